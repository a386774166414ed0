"""From a roof partition to closed shells: roofs, walls, ground.

In: the faces of a partition and a plane per section. Out: `Shell`s, one per part of the building that is connected through
edges. All coordinates are integer millimetres from the building's origin. A vertex of the partition is a *column*: the
heights of the faces round it, and the ground where it is on the outline, are its levels; every wall carries all levels of its
two columns, so neighbouring walls share their vertices. A column round which high and low faces alternate would make an edge of
four faces: one of the high faces is chamfered there.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from math import atan2, hypot
from typing import NamedTuple

import numpy as np

from kibs_steps.faces import MM, Face, NoPartition, Point, directed_edges, regions, rings_along

SAME = 8  # mm, levels of a column this near are one
CHAMFER = 200.0  # mm, cut off a face where high and low alternate
ROOF, WALL, GROUND = "RoofSurface", "WallSurface", "GroundSurface"

Point3 = tuple[int, int, int]


class Surface(NamedTuple):
    """One face of a shell: its kind, the section above it (−1 for ground), rings seen from outside (mm), on the outline?"""

    kind: str
    section: int
    rings: list[list[Point3]]
    exterior: bool


def shells(faces: list[Face], planes: np.ndarray, ground: int) -> list[list[Surface]]:
    """Closed shells over a partition.

    `planes` (n, 3): z (m) = a·x + b·y + c by section; `ground` mm. Every roof must be above ground. Raises `NoPartition`
    where alternating heights cannot be chamfered.
    """
    for _ in range(8):
        faces = _cut_where_profiles_cross(faces, planes)
        levels = column_heights(faces, planes)
        bad = _alternating(faces, levels)
        if not bad:
            break
        faces = _chamfered(faces, bad)
    else:
        raise NoPartition("high and low sections meet in one point")
    return [_shell(part, planes, ground) for part in parts(faces)]


def parts(faces: list[Face]) -> list[list[Face]]:
    """Faces grouped by connection through edges."""
    edges = directed_edges(faces)
    reached: dict[int, int] = {}
    beside: dict[int, set[int]] = defaultdict(set)
    for (u, v), f in edges.items():
        if (v, u) in edges:
            beside[f].add(edges[(v, u)])
    for start in range(len(faces)):
        waiting = [start] if start not in reached else []
        while waiting:
            f = waiting.pop()
            if f not in reached:
                reached[f] = start
                waiting += beside[f]
    return [[faces[f] for f in range(len(faces)) if reached[f] == name] for name in sorted(set(reached.values()))]


def height(plane: np.ndarray, point: Point) -> int:
    """Height (mm) of a plane at a mm point."""
    return round(float(plane[0] * point[0] + plane[1] * point[1] + plane[2] * MM))


def lowest(face: Face, plane: np.ndarray) -> int:
    """Lowest height (mm) of a face under its plane."""
    return min(height(plane, p) for ring in face.rings for p in ring)


def column_heights(faces: Sequence[Face], planes: np.ndarray) -> dict[Point, dict[int, int]]:
    """Height (mm) of each face at each of its vertices; heights within `SAME` of each other at one vertex are made one."""
    found: dict[Point, list[tuple[int, int]]] = defaultdict(list)
    for f, face in enumerate(faces):
        for ring in face.rings:
            for point in ring:
                found[point].append((height(planes[face.section], point), f))
    heights: dict[Point, dict[int, int]] = {}
    for point, pairs in found.items():
        pairs.sort()
        runs = [[pairs[0]]]
        for pair in pairs[1:]:
            if pair[0] - runs[-1][-1][0] < SAME:
                runs[-1].append(pair)
            else:
                runs.append([pair])
        heights[point] = {f: round(sum(z for z, _ in run) / len(run)) for run in runs for _, f in run}
    return heights


def _cut_where_profiles_cross(faces: list[Face], planes: np.ndarray) -> list[Face]:
    """Put a vertex on every shared edge where the two planes cross, so that each piece has one higher side."""
    edges = directed_edges(faces)
    cuts: dict[tuple[Point, Point], Point] = {}
    for (u, v), f in edges.items():
        g = edges.get((v, u))
        if g is None or g < f:
            continue
        first, second = (height(planes[faces[f].section], p) - height(planes[faces[g].section], p) for p in (u, v))
        if first * second < 0 and min(abs(first), abs(second)) >= SAME:
            t = first / (first - second)
            cut = (round(u[0] + t * (v[0] - u[0])), round(u[1] + t * (v[1] - u[1])))
            cuts[(u, v)] = cuts[(v, u)] = cut
    if not cuts:
        return faces
    new = []
    for face in faces:
        rings = []
        for ring in face.rings:
            path: list[Point] = []
            for edge in zip(ring, [*ring[1:], ring[0]], strict=True):
                path += [edge[0], cuts[edge]] if edge in cuts else [edge[0]]
            rings.append(path)
        new.append(Face(face.section, rings))
    return new


def _wedges(faces: Sequence[Face]) -> dict[Point, list[list[tuple[int, Point, Point]]]]:
    """Round each vertex the runs of faces that follow each other counter-clockwise without the outside between them.

    Each wedge is (face, neighbour it starts at, neighbour it ends at).
    """
    corners: dict[Point, dict[Point, tuple[int, Point]]] = defaultdict(dict)
    for f, face in enumerate(faces):
        for ring in face.rings:
            for before, point, after in zip([ring[-1], *ring[:-1]], ring, [*ring[1:], ring[0]], strict=True):
                corners[point][after] = (f, before)
    fans = {}
    for point, starting in corners.items():
        ends = {end for _, end in starting.values()}
        left = dict(starting)
        runs = []
        for first in sorted(starting, key=lambda n, ends=ends: (n in ends, n)):
            run, at = [], first
            while at in left:
                f, end = left.pop(at)
                run.append((f, at, end))
                at = end
            if run:
                runs.append(run)
        fans[point] = sorted(runs, key=lambda run, p=point: atan2(run[0][1][1] - p[1], run[0][1][0] - p[0]))
    return fans


def _alternating(
    faces: Sequence[Face], levels: dict[Point, dict[int, int]]
) -> dict[Point, list[tuple[int, Point, Point]]]:
    """Vertices round which high and low alternate, each with the wedges of the narrowest high run (to be chamfered).

    So are those that one face visits twice, with the narrower of its wedges.
    """
    bad = {}
    for point, runs in _wedges(faces).items():
        whole = len(runs) == 1 and runs[0][0][1] == runs[0][-1][2]
        if len(runs) == 1 and len(runs[0]) < 3 + whole:
            continue
        circle: list[tuple[int, Point, Point] | None] = []
        for run in runs:
            circle += run if whole else [*run, None]
        for level in sorted(set(levels[point].values())):
            high = [w is not None and levels[point][w[0]] >= level for w in circle]
            if all(high):
                continue
            start = high.index(False)
            turned, turned_high = circle[start:] + circle[:start], high[start:] + high[:start]
            arcs: list[list[tuple[int, Point, Point]]] = []
            for k, wedge in enumerate(turned):
                if wedge is not None and turned_high[k]:
                    if not turned_high[k - 1]:
                        arcs.append([])
                    arcs[-1].append(wedge)
            if len(arcs) > 1:
                bad[point] = min(arcs, key=lambda arc, p=point: (_angle(p, arc), arc[0][1]))
                break
        else:
            visits = Counter(wedge[0] for wedge in circle if wedge is not None)
            again = [[wedge] for wedge in circle if wedge is not None and visits[wedge[0]] > 1]
            if again:
                bad[point] = min(again, key=lambda arc, p=point: (_angle(p, arc), arc[0][1]))
    return bad


def _angle(point: Point, arc: list[tuple[int, Point, Point]]) -> float:
    """Angle that a run of wedges spans."""
    first, last = arc[0][1], arc[-1][2]
    start, end = (atan2(p[1] - point[1], p[0] - point[0]) for p in (first, last))
    return (end - start) % (2 * np.pi)


def _chamfered(faces: list[Face], bad: dict[Point, list[tuple[int, Point, Point]]]) -> list[Face]:
    """Cut the given run of wedges off each vertex; what is cut off goes to the face before it, else after it, else outside."""
    done: set[Point] = set()
    for point in sorted(bad):
        arc = bad[point]
        spokes = [arc[0][1], *(end for _, _, end in arc)]
        if done & {point, *spokes}:
            continue  # its surroundings have changed: the next round sees it again
        done |= {point, *spokes}
        cut = {}
        for spoke in spokes:
            dx, dy = spoke[0] - point[0], spoke[1] - point[1]
            share = min(CHAMFER / hypot(dx, dy), 0.35)
            cut[spoke] = (round(point[0] + share * dx), round(point[1] + share * dy))
        edges = directed_edges(faces)
        before, after = edges.get((spokes[0], point)), edges.get((point, spokes[-1]))
        chain = [cut[s] for s in spokes]

        def replace(f: int, old: tuple[Point, ...], new: list[Point]) -> None:
            faces[f] = Face(faces[f].section, [_with_path(r, old, new) for r in faces[f].rings])  # noqa: B023

        faces = list(faces)
        for f, start, end in arc:
            replace(f, (end, point, start), [end, cut[end], cut[start], start])
        if before is not None:
            replace(before, (spokes[0], point), [spokes[0], *chain, point])
            if after is not None:
                replace(after, (point, spokes[-1]), [point, chain[-1], spokes[-1]])
        elif after is not None:
            replace(after, (point, spokes[-1]), [point, *chain, spokes[-1]])
    return faces


def _with_path(ring: list[Point], old: tuple[Point, ...], new: list[Point]) -> list[Point]:
    """The ring with the consecutive points `old` replaced by `new`."""
    for k in range(len(ring)):
        turned = ring[k:] + ring[:k]
        if tuple(turned[: len(old)]) == old:
            return new + turned[len(old) :]
    return ring


def _shell(faces: list[Face], planes: np.ndarray, ground: int) -> list[Surface]:
    """One closed shell over connected faces."""
    edges = directed_edges(faces)
    heights = column_heights(faces, planes)
    levels = {point: set(by_face.values()) for point, by_face in heights.items()}
    outline = [edge for edge in edges if edge[::-1] not in edges]
    for u, _ in outline:
        levels[u].add(ground)
    surfaces = [
        Surface(ROOF, face.section, [[(*p, heights[p][f]) for p in ring] for ring in face.rings], False)
        for f, face in enumerate(faces)
    ]

    def column(point: Point, low: int, high: int) -> list[Point3]:
        return [(*point, z) for z in sorted(levels[point]) if low <= z <= high]

    for (u, v), f in edges.items():
        g = edges.get((v, u))
        top_u, top_v = heights[u][f], heights[v][f]
        low_u, low_v = (ground, ground) if g is None else (heights[u][g], heights[v][g])
        if low_u <= top_u and low_v <= top_v and (low_u, low_v) != (top_u, top_v):
            ring = column(v, low_v, top_v) + column(u, low_u, top_u)[::-1]
            surfaces.append(Surface(WALL, faces[f].section, [ring], g is None))
    base = rings_along(outline)
    for region in regions(base):
        surfaces.append(Surface(GROUND, -1, [[(*p, ground) for p in reversed(ring)] for ring in region], False))
    return surfaces
