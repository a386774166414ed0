"""Real Snakemake runs of the two methods, of the paper's mode, and of a suite."""

from __future__ import annotations

import json

import numpy as np
import pyogrio
import pytest
import rasterio
import toy
from test_workflow import MAIN, SNAKEMAKE, digests, finished, jobs, run, world

NEEDED = [*MAIN, "run.json"]


@pytest.fixture(scope="session")
def towns(tmp_path_factory):
    """One town by two models, and by one model that does both."""
    two = world(tmp_path_factory.mktemp("two"))
    run(two, only=NEEDED)
    one = world(tmp_path_factory.mktemp("one"))
    toy.both_model(one / "models/both.onnx")
    return two, one, run(one, method="single", only=NEEDED)


def test_one_model_gives_what_two_give(towns):
    two, one, output = towns
    done = jobs(output)
    assert not {"sections", "blend", "corners"} & set(done)
    assert done["single"] == done["tiles"]
    assert digests(one, files=["points.txt"]) == digests(two, files=["points.txt"])
    for layer in ("roof_sections", "roof_sections_image", "buildings", "corners"):
        frames = [pyogrio.read_dataframe(f / "results/town/city.gpkg", layer=layer) for f in (one, two)]
        assert len(frames[0]) > 0
        assert frames[0].equals(frames[1]), layer
    for name in ("labels.tif", "heights.tif"):
        with (
            rasterio.open(one / "results/town" / name) as first,
            rasterio.open(two / "results/town" / name) as second,
        ):
            np.testing.assert_array_equal(first.read(), second.read())
    assert "both.onnx" in (one / "results/town/run.json").read_text()
    assert jobs(run(one, method="single", only=NEEDED)) == {}


def test_methods_of_two_scenes_in_one_run(tmp_path):
    folder = world(tmp_path)
    toy.both_model(folder / "models/both.onnx")
    scene = {"raster": "town.tif", "dtm": 100, "models": "models", "block": 4, **toy.VIEW}
    config = {"scenes": {"a": {**scene, "method": "single"}, "a.b": {**scene, "method": "two_stage"}}}
    (folder / "config.yaml").write_text(json.dumps(config))
    files = [f"results/{name}/points.txt" for name in ("a", "a.b")]
    done = jobs(finished(folder, [*SNAKEMAKE, *files, "--cores", "2"]))
    assert done["single"] == 1
    assert done["sections"] == done["corners"] == 1
    points = ["points.txt"]
    assert digests(folder, "a", points) == digests(folder, "a.b", points)


def test_paper_mode_is_one_switch(towns, tmp_path):
    """Stride s − p, planes by the paper's rule, the picture with its codes: the same sections where tiles see them whole."""
    two = towns[0]
    folder = world(tmp_path)
    run(folder, mode="paper", planes="robust", only=[*NEEDED, "paper.tif"])
    record = json.loads((folder / "results/town/run.json").read_text())
    assert record["settings"]["planes"] == "paper"
    stack = [len(list((f / "results/town/blocks").iterdir())) for f in (folder, two)]
    assert stack[0] <= stack[1]
    sections = [
        pyogrio.read_dataframe(f / "results/town/city.gpkg", layer="roof_sections_image") for f in (folder, two)
    ]
    assert abs(len(sections[0]) - len(sections[1])) <= 0.1 * len(sections[1])
    with rasterio.open(folder / "results/town/paper.tif") as source:
        red, green, blue = source.read()
    with rasterio.open(folder / "results/town/labels.tif") as source:
        labels = source.read(1)
    assert set(np.unique(blue)) == {0, 220}  # no tile of this raster belongs to a training set
    assert not green.any()
    assert (labels[blue > 0] > 0).mean() > 0.98  # rims that run through a pixel's very centre may differ
    heights = pyogrio.read_dataframe(folder / "results/town/city.gpkg", layer="corners")["height"].to_numpy()
    expected = {200 + round(h) for h in heights.tolist()}
    found = set(np.unique(red).tolist()) - {0}
    assert found <= expected
    assert len(found) > 3
    assert not (two / "results/town/paper.tif").exists()


def test_the_scene_chooses_from_a_suite(tmp_path):
    folder = world(tmp_path)
    for name, elevations in (("steep", [70, 90]), ("oblique", [50, 65])):
        terms = {"trained_on": {"data": [name], "licence": f"licence of {name}", "view_elevation": elevations}}
        toy.sections_model(folder / "suite" / name / "sections.onnx", toy.contract("sections", **terms))
        toy.corners_model(folder / "suite" / name / "corners.onnx", toy.contract("corners", **terms))
    output = run(folder, models="suite", block=4, only=["run.json"])
    assert "licence of oblique" in output
    assert "licence of steep" not in output
    assert "suite/oblique/sections.onnx" in (folder / "results/town/run.json").read_text()
    done = jobs(run(folder, models="suite", block=4, view_elevation=80, only=["run.json"]))
    assert {"sections", "corners"} <= set(done)


def test_a_sun_that_nobody_told_is_supposed_on_request(tmp_path):
    folder = world(tmp_path)
    toy.lit_sections_model(folder / "models/sections.onnx")
    plain = run(folder, block=4, only=NEEDED)
    assert "supposed" not in jobs(plain)
    known = digests(folder, files=["points.txt"])
    done = jobs(run(folder, block=4, suppose=True, only=NEEDED))
    assert done["supposed"] == 1
    assert {"sections", "points"} <= set(done)
    assert not {"scene", "tiles"} & set(done)
    found = json.loads((folder / "results/town/supposed.json").read_text())
    assert (found["sun"]["azimuth"], found["sun"]["elevation"]) == (180.0, 30.0)  # the longest shadow to the north
    assert found["view"]["azimuth"] == toy.VIEW["view_azimuth"]
    assert "lit from azimuth 180°" in (folder / "results/town/logs/supposed.log").read_text()
    assert jobs(run(folder, block=4, suppose=True, only=NEEDED)) == {}
    # A sun that is told is not supposed; roofs are where they were, as nothing is moved by a sun.
    done = jobs(run(folder, block=4, suppose=True, sun_azimuth=180, sun_elevation=30, only=NEEDED))
    assert "supposed" not in done
    assert digests(folder, files=["points.txt"]) == known
