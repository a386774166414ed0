"""Meshes: solids as triangles, for formats that know nothing else.

Made once per block, with the solids, so that no published format parses or triangulates them again. In: CityJSON features.
Out: `meshes.parquet`, a row per building with a solid; read back as `Mesh`es in order of building ids, about a row of blocks in
memory. Faces are triangulated one by one with all their vertices and no others (constrained Delaunay), so the triangles of a
valid solid are watertight too.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import store

KINDS = ("RoofSurface", "WallSurface", "GroundSurface")
COLOURS = np.array([[176, 84, 66], [229, 222, 208], [140, 138, 130]], np.uint8)  # by kind, sRGB
# The same as shares of light: what glTF takes for the colours of vertices.
LINEAR = np.rint(255 * np.where(COLOURS <= 10, COLOURS / 255 / 12.92, ((COLOURS / 255 + 0.055) / 1.055) ** 2.4)).astype(
    np.uint8
)
NUMBERS = pa.list_(pa.int32())
MESHES = pa.schema(
    [
        ("building_id", pa.int64()),
        ("attributes", pa.string()),  # JSON
        ("surfaces", pa.string()),  # JSON, the distinct semantic objects
        ("origin", pa.list_(pa.float64())),  # map m, of the vertices
        ("vertices", NUMBERS),  # mm: x, y, z, x, y, z, …
        ("triangles", NUMBERS),  # places of vertices, three each
        ("face", NUMBERS),  # of each triangle
        ("meaning", NUMBERS),  # of each face, its place in `surfaces`
        ("rings", NUMBERS),  # how many rings each face has, exterior first
        ("lengths", NUMBERS),  # how many vertices each ring has
        ("corners", NUMBERS),  # places of vertices, ring after ring
    ]
)


class Mesh(NamedTuple):
    """A building: id, attributes, semantic object of each face; vertices (n, 3) map m; triangles and rings of places of vertices.

    `index` (t, 3) are seen counter-clockwise from outside, `face` (t,) is the face each belongs to, `kind` (f,) the kind of
    each face as a place in `KINDS`, `corners` the vertices of all rings, of which `lengths` (r,) belong to each, and `count` (f,)
    rings to each face.
    """

    building: int
    attributes: dict[str, Any]
    surfaces: list[dict[str, Any]]
    kind: np.ndarray
    vertices: np.ndarray
    index: np.ndarray
    face: np.ndarray
    count: np.ndarray
    lengths: np.ndarray
    corners: np.ndarray

    @property
    def triangles(self) -> np.ndarray:
        """(t, 3, 3) map m."""
        return self.vertices[self.index]

    @property
    def rings(self) -> list[list[np.ndarray]]:
        """The rings of each face (n, 3) map m, exterior first."""
        every = np.split(self.vertices[self.corners], np.cumsum(self.lengths)[:-1])
        ends = np.cumsum(self.count).tolist()
        return [every[a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]


def row_of(feature: dict[str, Any], origin: Sequence[float]) -> dict[str, Any] | None:
    """The row of a CityJSONFeature whose vertices are millimetres from `origin` (map m); None without a solid."""
    vertices = np.array(feature["vertices"], np.int64).reshape(-1, 3)
    surfaces: dict[str, int] = {}
    meaning, faces = [], []
    for thing in feature["CityObjects"].values():
        for geometry in thing.get("geometry", []):
            if geometry["type"] != "Solid":
                continue
            told = [json.dumps(kind) for kind in geometry["semantics"]["surfaces"]]
            faces += geometry["boundaries"][0]
            meaning += [surfaces.setdefault(told[k], len(surfaces)) for k in geometry["semantics"]["values"][0]]
    if not faces:
        return None
    triangles, face = triangulated(faces, vertices)
    return {
        "building_id": int(feature["id"].rsplit("-", 1)[1]),
        "attributes": json.dumps(feature["CityObjects"][feature["id"]]["attributes"]),
        "surfaces": f"[{','.join(surfaces)}]",
        "origin": [float(v) for v in origin],
        "vertices": vertices.ravel(),
        "triangles": triangles.ravel(),
        "face": face,
        "meaning": meaning,
        "rings": [len(rings) for rings in faces],
        "lengths": [len(ring) for rings in faces for ring in rings],
        "corners": [v for rings in faces for ring in rings for v in ring],
    }


def triangulated(faces: list[list[list[int]]], vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3) of planar faces and the face of each (t,); faces are rings of places in `vertices` (n, 3) int.

    Every face is laid flat by dropping the coordinate its normal is longest in, so points keep their integers and are found
    again.
    """
    if not faces:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    lengths = np.array([len(ring) for rings in faces for ring in rings])
    count = np.array([len(rings) for rings in faces])
    corner = np.array([v for rings in faces for ring in rings for v in ring])
    owner = np.repeat(np.repeat(np.arange(len(faces)), count), lengths)
    normals = area_vectors(vertices[corner], lengths, count)
    kept = np.array([(1, 2), (0, 2), (0, 1)])[np.abs(normals).argmax(axis=1)]
    flat = np.take_along_axis(vertices[corner], kept[owner], axis=1)
    shapes = polygons(flat.astype(float), lengths, count)
    parts, face = shapely.get_parts(shapely.constrained_delaunay_triangles(shapes), return_index=True)
    found = np.rint(shapely.get_coordinates(parts)).astype(np.int64).reshape(-1, 4, 2)[:, :3]

    def key(f: np.ndarray, at: np.ndarray) -> np.ndarray:
        """(face, u, v) as one number each, the same for the same."""
        low = flat.min(axis=0)
        wide = flat.max(axis=0) - low + 1
        return (f * wide[0] + (at[..., 0] - low[0])) * wide[1] + (at[..., 1] - low[1])

    known = key(owner, flat)
    order = np.argsort(known, kind="stable")
    place = order[np.searchsorted(known[order], key(face[:, None], found))]
    triangles = corner[place]
    side = np.cross(*(vertices[triangles[:, k]] - vertices[triangles[:, 0]] for k in (1, 2)))
    inward = (side * normals[face]).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles, face


