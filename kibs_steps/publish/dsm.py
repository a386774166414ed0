"""DSM: `dsm.tif`, terrain and buildings as one surface, in the map frame.

In: the scene, its terrain, the blocks' solids. Out: absolute heights (m, float32), a Cloud Optimized GeoTIFF with the grid's
pixels laid
over where things *stand*: a pixel has the height of the highest roof over its centre, else of the terrain. What was moved
beyond the
raster's edge is cut off. Pixels are worked on in windows, so memory does not grow with the raster.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, view, zbuffer
from kibs_steps import scene as scenes
from kibs_steps.grid import Grid
from kibs_steps.publish import licences
from kibs_steps.publish.mesh import KINDS, meshes
from kibs_steps.publish.rasters import CACHE, SIDE, cloud_optimized


class Roofs(NamedTuple):
    """Roof faces of the whole city, and a tree of their boxes in plan."""

    faces: list[zbuffer.Polygon]
    tree: shapely.STRtree

    def over(self, frame: Grid) -> list[zbuffer.Polygon]:
        """The faces whose boxes meet a frame, in a fixed order."""
        return [self.faces[k] for k in sorted(self.tree.query(shapely.box(*frame.bounds)))]


def roofs(paths: Sequence[str]) -> Roofs:
    """The roof faces of the published solids."""
    faces, boxes = [], []
    for mesh in meshes(paths):
        for k in np.flatnonzero(mesh.kind == KINDS.index("RoofSurface")):
            ring, *holes = mesh.rings[k]
            faces.append(zbuffer.Polygon(ring, tuple(holes)))
            boxes.append(shapely.box(*ring[:, :2].min(axis=0), *ring[:, :2].max(axis=0)))
    return Roofs(faces, shapely.STRtree(np.array(boxes, object)))


def surface(found: Roofs, frame: Grid, terrain: view.Surface) -> NDArray[np.float32]:
    """Heights (rows, cols) of roofs and terrain at the pixel centres of a frame."""
    rows, cols = np.mgrid[: frame.height, : frame.width]
    centres = frame.to_map(np.stack([cols, rows], axis=-1).reshape(-1, 2) + 0.5)
    ground = terrain(centres).reshape(frame.height, frame.width)
    near = found.over(frame)
    if near:
        ground = np.maximum(ground, zbuffer.render_faces(near, (0.0, 0.0), frame).height)
    return ground.astype(np.float32)


def main(argv: list[str] | None = None) -> None:
    """Write terrain and buildings as one height raster."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.dsm", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--solids", nargs="+", required=True, help="solids.city.jsonl of every block")
    parser.add_argument(
        "--models", nargs="*", default=[], help="models/*.json: their licence goes into the file's tags"
    )
    parser.add_argument("--out", required=True, help="out: dsm.tif")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    found = roofs(args.solids)
    tags = {"UNIT": "m", **({"LICENCE": line} if (line := licences.line(args.models)) else {})}
    with (
        rasterio.Env(GDAL_CACHEMAX=CACHE),
        cloud_optimized(args.out, scene.grid, "float32", float("nan"), tags) as target,
    ):
        for window in scene.grid.windows(SIDE):
            frame = scene.grid.part(window)
            target.write(surface(found, frame, scene.terrain(frame.bounds)), 1, window=rasterio.windows.Window(*window))


if __name__ == "__main__":
    cli.run(main)
