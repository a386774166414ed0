"""The roof partition of one building: sections that share their edges exactly, vertex for vertex.

In: one polygon per section (map frame, metres from the building's own origin) and the section's plane. Sections come from
independent fits and a shift along the view ray by their own height, so neighbours overlap or gape by up to a metre.
Out: `faces.Face`s that tile the building without gap, overlap or sliver.

Sections that already fit (to `EXACT`) keep every vertex. Otherwise vertices that neighbours mean to share are brought together,
what is claimed twice goes to the higher roof (the lower one runs under it) or, at one height, to the smaller section, and what
nobody claims between sections goes to the neighbour with the longest edge on it, the lower one at a step: that roof is what
the higher one hid.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from math import hypot
from typing import NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

from kibs_steps.faces import MM, Face, NoPartition, Point, directed_edges, merged, polygon, rings_of

EXACT = 0.005  # m, sections that fit better than this are left alone
REACH = 1.0  # m, vertices and edges that neighbours mean to share may be this far apart
GAP = 1.5  # m
STEP = 0.6  # m, roofs this far apart in height are taken for two levels
SMALLEST = 0.5  # m², faces smaller than this are given to a neighbour
THIN = 0.3  # m, so are narrower ones


class Partition(NamedTuple):
    """The faces of a building; whether its sections fitted exactly as they came."""

    faces: list[Face]
    exact: bool


def partition(
    polygons: Sequence[shapely.Geometry],
    planes: np.ndarray,
    reliable: np.ndarray,
    gap: float = GAP,
    reach: float = REACH,
) -> Partition:
    """The faces of a building.

    `polygons`: n polygons (m, any validity); `planes`: (n, 3) coefficients of z = a·x + b·y + c in the same frame;
    `reliable`: (n,) bool, whose height can be trusted; `gap` (m): widest gap between neighbours that do not fit, `reach` (m): how
    far apart what they share may be. Raises `NoPartition`.
    """
    cleaned = [polygonal(p) for p in polygons]
    if all(p.is_empty for p in cleaned):
        raise NoPartition("no section has an area")
    faces, exact = _tile(cleaned, planes, reliable, EXACT, gap)
    if not exact:
        faces, _ = _tile(cleaned, planes, reliable, reach, gap)
    if not faces:
        raise NoPartition("no section is wide enough to stand")
    return Partition(faces, exact)


def polygonal(geometry: shapely.Geometry | None) -> shapely.Geometry:
    """The valid polygonal part of a geometry, in plan, on the millimetre grid; possibly empty."""
    if geometry is None:
        return shapely.Polygon()
    flat = shapely.force_2d(geometry)
    if not np.isfinite(shapely.get_coordinates(flat)).all():
        return shapely.Polygon()
    if not flat.is_valid:
        flat = shapely.make_valid(flat, method="structure", keep_collapsed=False)
    parts = [p for p in shapely.get_parts(flat) if p.geom_type == "Polygon" and not p.is_empty]
    return shapely.set_precision(shapely.union_all(parts), 1 / MM) if parts else shapely.Polygon()


def _tile(
    polygons: list[shapely.Geometry], planes: np.ndarray, reliable: np.ndarray, reach: float, gap: float
) -> tuple[list[Face], bool]:
    """Faces from sections whose vertices are brought together within `reach`; whether nothing narrower than `gap` misfitted."""
    together = [polygonal(p) for p in _snapped(polygons, planes, reliable, reach)]
    slits = _slits(together, gap)
    lines = shapely.unary_union(shapely.boundary([*together, *slits]), grid_size=1 / MM)
    cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(lines)))
    if not len(cells):
        return [], True
    cells = shapely.orient_polygons(shapely.normalize(cells))
    cells = cells[np.lexsort(shapely.bounds(cells).T)]
    inner = shapely.point_on_surface(cells)
    xy = shapely.get_coordinates(inner)
    claims: list[list[int]] = [[] for _ in cells]
    for k, section in zip(*shapely.STRtree(np.array(together, object)).query(inner, predicate="within"), strict=True):
        claims[k].append(int(section))
    in_slit = np.zeros(len(cells), bool)
    if len(slits):
        in_slit[shapely.STRtree(slits).query(inner, predicate="within")[0]] = True
    narrow = shapely.is_empty(shapely.buffer(cells, -gap / 2, quad_segs=1)) & (shapely.area(cells) > 1e-12)
    size = shapely.area(together)

    def heights(k: int) -> dict[int, float]:
        return {s: float(planes[s] @ (*xy[k], 1.0)) for s in claims[k]}

    labels: list[int | None] = []
    for k, claim in enumerate(claims):
        if len(claim) > 1:
            trusted = [s for s in claim if reliable[s]] or claim
            z = heights(k)
            top = max(z[s] for s in trusted)
            labels.append(min((s for s in trusted if z[s] > top - STEP), key=lambda s: (size[s], s)))
        else:
            labels.append(claim[0] if claim else None)
    misfit = (np.array([len(c) for c in claims]) != 1) & (narrow | in_slit)
    visible = misfit & ~shapely.is_empty(shapely.buffer(cells, -EXACT, quad_segs=1))
    faces = [Face(k, rings_of(cell)) for k, cell in enumerate(cells)]
    gaps = {k for k in np.flatnonzero(misfit) if labels[k] is None}
    labels = _give_away(faces, labels, gaps, lambda k, s: float(planes[s] @ (*xy[k], 1.0)))
    faces = merged(faces, lambda f: labels[f])
    return _without_slivers(faces, 2 * EXACT if reach == EXACT else THIN), not visible.any()


def _slits(polygons: list[shapely.Geometry], width: float) -> np.ndarray:
    """Strips narrower than `width` between different sections that are open to the outside at an end."""
    roof = shapely.union_all(polygons)
    closed = shapely.buffer(shapely.buffer(roof, width / 2, join_style="mitre"), -width / 2, join_style="mitre")
    strips = shapely.get_parts(shapely.set_precision(shapely.difference(closed, roof), 1 / MM))
    strips = strips[(shapely.get_type_id(strips) == 3) & (shapely.area(strips) > 0.02)]
    if not len(strips):
        return strips
    near = shapely.STRtree(np.array(polygons, object)).query(strips, predicate="dwithin", distance=1.5 / MM)[0]
    return strips[np.bincount(near, minlength=len(strips)) > 1]


def _give_away(
    faces: list[Face], labels: list[int | None], gaps: set[int], height: Callable[[int, int], float]
) -> list[int | None]:
    """Label each gap as the labelled neighbour with the longest edge on it; at a step between long ones, the lowest."""
    edges = directed_edges(faces)
    labels = list(labels)
    waiting = sorted(gaps)
    while waiting:
        left = []
        for k in waiting:
            shared = _shared_lengths(faces[k], labels, edges)
            if not shared:
                left.append(k)
                continue
            longest = max(shared.values())
            likely = [s for s, length in shared.items() if length > longest / 2]
            lowest = min(height(k, s) for s in likely)
            labels[k] = max((s for s in likely if height(k, s) < lowest + STEP), key=lambda s: (shared[s], -s))
        if len(left) == len(waiting):
            break
        waiting = left
    return labels


def _shared_lengths(
    face: Face, labels: Sequence[int | None], edges: dict[tuple[Point, Point], int]
) -> dict[int, float]:
    """Length (mm) of a face's edge with each label round it."""
    shared: dict[int, float] = defaultdict(float)
    for ring in face.rings:
        for u, v in zip(ring, [*ring[1:], ring[0]], strict=True):
            other = edges.get((v, u))
            if other is not None and labels[other] is not None:
                shared[labels[other]] += hypot(v[0] - u[0], v[1] - u[1])
    return shared


