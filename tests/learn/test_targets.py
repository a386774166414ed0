"""Targets against brute force on small label images."""

import numpy as np
import pytest

from kibs_steps.labels import rims
from kibs_steps.learn import targets


@pytest.fixture
def labels() -> np.ndarray:
    image = np.zeros((24, 30), np.int32)
    image[3:14, 4:12] = 1
    image[3:14, 12:21] = 2
    image[16:19, 6:9] = 3
    image[18:24, 20:30] = -1
    return image


def test_distance_is_that_of_brute_force(labels):
    clip = 3.0
    expected = np.zeros(labels.shape)
    rim = rims(labels)
    for row, col in np.argwhere(labels > 0):
        own = np.argwhere(rim & (labels == labels[row, col]))
        far = np.sqrt(((own - (row, col)) ** 2).sum(1).min())
        expected[row, col] = min(far + 0.5, clip)
    for label in (1, 2, 3):
        expected[labels == label] /= expected[labels == label].max()
    np.testing.assert_allclose(targets.distance(labels, clip), expected, atol=1e-6)


def test_surface_gives_the_shares_of_each_cell():
    kinds = np.zeros((8, 8), np.uint8)
    kinds[:2, :2], kinds[0, 0], kinds[3, 3] = 1, 2, targets.IGNORED
    shares = targets.surface(kinds, 3)
    assert shares.shape == (3, 4, 4)
    np.testing.assert_allclose(shares[:, 0, 0], (0, 3 / 4, 1 / 4))
    np.testing.assert_allclose(shares[:, 0, 1], (1, 0, 0))
    assert not shares[:, 1, 1].any()


def test_slope_is_that_of_each_plane():
    labels = np.zeros((16, 24), np.int32)
    labels[2:14, 2:12], labels[2:14, 12:22] = 1, 2
    row, col = np.mgrid[:16, :24]
    height = np.where(labels == 1, 3 + 0.25 * col - 0.1 * row, np.where(labels == 2, 9 - 0.5 * col, np.nan))
    rise = targets.slope(labels, height.astype(np.float32))
    np.testing.assert_allclose(rise[:, 1, 1], (0.25, -0.1), atol=1e-5)
    np.testing.assert_allclose(rise[:, 1, 4], (-0.5, 0), atol=1e-5)
    assert np.isnan(rise[:, 0, 5]).all()  # the middle of the last cells lies off the roof


def test_centre_is_the_way_to_the_middle_of_the_section():
    labels = np.zeros((16, 200), np.int32)
    labels[2:14, 2:12], labels[2:14, 16:196] = 1, 2  # middles (7, 8) and (106, 8)
    labels[:, 196:] = 3  # cut by the tile
    way = targets.centre(labels)
    np.testing.assert_allclose(way[:, 1, 1], (1, 2))  # the cell's middle is (6, 6)
    np.testing.assert_allclose(way[:, 1, 25], (4, 2))  # (102, 6)
    np.testing.assert_allclose(np.hypot(*way[:, 1, 5]), 64, rtol=1e-6)  # (22, 6): 84 px away
    np.testing.assert_allclose(way[1, 1, 5] / way[0, 1, 5], 2 / 84, rtol=1e-6)
    assert np.isnan(way[:, 1, 49]).all()
    assert np.isnan(way[:, 1, 3]).all()  # (14, 6) lies between the two


def test_edge_ignores_unknown_and_keeps_shared_rims(labels):
    edge = targets.edge(labels)
    assert (edge[labels == -1] == targets.IGNORED).all()
    assert edge[8, 11] == edge[8, 12] == 1  # both sides of the shared edge
    assert edge[8, 7] == 0
    assert edge[0, 0] == 0


def test_small_sections_weigh_more(labels):
    weight = targets.section_weight(labels)
    assert weight[17, 7] > weight[8, 8] > 0
    assert weight[0, 0] == 1


@pytest.mark.parametrize("seed", range(8))
def test_perturbed_sections_keep_shape_and_type(labels, seed):
    clean = np.maximum(labels, 0)
    wrong = targets.perturbed(clean, np.random.default_rng(seed))
    assert wrong.shape == labels.shape
    assert wrong.dtype == labels.dtype
    assert wrong.min() >= 0
    assert (clean == np.maximum(labels, 0)).all()


def test_touching_sections_are_found(labels):
    assert targets._touching(np.maximum(labels, 0)) == [(1, 2)]


def test_corner_maps_say_where_the_corner_is():
    corners = np.array([[5.25, 9.75], [0.0, 0.0], [12.0, 40.0]])  # the last lies outside
    heights = np.array([4.0, np.nan, 7.0], np.float32)
    heat = targets.corner_heat(corners, (16, 16))
    assert heat[9, 5] == heat[0, 0] == 1
    assert (heat == 1).sum() == 2
    offset = targets.corner_offset(corners, (16, 16))
    np.testing.assert_allclose(offset[:, 9, 5], (-0.25, 0.25), atol=1e-6)
    assert np.isfinite(offset[0]).sum() == 2
    cells = targets.corner_height(corners, heights, (16, 16))
    assert cells[2, 1] == 4
    assert np.isfinite(cells).sum() == 1


def test_roof_height_is_the_mean_of_roof_pixels():
    height = np.full((8, 8), np.nan, np.float32)
    height[0, 0:2] = 3.0, 5.0
    cells = targets.roof_height(height)
    assert cells[0, 0] == 4
    assert np.isnan(cells).sum() == 3


def test_height_distribution_has_the_height_as_its_mean():
    edges, centres = targets.height_bins()
    assert len(edges) == len(centres) + 1
    height = np.array([3.3, 14.0, np.nan])
    soft = targets.height_distribution(height, edges, centres)
    np.testing.assert_allclose(soft.sum(1), (1, 1, 0), atol=1e-6)
    np.testing.assert_allclose((soft * centres).sum(1)[:2], height[:2], atol=0.15)
