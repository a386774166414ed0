"""Planes of one building brought together: where two sections agree along their shared edge, they agree exactly.

In: the faces of a partition and one plane per section. Out: planes whose ridges, hips and valleys close; edges where the planes
differ by more than the sections' own uncertainty stay steps. Planes stay planes, so every roof face stays planar.

The adjusted planes minimise the weighted squared height change at the faces' vertices under the equations "both planes have the
same height at this vertex". In coordinates where that sum of squares is the squared length, imposing one more equation is one
orthogonal projection; equations are imposed one edge after the other, best agreement first, and one that would lift a plane by
more than its tolerance, or tilt it beyond the slope cap, is not imposed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kibs_steps.faces import MM, Face, Point, directed_edges, is_coverage
from kibs_steps.straight import tidied

SLOPE_CAP = 75.0  # deg
PLACE = 0.35  # m, σ of a vertex's place where sections did not fit
LEVELLED = 0.1  # m, σ of heights that should be one
AGREE = 1.2  # m, planes farther apart at a vertex are at a step
FARTHEST = 0.6  # m, how far a vertex is moved
UNKNOWN = 0.3  # m, σ of a plane that has none
MISPLACED = 0.15  # m of height that an edge beside its place makes two planes differ
PARALLEL = 0.15  # m/m, planes whose gradients differ less are parallel
COINCIDE = 0.3  # m, parallel planes this near are one level
TOUCH = 0.1  # m, planes this near at a single vertex are made to meet there
LEAST, MOST = (
    0.1,
    0.19,
)  # m, how far a fitted plane is lifted: a roof face within 0.2 m of its section's plane is faithful
FLAT_WEIGHT = 1e-4  # of a section whose plane is only a placeholder, per m²


class Together(NamedTuple):
    """Planes (n, 3), and how many shared edges were closed and how many stayed steps."""

    planes: np.ndarray
    closed: int
    steps: int


def tolerance(sigma: np.ndarray, reliable: np.ndarray) -> np.ndarray:
    """How far (m) each plane may be lifted at any vertex: three times its σ, `LEAST` to `MOST`; placeholders 3 m."""
    return np.where(reliable, np.clip(3 * sigma, LEAST, MOST), 3.0)


def bring_together(
    faces: Sequence[Face], planes: np.ndarray, sigma: np.ndarray, reliable: np.ndarray, slope_cap: float = SLOPE_CAP
) -> Together:
    """Close the ridges, hips and valleys of a partition.

    `planes` (n, 3): z = a·x + b·y + c, metres from the partition's origin; `sigma` (n,): height σ (m), NaN unknown;
    `reliable` (n,): False for sections whose plane is a flat placeholder, which then follow their neighbours.
    """
    n = len(planes)
    sigma = np.where(np.isfinite(sigma), sigma, UNKNOWN)
    spare = tolerance(sigma, reliable)
    weight = np.where(reliable, 1 / np.maximum(sigma, 0.05) ** 2, FLAT_WEIGHT)
    owner = np.array([f.section for f in faces for ring in f.rings for _ in ring])
    xy = np.array([p for f in faces for ring in f.rings for p in ring], float) / MM
    centre = np.zeros((n, 2))
    count = np.maximum(np.bincount(owner, minlength=n), 1)
    for axis in (0, 1):
        centre[:, axis] = np.bincount(owner, xy[:, axis], minlength=n) / count
    at = np.c_[xy - centre[owner], np.ones(len(xy))]
    metric = np.tile(1e-6 * np.eye(3), (n, 1, 1))
    np.add.at(metric, owner, at[:, :, None] * at[:, None, :])
    factor = np.linalg.cholesky(metric * weight[:, None, None])
    unfactor = np.linalg.inv(factor)

    original = planes.astype(float).copy()
    original[:, 2] += (planes[:, :2] * centre).sum(axis=1)

    def to_planes(y: np.ndarray) -> np.ndarray:
        return np.einsum("nji,nj->ni", unfactor, y.reshape(n, 3))

    def equation(f: int, g: int, vertex: Point) -> np.ndarray:
        row = np.zeros((n, 3))
        where = np.array(vertex, float) / MM
        row[f] += unfactor[f] @ (*(where - centre[f]), 1.0)
        row[g] -= unfactor[g] @ (*(where - centre[g]), 1.0)
        return row.ravel()

    def acceptable(x: np.ndarray) -> bool:
        lift = np.abs((at * (x - original)[owner]).sum(axis=1))
        steep = np.hypot(x[:, 0], x[:, 1]) > np.maximum(
            np.tan(np.radians(slope_cap)), np.hypot(*original[:, :2].T) + 1e-9
        )
        return bool((lift <= spare[owner] + 1e-9).all() and not steep.any())

    y = np.einsum("nij,ni->nj", factor, original).ravel()
    basis = np.empty((0, 3 * n))
    closed = steps = 0
    for f, g, ends in _agreements(faces, planes, sigma, reliable):
        directions = basis
        for vertex in ends:
            row = equation(f, g, vertex)
            length = np.linalg.norm(row)
            for _ in range(2):
                row = row - directions.T @ (directions @ row)
            rest = np.linalg.norm(row)
            if rest > 1e-7 * length:
                directions = np.vstack([directions, row / rest])
        new = directions[len(basis) :]
        moved = y - new.T @ (new @ y)
        if acceptable(to_planes(moved)):
            y, basis = moved, directions
            closed += len(ends) == 2
        else:
            steps += len(ends) == 2
    result = to_planes(y)
    result[:, 2] -= (result[:, :2] * centre).sum(axis=1)
    return Together(result, closed, steps)


def drawn_to_planes(faces: list[Face], planes: np.ndarray) -> list[Face]:
    """Faces whose shared vertices are moved toward where the planes that meet there have one height.

    Meant for outlines that were found no better than `PLACE`: a ridge seen half a metre beside its place is put where its two
    planes cross, instead of bending the planes. On the building's outline a vertex moves along a straight stretch
    only. Vertices at steps stay, and all do if the faces would no longer tile.
    """
    edges = directed_edges(faces)
    sections: dict[Point, set[int]] = defaultdict(set)
    rim: dict[Point, list[Point]] = defaultdict(list)
    for (u, v), f in edges.items():
        sections[u].add(faces[f].section)
        if (v, u) not in edges:
            rim[u].append(v)
            rim[v].append(u)
    moved: dict[Point, Point] = {}
    for point, meeting in sections.items():
        met = planes[sorted(meeting)]
        heights = met @ (point[0] / MM, point[1] / MM, 1.0)
        if len(met) < 2 or np.ptp(heights) > AGREE:
            continue
        ways = np.eye(2)
        if point in rim:
            there = np.subtract(rim[point], point) / np.hypot(*np.subtract(rim[point], point).T)[:, None]
            if (
                len(there) != 2 or there[0] @ there[1] > -0.94
            ):  # a corner of the building, or a point it touches itself in
                continue
            ways = ((there[1] - there[0]) / np.hypot(*(there[1] - there[0])))[:, None]
        tilt = (met[:, :2] - met[:, :2].mean(axis=0)) @ ways
        stiff = tilt.T @ tilt + (LEVELLED / PLACE) ** 2 * np.eye(tilt.shape[1])
        way = -ways @ np.linalg.solve(stiff, tilt.T @ (heights - heights.mean()))
        way *= min(1.0, FARTHEST / max(np.hypot(*way), 1e-9))
        moved[point] = (round(point[0] + way[0] * MM), round(point[1] + way[1] * MM))
    drawn = [Face(f.section, [[moved.get(p, p) for p in ring] for ring in f.rings]) for f in faces]
    return tidied(drawn) if is_coverage(drawn) else faces


def _agreements(
    faces: Sequence[Face], planes: np.ndarray, sigma: np.ndarray, reliable: np.ndarray
) -> list[tuple[int, int, tuple[Point, ...]]]:
    """Equations worth trying: shared edges whose planes agree at both ends, best first; then vertices.

    Each is (section, section, vertices at which they should have one height). Planes agree within 2.5 σ of their difference and
    what a misplaced edge makes of it; parallel ones, which would have to bend, only if they nearly coincide.
    """
    edges = directed_edges(faces)
    along, single = [], []
    for (u, v), k in edges.items():
        other = edges.get((v, u))
        if other is None or other < k:
            continue
        f, g = faces[k].section, faces[other].section
        if f == g:
            continue
        if not (reliable[f] and reliable[g]):
            reach = 3.0
        elif np.hypot(*(planes[f] - planes[g])[:2]) < PARALLEL:
            reach = COINCIDE
        else:
            reach = float(np.clip(2.5 * np.hypot(sigma[f], sigma[g]), 0.25, 1.2)) + MISPLACED
        apart = [abs(float((planes[f] - planes[g]) @ (p[0] / MM, p[1] / MM, 1.0))) for p in (u, v)]
        if max(apart) <= reach:
            along.append((round(max(apart) / reach, 9), f, g, (min(u, v), max(u, v))))
        single += [(round(a, 9), f, g, (p,)) for a, p in zip(apart, (u, v), strict=True) if a <= TOUCH]
    return [candidate[1:] for candidate in sorted(along) + sorted(single)]
