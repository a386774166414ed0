"""GLB: `city.glb`, the city for any 3D viewer: a node per building, coloured by kind of surface.

In: the blocks' meshes; for roofs that wear the image, the scene. Out: one binary glTF 2.0. glTF is y-up: x is east, y up, z
south, in metres from the origin that the scene's extras name; each node's mesh has the building's attributes as extras. Roofs
with the image take it where each of their corners is *seen*; they are a child node of their building's.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from kibs_steps import cli, picture, store, view
from kibs_steps import scene as scenes
from kibs_steps.mesh import KINDS, LINEAR, Mesh, by_kind, meshes
from kibs_steps.publish import licences
from kibs_steps.publish.gltf import Glb, y_up
from kibs_steps.scene import Scene

LONGEST = 4096  # px: longer side of the image on the roofs, the largest that every graphics card takes
# glTF's own default is a mirror.
CLAMP_TO_EDGE = 33071  # of a glTF sampler
MATT = {"name": "by kind", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}
BY_KIND, IMAGE = 0, 1  # materials


def coloured(glb: Glb, mesh: Mesh, base: np.ndarray) -> dict[str, Any]:
    """A building coloured by kind as a primitive, in metres from `base`."""
    points, faces, kind = by_kind(mesh)
    opaque = np.column_stack([LINEAR[kind], np.full(len(kind), 255, np.uint8)])
    colours = glb.accessor("colours", opaque, normalized=True)
    return {**glb.primitive(y_up(points - base), faces, COLOR_0=colours), "material": BY_KIND}


def draped(glb: Glb, mesh: Mesh, base: np.ndarray, scene: Scene, dtm: view.Surface) -> dict[str, Any]:
    """A building's roofs with the image on them as a primitive, in metres from `base`."""
    roof = mesh.kind[mesh.face] == 0
    corners = mesh.triangles[roof].reshape(-1, 3)
    lean = np.zeros((len(corners), 2))
    if len(corners):  # of each section as a whole, as it was moved
        section = [surface.get("section_id", -1 - number) for number, surface in enumerate(mesh.surfaces)]
        of = np.unique(np.array(section)[mesh.face[roof]], return_inverse=True)[1].repeat(3)
        middle = np.column_stack([np.bincount(of, values) for values in corners.T]) / np.bincount(of)[:, None]
        lean = scene.leans_of(middle, dtm)[of]
    seen = view.image_position(corners[:, :2], corners[:, 2], lean, scene.projected_on(dtm))
    uv = scene.grid.to_image(seen) / (scene.grid.width, scene.grid.height)
    place = glb.accessor("image positions", uv.astype(np.float32))
    faces = np.arange(len(corners)).reshape(-1, 3)
    return {**glb.primitive(y_up(corners - base), faces, TEXCOORD_0=place), "material": IMAGE}


def without_roofs(mesh: Mesh) -> Mesh:
    """A building's walls and ground."""
    keep = mesh.kind[mesh.face] != 0
    return mesh._replace(index=mesh.index[keep], face=mesh.face[keep])


def write(
    path: Path, found: Iterable[Mesh], origin: np.ndarray, extra: dict[str, Any], drape: Scene | None = None
) -> None:
    """Write the GLB of buildings; `origin` (3,) map m; `drape`: the scene whose image the roofs wear."""
    more: dict[str, Any] = {"materials": [MATT]}
    with Glb(path.parent) as glb:
        if drape is not None:
            image, _ = glb.view("image", photograph(drape))
            texture = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
            more["materials"].append({"name": "image", "pbrMetallicRoughness": texture})
            more |= {
                "textures": [{"source": 0, "sampler": 0}],
                "images": [{"bufferView": image, "mimeType": "image/jpeg"}],
            }
            # Beyond the image's edge its rim goes on: repeated, as glTF has it else, a roof there would wear the other side.
            more["samplers"] = [{"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}]
            dtm = drape.terrain(drape.grid.bounds)
        top = []
        for mesh in found:
            name, base = f"building-{mesh.building}", np.floor(mesh.vertices.min(axis=0))
            body = coloured(glb, mesh if drape is None else without_roofs(mesh), base)
            extras = {"building_id": mesh.building, **mesh.attributes}
            node = {"mesh": glb.add("meshes", {"name": name, "primitives": [body], "extras": extras}), "name": name}
            if drape is not None:
                roof = {"name": f"{name}-roof", "primitives": [draped(glb, mesh, base, drape, dtm)]}
                child = {"mesh": glb.add("meshes", roof), "name": f"{name}-roof"}
                node["children"] = [glb.add("nodes", child)]
            node["translation"] = y_up((base - origin)[None])[0].tolist()
            top.append(glb.add("nodes", node))
        glb.save(path, {**({"nodes": top} if top else {}), "extras": extra}, **(more if top else {}))


def photograph(scene: Scene) -> bytes:
    """The scene's image as a JPEG of at most `LONGEST` px."""
    rgb, _ = picture.overview(scene, min(LONGEST, max(scene.grid.width, scene.grid.height)))
    content = io.BytesIO()
    Image.fromarray(rgb).save(content, "JPEG", quality=88)
    return content.getvalue()


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
    parser.add_argument("--meshes", nargs="+", required=True, help="meshes.parquet of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences go into the extras")
    parser.add_argument("--drape", action="store_true", help="put the image on the roofs")
    parser.add_argument("--out", required=True, help="out: city.glb")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    drape = scene if args.drape else None
    with store.whole(args.out) as temporary:
        write(temporary, meshes(args.meshes), origin_of(scene), about(scene, args.models), drape)


if __name__ == "__main__":
    cli.run(main, pandas=False)
