"""Viewer: `viewer.html`, the city in one file that any browser opens from disk, without a network.

In: the scene with its image and terrain, the blocks' solids. Out: HTML with everything inside: three.js (`three.min.js.gz`:
the names that
`three.entry.js` lists, bundled and minified by esbuild from three 0.187, its licence header kept), the viewer's own script,
and the
city as gzipped arrays in base64. Solids come triangulated (`publish.mesh`), so the browser needs no triangulation of its own.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import html
import io
import json
from collections.abc import Iterable
from importlib import resources
from typing import Any

import numpy as np
from PIL import Image

from kibs_steps import picture, store
from kibs_steps import scene as scenes
from kibs_steps.publish import licences
from kibs_steps.publish.glb import origin_of
from kibs_steps.publish.mesh import Mesh, meshes
from kibs_steps.scene import Scene

LONGEST = 1400  # px: longer side of the image on the ground
TERRAIN = 160  # points of terrain along the longer side
NO_AZIMUTH = 65535
SHOWN = ("building_id", "lod", "lod_reason", "roof_type", "height", "ground_z", "eave_z", "ridge_z", "volume", "footprint_area",
         "n_sections", "height_sigma", "position_sigma", "position_corrected")  # fmt: skip


def packed(values: np.ndarray) -> dict[str, str]:
    """An array as gzipped little-endian bytes in base64."""
    kind = values.dtype.newbyteorder("<")
    content = gzip.compress(values.astype(kind).tobytes(), 9, mtime=0)
    return {"type": kind.str[1:], "gzip": base64.b64encode(content).decode()}


def arrays(found: Iterable[Mesh], origin: np.ndarray) -> tuple[dict[str, Any], dict[str, list[Any]], list[str]]:
    """The city's arrays, attributes of buildings by column, and the names of statuses.

    `positions` cm from `origin` (3 corners × 3 coordinates per triangle), `surface` of each triangle; of each surface
    `building` (row),
    `kind`, `slope` (deg), `azimuth` (deg, `NO_AZIMUTH` none), `status` (place in the names), `section` (id, 0 none).
    """
    rows: dict[str, list[Any]] = {name: [] for name in SHOWN}
    positions, surface, kind, owner, meaning = [], [], [], [], []
    for number, mesh in enumerate(found):
        for name in SHOWN:
            rows[name].append(mesh.building if name == "building_id" else mesh.attributes.get(name))
        positions.append(np.rint((mesh.triangles - origin) * 100).astype(np.int32).reshape(-1, 9))
        surface.append(mesh.surface + len(meaning))
        kind.append(mesh.kind)
        owner.append(np.full(len(mesh.kind), number))
        meaning += mesh.surfaces
    names = sorted({m["status"] for m in meaning if "status" in m}, key=lambda name: (name != "ok", name)) or ["ok"]
    azimuth = [round(m["azimuth"]) % 360 if "azimuth" in m else NO_AZIMUTH for m in meaning]
    columns = {
        "positions": np.concatenate([np.zeros((0, 9), np.int32), *positions]),
        "surface": np.concatenate([np.zeros(0, int), *surface]).astype(np.uint32),
        "building": np.concatenate([np.zeros(0, int), *owner]).astype(np.uint32),
        "kind": np.concatenate([np.zeros(0, np.int8), *kind]).astype(np.uint8),
        "slope": np.array([m.get("slope", 0.0) for m in meaning], np.float32),
        "azimuth": np.array(azimuth, np.uint16),
        "status": np.array([names.index(m.get("status", names[0])) for m in meaning], np.uint8),
        "section": np.array([m.get("section_id", 0) for m in meaning], np.uint32),
    }
    return {name: packed(values) for name, values in columns.items()}, rows, names


def terrain_of(scene: Scene, origin: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
    """The grid of the terrain shown (extent in metres from `origin`) and its heights, row by row from the north."""
    left, bottom, right, top = scene.grid.bounds
    longest = max(right - left, top - bottom)
    cols, rows = (max(2, round(TERRAIN * side / longest)) for side in (right - left, top - bottom))
    x, y = np.meshgrid(np.linspace(left, right, cols), np.linspace(top, bottom, rows))
    heights = scene.terrain(scene.grid.bounds)(np.column_stack([x.ravel(), y.ravel()]))
    extent = {"x0": left - origin[0], "y0": bottom - origin[1], "x1": right - origin[0], "y1": top - origin[1]}
    return {"cols": cols, "rows": rows, **{k: round(v, 3) for k, v in extent.items()}}, heights.astype(np.float32)


def page(scene: Scene, found: Iterable[Mesh], licence: str) -> str:
    """The whole HTML file."""
    origin = origin_of(scene)
    columns, buildings, statuses = arrays(found, origin)
    terrain, heights = terrain_of(scene, origin)
    columns["terrain"] = packed(heights)
    rgb, _ = picture.overview(scene, LONGEST)
    jpeg = io.BytesIO()
    Image.fromarray(rgb).save(jpeg, "JPEG", quality=80)
    known = [h for h in buildings["height"] if h is not None]
    where = "where they stand" if scene.view or scene.regions else "where they are seen (the view is unknown)"
    data = {
        "title": scene.name,
        "note": f"{len(buildings['building_id']):,} buildings {where}. {licence}".strip(),
        "origin": origin.tolist(),
        "highest": picture.nice_length(max(float(np.quantile(known, 0.98)), 1.0)) if known else 10.0,
        "statuses": statuses,
        "buildings": buildings,
        "terrain": terrain,
        "image": "data:image/jpeg;base64," + base64.b64encode(jpeg.getvalue()).decode(),
        "arrays": columns,
    }
    here = resources.files(__package__)
    three = gzip.decompress((here / "three.min.js.gz").read_bytes()).decode()
    text = (here / "viewer.html").read_text(encoding="utf-8")
    content = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    parts = {
        "TITLE": html.escape(scene.name),
        "THREE": three,
        "DATA": content,
        "VIEWER": (here / "viewer.js").read_text(encoding="utf-8"),
    }
    for name, part in parts.items():
        text = text.replace(f"@{name}@", part, 1)
    return text


def main(argv: list[str] | None = None) -> None:
    """Write the city as one HTML file."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.viewer", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--solids", nargs="+", required=True, help="solids.city.jsonl of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences are shown")
    parser.add_argument("--out", required=True, help="out: viewer.html")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    with store.whole(args.out) as temporary:
        temporary.write_text(page(scene, meshes(args.solids), licences.line(args.models)), encoding="utf-8")
