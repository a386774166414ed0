"""Every bad input of docs/inputs.md gets the error and the message that the page gives, before any work."""

from __future__ import annotations

from pathlib import Path

import cases
import good_inputs
import numpy as np
import page
import pyproj
import pytest
import rasterio
import rasters
import shapely
import yaml

from kibs_steps import inputs, plan, scene, settings, truth
from kibs_steps.errors import KibsError

SCHEMA = yaml.safe_load((Path(__file__).parents[2] / "workflow/schemas/config.schema.yaml").read_text())


def attempt(folder: Path, config: dict) -> list[str]:
    """All that looks at a user's inputs, in the workflow's order: the plan, the headers, then the jobs `scene` and `truth`.

    Returns the doubts.
    """
    config = {key: value for key, value in config.items() if value is not None}
    inputs.writable(folder / "results")
    ((name, values),) = plan.scenes(config, SCHEMA).items()
    planned = plan.plan(name, values, folder, folder / "results")
    doubts = planned.warnings + inputs.check(planned, folder / "results")
    view = (values.get("view_azimuth"), values.get("view_elevation"))
    bands, ground = inputs.bands_of(values), planned.dtm
    out = folder / "results" / name
    vertical = values.get("vertical_crs")
    made = scene.build(name, planned.raster, ground, 0.38, out, bands=bands, view=view, vertical_crs=vertical)
    if planned.truth:
        layer = truth.read_layer(planned.truth, values["truth_frame"])
        truth.table(layer, made, values["truth_frame"], values["truth_z"])
    return doubts


@pytest.mark.parametrize("case", cases.CASES, ids=lambda c: f"{c.part}: {c.given}")
def test_refused(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = {**good_inputs.good(tmp_path), **case.make(tmp_path)}
    with pytest.raises(KibsError) as caught:
        attempt(tmp_path, config)
    said = str(caught.value).replace(f"{tmp_path}/", "")
    assert type(caught.value).__name__ == case.error, said
    assert cases.pattern(case.message).fullmatch(said), said
    assert not list(tmp_path.glob("results/s/blocks"))


def test_the_good_input_is_taken(tmp_path):
    assert attempt(tmp_path, good_inputs.good(tmp_path)) == []


def test_the_page_tells_all_cases():
    assert page.tables() in page.PAGE.read_text()


def test_a_truth_that_crosses_itself_is_repaired(tmp_path, capsys):
    """A bow tie becomes its two triangles, each with heights."""
    left, bottom, right, top = good_inputs.BOX
    spike = [(right, bottom, 58), (right + 2, bottom, 58), (right, bottom, 58)]  # and back again
    tie = shapely.Polygon([(left, bottom, 58), (right, top, 58), *spike, (left, top, 58)])
    path = good_inputs.vector(tmp_path / "t.gpkg", [tie, good_inputs.roof()])
    layer = truth.read_layer(path, "map")
    assert len(layer.polygons) == 3
    assert shapely.is_valid(layer.polygons).all()
    assert np.isfinite(shapely.get_coordinates(layer.polygons, include_z=True)).all()
    assert shapely.area(layer.polygons).tolist() == pytest.approx([12.0, 12.0, 48.0])
    assert "1 outlines cross themselves (rows 1)" in capsys.readouterr().err


def test_a_terrain_in_a_crs_in_feet_is_doubted(tmp_path):
    config = good_inputs.good(tmp_path)
    place = rasterio.Affine(0.38, 0, 583_000, 0, -0.38, 4_507_000)
    path = rasters.write(tmp_path / "b.tif", rasters.picture(), "EPSG:32618", transform=place)
    heights = np.full((400, 400), 160, "float32")
    x, y = pyproj.Transformer.from_crs(32618, 2263, always_xy=True).transform(583_000, 4_507_000)
    ground = rasters.dtm(tmp_path / "feet.tif", heights, x - 1200, y + 1200, step=7.0, crs="EPSG:2263")
    doubts = attempt(tmp_path, {**config, "raster": str(path), "dtm": str(ground)})
    assert any("-units ft" in doubt for doubt in doubts)


def test_bad_yaml_is_told_with_its_line(tmp_path):
    (tmp_path / "config.yaml").write_text("block: 8\nscenes: [\n")
    with pytest.raises(settings.BadConfig, match=r"config\.yaml, line 3, column 1: .*indented with spaces"):
        settings.read(tmp_path / "config.yaml")
    (tmp_path / "config.yaml").write_text("!!python/object/apply:os.system ['touch pwned']")
    with pytest.raises(settings.BadConfig, match=r"config\.yaml, line 1"):
        settings.read(tmp_path / "config.yaml")
    assert not Path("pwned").exists()
    (tmp_path / "config.yaml").write_bytes(b"scene: \xff")
    with pytest.raises(settings.BadConfig, match="UTF-8"):
        settings.read(tmp_path / "config.yaml")
