"""Real cities: LOD2 buildings of a CityJSON file (0.8 to 2.0) or a CityJSONSeq, as faces the simulator can render.

A **building** is a top-level city object with all its parts. Of each object the geometry of the highest LOD below 3 counts, LOD 2
at least; where there is none, one of LOD 3. Its roof surfaces, terraces too, are roof sections; neighbouring ones in one
plane are one section. Surfaces without semantics are told apart by their normals.

In: a file. Out: a `CityModel`, map metres of the file's own CRS, absolute z. Raises `UnusableCity`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kibs_steps.errors import KibsError
from kibs_steps.zbuffer import Polygon, planes

UPRIGHT = 0.05  # vertical part of a unit normal below which a surface is a wall
ONE_PLANE = 0.05  # m: corners this near to a neighbour's plane lie in it
BENT = 0.2  # m: a surface with corners this far off its plane is cut into triangles
ARCHED = 0.25  # m from their common plane, beyond which faces that are one in pairs are a vault
STRAIGHT = 0.01  # m: a corner this near to the line through its neighbours is none


class UnusableCity(KibsError):
    """A file that gives no LOD2 buildings."""


class Building(NamedTuple):
    """Roof sections and walls (rings and holes, normals up and outwards), the lowest z (m), middle of the plan and reach (m)."""

    name: str
    roofs: list[Polygon]
    walls: list[Polygon]
    base: float
    centre: tuple[float, float]
    reach: float


class CityModel(NamedTuple):
    """A city: its CRS (None: not stated), buildings, and terrain points (n, 3) where the file has a terrain."""

    name: str
    crs: str | None
    buildings: list[Building]
    terrain: np.ndarray | None


def read(path: str | Path) -> CityModel:
    """The buildings of a CityJSON file or CityJSONSeq with LOD2 geometry. Raises `UnusableCity`."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UnusableCity(f"{path} cannot be read: give a CityJSON file (.json) or a CityJSONSeq (.jsonl)") from error
    try:
        documents = [json.loads(text)]
    except json.JSONDecodeError:
        try:
            documents = [json.loads(line) for line in text.split("\n") if line.strip()]
        except json.JSONDecodeError as error:
            raise UnusableCity(f"{path} is not JSON (line {error.lineno}): give CityJSON or CityJSONSeq") from error
    if not documents or not isinstance(documents[0], dict) or documents[0].get("type") != "CityJSON":
        raise UnusableCity(f"{path} is not CityJSON: its `type` says so, and a CityJSONSeq starts with such a line")
    header = documents[0]
    buildings: list[Building] = []
    ground: list[np.ndarray] = []
    try:
        for document in documents:
            # A feature has vertices of its own; where they lie stands in the header.
            corners = _vertices(document.get("vertices") or [], header.get("transform"))
            objects = document.get("CityObjects") or {}
            buildings += _buildings(objects, corners)
            for item in objects.values():
                if item.get("type") == "TINRelief":
                    used = [i for g in item.get("geometry") or [] for i in _flat(g["boundaries"])]
                    ground += [corners[np.unique(np.array(used, int))]]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UnusableCity(f"{path} is not sound CityJSON ({error!r}): check it with cjval, and mend it") from error
    if not buildings:
        raise UnusableCity(f"{path} has no building with LOD2 roofs: LOD1 blocks show the simulator no roof sections")
    system = (header.get("metadata") or {}).get("referenceSystem")
    points = np.concatenate([*ground, np.zeros((0, 3))])
    return CityModel(path.name, _horizontal(system), buildings, points if _spans(points) else None)


def _spans(points: np.ndarray) -> bool:
    """Whether points (n, 3) span an area in plan, as those of a terrain do."""
    return len(points) >= 3 and np.linalg.matrix_rank(points[1:, :2] - points[0, :2], tol=1e-6) == 2


