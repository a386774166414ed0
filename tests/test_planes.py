"""Corners to planes: closed-form roofs, the paper's rules, statuses, filing hazards."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import planes, view
from kibs_steps.grid import neighbours
from kibs_steps.planes import Points


def points(xyz, sigma=0.5, ground=0.0):
    x, y, z = np.asarray(xyz, float).T
    return Points(x, y, x, y, z, z - ground, np.full(len(x), sigma))


SLOPE = view.Plane(0.3, -0.4, 7.0, 0.0, 0.0)
SQUARE = np.array([[-5.0, -4.0], [5.0, -4.0], [5.0, 4.0], [-5.0, 4.0]])
MIDDLE = np.zeros(2)


def on_plane(xy):
    return points(np.column_stack([xy, SLOPE.at(xy)]))


@pytest.mark.parametrize("rule", ["robust", "paper"])
def test_three_corners_give_their_plane(rule):
    """Exact corners of two distinct heights: both rules return the plane (the paper's filing keeps two equal heights)."""
    level = view.Plane(0.0, 0.5, 6.0, 0.0, 0.0)
    xyz = np.column_stack([SQUARE, level.at(SQUARE)])
    found = planes.fit(points(xyz, 0.01), 80.0, MIDDLE, 0.0, (6.11, 3.0), rule)
    assert found.status == "ok"
    np.testing.assert_allclose(found.plane[:3], level[:3], atol=2e-4)


def test_the_height_map_gives_a_plane_without_corners():
    cells = planes.Cells(on_plane(SQUARE), 30.0, 2.0)
    none = points(np.zeros((0, 3)))
    sharp = cells._replace(points=cells.points._replace(sigma=np.full(4, 0.05)))
    found = planes.fit(none, 400.0, MIDDLE, 0.0, (6.11, 3.0), "robust", sharp)
    assert found.status == "ok"
    np.testing.assert_allclose(found.plane[:3], SLOPE[:3], atol=0.01)
    assert found.sigma >= planes.COMMON * 2.0  # cells err together
    assert planes.fit(none, 400.0, MIDDLE, 0.0, (6.11, 3.0), "paper", cells).status == "no_corners"
    assert planes.fit(none, 400.0, MIDDLE, 0.0, (6.11, 3.0), "robust", cells._replace(n=1.0)).status == "no_corners"


def test_one_wild_corner_is_outvoted():
    """Five corners on a plane and one 8 m too high: the robust plane stays within 0.2 m, plain least squares does not."""
    xy = np.vstack([SQUARE, [[0.0, 4.0], [0.0, -4.0]]])
    good = on_plane(xy)
    z = good.z.copy()
    z[2] += 8.0
    wild = good._replace(z=z, height=z)
    plane, _ = planes.robust_plane(wild, MIDDLE)
    assert np.abs(plane.at(xy) - SLOPE.at(xy)).max() < 0.2
    design = np.column_stack([xy, np.ones(6)])
    plain = design @ np.linalg.lstsq(design, z, rcond=None)[0]
    assert np.abs(plain - SLOPE.at(xy)).max() > 1.0


def test_a_slightly_warped_roof_keeps_all_its_corners():
    """Four exact corners, one 0.3 m off their plane: no corner is thrown away, the plane halves the warp on all of them."""
    z = SLOPE.at(SQUARE)
    z[2] += 0.3
    plane, _ = planes.robust_plane(points(np.column_stack([SQUARE, z]), 0.01), MIDDLE)
    assert np.abs(plane.at(SQUARE) - z).max() == pytest.approx(0.075, abs=0.01)


def test_sigma_matches_spread_of_repeated_fits():
    """The σ of the height at the middle is what repeated noisy fits scatter by."""
    rng = np.random.default_rng(1)
    xy = np.vstack([SQUARE, SQUARE / 2])
    heights, sigmas = [], []
    for _ in range(400):
        noisy = on_plane(xy)
        noisy = noisy._replace(z=noisy.z + rng.normal(0, 0.5, len(xy)))
        plane, sigma = planes.robust_plane(noisy, MIDDLE)
        heights.append(plane.at(MIDDLE))
        sigmas.append(sigma)
    assert np.mean(sigmas) == pytest.approx(np.std(heights), rel=0.3)


@pytest.mark.parametrize(("n", "status"), [(0, "no_corners"), (1, "one_corner"), (2, "two_corners")])
def test_few_corners_give_level_planes(n, status):
    """Paper: none gives the training mean, one its height, two their mean; above the ground at the section."""
    xyz = np.array([[1.0, 1.0, 104.0], [2.0, 3.0, 108.0]])[:n].reshape(-1, 3)
    found = planes.fit(points(xyz, ground=100.0), 50.0, MIDDLE, 100.0, (6.11, 3.0), "robust")
    assert found.status == status
    assert found.reason
    expected = {0: 106.11, 1: 104.0, 2: 106.0}[n]
    assert (found.plane.a, found.plane.b) == (0, 0)
    assert found.plane.c == pytest.approx(expected)


def test_paper_rule_levels_corners_that_stand_on_one_line():
    """A triangle where it is seen, a line where it stands."""
    seen = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]])
    x, z, same = np.array([0.0, 5.0, 10.0]), np.array([4.0, 6.0, 9.0]), np.full(3, 0.5)
    corners = planes.Points(seen[:, 0], seen[:, 1], x, np.zeros(3), z, z, same)
    found = planes.fit(corners, 400.0, np.zeros(2), 0.0, (6.11, 3.0), "paper")
    assert found.status == "degenerate_triangle"
    assert (found.plane.a, found.plane.b, found.plane.c) == (0.0, 0.0, 6.11)


