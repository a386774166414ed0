"""Planes: a plane for every section from its corners, fitted in the map frame.

An off-nadir image shears roofs (at 59.3° elevation a 40° slope looks 29° steep where it faces the satellite, 59° where it
faces away), so corners are first moved to where they stand (PAPER, off-nadir geometry), then filed to sections, then fitted.

Two rules. `paper`: the three corners of the largest triangle; a triangle under 20 % or over 200 % of the section's area is
not trusted; two corners or one give a flat plane at their mean height, none the model's mean height. `robust` (default):
least squares over all corners and the cells of the model's height map (`heightmap`), weighted by 1/σ², outliers by Tukey's
biweight, with a weak prior on the slope so that corners in a row leave the plane level across that row. Every section keeps a
**status** with its reason.

In: stitched sections and corners, DTM, view. Out: `planes.parquet`, `filed_corners.parquet`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, heightmap, scene, store, view
from kibs_steps.grid import neighbours
from kibs_steps.view import Plane

SHARED = 2.0  # px: a corner on a ridge or eave belongs to every section whose rim is as near, up to this
SLOPE_PRIOR = 0.7  # standard deviation of a roof's gradient per axis: 35° is ordinary, 60° is rare
SIGMA_FLOOR = 0.1  # m: no roof is flatter than that
TUKEY = 4.0  # residuals beyond 4 σ do not count
COMMON = 0.7  # share of the height map's σ that all of a section has in common
ENOUGH = 2  # cells of the height map that give a section its plane without corners
MOST_STARTS = 12  # points whose triples are tried: 220 planes
MAX_SLOPE = 72.0  # deg, in the map frame
MAX_STRETCH = 20.0  # times its area as seen, at most, is a section's area as it stands: beyond, it is seen edge-on
MIN_HEIGHT = 0.3  # m above ground: lower, and it is no roof
MAX_HEIGHT = 200.0  # m above ground: taller than any building of a city without high-rises is a mistake
DEEPEST = -10.0  # m: no part of a roof is so far below the ground at its middle
MIN_AREA = 12.0  # px: smaller areas are specks, not roofs
TRIANGLE = (0.2, 2.0)  # share of the section's area between which its triangle is trusted (PAPER, planes)

PLANE_FIELDS = [("plane_a", pa.float64()), ("plane_b", pa.float64()), ("plane_c", pa.float64())]
PLANE_FIELDS += [("x0", pa.float64()), ("y0", pa.float64()), ("height_sigma", pa.float64()), ("n_corners", pa.int64())]
PLANE_FIELDS += [("status", pa.string()), ("status_reason", pa.string())]


class Points(NamedTuple):
    """Corners where they are seen, col, row (px), and where they stand, x, y, z (map, m); height above ground, σ (m)."""

    col: np.ndarray
    row: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    height: np.ndarray
    sigma: np.ndarray

    def take(self, index: np.ndarray) -> Points:
        """The chosen points."""
        return Points(*(column[index] for column in self))

    def joined(self, other: Points) -> Points:
        """These points, then the others."""
        return Points(*map(np.concatenate, zip(self, other, strict=True)))


class Cells(NamedTuple):
    """What the height map says of a section: points that fix its plane (`heightmap.points`), number of cells, their σ (m)."""

    points: Points
    n: float
    sigma: float


NO_CELLS = Cells(Points(*np.zeros((7, 0))), 0.0, 0.0)


class Rim(NamedTuple):
    """A section's outline where it is seen (n, 2; image map frame, m), the height the image was projected on there (m), and
    the lean of the view (2,)."""

    seen: np.ndarray
    base: np.ndarray
    lean: np.ndarray

    def heights(self, plane: Plane) -> np.ndarray:
        """Lowest and highest absolute height (m) of the outline on a plane that faces the view."""
        _, z = view.ray_meets_plane(self.seen, plane, self.lean, lambda _: self.base)
        return np.array([z.min(), z.max()])


class Fit(NamedTuple):
    """A plane, the σ of its height at the section's middle (m), a status and its reason."""

    plane: Plane
    sigma: float
    status: str
    reason: str


