"""Tiles: the part of the raster one block looks at, as 8-bit RGB on the model grid.

In: `scene.json` and the raster, of which only the block's window is read. Out: `tiles.tif`, RGBA of the block's core grown
by the margin; A = 0 where there is no data. Networks must see no black frames, so colour goes on beyond the data: pixels
within 32 px of data take the nearest colour, and so do those of the margin outside the grid (`sections.tile_image` shows
networks a mirror image there).
"""

from __future__ import annotations

import argparse

import numpy as np
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp, Resampling
from rasterio.vrt import WarpedVRT

from kibs_steps import cli, imagery, raster, scene
from kibs_steps.errors import KibsError
from kibs_steps.grid import Block, Grid, Tiling, Window
from kibs_steps.scene import Scene

FILL = 32  # px
AREA = 5  # px


class NoSuchBlock(KibsError):
    """A block that the scene's grid does not have."""


def read_block(scene: Scene, tiling: Tiling, block: Block) -> tuple[np.ndarray, np.ndarray]:
    """RGB uint8 (rows, cols, 3) and data mask bool (rows, cols) of the block's core grown by the margin.

    Every pixel depends on its own place in the grid alone, not on the cut into blocks. Raises `NoSuchBlock`.
    """
    grid = scene.grid
    core = tiling.block_core(block, grid.width, grid.height)
    if min(core) < 0 or core.width < 1 or core.height < 1:
        names = tiling.blocks(grid.width, grid.height)
        raise NoSuchBlock(f"scene {scene.name} has no block {block.name}: it has {names[0].name} to {names[-1].name}")
    return read_window(scene, core.grown(tiling.margin))


def read_window(scene: Scene, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """As `read_block`, any window that meets the grid."""
    inside = window.within(scene.grid)
    read = inside.grown(FILL).within(scene.grid)
    with imagery.opened(scene.raster) as source:
        values, valid = _values(source, scene, read)
    rgb = imagery.stretched(values, scene.stretch)
    top, left = inside.row - read.row, inside.col - read.col
    kept = (slice(top, top + inside.height), slice(left, left + inside.width))
    rgb, valid = _filled(rgb, valid), valid if scene.nodata is None else _without_specks(valid)
    rgb, valid = rgb[:, *kept], valid[kept]
    beyond = (
        (inside.row - window.row, window.row + window.height - inside.row - inside.height),
        (inside.col - window.col, window.col + window.width - inside.col - inside.width),
    )
    rgb = np.pad(rgb, ((0, 0), *beyond), mode="edge")
    return np.ascontiguousarray(rgb.transpose(1, 2, 0)), np.pad(valid, beyond)


def _values(source: rasterio.DatasetReader, scene: Scene, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Raw values (bands, rows, cols) and data mask of a window of the model grid."""
    offset = own_offset(source, scene.grid)
    if offset is not None:
        place = rasterio.windows.Window(window.col + offset[0], window.row + offset[1], window.width, window.height)
        return imagery.read(source, scene.bands, scene.nodata, window=place)
    place = rasterio.windows.Window(*window)
    with imagery.reading(source, place), on_grid(source, scene.grid, scene.nodata) as warped:
        alpha = warped.colorinterp.index(ColorInterp.alpha) + 1
        values = warped.read([*scene.bands, alpha], window=place)
    return values[:3], (values[3] > 0) & imagery.has_data(values[:3], None)


def own_offset(source: rasterio.DatasetReader, grid: Grid) -> tuple[int, int] | None:
    """Where the grid starts in the raster (col, row px) if its pixels are the raster's own, else None."""
    t = source.transform
    square = t.b == 0 and t.d == 0 and t.a == grid.gsd and abs(t.a + t.e) <= 1e-6 * t.a
    if not square or imagery.crs_name(imagery.crs_of(source)) != grid.crs:
        return None
    real = np.array([(grid.x0 - t.c) / t.a, (t.f - grid.y0) / t.a])
    col, row = whole = np.rint(real).astype(int).tolist()
    fits = col >= 0 and row >= 0 and col + grid.width <= source.width and row + grid.height <= source.height
    return (col, row) if fits and np.abs(real - whole).max() < 1e-4 else None


def on_grid(source: rasterio.DatasetReader, grid: Grid, nodata: float | None) -> WarpedVRT:
    """The raster as if it had been made on the model grid, with an alpha band: read any window of it.

    Pixels half as large as the grid's, or smaller, are averaged; else cubic convolution, widened when it shrinks the
    image. The transform is exact and the kernel fixed for the whole raster: GDAL's defaults adapt both to the window
    read, and neighbouring blocks would not agree.
    """
    import pyproj

    sides = imagery.pixel_size(source, pyproj.CRS.from_user_input(grid.crs))
    scale_x, scale_y = (side / grid.gsd for side in sides)
    resampling = Resampling.average if max(scale_x, scale_y) <= 0.5 else Resampling.cubic
    return WarpedVRT(
        source,
        crs=grid.crs,
        transform=Affine(grid.gsd, 0.0, grid.x0, 0.0, -grid.gsd, grid.y0),
        width=grid.width,
        height=grid.height,
        resampling=resampling,
        tolerance=1e-12,
        src_nodata=nodata,
        add_alpha=ColorInterp.alpha not in source.colorinterp,
        UNIFIED_SRC_NODATA="YES",
        SRC_ALPHA_MAX="1",  # any alpha above 0 is data, whatever the type's greatest value
        XSCALE=scale_x,
        YSCALE=scale_y,
        **imagery.unwrapped(source),
    )


def _filled(rgb: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """RGB (3, rows, cols) in which pixels without data within 32 px of data take the nearest colour, others are black."""
    if valid.all():
        return rgb
    if not valid.any():
        return np.zeros_like(rgb)
    from scipy.ndimage import distance_transform_edt

    distance, (row, col) = distance_transform_edt(~valid, return_indices=True)
    return np.where(distance <= FILL, rgb[:, row, col], 0).astype(np.uint8)


def _without_specks(valid: np.ndarray) -> np.ndarray:
    """The data mask in which a pixel that merely has the nodata value is data too: deep shadow, clipped to 0 by the vendor.

    Missing data comes in areas, so only what a square of `AREA` px of missing pixels can reach is missing.
    """
    if valid.all():
        return valid
    from scipy.ndimage import binary_opening

    missing = np.pad(~valid, AREA, constant_values=True)
    return ~binary_opening(missing, np.ones((AREA, AREA), bool))[AREA:-AREA, AREA:-AREA]


def main(argv: list[str] | None = None) -> None:
    """Cut one block out of the raster."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.tiles", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--raster", help="a copy to read instead of the scene's raster")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="margin on each side of a tile, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--name", required=True, help="block name, as in r000c000")
    parser.add_argument("--out", required=True, help="out: tiles.tif")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    facts = facts._replace(raster=args.raster or facts.raster)
    tiling = Tiling(args.tile, args.margin, args.block)
    block = tiling.block_of(args.name)
    rgb, valid = read_block(facts, tiling, block)
    core = tiling.block_core(block, facts.grid.width, facts.grid.height)
    corner = Affine.translation(core.col - tiling.margin, core.row - tiling.margin)
    rgba = np.dstack([rgb, np.where(valid, 255, 0).astype(np.uint8)])
    raster.write(args.out, rgba, facts.grid.crs, facts.grid.transform * corner)


if __name__ == "__main__":
    cli.run(main)
