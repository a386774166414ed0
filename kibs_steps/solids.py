"""Solids: every building as a closed solid on the ground, or the best simpler one that is valid, with the reason.

In: the block's rows of `buildings.parquet`, the DTM. Out: CityJSONSeq (a header line, then one feature per building),
`solids.parquet`, the building attributes, and the solids' triangles (`mesh`). Buildings that touch (a cluster) are tiled as one,
so their party walls are the same faces; then each is made by itself. It is tried as a roof of fused planes (LOD2), then with
roofs that dive into the ground cut there, then with every section flat at its mean height (1.3), then as one flat block (1.2);
the first whose shells all pass `gate.check` is published, and `lod_reason` says what was refused before it. Where
none passes the building stays, LOD "0", as its footprint.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, clip, features, gate, georeference, mesh, scene, shells, store, straight
from kibs_steps.buildings import hidden
from kibs_steps.errors import KibsError
from kibs_steps.faces import MM, Face, NoPartition, Point, dissolved, shapes_of
from kibs_steps.features import roof_type
from kibs_steps.partition import GAP, REACH, partition, polygonal
from kibs_steps.planes import middle_of
from kibs_steps.planes_together import SLOPE_CAP, bring_together, drawn_to_planes
from kibs_steps.shells import GROUND, WALL, Surface
from kibs_steps.terrain import Terrain

FITTED = ("ok", "raster_edge", "cloud_or_nodata")  # statuses whose plane was fitted to enough corners
LOWEST_ROOF = 0.5  # m above the building's ground
TIDIED = 40  # mm, how much lower a cut roof may end once its short edges are drawn together
RAGGED = 1.3  # px, how far the rim of a traced section may be from its straight edge
DRAWN = 0.3  # m, how well drawn outlines fit each other
MEETING = 1.5  # px, outlines this near in the image meet there
ALONG = 8.0  # px, longer common edges are no chance
WHOLE = 10.0  # px², outlines over each other by more show parts that are hidden
TOUCHING = 1.5  # mm, walls this near stand along each other
ONE_LEVEL = 0.1  # m, flat sections this near in height are one level
CANNOT = (NoPartition, shapely.errors.GEOSException, np.linalg.LinAlgError, ValueError)  # what bad geometry ends in


class Refused(KibsError):
    """A level of detail this building cannot have, and why."""


class Sections(NamedTuple):
    """The sections of one building, or of several that touch.

    Ids, polygons and planes (n, 3: z = a·x + b·y + c) in metres from `origin` (map m). `traced`: their outlines
    run from pixel corner to pixel corner, so their rims are ragged. `spread` (n,): σ of where they stand (m), NaN where the
    view is unknown. `seen` (n,): outlines in the image (px).
    """

    ids: np.ndarray
    polygons: list[shapely.Geometry]
    planes: np.ndarray
    status: list[str]
    sigma: np.ndarray
    origin: tuple[int, int]
    traced: bool = False
    spread: np.ndarray | None = None
    seen: np.ndarray | None = None

    def take(self, rows: np.ndarray) -> Sections:
        """Some of the sections."""
        return self._replace(
            ids=self.ids[rows],
            polygons=[self.polygons[k] for k in rows],
            planes=self.planes[rows],
            status=[self.status[k] for k in rows],
            sigma=self.sigma[rows],
            spread=None if self.spread is None else self.spread[rows],
            seen=None if self.seen is None else self.seen[rows],
        )

    @property
    def fitted(self) -> np.ndarray:
        """(n,) bool: whose plane was fitted; the others are level placeholders."""
        return np.isin(self.status, FITTED)


class Fit(NamedTuple):
    """How well sections fit (m): what neighbours share may be `reach` apart, with a `gap` between; rims waver by `ragged`."""

    reach: float = REACH
    gap: float = GAP
    ragged: float = straight.REACH


class Solid(NamedTuple):
    """A building as published: its shells (mm from the sections' origin), ground (mm), roof type; no shells at LOD "0".

    `party`: edges of its outline (mm, in plan) along which another building stands (`with_party_walls`).
    """

    lod: str
    reason: str
    shells: list[list[Surface]]
    ground: int
    roof_type: str | None
    base: shapely.Geometry
    party: frozenset[tuple[Point, Point]] = frozenset()


class Roof(NamedTuple):
    """Faces and planes of a roof, and the height (mm) of the ground that its walls come down to."""

    faces: list[Face]
    planes: np.ndarray
    ground: int


class Built(NamedTuple):
    """One building: its id, its sections and its solid."""

    building: int
    sections: Sections
    solid: Solid


def fit_of(sections: Sections, lean: np.ndarray, gsd: float) -> Fit:
    """How well the sections of a cluster fit: as their outlines were made; `lean` (n, 2) of the view, `gsd` in m.

    Traced outlines gape by all that a step can hide. Drawn ones are trusted. If some overlap in the image they were drawn whole,
    hidden parts too, and all gaps are real. Else a strip was hidden between sections that run along each other in the image
    and stand apart on the map; other gaps are seen, and so real.
    """
    if sections.traced or sections.seen is None:
        return Fit(gap=max(GAP, hidden(lean)), ragged=RAGGED * gsd)
    seen, standing = (np.array([polygonal(p) for p in some], object) for some in (sections.seen, sections.polygons))
    a, b = shapely.STRtree(seen).query(seen, "dwithin", MEETING)
    a, b = a[a < b], b[a < b]
    if shapely.area(shapely.intersection(seen[a], seen[b])).max(initial=0.0) > WHOLE:
        return Fit(DRAWN, DRAWN, 0.0)
    along = shapely.length(shapely.intersection(shapely.boundary(seen[a]), shapely.buffer(seen[b], MEETING)))
    apart = shapely.distance(standing[a], standing[b])[along > ALONG]
    widest = min(float(apart.max(initial=0.0)), hidden(lean))
    return Fit(DRAWN, widest + DRAWN, 0.0)


def build(sections: Sections, dtm: Terrain, lod_label: str = "2.0", fit: Fit | None = None) -> Solid:
    """The most detailed valid solid of a building that stands alone; never raises on geometry."""
    ((_, _, solid),) = together(sections, np.zeros(len(sections.ids), np.int64), dtm, lod_label, fit)
    return solid


def together(
    sections: Sections,
    building: np.ndarray,
    dtm: Terrain,
    lod_label: str = "2.0",
    fit: Fit | None = None,
) -> list[Built]:
    """The most detailed valid solids of buildings that touch, tiled as one so that they share their party walls.

    `building` (n,): building of each section; `fit`: how well they fit (`fit_of`).
    Never raises on geometry: what cannot be tiled together is tried alone.
    """
    fit = fit or Fit()
    names = np.unique(building)
    of = {int(b): np.flatnonzero(building == b) for b in names}
    try:
        faces = _tiled(sections, building, fit)
    except CANNOT as error:
        if len(names) > 1:
            return [
                Built(b, mine, build(mine, dtm, lod_label, fit))
                for b, mine in ((b, sections.take(rows)) for b, rows in of.items())
            ]
        return [Built(int(names[0]), sections, _undivided(sections, dtm, lod_label, error))]
    found = []
    for b, rows in of.items():
        mine = sections.take(rows)
        place = {int(row): k for k, row in enumerate(rows)}
        own = [Face(place[f.section], f.rings) for f in faces if f.section in place]
        if not own:
            lost = ["nothing of it is left beside and under the roofs of the buildings it touches"]
            found.append(Built(b, mine, _nothing(mine, dtm, lost if len(names) > 1 else [])))
            continue
        found.append(Built(b, mine, _climb(own, mine, dtm, lod_label)))
    return with_party_walls(found)


def with_party_walls(found: list[Built]) -> list[Built]:
    """Buildings of one cluster with their `party` walls: those along which, for half of their length at least, walls of others
    stand. Asked of what is published: a roof cut where it comes down to the ground leaves its neighbour's wall free."""
    walls = [(k, *segment) for k, built in enumerate(found) for segment in _outer_walls(built.solid)]
    if len({k for k, *_ in walls}) < 2:
        return found
    owner = np.array([k for k, *_ in walls])
    lines = shapely.linestrings(np.array([segment for _, *segment in walls], float))
    one, other = shapely.STRtree(lines).query(lines, "dwithin", TOUCHING)
    apart = owner[one] != owner[other]
    one, other = one[apart], other[apart]
    common = shapely.length(shapely.intersection(lines[one], shapely.buffer(lines[other], TOUCHING, cap_style="flat")))
    shared = np.bincount(one, common, len(lines)) >= 0.5 * shapely.length(lines)
    party: list[set[tuple[Point, Point]]] = [set() for _ in found]
    for (k, start, end), behind in zip(walls, shared, strict=True):
        if behind:
            party[k].add((start, end))
    return [
        built._replace(solid=built.solid._replace(party=frozenset(edges)))
        for built, edges in zip(found, party, strict=True)
    ]


def _outer_walls(solid: Solid) -> list[tuple[Point, Point]]:
    """The edges (mm, in plan) of a solid's outline, each once, as its walls run."""
    ends = (
        (surface.rings[0][-1][:2], surface.rings[0][0][:2])
        for shell in solid.shells
        for surface in shell
        if surface.kind == WALL and surface.exterior
    )
    return list(dict.fromkeys(ends))


def _tiled(sections: Sections, building: np.ndarray, fit: Fit) -> list[Face]:
    """The faces of buildings that touch: as they are where they fit, else with straight rims."""
    faces, exact = partition(sections.polygons, sections.planes, sections.fitted, fit.gap, fit.reach)
    if (exact and not sections.traced) or not fit.ragged:
        return straight.tidied(faces)
    return drawn_to_planes(straight.ragged(faces, fit.ragged, building), sections.planes)


def _climb(faces: list[Face], sections: Sections, dtm: Terrain, lod_label: str) -> Solid:
    """The first rung of the ladder of detail whose shells pass the gate."""
    planes, refused = sections.planes, []
    ground = lowest_ground(shapes_of(faces), sections.origin, dtm)
    kind = roof_type(faces, planes)
    ladder: list[tuple[str, Callable[[], Roof]]] = []
    if sections.fitted.any():
        fused = bring_together(faces, planes, sections.sigma, sections.fitted).planes
        ladder += [
            (lod_label, lambda: Roof(faces, fused, ground)),
            (lod_label, lambda: Roof(faces, planes, ground)),
            (lod_label, lambda: _clipped(Roof(faces, fused, ground), sections.origin, dtm)),
            (lod_label, lambda: Roof(faces, _bad_ones_level(faces, planes, ground), ground)),
        ]
    else:
        refused.append(f"{lod_label}: no section has a fitted plane")
    ladder.append(("1.3", lambda: Roof(faces, _level_sections(faces, planes), ground)))
    return _first(ladder, faces, sections, ground, kind, refused) or _nothing(sections, dtm, refused)


def _undivided(sections: Sections, dtm: Terrain, lod_label: str, why: Exception) -> Solid:
    """A building whose sections cannot be tiled, as one block."""
    refused = [f"{lod_label} and 1.3: {why}"]
    try:
        faces, planes = _one_polygon(sections)
    except CANNOT as worse:
        return _nothing(sections, dtm, [*refused, f"1.2: {worse}"])
    ground = lowest_ground(shapes_of(faces), sections.origin, dtm)
    one = sections._replace(planes=planes)
    return _first([], faces, one, ground, roof_type(faces, planes), refused) or _nothing(sections, dtm, refused)


def _first(
    ladder: list[tuple[str, Callable[[], Roof]]],
    faces: list[Face],
    sections: Sections,
    ground: int,
    kind: str,
    refused: list[str],
) -> Solid | None:
    """The solid of the first rung that holds, one flat block being the last; what does not hold is added to `refused`."""
    last = ("1.2", lambda: Roof(straight.tidied(dissolved(faces)), _one_level(faces, sections.planes), ground))
    for lod, make in [*ladder, last]:
        try:
            roof = make()
            built = _gated(roof, sections.ids if lod != "1.2" else None)
        except (Refused, *CANNOT) as error:
            refused.append(f"{lod}: {error}")
        else:
            return Solid(
                lod, "; ".join(dict.fromkeys(refused)), built, roof.ground, kind, _base(built, sections.origin)
            )
    return None


def _clipped(roof: Roof, origin: tuple[int, int], dtm: Terrain) -> Roof:
    """The roof cut where it comes down to the ground that lies under what stays of it. Raises `Refused` if it nowhere does."""
    whole = roof
    while low := {f.section for f in roof.faces if _above(roof, f) < LOWEST_ROOF * MM}:
        faces = _cut(roof, low)
        ground = lowest_ground(shapes_of(faces), origin, dtm)
        if ground <= roof.ground:
            return roof._replace(faces=faces)
        roof = roof._replace(faces=faces, ground=ground)
    if roof is whole:
        raise Refused("no section comes down to the ground")
    return roof


def _cut(roof: Roof, low: set[int]) -> list[Face]:
    """Its faces, those of sections in `low` cut where they come down to the lowest height; a little higher where tidying would
    take them below it again."""
    for spare in (0, TIDIED):
        lowest = roof.ground + round(LOWEST_ROOF * MM) + spare
        faces = straight.tidied(clip.clipped(roof.faces, roof.planes, low, lowest))
        if all(_above(roof, face) >= LOWEST_ROOF * MM for face in faces):
            break
    return faces


def _above(roof: Roof, face: Face) -> int:
    """How high (mm) the lowest corner of a face is above the ground."""
    return shells.lowest(face, roof.planes[face.section]) - roof.ground


def _unusable(face: Face, plane: np.ndarray, ground: int) -> str | None:
    """What is wrong with a roof face on its own: too steep, or too near to the ground."""
    slope = float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))
    if slope > SLOPE_CAP:
        return f"has a slope of {slope:.0f}°"
    above = shells.lowest(face, plane) - ground
    if above < LOWEST_ROOF * MM:
        return f"comes down to {above / MM:.2f} m above the ground"
    return None