def _horizontal(system: str | int | None) -> str | None:
    """The horizontal part of a reference system, "EPSG:n"; None where none is stated. Raises `UnusableCity` for degrees and for
    systems of others than EPSG."""
    system = str(system or "")
    # The URL or URN of one system, or of several: then the horizontal one comes first.
    codes = re.findall(r"EPSG(?::[^:,]*:|/[^/]*/|:)(\d+)", system, re.IGNORECASE) or re.findall(r"(\d+)/?$", system)
    if not system:
        return None
    if not codes:
        raise UnusableCity(f"the city's reference system {system} is not known: state one of EPSG's")
    import pyproj

    try:
        crs = pyproj.CRS.from_epsg(int(codes[0]))
    except pyproj.exceptions.CRSError as error:
        raise UnusableCity(f"the city's reference system {system} is not known: state one of EPSG's") from error
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    if flat.is_geographic:
        raise UnusableCity(f"the city's coordinates are degrees ({system}): reproject it to a system in metres")
    if not flat.is_projected or any(axis.unit_conversion_factor != 1.0 for axis in flat.axis_info):
        raise UnusableCity(f"the city's coordinates are not metres ({system}): reproject it to a system in metres")
    return f"EPSG:{flat.to_epsg() or codes[0]}"


def _vertices(stored: list, transform: dict[str, Any] | None) -> np.ndarray:
    corners = np.array(stored, float).reshape(-1, 3)
    return corners * transform["scale"] + transform["translate"] if transform else corners


def _flat(nested: list) -> list:
    """Vertex indices of nested boundaries, in order."""
    if not nested or not isinstance(nested[0], list):
        return nested
    return [i for part in nested for i in _flat(part)]


def _surfaces(geometry: dict[str, Any]) -> Iterator[tuple[list[list[int]], str | None]]:
    """Rings of vertex indices and the semantic type (or None) of each surface of a geometry."""
    semantics = geometry.get("semantics") or {}
    kinds = [s["type"] for s in semantics.get("surfaces") or []]

    def walk(boundaries: list, values: Any, depth: int) -> Iterator[tuple[list[list[int]], str | None]]:
        for i, part in enumerate(boundaries):
            value = (values[i] if i < len(values) else None) if isinstance(values, list) else values
            if depth:
                yield from walk(part, value, depth - 1)
            else:
                yield part, kinds[value] if value is not None and 0 <= value < len(kinds) else None

    depths = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
    yield from walk(geometry["boundaries"], semantics.get("values"), depths[geometry["type"]])


def _lod(geometry: dict[str, Any]) -> float:
    """The level of detail of surfaces, 0 where none is told."""
    surfaces = geometry["type"] in ("MultiSurface", "CompositeSurface", "Solid", "MultiSolid", "CompositeSolid")
    told = re.match(r"\d+(\.\d+)?", str(geometry.get("lod")))
    return float(told[0]) if surfaces and told else 0.0


def _buildings(objects: dict[str, Any], corners: np.ndarray) -> list[Building]:
    """The buildings among city objects, parts gathered under their top-level object, in the file's order."""
    whole = {name: o for name, o in objects.items() if o.get("type", "").startswith("Building")}  # groups are none
    above = {c: name for name, o in whole.items() for c in [*o.get("children", ()), *o.get("Parts", ())]}
    for name, item in whole.items():
        parent = item.get("parent") or next((p for p in item.get("parents", ()) if p in whole), None)
        if parent:
            above[name] = parent
    shells: dict[str, list[tuple[Polygon, str | None]]] = {}
    for name, item in objects.items():
        if name not in whole:
            continue
        detailed = [g for g in item.get("geometry") or [] if _lod(g) >= 2]
        chosen = max(detailed, key=lambda g: (_lod(g) < 3, _lod(g)), default=None)
        if chosen is None:
            continue
        top = name
        while top in above:
            top = above[top]
        for rings, kind in _surfaces(chosen):
            if not rings:
                continue
            outer, *inner = (_clean(corners[ring]) for ring in rings)
            if len(outer) >= 3:
                shells.setdefault(top, []).append((Polygon(outer, tuple(h for h in inner if len(h) >= 3)), kind))
    made = (_building(name, shell) for name, shell in shells.items())
    return [b for b in made if b.roofs]


