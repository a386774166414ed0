"""Roofs as exact geometry: sections, walls and what stands on them.

A **wing** is a convex footprint under the lower envelope of a few planes (gable 2, hip 4, mansard 5 …); a roof is the upper
envelope of its wings, so L, T, U and cross plans get true ridges, hips and valleys. All in a building's own frame: x along its
length, y across, metres, z above its base. Rings are counter-clockwise seen from above.

In: sizes, pitches, kinds. Out: rings (n, 3) of sections, walls, dormers, chimneys.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from shapely.geometry import Polygon
from shapely.ops import unary_union

Ring2 = list[tuple[float, float]]
Slope = tuple[float, float, float]  # z = a x + b y + c

TINY = 0.02  # m²: slivers of rounding are not sections


class Wing(NamedTuple):
    """A convex footprint (counter-clockwise) and the planes whose lower envelope covers it."""

    footprint: Ring2
    planes: tuple[Slope, ...]


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Ring2:
    """A rectangle, counter-clockwise."""
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def clip(ring: Ring2, a: float, b: float, c: float) -> Ring2:
    """The part of a convex ring where a x + b y + c ≥ 0."""
    kept: Ring2 = []
    if not ring:
        return kept
    previous = ring[-1]
    before = a * previous[0] + b * previous[1] + c
    for point in ring:
        here = a * point[0] + b * point[1] + c
        if (here > 1e-9 and before < -1e-9) or (here < -1e-9 and before > 1e-9):
            t = before / (before - here)
            kept.append((previous[0] + t * (point[0] - previous[0]), previous[1] + t * (point[1] - previous[1])))
        if here >= -1e-9:
            kept.append(point)
        previous, before = point, here
    return kept


def area(ring: Ring2) -> float:
    """Signed area in m²."""
    total = 0.0
    for (x0, y0), (x1, y1) in zip(ring, ring[1:] + ring[:1], strict=True):
        total += x0 * y1 - x1 * y0
    return total / 2


def envelope(wing: Wing) -> list[tuple[Slope, Ring2]]:
    """The cells of one wing: for each plane the convex part of the footprint where it is the lowest."""
    cells = []
    for i, (a, b, c) in enumerate(wing.planes):
        ring = wing.footprint
        for j, (p, q, r) in enumerate(wing.planes):
            if j != i and ring:
                ring = clip(ring, p - a, q - b, r - c)
        ring = _simple(ring)
        if len(ring) > 2 and area(ring) > TINY:
            cells.append(((a, b, c), ring))
    return cells


def _lift(slope: Slope, points: Ring2) -> np.ndarray:
    ring = np.array(points, float)
    return np.column_stack([ring, ring @ slope[:2] + slope[2]])


def _simple(points: Ring2) -> Ring2:
    """A counter-clockwise ring without repeated points (1 µm) and points on straight lines."""
    apart = []
    for i, (x, y) in enumerate(points):
        if abs(x - points[i - 1][0]) + abs(y - points[i - 1][1]) > 1e-6:
            apart.append((x, y))
    if area(apart) < 0:
        apart.reverse()
    kept = []
    for i, (x, y) in enumerate(apart):
        (px, py), (nx, ny) = apart[i - 1], apart[(i + 1) % len(apart)]
        cross = (x - px) * (ny - y) - (y - py) * (nx - x)
        if abs(cross) > 1e-6 * (abs(nx - px) + abs(ny - py)):
            kept.append((x, y))
    return kept


def _same(p: Slope, q: Slope) -> bool:
    return abs(p[0] - q[0]) + abs(p[1] - q[1]) + abs(p[2] - q[2]) < 1e-6


def sections(wings: list[Wing]) -> list[np.ndarray]:
    """The sections of a roof: exact polygons (n, 3) that partition the union of the footprints.

    Where wings overlap the higher one shows; cells of one plane that touch are one section. Two wings of one plane's
    height tie for the earlier one.
    """
    if len(wings) == 1:
        return [_lift(slope, ring) for slope, ring in envelope(wings[0])]
    pieces: list[tuple[Slope, Polygon]] = []
    for i, wing in enumerate(wings):
        for slope, ring in envelope(wing):
            shape = Polygon(ring)
            for j, other in enumerate(wings):
                if j == i:
                    continue
                above = other.footprint
                for p, q, r in other.planes:
                    if _same((p, q, r), slope):
                        above = above if j < i else []
                    elif above:
                        above = clip(above, p - slope[0], q - slope[1], r - slope[2])
                if len(above) > 2 and area(above) > 1e-6:
                    shape = shape.difference(Polygon(above))
            pieces.append((slope, shape))
    merged: list[tuple[Slope, list[Polygon]]] = []
    for slope, shape in pieces:
        for known, shapes in merged:
            if _same(known, slope):
                shapes.append(shape)
                break
        else:
            merged.append((slope, [shape]))
    found = []
    for slope, shapes in merged:
        whole = shapes[0] if len(shapes) == 1 else unary_union(shapes)
        for part in getattr(whole, "geoms", [whole]):
            if part.geom_type == "Polygon" and part.area > TINY:
                ring = _simple(list(part.exterior.coords)[:-1])
                if len(ring) > 2:
                    found.append(_lift(slope, ring))
    return found


KINDS = ("gable", "hip", "half_hip", "pyramid", "shed", "flat", "mansard", "gambrel", "one_hip", "skew_gable")


def wing(
    kind: str,
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    eave: float,
    pitch: float,
    along_x: bool = True,
    share: float = 0.5,
) -> Wing:
    """One wing of a kind over a rectangle: eave height (m), pitch (rise per m); ridge along x, or along y.

    `share` is what it is for the kind: the height at which a half-hip starts, where a skew gable's ridge lies, where a
    gambrel or mansard breaks (shares of the half width).
    """
    if not along_x:
        turned = wing(kind, y0, x0, y1, x1, eave, pitch, True, share)
        return Wing([(y, x) for x, y in reversed(turned.footprint)], tuple((b, a, c) for a, b, c in turned.planes))
    half = (y1 - y0) / 2
    south, north = (0.0, pitch, eave - pitch * y0), (0.0, -pitch, eave + pitch * y1)
    west, east = (pitch, 0.0, eave - pitch * x0), (-pitch, 0.0, eave + pitch * x1)
    footprint = rectangle(x0, y0, x1, y1)
    if kind == "flat":
        return Wing(footprint, ((0.0, 0.0, eave),))
    if kind == "shed":
        return Wing(footprint, (south,))
    if kind == "gable":
        return Wing(footprint, (south, north))
    if kind == "one_hip":
        return Wing(footprint, (south, north, west))
    if kind == "half_hip":
        lift = share * pitch * half
        steep = 1.2 * pitch
        ends = (steep, 0.0, eave + lift - steep * x0), (-steep, 0.0, eave + lift + steep * x1)
        return Wing(footprint, (south, north, *ends))
    if kind == "skew_gable":
        # Both eaves at one height, the ridge off the middle.
        ridge = y0 + (0.3 + 0.4 * share) * 2 * half
        rise = pitch * half
        a, b = rise / (ridge - y0), rise / (y1 - ridge)
        return Wing(footprint, ((0.0, a, eave - a * y0), (0.0, -b, eave + b * y1)))
    if kind == "pyramid":
        steep = pitch * half / ((x1 - x0) / 2)
        return Wing(footprint, (south, north, (steep, 0.0, eave - steep * x0), (-steep, 0.0, eave + steep * x1)))
    if kind == "gambrel":
        low = 2.2 * pitch
        lift = (low - 0.6 * pitch) * share * half
        lower = (0.0, low, eave - low * y0), (0.0, -low, eave + low * y1)
        upper = (0.0, 0.6 * pitch, eave + lift - 0.6 * pitch * y0), (0.0, -0.6 * pitch, eave + lift + 0.6 * pitch * y1)
        return Wing(footprint, (*lower, *upper))
    if kind == "mansard":
        return Wing(footprint, (south, north, west, east, (0.0, 0.0, eave + pitch * half * share)))
    return Wing(footprint, (south, north, west, east))


def walls(rings: list[np.ndarray], overhang: float = 0.0) -> list[np.ndarray]:
    """Walls under every section edge that is not a ridge, hip or valley: vertical quads down to z = 0.

    With an `overhang` (m) the walls stand back from the outline by it. Quads run (foot a, foot b, top b, top a) with the
    building on the left, so their normals point outwards.
    """
    known: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
    for ring in rings:
        keys = [tuple(p) for p in np.round(ring * 200).astype(int).tolist()]
        for i, key in enumerate(keys):
            following = (i + 1) % len(ring)
            twin = (keys[following], key)
            if twin in known:
                del known[twin]
            else:
                known[(key, keys[following])] = (ring[i], ring[following])
    edges = [(a, b) for a, b in known.values() if abs(a[0] - b[0]) + abs(a[1] - b[1]) > 0.01]
    if overhang > 0:
        edges = _set_back(edges, overhang)
    return [np.array([[a[0], a[1], 0.0], [b[0], b[1], 0.0], b, a]) for a, b in edges]


def _set_back(edges: list[tuple[np.ndarray, np.ndarray]], overhang: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Outline edges moved inwards by `overhang`, mitred; left where they are if the outline branches."""
    starts: dict[tuple, int] = {}
    ends: dict[tuple, int] = {}
    inward = []
    for i, (a, b) in enumerate(edges):
        s, e = (round(a[0] * 200), round(a[1] * 200)), (round(b[0] * 200), round(b[1] * 200))
        if s in starts or e in ends:
            return edges
        starts[s], ends[e] = i, i
        d = b[:2] - a[:2]
        inward.append(np.array([-d[1], d[0]]) / np.hypot(*d))
    moved = []
    for i, (a, b) in enumerate(edges):
        ring = []
        for point, table in ((a, ends), (b, starts)):
            other = table.get((round(point[0] * 200), round(point[1] * 200)), i)
            n, m = inward[i], inward[other]
            shift = overhang * (n + m) / max(1.0 + float(n @ m), 0.2)
            ring.append(np.array([point[0] + shift[0], point[1] + shift[1], point[2] - 0.1]))
        moved.append((ring[0], ring[1]))
    return moved


