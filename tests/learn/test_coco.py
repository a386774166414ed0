"""COCO there and back, ids that cannot mix tiles, and what foreign or broken files do."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("pycocotools", reason="COCO needs the extra `learn` (pycocotools)")

from kibs_steps.learn import coco
from kibs_steps.learn.samples import UNKNOWN, Sample

SIZE = 40


def sample(seed: int = 0) -> Sample:
    """Two sections of one roof, a roof whose sections are unknown, and ground nobody looked at."""
    rng = np.random.default_rng(seed)
    made = Sample.ground(rng.integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8))
    made.labels[5:12, 4:20] = 1
    made.labels[12:20, 4:20] = 2
    made.labels[25:30, 25:35] = -1
    made.labels[35:, :] = -1
    made.roof[made.labels != 0] = 1
    made.roof[35:, :] = UNKNOWN
    made.corners_known[33:, :] = 0
    return made._replace(
        corners=np.float32([[4.25, 5.5], [20, 5], [0.5, 39.5], [39.9, 0.1]]),
        corner_heights=np.float32([3.2, 6.0, np.nan, 25.0]),
        geometry=np.float32([0.1, 1.5, -2, 0, 1, 1]),
    )


def equal(one: Sample, other: Sample) -> None:
    for name in ("rgb", "labels", "roof", "corners", "corner_heights", "corners_known", "geometry"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_there_and_back(tmp_path):
    samples = {name: sample(i) for i, name in enumerate(("1", "10", "1-0", "été"))}
    coco.write(tmp_path, samples.items(), coco.paper_bins())
    found = dict(coco.read(tmp_path))
    assert list(found) == list(samples)
    for name, one in samples.items():
        equal(found[name], one)


@given(st.lists(st.integers(0, 6), min_size=SIZE, max_size=SIZE), st.integers(0, 3))
def test_any_label_image_comes_back(tmp_path_factory, columns, turn):
    labels = np.rot90(np.tile(np.int32(columns) - 1, (SIZE, 1)), turn).copy()
    _, order = np.unique(labels[labels > 0], return_inverse=True)
    labels[labels > 0] = order + 1
    one = sample()._replace(labels=labels, roof=(labels != 0).astype(np.uint8))
    folder = tmp_path_factory.mktemp("coco")
    coco.write(folder, [("a", one)], coco.paper_bins())
    ((_, found),) = coco.read(folder)
    equal(found, one)


def test_ids_are_exact_and_squares_carry_their_class():
    sections, corners = coco.annotations([("1", sample()), ("11", sample(1))], coco.paper_bins(), side=15)
    for content in (sections, corners):
        ids = [a["id"] for a in content["annotations"]]
        assert ids == list(range(1, len(ids) + 1))
        assert [a["image_id"] for a in content["annotations"]] == [1] * (len(ids) // 2) + [2] * (len(ids) // 2)
    assert {a["category_id"] for a in sections["annotations"]} == {1}
    assert [a["area"] for a in sections["annotations"] if not a["iscrowd"]][:2] == [7 * 16, 8 * 16]
    squares = [a for a in corners["annotations"] if not a["iscrowd"]][:4]
    names = {c["id"]: c["name"] for c in corners["categories"]}
    assert [names[a["category_id"]] for a in squares] == [
        "2.5-3.5 m",
        "5.5-6.5 m",
        "unknown height",
        "18.5-19.5 m",
    ]
    assert squares[1]["bbox"] == [13, 0, 15, 13]  # pixels 13–27 about x = 20 … cut at the tile's upper edge
    assert squares[2]["bbox"] == [0, 32, 8, 8]


@given(
    st.floats(0, SIZE - 0.01),
    st.floats(0, SIZE - 0.01),
    st.integers(1, 20),
)
def test_a_square_holds_its_corner(col, row, side):
    ((x0, y0, x1, y1),) = coco.squares(np.array([[col, row]]), (SIZE, SIZE), side)
    assert x0 <= col < x1 + 1
    assert y0 <= row < y1 + 1
    assert 0 <= x0 < x1 <= SIZE
    assert x1 - x0 <= side
    inside = side / 2 < col < SIZE - side / 2 - 1
    assert not inside or (x1 - x0 == side and abs((x0 + x1) / 2 - col) <= 1)


def test_files_of_other_makers(tmp_path):
    """Polygons instead of run lengths, no exact corners, no corners at all."""
    coco.write(tmp_path, [("a", sample())], coco.paper_bins())
    content = json.loads((tmp_path / "sections.json").read_text())
    content["annotations"] = [
        {
            "id": 9,
            "image_id": 1,
            "category_id": 1,
            "bbox": [3, 3, 10, 6],
            "segmentation": [[3, 3, 13, 3, 13, 9, 3, 9]],
        }
    ]
    (tmp_path / "sections.json").write_text(json.dumps(content))
    squares = json.loads((tmp_path / "corners.json").read_text())
    for annotation in squares["annotations"]:
        annotation.pop("corner", None), annotation.pop("height", None)
    (tmp_path / "corners.json").write_text(json.dumps(squares))
    ((_, found),) = coco.read(tmp_path)
    assert (found.labels == 1).sum() == pytest.approx(60, abs=12)
    np.testing.assert_allclose(found.corners[1], [20.5, 6.5])
    np.testing.assert_array_equal(found.corner_heights, np.float32([3, 6, np.nan, 19]))
    (tmp_path / "corners.json").unlink()
    ((_, found),) = coco.read(tmp_path)
    assert not found.corners_known.any()
    assert not len(found.corners)


def test_of_several_categories_those_of_roofs_count(tmp_path):
    coco.write(tmp_path, [("a", sample())], coco.paper_bins())
    content = json.loads((tmp_path / "sections.json").read_text())
    square = {"image_id": 1, "bbox": [3, 3, 10, 6], "iscrowd": 0}
    shapes = {1: [[3, 3, 13, 3, 13, 9, 3, 9]], 2: [[20, 20, 30, 20, 30, 30, 20, 30]]}
    content["annotations"] = [{**square, "id": k, "category_id": k, "segmentation": s} for k, s in shapes.items()]
    for names, right in ((("Roof section", "tree"), True), (("house", "tree"), False)):
        content["categories"] = [{"id": k, "name": name} for k, name in enumerate(names, start=1)]
        (tmp_path / "sections.json").write_text(json.dumps(content))
        if right:
            ((_, found),) = coco.read(tmp_path)
            assert found.roof[5, 8] == 1
            assert not found.roof[22:28, 22:28].any()
        else:
            with pytest.raises(coco.BadAnnotations, match=r"categories house, tree: call that of roof sections"):
                list(coco.read(tmp_path))


def test_squares_that_were_moved_or_classed_anew_by_hand_count_as_they_are(tmp_path):
    """The tool kept the exact corner and height of before in its fields."""
    coco.write(tmp_path, [("a", sample())], coco.paper_bins())
    content = json.loads((tmp_path / "corners.json").read_text())
    content["annotations"][1]["bbox"] = [15, 10, 15, 15]
    content["annotations"][0]["category_id"] = 9
    content["annotations"][3]["category_id"] = 20
    (tmp_path / "corners.json").write_text(json.dumps(content))
    ((_, found),) = coco.read(tmp_path)
    np.testing.assert_allclose(found.corners, np.float32([[4.25, 5.5], [22.5, 17.5], [0.5, 39.5], [39.9, 0.1]]))
    np.testing.assert_array_equal(found.corner_heights, np.float32([9, 6, np.nan, np.nan]))


@pytest.mark.parametrize("fault", ["twice", "no image", "another size", "no picture", "no COCO", "nothing"])
def test_broken_files_are_refused(tmp_path, fault):
    coco.write(tmp_path, [("a", sample()), ("b", sample(1))], coco.paper_bins())
    content = json.loads((tmp_path / "sections.json").read_text())
    if fault == "twice":
        content["annotations"][1]["id"] = content["annotations"][0]["id"]
    if fault == "no image":
        content["annotations"][0]["image_id"] = 77
    if fault == "another size":
        content["images"][0]["width"] += 1
    if fault == "no picture":
        (tmp_path / "images" / "b.png").unlink()
    if fault == "no COCO":
        content = [1]
    (tmp_path / "sections.json").write_text(json.dumps(content))
    if fault == "nothing":
        (tmp_path / "sections.json").unlink()
    with pytest.raises(coco.BadAnnotations):
        list(coco.read(tmp_path))
