"""Solids: every building as a closed solid on the ground, or the best simpler one that is valid, with the reason.

In: the block's rows of `buildings.parquet`, the DTM. Out: CityJSONSeq (a header line, then one feature per building) and
`solids.parquet`, the building attributes. A building is tried as a roof of fused planes (LOD2), then with every section flat
at its mean height (1.3), then as one flat block (1.2); the first whose shells all pass `gate.check` is published, and
`lod_reason` says what was refused before it. Where none passes the building stays, LOD "0", as its footprint.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, gate, scene, shells, store, straight
from kibs_steps.buildings import hidden
from kibs_steps.errors import KibsError
from kibs_steps.faces import MM, Face, NoPartition, dissolved, polygon
from kibs_steps.ground import slope_azimuth
from kibs_steps.partition import GAP, partition, polygonal
from kibs_steps.planes_together import SLOPE_CAP, bring_together, drawn_to_planes
from kibs_steps.shells import GROUND, ROOF, WALL, Surface
from kibs_steps.terrain import Terrain

FITTED = ("ok", "raster_edge", "cloud_or_nodata")  # statuses whose plane was fitted to enough corners
LOWEST_ROOF = 0.5  # m above the building's ground
RAGGED = 1.3  # px, how far the rim of a traced section may be from its straight edge
ONE_LEVEL = 0.1  # m, flat sections this near in height are one level
PITCHED = 5.0  # deg, from here on a section counts as a slope
SAME_WAY = 25.0  # deg between azimuths
CANNOT = (NoPartition, shapely.errors.GEOSException, np.linalg.LinAlgError, ValueError)  # what bad geometry ends in

ATTRIBUTES = pa.schema(
    [
        ("building_id", pa.int64()),
        ("lod", pa.string()),
        ("lod_reason", pa.string()),
        ("valid", pa.bool_()),
        ("position_corrected", pa.bool_()),
        ("n_sections", pa.int64()),
        ("ground_z", pa.float64()),
        ("eave_z", pa.float64()),
        ("ridge_z", pa.float64()),
        ("height", pa.float64()),
        ("volume", pa.float64()),
        ("footprint_area", pa.float64()),
        ("roof_type", pa.string()),
        ("outline", pa.binary()),
        ("footprint", pa.binary()),
    ]
)


class Refused(KibsError):
    """A level of detail this building cannot have, and why."""


class Sections(NamedTuple):
    """The sections of one building: ids, polygons and planes (n, 3: z = a·x + b·y + c) in metres from `origin` (map m).

    `traced`: their outlines run from pixel corner to pixel corner, so their rims are ragged.
    """

    ids: np.ndarray
    polygons: list[shapely.Geometry]
    planes: np.ndarray
    status: list[str]
    sigma: np.ndarray
    origin: tuple[int, int]
    traced: bool = False

    @property
    def fitted(self) -> np.ndarray:
        """(n,) bool: whose plane was fitted; the others are level placeholders."""
        return np.isin(self.status, FITTED)


class Solid(NamedTuple):
    """A building as published: its shells (mm from the sections' origin), ground (mm), roof type; no shells at LOD "0"."""

    lod: str
    reason: str
    shells: list[list[Surface]]
    ground: int
    roof_type: str
    base: shapely.Geometry


def build(
    sections: Sections, dtm: Terrain, lod_label: str = "2.0", gap: float = GAP, reach: float = straight.REACH
) -> Solid:
    """The most detailed valid solid of a building; never raises on geometry.

    `gap` (m) as in `partition.partition`, `reach` (m) as in `straight.ragged`.
    """
    refused: list[str] = []
    divided = True
    planes = sections.planes
    try:
        faces, exact = partition(sections.polygons, planes, sections.fitted, gap)
        as_it_is = exact and not sections.traced
        faces = straight.tidied(faces) if as_it_is else drawn_to_planes(straight.ragged(faces, reach), planes)
    except CANNOT as error:
        refused.append(f"{lod_label} and 1.3: {error}")
        divided = False
        try:
            faces, planes = _one_polygon(sections)
        except CANNOT as worse:
            return _nothing(sections, dtm, [*refused, f"1.2: {worse}"])
    ground = lowest_ground(_shapes(faces), sections.origin, dtm)
    kind = roof_type(faces, planes)
    ladder: list[tuple[str, Callable[[], tuple[list[Face], np.ndarray]]]] = []
    if divided and sections.fitted.any():
        ladder += [
            (lod_label, lambda: (faces, bring_together(faces, planes, sections.sigma, sections.fitted).planes)),
            (lod_label, lambda: (faces, planes)),
            (lod_label, lambda: (faces, _bad_ones_level(faces, planes, ground))),
        ]
    elif divided:
        refused.append(f"{lod_label}: no section has a fitted plane")
    if divided:
        ladder.append(("1.3", lambda: (faces, _level_sections(faces, planes))))
    ladder.append(("1.2", lambda: (straight.tidied(dissolved(faces)), _one_level(faces, planes))))
    for lod, roof in ladder:
        try:
            built = _gated(*roof(), ground, sections.ids if lod != "1.2" else None)
        except (Refused, *CANNOT) as error:
            refused.append(f"{lod}: {error}")
        else:
            return Solid(lod, "; ".join(dict.fromkeys(refused)), built, ground, kind, _base(built, sections.origin))
    return _nothing(sections, dtm, refused)


def _unusable(face: Face, plane: np.ndarray, ground: int) -> str | None:
    """What is wrong with a roof face on its own: too steep, or too near to the ground."""
    slope = float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))
    if slope > SLOPE_CAP:
        return f"has a slope of {slope:.0f}°"
    above = min(shells.height(plane, p) for ring in face.rings for p in ring) - ground
    if above < LOWEST_ROOF * MM:
        return f"comes down to {above / MM:.2f} m above the ground"
    return None


