"""Tiled: a copy of a raster whose own layout makes blocks expensive.

A block's window of a raster compressed in strips of full width needs all of each strip: a city 17 blocks wide is
decoded 17 times. Such a raster is copied once, tile by tile, with the same values, mask and georeference.

In: the raster. Out: a tiled GeoTIFF, which blocks then read instead.
"""

from __future__ import annotations

import argparse
import functools

from kibs_steps import cli, imagery, store

WINDOW = 2048  # px: about a block's side
TOO_MUCH = 8.0  # times as many pixels decoded as asked for
FORMAT = {
    "TILED": "YES",
    "BLOCKXSIZE": 512,
    "BLOCKYSIZE": 512,
    "COMPRESS": "ZSTD",
    "ZSTD_LEVEL": 1,
    "BIGTIFF": "IF_SAFER",
}


def excess(width: int, height: int, cell: tuple[int, int]) -> float:
    """How many times the pixels of a window of `WINDOW` px must be decoded when cells (rows, cols px) come whole only."""
    window, decoded = 1, 1
    for length, side in zip((height, width), cell, strict=True):
        wanted = min(WINDOW, length)
        window *= wanted
        decoded *= min((-(-wanted // side) + 1) * side, length) if side > 1 else wanted
    return decoded / window


@functools.cache
def needed(path: str) -> bool:
    """Whether blocks should read a copy of the raster; only its header is read. Raises what `imagery.opened` raises."""
    with imagery.opened(path) as source:
        plain = source.driver == "GTiff" and source.compression is None
        return not plain and excess(source.width, source.height, source.block_shapes[0]) > TOO_MUCH


def main(argv: list[str] | None = None) -> None:
    """Copy a raster to a tiled GeoTIFF."""
    import rasterio
    import rasterio.shutil

    parser = argparse.ArgumentParser(prog="python -m kibs_steps.tiled", description=main.__doc__)
    parser.add_argument("--raster", required=True, help="a file or GDAL's name of a remote one")
    parser.add_argument("--out", required=True, help="out: tiled GeoTIFF")
    args = parser.parse_args(argv)
    with (
        imagery.opened(args.raster) as source,
        store.whole(args.out) as temporary,
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK="YES"),
    ):
        rasterio.shutil.copy(source, temporary, driver="GTiff", **FORMAT)


if __name__ == "__main__":
    cli.run(main)
