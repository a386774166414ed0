"""Georeference: where a raster lies on Earth, the grid it is looked at on, and what heights are counted from.

In: rasters' headers, an area of interest, the name of a vertical CRS. Out: the model grid (`Grid`), the turn of its axes against
true north, and refusals that say what to do. What a file says of its own CRS is `imagery`'s.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid

if TYPE_CHECKING:
    import pyproj
    import rasterio

COARSEST = 1.6  # times the model's GSD
SAME_GSD = 0.005  # a raster whose GSD differs less from the model's is used as it is
DEGREES = 4326  # EPSG: longitude and latitude in degrees from Greenwich
SCALE_ERROR = 0.01  # of a projection, beyond which its metres are no metres


class GsdTooCoarse(KibsError):
    """A raster that does not show what the models look for."""


class AoiUnusable(KibsError):
    """An area of interest that selects nothing of the raster."""


class VerticalCrsUnusable(KibsError):
    """A vertical CRS that is none."""


def model_grid(raster: str | Path, gsd: float, aoi: str | Path | None = None) -> Grid:
    """The model grid of a raster for a model of that GSD (m/px), clipped to the bounds of `aoi`; reads headers only.

    A north-up raster in a projected CRS in metres keeps its CRS: its own pixels where its GSD is within 0.5 % of the
    model's, else pixels of the model's GSD over the same bounds. Any other gets the WGS 84 UTM zone of its centre.
    Raises `GsdTooCoarse`, `AoiUnusable` and what `imagery.opened` and `imagery.crs_of` raise.
    """
    from kibs_steps import imagery

    with imagery.opened(raster) as source:
        grid = grid_of(source, gsd)
    return grid if aoi is None else clipped(grid, aoi)


def own_gsd(raster: str | Path) -> float:
    """The longer side (m) of a raster's pixels, in the CRS the scene will have."""
    from kibs_steps import imagery

    with imagery.opened(raster) as source:
        return max(imagery.pixel_size(source, _scene_crs(source)[0]))


def _scene_crs(source: rasterio.DatasetReader) -> tuple[pyproj.CRS, bool]:
    """The CRS of a raster's scene, and whether it is the raster's own."""
    import pyproj

    from kibs_steps import imagery

    crs, t = imagery.crs_of(source), source.transform
    north_up = t.b == 0 and t.d == 0 and t.a > 0 and t.e < 0
    if north_up and in_true_metres(crs, imagery.outline(source, crs, 1).mean(axis=0)):
        return crs, True
    longitude, latitude = imagery.outline(source, pyproj.CRS.from_epsg(DEGREES), 1).mean(axis=0)
    return _utm(longitude, latitude), False


def grid_of(source: rasterio.DatasetReader, gsd: float) -> Grid:
    """The model grid over all of an open raster. Raises `GsdTooCoarse`."""
    import pyproj

    from kibs_steps import imagery

    t = source.transform
    crs, keeps = _scene_crs(source)
    own = max(imagery.pixel_size(source, crs))
    if own > COARSEST * gsd:
        raise GsdTooCoarse(
            f"{source.name} has pixels of {own:.2f} m, the models need {gsd:g} m and bear at most {COARSEST * gsd:.2f} m: give a "
            "finer raster (pansharpened, if this is the multispectral one) or models trained for this GSD (models=)"
        )
    square = abs(t.a + t.e) <= 1e-6 * t.a
    if keeps and square and abs(own - gsd) <= SAME_GSD * gsd:
        return Grid(imagery.crs_name(crs), t.c, t.f, t.a, source.width, source.height)
    ring = imagery.outline(source, pyproj.CRS.from_user_input(crs))
    (left, bottom), (right, top) = ring.min(axis=0), ring.max(axis=0)
    if not keeps:
        left, top = np.floor(left / gsd) * gsd, np.ceil(top / gsd) * gsd
    width, height = (int(np.ceil(length / gsd - 1e-6)) for length in (right - left, top - bottom))
    return Grid(imagery.crs_name(crs), float(left), float(top), float(gsd), width, height)


def in_true_metres(crs: pyproj.CRS, centre: np.ndarray) -> bool:
    """Whether at `centre` (x, y) a metre of this CRS is one on the ground, within 1 %: not in feet, degrees, Mercator."""
    if not crs.is_projected or any(axis.unit_conversion_factor != 1.0 for axis in crs.axis_info):
        return False
    if "Pseudo" in crs.coordinate_operation.method_name:
        return False
    east, north = _ground_metre(crs, *centre)
    return max(abs(np.hypot(*east) - 1.0), abs(np.hypot(*north) - 1.0)) <= SCALE_ERROR


def _ground_metre(crs: pyproj.CRS, x: float, y: float, step: float = 10.0) -> np.ndarray:
    """What a metre on the ground is in map axes (x, y) at a place: towards true east and true north, (2, 2).

    By steps of some metres both ways: a CRS's own degrees may be grads from Paris, and then its factors are no help.
    """
    import pyproj

    to_degrees = pyproj.Transformer.from_crs(crs, DEGREES, always_xy=True)
    longitude, latitude = to_degrees.transform(x, y)
    places = np.array(
        pyproj.Geod(ellps="WGS84").fwd([longitude] * 4, [latitude] * 4, [90, 270, 0, 180], [step] * 4)[:2]
    )
    east, west, north, south = np.column_stack(to_degrees.transform(*places, direction="INVERSE"))
    return np.stack([east - west, north - south]) / (2 * step)


