"""Straight rims: the faces of a partition without the raggedness of their making.

In: faces that tile a building, cut from pixels and moved by noisy heights (`ragged`), or exact ones (`tidied` only). Out: faces
that tile it with straight edges, long edges along the building's main directions, and nothing too small for the millimetre
grid. Edges shared by two faces stay shared: what changes are the vertices, never which face lies where.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from math import hypot
from typing import NamedTuple

import numpy as np
import shapely

from kibs_steps.faces import (
    MM,
    Face,
    NoPartition,
    Point,
    area,
    directed_edges,
    is_coverage,
    misplaced,
    polygon,
    regions,
    rings_along,
)

NOISE = 0.35  # m, shortest edge worth keeping
REACH = 0.5  # m, how far a straight edge may run beside the ragged one: 1.3 px of the usual 0.38 m
TURN = 12.0  # deg, edges this near to a main direction are turned into it
LONG = 1.5  # m, edges that say something about directions
ANCHOR = 0.05  # weight (m) of a vertex's own place against that of its edges' lines
ROUNDS = 5  # in which faces that do not tile are put back
SMALLEST = 0.25  # m², no face is made smaller
CLEARANCE = 0.02  # m, a vertex this near to an edge is made part of it
TINY = 0.01  # m, shortest edge of any partition
COLLINEAR = 0.002  # m, a vertex this near to the line between its neighbours says nothing
APART = 0.25  # sine of the angle between two lines that meet in a corner


class Piece(NamedTuple):
    """A straight piece of rim: the path (mm) that its line is fitted to, and the vertices between which it runs."""

    path: list[Point]
    start: Point
    end: Point


def ragged(faces: list[Face], reach: float = REACH, building: np.ndarray | None = None) -> list[Face]:
    """Straight faces of ragged ones, rims moved by `reach` (m) at most; as they were where no straight version tiles.

    `building` (n,): building of each section, each with a main direction of its own; one for all unless given.
    """
    junctions = {point for point, others in _around(faces).items() if len(others) > 2}
    faces = _contracted(faces, reach, junctions)
    faces = _straight(faces, reach, building) or faces
    shorter = without_collinear(_contracted(faces, NOISE), NOISE / 5)
    return tidied(shorter if is_coverage(shorter) else faces)


def tidied(faces: list[Face]) -> list[Face]:
    """Faces without edges too short, vertices too near to an edge or needless ones, for the millimetre grid."""
    return without_collinear(_contracted(_clear(_contracted(faces, TINY)), TINY), COLLINEAR)


def _straight(faces: list[Face], reach: float, building: np.ndarray | None) -> list[Face] | None:
    """Faces whose rims are straight within `reach` (m), or None if they would no longer tile.

    Each chain of edges between two junctions is cut by Douglas and Peucker, and corners that this cuts off are put back; to each
    piece a line is fitted over all of the chain that it replaces; each vertex goes to where the lines of its pieces meet. Faces
    that this breaks stay as they are.
    """
    pieces = _pieces(faces, reach)
    owner = _owners(pieces, faces, building)
    main = {o: _main_direction([p for p, own in zip(pieces, owner, strict=True) if own == o]) for o in set(owner)}
    stiff: dict[Point, np.ndarray] = {}
    pull: dict[Point, np.ndarray] = {}
    for piece, own in zip(pieces, owner, strict=True):
        normal, offset, weight = _line(piece.path, main[own], reach)
        for point in (piece.start, piece.end):
            place = np.array(point) / MM
            stiff.setdefault(point, ANCHOR * np.eye(2))
            pull.setdefault(point, ANCHOR * place)
            stiff[point] = stiff[point] + weight * np.outer(normal, normal)
            pull[point] = pull[point] + weight * offset * normal
    moved = {}
    for point in stiff:
        way = np.linalg.solve(stiff[point], pull[point]) - np.array(point) / MM
        way *= min(1.0, 2 * reach / max(np.hypot(*way), 1e-9))
        moved[point] = (round(point[0] + way[0] * MM), round(point[1] + way[1] * MM))
    rough: set[int] = set()
    for _ in range(ROUNDS):
        at = moved | {p: p for f in rough for ring in faces[f].rings for p in ring}
        straight = [Face(face.section, [[at[p] for p in ring if p in at] for ring in face.rings]) for face in faces]
        wrong = misplaced(straight)
        if not wrong:
            return straight
        rough |= wrong
    return None


def _owners(pieces: list[Piece], faces: list[Face], building: np.ndarray | None) -> list[int]:
    """The building that each piece of rim belongs to; of two, the first."""
    if building is None:
        return [0] * len(pieces)
    edges = directed_edges(faces)
    owners = []
    for (u, v, *_), *_ in pieces:
        beside = [edges[e] for e in ((u, v), (v, u)) if e in edges]
        owners.append(min(int(building[faces[f].section]) for f in beside))
    return owners


def _around(faces: list[Face]) -> dict[Point, list[Point]]:
    """The vertices that each vertex has an edge to."""
    around: dict[Point, list[Point]] = defaultdict(list)
    for u, v in sorted({(min(e), max(e)) for e in directed_edges(faces)}):
        around[u].append(v)
        around[v].append(u)
    return around


def _chains(around: dict[Point, list[Point]]) -> Iterator[list[Point]]:
    """Edges as paths between junctions (vertices with other than two edges), each once; loops end where they begin."""
    left = {(u, v) for u in around for v in around[u]}

    def follow(u: Point, v: Point) -> list[Point]:
        chain = [u, v]
        while len(around[chain[-1]]) == 2 and chain[-1] != u:
            chain.append(next(p for p in around[chain[-1]] if p != chain[-2]))
        left.difference_update(pairwise(chain))
        left.difference_update((b, a) for a, b in pairwise(chain))
        return chain

    for junctions in (True, False):
        for u in sorted(around):
            for v in around[u] if junctions == (len(around[u]) != 2) else []:
                if (u, v) in left:
                    yield follow(u, v)


def _pieces(faces: list[Face], reach: float) -> list[Piece]:
    """The rims of faces as straight pieces, chain by chain."""
    around = _around(faces)
    found = []
    for chain in _chains(around):
        start, loop = chain[0], chain[0] == chain[-1]
        far = max(range(len(chain)), key=lambda k: hypot(chain[k][0] - start[0], chain[k][1] - start[1]))
        halves = [chain[: far + 1], chain[far:]] if loop else [chain]
        pieces = [Piece(path, path[0], path[-1]) for half in halves for path in _cut(half, reach)]
        found += _with_corners(pieces, loop and len(around[start]) == 2, reach)
    return found


def _cut(chain: list[Point], reach: float) -> list[list[Point]]:
    """A chain cut where it leaves its chord by more than `reach` (m)."""
    kept = shapely.get_coordinates(shapely.simplify(shapely.LineString(chain), reach * MM, preserve_topology=False))
    cuts, k = [], 0
    for point in map(tuple, kept.astype(int).tolist()):
        while chain[k] != point:
            k += 1
        cuts.append(k)
        k = min(k + 1, len(chain) - 1)
    return [chain[a : b + 1] for a, b in pairwise(cuts)]


def _with_corners(pieces: list[Piece], loop: bool, reach: float) -> list[Piece]:
    """The pieces of a chain without those that cut a corner off: shorter than both of their neighbours, whose lines meet in a
    corner that does as well within `reach` (m). The shortest goes first; of a `loop` any may go, else neither end's."""
    while len(pieces) > (3 if loop else 2):
        among = range(len(pieces)) if loop else range(1, len(pieces) - 1)
        for k in sorted(among, key=lambda k: _chord(pieces[k].path)):
            before, cut, after = pieces[k - 1], pieces[k], pieces[(k + 1) % len(pieces)]
            corner = _corner(before, cut, after, reach)
            if corner is not None:
                pieces = list(pieces)
                pieces[k - 1], pieces[(k + 1) % len(pieces)] = before._replace(end=corner), after._replace(start=corner)
                del pieces[k]
                break
        else:
            break
    return pieces


