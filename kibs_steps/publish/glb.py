"""GLB: `city.glb`, the city for any 3D viewer: a node per building, coloured by kind of surface.

In: the blocks' solids; for roofs that wear the image, the scene. Out: one binary glTF 2.0. glTF is y-up: x is east, y up, z
south, in
metres from the origin that the scene's extras name; each node's mesh has the building's attributes as extras. Roofs with the
image
take it where each of their corners is *seen*.
"""

from __future__ import annotations

import argparse
import io
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from kibs_steps import cli, picture, store, view
from kibs_steps import scene as scenes
from kibs_steps.publish import licences
from kibs_steps.publish.mesh import COLOURS, KINDS, Mesh, indexed, meshes
from kibs_steps.scene import Scene

LONGEST = 4096  # px: longer side of the image on the roofs, the largest that every graphics card takes
MATT = {"name": "by kind", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}


def y_up(points: np.ndarray) -> np.ndarray:
    """(east, north, up) as glTF's (x, y, z)."""
    return np.column_stack([points[:, 0], points[:, 2], -points[:, 1]])


def coloured(mesh: Mesh, origin: np.ndarray) -> trimesh.Trimesh:
    """A building coloured by kind, y-up, in metres from `origin`."""
    points, faces, kind = indexed(mesh, origin)
    colours = np.column_stack([COLOURS[kind], np.full(len(kind), 255, np.uint8)])
    return trimesh.Trimesh(y_up(points), faces, vertex_colors=colours, process=False, metadata=extras(mesh))


def extras(mesh: Mesh) -> dict[str, Any]:
    """What a building's node tells."""
    return {"building_id": mesh.building, **mesh.attributes}


def draped(mesh: Mesh, origin: np.ndarray, scene: Scene, dtm: view.Surface, material: PBRMaterial) -> trimesh.Trimesh:
    """A building's roofs with the image on them, y-up, in metres from `origin`."""
    corners = mesh.triangles[mesh.kind[mesh.surface] == 0].reshape(-1, 3)
    lean = scene.leans(corners[:, :2])
    seen = view.image_position(corners[:, :2], corners[:, 2], lean, scene.projected_on(dtm))
    uv = scene.grid.to_image(seen) / (scene.grid.width, scene.grid.height)
    visual = trimesh.visual.TextureVisuals(uv=np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), material=material)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(y_up(corners - origin), faces, visual=visual, process=False)


def without_roofs(mesh: Mesh) -> Mesh:
    """A building's walls and ground."""
    keep = mesh.kind[mesh.surface] != 0
    return mesh._replace(triangles=mesh.triangles[keep], surface=mesh.surface[keep])


def city(found: Iterable[Mesh], origin: np.ndarray, extra: dict[str, Any], drape: Scene | None = None) -> bytes:
    """The GLB of buildings; `origin` (3,) map m; `drape`: the scene whose image the roofs wear."""
    world = trimesh.Scene(metadata=extra)
    material = None
    if drape is not None:
        material = PBRMaterial("image", baseColorTexture=photograph(drape), metallicFactor=0.0, roughnessFactor=1.0)
        dtm = drape.terrain(drape.grid.bounds)
    for mesh in found:
        base = np.floor(mesh.triangles.reshape(-1, 3).min(axis=0))
        shift = trimesh.transformations.translation_matrix(y_up((base - origin)[None])[0])
        name = f"building-{mesh.building}"
        if material is None:
            world.add_geometry(coloured(mesh, base), node_name=name, geom_name=name, transform=shift)
            continue
        world.add_geometry(coloured(without_roofs(mesh), base), node_name=name, geom_name=name, transform=shift)
        roofs = draped(mesh, base, drape, dtm, material)
        world.add_geometry(roofs, node_name=f"{name}-roof", geom_name=f"{name}-roof", parent_node_name=name)
    if not world.geometry:
        return empty(extra)
    return trimesh.exchange.gltf.export_glb(world, include_normals=False, tree_postprocessor=matt)


def photograph(scene: Scene) -> Image.Image:
    """The scene's image as a JPEG of at most `LONGEST` px."""
    rgb, _ = picture.overview(scene, min(LONGEST, max(scene.grid.width, scene.grid.height)))
    content = io.BytesIO()
    Image.fromarray(rgb).save(content, "JPEG", quality=88)
    return Image.open(content)


def matt(tree: dict[str, Any]) -> None:
    """Give every part without a material a matt one: glTF's own default is a mirror."""
    bare = [p for mesh in tree.get("meshes", []) for p in mesh["primitives"] if "material" not in p]
    if bare:
        tree.setdefault("materials", []).append(MATT)
    for part in bare:
        part["material"] = len(tree["materials"]) - 1


def empty(extra: dict[str, Any]) -> bytes:
    """A GLB without any building."""
    text = json.dumps({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"extras": extra}]}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


def origin_of(scene: Scene) -> np.ndarray:
    """Where the meshes' frame begins: the scene's lower left corner in whole metres, height 0."""
    return np.array([np.floor(scene.grid.bounds[0]), np.floor(scene.grid.bounds[1]), 0.0])


def about(scene: Scene, models: list[str]) -> dict[str, Any]:
    """What a file tells of the scene."""
    told = {
        "title": scene.name,
        "crs": scene.grid.crs,
        "origin": origin_of(scene).tolist(),
        "licence": licences.line(models),
    }
    return {key: value for key, value in told.items() if value} | {"colours": list(KINDS)}


def main(argv: list[str] | None = None) -> None:
    """Write the city as binary glTF."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.glb", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--solids", nargs="+", required=True, help="solids.city.jsonl of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences go into the extras")
    parser.add_argument("--drape", action="store_true", help="put the image on the roofs")
    parser.add_argument("--out", required=True, help="out: city.glb")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    content = city(meshes(args.solids), origin_of(scene), about(scene, args.models), scene if args.drape else None)
    with store.whole(args.out) as temporary:
        Path(temporary).write_bytes(content)


if __name__ == "__main__":
    cli.run(main)
