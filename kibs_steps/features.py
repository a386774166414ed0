"""Features: what is said of a building's solid: attributes, roof type, and its CityJSON feature.

In: the sections of a building and its `solids.Solid`. Out: a row of `solids.parquet`, and a CityJSONFeature with semantics.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import gate
from kibs_steps.faces import MM, Face, shapes_of
from kibs_steps.ground import slope_azimuth
from kibs_steps.shells import GROUND, ROOF, WALL, Surface

if TYPE_CHECKING:
    from kibs_steps.solids import Sections, Solid

PITCHED = 5.0  # deg, from here on a section counts as a slope
SAME_WAY = 25.0  # deg between azimuths
COUNTED = 4.0  # m², smaller sections say nothing of how faithful a building is
FAITHFUL = 0.2  # m, how far a roof face may be from its section's plane

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
        ("height_sigma", pa.float64()),
        ("position_sigma", pa.float64()),
        ("faithful", pa.float64()),
        ("outline", pa.binary()),
        ("footprint", pa.binary()),
    ]
)


def roof_type(faces: list[Face], planes: np.ndarray) -> str:
    """flat, shed, gable, hip, pyramid or complex, from the number and the directions of the slopes.

    Sections below a tenth of the largest do not count, nor do level ones below 15 % in all beside slopes.
    """
    shapes = shapes_of(faces)
    area = np.bincount([f.section for f in faces], shapely.area(shapes), minlength=len(planes))
    slope, azimuth = slope_azimuth(planes[:, 0], planes[:, 1], 0.0)
    counted = area >= 0.1 * area.max()
    pitched = np.flatnonzero(counted & (slope >= PITCHED))
    pitched = pitched[np.lexsort((azimuth[pitched], -area[pitched].round(3)))]  # the largest leads, whatever their ids
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


def faithful(sections: Sections, solid: Solid) -> float | None:
    """Share of the sections over `COUNTED` m² that own a roof face within `FAITHFUL` m of their plane; None without any.

    At least half of the section's area has to lie under such faces.
    """
    area = np.array([0.0 if p is None else p.area for p in sections.polygons])
    counted = np.flatnonzero(area > COUNTED)
    if not len(counted):
        return None
    near = np.zeros(len(area))
    for surface in (s for shell in solid.shells for s in shell if s.kind == ROOF and solid.lod != "1.2"):
        points = np.array([p for ring in surface.rings for p in ring]) / MM
        off = np.abs(
            points[:, :2] @ sections.planes[surface.section, :2] + sections.planes[surface.section, 2] - points[:, 2]
        )
        if off.max() <= FAITHFUL:
            near[surface.section] += abs(sum(gate.newell(ring)[2] for ring in surface.rings)) / MM**2
    return float((near[counted] >= area[counted] / 2).mean())


def _volume(solid: Solid) -> float:
    """m³ of all shells."""
    return round(float(sum(gate.volume([s.rings for s in shell]) for shell in solid.shells)) / MM**3, 3)


def attributes(building: int, sections: Sections, solid: Solid) -> dict[str, Any]:
    """One row of `ATTRIBUTES`, geometries as shapely objects; of a footprint in several parts the largest."""
    area = np.array([0.0 if p is None else p.area for p in sections.polygons])
    weight = area / area.sum() if area.sum() > 0 else np.full(len(area), 1 / max(len(area), 1))

    def mean(sigma: np.ndarray | None) -> float | None:
        value = float("nan") if sigma is None else float((weight * sigma).sum())
        return round(value, 3) if np.isfinite(value) else None

    roof = [p[2] for shell in solid.shells for s in shell if s.kind == ROOF for ring in s.rings for p in ring]
    eave, ridge = (min(roof) / MM, max(roof) / MM) if roof else (None, None)
    ground = solid.ground / MM
    parts = [p for p in shapely.get_parts(solid.base) if p.geom_type == "Polygon"]
    return {
        "building_id": building,
        "lod": solid.lod,
        "lod_reason": solid.reason,
        "valid": bool(solid.shells),
        "position_corrected": mean(sections.spread) is not None,
        "n_sections": len(sections.ids),
        "ground_z": ground,
        "eave_z": eave,
        "ridge_z": ridge,
        "height": None if ridge is None else round(ridge - ground, 3),
        "volume": _volume(solid) if solid.shells else None,
        "footprint_area": round(float(shapely.area(solid.base)), 3),
        "roof_type": solid.roof_type,
        "height_sigma": mean(sections.sigma),
        "position_sigma": mean(sections.spread),
        "faithful": faithful(sections, solid),
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
        kinds = [_semantics(s, sections, solid, convergence) for s in shell]
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


def _semantics(surface: Surface, sections: Sections, solid: Solid, convergence: float) -> dict[str, Any]:
    """A surface's semantic object: what it is, and for roofs how they lie and the section they come from (not in one block)."""
    if surface.kind == WALL:
        end, start = (surface.rings[0][k][:2] for k in (0, -1))
        party = (start, end) in solid.party
        return {"type": WALL, "exterior": surface.exterior and not party, **({"party_wall": True} if party else {})}
    if surface.kind == GROUND:
        return {"type": GROUND}
    nx, ny, nz = np.sum([gate.newell(ring) for ring in surface.rings], axis=0)
    slope, azimuth = (float(v) for v in slope_azimuth(-nx / nz, -ny / nz, convergence))
    found: dict[str, Any] = {"type": ROOF}
    if solid.lod != "1.2":
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