def _gated(roof: Roof, ids: np.ndarray | None) -> list[list[Surface]]:
    """Shells that pass the gate; `ids` None for a roof that is not divided. Raises `Refused` or `NoPartition`."""
    faces, planes, ground = roof
    for face in faces:
        wrong = _unusable(face, planes[face.section], ground)
        if wrong:
            raise Refused(f"{'the roof' if ids is None else f'section {ids[face.section]}'} {wrong}")
    built = shells.shells(faces, planes, ground)
    for shell in built:
        problems = gate.check([surface.rings for surface in shell])
        if problems:
            raise Refused(problems[0].text)
    return built


def _bad_ones_level(faces: list[Face], planes: np.ndarray, ground: int) -> np.ndarray:
    """Planes with those unusable on their own made level at their mean height, above ground. Raises `Refused` if all are."""
    bad = {face.section for face in faces if _unusable(face, planes[face.section], ground)}
    if not bad or bad == {face.section for face in faces}:
        raise Refused("level planes in place of bad ones do not help")
    _, mean = _mean_heights(faces, planes)
    mended = planes.astype(float).copy()
    for section in bad:
        mended[section] = (0.0, 0.0, max(mean[section], ground / MM + LOWEST_ROOF))
    return mended


def _mean_heights(faces: list[Face], planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Area (m²) of each section in the partition and the mean height (m) of its plane there."""
    area, moment = np.zeros(len(planes)), np.zeros(len(planes))
    for face, shape in zip(faces, shapes_of(faces), strict=True):
        area[face.section] += shape.area
        moment[face.section] += shape.area * float(planes[face.section] @ (shape.centroid.x, shape.centroid.y, 1.0))
    return area, moment / np.maximum(area, 1e-9)


def _level_sections(faces: list[Face], planes: np.ndarray) -> np.ndarray:
    """Level planes at each section's mean height, heights within `ONE_LEVEL` of the next made one."""
    area, mean = _mean_heights(faces, planes)
    order = np.argsort(mean, kind="stable")
    run = np.cumsum(np.r_[0, np.diff(mean[order]) > ONE_LEVEL])
    level = np.bincount(run, mean[order] * area[order]) / np.maximum(np.bincount(run, area[order]), 1e-9)
    flat = np.zeros((len(planes), 3))
    flat[order, 2] = level[run]
    return flat


def _one_level(faces: list[Face], planes: np.ndarray) -> np.ndarray:
    """One level plane at the roof's mean height."""
    area, mean = _mean_heights(faces, planes)
    return np.array([[0.0, 0.0, float((area * mean).sum() / area.sum())]])


def _one_polygon(sections: Sections) -> tuple[list[Face], np.ndarray]:
    """All sections as one, level at their mean height."""
    shapes = [polygonal(p) for p in sections.polygons]
    area = shapely.area(shapes)
    if not area.sum() > 0:
        raise NoPartition("no section has an area")
    centre = shapely.get_coordinates([p.centroid if p.area else shapely.Point(0, 0) for p in shapes])
    mean = (sections.planes * np.c_[centre, np.ones(len(area))]).sum(axis=1)
    plane = np.array([[0.0, 0.0, float((area * mean).sum() / area.sum())]])
    faces = partition([shapely.union_all(shapes)], plane, np.ones(1, bool)).faces
    return straight.tidied(faces), plane


def _nothing(sections: Sections, dtm: Terrain, refused: list[str]) -> Solid:
    """A building without a solid: its footprint only."""
    outline = shapely.union_all([polygonal(p) for p in sections.polygons])
    ground = 0 if outline.is_empty else lowest_ground([outline], sections.origin, dtm)
    return Solid("0", "; ".join(dict.fromkeys(refused)), [], ground, None, _moved(outline, sections.origin))


def lowest_ground(shapes: list[shapely.Geometry], origin: tuple[int, int], dtm: Terrain) -> int:
    """Lowest terrain (mm) under shapes (m from `origin`): at their rims and at the DTM's pixel centres inside."""
    placed = [_moved(shape, origin) for shape in shapes]
    left, bottom, right, top = shapely.total_bounds(placed)
    cols = np.arange(np.ceil((left - dtm.x0) / dtm.step[0]), (right - dtm.x0) / dtm.step[0])
    rows = np.arange(np.ceil((dtm.y0 - top) / dtm.step[1]), (dtm.y0 - bottom) / dtm.step[1])
    centres = np.stack(np.meshgrid(dtm.x0 + cols * dtm.step[0], dtm.y0 - rows * dtm.step[1]), axis=-1).reshape(-1, 2)
    inside = [centres[shapely.contains_xy(shape, *centres.T)] for shape in placed]
    rim = shapely.get_coordinates(shapely.segmentize(placed, min(dtm.step) / 2))
    lowest = dtm(np.concatenate([rim, *inside])).min() * MM
    return int(np.floor(lowest + 1e-3))  # between pixels of one height its last digits differ


def _moved(geometry: shapely.Geometry, origin: tuple[int, int]) -> shapely.Geometry:
    """Metres from the origin to map metres."""
    return shapely.transform(geometry, lambda xy: np.round(xy, 3) + origin)


def _base(built: list[list[Surface]], origin: tuple[int, int]) -> shapely.Geometry:
    """The base of the walls as a polygon in map metres, one part per shell."""
    flat = []
    for shell in built:
        for surface in shell:
            if surface.kind == GROUND:
                exterior, *holes = [np.array(ring, float)[::-1, :2] / MM for ring in surface.rings]
                flat.append(shapely.Polygon(exterior, holes))
    return _moved(flat[0] if len(flat) == 1 else shapely.MultiPolygon(flat), origin)


def clusters_of(table: pa.Table) -> Iterator[tuple[np.ndarray, Sections]]:
    """Buildings that touch: building ids (n,) and sections (n) of each `cluster_id` of a `buildings.parquet`, ascending."""
    table = table.sort_by([(name, "ascending") for name in ("cluster_id", "building_id", "section_id")])
    cluster, building, ids = (table[name].to_numpy() for name in ("cluster_id", "building_id", "section_id"))
    outlines = shapely.from_wkb(table["outline_map"].to_numpy(zero_copy_only=False), on_invalid="ignore")
    pixels = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False), on_invalid="ignore")
    status = table["status"].to_pylist()
    a, b, c, x0, y0, sigma, along, across = (
        table[name].to_numpy().astype(float)
        for name in ("plane_a", "plane_b", "plane_c", "x0", "y0", "height_sigma", "sigma_along", "sigma_across")
    )
    cuts = [0, *(np.flatnonzero(np.diff(cluster)) + 1), len(cluster)]
    for first, end in pairwise(cuts if len(cluster) else []):
        mine = slice(first, end)
        corner = shapely.get_coordinates(outlines[mine])
        corner = corner[np.isfinite(corner).all(axis=1)]
        origin = np.floor(corner.min(axis=0)).astype(int) if len(corner) else np.zeros(2, int)
        local = c[mine] + a[mine] * (origin[0] - x0[mine]) + b[mine] * (origin[1] - y0[mine])
        planes = np.column_stack([a[mine], b[mine], local])
        near = [g and shapely.transform(shapely.force_2d(g), lambda xy, o=origin: xy - o) for g in outlines[mine]]
        place = (int(origin[0]), int(origin[1]))
        corners = shapely.get_coordinates(pixels[mine])
        traced = bool(len(corners)) and bool((corners == np.round(corners)).all(axis=1).mean() > 0.5)
        spread = np.hypot(along[mine], across[mine])
        yield (
            building[mine],
            Sections(ids[mine], near, planes, status[mine], sigma[mine], place, traced, spread, pixels[mine]),
        )