def _without_slivers(faces: list[Face], width: float) -> list[Face]:
    """Give faces too small or narrower than `width` (m) to the neighbour with the longest shared edge; drop lonely ones."""
    while True:
        shapes = [polygon(f) for f in faces]
        thin = shapely.is_empty(shapely.buffer(shapes, -width / 2, quad_segs=1))
        small = [k for k in range(len(faces)) if thin[k] or (shapes[k].area < SMALLEST and width > 2 * EXACT)]
        if not small:
            return faces
        k = min(small, key=lambda k: (shapes[k].area, k))
        shared = _shared_lengths(faces[k], range(len(faces)), directed_edges(faces))
        shared.pop(k, None)
        target = max(shared, key=lambda g: (shared[g], -g)) if shared else None
        sections = [f.section for f in faces]
        joined = merged(faces, lambda f, k=k, target=target: target if f == k else f)
        faces = [Face(sections[f.section], f.rings) for f in joined]
        if not faces:
            return faces


class _Clusters:
    """Vertices brought together: each cluster holds at most one vertex of a section and stays within a diameter."""

    def __init__(self, xy: np.ndarray, section: np.ndarray, diameter: float) -> None:
        self.xy, self.section, self.diameter = xy, section, diameter
        self.of = list(range(len(xy)))
        self.members = {k: [k] for k in range(len(xy))}

    def join(self, a: int, b: int) -> None:
        """Join the clusters of two vertices if the rules allow it."""
        a, b = sorted((self.of[a], self.of[b]))
        if a == b:
            return
        both = self.members[a] + self.members[b]
        if len({int(self.section[k]) for k in both}) < len(both) or np.ptp(self.xy[both], axis=0).max() > self.diameter:
            return
        self.members[a] = both
        for k in self.members.pop(b):
            self.of[k] = a


