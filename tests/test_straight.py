"""Straight rims: ragged faces become straight ones that still tile; exact ones are left alone."""

import numpy as np
import pytest
import shapely
from rasterio import features

from kibs_steps import straight
from kibs_steps.faces import MM, Face, is_coverage, polygon

GSD = 0.38


def staircase(length, step, rise):
    """Points (mm) of a staircase along x that climbs `rise` every `step`."""
    points = []
    for k, x in enumerate(range(0, length, step)):
        points += [(x, k * rise), (min(x + step, length), k * rise)]
    return list(dict.fromkeys(points))


def two_ragged_faces():
    """Two rectangles of 12 × 6 m, turned by 5.4°, whose rims climb one pixel of 0.38 m every 4 m."""
    low = staircase(12000, 4000, 380)
    middle = [(x - 600, y + 6000) for x, y in low]
    top = [(x - 1200, y + 12000) for x, y in low]
    return [Face(0, [low + middle[::-1]]), Face(1, [middle + top[::-1]])]


def test_staircases_become_straight_edges():
    faces = straight.ragged(two_ragged_faces())
    assert is_coverage(faces)
    assert [f.section for f in faces] == [0, 1]
    assert [len(f.rings[0]) for f in faces] == [4, 4]
    for ragged, face in zip(two_ragged_faces(), faces, strict=True):
        assert polygon(face).area == pytest.approx(polygon(ragged).area, rel=0.03)
        corners = np.array(face.rings[0], float)
        edges = np.roll(corners, -1, axis=0) - corners
        turns = np.degrees(np.arctan2(edges[:, 1], edges[:, 0])) % 90
        assert np.ptp((turns + 45) % 90) < 1.0


def test_shared_edges_stay_shared():
    first, second = straight.ragged(two_ragged_faces())
    assert len(set(first.rings[0]) & set(second.rings[0])) == 2
    union = shapely.union_all([polygon(first), polygon(second)])
    assert union.geom_type == "Polygon"
    assert not union.interiors


def test_a_courtyard_and_what_fills_a_hole_survive():
    outer = [(0, 0), (20000, 0), (20000, 20000), (0, 20000)]
    hole = [(6000, 6000), (6000, 12000), (12000, 12000), (12000, 6000)]
    yard = [(14000, 14000), (14000, 18000), (18000, 18000), (18000, 14000)]
    faces = straight.ragged([Face(0, [outer, hole, yard]), Face(1, [hole[::-1]])])
    assert is_coverage(faces)
    assert [len(f.rings) for f in faces] == [3, 1]
    assert sum(polygon(f).area for f in faces) == pytest.approx(400 - 16)


def house(rng):
    """A rectangle, or an L, of 5 to 20 m at any angle: polygon (m)."""
    length, width = rng.uniform(5, 20), rng.uniform(4, 12)
    whole = shapely.box(0, 0, length, width)
    yard = shapely.box(length * rng.uniform(0.4, 0.7), width * rng.uniform(0.4, 0.6), length + 1, width + 1)
    shape = whole if rng.random() < 0.5 else whole - yard
    turned = shapely.affinity.rotate(shape, rng.uniform(0, 90), origin="centroid")
    return shapely.affinity.translate(turned, *rng.uniform(10, 12, 2))


def as_pixels(shape):
    """The face of the pixels (of `GSD`) whose middles lie in a polygon (m)."""
    pixels = features.rasterize(
        [(shapely.affinity.scale(shape, 1 / GSD, 1 / GSD, origin=(0, 0)), 1)], (90, 90), dtype="uint8"
    )
    ((traced, _),) = features.shapes(pixels, mask=pixels == 1)
    ring = shapely.orient_polygons(shapely.geometry.shape(traced)).exterior.coords[:-1]
    return Face(0, [[(round(x * GSD * MM), round(y * GSD * MM)) for x, y in ring]])


def test_houses_traced_at_any_angle_get_their_own_corners_and_no_more():
    """Short edges that cut a corner off, left by steps of pixels, are not taken for edges of the house."""
    right, overlap = [], []
    for seed in range(60):
        shape = house(np.random.default_rng(seed))
        (face,) = straight.ragged([as_pixels(shape)], 1.3 * GSD)
        right.append(len(face.rings[0]) == len(shape.exterior.coords) - 1)
        overlap.append(polygon(face).intersection(shape).area / polygon(face).union(shape).area)
    assert np.mean(right) > 0.9
    assert np.mean(overlap) > 0.97


def test_a_corner_cut_off_by_more_than_the_rim_may_move_stays_cut():
    cut = [(0, 0), (12000, 0), (12000, 6000), (10000, 8000), (0, 8000)]
    (face,) = straight.ragged([Face(0, [cut])], 0.5)
    assert shapely.equals_exact(
        shapely.normalize(polygon(face)), shapely.normalize(shapely.Polygon(np.array(cut) / MM)), 0.05
    )


def test_tidied_leaves_exact_faces_alone():
    faces = [
        Face(0, [[(0, 0), (10000, 0), (10000, 4000), (0, 4000)]]),
        Face(1, [[(0, 4000), (10000, 4000), (10000, 8100), (9800, 8300), (0, 8000)]]),
    ]
    assert straight.tidied(faces) == faces


def test_tidied_removes_what_is_too_small_for_the_grid():
    sliver = [
        Face(0, [[(0, 0), (10000, 0), (10000, 4000), (5000, 4000), (4996, 4000), (0, 4000)]]),
        Face(1, [[(0, 4000), (4996, 4000), (5000, 4000), (5000, 9000), (0, 9000)]]),
    ]
    faces = straight.tidied(sliver)
    assert is_coverage(faces)
    assert all(
        np.hypot(*np.subtract(a, b)) >= 10
        for f in faces
        for r in f.rings
        for a, b in zip(r, r[1:] + r[:1], strict=True)
    )


def test_a_vertex_beside_an_edge_becomes_part_of_it():
    # The second face touches the first with a corner that the first does not have, 8 mm beside its edge.
    faces = straight.tidied(
        [
            Face(0, [[(0, 0), (10000, 0), (10000, 4000), (0, 4000)]]),
            Face(1, [[(10000, 4000), (10000, 8000), (5000, 4008)]]),
        ]
    )
    assert (5000, 4008) in faces[0].rings[0]
    assert is_coverage(faces)