def _gated(faces: list[Face], planes: np.ndarray, ground: int, ids: np.ndarray | None) -> list[list[Surface]]:
    """Shells that pass the gate; `ids` None for a roof that is not divided. Raises `Refused` or `NoPartition`."""
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
    for face, shape in zip(faces, _shapes(faces), strict=True):
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
    return Solid("0", "; ".join(dict.fromkeys(refused)), [], ground, "complex", _moved(outline, sections.origin))


def _shapes(faces: list[Face]) -> list[shapely.Geometry]:
    """Valid areas (m from the origin) of faces; a face that touches itself in a point becomes several parts."""
    return list(shapely.make_valid([polygon(face) for face in faces]))


def lowest_ground(shapes: list[shapely.Geometry], origin: tuple[int, int], dtm: Terrain) -> int:
    """Lowest terrain (mm) under shapes (m from `origin`): at their rims and at the DTM's pixel centres inside."""
    placed = [_moved(shape, origin) for shape in shapes]
    left, bottom, right, top = shapely.total_bounds(placed)
    cols = np.arange(np.ceil((left - dtm.x0) / dtm.step[0]), (right - dtm.x0) / dtm.step[0])
    rows = np.arange(np.ceil((dtm.y0 - top) / dtm.step[1]), (dtm.y0 - bottom) / dtm.step[1])
    centres = np.stack(np.meshgrid(dtm.x0 + cols * dtm.step[0], dtm.y0 - rows * dtm.step[1]), axis=-1).reshape(-1, 2)
    inside = [centres[shapely.contains_xy(shape, *centres.T)] for shape in placed]
    rim = shapely.get_coordinates(shapely.segmentize(placed, min(dtm.step) / 2))
    return int(np.floor(dtm(np.concatenate([rim, *inside])).min() * MM))


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


def roof_type(faces: list[Face], planes: np.ndarray) -> str:
    """flat, shed, gable, hip, pyramid or complex, from the number and the directions of the slopes.

    Sections below a tenth of the largest do not count, nor do level ones below 15 % in all beside slopes.
    """
    shapes = _shapes(faces)
    area = np.bincount([f.section for f in faces], shapely.area(shapes), minlength=len(planes))
    slope, azimuth = slope_azimuth(planes[:, 0], planes[:, 1], 0.0)
    counted = area >= 0.1 * area.max()
    pitched = np.flatnonzero(counted & (slope >= PITCHED))
    level = area[counted & (slope < PITCHED)].sum() / area[counted].sum()
    if not len(pitched):
        return "flat"
    if level > 0.15:
        return "complex"
    ways: list[list[int]] = []
    for section in pitched:
        for way in ways:
            if abs((azimuth[section] - azimuth[way[0]] + 180) % 360 - 180) <= SAME_WAY:
                way.append(section)
                break
        else:
            ways.append([section])
    if len(ways) == 1:
        return "shed"
    if len(ways) == 2:
        return "gable" if _fall_apart(ways, azimuth, shapes, faces) else "complex"
    corners = [{p for f in faces if f.section == s for ring in f.rings for p in ring} for s in pitched]
    whole = shapely.union_all(shapes)
    if len(ways) > 4 or whole.area < 0.85 * whole.minimum_rotated_rectangle.area:
        return "complex"
    if len(pitched) == len(ways) and set.intersection(*corners):
        return "pyramid"
    return "hip"