def file_corners(
    outlines: np.ndarray,
    corners: np.ndarray,
    owner: np.ndarray,
    owners: np.ndarray,
    reach: float,
    shared: float,
    others: Sequence[shapely.Geometry] = (),
):
    """Which corners belong to which section: arrays (section index, corner index), sorted.

    A corner goes to the sections whose rim is nearest: within `reach` px, and within `shared` px of the nearest one, so
    neighbours on a ridge both get it and a section further off does not (0 gives it to the nearest alone, which several are
    that meet in one rim). `corners` (n, 2) px. Corners with an owner go to the section of that owner alone. `others` are
    outlines of sections that are not asked about here, but may be nearer.
    """
    if not len(outlines) or not len(corners):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    points = shapely.points(corners)
    free = np.flatnonzero(owner == 0)
    rims = shapely.boundary(np.concatenate([outlines, np.array(others, object)]))
    tree = shapely.STRtree(rims)
    corner, section = tree.query(points[free], predicate="dwithin", distance=reach)
    corner = free[corner]
    distance = shapely.distance(points[corner], rims[section])
    nearest = np.full(len(corners), np.inf)
    np.minimum.at(nearest, corner, distance)
    keep = (distance <= nearest[corner] + shared) & (section < len(outlines))
    corner, section = corner[keep], section[keep]
    at = {int(o): i for i, o in enumerate(owners) if o}
    owned = np.array([(at[int(o)], i) for i, o in enumerate(owner) if o and int(o) in at], np.int64).reshape(-1, 2)
    section, corner = np.r_[section, owned[:, 0]], np.r_[corner, owned[:, 1]]
    order = np.lexsort((corner, section))
    return section[order], corner[order]


def flat(z: float, middle: np.ndarray) -> Plane:
    """A level plane."""
    return Plane(0.0, 0.0, float(z), float(middle[0]), float(middle[1]))


def robust_plane(points: Points, middle: np.ndarray) -> tuple[Plane, float]:
    """Least squares plane through points, and the σ of its height at `middle` (map, m).

    Weights 1/σ² and a gradient prior N(0, `SLOPE_PRIOR`²). Starts from the best of all planes through three points (a few
    points with one wild among them mislead every average), then Tukey's biweight.
    """
    sigma = np.maximum(points.sigma, SIGMA_FLOOR)
    design = np.column_stack([points.x - middle[0], points.y - middle[1], np.ones(len(sigma))])
    prior = np.diag([SLOPE_PRIOR**-2, SLOPE_PRIOR**-2, 0.0])

    def solve(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        normal = design.T @ (weight[:, None] * design) + prior
        return normal, np.linalg.solve(normal, design.T @ (weight * points.z))

    sharpest = np.sort(np.argsort(sigma, kind="stable")[:MOST_STARTS])
    triples = np.array(list(combinations(sharpest.tolist(), 3)))
    a = design[triples]
    w = sigma[triples] ** -2.0
    normals = np.einsum("tni,tn,tnj->tij", a, w, a) + prior
    starts = np.linalg.solve(normals, np.einsum("tni,tn,tn->ti", a, w, points.z[triples])[..., None])[..., 0]
    starts = np.vstack([solve(sigma**-2.0)[1], starts])
    residuals = np.abs(points.z - starts @ design.T) / sigma
    steepness = ((starts[:, :2] / SLOPE_PRIOR) ** 2).sum(axis=1)
    solution = starts[np.argmin((np.minimum(residuals, TUKEY) ** 2).sum(axis=1) + steepness)]
    for _ in range(8):
        residual = np.abs(points.z - design @ solution) / sigma
        scale = max(1.0, float(np.median(residual)) / 0.6745)
        robust = np.maximum((1 - np.minimum(residual / (TUKEY * scale), 1.0) ** 2) ** 2, 1e-6)
        normal, solution = solve(robust * sigma**-2.0)
    variance = np.linalg.inv(normal)[2, 2] * scale**2
    return Plane(*map(float, solution), float(middle[0]), float(middle[1])), float(np.sqrt(variance))


def largest_triangle(x: np.ndarray, y: np.ndarray) -> tuple[tuple[int, int, int], float]:
    """The three of n ≥ 3 points with the largest triangle, and its area; ties go to the first.

    Its corners lie on the convex hull, so only those are tried.
    """
    hull = np.arange(len(x))
    if len(x) > 8:
        from scipy.spatial import ConvexHull, QhullError

        try:
            hull = np.sort(ConvexHull(np.column_stack([x, y])).vertices)
        except QhullError:
            hull = np.arange(len(x))[:8]
    triples = np.array(list(combinations(hull.tolist(), 3)))
    a, b, c = triples.T
    area = np.abs((x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])) / 2
    best = int(np.argmax(area))
    return tuple(triples[best].tolist()), float(area[best])