def _corner(before: Piece, cut: Piece, after: Piece, reach: float) -> Point | None:
    """The vertex of a piece that is nearest to where its neighbours' lines meet, if these do in its place."""
    if _chord(cut.path) > min(_chord(before.path), _chord(after.path)):
        return None
    (one, off, _), (other, away, _) = (_line(piece.path, None, reach) for piece in (before, after))
    if abs(one[0] * other[1] - one[1] * other[0]) < APART:
        return None
    corner = np.linalg.solve([one, other], [off, away])
    vertices = np.array(cut.path, float) / MM
    distance = np.hypot(*(vertices - corner).T)
    instead = shapely.LineString([np.array(before.start) / MM, corner, np.array(after.end) / MM])
    if distance.min() > 2 * reach or shapely.distance(shapely.points(vertices), instead).max() > reach:
        return None
    return cut.path[int(distance.argmin())]


def _chord(path: list[Point]) -> float:
    """The length (m) from a path's start to its end."""
    return hypot(path[-1][0] - path[0][0], path[-1][1] - path[0][1]) / MM


def _main_direction(pieces: list[Piece]) -> float | None:
    """The building's main direction (rad, modulo a right angle), None where it has none."""
    chords = np.array([np.subtract(piece.path[-1], piece.path[0]) for piece in pieces], float) / MM
    square = (chords**2).sum(axis=1)
    square[square < LONG**2] = 0.0
    turns = (square * np.exp(4j * np.arctan2(chords[:, 1], chords[:, 0]))).sum()
    return float(np.angle(turns) / 4) if abs(turns) > 0.5 * square.sum() > 0 else None