def _fall_apart(ways: list[list[int]], azimuth: np.ndarray, shapes: list[shapely.Geometry], faces: list[Face]) -> bool:
    """Whether two groups of sections slope in opposite directions, away from each other."""
    first, second = (azimuth[way[0]] for way in ways)
    if abs((first - second) % 360 - 180) > SAME_WAY:
        return False
    centres = [
        shapely.union_all([shape for shape, face in zip(shapes, faces, strict=True) if face.section in way]).centroid
        for way in ways
    ]
    down = np.array([np.sin(np.radians(second)), np.cos(np.radians(second))])
    return float(down @ (centres[1].x - centres[0].x, centres[1].y - centres[0].y)) > 0


def sections_of(table: pa.Table) -> Iterator[tuple[int, Sections]]:
    """The buildings of a `buildings.parquet` table with their sections, by ascending id."""
    table = table.sort_by([("building_id", "ascending"), ("section_id", "ascending")])
    building = table["building_id"].to_numpy()
    ids = table["section_id"].to_numpy()
    outlines = shapely.from_wkb(table["outline_map"].to_numpy(zero_copy_only=False), on_invalid="ignore")
    pixels = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False), on_invalid="ignore")
    status = table["status"].to_pylist()
    a, b, c, x0, y0, sigma = (
        table[name].to_numpy().astype(float) for name in ("plane_a", "plane_b", "plane_c", "x0", "y0", "height_sigma")
    )
    cuts = [0, *(np.flatnonzero(np.diff(building)) + 1), len(building)]
    for first, end in pairwise(cuts if len(building) else []):
        mine = slice(first, end)
        corner = shapely.get_coordinates(outlines[mine])
        corner = corner[np.isfinite(corner).all(axis=1)]
        origin = np.floor(corner.min(axis=0)).astype(int) if len(corner) else np.zeros(2, int)
        local = c[mine] + a[mine] * (origin[0] - x0[mine]) + b[mine] * (origin[1] - y0[mine])
        planes = np.column_stack([a[mine], b[mine], local])
        near = [g and shapely.transform(shapely.force_2d(g), lambda xy, o=origin: xy - o) for g in outlines[mine]]
        place = (int(origin[0]), int(origin[1]))
        corners = shapely.get_coordinates(pixels[mine])
        traced = bool(len(corners)) and bool((corners == np.round(corners)).all())
        yield int(building[first]), Sections(ids[mine], near, planes, status[mine], sigma[mine], place, traced)


def attributes(building: int, sections: Sections, solid: Solid, position_corrected: bool) -> dict[str, Any]:
    """One row of `ATTRIBUTES`, geometries as shapely objects; of a footprint in several parts the largest."""
    roof = [p[2] for shell in solid.shells for s in shell if s.kind == ROOF for ring in s.rings for p in ring]
    eave, ridge = (min(roof) / MM, max(roof) / MM) if roof else (None, None)
    ground = solid.ground / MM
    parts = [p for p in shapely.get_parts(solid.base) if p.geom_type == "Polygon"]
    return {
        "building_id": building,
        "lod": solid.lod,
        "lod_reason": solid.reason,
        "valid": bool(solid.shells),
        "position_corrected": position_corrected,
        "n_sections": len(sections.ids),
        "ground_z": ground,
        "eave_z": eave,
        "ridge_z": ridge,
        "height": None if ridge is None else round(ridge - ground, 3),
        "volume": round(float(sum(gate.volume([s.rings for s in shell]) for shell in solid.shells)) / MM**3, 3),
        "footprint_area": round(float(shapely.area(solid.base)), 3),
        "roof_type": solid.roof_type,
        "outline": shapely.MultiPolygon(parts),
        "footprint": max(parts, key=shapely.area, default=None),
    }


def feature(
    row: dict[str, Any], sections: Sections, solid: Solid, datum: tuple[int, int], convergence: float
) -> dict[str, Any]:
    """A CityJSONFeature of one building with the values of `row`; vertices are mm from `datum` (map m), heights mm.

    A building of several shells has one BuildingPart each.
    """
    vertices: dict[tuple[int, int, int], int] = {}
    dx, dy = ((sections.origin[k] - datum[k]) * MM for k in (0, 1))

    def indices(ring: list[tuple[int, int, int]]) -> list[int]:
        return [vertices.setdefault((x + dx, y + dy, z), len(vertices)) for x, y, z in ring]

    def geometry(shell: list[Surface]) -> dict[str, Any]:
        kinds = [_semantics(s, sections, solid.lod, convergence) for s in shell]
        texts = [json.dumps(kind) for kind in kinds]
        distinct = dict(zip(texts, kinds, strict=True))
        place = {text: k for k, text in enumerate(distinct)}
        return {
            "type": "Solid",
            "lod": solid.lod,
            "boundaries": [[[indices(ring) for ring in s.rings] for s in shell]],
            "semantics": {"surfaces": list(distinct.values()), "values": [[place[text] for text in texts]]},
        }

    key = f"building-{row['building_id']}"
    values = {name: value for name, value in row.items() if value is not None and not shapely.is_geometry(value)}
    building: dict[str, Any] = {"type": "Building", "attributes": values}
    objects = {key: building}
    if len(solid.shells) == 1:
        building["geometry"] = [geometry(solid.shells[0])]
    elif solid.shells:
        building["children"] = [f"{key}-{k + 1}" for k in range(len(solid.shells))]
        for child, shell in zip(building["children"], solid.shells, strict=True):
            objects[child] = {"type": "BuildingPart", "parents": [key], "geometry": [geometry(shell)]}
    else:
        surfaces = [
            [indices(ring) for ring in rings] for rings in _flat_rings(solid.base, sections.origin, solid.ground)
        ]
        building["geometry"] = [{"type": "MultiSurface", "lod": "0", "boundaries": surfaces}] if surfaces else []
    return {"type": "CityJSONFeature", "id": key, "CityObjects": objects, "vertices": [list(v) for v in vertices]}


