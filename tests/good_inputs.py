"""Inputs that are taken: a picture, its terrain and models, layers over it. Tests spoil one of them, or build on all."""

from __future__ import annotations

from pathlib import Path

import geopandas
import numpy as np
import rasters
import shapely
import toy

CRS = "EPSG:32631"
BOX = (rasters.X0 + 10.0, rasters.Y0 - 20.0, rasters.X0 + 16.0, rasters.Y0 - 12.0)  # a roof, map m


def good(folder: Path) -> dict:
    """Settings that work."""
    return {
        "scene": "s",
        "raster": str(rasters.write(folder / "a.tif", rasters.picture())),
        "dtm": str(ground(folder / "dtm.tif")),
        "models": str(toy.models(folder / "models")),
        "block": 2,
        **toy.VIEW,
    }


def ground(path: Path, heights: np.ndarray | None = None, crs: str | None = CRS, **options) -> Path:
    """A terrain model around the picture."""
    heights = np.full((330, 340), 50, "float32") if heights is None else heights
    return rasters.dtm(path, heights, rasters.X0 - 300, rasters.Y0 + 300, crs=crs, **options)


def vector(path: Path, shapes: list, crs: str | None = CRS) -> Path:
    """A vector file of one layer."""
    geopandas.GeoSeries(shapes, crs=crs).to_file(path)
    return path


def roof(z: float = 58.0) -> shapely.Polygon:
    """A section with heights, inside the picture."""
    return shapely.force_3d(shapely.box(*BOX), z)


def picture(folder: Path, name: str, **options) -> dict:
    """Settings with another raster."""
    return {"raster": str(rasters.write(folder / name, options.pop("values", rasters.picture()), **options))}
