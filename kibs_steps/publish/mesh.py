"""Meshes: the published solids as triangles, for formats that know nothing else.

In: the blocks' `solids.city.jsonl`. Out: one `Mesh` per building, in order of building ids. Faces are triangulated one by one
with
all their vertices and no others (constrained Delaunay), so the triangles of a valid solid are watertight too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely

from kibs_steps.publish import cityjson

KINDS = ("RoofSurface", "WallSurface", "GroundSurface")
COLOURS = np.array([[176, 84, 66], [229, 222, 208], [140, 138, 130]], np.uint8)  # by kind


class Mesh(NamedTuple):
    """A building: id, attributes, surfaces (semantic objects), rings of each surface (map m, exterior first), triangles.

    `triangles` (t, 3, 3) are map metres seen counter-clockwise from outside, `surface` (t,) the surface each belongs to,
    `kind` (n,) the kind of each surface as a place in `KINDS`.
    """

    building: int
    attributes: dict[str, Any]
    surfaces: list[dict[str, Any]]
    kind: np.ndarray
    rings: list[list[np.ndarray]]
    triangles: np.ndarray
    surface: np.ndarray


def meshes(paths: Sequence[str | Path]) -> Iterator[Mesh]:
    """The buildings with a solid, one after the other. Raises `store.DamagedFile`."""
    lines = [line for path in paths for line in cityjson.index_of(path)[0]]
    placed = {str(path): cityjson.transform(path) for path in paths}
    for line in sorted(lines, key=lambda line: line.building):
        mesh = mesh_of(cityjson.feature_at(line), placed[line.path])
        if len(mesh.triangles):
            yield mesh


def mesh_of(feature: dict[str, Any], placed: dict[str, Any]) -> Mesh:
    """The mesh of a CityJSONFeature; `placed` is its transform."""
    vertices = np.array(feature["vertices"], np.int64).reshape(-1, 3)
    objects = feature["CityObjects"]
    surfaces, faces = [], []
    for thing in objects.values():
        for geometry in thing.get("geometry", []):
            if geometry["type"] != "Solid":
                continue
            for face, meaning in zip(geometry["boundaries"][0], geometry["semantics"]["values"][0], strict=True):
                surfaces.append(geometry["semantics"]["surfaces"][meaning])
                faces.append([vertices[ring] for ring in face])
    triangles, surface = triangulated(faces)
    scale, origin = np.array(placed["scale"]), np.array(placed["translate"])
    return Mesh(
        int(feature["id"].rsplit("-", 1)[1]),
        objects[feature["id"]]["attributes"],
        surfaces,
        np.array([KINDS.index(s["type"]) for s in surfaces], np.int8),
        [[ring * scale + origin for ring in rings] for rings in faces],
        triangles * scale + origin,
        surface,
    )


def triangulated(faces: list[list[np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3, 3) of planar faces (rings of integer points, exterior first) and the face of each (t,).

    Every face is laid flat by dropping the coordinate its normal is longest in, so points keep their integers and are found
    again.
    """
    if not faces:
        return np.zeros((0, 3, 3), np.int64), np.zeros(0, np.int64)
    normals = np.array([sum(_area_vector(ring) for ring in rings) for rings in faces])
    drop = np.abs(normals).argmax(axis=1)
    axes = np.array([(1, 2), (0, 2), (0, 1)])[drop]
    flat = [shapely.Polygon(r[0][:, a], [h[:, a] for h in r[1:]]) for r, a in zip(faces, axes, strict=True)]
    parts, face = shapely.get_parts(shapely.constrained_delaunay_triangles(flat), return_index=True)
    corners = np.rint(shapely.get_coordinates(parts)).astype(np.int64).reshape(-1, 4, 2)[:, :3]
    at = [
        {(int(p[a[0]]), int(p[a[1]])): p for ring in rings for p in ring} for rings, a in zip(faces, axes, strict=True)
    ]
    found = np.array([[at[f][u, v] for u, v in t] for f, t in zip(face, corners.tolist(), strict=True)], np.int64)
    turned = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
    inward = (turned * normals[face]).sum(axis=1) < 0
    found[inward] = found[inward][:, ::-1]
    return found, face


def _area_vector(ring: np.ndarray) -> np.ndarray:
    p = (ring - ring[0]).astype(float)
    return np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0) / 2


def indexed(mesh: Mesh, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3) in metres from `origin`, triangles (t, 3) of them, and each vertex's kind (n,): kinds share none."""
    kind = np.repeat(mesh.kind[mesh.surface], 3)
    corners = np.rint((mesh.triangles.reshape(-1, 3) - origin) * 1000)
    rows, index = np.unique(np.column_stack([kind, corners]), axis=0, return_inverse=True)
    return rows[:, 1:] / 1000, index.reshape(-1, 3), rows[:, 0].astype(np.int8)
