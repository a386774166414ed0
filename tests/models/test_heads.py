"""Decoding: painted truth through ideal network outputs comes back; both heads give the same kind of detections."""

import numpy as np
import pytest
from scipy import ndimage

from kibs_steps.models import heads

RGB = np.zeros((64, 64, 3), np.uint8)
THRESHOLDS = {"roof": 0.5, "prominence": 0.2, "min_area": 10, "corner": 0.3, "score": 0.5}
HEIGHTS = {"edges": [0.0, 1.0, 2.0, 4.0], "centres": [0.5, 1.5, 3.0], "fallback": 2.0}


def ideal_maps(labels, clip=4.0):
    """What a perfect dense network would say of a label image."""
    edge = np.zeros(labels.shape)
    distance = np.zeros(labels.shape)
    for label in range(1, labels.max() + 1):
        inside = np.pad(labels == label, 1)
        d = ndimage.distance_transform_edt(inside)[1:-1, 1:-1]
        edge[(d > 0) & (d <= 1)] = 1
        distance = np.maximum(distance, np.minimum(d / clip, 1))
    return {"roof": (labels > 0).astype(float)[None], "edge": edge[None], "distance": distance[None]}


def test_adjacent_sections_come_back_apart():
    labels = np.zeros((64, 64), int)
    labels[8:30, 10:40] = 1
    labels[30:50, 10:40] = 2
    labels[55:60, 50:60] = 3
    found = heads.dense_sections(ideal_maps(labels), THRESHOLDS, RGB)
    assert found.labels.max() == 3
    for label in (1, 2, 3):
        values, counts = np.unique(found.labels[labels == label], return_counts=True)
        assert counts.max() == (labels == label).sum()
        assert (found.labels == values[np.argmax(counts)]).sum() == (labels == label).sum()
    np.testing.assert_allclose(found.scores, 1)


def test_a_tile_alone_is_without_what_is_not_sure():
    labels = np.zeros((64, 64), int)
    labels[8:20, 10:40], labels[30:50, 10:40], labels[55:60, 50:60] = 1, 2, 3
    outputs = ideal_maps(labels)
    outputs["roof"][0][labels == 2] = 0.55
    contract = {"head": "dense", "thresholds": THRESHOLDS}
    every = heads.decode_sections(outputs, contract, np.zeros((64, 64, 3), np.uint8))
    assert heads.alone(every, outputs, contract) is every
    left = heads.alone(every, outputs, {**contract, "thresholds": {**THRESHOLDS, "sure": 0.6}})
    np.testing.assert_array_equal(left.labels > 0, (labels == 1) | (labels == 3))
    assert sorted(np.unique(left.labels)) == [0, 1, 2]
    assert left.scores.shape == (2,)


def test_an_unlikely_section_must_be_surer_a_roof():
    """Of two sections of one roof probability the one of a low score goes; a surer one of a low score stays."""
    labels = np.zeros((64, 64), int)
    labels[8:20, 10:40], labels[30:50, 10:40], labels[55:60, 50:60] = 1, 2, 3
    outputs = ideal_maps(labels)
    for label, roof in ((1, 0.6), (2, 0.6), (3, 0.8)):
        outputs["roof"][0][labels == label] = roof
    found = heads.Sections(labels, np.array([0.5, 0.05, 0.05], np.float32))
    contract = {"head": "dense", "thresholds": {**THRESHOLDS, "sure": 0.5, "likely": 0.1, "surer": 0.7}}
    left = heads.alone(found, outputs, contract)
    np.testing.assert_array_equal(left.labels, np.array([0, 1, 0, 2])[labels])


def test_a_summit_counts_by_its_rise_above_the_pass():
    """Two summits of 1 and 0.8 with a pass of 0.5 between them: two sections below a prominence of 0.3, one above it."""
    level = np.full((3, 9), 0.5)
    level[1, 2], level[1, 6] = 1.0, 0.8
    mask = np.ones(level.shape, bool)
    basins = heads.flood(heads.summits(level, mask & (level > 0.5)), mask, level)
    assert len(np.unique(heads.joined_basins(basins, level, 0.25))) == 2
    assert len(np.unique(heads.joined_basins(basins, level, 0.35))) == 1


def test_joining_depends_on_the_highest_pass_only():
    """Three summits in a row: the middle one joins across the higher pass, whatever labels the basins have."""
    level = np.array([[1.0, 0.5, 0.7, 0.6, 0.9]])
    for order in ((1, 2, 3), (3, 1, 2), (2, 3, 1)):
        basins = np.array(order, np.int32)[[[0, 0, 1, 1, 2]]]
        joined = heads.joined_basins(basins, level, 0.15)[0]
        assert joined[2] == joined[4] != joined[0]


def test_thin_roof_without_marker_is_a_section():
    labels = np.zeros((32, 32), int)
    labels[10:12, 4:28] = 1
    found = heads.dense_sections(ideal_maps(labels, 8.0), THRESHOLDS, RGB[:32, :32])
    np.testing.assert_array_equal(found.labels, labels)


def test_specks_are_absorbed_or_dropped():
    labels = np.zeros((32, 32), int)
    labels[5:25, 5:20] = 1
    labels[5:8, 20:22] = 2
    labels[29:31, 29:31] = 3
    found = heads.absorb_small(labels, 10)
    assert found.max() == 1
    assert (found[5:8, 20:22] == 1).all()
    assert found[29, 29] == 0


