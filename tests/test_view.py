"""View: closed forms of the paper's geometry, and ways there and back that must agree."""

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import terrain, view
from kibs_steps.view import Plane

ANGLES = st.tuples(st.floats(0, 360), st.floats(45, 89.9))


def sloped(x_y):
    """A hill: slopes to 0.25, no plane."""
    x_y = np.asarray(x_y, float)
    return 80 + 0.12 * x_y[..., 0] - 0.07 * x_y[..., 1] + 1.5 * np.sin(x_y[..., 0] / 25) * np.cos(x_y[..., 1] / 30)


def points(seed=0, n=200):
    random = np.random.default_rng(seed)
    return random.uniform(-200, 200, (n, 2)), random.uniform(0, 30, n)


def test_a_point_settles_whatever_points_are_beside_it():
    """The bytes of a block must not depend on what else lies in it."""
    image, height = points(n=600)
    k = view.lean(140.0, 50.0)
    place, z = view.ground_position(image, height, sloped, k)
    seen = view.image_position(place, z, k, sloped)
    for some in np.array_split(np.arange(600), 40):
        own, own_z = view.ground_position(image[some], height[some], sloped, k)
        assert (own == place[some]).all()
        assert (own_z == z[some]).all()
        assert (view.image_position(place[some], z[some], k, sloped) == seen[some]).all()


@pytest.mark.parametrize("steepness", [0.9, 1.5, 4.0])
def test_a_point_over_a_quay_finds_its_place(steepness):
    """The ground falls towards the satellite more steeply than the view: there is one place all the same."""

    def quay(x_y):
        return 10.0 - np.clip(steepness * (np.asarray(x_y, float)[..., 1] + 3.0), 0.0, 8.0)

    image = np.column_stack([np.zeros(81), np.linspace(-20, 20, 81)])
    k = np.array(view.lean(0.0, 45.0))
    place, z = view.ground_position(image, np.full(81, 6.0), quay, k)
    assert place == pytest.approx(image + (z - quay(image))[:, None] * k, abs=1e-4)
    assert z == pytest.approx(quay(place) + 6.0)


class TestLean:
    @pytest.mark.parametrize(
        ("azimuth", "elevation", "length"),
        [(181.10, 59.30, 0.594), (172.9, 66.6, 0.433)],
        ids=["Mourmelon", "Sissonne"],
    )
    def test_the_papers_scenes(self, azimuth, elevation, length):
        k = view.lean(azimuth, elevation)
        assert np.hypot(*k) == pytest.approx(length, abs=5e-4)
        assert np.degrees(np.arctan2(*k)) % 360 == pytest.approx(azimuth)

    def test_mourmelons_mean_roof_stands_ten_pixels_off(self):
        """6.36 m high: seen 3.8 m = 10 px of 0.38 m north of where it stands (the satellite is in the south)."""
        ground = np.zeros((1, 2))
        shown = view.image_position(ground, np.array([6.36]), view.lean(181.10, 59.30), terrain.flat(0.0))
        assert shown[0, 1] == pytest.approx(3.78, abs=0.01)
        assert shown[0, 1] / 0.38 == pytest.approx(10, abs=0.1)

    @pytest.mark.parametrize(("azimuth", "expected"), [(0, (0, 1)), (90, (1, 0)), (180, (0, -1)), (270, (-1, 0))])
    def test_axes_at_45_degrees(self, azimuth, expected):
        assert view.lean(azimuth, 45.0) == pytest.approx(expected, abs=1e-12)

    @pytest.mark.parametrize(("x", "y"), [(250_000, 5_750_000), (500_000, 5_750_000), (760_000, 5_200_000)])
    def test_convergence_turns_true_into_grid_axes(self, x, y):
        """A true-north displacement, projected, lies along the lean of azimuth 0."""
        crs = pyproj.CRS.from_epsg(32631)
        to_map = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
        longitude, latitude = to_map.transform(x, y, direction="INVERSE")
        east, north = to_map.transform([longitude] * 2, [latitude, latitude + 1e-4])
        convergence = pyproj.Proj(crs).get_factors(longitude, latitude).meridian_convergence
        expected = np.degrees(np.arctan2(east[1] - east[0], north[1] - north[0]))
        assert np.degrees(np.arctan2(*view.lean(0.0, 60.0, convergence))) == pytest.approx(expected, abs=1e-4)