def area_vectors(points: np.ndarray, lengths: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Twice the area of faces along their normals (f, 3), by Newell's rule.

    `points` (n, 3) ring after ring, `lengths` (r,) of the rings, `count` (f,) of the rings of each face.
    """
    owner = np.repeat(np.repeat(np.arange(len(count)), count), lengths)
    ends = np.cumsum(lengths)
    following = np.arange(len(points)) + 1
    following[ends - 1] = ends - lengths
    local = (points - points[np.searchsorted(owner, owner)]).astype(float)  # from each face's first point
    found = np.zeros((len(count), 3))
    np.add.at(found, owner, np.cross(local, local[following]))
    return found


def polygons(points: np.ndarray, lengths: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Polygons (f,) of rings in a plane: points (n, 2) ring after ring, rings and faces as in `area_vectors`."""
    rings = shapely.linearrings(points, indices=np.repeat(np.arange(len(lengths)), lengths))
    first = np.cumsum(count) - count
    shapes = shapely.polygons(rings[first])
    for f in np.flatnonzero(count > 1):
        shapes[f] = shapely.polygons(rings[first[f]], rings[first[f] + 1 : first[f] + count[f]])
    return shapes


def table(rows: list[dict[str, Any]]) -> pa.Table:
    """The rows of a block, in order of ids."""
    return pa.Table.from_pylist(sorted(rows, key=lambda row: row["building_id"]), MESHES)


def meshes(paths: Sequence[str | Path]) -> Iterator[Mesh]:
    """The buildings with a solid, one after the other, by id. Raises `store.DamagedFile`."""
    for some in store.merged(list(paths), ["building_id"]):
        yield from read(some)


def read(rows: pa.Table) -> Iterator[Mesh]:
    """The meshes of a table's rows."""
    lists, texts = {}, {}
    for name in MESHES.names[3:]:
        column = rows[name].combine_chunks()
        lists[name] = column.flatten().to_numpy(), np.r_[0, np.cumsum(column.value_lengths().to_numpy())]
    for name in MESHES.names[:3]:
        texts[name] = rows[name].to_pylist()
    for k, building in enumerate(texts["building_id"]):
        mine = {name: values[ends[k] : ends[k + 1]] for name, (values, ends) in lists.items()}
        distinct = json.loads(texts["surfaces"][k])
        kinds = np.array([KINDS.index(s["type"]) for s in distinct], np.int8)
        yield Mesh(
            building,
            json.loads(texts["attributes"][k]),
            [distinct[m] for m in mine["meaning"].tolist()],
            kinds[mine["meaning"]],
            mine["vertices"].reshape(-1, 3) / 1000 + mine["origin"],
            mine["triangles"].reshape(-1, 3),
            mine["face"],
            mine["rings"],
            mine["lengths"],
            mine["corners"],
        )


def by_kind(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3) map m, triangles (t, 3) of them, and each vertex's kind (n,): kinds share none."""
    kind = np.repeat(mesh.kind[mesh.face].astype(np.int64), 3)
    known, index = np.unique(kind * len(mesh.vertices) + mesh.index.ravel(), return_inverse=True)
    kind, vertex = np.divmod(known, max(len(mesh.vertices), 1))
    return mesh.vertices[vertex], index.reshape(-1, 3), kind