def test_no_roof_no_sections():
    found = heads.dense_sections(ideal_maps(np.zeros((16, 16), int)), THRESHOLDS, RGB[:16, :16])
    assert found.labels.max() == 0
    assert len(found.scores) == 0


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_corner_position_and_height(stride):
    """A peak moved by the offset map; the height is the mean of the distribution there, σ includes the bins' width."""
    corner = np.zeros((32, 32))
    corner[10, 20], corner[10, 21] = 0.9, 0.5
    offset = np.zeros((2, 32, 32))
    offset[:, 10, 20] = 0.3, -0.2
    height = np.zeros((3, 32 // stride, 32 // stride))
    height[0], height[1] = 0.25, 0.75
    found = heads.dense_corners(corner, offset, height, HEIGHTS, THRESHOLDS, len(corner))
    assert (found.col.tolist(), found.row.tolist()) == ([pytest.approx(20.8)], [pytest.approx(10.3)])
    assert found.height[0] == pytest.approx(1.25)
    assert found.sigma[0] == pytest.approx(np.sqrt(0.25 * 0.75 + 1 / 12))
    assert found.score[0] == pytest.approx(0.9)


def test_corners_of_a_coarser_heatmap_lie_where_they_lie():
    corner = np.zeros((16, 16))
    corner[5, 10] = 0.9
    offset = np.zeros((2, 16, 16))
    offset[:, 5, 10] = 0.4, -0.6
    found = heads.dense_corners(corner, offset, np.ones((3, 4, 4)) / 3, HEIGHTS, THRESHOLDS, 32)
    assert (found.col.tolist(), found.row.tolist()) == ([pytest.approx(21.4)], [pytest.approx(10.4)])


def test_no_corners_is_an_empty_table():
    found = heads.dense_corners(np.zeros((8, 8)), np.zeros((2, 8, 8)), np.ones((3, 8, 8)) / 3, HEIGHTS, THRESHOLDS, 8)
    assert [len(c) for c in found] == [0] * 5


def test_instances_paste_where_their_boxes_are():
    """Full 28×28 masks fill their boxes; the better score wins an overlap; low scores are left out."""
    outputs = {
        "boxes": np.array([[4, 4, 20, 20], [14, 4, 30, 20], [40, 40, 60, 60]], np.float32),
        "labels": np.ones(3, np.int64),
        "scores": np.array([0.9, 0.8, 0.1], np.float32),
        "masks": np.ones((3, 28, 28), np.float32),
    }
    found = heads.instance_sections(outputs, 64, {**THRESHOLDS, "min_area": 4})
    assert found.labels.max() == 2
    assert (found.labels[5:19, 5:19] == found.labels[10, 10]).all()
    assert found.labels[10, 25] not in (0, found.labels[10, 10])
    assert found.labels[50, 50] == 0
    np.testing.assert_allclose(np.sort(found.scores), [0.8, 0.9])


def test_instance_corners_decode_class_to_bin():
    """Class 1 is the first bin (0-based labels would be 1 m off: PAPER, finding 8); two boxes on one corner are one."""
    outputs = {
        "boxes": np.array([[10, 10, 25, 25], [10, 10, 25, 25], [40, 40, 55, 55]], np.float32),
        "labels": np.array([1, 2, 3]),
        "scores": np.array([0.6, 0.6, 0.9], np.float32),
    }
    found = heads.instance_corners(outputs, HEIGHTS, THRESHOLDS)
    assert sorted(zip(found.col.tolist(), found.height.round(6).tolist(), strict=True)) == [(17.5, 1.0), (47.5, 3.0)]


def test_a_full_mask_fills_its_box_to_the_rim():
    """Wide boxes too, whose outermost pixels lie beyond the centres of the mask's outermost cells."""
    for box in ([10, 20, 50, 40], [3, 3, 60, 63], [5, 5, 12, 9]):
        window, mask = heads.pasted(np.float32(box), np.ones((28, 28), np.float32), 64)
        assert (window[1].start, window[0].start, window[1].stop, window[0].stop) == tuple(box)
        assert (mask > 0.5).all(), box


def test_small_sections_that_touch_are_one_that_is_large_enough():
    labels = np.zeros((8, 12), np.int32)
    labels[2:5, 1:5], labels[2:5, 5:9] = 1, 2  # 12 px each
    for order in (labels, np.where(labels > 0, 3 - labels, 0)):
        assert (heads.absorb_small(order, 16) == (labels > 0)).all()
    assert not heads.absorb_small(labels, 25).any()


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_a_corners_height_is_read_where_the_corner_lies(stride):
    """Heights rise along the columns, σ along the rows: neither axis may be taken for the other."""
    n = 32 // stride
    along = (np.arange(n) + 0.5) * stride / 32
    height = np.stack([np.broadcast_to(1 - along, (n, n)), np.broadcast_to(along, (n, n)), np.zeros((n, n))])
    corner, offset = np.zeros((32, 32)), np.zeros((2, 32, 32))
    corner[10, 20] = 0.9
    offset[:, 10, 20] = 0.3, -0.2
    found = heads.dense_corners(corner, offset, height, HEIGHTS, THRESHOLDS, 32)
    assert found.height[0] == pytest.approx(0.5 + 20.8 / 32)


@pytest.mark.parametrize(("apart", "n"), [(1, 1), (2, 1), (3, 2)])
def test_peaks_within_two_cells_are_one_corner(apart, n):
    corner = np.zeros((32, 32))
    corner[10, 10], corner[10, 10 + apart] = 0.9, 0.8
    found = heads.dense_corners(corner, np.zeros((2, 32, 32)), np.ones((3, 8, 8)) / 3, HEIGHTS, THRESHOLDS, 32)
    assert len(found.col) == n