class TestPositions:
    @given(ANGLES, st.floats(-50, 500))
    def test_flat_ground_is_a_shift(self, angles, level):
        k = view.lean(*angles)
        image, height = points()
        ground, z = view.ground_position(image, height, terrain.flat(level), k)
        assert np.allclose(ground, image + height[:, None] * k, atol=1e-6)
        assert np.allclose(z, level + height)

    @given(ANGLES)
    def test_there_and_back_on_sloped_ground(self, angles):
        k = view.lean(*angles)
        image, height = points()
        ground, z = view.ground_position(image, height, sloped, k)
        assert np.allclose(z, sloped(ground) + height)
        assert np.allclose(view.image_position(ground, z, k, sloped), image, atol=1e-4)

    @given(ANGLES, st.floats(0, 200))
    def test_there_and_back_when_projected_on_one_height(self, angles, z0):
        k = view.lean(*angles)
        image, height = points()
        ground, z = view.ground_position(image, height, sloped, k, terrain.flat(z0))
        assert np.allclose(ground, image + (z - z0)[:, None] * k, atol=1e-4)
        assert np.allclose(view.image_position(ground, z, k, terrain.flat(z0)), image, atol=1e-6)

    def test_points_on_the_ground_stay_in_a_terrain_corrected_image(self):
        image, _ = points()
        ground, _ = view.ground_position(image, np.zeros(len(image)), sloped, view.lean(181.1, 59.3))
        assert np.allclose(ground, image, atol=1e-5)

    def test_one_slope_by_hand(self):
        """Ground z = 0.2·x, k = (0.5, 0): x = x_img + 0.5·(h + 0.2·(x − x_img)), so x − x_img = 0.5·h / 0.9."""
        ground, z = view.ground_position(
            np.array([[10.0, 3.0]]), np.array([9.0]), lambda p: 0.2 * np.asarray(p)[..., 0], (0.5, 0.0)
        )
        assert ground == pytest.approx(np.array([[15.0, 3.0]]), abs=1e-5)
        assert z == pytest.approx([12.0], abs=1e-5)

    def test_nothing_moves_at_nadir_and_nothing_is_fine(self):
        image, height = points()
        ground, _ = view.ground_position(image, height, sloped, (0.0, 0.0))
        assert (ground == image).all()
        empty, z = view.ground_position(np.zeros((0, 2)), np.zeros(0), sloped, (0.3, 0.2))
        assert (empty.shape, z.shape) == ((0, 2), (0,))


class TestPlanes:
    @given(ANGLES, st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))
    def test_rays_agree_with_both_positions(self, angles, a, b):
        """The point found on the roof plane is shown at that pixel, and its height leads back to it."""
        k = view.lean(*angles)
        if abs(a * k[0] + b * k[1]) > 0.9:
            return
        image, _ = points()
        roof = Plane(a, b, 120.0, 5.0, -7.0)
        for surface in (sloped, terrain.flat(90.0)):
            ground, z = view.ray_meets_plane(image, roof, k, surface)
            assert np.allclose(z, roof.at(ground), atol=1e-6)
            assert np.allclose(view.image_position(ground, z, k, surface), image, atol=1e-4)
            again, _ = view.ground_position(image, z - sloped(ground), sloped, k, surface)
            assert np.allclose(again, ground, atol=1e-3)

    @pytest.mark.parametrize(("azimuth", "seen"), [(0.0, 29), (180.0, 59)], ids=["towards", "away"])
    def test_an_image_shears_roofs(self, azimuth, seen):
        """A 40° roof at 59.3° looks 29° steep where it faces the satellite and 59° where it faces away (DESIGN)."""
        k = view.lean(azimuth, 59.3)
        roof = Plane(0.0, -np.tan(np.radians(40.0)), 10.0, 0.0, 0.0)
        ground = np.array([[0.0, 0.0], [0.0, -1.0]])
        z = roof.at(ground)
        image = view.image_position(ground, z, k, terrain.flat(0.0))
        apparent = np.degrees(np.arctan(abs((z[1] - z[0]) / (image[1, 1] - image[0, 1]))))
        assert apparent == pytest.approx(seen, abs=0.6)

    def test_at(self):
        assert Plane(1.0, -2.0, 3.0, 10.0, 20.0).at(np.array([[10.0, 20.0], [11.0, 21.0]])).tolist() == [3.0, 2.0]
