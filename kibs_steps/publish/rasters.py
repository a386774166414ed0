"""Rasters: `labels.tif` and `heights.tif`, what every pixel of the model grid shows, in the image frame.

In: the scene and its sections with planes. Out: two Cloud Optimized GeoTIFFs. A pixel has the `section_id` of the section
whose outline holds its centre, 0 where there is none; where outlines overlap, of the one nearer to the satellite. Its height
is that of the point where its view ray meets the section's plane, in metres above the terrain under that point.
Pixels are worked on in windows, so memory does not grow with the raster.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, store, view, zbuffer
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.planes import middle_of
from kibs_steps.publish import licences
from kibs_steps.scene import Scene
from kibs_steps.view import Plane

SIDE = 1024  # px: side of the windows, a multiple of the files' own blocks
CACHE = 64  # MB that GDAL may keep; its default grows with the machine
PLANE = ("plane_a", "plane_b", "plane_c", "x0", "y0")


class IdsTooLarge(KibsError):
    """Section ids that do not fit the label raster."""


class Sections(NamedTuple):
    """Sections with planes, by id: outline as WKB (px), its bounds (n, 4) px, plane parameters (n, 5)."""

    ids: NDArray[np.int64]
    outlines: NDArray[np.object_]
    bounds: NDArray[np.float64]
    planes: NDArray[np.float64]

    def near(self, window: Window) -> Sections:
        """The sections whose bounds meet a window (px)."""
        b = self.bounds
        right, bottom = window.col + window.width, window.row + window.height
        rows = (b[:, 0] < right) & (b[:, 2] > window.col) & (b[:, 1] < bottom) & (b[:, 3] > window.row)
        return Sections(*(column[rows] for column in self))


def read(paths: list[str]) -> Sections:
    """Read the sections with planes of all blocks. Raises `IdsTooLarge` for a grid beyond 65,536 px square."""
    parts = []
    for some in store.merged(paths, ["section_id"], ["section_id", "outline", *PLANE]):
        planes = np.column_stack([some[name].to_numpy().astype(float) for name in PLANE]).reshape(-1, 5)
        known = np.isfinite(planes).all(axis=1)
        outlines = some["outline"].to_numpy()[known]
        bounds = shapely.bounds(shapely.from_wkb(outlines)).reshape(-1, 4)
        parts.append((some["section_id"].to_numpy()[known], outlines, bounds, planes[known]))
    found = Sections(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    if len(found.ids) and found.ids[-1] > np.iinfo(np.uint32).max:
        raise IdsTooLarge(f"section id {found.ids[-1]} does not fit labels.tif (uint32): cut the raster with aoi=FILE")
    return found


def shown(sections: Sections, scene: Scene, window: Window) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """Labels and heights (height, width) of a window: `section_id`, 0 where there is none; m above ground, NaN there."""
    labels = np.zeros((window.height, window.width), np.uint32)
    heights = np.full(labels.shape, np.nan, np.float32)
    near = sections.near(window)
    if not len(near.ids):
        return labels, heights
    frame = scene.grid.part(window)
    terrain = scene.terrain(frame.bounds)
    projected_on = scene.projected_on(terrain)

    # A vertex is lifted along its ray to its section's plane: one parallel view over height 0 shows it where the image does.
    rings, owner = shapely.get_rings(shapely.from_wkb(near.outlines), return_index=True)
    points, ring = shapely.get_coordinates(rings, return_index=True)
    image = scene.grid.to_map(points)
    lean = scene.leans(middle_of(shapely.from_wkb(near.outlines), scene))
    _, z = view.ray_meets_plane(image, Plane(*near.planes[owner[ring]].T), lean[owner[ring]], projected_on)
    lifted = np.column_stack([image + z[:, None] * scene.lean, z])
    parts = [part[:-1] for part in np.split(lifted, np.flatnonzero(np.diff(ring)) + 1)]
    first = np.searchsorted(owner, np.arange(len(near.ids) + 1))
    faces = [zbuffer.Polygon(parts[start], tuple(parts[start + 1 : end])) for start, end in pairwise(first)]
    face = zbuffer.render_faces(faces, scene.lean, frame).face

    rows, cols = np.nonzero(face >= 0)
    section = face[rows, cols]
    image = frame.to_map(np.column_stack([cols, rows]) + 0.5)
    standing, z = view.ray_meets_plane(image, Plane(*near.planes[section].T), lean[section], projected_on)
    labels[rows, cols] = near.ids[section]
    heights[rows, cols] = z - terrain(standing)
    return labels, heights


@contextlib.contextmanager
def cloud_optimized(
    path: str | Path, grid: Grid, dtype: str, nodata: float | None, tags: dict[str, str], bands: int = 1
) -> Iterator:
    """A raster on a grid, open for writing by window; a COG under its name once the block ends without error.

    Overviews are decimated, not averaged: a label or the height of one roof stays what it is.
    """
    import rasterio.shutil

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    form = {
        "compress": "deflate",
        "zlevel": 6,
        "predictor": 3 if dtype.startswith("float") else 2,
        "bigtiff": "if_safer",
    }
    size = {"width": grid.width, "height": grid.height, "count": bands}
    place = {"crs": grid.crs, "transform": grid.transform}
    with tempfile.TemporaryDirectory(prefix=".tmp-", dir=path.parent) as folder:
        plain = Path(folder) / "plain.tif"
        tiles = {"tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True}
        with rasterio.open(
            plain, "w", driver="GTiff", dtype=dtype, nodata=nodata, **size, **place, **form, **tiles
        ) as target:
            target.update_tags(**tags)
            yield target
        with store.whole(path) as temporary:
            options = {"COMPRESS": "DEFLATE", "LEVEL": 6, "PREDICTOR": "YES", "BIGTIFF": "IF_SAFER", "BLOCKSIZE": 512}
            rasterio.shutil.copy(plain, temporary, driver="COG", OVERVIEW_RESAMPLING="NEAREST", **options)


def main(argv: list[str] | None = None) -> None:
    """Write the label and height rasters of a scene."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.rasters", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--sections", required=True, nargs="+", help="buildings.parquet of all blocks")
    parser.add_argument(
        "--models", nargs="*", default=[], help="models/*.json: their licence goes into the files' tags"
    )
    parser.add_argument("--labels", required=True, help="out: labels.tif")
    parser.add_argument("--heights", required=True, help="out: heights.tif")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    sections = read(args.sections)
    tags = {"LICENCE": line} if (line := licences.line(args.models)) else {}
    with (
        rasterio.Env(GDAL_CACHEMAX=CACHE),
        cloud_optimized(args.labels, scene.grid, "uint32", 0, tags) as labels,
        cloud_optimized(
            args.heights, scene.grid, "float32", float("nan"), {**tags, "UNIT": "m above ground"}
        ) as heights,
    ):
        for window in scene.grid.windows(SIDE):
            place = rasterio.windows.Window(*window)
            for target, values in zip((labels, heights), shown(sections, scene, window), strict=True):
                target.write(values, 1, window=place)


if __name__ == "__main__":
    cli.run(main, pandas=False)
