"""Faces: polygons of integer millimetres that share their vertices exactly, and what can be asked of a set of them.

A `Face` is a connected part of one roof section, as rings of (x, y) mm from the building's own origin, the exterior
counter-clockwise first, holes clockwise. Faces *tile* a building when every directed edge has at most one face on its left
and two faces that meet have the same vertices there. All functions here are exact: they only compare integers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from math import atan2, pi
from typing import NamedTuple

import numpy as np
import shapely

from kibs_steps.errors import KibsError

MM = 1000

Point = tuple[int, int]
Ring = list[Point]


class Face(NamedTuple):
    """A connected part of one section: its index, and rings of mm points, the exterior counter-clockwise first."""

    section: int
    rings: list[Ring]


class NoPartition(KibsError):
    """Sections that cannot be made into a partition."""


def polygon(face: Face) -> shapely.Polygon:
    """A face as a polygon of metres."""
    exterior, *holes = [np.asarray(ring, float) / MM for ring in face.rings]
    return shapely.Polygon(exterior, holes)


def shapes_of(faces: list[Face]) -> list[shapely.Geometry]:
    """Valid areas (m from the origin) of faces; a face that touches itself in a point becomes several parts."""
    return list(shapely.make_valid([polygon(face) for face in faces]))


def rings_of(cell: shapely.Polygon) -> list[Ring]:
    """A polygon's rings as mm points."""
    return [
        [(int(x), int(y)) for x, y in np.rint(shapely.get_coordinates(ring)[:-1] * MM)]
        for ring in (cell.exterior, *cell.interiors)
    ]


def directed_edges(faces: Iterable[Face]) -> dict[tuple[Point, Point], int]:
    """Which face lies on the left of each directed edge. Raises `NoPartition` where two do."""
    edges: dict[tuple[Point, Point], int] = {}
    for f, face in enumerate(faces):
        for ring in face.rings:
            for edge in zip(ring, [*ring[1:], ring[0]], strict=True):
                if edge in edges:
                    raise NoPartition(f"two sections claim the same side of the edge {edge}")
                edges[edge] = f
    return edges


def rings_along(edges: Iterable[tuple[Point, Point]]) -> list[Ring]:
    """Chain directed edges (area on their left) into rings; where a region touches itself, rings keep to their own corner."""
    leaving: dict[Point, list[Point]] = defaultdict(list)
    for u, v in sorted(edges):
        leaving[u].append(v)
    rings = []
    for start in sorted(leaving):
        while leaving[start]:
            first = leaving[start].pop(0)
            ring, before, at = [start], start, first
            while True:
                choices = [*leaving[at], first] if at == start else leaving[at]
                if not choices:
                    raise NoPartition(f"an outline ends at {at}")
                following = min(choices, key=lambda p, at=at, before=before: _clockwise(at, before, p))
                if at == start and following == first:
                    break
                ring.append(at)
                leaving[at].remove(following)
                before, at = at, following
            rings.append(ring)
    return rings


def _clockwise(at: Point, reference: Point, other: Point) -> float:
    """Angle (0, 2π] turned clockwise at `at` from the direction of `reference` to that of `other`."""
    first = atan2(reference[1] - at[1], reference[0] - at[0])
    second = atan2(other[1] - at[1], other[0] - at[0])
    return (first - second) % (2 * pi) or 2 * pi


def area(ring: Ring) -> float:
    """Signed area (mm²), positive counter-clockwise."""
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(ring, [*ring[1:], ring[0]], strict=True)) / 2


def regions(rings: list[Ring]) -> list[list[Ring]]:
    """Group rings into exteriors, each followed by the holes inside it."""
    exteriors = [r for r in rings if area(r) > 0]
    grouped = [[r] for r in exteriors]
    if len(exteriors) == 1:
        grouped[0] += [r for r in rings if area(r) < 0]
        return grouped
    solid = [shapely.Polygon(r) for r in exteriors]
    for hole in (r for r in rings if area(r) < 0):
        inside = shapely.Polygon(hole).representative_point()
        around = [k for k, p in enumerate(solid) if p.contains(inside)]
        if around:
            grouped[min(around, key=lambda k: solid[k].area)].append(hole)
    return grouped


def merged(faces: list[Face], label: Callable[[int], int | None]) -> list[Face]:
    """Faces joined across edges where their `label` is the same; those labelled None are dropped."""
    edges = directed_edges(faces)
    labels = [label(f) for f in range(len(faces))]
    neighbours: dict[int, set[int]] = defaultdict(set)
    for (u, v), f in edges.items():
        g = edges.get((v, u))
        if g is not None and labels[g] == labels[f]:
            neighbours[f].add(g)
    outlines: dict[int, list[tuple[Point, Point]]] = defaultdict(list)
    group = _components(len(faces), neighbours)
    for (u, v), f in edges.items():
        g = edges.get((v, u))
        if g is None or group[g] != group[f]:
            outlines[group[f]].append((u, v))
    joined = []
    for f in sorted(outlines):
        if labels[f] is not None:
            joined += [Face(labels[f], region) for region in regions(rings_along(outlines[f]))]
    return joined


def dissolved(faces: list[Face]) -> list[Face]:
    """The whole building as one face per connected part, all of section 0."""
    return merged(faces, lambda f: 0)


def _components(n: int, neighbours: dict[int, set[int]]) -> list[int]:
    """For each of n nodes the smallest node it is connected to."""
    component = [-1] * n
    for start in range(n):
        waiting = [start] if component[start] < 0 else []
        while waiting:
            node = waiting.pop()
            if component[node] < 0:
                component[node] = start
                waiting += neighbours.get(node, ())
    return component


def is_coverage(faces: list[Face]) -> bool:
    """Whether faces are valid polygons that tile without overlap."""
    return not misplaced(faces)


def misplaced(faces: list[Face]) -> set[int]:
    """The faces that are no valid polygons or do not tile with their neighbours."""
    broken = {k for k, f in enumerate(faces) if any(len(set(r)) < len(r) or len(r) < 3 for r in f.rings)}
    whole = [k for k in range(len(faces)) if k not in broken]
    shapes = np.array([polygon(faces[k]) for k in whole], object)
    valid = shapely.is_valid(shapes)
    broken |= {k for k, fine in zip(whole, valid, strict=True) if not fine}
    if not broken and len(shapes):
        overlapping = ~shapely.is_empty(shapely.coverage_invalid_edges(shapes))
        broken = set(np.flatnonzero(overlapping).tolist())
    return broken