def _line(path: list[Point], main: float | None, reach: float) -> tuple[np.ndarray, float, float]:
    """Normal, offset (m) and weight (m) of the line through a path, turned into a main direction that is near."""
    at = np.array(path, float) / MM
    edge, middle = np.diff(at, axis=0), (at[1:] + at[:-1]) / 2
    length = np.hypot(*edge.T)
    centre = (middle * length[:, None]).sum(axis=0) / length.sum()
    away = middle - centre
    spread = np.einsum("i,ij,ik->jk", length, away, away) + np.einsum("i,ij,ik->jk", length / 12, edge, edge)
    along = np.linalg.eigh(spread)[1][:, 1]
    chord = _chord(path)
    if main is not None:
        angle = np.arctan2(along[1], along[0]) - main
        off = angle - np.round(angle / (np.pi / 2)) * (np.pi / 2)
        if abs(off) < np.radians(TURN) and abs(np.sin(off)) * chord / 2 < reach:
            along = np.array([np.cos(angle - off + main), np.sin(angle - off + main)])
    normal = np.array([-along[1], along[0]])
    return normal, float(normal @ centre), float(min(chord, 5.0))


def without_collinear(faces: list[Face], tolerance: float) -> list[Face]:
    """Faces without the vertices that lie within `tolerance` (m) of the line between their only two neighbours."""
    while True:
        around: dict[Point, set[Point]] = defaultdict(set)
        fewest: dict[Point, int] = {}
        for face in faces:
            for ring in face.rings:
                for before, point, after in zip([ring[-1], *ring[:-1]], ring, [*ring[1:], ring[0]], strict=True):
                    around[point] |= {before, after}
                    fewest[point] = min(fewest.get(point, len(ring)), len(ring))
        dropped: set[Point] = set()
        for point in sorted(around):
            if len(around[point]) == 2 and fewest[point] > 3 and not around[point] & dropped:
                a, b = around[point]
                if _off_line(point, a, b) <= tolerance * MM:
                    dropped.add(point)
        slimmer = [Face(f.section, [[p for p in r if p not in dropped] for r in f.rings]) for f in faces]
        if not dropped or any(len(r) < 3 for f in slimmer for r in f.rings):
            return faces
        faces = slimmer