def _clean(ring: np.ndarray) -> np.ndarray:
    """A ring without repeated corners (1 mm)."""
    apart = np.abs(ring - np.roll(ring, 1, axis=0)).max(axis=1) > 1e-3
    return ring[apart]


def _building(name: str, shell: list[tuple[Polygon, str | None]]) -> Building:
    plane = planes([face for face, _ in shell])
    normals = plane.normal
    if all(kind is None for _, kind in shell) and _inside_out(shell, plane.point, normals):
        shell = [(_turned(face), None) for face, _ in shell]
        normals = -normals
    roofs, walls = [], []
    for (face, kind), normal in zip(shell, normals, strict=True):
        if kind == "GroundSurface" or not normal.any():
            continue
        if abs(normal[2]) < UPRIGHT:
            walls.append(face)
        elif kind == "RoofSurface" or (kind in (None, "OuterFloorSurface") and normal[2] > 0):  # of these a terrace
            roofs.append(face if normal[2] > 0 else _turned(face))
        elif kind is not None:
            walls.append(face)
    points = np.concatenate([face.ring for face, _ in shell])
    low, high = points.min(0), points.max(0)
    centre = (low[:2] + high[:2]) / 2
    reach = float(np.hypot(*(points[:, :2] - centre).T).max())
    return Building(name, sections(roofs), walls, float(low[2]), (float(centre[0]), float(centre[1])), reach)


def _turned(face: Polygon) -> Polygon:
    """The face seen from its other side."""
    return Polygon(face.ring[::-1], tuple(hole[::-1] for hole in face.holes))


def _inside_out(shell: list[tuple[Polygon, str | None]], points: np.ndarray, normals: np.ndarray) -> bool:
    """Whether surfaces with walls among them show their inner sides: what they enclose is less than nothing. Only of solids it is
    said which way they turn."""
    if not (normals.any(axis=1) & (np.abs(normals[:, 2]) < UPRIGHT)).any():
        return False

    def area(ring: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0)) / 2)

    areas = np.array([area(face.ring) - sum(map(area, face.holes)) for face, _ in shell])
    middle = points.mean(axis=0)
    return bool((((points - middle) * normals).sum(axis=1) * areas).sum() < 0)


def sections(roofs: list[Polygon]) -> list[Polygon]:
    """Roof surfaces (normals up) as sections: bent ones are cut, neighbours in one plane become one, corners on straight
    lines go."""
    import shapely

    roofs = [part for face in roofs for part in _flattened(face)]
    if len(roofs) > 1:
        plane = planes(roofs)
        origin = roofs[0].ring[0]
        # To the millimetre, so that neighbours share their corners exactly.
        shapes = np.array(
            [
                shapely.Polygon(_millimetres(f.ring, origin), [_millimetres(h, origin) for h in f.holes]).buffer(0)
                for f in roofs
            ]
        )
        group = list(range(len(roofs)))
        for i, j in shapely.STRtree(shapes).query(shapes, predicate="intersects").T.tolist():
            if i < j and group[i] != group[j] and _one_plane(roofs, plane.normal, i, j):
                shared = shapely.intersection(shapes[i].boundary, shapes[j].boundary)
                both = [roofs[k] for k, g in enumerate(group) if g in (group[i], group[j])]
                if shared.length > 0.1 and _flat_together(both):
                    old = group[j]
                    group = [group[i] if g == old else g for g in group]
        merged = []
        for label in dict.fromkeys(group):
            members = [i for i, g in enumerate(group) if g == label]
            whole = shapely.union_all(shapes[members]) if len(members) > 1 else None
            if whole is None or whole.geom_type != "Polygon":
                merged += [roofs[i] for i in members]
            else:
                merged.append(_lifted(shapely.orient_polygons(whole), [roofs[i] for i in members], origin))
        roofs = merged
    straight = (Polygon(_straight(f.ring), tuple(_straight(h) for h in f.holes)) for f in roofs)
    return [f for f in straight if len(f.ring) >= 3]


