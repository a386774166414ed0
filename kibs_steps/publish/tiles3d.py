"""3D Tiles: `tiles3d/`, the city for web globes (3D Tiles 1.1): squares of the map as GLB, placed on the Earth.

In: the blocks' meshes. Out: `tileset.json` and one GLB per square of `SIDE` metres. Every vertex is brought to geocentric
coordinates by PROJ and stored in the local east-north-up frame of the scene's centre, so that the grid's convergence and scale
are right; the tileset's transform places that frame. Each vertex carries the number of its building (EXT_mesh_features), and a
property table says which that is (EXT_structural_metadata: `building_id, height, ground_z, volume`). Without a vertical CRS
heights count from the ellipsoid.
"""

from __future__ import annotations

import argparse
import functools
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from kibs_steps import cli, georeference, store, sums
from kibs_steps import scene as scenes
from kibs_steps.mesh import LINEAR, Mesh, by_kind, read
from kibs_steps.publish import licences
from kibs_steps.publish.glb import MATT
from kibs_steps.publish.gltf import Glb, y_up

SIDE = 256.0  # m
KEPT = 16  # blocks in memory
GEOCENTRIC = "EPSG:4978"
NUMBERS = {"building_id": np.uint32, "height": np.float32, "ground_z": np.float32, "volume": np.float32}