def main(argv: list[str] | None = None) -> None:
    """Build valid solids of the buildings of one block."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.solids", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--buildings", required=True, help="buildings.parquet of all blocks")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--lod-label", default="2.0", help="what the most detailed level is called")
    parser.add_argument("--out", required=True, help="out: solids.city.jsonl")
    parser.add_argument("--attributes", required=True, help="out: solids.parquet")
    parser.add_argument("--meshes", required=True, help="out: meshes.parquet")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    grid = facts.grid
    datum = (int(np.floor(grid.bounds[0])), int(np.floor(grid.bounds[1])))
    convergence = georeference.convergence(grid)
    table = store.read_table(args.buildings, block=args.name)
    clusters = list(clusters_of(table))
    shapes = [_moved(p, s.origin) for _, s in clusters for p in s.polygons if p is not None and not p.is_empty]
    dtm = facts.terrain(tuple(shapely.total_bounds(shapes)) if shapes else grid.bounds)
    pixels = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False), on_invalid="ignore")
    lean = dict(zip(table["section_id"].to_pylist(), facts.leans(middle_of(pixels, facts)), strict=True))
    built = []
    for building, sections in clusters:
        fit = fit_of(sections, np.array([lean[k] for k in sections.ids.tolist()]), grid.gsd)
        built += together(sections, building, dtm, args.lod_label, fit)
    rows, triangles = [], []
    with store.whole(args.out) as temporary, temporary.open("w", encoding="utf-8") as out:
        out.write(json.dumps(features.header(datum), separators=(",", ":")) + "\n")
        for building, sections, solid in sorted(built, key=lambda one: one.building):
            row = features.attributes(building, sections, solid)
            line = features.feature(row, sections, solid, datum, convergence)
            out.write(json.dumps(line, separators=(",", ":"), allow_nan=False) + "\n")
            rows.append({**row, **{name: shapely.to_wkb(row[name]) for name in ("outline", "footprint")}})
            triangles.append(mesh.row_of(line, (*datum, 0)))
    store.write_table(args.attributes, pa.Table.from_pylist(rows, features.ATTRIBUTES))
    store.write_table(args.meshes, mesh.table([row for row in triangles if row]))


if __name__ == "__main__":
    cli.run(main, pandas=False)
