"""Clip: roofs that come down too near to the ground end there.

A plane fitted to a few corners may dive below the terrain at its far end. Moving those vertices up would bend the face; here the
face is cut along its level line instead, and what lies below it is no roof: the building ends there, with a low wall.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import shapely

from kibs_steps import shells
from kibs_steps.faces import MM, Face, NoPartition, Point, polygon, rings_of

SPARE = 2  # mm above the lowest height, so that rounding does not take it back
MOST = 0.5  # of a section's area that may be cut off; more is no dive but a wrong plane


def clipped(faces: list[Face], planes: np.ndarray, low: set[int], lowest: int) -> list[Face]:
    """Faces whose sections in `low` are cut where their plane comes down to `lowest` (mm).

    Neighbours get the cut's vertices too. Raises `NoPartition` where more than half of a section would go.
    """
    lowest += SPARE
    cuts: dict[tuple[Point, Point], set[Point]] = defaultdict(set)  # of each edge, from both sides
    for face in faces:
        if face.section in low:
            for u, v in _edges(face):
                away = [shells.height(planes[face.section], p) - lowest for p in (u, v)]
                if away[0] * away[1] < 0:
                    t = away[0] / (away[0] - away[1])
                    cut = (round(u[0] + t * (v[0] - u[0])), round(u[1] + t * (v[1] - u[1])))
                    cuts[(u, v)].add(cut)
                    cuts[(v, u)].add(cut)
    result = []
    for face in faces:
        rings = [
            [p for u, v in pairwise([*ring, ring[0]]) for p in dict.fromkeys((u, *_along(u, cuts.get((u, v), ()))))]
            for ring in face.rings
        ]
        whole = Face(face.section, rings)
        result += _above(whole, planes[face.section], lowest) if face.section in low else [whole]
    before, after = ({s: sum(polygon(f).area for f in some if f.section == s) for s in low} for some in (faces, result))
    gone = [s for s in sorted(low) if after[s] < (1 - MOST) * before[s]]
    if gone:
        raise NoPartition(f"{1 - after[gone[0]] / before[gone[0]]:.0%} of a section would lie below the ground")
    return result


def _along(start: Point, points: Iterable[Point]) -> list[Point]:
    """Points of an edge in their order from its start."""
    return sorted(points, key=lambda p: (p[0] - start[0]) ** 2 + (p[1] - start[1]) ** 2)


def _edges(face: Face) -> list[tuple[Point, Point]]:
    return [edge for ring in face.rings for edge in pairwise([*ring, ring[0]])]


def _above(face: Face, plane: np.ndarray, lowest: int) -> list[Face]:
    """The parts of a face, which has vertices on the level line already, that are not below `lowest` (mm)."""
    corners = [p for ring in face.rings for p in ring]
    tilt = float(np.hypot(*plane[:2]))
    away = {p: shells.height(plane, p) - lowest for p in corners}
    if min(away.values()) >= -1:
        return [face]
    along = np.array([-plane[1], plane[0]]) / max(tilt, 1e-12)
    on_line = sorted((p for p in away if abs(away[p]) <= 2 + 2 * tilt), key=lambda p: float(along @ p))
    shape = shapely.Polygon(face.rings[0], face.rings[1:])
    inside = [
        s for s in map(shapely.LineString, pairwise(on_line)) if shape.contains(s.interpolate(0.5, normalized=True))
    ]
    lines = [shapely.LineString(edge) for edge in _edges(face)] + inside
    cells = shapely.get_parts(shapely.polygonize(lines))
    middles = [shapely.get_coordinates(shapely.point_on_surface(c))[0] for c in cells]
    kept = [
        c
        for c, m in zip(cells, middles, strict=True)
        if shape.contains(shapely.Point(m)) and plane @ (m[0] / MM, m[1] / MM, 1.0) * MM > lowest
    ]
    return [
        Face(face.section, rings_of(shapely.transform(shapely.orient_polygons(c), lambda xy: xy / MM))) for c in kept
    ]
