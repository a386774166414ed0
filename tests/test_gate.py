"""The gate: accepts solids, refuses everything that is none."""

import numpy as np
import pytest

from kibs_steps import gate

GABLE = {
    "south": [[(0, 0, 3000), (10000, 0, 3000), (10000, 4000, 6000), (0, 4000, 6000)]],
    "north": [[(0, 4000, 6000), (10000, 4000, 6000), (10000, 8000, 3000), (0, 8000, 3000)]],
    "front": [[(0, 0, 0), (10000, 0, 0), (10000, 0, 3000), (0, 0, 3000)]],
    "back": [[(10000, 8000, 0), (0, 8000, 0), (0, 8000, 3000), (10000, 8000, 3000)]],
    "east": [[(10000, 0, 0), (10000, 8000, 0), (10000, 8000, 3000), (10000, 4000, 6000), (10000, 0, 3000)]],
    "west": [[(0, 8000, 0), (0, 0, 0), (0, 0, 3000), (0, 4000, 6000), (0, 8000, 3000)]],
    "ground": [[(0, 8000, 0), (10000, 8000, 0), (10000, 0, 0), (0, 0, 0)]],
}


def gable(**changes: list | None) -> list:
    """The faces of a gable house, some replaced (or left out: None)."""
    return [face for face in {**GABLE, **changes}.values() if face is not None]


def box(x0: int, y0: int, x1: int, y1: int, z0: int, z1: int) -> list:
    """The faces of a box."""
    low = [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)]
    high = [(x, y, z1) for x, y, _ in low]
    walls = [[[low[k - 1], low[k], high[k], high[k - 1]]] for k in range(4)]
    return [[high], [low[::-1]], *walls]


def kinds(faces: list) -> set[str]:
    return {problem.kind for problem in gate.check(faces)}


def test_a_gable_house_is_a_solid_of_known_volume():
    assert gate.check(gable()) == []
    assert gate.volume(gable()) == pytest.approx(10 * 8 * 3e9 + 10 * 8 * 3e9 / 2)


def test_a_missing_wall_is_refused():
    assert kinds(gable(front=None)) == {"open"}


def test_a_bent_roof_is_refused():
    bent = [(10000, 0, 3100) if p == (10000, 0, 3000) else p for p in GABLE["south"][0]]
    east = [(10000, 0, 3100) if p == (10000, 0, 3000) else p for p in GABLE["east"][0]]
    front = [(10000, 0, 3100) if p == (10000, 0, 3000) else p for p in GABLE["front"][0]]
    assert "not_planar" in kinds(gable(south=[bent], east=[east], front=[front]))


def test_five_millimetres_off_the_plane_are_allowed_and_no_more():
    for lift, refused in ((8, False), (40, True)):
        moved = {(10000, 0, 3000): (10000, 0, 3000 + lift)}
        changed = {
            name: [[moved.get(p, p) for p in ring] for ring in GABLE[name]] for name in ("south", "east", "front")
        }
        assert (kinds(gable(**changed)) == {"not_planar"}) == refused


def test_a_flipped_roof_is_refused():
    assert "edge" in kinds(gable(south=[GABLE["south"][0][::-1]]))


def test_a_solid_turned_inside_out_is_refused():
    assert kinds([[ring[::-1] for ring in face] for face in gable()]) == {"inside_out"}


def test_a_point_visited_twice_or_too_near_is_refused():
    front = GABLE["front"][0]
    assert kinds(gable(front=[[*front, front[1]]])) == {"ring"}
    assert kinds(gable(front=[[*front[:2], (10000, 0, 3), *front[2:]]])) == {"near"}


def test_a_vertex_in_the_middle_of_a_neighbours_edge_is_refused():
    front = GABLE["front"][0]
    assert "open" in kinds(gable(front=[[*front[:1], (5000, 0, 0), *front[1:]]]))


def test_a_wall_that_crosses_itself_is_refused():
    a, b, c, d, e = GABLE["east"][0]
    assert "ring" in kinds(gable(east=[[a, b, d, c, e]]))