def test_paper_rule_distrusts_thin_and_huge_triangles():
    xyz = np.array([[0, 0, 5.0], [10, 0, 5.0], [5, 0.2, 9.0]])
    for area in (50.0, 0.1):
        found = planes.fit(points(xyz), area, MIDDLE, 0.0, (6.11, 3.0), "paper")
        assert found.status == "degenerate_triangle"
        assert found.plane.c == pytest.approx(6.11)


def test_corners_in_a_row_leave_the_other_direction_level():
    """Three corners on one line fix the slope along it; the prior keeps the plane level across it."""
    xyz = np.array([[-5, 0, 4.0], [0, 0, 6.0], [5, 0, 8.0]])
    found = planes.fit(points(xyz, 0.05), 60.0, MIDDLE, 0.0, (6.11, 3.0), "robust")
    assert found.status == "degenerate_triangle"
    assert found.plane.a == pytest.approx(0.4, abs=0.01)
    assert found.plane.b == pytest.approx(0.0, abs=1e-6)


@given(st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=3, max_size=12, unique=True))
def test_largest_triangle_is_the_largest(xy):
    """Against all triples by brute force."""
    from itertools import combinations

    x, y = np.array(xy).T
    best = max(
        abs((x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])) / 2
        for a, b, c in combinations(range(len(x)), 3)
    )
    _, area = planes.largest_triangle(x, y)
    assert area == pytest.approx(best, rel=1e-6, abs=1e-6)


@given(st.lists(st.floats(0, 60), min_size=3, max_size=3))
def test_filing_of_heights(heights):
    """The paper's rule keeps the sum of the two merged heights and leaves exactly two values."""
    z = sorted(heights)
    filed = planes.filed_heights(*z)
    assert sum(filed) == pytest.approx(sum(z))
    if z[0] < z[1] < z[2]:
        assert len(set(filed)) <= 2
        assert filed[2] == z[2] if z[1] < (z[0] + z[2]) / 2 else filed[0] == z[0]
    else:
        assert list(filed) == z


def filed(outlines, corners, reach=7.5, shared=2.0):
    none = np.zeros(len(corners), int)
    section, corner = planes.file_corners(
        np.array(outlines), np.array(corners, float), none, np.zeros(len(outlines), int), reach, shared
    )
    return list(zip(section.tolist(), corner.tolist(), strict=True))