def _off_line(point: Point, a: Point, b: Point) -> float:
    """Distance of `point` from the segment a–b; infinite beyond its ends."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = hypot(dx, dy)
    px, py = point[0] - a[0], point[1] - a[1]
    return abs(dx * py - dy * px) / length if length and 0 < dx * px + dy * py < length**2 else float("inf")


def _clear(faces: list[Face]) -> list[Face]:
    """Faces whose edges pass through every vertex nearer than `CLEARANCE`, so that nothing almost touches."""
    edges = sorted({(min(e), max(e)) for e in directed_edges(faces)})
    points = sorted({p for e in edges for p in e})
    ends, at = np.array(edges, float), np.array(points, float)
    e, p = shapely.STRtree(shapely.points(at)).query(shapely.linestrings(ends), "dwithin", CLEARANCE * MM)
    span = ends[e, 1] - ends[e, 0]
    t = ((at[p] - ends[e, 0]) * span).sum(axis=1) / (span**2).sum(axis=1)
    through: dict[tuple[Point, Point], list[tuple[float, Point]]] = defaultdict(list)
    for i, k, along in zip(e, p, t, strict=True):
        if points[k] not in edges[i] and 0 < along < 1:
            through[edges[i]].append((float(along), points[k]))
    if not through:
        return faces

    def path(u: Point, v: Point) -> list[Point]:
        between = [q for _, q in sorted(through.get((min(u, v), max(u, v)), []))]
        return [u, *(between if u < v else between[::-1])]

    denser = []
    try:
        for face in faces:
            own = {
                e
                for r in face.rings
                for u, v in zip(r, [*r[1:], r[0]], strict=True)
                for e in pairwise([*path(u, v), v])
            }
            open_edges = [(u, v) for u, v in own if (v, u) not in own]  # spikes and slits of the face have closed
            denser += [Face(face.section, region) for region in regions(rings_along(open_edges))]
        directed_edges(denser)
    except NoPartition:
        return faces
    return denser


def _contracted(faces: list[Face], shortest: float, among: set[Point] | None = None) -> list[Face]:
    """Faces whose edges below `shortest` (m) are drawn together to their middle, shortest first, while all stay simple.

    With `among`, only edges that join two of these points.
    """
    faces = list(faces)
    refused: set[tuple[Point, Point]] = set()
    while True:
        at: dict[Point, set[int]] = defaultdict(set)
        short = []
        for f, face in enumerate(faces):
            for ring in face.rings:
                for u, v in zip(ring, [*ring[1:], ring[0]], strict=True):
                    at[u].add(f)
                    length = hypot(v[0] - u[0], v[1] - u[1])
                    if among is not None and not (u in among and v in among):
                        continue
                    if length < shortest * MM and (min(u, v), max(u, v)) not in refused:
                        short.append((length, min(u, v), max(u, v)))
        if not short:
            return faces
        changed: set[int] = set()
        for _, u, v in sorted(set(short)):
            touched = at[u] | at[v]
            if touched & changed:
                continue  # seen again in the next round
            middle = ((u[0] + v[0]) // 2, (u[1] + v[1]) // 2)
            drawn = {f: _drawn_together(faces[f], u, v, middle) for f in sorted(touched)}
            if (middle in at and middle not in (u, v)) or not _all_simple(list(drawn.values())):
                refused.add((u, v))
                continue
            for f, face in drawn.items():
                faces[f] = face
            changed |= touched


def _drawn_together(face: Face, u: Point, v: Point, middle: Point) -> Face:
    """The face with two of its points made one."""
    rings = []
    for ring in face.rings:
        new = [middle if p in (u, v) else p for p in ring]
        rings.append([p for k, p in enumerate(new) if p != new[k - 1]])
    return Face(face.section, rings)


def _all_simple(faces: list[Face]) -> bool:
    """Whether each face is a valid polygon, counter-clockwise, of at least `SMALLEST`."""
    if any(len(r) < 3 or len(set(r)) < len(r) for f in faces for r in f.rings):
        return False
    if any(area(f.rings[0]) < SMALLEST * MM**2 for f in faces):
        return False
    return bool(shapely.is_valid([polygon(f) for f in faces]).all())