def test_two_boxes_are_not_one_shell():
    apart = box(0, 0, 1000, 1000, 0, 1000) + box(2000, 0, 3000, 1000, 0, 1000)
    assert kinds(apart) == {"pieces"}


def test_two_boxes_on_one_vertical_edge_are_refused():
    assert "edge" in kinds(box(0, 0, 1000, 1000, 0, 1000) + box(1000, 1000, 2000, 2000, 0, 1000))


def test_two_boxes_at_one_vertex_are_refused():
    corner = box(0, 0, 1000, 1000, 0, 1000) + box(1000, 1000, 2000, 2000, 1000, 2000)
    assert kinds(corner) == {"vertex"}


def courtyard(inner: int = 2000, hole_reversed: bool = False) -> list:
    """A block of 6 m with a courtyard."""
    ring = [(0, 0), (6000, 0), (6000, 6000), (0, 6000)]
    hole = [(inner, inner), (inner, 4000), (4000, 4000), (4000, inner)]

    def at(r, z):
        return [(*p, z) for p in r]

    def walls(r):
        return [[[(*r[k - 1], 0), (*r[k], 0), (*r[k], 3000), (*r[k - 1], 3000)]] for k in range(4)]

    roof_hole = at(hole[::-1] if hole_reversed else hole, 3000)
    return [[at(ring, 3000), roof_hole], [at(ring, 0)[::-1], at(hole, 0)[::-1]], *walls(ring), *walls(hole)]


def test_courtyards_are_allowed_but_must_run_the_other_way_and_lie_inside():
    assert gate.check(courtyard()) == []
    assert gate.volume(courtyard()) == pytest.approx((36 - 4) * 3e9)
    assert "ring_orientation" in kinds(courtyard(hole_reversed=True))
    assert "ring" in kinds(courtyard(inner=-1000))


def test_an_edge_through_a_face_is_refused():
    # A spire pulled down through the ground: closed, oriented and planar, but it passes through the base.
    ring = [(0, 0), (4000, 0), (4000, 4000), (0, 4000)]
    tip = (2000, 2000, -3000)
    low, high = [(*p, 0) for p in ring], [(*p, 4000) for p in ring]
    roof = [[[high[k - 1], high[k], tip]] for k in range(4)]
    walls = [[[low[k - 1], low[k], high[k], high[k - 1]]] for k in range(4)]
    assert "intersection" in kinds([*roof, *walls, [low[::-1]]])


def test_a_vertex_that_touches_a_foreign_face_is_refused():
    ring = [(0, 0), (4000, 0), (4000, 4000), (0, 4000)]
    tip = (2000, 2000, 0)
    low, high = [(*p, 0) for p in ring], [(*p, 4000) for p in ring]
    roof = [[[high[k - 1], high[k], tip]] for k in range(4)]
    walls = [[[low[k - 1], low[k], high[k], high[k - 1]]] for k in range(4)]
    assert kinds([*roof, *walls, [low[::-1]]]) == {"touch"}


def test_overlapping_walls_in_one_plane_are_refused():
    # A U whose arms are folded onto each other: the inner walls coincide over part of their length.
    ring = [(0, 0), (9000, 0), (9000, 5000), (5000, 5000), (5000, 1000), (4998, 1000), (4998, 5000), (0, 5000)]
    low, high = [(*p, 0) for p in ring], [(*p, 3000) for p in ring]
    walls = [[[low[k - 1], low[k], high[k], high[k - 1]]] for k in range(len(ring))]
    assert kinds([[high], [low[::-1]], *walls]) <= {"near", "touch", "overlap"}
    assert kinds([[high], [low[::-1]], *walls])


def test_turning_and_moving_a_solid_changes_nothing():
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for faces in (gable(), courtyard()):
        moved = [
            [[tuple(int(v) for v in turn @ p + (5_000_000, -3_000_000, 200_000)) for p in r] for r in f] for f in faces
        ]
        assert gate.check(moved) == []
        assert gate.volume(moved) == pytest.approx(gate.volume(faces))