def test_corner_on_a_ridge_belongs_to_both_sections():
    boxes = [shapely.box(0, 0, 20, 10), shapely.box(0, 10, 20, 20)]
    assert filed(boxes, [(0.4, 10.3)]) == [(0, 0), (1, 0)]


def test_corner_over_a_neighbour_goes_to_the_nearest_rim():
    """Hazard: a corner whose square covers a second house, clearly nearer to the first."""
    boxes = [shapely.box(0, 0, 20, 10), shapely.box(0, 15, 20, 30)]
    assert filed(boxes, [(10, 11)]) == [(0, 0)]


def test_corner_too_far_off_is_filed_to_none():
    assert filed([shapely.box(0, 0, 20, 10)], [(40, 5)]) == []


def test_corner_inside_a_section_still_counts_from_its_rim():
    """Hazard: which pixel of the rim; a corner placed inside by two pixels is as good as one outside by two."""
    box = [shapely.box(0, 0, 30, 30)]
    assert filed(box, [(2, 2), (-1.4, -1.4), (15, 15)]) == [(0, 0), (0, 1)]


def test_owned_corners_go_to_their_owner_only():
    boxes = np.array([shapely.box(0, 0, 20, 10), shapely.box(0, 10, 20, 20)])
    section, corner = planes.file_corners(boxes, np.array([[0.0, 10.0]]), np.array([7]), np.array([3, 7]), 7.5, 2.0)
    assert (section.tolist(), corner.tolist()) == ([1], [0])


RIM = planes.Rim(np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]]), np.zeros(4), np.array([0.0, -0.594]))


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({}, "ok"),
        ({"edge": True}, "raster_edge"),
        ({"void": True}, "cloud_or_nodata"),
        ({"area_px": 4.0}, "too_small"),
        ({"ground": 30.0}, "implausible_height"),
    ],
)
def test_statuses(change, status):
    found = planes.fit(on_plane(SQUARE), 80.0, MIDDLE, 0.0, (6.11, 3.0), "robust")
    arguments = {"area_px": 400.0, "ground": 0.0, "middle": MIDDLE, "rim": RIM, "edge": False, "void": False, **change}
    result = planes.checked(found, on_plane(SQUARE).height, **arguments)
    assert result.status == status
    assert bool(result.reason) == (status != "ok")


@pytest.mark.parametrize(("height", "near"), [(-1086.0, 0.3), (0.2, 0.3), (900.0, planes.MAX_HEIGHT)])
def test_implausible_height_is_made_level_at_the_nearest_plausible_one(height, near):
    absurd = planes.Fit(view.Plane(0.5, 0.0, height, *MIDDLE), 0.1, "ok", "")
    result = planes.checked(absurd, on_plane(SQUARE).height, 400.0, 0.0, MIDDLE, RIM, False, False)
    assert result.status == "implausible_height"
    assert (result.plane.a, result.plane.b) == (0, 0)
    assert result.plane.at(MIDDLE) == pytest.approx(near)


# The satellite stands in the south: a roof that rises toward it by more than tan 59.3° shows its back.
@pytest.mark.parametrize(("a", "b", "why"), [(6.0, 0.0, "exceeds"), (0.0, -1.75, "away"), (0.0, -1.6, "edge-on")])
def test_implausible_slope_is_made_level(a, b, why):
    steep = view.Plane(a, b, 10.0, *MIDDLE)
    found = planes.Fit(steep, 0.1, "ok", "")
    result = planes.checked(found, on_plane(SQUARE).height, 400.0, 0.0, MIDDLE, RIM, False, False)
    assert result.status == "implausible_slope"
    assert why in result.reason
    assert (result.plane.a, result.plane.b) == (0, 0)


def test_plane_that_dives_into_the_ground_is_made_level():
    """As steep as a roof may be, but over a section as long as no roof is steep."""
    long = planes.Rim(RIM.seen * [1.0, 20.0], RIM.base, RIM.lean)
    found = planes.Fit(view.Plane(0.0, -1.2, 8.0, *MIDDLE), 0.1, "ok", "")
    result = planes.checked(found, on_plane(SQUARE).height, 400.0, 0.0, MIDDLE, long, False, False)
    assert result.status == "implausible_height"
    assert (result.plane.a, result.plane.b) == (0, 0)
    assert planes.checked(found, on_plane(SQUARE).height, 400.0, 0.0, MIDDLE, RIM, False, False).status == "ok"