class Frame(NamedTuple):
    """A section's own axes: `origin` on its eave, `along` the eave and `up` the slope (horizontal units), `rise` m/m."""

    origin: np.ndarray
    along: np.ndarray
    up: np.ndarray
    rise: float
    ring: np.ndarray  # (n, 2): along, up

    def point(self, u: float, v: float, lift: float = 0.0) -> list[float]:
        """The point `u` m along and `v` m (horizontally) up the slope, `lift` m above the roof."""
        x_y = self.origin[:2] + u * self.along + v * self.up
        return [x_y[0], x_y[1], self.origin[2] + v * self.rise + lift]

    def holds(self, u0: float, v0: float, u1: float, v1: float) -> bool:
        """Whether a rectangle lies in the (convex) section."""
        ring = self.ring
        edge = np.concatenate([ring[1:], ring[:1]]) - ring
        corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
        d = corners[:, None] - ring[None]
        return bool((edge[None, :, 0] * d[..., 1] - edge[None, :, 1] * d[..., 0] >= -1e-6).all())


def frame_of(ring: np.ndarray) -> Frame:
    """Axes of a section; of a flat one, along its longest edge."""
    x, y, z = (ring - ring[0]).T
    after = np.arange(1, len(ring) + 1)
    after[-1] = 0
    x1, y1, z1 = x[after], y[after], z[after]
    up = float((x * y1 - y * x1).sum())
    gradient = np.array([-(y * z1 - z * y1).sum() / up, -(z * x1 - x * z1).sum() / up])
    rise = float(np.hypot(*gradient))
    if rise > 1e-3:
        up = gradient / rise
    else:
        edges = ring[after, :2] - ring[:, :2]
        longest = edges[np.argmax((edges**2).sum(1))]
        up, rise = np.array([-longest[1], longest[0]]) / np.hypot(*longest), 0.0
    along = np.array([up[1], -up[0]])
    flat = np.column_stack([ring[:, :2] @ along, ring[:, :2] @ up])
    start = flat.min(0)
    corner = along * start[0] + up * start[1]
    z = ring[0, 2] + (start[1] - flat[0, 1]) * rise
    return Frame(np.array([corner[0], corner[1], z]), along, up, rise, flat - start)