def filed_heights(z1: float, z2: float, z3: float) -> tuple[float, float, float]:
    """The paper's filing of three heights z1 < z2 < z3: the middle one joins the nearer of the others at their mean.

    Equal heights are left as they are (PAPER, filing of heights).
    """
    if not z1 < z2 < z3:
        return z1, z2, z3
    if z2 < (z1 + z3) / 2:
        mean = (z1 + z2) / 2
        return mean, mean, z3
    mean = (z2 + z3) / 2
    return z1, mean, mean


def triangle_plane(points: Points, triple: tuple[int, int, int], middle: np.ndarray) -> Plane:
    """The plane through three points after `filed_heights` on their heights above ground."""
    index = np.array(triple)
    index = index[np.argsort(points.height[index], kind="stable")]
    ground = points.z[index] - points.height[index]
    z = ground + np.array(filed_heights(*points.height[index]))
    design = np.column_stack([points.x[index] - middle[0], points.y[index] - middle[1], np.ones(3)])
    return Plane(*map(float, np.linalg.solve(design, z)), float(middle[0]), float(middle[1]))


def fit(
    corners: Points,
    area: float,
    middle: np.ndarray,
    ground: float,
    fallback: tuple[float, float],
    rule: str,
    cells: Cells = NO_CELLS,
) -> Fit:
    """A section's plane from its corners and, by the rule `robust`, the cells of the height map.

    `area` px² of the section as seen, `middle` (2,) map m, `ground` DTM there (m), `fallback` the model's mean height and σ
    (m above ground), `rule` robust or paper.
    """
    n = len(corners.z)
    share = largest_triangle(corners.col, corners.row)[1] / max(area, 1e-9) if n > 2 else 0.0
    if rule == "robust" and cells.n:
        plane, sigma = robust_plane(corners.joined(cells.points), middle)
        sigma = max(sigma, COMMON * cells.sigma)
        if cells.n >= ENOUGH or share >= TRIANGLE[0]:
            return Fit(plane, sigma, "ok", "")
        status = ("no_corners", "one_corner", "two_corners", "degenerate_triangle")[min(n, 3)]
        return Fit(
            plane, sigma, status, f"{n} corners and {cells.n:.0f} cells of the height map are too few for a slope"
        )
    if n == 0:
        reason = f"no corner was found; the model's mean height {fallback[0]:.2f} m is used"
        return Fit(flat(ground + fallback[0], middle), fallback[1], "no_corners", reason)
    if n < 3:
        sigma = float(np.sqrt((np.maximum(corners.sigma, SIGMA_FLOOR) ** 2).sum()) / n)
        status = "one_corner" if n == 1 else "two_corners"
        reason = f"{'one corner gives' if n == 1 else 'two corners give'} a level plane at the mean height"
        return Fit(flat(ground + corners.height.mean(), middle), sigma, status, reason)
    plane, sigma = robust_plane(corners, middle)
    trusted = share >= TRIANGLE[0] and (share <= TRIANGLE[1] or rule == "robust")
    if rule == "paper":
        if not trusted:
            reason = f"largest triangle of corners is {share:.0%} of the section; level at the model's mean height"
            return Fit(flat(ground + fallback[0], middle), fallback[1], "degenerate_triangle", reason)
        try:
            plane = triangle_plane(corners, largest_triangle(corners.col, corners.row)[0], middle)
        except np.linalg.LinAlgError:
            reason = "its corners stand on one line; level at the model's mean height"
            return Fit(flat(ground + fallback[0], middle), fallback[1], "degenerate_triangle", reason)
    elif not trusted:
        reason = f"corners span {share:.0%} of the section: level across the direction they do not span"
        return Fit(plane, sigma, "degenerate_triangle", reason)
    return Fit(plane, sigma, "ok", "")


def implausible_slope(plane: Plane, lean: np.ndarray) -> str:
    """Why a plane is too steep for a roof that the satellite sees, empty if it is not; `lean` (2,) of the view."""
    slope = np.degrees(np.arctan(np.hypot(plane.a, plane.b)))
    if slope > MAX_SLOPE:
        return f"fitted slope {slope:.0f}° exceeds {MAX_SLOPE:.0f}°; made level"
    facing = 1.0 - (plane.a * lean[0] + plane.b * lean[1])
    if facing < 1.0 / MAX_STRETCH:
        how = "faces away from the view" if facing <= 0 else "would be seen edge-on"
        return f"a fitted slope of {slope:.0f}° in its direction {how}; made level"
    return ""