def _utm(longitude: float, latitude: float) -> pyproj.CRS:
    import pyproj

    zone = int((longitude + 180.0) % 360.0 // 6.0) + 1
    return pyproj.CRS.from_epsg((32600 if latitude >= 0 else 32700) + zone)


def clipped(grid: Grid, aoi: str | Path) -> Grid:
    """The part of the grid within the bounds of a vector file's first layer, grown to whole pixels."""
    left, bottom, right, top = _bounds_of(aoi, grid.crs)
    (col0, row0), (col1, row1) = grid.to_image(np.array([[left, top], [right, bottom]]))
    col0, row0 = max(int(np.floor(col0 + 1e-6)), 0), max(int(np.floor(row0 + 1e-6)), 0)
    col1, row1 = min(int(np.ceil(col1 - 1e-6)), grid.width), min(int(np.ceil(row1 - 1e-6)), grid.height)
    if col0 >= col1 or row0 >= row1:
        raise AoiUnusable(
            f"aoi {aoi} lies outside the raster: in {grid.crs.splitlines()[0][:40]} it spans {left:.0f} {bottom:.0f} {right:.0f} "
            f"{top:.0f}, the raster {' '.join(f'{b:.0f}' for b in grid.bounds)} (left bottom right top): check its CRS"
        )
    return grid._replace(
        x0=grid.x0 + col0 * grid.gsd, y0=grid.y0 - row0 * grid.gsd, width=col1 - col0, height=row1 - row0
    )


def _bounds_of(aoi: str | Path, crs: str) -> np.ndarray:
    """(left, bottom, right, top) of a vector file's shapes in `crs`."""
    import pyogrio
    import pyproj
    import shapely

    try:
        facts, _, shapes, _ = pyogrio.raw.read(aoi, columns=[], force_2d=True)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise AoiUnusable(
            f"aoi {aoi} cannot be read as vector data ({error}): give a GeoPackage, GeoJSON or the like"
        ) from error
    shapes = shapely.from_wkb(shapes) if shapes is not None else np.zeros(0, object)
    points = shapely.get_coordinates(shapes)
    if (
        len(points) > 1 and (extent := np.ptp(points, axis=0).max()) > 0
    ):  # what is straight in one CRS is bent in another
        points = shapely.get_coordinates(shapely.segmentize(shapes, extent / 256))
    if not len(points):
        raise AoiUnusable(f"aoi {aoi} holds no shape in its first layer: draw one, or leave aoi out")
    if facts["crs"] is None:
        raise AoiUnusable(f"aoi {aoi} has no CRS: assign it, or save it as GeoJSON in WGS 84")
    to_grid = pyproj.Transformer.from_crs(facts["crs"], crs, always_xy=True)
    points = np.column_stack(to_grid.transform(points[:, 0], points[:, 1]))
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise AoiUnusable(f"aoi {aoi} cannot be brought into the scene's CRS: it lies far outside the raster")
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def convergence(grid: Grid) -> float:
    """Meridian convergence (deg) at the grid's centre: the angle from true to grid north, clockwise."""
    import pyproj

    crs = pyproj.CRS.from_user_input(grid.crs)
    left, bottom, right, top = grid.bounds
    _, (x, y) = _ground_metre(crs, (left + right) / 2.0, (bottom + top) / 2.0)
    return round(float(np.degrees(np.arctan2(-x, y))), 6)


def check_vertical(vertical_crs: str | None) -> None:
    """Raise `VerticalCrsUnusable` for a vertical CRS that is none, is more than that, or does not count metres upwards."""
    import pyproj

    from kibs_steps import imagery

    if vertical_crs is None:
        return
    try:
        found = pyproj.CRS.from_user_input(vertical_crs)
    except pyproj.exceptions.CRSError:
        found = None
    if found is None or not found.is_vertical:
        raise VerticalCrsUnusable(
            f"vertical_crs={vertical_crs} is no vertical CRS: give one as in EPSG:5773 (EGM96 height)"
        )
    if found.is_compound:
        part = found.sub_crs_list[1]
        raise VerticalCrsUnusable(
            f"vertical_crs={vertical_crs} is a compound CRS: give its vertical part, {imagery.crs_name(part)} ({part.name})"
        )
    if found.axis_info[0].unit_conversion_factor != 1.0:
        raise VerticalCrsUnusable(
            f"vertical_crs={vertical_crs} counts in {found.axis_info[0].unit_name}, published heights are in metres: give "
            "the CRS of the same datum in metres (the terrain model may be in feet)"
        )
    if found.axis_info[0].direction != "up":
        raise VerticalCrsUnusable(
            f"vertical_crs={vertical_crs} counts depths ({found.name}), published heights are counted upwards: give the CRS of "
            "heights of the same datum"
        )


def missing_geoid(crs: str, vertical_crs: str | None) -> str | None:
    """The grid that PROJ lacks to tell how high above the ellipsoid the zero of `vertical_crs` lies; None if it can tell."""
    import warnings

    import pyproj

    if vertical_crs is None:
        return None
    flat, up = pyproj.CRS.from_user_input(crs), pyproj.CRS.from_user_input(vertical_crs)
    whole = pyproj.crs.CompoundCRS(f"{flat.name} + {up.name}", [flat, up])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = pyproj.transformer.TransformerGroup(whole, "EPSG:4978", always_xy=True)
    if "ballpark vertical" not in found.transformers[0].description:
        return None
    grids = [grid.short_name for way in found.unavailable_operations for grid in way.grids if not grid.available]
    return grids[0] if grids else f"of {up.name}"
