"""The validity gate: is this a solid? Asked of every building before it is published, knowing nothing of how it was built.

In: the faces of one shell, each a list of rings (exterior first) of integer millimetre points (x, y, z); seen from outside,
exteriors run counter-clockwise and holes clockwise. Out: a list of `Problem`, empty when the shell bounds one solid in the
sense of ISO 19107: closed, two-manifold in edges and vertices, oriented outward, faces planar and simple, touching
each other only where they share vertices and edges.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

Point3 = tuple[int, int, int]
Rings = Sequence[Sequence[Point3]]

PLANARITY = 5.0  # mm, from the Newell and from the fitted plane
NEAR = 5.0  # mm, closest two vertices may be
TOUCH = 2.0  # mm, a vertex this near to a face that does not have it touches it
PAIRS_AT_ONCE = 4_000_000  # edge-face pairs held in memory


class Problem(NamedTuple):
    """One reason to refuse a solid: its kind, the faces concerned, and a sentence."""

    kind: str
    faces: tuple[int, ...]
    text: str


class Flat(NamedTuple):
    """A face in its plane: unit normal n, offset n·p (mm), the two axes kept when it is laid flat, and the polygon there."""

    normal: np.ndarray
    offset: float
    axes: tuple[int, int]
    polygon: shapely.Polygon


def newell(ring: Sequence[Point3]) -> np.ndarray:
    """Area vector (mm²) of a ring: its length is the area, its direction the normal (Newell's method)."""
    p = np.asarray(ring, float)
    p = p - p[0]
    return np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0) / 2


def volume(faces: Sequence[Rings]) -> float:
    """Signed volume (mm³) inside the faces: positive when they face outward."""
    every = [ring for rings in faces for ring in rings]
    first = np.array([ring[0] for ring in every], float) - every[0][0]
    return float((area_vectors(every) * first).sum()) / 3


def area_vectors(rings: Sequence[Sequence[Point3]]) -> np.ndarray:
    """Area vectors (n, 3) of rings: `newell` of each, all at once."""
    count = np.array([len(ring) for ring in rings])
    start = np.cumsum(count) - count
    p = np.array([point for ring in rings for point in ring], float)
    p -= np.repeat(p[start], count, axis=0)
    after = np.arange(len(p)) + 1
    after[start + count - 1] = start
    (x, y, z), (u, v, w) = p.T, p[after].T
    return np.add.reduceat(np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1), start) / 2


def check(faces: Sequence[Rings]) -> list[Problem]:
    """All problems of a shell of faces (mm). Later checks are left out where earlier ones make them meaningless."""
    if len(faces) < 4:
        return [Problem("open", (), f"{len(faces)} faces cannot enclose a volume")]
    problems = _rings(faces) or _near(faces)
    if problems:
        return problems
    flat, problems = _lay_flat(faces)
    problems += _manifold(faces)
    if problems:
        return problems
    if volume(faces) <= 0:
        return [Problem("inside_out", (), "the faces enclose a negative volume: they face inward")]
    return _intersections(faces, flat)


def _rings(faces: Sequence[Rings]) -> list[Problem]:
    """Rings of at least three points, none visited twice by a face."""
    problems = []
    for i, rings in enumerate(faces):
        points = [p for ring in rings for p in ring]
        if not rings or min(map(len, rings)) < 3:
            problems.append(Problem("ring", (i,), f"face {i} has a ring of fewer than three points"))
        elif len(set(points)) < len(points):
            problems.append(Problem("ring", (i,), f"face {i} visits a point twice"))
    return problems


def _near(faces: Sequence[Rings]) -> list[Problem]:
    """Vertices at least `NEAR` apart."""
    points = sorted({p for rings in faces for ring in rings for p in ring})
    pairs = cKDTree(np.asarray(points, float)).query_pairs(NEAR - 1e-6)
    return [
        Problem("near", (), f"vertices {points[a]} and {points[b]} are less than {NEAR:g} mm apart") for a, b in pairs
    ]


