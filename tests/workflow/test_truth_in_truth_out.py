"""feed=truth on a small simulated scene, through every step: what goes in comes out, on flat ground and on a slope."""

from __future__ import annotations

import json

import numpy as np
import pyogrio
import pytest
import shapely
import toy
from test_workflow import SNAKEMAKE, finished

ANGLES = {"view_azimuth": 181.1, "view_elevation": 59.3, "sun_azimuth": 155.0, "sun_elevation": 45.0}


@pytest.mark.parametrize("slope", [0, 15])
def test_truth_in_truth_out(tmp_path, slope):
    """Sections come back within 0.05 m in the map frame and 0.1 px in the image; heights within 0.05 m."""
    toy.models(tmp_path / "models")
    simulated = {"seed": 4, "size": 420, "gsd": 0.38, "style": "suburb", "relief": 0.0, "slope": slope}
    config = {"scenes": {"s": {"simulate": simulated, **ANGLES}}, "feed": "truth", "models": "models", "block": 4}
    (tmp_path / "config.yaml").write_text(json.dumps(config))
    finished(tmp_path, [*SNAKEMAKE, "results/s/city.gpkg", "results/s/evaluation.json", "--cores", "2"])
    folder = tmp_path / "results/s"
    for layer, truth_layer, tolerance in (
        ("roof_sections", "sections_map", 0.05),
        ("roof_sections_image", "sections_image", 0.1 * 0.38),
    ):
        truth = pyogrio.read_dataframe(folder / "simulated/truth.gpkg", layer=truth_layer)
        found = pyogrio.read_dataframe(folder / "city.gpkg", layer=layer)
        whole = found[~found["status"].isin(["raster_edge", "cloud_or_nodata"])]
        assert len(whole) > 20
        tree = shapely.STRtree(np.array(truth.geometry))
        matched = 0
        for polygon in whole.geometry:
            points = shapely.get_coordinates(polygon, include_z=True)
            near = [truth.geometry.iloc[i] for i in tree.query(polygon)]
            best = np.inf
            for other in near:
                vertices = shapely.get_coordinates(other, include_z=True)
                gap = np.abs(points[:, None] - vertices[None])
                plan, z = np.hypot(gap[..., 0], gap[..., 1]), gap[..., 2]
                best = min(best, np.where((plan < tolerance) & (z < 0.05), 0.0, plan + z).min(axis=1).max())
            matched += best == 0.0
        assert matched == len(whole), (
            f"{layer}: {len(whole) - matched} of {len(whole)} sections are not where they were"
        )
    evaluation = json.loads((folder / "evaluation.json").read_text())
    figures = (
        evaluation["pixels"]["all"]["iou"],
        evaluation["sections"]["all"]["ap50"],
        evaluation["sections"]["all"]["pq"],
    )
    assert min(figures) > 0.97, figures
    assert evaluation["heights"]["found"]["all"]["mae"] < 0.05