def checked(
    found: Fit,
    heights: np.ndarray,
    area_px: float,
    ground: float,
    middle: np.ndarray,
    rim: Rim,
    edge: bool,
    void: bool,
) -> Fit:
    """The fit with its plausibility: slope, height, size, place in the raster. What comes first in DESIGN's list gives way.

    `heights` (n,) are those its corners and cells have above ground (m), `area_px` its area as seen, `ground` the DTM (m) at its
    `middle` (map, m). An implausible slope is replaced by a level plane at the median of `heights`, and so is a plane that
    leaves the plausible heights at its rim; an implausible mean height by a level plane at the nearest plausible one. An absurd
    plane would move the outline along the view to where nothing stands.
    """
    typical = ground + (float(np.median(heights)) if len(heights) else 0.0)
    if reason := implausible_slope(found.plane, rim.lean):
        found = Fit(flat(typical, middle), found.sigma, "implausible_slope", reason)
    height = float(found.plane.at(middle)) - ground
    lowest, highest = rim.heights(found.plane) - ground
    if MIN_HEIGHT <= height <= MAX_HEIGHT and (lowest < DEEPEST or highest > MAX_HEIGHT):
        reason = f"fitted from {lowest:.0f} m to {highest:.0f} m above the ground; made level"
        found = Fit(flat(typical, middle), found.sigma, "implausible_height", reason)
        height = typical - ground
    if not MIN_HEIGHT <= height <= MAX_HEIGHT:
        near = float(np.clip(height, MIN_HEIGHT, MAX_HEIGHT))
        reason = f"mean height {height:.1f} m above ground; made level at {near:g} m"
        found = Fit(flat(ground + near, middle), found.sigma, "implausible_height", reason)
    if area_px < MIN_AREA:
        found = found._replace(status="too_small", reason=f"{area_px:.0f} px is too small to be trusted")
    if void:
        found = found._replace(
            status="cloud_or_nodata", reason="touches an area without data, or a tile burnt out (cloud, snow)"
        )
    if edge:
        found = found._replace(status="raster_edge", reason="cut by the raster's edge: its outline goes on outside")
    return found


def planes(
    sections: pa.Table,
    corners: pa.Table,
    facts: scene.Scene,
    dtm: view.Surface,
    fallback: tuple[float, float],
    reach: float,
    rule: str,
    others: Sequence[shapely.Geometry] = (),
) -> tuple[pa.Table, pa.Table]:
    """Sections with planes, and corners filed to them (one row per pair), both sorted by section.

    `reach` px; `fallback` (mean height, σ) m; `others` outlines (px) of sections round about, whose corners may lie near these.
    """
    outlines = shapely.from_wkb(sections["outline"].to_numpy(zero_copy_only=False))
    pixel = np.stack([corners["col"].to_numpy(), corners["row"].to_numpy()], axis=1)
    base = facts.projected_on(dtm)
    shared = SHARED if rule == "robust" else 0.0
    section, corner = file_corners(
        outlines, pixel, corners["owner"].to_numpy(), sections["owner"].to_numpy(), reach, shared, others
    )
    centre = middle_of(outlines, facts)
    lean = facts.leans(centre)
    sums = heightmap.column(sections["sums"])
    lift = heightmap.lifts(sums)
    pixel, height = pixel[corner], np.maximum(corners["height"].to_numpy()[corner] + lift[section], 0.0)
    sigma = corners["sigma"].to_numpy()[corner]
    known = [heightmap.points(row) for row in sums] if rule == "robust" else [np.zeros((0, 4))] * len(sums)
    cell = np.concatenate([np.zeros((0, 4)), *known])
    inside = np.repeat(np.arange(len(known)), [len(k) for k in known])

    def standing(pixel: np.ndarray, height: np.ndarray, sigma: np.ndarray, section: np.ndarray) -> Points:
        where, z = view.ground_position(facts.grid.to_map(pixel), height, dtm, lean[section], base)
        return Points(*pixel.T, *where.T, z, height, sigma)

    points = standing(pixel, height, sigma, section)
    cells = standing(cell[:, :2], cell[:, 2] + lift[inside], cell[:, 3], inside)
    count = np.arange(len(outlines) + 1)
    parts, shown = (
        [some.take(np.arange(first, end)) for first, end in pairwise(np.searchsorted(of, count))]
        for some, of in ((points, section), (cells, inside))
    )
    area_px = shapely.area(outlines)
    heights = [np.concatenate([p.height, c.height]) for p, c in zip(parts, shown, strict=True)]
    typical = np.array([np.median(h) if len(h) else fallback[0] for h in heights])
    middle, _ = view.ground_position(centre, typical, dtm, lean, base)
    ground = dtm(middle)
    edge, void = sections["edge"].to_pylist(), sections["void"].to_pylist()
    outline, of = shapely.get_coordinates(outlines, return_index=True)
    seen = facts.grid.to_map(outline)
    projected = base(seen)
    vertices = np.searchsorted(of, count)
    rows = []
    for i, mine in enumerate(parts):
        n = float(sums[i, heightmap.NUMBER]) if len(shown[i].z) else 0.0
        of_map = Cells(shown[i], n, float(sums[i, heightmap.SIGMA]) / max(n, 1.0))
        found = fit(mine, area_px[i], middle[i], ground[i], fallback, rule, of_map)
        own = slice(vertices[i], vertices[i + 1])
        rim = Rim(seen[own], projected[own], lean[i])
        found = checked(found, heights[i], area_px[i], float(ground[i]), middle[i], rim, edge[i], void[i])
        rows.append([*found.plane, found.sigma, len(mine.z), found.status, found.reason])
    table = sections.select(["section_id", "outline", "score", "split"])
    for k, (name, kind) in enumerate(PLANE_FIELDS):
        table = table.append_column(name, pa.array([row[k] for row in rows], kind))
    filed = pa.table(
        {
            "section_id": sections["section_id"].to_numpy()[section],
            "x": points.x,
            "y": points.y,
            "z": points.z,
            "col": points.col,
            "row": points.row,
            "height": points.height,
            "sigma": points.sigma,
            "score": corners["score"].to_numpy()[corner],
        }
    )
    return table, filed