def test_a_corner_on_a_neighbours_rim_is_the_neighbours_even_where_that_is_not_asked_about():
    mine, other = shapely.box(60, 30, 94, 60), shapely.box(97, 30, 130, 60)
    corners, free = np.array([[97.0, 30.0], [97.0, 60.0]]), np.zeros(2, int)
    together = planes.file_corners(np.array([mine, other]), corners, free, np.zeros(2, int), 6.0, 2.0)
    assert together[0].tolist() == [1, 1]
    alone = planes.file_corners(np.array([mine]), corners, free, np.zeros(1, int), 6.0, 2.0, [other])
    assert len(alone[0]) == 0
    assert neighbours("r000c001") == ["r000c000", "r000c002", "r001c000", "r001c001", "r001c002"]


def test_sigma_of_a_level_plane_is_that_of_the_mean():
    xyz = np.array([[1.0, 1.0, 104.0], [2.0, 3.0, 108.0]])
    two = planes.fit(points(xyz, 0.5, 100.0), 50.0, MIDDLE, 100.0, (6.11, 3.0), "robust")
    assert two.sigma == pytest.approx(0.5 / np.sqrt(2))
    one = planes.fit(points(xyz[:1], 0.02, 100.0), 50.0, MIDDLE, 100.0, (6.11, 3.0), "robust")
    assert one.sigma == pytest.approx(planes.SIGMA_FLOOR)


@pytest.mark.parametrize(("angle", "status"), [(71.0, "ok"), (73.0, "implausible_slope")])
def test_roofs_are_at_most_72_degrees_steep(angle, status):
    steep = planes.Fit(view.Plane(np.tan(np.radians(angle)), 0.0, 10.0, 4.0, 3.0), 0.1, "ok", "")
    middle = np.array([4.0, 3.0])
    rim = planes.Rim(RIM.seen * [0.1, 1.0] + [3.6, 0.0], RIM.base, np.zeros(2))
    assert planes.checked(steep, np.array([10.0]), 400.0, 0.0, middle, rim, False, False).status == status


def test_a_plane_that_climbs_beyond_any_building_is_made_level():
    """100 m high in its middle, 250 m at its end."""
    long = planes.Rim(np.array([[-150.0, 0.0], [150.0, 0.0], [150.0, 6.0], [-150.0, 6.0]]), np.zeros(4), np.zeros(2))
    found = planes.Fit(view.Plane(0.7, 0.0, 100.0, *MIDDLE), 0.1, "ok", "")
    result = planes.checked(found, np.array([90.0]), 400.0, 0.0, MIDDLE, long, False, False)
    assert (result.status, result.plane.a, result.plane.c) == ("implausible_height", 0, 90.0)
    assert "205 m" in result.reason


def test_of_several_statuses_the_outermost_cause_is_told():
    found = planes.fit(on_plane(SQUARE), 80.0, MIDDLE, 0.0, (6.11, 3.0), "robust")

    def told(area, edge, void):
        return planes.checked(found, on_plane(SQUARE).height, area, 0.0, MIDDLE, RIM, edge, void).status

    assert told(4.0, False, True) == "cloud_or_nodata"
    assert told(4.0, True, True) == told(400.0, True, True) == "raster_edge"


def test_few_cells_and_good_corners_are_a_plane_that_can_be_trusted():
    """One cell of the height map tells no slope; corners that span the section do."""
    cells = planes.Cells(on_plane(SQUARE), 1.0, 0.2)
    assert planes.fit(on_plane(SQUARE), 80.0, MIDDLE, 0.0, (6.11, 3.0), "robust", cells).status == "ok"
    assert planes.fit(on_plane(SQUARE[:2]), 80.0, MIDDLE, 0.0, (6.11, 3.0), "robust", cells).status == "two_corners"