class Earth:
    """From map metres to the east-north-up frame of a place on the Earth."""

    def __init__(self, crs: str, vertical: str | None, x: float, y: float) -> None:
        known = pyproj.CRS.from_user_input(crs)
        if vertical is None:
            whole = known.to_3d()
        else:
            up = pyproj.CRS.from_user_input(vertical)
            whole = pyproj.crs.CompoundCRS(f"{known.name} + {up.name}", [known, up])
        self.geocentric = pyproj.Transformer.from_crs(whole, GEOCENTRIC, always_xy=True)
        degrees = pyproj.Transformer.from_crs(known, georeference.DEGREES, always_xy=True)
        lon, lat = np.radians(degrees.transform(x, y))
        east = [-np.sin(lon), np.cos(lon), 0.0]
        north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
        up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
        self.axes = np.array([east, north, up])
        self.origin = np.array(self.geocentric.transform(x, y, 0.0))

    def local(self, points: np.ndarray) -> np.ndarray:
        """East, north, up (n, 3) in metres of map points (n, 3)."""
        return (np.column_stack(self.geocentric.transform(*points.T)) - self.origin) @ self.axes.T

    @property
    def transform(self) -> list[float]:
        """The frame's place as a 4×4 matrix, column by column."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.axes.T, self.origin
        return matrix.T.ravel().tolist()


def content(path: Path, found: list[Mesh], earth: Earth) -> np.ndarray:
    """Write the GLB of some buildings; returns their bounds (2, 3) in the local frame."""
    every, faces, colours, number = [], [], [], []
    used = 0
    for k, mesh in enumerate(found):
        points, index, kind = by_kind(mesh)
        every.append(points)
        faces.append(index + used)
        colours.append(LINEAR[kind])
        number.append(np.full(len(points), k, np.float32))
        used += len(points)
    points, colour = earth.local(np.concatenate(every)), np.concatenate(colours)
    centre = np.round((points.min(axis=0) + points.max(axis=0)) / 2)
    with Glb(path.parent) as glb:
        opaque = np.column_stack([colour, np.full(len(colour), 255, np.uint8)])
        attributes = {
            "COLOR_0": glb.accessor("colours", opaque, normalized=True),
            "_FEATURE_ID_0": glb.accessor("features", np.concatenate(number)),
        }
        body = {**glb.primitive(y_up(points - centre), np.concatenate(faces), **attributes), "material": 0}
        ids = {"featureCount": len(found), "attribute": 0, "propertyTable": 0}
        body["extensions"] = {"EXT_mesh_features": {"featureIds": [ids]}}
        mesh = glb.add("meshes", {"name": "buildings", "primitives": [body]})
        node = {"name": "buildings", "mesh": mesh, "translation": y_up(centre[None])[0].tolist()}
        more = {"materials": [MATT], "extensionsUsed": ["EXT_mesh_features", "EXT_structural_metadata"]}
        more["extensions"] = {"EXT_structural_metadata": _properties(glb, found)}
        glb.save(path, {"nodes": [glb.add("nodes", node)]}, **more)
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _properties(glb: Glb, found: list[Mesh]) -> dict[str, Any]:
    """The property table of buildings and its schema."""
    columns = {}
    for name, kind in NUMBERS.items():
        values = [mesh.building if name == "building_id" else mesh.attributes.get(name) or 0.0 for mesh in found]
        columns[name] = {"values": glb.view(f"property {name}", np.array(values, kind).tobytes())[0]}
    table = {"name": "buildings", "class": "building", "count": len(found), "properties": columns}
    types = {np.uint32: "UINT32", np.float32: "FLOAT32"}
    properties = {name: {"type": "SCALAR", "componentType": types[kind]} for name, kind in NUMBERS.items()}
    schema = {"id": "kibs", "classes": {"building": {"properties": properties}}}
    return {"schema": schema, "propertyTables": [table]}


def box(bounds: np.ndarray) -> dict[str, list[float]]:
    """A bounding volume: centre and half axes of an upright box; bounds (2, 3)."""
    half = np.maximum((bounds[1] - bounds[0]) / 2, 0.5)
    return {"box": [round(float(v), 3) for v in (*bounds.mean(axis=0), half[0], 0, 0, 0, half[1], 0, 0, 0, half[2])]}


def squares(paths: Sequence[str]) -> Iterator[tuple[tuple[int, int], list[Mesh]]]:
    """Squares of the map (column, row of `SIDE` m) with the buildings whose middle they hold, in order.

    What is in memory is a number for each building, and the blocks that the square's buildings come from.
    """
    of: dict[tuple[int, int], list[tuple[str, int]]] = defaultdict(list)
    for path in paths:
        for k, mesh in enumerate(read(store.read_table(path))):
            middle = (mesh.vertices[:, :2].min(axis=0) + mesh.vertices[:, :2].max(axis=0)) / 2
            of[tuple(int(v) for v in middle // SIDE)].append((path, k))
    table = functools.lru_cache(maxsize=KEPT)(store.read_table)
    for place in sorted(of):
        found = [next(read(table(path).slice(k, 1))) for path, k in of[place]]
        yield place, sorted(found, key=lambda mesh: mesh.building)


def write(
    folder: Path, found: Iterable[tuple[tuple[int, int], list[Mesh]]], earth: Earth, asset: dict[str, Any]
) -> None:
    """Write the tileset into a new folder, square by square."""
    children, bounds = [], []
    for place, buildings in found:
        name = f"{place[0]}_{place[1]}.glb"
        with store.whole(folder / name) as temporary:
            extent = content(temporary, buildings, earth)
        children.append({"boundingVolume": box(extent), "geometricError": 0.0, "content": {"uri": name}})
        bounds.append(extent)
    whole = np.stack([np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]]) if bounds else np.zeros((2, 3))
    error = round(float(np.linalg.norm(whole[1] - whole[0])), 3)
    root = {"transform": earth.transform, "boundingVolume": box(whole), "geometricError": error, "refine": "ADD"}
    if children:
        root["children"] = children
    tileset = {"asset": {"version": "1.1", **asset}, "geometricError": 2 * error, "root": root}
    store.write_json(folder / "tileset.json", tileset)


def main(argv: list[str] | None = None) -> None:
    """Write the city as 3D Tiles."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.tiles3d", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--meshes", nargs="+", required=True, help="meshes.parquet of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences go into the asset")
    parser.add_argument("--out", required=True, help="out: tileset.json in a folder of its own")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    left, bottom, right, top = scene.grid.bounds
    vertical = store.read_json(args.scene).get("vertical_crs")
    earth = Earth(scene.grid.crs, vertical, (left + right) / 2, (bottom + top) / 2)
    if lacking := georeference.missing_geoid(scene.grid.crs, vertical):
        print(
            f"warning: PROJ lacks the geoid {lacking}: heights of {vertical} are taken from the ellipsoid",
            file=sys.stderr,
        )
    told = {"title": scene.name, "licence": licences.line(args.models)}
    folder = Path(args.out).parent
    making = folder.with_name(f".tmp-{folder.name}")
    shutil.rmtree(making, ignore_errors=True)
    making.mkdir(parents=True)
    write(making, squares(args.meshes), earth, {"extras": {k: v for k, v in told.items() if v}})
    for path in folder.glob("[!.]*"):  # what a user put there, or changed and `verify` set aside: what is made has sums
        if not sums.place(path).exists() and not (making / path.name).exists():
            path.rename(making / path.name)
    shutil.rmtree(folder, ignore_errors=True)
    making.rename(folder)


if __name__ == "__main__":
    cli.run(main, pandas=False)
