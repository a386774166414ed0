"""Regions: parts of one raster that were seen from different directions, as the patches of an aerial mosaic.

In: a polygon layer with `view_azimuth` and `view_elevation` (deg) of each part. Out: `scene.Region`s, for `scene.json`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid
from kibs_steps.scene import Region, direction

if TYPE_CHECKING:
    import geopandas


class RegionsUnusable(KibsError):
    """A layer of regions that does not say from where each was seen."""


def read(path: str | Path, grid: Grid) -> tuple[Region, ...]:
    """The regions of a polygon layer with the columns `view_azimuth` and `view_elevation` (deg), in the layer's order.

    Where polygons overlap the later one holds. Raises `RegionsUnusable`, `AnglesUnusable`.
    """
    import shapely

    frame = _layer(path).to_crs(grid.crs)
    outlines = shapely.make_valid(shapely.force_2d(frame.geometry.to_numpy()))
    angles = zip(frame["view_azimuth"], frame["view_elevation"], strict=True)
    return tuple(Region(o, direction(*a, grid, "view")) for o, a in zip(outlines, angles, strict=True))


def views(path: str | Path) -> list[dict[str, float]]:
    """Azimuth and elevation (deg) of the regions of a layer, each view once. Raises `RegionsUnusable`."""
    frame = _layer(path)
    found = dict.fromkeys(zip(frame["view_azimuth"], frame["view_elevation"], strict=True))
    return [{"azimuth": azimuth % 360, "elevation": elevation} for azimuth, elevation in found]


def _layer(path: str | Path) -> geopandas.GeoDataFrame:
    """The polygons of a layer with their angles as numbers."""
    import geopandas
    import pyogrio

    try:
        frame = geopandas.read_file(path)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise RegionsUnusable(
            f"regions {path} cannot be read as vector data ({error}): give a GeoPackage or GeoJSON"
        ) from error
    lacking = [name for name in ("view_azimuth", "view_elevation") if name not in frame.columns]
    if lacking:
        raise RegionsUnusable(
            f"regions {path} lacks the column {' and '.join(lacking)}: each polygon needs both, in degrees"
        )
    if frame.crs is None:
        raise RegionsUnusable(f"regions {path} has no CRS: assign it, or save it as GeoJSON in WGS 84")
    frame = frame[frame.geom_type.isin(["Polygon", "MultiPolygon"])]
    if frame.empty:
        raise RegionsUnusable(f"regions {path} holds no polygon: draw the parts of the image that share a view")
    try:
        azimuth, elevation = (frame[name].astype(float) for name in ("view_azimuth", "view_elevation"))
    except (TypeError, ValueError) as error:
        raise RegionsUnusable(f"regions {path}: an angle is no number ({error}): give degrees, as in 181.1") from error
    if azimuth.isna().any() or elevation.isna().any():
        raise RegionsUnusable(f"regions {path}: a polygon has no view_azimuth or view_elevation: fill in both")
    return frame.assign(view_azimuth=azimuth, view_elevation=elevation)
