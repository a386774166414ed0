"""DSM: `dsm.tif`, terrain and buildings as one surface, in the map frame.

In: the scene, its terrain, the blocks' meshes. Out: absolute heights (m, float32), a Cloud Optimized GeoTIFF with the grid's
pixels laid over where things *stand* (`scene.standing`): a pixel has the height of the highest roof over its centre, or of
the terrain where that is higher. What was moved beyond the raster's edge is cut off. Pixels are worked on in windows, so
memory does not grow with the raster.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray

from kibs_steps import cli, view, zbuffer
from kibs_steps import scene as scenes
from kibs_steps.grid import Grid
from kibs_steps.mesh import KINDS, Mesh, meshes
from kibs_steps.publish import licences
from kibs_steps.publish.rasters import CACHE, SIDE, cloud_optimized


class Roofs(NamedTuple):
    """Roof faces of the whole city as numbers: `points` (n, 3) map m of all rings, how many of them each ring has, how many
    rings each face has, and the faces' boxes in plan (left, bottom, right, top)."""

    points: NDArray[np.float64]
    ends: NDArray[np.int64]  # of rings, in `points`
    last: NDArray[np.int64]  # of faces, in `ends`
    boxes: NDArray[np.float64]

    def over(self, frame: Grid) -> list[zbuffer.Polygon]:
        """The faces whose boxes meet a frame, in order."""
        left, bottom, right, top = frame.bounds
        x0, y0, x1, y1 = self.boxes.T
        found = []
        for face in np.flatnonzero((x0 <= right) & (x1 >= left) & (y0 <= top) & (y1 >= bottom)):
            rings = range(self.last[face - 1] if face else 0, self.last[face])
            ring, *holes = (self.points[self.ends[r - 1] if r else 0 : self.ends[r]] for r in rings)
            found.append(zbuffer.Polygon(ring, tuple(holes)))
        return found


def roofs(found: Iterable[Mesh]) -> Roofs:
    """The roof faces of the published solids."""
    points, lengths, counts, boxes = [np.zeros((0, 3))], [], [], [np.zeros((0, 4))]
    for mesh in found:
        rings = [face for face, kind in zip(mesh.rings, mesh.kind, strict=True) if KINDS[kind] == "RoofSurface"]
        if not rings:
            continue
        counts += map(len, rings)
        lengths += [len(ring) for face in rings for ring in face]
        points.append(np.concatenate([ring for face in rings for ring in face]))
        boxes.append(np.array([[*face[0][:, :2].min(axis=0), *face[0][:, :2].max(axis=0)] for face in rings]))
    ends, last = (np.cumsum(numbers, dtype=np.int64) for numbers in (lengths, counts))
    return Roofs(np.concatenate(points), ends, last, np.concatenate(boxes))


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
    parser.add_argument("--meshes", nargs="+", required=True, help="meshes.parquet of every block")
    parser.add_argument(
        "--models", nargs="*", default=[], help="models/*.json: their licence goes into the file's tags"
    )
    parser.add_argument("--out", required=True, help="out: dsm.tif")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    found = roofs(meshes(args.meshes))
    tags = {"UNIT": "m", **({"LICENCE": line} if (line := licences.line(args.models)) else {})}
    grid = scene.standing
    with (
        rasterio.Env(GDAL_CACHEMAX=CACHE),
        cloud_optimized(args.out, grid, "float32", float("nan"), tags) as target,
    ):
        for window in grid.windows(SIDE):
            frame = grid.part(window)
            target.write(surface(found, frame, scene.terrain(frame.bounds)), 1, window=rasterio.windows.Window(*window))


if __name__ == "__main__":
    cli.run(main, pandas=False)