def main(argv: list[str] | None = None) -> None:
    """Fit a plane to every section of one block."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.planes", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--sections", required=True, help="stitched/sections.parquet")
    parser.add_argument("--corners", required=True, help="stitched/corners.parquet")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--model", required=True, help="models/corners.json: mean height where no corner is found")
    parser.add_argument("--reach", type=float, required=True, help="how far corners may lie from their section, px")
    parser.add_argument("--rule", choices=["robust", "paper"], default="robust")
    parser.add_argument("--surface", help="surface.tif: heights come from there, not from corners")
    parser.add_argument("--planes", required=True, help="out: planes.parquet")
    parser.add_argument("--filed", required=True, help="out: filed_corners.parquet")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    heights = store.read_json(args.model)["contract"]["heights"]
    sections, corners = (store.read_table(f, block=args.name) for f in (args.sections, args.corners))
    dtm = facts.terrain(map_bounds(sections, facts))
    fallback = (heights["fallback"], heights.get("fallback_sigma", 3.0))
    if args.surface:
        from kibs_steps import surface

        sections, corners = surface.under(sections, facts, args.surface, dtm)
    round_about = (store.read_table(args.sections, ["outline"], block=name) for name in neighbours(args.name))
    others = [outline for table in round_about for outline in shapely.from_wkb(table["outline"].to_numpy())]
    table, filed = planes(sections, corners, facts, dtm, fallback, args.reach, args.rule, others)
    store.write_table(args.planes, table)
    store.write_table(args.filed, filed)


def middle_of(outlines: np.ndarray, facts: scene.Scene) -> np.ndarray:
    """Middles (n, 2; image map frame, m) of outlines (px): a section is seen from the direction that holds there."""
    if not len(outlines):
        return np.zeros((0, 2))
    return facts.grid.to_map(shapely.get_coordinates(shapely.centroid(outlines)))


def map_bounds(sections: pa.Table, facts: scene.Scene) -> tuple[float, float, float, float]:
    """Bounds (left, bottom, right, top; image map frame, m) of a table's outlines; the scene's corner if it has none."""
    if not len(sections):
        left, _, _, top = facts.grid.bounds
        return left, top, left, top
    x0, y0, x1, y1 = shapely.total_bounds(shapely.from_wkb(sections["outline"].to_numpy(zero_copy_only=False)))
    (left, top), (right, bottom) = facts.grid.to_map(np.array([[x0, y0], [x1, y1]]))
    return float(left), float(bottom), float(right), float(top)


if __name__ == "__main__":
    cli.run(main, pandas=False)
