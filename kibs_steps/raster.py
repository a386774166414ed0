"""Intermediate rasters: tiled, quickly compressed GeoTIFFs of one block, read and written whole."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

from kibs_steps import store, sums

FORMAT = {"driver": "GTiff", "tiled": True, "blockxsize": 256, "blockysize": 256}
FORMAT |= {"compress": "zstd", "zstd_level": 1, "predictor": 2}


def write(path: str | Path, image: np.ndarray, crs: str | None = None, transform: Affine | None = None) -> None:
    """Write an image (rows, cols) or (rows, cols, bands)."""
    bands = image[None] if image.ndim == 2 else image.transpose(2, 0, 1)
    shape = {"count": bands.shape[0], "height": bands.shape[1], "width": bands.shape[2]}
    place = {"crs": crs, "transform": transform} if transform is not None else {}
    with store.whole(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(temporary, "w", dtype=image.dtype, **shape, **FORMAT, **place) as target:
            target.write(bands)


def read(path: str | Path) -> np.ndarray:
    """Read an image as (rows, cols) or (rows, cols, bands); a damaged file raises `store.DamagedFile`."""
    sums.check(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                bands = source.read()
    except RasterioIOError as error:
        raise sums.damaged(path, error) from error
    return bands[0] if bands.shape[0] == 1 else bands.transpose(1, 2, 0)


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator[rasterio.DatasetReader]:
    """A raster of this workflow, open to be read window by window, each checked; raises `store.DamagedFile`."""
    with sums.opened(path) as file:

        def opener(name: str, mode: str = "rb", **_: object):
            if name != str(path):
                raise FileNotFoundError(name)
            return file

        try:
            with rasterio.open(str(path), opener=opener) as source:
                yield source
        except RasterioIOError as error:
            raise sums.damaged(path, error) from error