def _snapped(
    polygons: list[shapely.Geometry], planes: np.ndarray, reliable: np.ndarray, reach: float
) -> list[shapely.Geometry]:
    """Sections with the vertices and edges they share brought together within `reach` (m)."""
    parts, part_section = shapely.get_parts(np.array(polygons, object), return_index=True)
    there = ~shapely.is_empty(parts)  # a section without area is a part without rings
    parts, part_section = parts[there], part_section[there]
    rings, ring_part = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    last = np.r_[np.diff(ring) != 0, True]
    xy, ring = xy[~last], ring[~last]
    section = part_section[ring_part[ring]]
    clusters = _Clusters(xy, section, reach)
    pairs = cKDTree(xy).query_pairs(reach, output_type="ndarray")
    pairs = pairs[section[pairs[:, 0]] != section[pairs[:, 1]]]
    length = np.hypot(*(xy[pairs[:, 0]] - xy[pairs[:, 1]]).T)
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0], length.round(6)))]:
        clusters.join(a, b)

    z = (planes[section] * np.c_[xy, np.ones(len(xy))]).sum(axis=1)
    names = sorted(clusters.members)
    moved = xy.copy()
    centres = np.empty((len(names), 2))
    for n, name in enumerate(names):
        members = np.array(clusters.members[name])
        trusted = members[reliable[section[members]]]
        trusted = trusted if len(trusted) else members
        high = trusted[z[trusted] > z[trusted].max() - STEP]
        centres[n] = moved[members] = xy[high].mean(axis=0)
    inserted = _meeting_points(
        polygons, moved, ring, section, centres, [set(section[clusters.members[n]]) for n in names], reach
    )

    new = []
    for r in range(len(rings)):
        path = []
        for k in np.flatnonzero(ring == r):
            path += [moved[k], *inserted.get(int(k), ())]
        path = [p for k, p in enumerate(path) if np.any(p != path[k - 1])]
        new.append(path)
    sections: list[list[shapely.Polygon]] = [[] for _ in polygons]
    for p in range(len(parts)):
        exterior, *holes = [new[r] for r in np.flatnonzero(ring_part == p)]
        if len(exterior) >= 3:
            sections[part_section[p]].append(shapely.Polygon(exterior, [h for h in holes if len(h) >= 3]))
    return [shapely.MultiPolygon(s) if s else shapely.Polygon() for s in sections]


def _meeting_points(
    polygons: list[shapely.Geometry],
    xy: np.ndarray,
    ring: np.ndarray,
    section: np.ndarray,
    centres: np.ndarray,
    sections_at: list[set[int]],
    reach: float,
) -> dict[int, list[np.ndarray]]:
    """Vertices of neighbours that an edge should pass through: edge (by its first vertex) → points in order along it.

    A vertex is taken only if the way from it to the edge runs through a gap (no section) or an overlap (both sections):
    otherwise it is the far side of something narrow.
    """
    after = np.arange(len(xy)) + 1
    firsts = np.flatnonzero(np.r_[True, np.diff(ring) != 0])
    after[np.r_[firsts[1:], len(xy)] - 1] = firsts
    edges = shapely.linestrings(np.stack([xy, xy[after]], axis=1))
    e, c = shapely.STRtree(shapely.points(centres)).query(edges, predicate="dwithin", distance=reach)
    keep = np.array([section[i] not in sections_at[j] for i, j in zip(e, c, strict=True)], bool)
    e, c = e[keep], c[keep]
    if not len(e):
        return {}
    along = xy[after[e]] - xy[e]
    length = np.hypot(*along.T)
    t = ((centres[c] - xy[e]) * along).sum(axis=1) / np.maximum(length, 1e-9) ** 2
    foot = xy[e] + t[:, None] * along
    keep = (t * length > 1 / MM) & ((1 - t) * length > 1 / MM)
    if reach > EXACT:
        middle = (foot + centres[c]) / 2
        inside = shapely.contains_xy(np.array(polygons, object)[None, :], middle[:, :1], middle[:, 1:])
        own = inside[np.arange(len(e)), section[e]]
        theirs = np.array([inside[k, sorted(sections_at[j])].any() for k, j in enumerate(c)], bool)
        keep &= (own == theirs) & (own | ~inside.any(axis=1))
    points: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for i, j, at in zip(e[keep], c[keep], t[keep], strict=True):
        points[int(i)].append((float(at), int(j)))
    return {i: [centres[j] for _, j in sorted(found)] for i, found in points.items()}
