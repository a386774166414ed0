"""Small rasters for tests, written to disk: any driver, CRS, type; a smooth picture whose colours tell where a pixel is; the
scene made of one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

from kibs_steps import scene

X0, Y0 = 500_000.0, 5_400_000.0


def picture(bands: int = 3, height: int = 90, width: int = 110, dtype: str = "uint8") -> np.ndarray:
    """A picture (bands, rows, cols) without zeros; band b is a wave of its own period. uint8 30–226, others ten times that."""
    row, col = np.mgrid[:height, :width]
    waves = [np.sin(col / (4.0 + b)) * np.cos(row / (5.0 + 2 * b)) for b in range(bands)]
    values = 128.0 + 98.0 * np.stack(waves)
    return (values if dtype == "uint8" else values * 10).astype(dtype)


def write(
    path: Path,
    values: np.ndarray,
    crs: str | None = "EPSG:32631",
    gsd: float = 0.38,
    transform: Affine | None = None,
    descriptions: tuple[str, ...] | None = None,
    **profile,
) -> Path:
    """Write `values` (bands, rows, cols); north-up at (X0, Y0) unless `transform` is given."""
    transform = transform or Affine(gsd, 0.0, X0, 0.0, -gsd, Y0)
    count, height, width = values.shape
    colours = profile.pop("colours", None)
    shape = {
        "count": count,
        "height": height,
        "width": width,
        "dtype": values.dtype,
        "crs": crs,
        "transform": transform,
    }
    with rasterio.open(path, "w", **{"driver": "GTiff", **shape, **profile}) as target:
        target.write(values)
        if descriptions:
            target.descriptions = descriptions
        if colours:
            target.colorinterp = colours
    return path


def dtm(
    path: Path, heights: np.ndarray, x0: float, y0: float, step: float = 2.0, crs: str = "EPSG:32631", **profile
) -> Path:
    """Write a terrain raster (rows, cols) whose upper-left corner is (x0, y0)."""
    return write(path, heights[None], crs, transform=Affine(step, 0.0, x0, 0.0, -step, y0), **profile)


def build(folder: Path, raster: Path, ground: str = "0", gsd: float = 0.38, **options) -> tuple[scene.Scene, dict]:
    """The scene of a raster and its terrain, and the JSON written for it."""
    made = scene.build("toy", raster, ground, gsd, folder / "out", **options)
    return made, json.loads((folder / "out/scene.json").read_text())