def _lay_flat(faces: Sequence[Rings]) -> tuple[list[Flat], list[Problem]]:
    """Every face laid flat by dropping the coordinate its normal is longest in, so that coordinates stay integers."""
    flats, problems = [], []
    count = [len(rings) for rings in faces]
    of_face = np.split(area_vectors([ring for rings in faces for ring in rings]), np.cumsum(count)[:-1])
    for i, (rings, areas) in enumerate(zip(faces, of_face, strict=True)):
        total = areas.sum(axis=0)
        length = np.linalg.norm(total)
        if length < 1.0:
            problems.append(Problem("degenerate", (i,), f"face {i} has no area"))
            continue
        normal = total / length
        points = np.asarray([p for ring in rings for p in ring], float)
        centre = points.mean(axis=0)
        fitted = np.linalg.svd(points - centre, full_matrices=False)[2][-1]
        off = max(np.abs((points - centre) @ normal).max(), np.abs((points - centre) @ fitted).max())
        if off > PLANARITY:
            problems.append(Problem("not_planar", (i,), f"face {i} is {off:.0f} mm off its plane"))
        if any(area @ normal >= 0 for area in areas[1:]) or areas[0] @ normal <= 0:
            problems.append(Problem("ring_orientation", (i,), f"a hole of face {i} runs the same way as its exterior"))
        drop = int(np.abs(normal).argmax())
        axes = ((1, 2), (0, 2), (0, 1))[drop]
        polygon = _laid(rings, axes)
        if not polygon.is_valid:
            problems.append(Problem("ring", (i,), f"face {i}: {shapely.is_valid_reason(polygon)}"))
        flats.append(Flat(normal, float(normal @ centre), axes, polygon))
    return flats, problems


def _manifold(faces: Sequence[Rings]) -> list[Problem]:
    """Every edge once each way, one fan of faces round every vertex, one piece."""
    used: Counter[tuple[Point3, Point3]] = Counter()
    corners: dict[Point3, list[tuple[Point3, Point3]]] = defaultdict(list)
    for rings in faces:
        for ring in rings:
            for before, point, after in zip([ring[-1], *ring[:-1]], ring, [*ring[1:], ring[0]], strict=True):
                used[(point, after)] += 1
                corners[point].append((before, after))
    problems = []
    for (a, b), times in used.items():
        if times > 1:
            problems.append(Problem("edge", (), f"edge {a} to {b} is used {times} times in one direction"))
        elif (b, a) not in used:
            problems.append(Problem("open", (), f"edge {a} to {b} has a face on one side only"))
    if problems:
        return problems
    for point, fan in corners.items():
        if _steps_round(dict(fan), fan[0][0]) < len(fan):
            problems.append(Problem("vertex", (), f"separate fans of faces meet in vertex {point}"))
    return problems or _one_piece(faces)


def _steps_round(following: dict[Point3, Point3], start: Point3) -> int:
    """Faces met on the way round a vertex, from the neighbour `start` back to it."""
    steps, at = 1, following[start]
    while at != start:
        steps, at = steps + 1, following[at]
    return steps


def _one_piece(faces: Sequence[Rings]) -> list[Problem]:
    """All faces connected through their vertices (a face connects its own rings)."""
    at: dict[Point3, list[int]] = defaultdict(list)
    for i, rings in enumerate(faces):
        for ring in rings:
            for point in ring:
                at[point].append(i)
    reached, waiting = set(), [0]
    while waiting:
        i = waiting.pop()
        if i not in reached:
            reached.add(i)
            waiting += [j for ring in faces[i] for point in ring for j in at[point]]
    return [] if len(reached) == len(faces) else [Problem("pieces", (), "the faces form more than one shell")]


