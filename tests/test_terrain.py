"""Terrain: bilinear heights at the right place, from any window of the file."""

import numpy as np
import pytest
import rasters
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import terrain
from kibs_steps.terrain import Terrain


@pytest.fixture(scope="module")
def plane_file(tmp_path_factory):
    """z = 0.1·x − 0.2·y + 3 over 400 × 300 m from (1000, 2000) down, pixels of 2 × 2 m."""
    x, y = 1000 + (np.arange(200) + 0.5) * 2, 2000 - (np.arange(150) + 0.5) * 2
    heights = (0.1 * x[None] - 0.2 * y[:, None] + 3).astype("float32")
    return rasters.dtm(tmp_path_factory.mktemp("terrain") / "dtm.tif", heights, 1000.0, 2000.0)


def plane(x_y):
    return 0.1 * x_y[..., 0] - 0.2 * x_y[..., 1] + 3


class TestHeights:
    def test_pixel_centres_and_between(self):
        ground = Terrain(np.array([[1.0, 2.0], [3.0, 4.0]]), 10.0, 20.0, (2.0, 4.0))
        at = np.array([[10, 20], [12, 20], [10, 16], [12, 16], [11, 18], [10.5, 20]])
        assert ground(at).tolist() == [1, 2, 3, 4, 2.5, 1.25]

    def test_the_edge_holds_outside(self):
        ground = Terrain(np.array([[1.0, 2.0], [3.0, 4.0]]), 10.0, 20.0, (2.0, 2.0))
        assert ground(np.array([[-500, 900], [500, -900], [11, 900]])).tolist() == [1, 4, 1.5]

    def test_any_leading_shape(self):
        ground = Terrain(np.zeros((3, 3)), 0.0, 0.0, (1.0, 1.0))
        assert ground(np.zeros((0, 2))).shape == (0,)
        assert ground(np.zeros((4, 5, 2))).shape == (4, 5)

    def test_flat(self):
        assert np.allclose(terrain.flat(-3.25)(np.random.default_rng(0).normal(0, 1e6, (20, 2))), -3.25, atol=1e-12)


class TestRead:
    def test_a_plane_is_met_exactly(self, plane_file):
        ground = terrain.read(plane_file, (1100, 1800, 1200, 1900))
        points = np.random.default_rng(0).uniform((1050, 1750), (1250, 1950), (300, 2))
        assert np.allclose(ground(points), plane(points), atol=1e-3)

    @given(st.floats(1000, 1399), st.floats(1700, 1999), st.floats(0, 100), st.floats(0, 50))
    def test_every_window_gives_the_same_heights(self, plane_file, left, bottom, size, margin):
        whole = terrain.read(plane_file, (1000, 1700, 1400, 2000), 0.0)
        part = terrain.read(plane_file, (left, bottom, left + size, bottom + size), margin)
        points = np.random.default_rng(0).uniform((left, bottom), (left + size, bottom + size), (50, 2))
        assert np.allclose(part(points), whole(points), atol=1e-4)

    def test_beyond_the_file(self, plane_file):
        ground = terrain.read(plane_file, (5000, 5000, 5100, 5100), 10.0)
        assert np.isfinite(ground(np.array([[5050.0, 5050.0]]))).all()
