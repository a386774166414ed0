"""Viewer: `viewer.html`, the city in one file that any browser opens from disk, without a network.

In: the scene with its image and terrain, the blocks' meshes. Out: HTML with everything inside: three.js (`three.min.js.gz`:
the names that `three.entry.js` lists, bundled and minified by esbuild from three 0.187, its licence header kept), the viewer's
own script, and the city as gzipped arrays in base64.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import html
import io
import json
import re
from collections.abc import Iterable
from importlib import resources
from typing import Any, TextIO

import numpy as np
from PIL import Image

from kibs_steps import picture, store
from kibs_steps import scene as scenes
from kibs_steps.mesh import Mesh, meshes
from kibs_steps.publish import licences
from kibs_steps.publish.glb import origin_of
from kibs_steps.publish.preview import by_height
from kibs_steps.scene import Scene
from kibs_steps.view import ground_position

LONGEST = 1400  # px: longer side of the image on the ground
TERRAIN = 160  # points of terrain along the longer side
NO_AZIMUTH = 65535
LEVEL = 6  # of compression
SHOWN = ("building_id", "lod", "lod_reason", "roof_type", "height", "ground_z", "eave_z", "ridge_z", "volume", "footprint_area",
         "n_sections", "height_sigma", "position_sigma", "position_corrected")  # fmt: skip


class Packed:
    """An array that grows, as gzipped little-endian bytes: memory holds it compressed."""

    def __init__(self, kind: str) -> None:
        self.kind, self.content = kind, io.BytesIO()
        self.file = gzip.GzipFile(fileobj=self.content, mode="wb", compresslevel=LEVEL, mtime=0)

    def add(self, values: np.ndarray) -> None:
        """Appends values."""
        self.file.write(np.asarray(values).astype(f"<{self.kind}").tobytes())

    def text(self) -> dict[str, str]:
        """The array as JSON has it, in base64."""
        self.file.close()
        return {"type": self.kind, "gzip": base64.b64encode(self.content.getvalue()).decode()}


BLOCK = "one block"  # of a building that stands as one, without sections
KINDS_OF = {"positions": "i4", "surface": "u4", "building": "u4", "kind": "u1", "slope": "f4", "azimuth": "u2", "status": "u1",
            "section": "u4"}  # fmt: skip


def arrays(found: Iterable[Mesh], origin: np.ndarray) -> tuple[dict[str, Any], dict[str, list[Any]], list[str]]:
    """The city's arrays, attributes of buildings by column, and the names of statuses.

    `positions` cm from `origin` (3 corners × 3 coordinates per triangle), `surface` of each triangle; of each surface
    `building` (row), `kind`, `slope` (deg), `azimuth` (deg, `NO_AZIMUTH` none), `status` (place in the names), `section` (id, 0
    none).
    """
    rows: dict[str, list[Any]] = {name: [] for name in SHOWN}
    packs = {name: Packed(kind) for name, kind in KINDS_OF.items()}
    names = ["ok"]
    surfaces = 0
    for number, mesh in enumerate(found):
        for name in SHOWN:
            rows[name].append(mesh.building if name == "building_id" else mesh.attributes.get(name))
        # A roof without sections has no status of one.
        of_surfaces = [
            m.get("status", BLOCK if kind == 0 else "ok") for m, kind in zip(mesh.surfaces, mesh.kind, strict=True)
        ]
        names += sorted(set(of_surfaces) - set(names))
        of_building = {
            "positions": np.rint((mesh.triangles - origin) * 100),
            "surface": mesh.face + surfaces,
            "building": np.full(len(mesh.kind), number),
            "kind": mesh.kind,
            "slope": np.array([m.get("slope", 0.0) for m in mesh.surfaces]),
            "azimuth": np.array([round(m["azimuth"]) % 360 if "azimuth" in m else NO_AZIMUTH for m in mesh.surfaces]),
            "status": np.array([names.index(status) for status in of_surfaces]),
            "section": np.array([m.get("section_id", 0) for m in mesh.surfaces]),
        }
        for name, values in of_building.items():
            packs[name].add(values)
        surfaces += len(mesh.kind)
    return {name: pack.text() for name, pack in packs.items()}, rows, names


def terrain_of(scene: Scene, origin: np.ndarray) -> tuple[dict[str, int], np.ndarray]:
    """The terrain shown: its columns and rows, and its points (n, 3; m, places from `origin`), row by row from the north.

    A point lies where the ground stands that the image shows at an even grid, so the image drapes over them evenly.
    """
    left, bottom, right, top = scene.grid.bounds
    longest = max(right - left, top - bottom)
    cols, rows = (max(2, round(TERRAIN * side / longest)) for side in (right - left, top - bottom))
    x, y = np.meshgrid(np.linspace(left, right, cols), np.linspace(top, bottom, rows))
    finest = longest / TERRAIN / 4  # of a fine model only so many heights are read
    dtm = scene.terrain(scene.grid.bounds, step=finest)
    seen = np.column_stack([x.ravel(), y.ravel()])
    place, z = ground_position(seen, np.zeros(len(seen)), dtm, scene.leans(seen), scene.projected_on(dtm))
    return {"cols": cols, "rows": rows}, np.column_stack([place - origin[:2], z]).astype(np.float32)


def write(out: TextIO, scene: Scene, found: Iterable[Mesh], licence: str) -> None:
    """Write the whole HTML file."""
    origin = origin_of(scene)
    columns, buildings, statuses = arrays(found, origin)
    terrain, ground = terrain_of(scene, origin)
    pack = Packed("f4")
    pack.add(ground)
    columns["terrain"] = pack.text()
    rgb, _ = picture.overview(scene, LONGEST)
    jpeg = io.BytesIO()
    Image.fromarray(rgb).save(jpeg, "JPEG", quality=80)
    known = [h for h in buildings["height"] if h is not None]
    where = "where they stand" if scene.view or scene.regions else "where they are seen (the view is unknown)"
    data = {
        "title": scene.name,
        "note": f"{len(buildings['building_id']):,} buildings {where}. {licence}".strip(),
        "origin": origin.tolist(),
        "highest": by_height(np.array(known, float))[1],
        "statuses": statuses,
        "buildings": buildings,
        "terrain": terrain,
        "image": "data:image/jpeg;base64," + base64.b64encode(jpeg.getvalue()).decode(),
        "arrays": columns,
    }
    here = resources.files(__package__)
    three = gzip.decompress((here / "three.min.js.gz").read_bytes()).decode()
    text = (here / "viewer.html").read_text(encoding="utf-8")
    parts = {
        "TITLE": html.escape(scene.name),
        "THREE": three,
        "VIEWER": (here / "viewer.js").read_text(encoding="utf-8"),
    }
    for piece in re.split(f"@({'|'.join(parts)}|DATA)@", text):
        if piece == "DATA":
            for some in json.JSONEncoder(separators=(",", ":"), allow_nan=False).iterencode(data):
                out.write(some.replace("</", "<\\/"))
        else:
            out.write(parts.get(piece, piece))


def main(argv: list[str] | None = None) -> None:
    """Write the city as one HTML file."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.viewer", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--meshes", nargs="+", required=True, help="meshes.parquet of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences are shown")
    parser.add_argument("--out", required=True, help="out: viewer.html")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    with store.whole(args.out) as temporary, temporary.open("w", encoding="utf-8") as out:
        write(out, scene, meshes(args.meshes), licences.line(args.models))
