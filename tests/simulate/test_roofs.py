"""Roofs are exact: sections partition the plan, meet in shared corners, and have the slopes asked for."""

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon
from shapely.ops import unary_union

from kibs_steps.simulate.roofs import KINDS, Wing, dome, dormer, frame_of, rectangle, sections, walls, wing


def plan(ring):
    return Polygon(ring[:, :2])


PLANS = {
    "L": [wing("hip", -8, -4, 8, 4, 5, 0.7), wing("hip", -8, -14, 0, 4, 5, 0.7, False)],
    "T": [wing("gable", -8, -4, 8, 4, 5, 0.7), wing("one_hip", -2, -11, 3, 0, 5, 0.7, False)],
    "U": [
        wing("hip", -9, -4, 9, 4, 6, 0.5),
        wing("gable", -9, -10, -4, 0, 6, 0.5, False),
        wing("gable", 3, -10, 9, 0, 5, 0.5, False),
    ],
    "cross": [wing("gable", -8, -3, 8, 3, 5, 0.9), wing("gable", -2, -9, 3, 8, 5, 0.9, False)],
}


@pytest.mark.parametrize("name", PLANS)
def test_sections_partition_the_footprint(name):
    wings = PLANS[name]
    rings = sections(wings)
    footprint = unary_union([Polygon(w.footprint) for w in wings])
    shapes = [plan(r) for r in rings]
    assert all(s.is_valid and s.exterior.is_ccw for s in shapes)
    assert sum(s.area for s in shapes) == pytest.approx(footprint.area, abs=1e-6)
    assert unary_union(shapes).symmetric_difference(footprint).area < 1e-6
    tree = shapely.STRtree(shapes)
    for i, j in tree.query(shapes, predicate="overlaps").T:
        assert shapes[i].intersection(shapes[j]).area < 1e-6


@pytest.mark.parametrize("name", PLANS)
def test_the_highest_wing_shows(name):
    wings = PLANS[name]
    rng = np.random.default_rng(1)
    for ring in sections(wings):
        normal = np.cross(ring[1] - ring[0], ring[2] - ring[0])
        x0, y0, x1, y1 = plan(ring).bounds
        for x, y in rng.uniform([x0, y0], [x1, y1], (40, 2)):
            if not plan(ring).contains(shapely.Point(x, y)):
                continue
            z = ring[0, 2] - (normal[0] * (x - ring[0, 0]) + normal[1] * (y - ring[0, 1])) / normal[2]
            truth = max(
                min(a * x + b * y + c for a, b, c in w.planes)
                for w in wings
                if Polygon(w.footprint).buffer(1e-9).contains(shapely.Point(x, y))
            )
            assert z == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("gable", 2),
        ("hip", 4),
        ("half_hip", 4),
        ("pyramid", 4),
        ("shed", 1),
        ("flat", 1),
        ("mansard", 5),
        ("gambrel", 4),
    ],
)
def test_kinds_have_their_sections(kind, count):
    rings = sections([wing(kind, -6, -4, 6, 4, 5, 0.7)])
    assert len(rings) == count
    assert sum(plan(r).area for r in rings) == pytest.approx(96)
    assert min(r[:, 2].min() for r in rings) == pytest.approx(5)


def test_ridge_of_a_gable_is_shared_and_as_high_as_the_pitch():
    a, b = sections([wing("gable", -6, -4, 6, 4, 5, 0.7)])
    shared = {tuple(p) for p in a.round(9).tolist()} & {tuple(p) for p in b.round(9).tolist()}
    assert shared == {(-6.0, 0.0, 7.8), (6.0, 0.0, 7.8)}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("along_x", [True, False])
def test_walls_close_the_building_under_the_eaves(kind, along_x):
    rings = sections([wing(kind, -6, -4, 6, 4, 5, 0.5, along_x)])
    quads = walls(rings)
    length = sum(np.hypot(*(q[1] - q[0])[:2]) for q in quads)
    assert length == pytest.approx(40)
    for q in quads:
        out = np.cross(q[1] - q[0], q[3] - q[0])
        assert out[:2] @ q[:, :2].mean(0) > 0  # normals point away from the middle
    set_back = walls(rings, 0.5)
    assert sum(np.hypot(*(q[1] - q[0])[:2]) for q in set_back) == pytest.approx(36)


def test_wings_of_one_height_are_one_section():
    rings = sections([wing("flat", 0, 0, 10, 5, 4, 0), wing("flat", 0, 5, 5, 10, 4, 0)])
    assert len(rings) == 1
    assert len(rings[0]) == 6


def test_dormer_stands_on_its_slope_or_is_refused():
    axes = frame_of(sections([wing("gable", -6, -4, 6, 4, 5, 0.9)])[0])
    roof, sides = dormer(axes, 6, 1, 2, 1.2, False)
    assert len(roof) == 1
    assert len(sides) == 3
    assert roof[0][:, 2].min() > 5.9
    assert dormer(axes, 0.5, 1, 2, 1.2, False) is None


def test_a_wing_may_be_any_convex_plan():
    w = Wing([(0, 0), (10, 1), (9, 7), (1, 6)], ((0.0, 0.5, 3.0), (0.0, -0.5, 6.0)))
    assert sum(plan(r).area for r in sections([w])) == pytest.approx(Polygon(w.footprint).area)
    assert rectangle(0, 0, 2, 1) == [(0, 0), (2, 0), (2, 1), (0, 1)]


@pytest.mark.parametrize(("rise", "rings"), [(1.5, 1), (1.5, 4), (5.0, 6)])
def test_a_dome_is_a_cap_of_a_sphere(rise, rings):
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.column_stack([3 + 6 * np.cos(angle), 6 * np.sin(angle) - 1, np.full(24, 8.0)])
    lids = dome(rim, rise, rings)
    shapes = [plan(r) for r in lids]
    assert all(s.is_valid and s.exterior.is_ccw for s in shapes)
    assert sum(s.area for s in shapes) == pytest.approx(plan(rim).area)
    assert unary_union(shapes).symmetric_difference(plan(rim)).area < 1e-6
    points = np.concatenate(lids)
    radius = (6**2 + rise**2) / (2 * rise)
    middle = [3, -1, 8 + rise - radius]
    assert np.linalg.norm(points - middle, axis=1) == pytest.approx(np.full(len(points), radius))
    assert points[:, 2].max() == pytest.approx(8 + rise)
    for ring in lids:  # renderers draw planes
        normal = np.cross(ring[1] - ring[0], ring[2] - ring[0])
        assert np.abs((ring - ring[0]) @ normal).max() < 1e-9 * max(1, np.abs(normal).max())