def _flat_together(faces: list[Polygon]) -> bool:
    """Whether all corners of faces lie near one plane: facets of a vault do in pairs, and not together."""
    points = np.concatenate([face.ring for face in faces])
    points = points - points.mean(axis=0)
    normal = np.linalg.svd(points, full_matrices=False)[2][-1]
    return bool(np.abs(points @ normal).max() < ARCHED)


def _flattened(face: Polygon) -> list[Polygon]:
    """The face, or its triangles if its corners are not in one plane."""
    plane = planes([face])
    if np.abs((face.ring - plane.point[0]) @ plane.normal[0]).max() < BENT:
        return [face]
    import shapely

    points = np.concatenate([face.ring, *face.holes])
    shape = shapely.Polygon(face.ring[:, :2], [h[:, :2] for h in face.holes])
    if not shape.is_valid:
        return [face]
    cut = shapely.orient_polygons(shapely.get_parts(shapely.constrained_delaunay_triangles(shape)))
    corners = [np.array(t.exterior.coords)[:3] for t in cut]
    nearest = [np.argmin(((points[None, :, :2] - c[:, None]) ** 2).sum(2), axis=1) for c in corners]
    return [Polygon(points[index]) for index in nearest]


def _millimetres(ring: np.ndarray, origin: np.ndarray) -> np.ndarray:
    return np.round(ring[:, :2] - origin[:2], 3)


def _one_plane(roofs: list[Polygon], normals: np.ndarray, i: int, j: int) -> bool:
    """Whether the corners of two surfaces lie in each other's planes and the planes are hardly turned (2°)."""
    if normals[i] @ normals[j] < 0.9994:
        return False
    a, b = roofs[i].ring, roofs[j].ring
    off = np.concatenate([(a - b.mean(0)) @ normals[j], (b - a.mean(0)) @ normals[i]])
    return bool(np.abs(off).max() < ONE_PLANE)


def _lifted(whole: Any, parts: list[Polygon], origin: np.ndarray) -> Polygon:
    """A union in plan with the heights its corners had in the parts."""
    points = np.concatenate([r for f in parts for r in (f.ring, *f.holes)])
    known = {tuple(k): p for k, p in zip(_millimetres(points, origin).tolist(), points, strict=True)}
    centre = points.mean(0)
    fit = np.linalg.lstsq(
        np.column_stack([points[:, :2] - centre[:2], np.ones(len(points))]), points[:, 2] - centre[2], rcond=None
    )[0]

    def lift(ring: Any) -> np.ndarray:
        out = []
        for x, y in list(ring.coords)[:-1]:
            there = known.get((round(x, 3), round(y, 3)))
            if there is None:
                at = np.array([x, y]) + origin[:2]
                there = np.array([*at, centre[2] + fit[:2] @ (at - centre[:2]) + fit[2]])
            out.append(there)
        return np.array(out)

    return Polygon(lift(whole.exterior), tuple(lift(h) for h in whole.interiors))


def _straight(ring: np.ndarray) -> np.ndarray:
    """A ring without the corners that lie on the line through their neighbours."""
    kept = list(range(len(ring)))
    i = 0
    while len(kept) > 3 and i < len(kept):
        a, p, b = (ring[kept[(i + d) % len(kept)]] for d in (-1, 0, 1))
        along = b - a
        length = np.linalg.norm(along)
        off = np.linalg.norm(np.cross(along, p - a)) / length if length > 1e-6 else 0.0
        if off < STRAIGHT:
            del kept[i]
            i = max(i - 1, 0)
        else:
            i += 1
    return ring[kept]
