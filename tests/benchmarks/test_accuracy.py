"""The accuracy benchmark: its own sums against figures that are known, and one run of it on the toy models."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import toy

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.accuracy import __main__ as program
from benchmarks.accuracy import chips, methods, scenes, table
from kibs_steps.learn.samples import UNKNOWN, Sample
from kibs_steps.models import contract, runtime
from kibs_steps.view import lean

S = chips.SIDE


def tile(seed=0):
    """Two sections of a roof, a speck, and ground whose sections are unknown."""
    made = Sample.ground(np.zeros((S, S, 3), np.uint8))
    made.labels[20:40, 10:50], made.labels[40:60, 10:50], made.labels[100:102, 100:103] = 1, 2, 3
    made.labels[150:, 150:] = -1
    made.corners_known[150:, 150:] = 0
    made.roof[made.labels > 0] = 1
    made.roof[150:, 150:] = UNKNOWN
    return made._replace(corners=np.float32([[10, 20], [50, 20], [10, 60], [50, 60]]))


def test_the_truth_itself_scores_one():
    one = tile()
    found = chips.Found(one.labels.clip(0), np.array([0.9, 0.8, 0.7]), one.corners.astype(float))
    figures = chips.figures([one, one], [found, found])
    for key in ("iou", "ap50", "mean_best_iou", "pq", "corner_precision", "corner_recall"):
        assert figures[key] == pytest.approx(1), key
    assert figures["truth"] == 4


def test_mistakes_cost_what_they_should():
    """A section found as one with its neighbour, one made up, one where nobody knows; one corner off by more than 2 px."""
    one = tile()
    labels = np.zeros((S, S), np.int32)
    labels[20:40, 10:50], labels[120:140, 10:30], labels[160:170, 160:170] = 1, 2, 3
    corners = one.corners + np.array([[0, 0], [1, 1], [0, 0], [3, 0]])
    figures = chips.figures([one], [chips.Found(labels, np.array([0.9, 0.95, 0.99]), corners)])
    assert (figures["truth"], figures["predicted"]) == (2, 2)
    assert figures["pq"] == pytest.approx(1 / (1 + 0.5 + 0.5))
    assert figures["mean_best_iou"] == pytest.approx(0.5)
    assert figures["ap50"] == pytest.approx(0.5 * 51 / 101)  # recall 0.5 at precision 0.5
    assert figures["iou"] == pytest.approx(800 / (1606 + 400))
    assert figures["corner_precision"] == figures["corner_recall"] == 0.75


def test_corners_of_one_tile_are_no_others():
    one = tile()
    none = one._replace(corners=one.corners[:0])
    found = chips.Found(one.labels.clip(0), np.ones(3), one.corners.astype(float))
    empty = found._replace(corners=np.zeros((0, 2)))
    figures = chips.corner_figures([one, none], [empty, found])
    assert figures == {"corner_precision": 0.0, "corner_recall": 0.0}


def test_methods_of_a_folder(tmp_path):
    toy.models(tmp_path / "pair")
    toy.both_model(tmp_path / "pair" / "both.onnx")
    told = {"data": ["toy"], "licence": "CC0-1.0", "init": "none", "tiles_seen": 12, "minutes": 3, "converged": False}
    toy.both_model(tmp_path / "one" / "both.onnx", toy.contract("both", trained_on=told))
    found = methods.of(tmp_path)
    assert [m.name for m in found] == ["one single", "pair single", "pair two-stage"]
    assert found[0].training == {"init": "none", "tiles_seen": "12", "minutes": "3", "state": "not converged"}
    assert found[1].training["state"] == "not told"
    assert found[2].settings["method"] == "two_stage"
    with pytest.raises(methods.NoModels):
        methods.of(tmp_path / "nowhere")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "both.onnx").write_bytes(b"x")
    with pytest.raises(contract.NotAModel):
        methods.of(tmp_path / "bad")


def test_a_method_takes_the_set_made_for_a_view_as_the_workflow_does(tmp_path):
    for place, gsd, elevation in (("", 0.38, [45, 90]), ("nadir", 0.38, [85, 90]), ("fine", 0.2, [45, 90])):
        told = {"data": ["toy"], "licence": "CC0-1.0", "view_elevation": elevation}
        for task, make in (("sections", toy.sections_model), ("corners", toy.corners_model)):
            make(tmp_path / place / f"{task}.onnx", toy.contract(task, gsd=gsd, trained_on=told))
    method, finer = methods.of(tmp_path)
    assert [len(method.sets), len(finer.sets)] == [2, 1]

    def place(view):
        return method.models(view)[0].path.parent

    assert place({"azimuth": 180.0, "elevation": 60.0}) == place(None) == tmp_path
    assert place({"azimuth": 0.0, "elevation": 90.0}) == tmp_path / "nadir"


@pytest.mark.parametrize("view", [(181.1, 59.3), (250.0, 62.0), (30.0, 88.0), (0.0, 90.0)])
def test_views_are_told_by_geometry_vectors(view):
    vector = runtime.geometry_vector(lean(*view), None, 0.38)[0]
    told = chips.seen_from(vector, 0.38)
    assert told["elevation"] == pytest.approx(view[1])
    assert view[1] == 90 or told["azimuth"] == pytest.approx(view[0], rel=1e-5)
    assert chips.seen_from(np.zeros(6, np.float32), 0.38) is None


def test_a_runner_sees_the_tile_where_it_is(tmp_path):
    """The toy networks (64 px) are asked for a smaller picture than they take: places are those of the picture."""
    toy.models(tmp_path)
    (method,) = methods.of(tmp_path)
    side, chips.SIDE = chips.SIDE, 48
    try:
        rgb = toy.paint([(8, 8, 20, 16, 50, (3.0, 3.0, 5.0, 5.0))], 48, 48)
        found = chips.Runner(method)(Sample.ground(rgb))
    finally:
        chips.SIDE = side
    assert (found.labels[10:22, 10:26] > 0).all()
    assert not found.labels[:7].any()
    assert sorted(map(tuple, np.floor(found.corners).astype(int).tolist())) == [(8, 8), (8, 23), (27, 8), (27, 23)]


def test_the_table_shows_all_figures():
    rows = [
        {"set": "A nadir", "method": "m", "iou": 0.91234, "found_mae": 0.5, "found_mae_by_height": {"0-3 m": 0.1}},
        {"set": "C paris", "method": "m", "iou": 0.5},
        {"set": "C rome", "method": "m", "iou": 0.7},
    ]
    rows += table.mean_of_places(rows)
    assert rows[-1] == {"set": "C mean", "method": "m", "iou": pytest.approx(0.6)}
    told = {
        "m": {"init": "a", "tiles_seen": "5", "minutes": "1", "state": "converged", "tile": 256, "ms_per_tile": 12.3}
    }
    text = table.markdown(rows, told)
    assert "| A nadir | m | 0.912 | – |" in text
    assert "| m | a | 5 | 1 | converged | 12 | 256 |" in text
    assert "| A nadir | m | 0.10 |" in text


@pytest.mark.long
def test_one_command_and_nothing_twice(tmp_path, monkeypatch):
    """Set A with the toy models on a small made-up city; the second call runs no network again."""
    toy.models(tmp_path / "models" / "toy")
    monkeypatch.setattr(scenes, "VIEWS", {"A nadir": (0.0, 90.0)})
    words = [
        f"--models={tmp_path / 'models'}",
        f"--work={tmp_path / 'work'}",
        f"--out={tmp_path / 't.json'}",
        "--size=200",
    ]
    program.main(words)
    first = json.loads((tmp_path / "t.json").read_text())
    assert [row["set"] for row in first["rows"]] == ["A nadir"]
    assert first["rows"][0]["iou"] is not None
    made = {p: p.stat().st_mtime_ns for p in (tmp_path / "work").rglob("*.tif")}
    program.main(words)
    assert json.loads((tmp_path / "t.json").read_text()) == first
    assert made == {p: p.stat().st_mtime_ns for p in (tmp_path / "work").rglob("*.tif")}