def _flat_rings(base: shapely.Geometry, origin: tuple[int, int], z: int) -> list[list[list[tuple[int, int, int]]]]:
    """The rings of each polygon of `base` (map m) as mm points from the origin at one height."""
    found = []
    for shape in shapely.orient_polygons(shapely.get_parts(base)):
        rings = [np.rint((shapely.get_coordinates(r)[:-1] - origin) * MM) for r in shapely.get_rings(shape)]
        found.append([[(int(x), int(y), z) for x, y in ring] for ring in rings if len(ring) >= 3])
    return [rings for rings in found if rings]


def _semantics(surface: Surface, sections: Sections, lod: str, convergence: float) -> dict[str, Any]:
    """A surface's semantic object: what it is, and for roofs how they lie and the section they come from (not in one block)."""
    if surface.kind == WALL:
        return {"type": WALL, "exterior": surface.exterior}
    if surface.kind == GROUND:
        return {"type": GROUND}
    nx, ny, nz = np.sum([gate.newell(ring) for ring in surface.rings], axis=0)
    slope, azimuth = (float(v) for v in slope_azimuth(-nx / nz, -ny / nz, convergence))
    found: dict[str, Any] = {"type": ROOF}
    if lod != "1.2":
        sigma = float(sections.sigma[surface.section])
        found["section_id"] = int(sections.ids[surface.section])
        found["status"] = sections.status[surface.section]
        found["height_sigma"] = round(sigma, 3) if np.isfinite(sigma) else None
    found["slope"] = round(slope, 2)
    found["azimuth"] = round(azimuth, 1) if np.isfinite(azimuth) else None
    found["area"] = round(float(np.linalg.norm((nx, ny, nz))) / MM**2, 2)
    return {name: value for name, value in found.items() if value is not None}


def header(datum: tuple[int, int]) -> dict[str, Any]:
    """The first line of a CityJSONSeq: how integer vertices become map metres."""
    transform = {"scale": [1 / MM] * 3, "translate": [float(datum[0]), float(datum[1]), 0.0]}
    return {"type": "CityJSON", "version": "2.0", "transform": transform, "CityObjects": {}, "vertices": []}


def main(argv: list[str] | None = None) -> None:
    """Build valid solids of the buildings of one block."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.solids", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--buildings", required=True, help="buildings.parquet of all blocks")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--lod-label", default="2.0", help="what the most detailed level is called")
    parser.add_argument("--out", required=True, help="out: solids.city.jsonl")
    parser.add_argument("--attributes", required=True, help="out: solids.parquet")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    grid = facts.grid
    datum = (int(np.floor(grid.bounds[0])), int(np.floor(grid.bounds[1])))
    convergence = scene.convergence(grid)
    buildings = list(sections_of(store.read_table(args.buildings, block=args.name)))
    shapes = [_moved(p, s.origin) for _, s in buildings for p in s.polygons if p is not None and not p.is_empty]
    dtm = facts.terrain(tuple(shapely.total_bounds(shapes)) if shapes else grid.bounds)
    gap = max(GAP, hidden(facts.lean))
    rows = []
    with store.whole(args.out) as temporary, temporary.open("w", encoding="utf-8") as out:
        out.write(json.dumps(header(datum), separators=(",", ":")) + "\n")
        for building, sections in buildings:
            solid = build(sections, dtm, args.lod_label, gap, RAGGED * grid.gsd)
            row = attributes(building, sections, solid, facts.view is not None)
            line = feature(row, sections, solid, datum, convergence)
            out.write(json.dumps(line, separators=(",", ":"), allow_nan=False) + "\n")
            rows.append(
                {**row, "outline": shapely.to_wkb(row["outline"]), "footprint": shapely.to_wkb(row["footprint"])}
            )
    store.write_table(args.attributes, pa.Table.from_pylist(rows, ATTRIBUTES))


if __name__ == "__main__":
    cli.run(main)