def _intersections(faces: Sequence[Rings], flat: Sequence[Flat]) -> list[Problem]:
    """Faces that meet anywhere but in shared vertices and edges.

    Two planar faces meet improperly only if an edge of one passes through the other, a vertex of one lies on the other, or
    they overlap within one plane; each is looked for directly.
    """
    points = sorted({p for rings in faces for ring in rings for p in ring})
    index = {p: k for k, p in enumerate(points)}
    xyz = np.asarray(points, float)
    edges = np.asarray(
        sorted(
            {
                (index[a], index[b])
                for rings in faces
                for r in rings
                for a, b in zip(r, [*r[1:], r[0]], strict=True)
                if a < b
            }
        )
    )
    member = np.zeros((len(faces), len(points)), bool)
    for i, rings in enumerate(faces):
        member[i, [index[p] for ring in rings for p in ring]] = True
    low = np.array([xyz[m].min(axis=0) for m in member]) - NEAR
    high = np.array([xyz[m].max(axis=0) for m in member]) + NEAR
    polygons = np.array([f.polygon for f in flat], object)
    axes = np.array([f.axes for f in flat])
    normals = np.array([f.normal for f in flat])
    offsets = np.array([f.offset for f in flat])
    edge_low, edge_high = np.minimum(*xyz[edges.T]), np.maximum(*xyz[edges.T])
    problems = []
    step = max(1, PAIRS_AT_ONCE // max(len(edges), 1))
    for first in range(0, len(faces), step):
        part = slice(first, first + step)
        away = normals[part] @ xyz.T - offsets[part, None]
        away[member[part]] = 0.0

        inside = ((xyz >= low[part, None]) & (xyz <= high[part, None])).all(axis=2)
        f, v = np.nonzero(~member[part] & (np.abs(away) <= TOUCH) & inside)
        on = shapely.distance(polygons[first + f], _points_in(xyz[v], axes[first + f])) < TOUCH
        problems += [
            Problem("touch", (first + int(i),), f"vertex {points[k]} lies on face {first + i}, which does not have it")
            for i, k in zip(f[on], v[on], strict=True)
        ]

        d0, d1 = away[:, edges[:, 0]], away[:, edges[:, 1]]
        crossing = (np.minimum(d0, d1) < -NEAR) & (np.maximum(d0, d1) > NEAR)
        crossing &= ((edge_high >= low[part, None]) & (edge_low <= high[part, None])).all(axis=2)
        f, e = np.nonzero(crossing)
        t = (d0[f, e] / (d0[f, e] - d1[f, e]))[:, None]
        through = xyz[edges[e, 0]] * (1 - t) + xyz[edges[e, 1]] * t
        hit = shapely.distance(polygons[first + f], _points_in(through, axes[first + f])) < 1.0
        problems += [
            Problem(
                "intersection", (first + int(i),), f"edge {points[a]} to {points[b]} passes through face {first + i}"
            )
            for i, (a, b) in zip(f[hit], edges[e[hit]], strict=True)
        ]
    return problems or _overlaps(faces, flat, low, high)


def _overlaps(faces: Sequence[Rings], flat: Sequence[Flat], low: np.ndarray, high: np.ndarray) -> list[Problem]:
    """Pairs of faces in one plane that share area; `low` and `high` are the corners (n, 3) of their boxes."""
    tree = shapely.STRtree(shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1]))
    normals = np.array([f.normal for f in flat])
    a, b = tree.query(tree.geometries)
    keep = (a < b) & (np.abs((normals[a] * normals[b]).sum(axis=1)) > 0.999)
    keep &= (low[a, 2] <= high[b, 2]) & (low[b, 2] <= high[a, 2])
    problems = []
    for i, j in zip(a[keep], b[keep], strict=True):
        other = np.asarray([p for ring in faces[j] for p in ring], float)
        if np.abs(other @ normals[i] - flat[i].offset).max() > 2 * NEAR:
            continue
        shared = shapely.intersection(flat[i].polygon, shapely.make_valid(_laid(faces[j], flat[i].axes)))
        if not shapely.buffer(shared, -NEAR).is_empty:
            problems.append(Problem("overlap", (int(i), int(j)), f"faces {i} and {j} overlap in one plane"))
    return problems


def _laid(rings: Rings, axes: tuple[int, int]) -> shapely.Polygon:
    """A face as a polygon in two of its three coordinates."""
    exterior, *holes = [np.asarray(ring, float)[:, axes] for ring in rings]
    return shapely.Polygon(exterior, holes)


def _points_in(xyz: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Points (n, 3) laid flat along each one's pair of axes (n, 2)."""
    return shapely.points(np.take_along_axis(xyz, axes, axis=1)) if len(xyz) else np.empty(0, object)
