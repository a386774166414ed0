"""The z-buffer against closed forms: displacement, coverage, first hit."""

import numpy as np
import pytest

from kibs_steps.grid import Grid
from kibs_steps.view import lean
from kibs_steps.zbuffer import Polygon, heights_on, pixel_counts, planes, render_faces

FRAME = Grid("", 0.0, 50.0, 0.1, 500, 500)


def square(x0, y0, x1, y1, z):
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], float)


def centroid(mask):
    rows, cols = np.nonzero(mask)
    return FRAME.to_map(np.array([cols.mean() + 0.5, rows.mean() + 0.5]))


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 60), (90, 45), (181.1, 59.3), (300, 75)])
def test_flat_roof_is_displaced_by_h_cot_elevation(azimuth, elevation):
    k = lean(azimuth, elevation)
    # Turned, so that the pixels' edges average out.
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    ring = square(-5, -5, 5, 5, 8.0)
    ring[:, :2] = ring[:, :2] @ turn + 25
    hits = render_faces([Polygon(ring)], k, FRAME)
    assert pixel_counts([Polygon(ring)], k, FRAME)[0] == (hits.face == 0).sum()
    assert np.allclose(centroid(hits.face == 0), np.array([25, 25]) - 8.0 * np.array(k), atol=0.02)
    assert np.allclose(hits.height[hits.face == 0], 8.0)
    assert abs((hits.face == 0).sum() * 0.01 - 100.0) < 0.6


def test_shared_edges_leave_no_gap_and_no_overlap():
    rng = np.random.default_rng(0)
    centre = np.array([25.0, 25.0, 5.0])
    angle = np.sort(rng.uniform(0, 2 * np.pi, 9))
    rim = np.column_stack([25 + 15 * np.cos(angle), 25 + 15 * np.sin(angle), np.full(9, 5.0)])
    fan = [Polygon(np.array([centre, rim[i], rim[(i + 1) % 9]])) for i in range(9)]
    alone = sum((render_faces([f], (0.3, 0.2), FRAME).face == 0).astype(int) for f in fan)
    whole = render_faces([Polygon(rim)], (0.3, 0.2), FRAME).face == 0
    assert alone.max() == 1
    assert np.array_equal(alone == 1, whole)


def test_faces_traced_from_pixels_leave_no_gap_and_no_overlap():
    """An edge whose cut falls on a pixel's centre is cut alike from both its sides, whichever way their rings run."""
    rng = np.random.default_rng(0)
    frame = Grid("EPSG:32631", 500_000.0, 5_400_000.0, 0.38, 40, 40)
    rim = np.array([(0, 0), (40, 0), (40, 40), (0, 40)], float)
    for _ in range(200):
        centre = rng.integers(2, 38, 2).astype(float)
        covered = np.zeros((40, 40), int)
        for k in range(4):
            ring = frame.to_map(np.array([centre, rim[k], rim[(k + 1) % 4]]))[:: rng.choice([-1, 1])]
            covered += render_faces([Polygon(np.column_stack([ring, np.full(3, 5.0)]))], (0.0, 0.0), frame).face >= 0
        assert (covered == 1).all()


def test_holes_are_not_covered():
    face = Polygon(square(10, 10, 40, 40, 3.0), (square(20, 20, 30, 30, 3.0)[::-1],))
    hits = render_faces([face], (0.0, 0.0), FRAME)
    assert abs((hits.face == 0).sum() * 0.01 - 800.0) < 0.5
    assert hits.face[250, 250] == -1


def test_tall_wall_hides_the_roof_behind_it():
    k = lean(180, 45)  # satellite in the south: things lean north
    low = Polygon(square(20, 26, 30, 30, 3.0))
    wall = Polygon(np.array([[20, 20, 0], [30, 20, 0], [30, 20, 15], [20, 20, 15]], float))
    hits = render_faces([low, wall], k, FRAME)
    assert not (hits.face == 0).any()
    assert (hits.face == 1).any()
    away = render_faces([low, wall], lean(0, 45), FRAME)
    assert abs((away.face == 0).sum() * 0.01 - 40.0) < 0.5


def test_nadir_shows_no_walls():
    wall = Polygon(np.array([[20, 20, 0], [30, 20, 0], [30, 20, 15], [20, 20, 15]], float))
    assert (render_faces([wall], (0.0, 0.0), FRAME).face == -1).all()


def test_heights_on_a_slope_are_where_the_ray_meets_the_plane():
    k = lean(140, 60)
    ring = np.array([[15, 15, 4], [35, 15, 4], [35, 30, 12], [15, 30, 12]], float)
    hits = render_faces([Polygon(ring)], k, FRAME, base=1.0)
    rows, cols = np.nonzero(hits.face == 0)
    seen = FRAME.to_map(np.stack([cols + 0.5, rows + 0.5], -1))
    z = hits.height[rows, cols]
    stands = seen + (z - 1.0)[:, None] * np.array(k)
    assert np.allclose(z, 4 + (stands[:, 1] - 15) * 8 / 15, atol=1e-6)
    again = heights_on(planes([Polygon(ring)]), np.zeros(len(z), int), seen, k, 1.0)
    assert np.allclose(again, z)


def test_no_faces_show_nothing():
    hits = render_faces([], (0.1, 0.1), FRAME)
    assert (hits.face == -1).all()
    assert np.isneginf(hits.height).all()