def box(x0: float, y0: float, x1: float, y1: float, low: float, high: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """An upright box: its top and its four sides."""
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)
    return prism(ring, low, high)


def prism(ring: np.ndarray, low: float, high: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """An upright prism over a counter-clockwise ring (n, 2): its top and its sides."""
    top = np.column_stack([ring, np.full(len(ring), high)])
    foot = np.column_stack([ring, np.full(len(ring), low)])
    after = np.roll(np.arange(len(ring)), -1)
    return top, [np.array([foot[i], foot[j], top[j], top[i]]) for i, j in enumerate(after)]


def dome(rim: np.ndarray, rise: float, rings: int = 4) -> list[np.ndarray]:
    """A round lid over a level, counter-clockwise rim (n, 3): a spherical cap `rise` m high in `rings` rings of faces, the last
    of triangles; a cone for one."""
    middle = rim.mean(axis=0)
    radius = np.hypot(*(rim[0] - middle)[:2])
    sphere = (radius**2 + rise**2) / (2 * rise)
    lids, low = [], rim
    for i in range(1, rings + 1):
        share = 1 - i / rings
        up = np.sqrt(sphere**2 - (share * radius) ** 2) - (sphere - rise)
        high = middle + (rim - middle) * [share, share, 0.0] + [0.0, 0.0, up]
        after = zip(low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high, strict=True)
        lids += [np.array([a, b, d] if i == rings else [a, b, c, d]) for a, b, c, d in after]
        low = high
    return lids


def slab(axes: Frame, u0: float, v0: float, u1: float, v1: float, lift: float) -> np.ndarray:
    """A thin rectangle parallel to the roof (skylight, solar panel)."""
    return np.array(
        [axes.point(u0, v0, lift), axes.point(u1, v0, lift), axes.point(u1, v1, lift), axes.point(u0, v1, lift)]
    )


def dormer(
    axes: Frame, u: float, v: float, width: float, height: float, gable: bool
) -> tuple[list[np.ndarray], list[np.ndarray]] | None:
    """A dormer whose front stands at (u, v): roof faces and walls; None where the slope does not hold it."""
    slack = axes.rise * 0.12
    depth = height / max(axes.rise - slack, 0.1)
    if not axes.holds(u - width / 2 - 0.3, v - 0.2, u + width / 2 + 0.3, v + depth + 0.3):
        return None
    left, right = u - width / 2, u + width / 2
    a, b = axes.point(left, v), axes.point(right, v)
    c, d = axes.point(right, v, height), axes.point(left, v, height)
    if gable:
        top = height + 0.35 * width
        long = top / axes.rise
        if not axes.holds(u - 0.1, v, u + 0.1, v + long):
            return None
        flat = height / axes.rise
        ridge, ridge_back = axes.point(u, v, top), axes.point(u, v + long)
        e, f = axes.point(left, v + flat), axes.point(right, v + flat)
        roof = [np.array([d, ridge, ridge_back, e])[::-1], np.array([c, ridge, ridge_back, f])]
        side = [np.array([a, b, c, ridge, d]), np.array([b, f, c]), np.array([e, a, d])]
        return roof, side
    e, f = axes.point(left, v + depth), axes.point(right, v + depth)
    return [np.array([d, c, f, e])], [np.array([a, b, c, d]), np.array([b, f, c]), np.array([e, a, d])]
