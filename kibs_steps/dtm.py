"""DTM: the terrain model as the user has it, made the scene's `dtm.tif`.

In: a number (m), or a raster in any CRS, resolution and unit of height. Out: float32 metres in the scene's CRS over the
scene and 250 m around it, without holes: a raster in the scene's CRS keeps its own pixels, any other is warped
(bilinear) at its own resolution; where it has no value, neighbours are interpolated. The work goes in strips, so memory
grows with the raster's width alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from affine import Affine

from kibs_steps import imagery, store
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid

if TYPE_CHECKING:
    import rasterio

AROUND = 250.0  # metres of terrain around the scene, and how far a hole's pixels may be from data
LOWEST, HIGHEST = -500.0, 9000.0  # m; the Dead Sea's shore lies at -430
STRIP = 512
REACH = 64  # pixels over which a strip's own neighbours fill a hole; what is farther is filled from a coarse copy
COARSE = 1024
STAYS = np.zeros((1, 2))  # moves of what stands where it is seen
METRES = {
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "cm": 0.01, "centimetre": 0.01, "dm": 0.1,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048,
    "us survey foot": 1200 / 3937, "us_survey_foot": 1200 / 3937, "us-ft": 1200 / 3937, "ftus": 1200 / 3937,
}  # fmt: skip


class DtmMissing(KibsError):
    """The terrain model is not there or cannot be read."""


class DtmPartial(KibsError):
    """The terrain model does not cover the scene."""


class DtmAbsurd(KibsError):
    """Heights that are no heights on Earth, or whose unit is unknown."""


class DtmDatum(KibsError):
    """A terrain model whose heights are counted from another zero than the scene's."""


class Canvas(NamedTuple):
    """The raster to be written: transform and size; `rows(first, last)` gives its heights in metres, NaN in holes."""

    transform: Affine
    width: int
    height: int
    rows: Callable[[int, int], np.ndarray]


def write(
    dtm: str | Path | float,
    grid: Grid,
    footprint: np.ndarray,
    path: str | Path,
    what: str = "dtm",
    moves: np.ndarray = STAYS,
) -> dict:
    """Write `dtm.tif` for a scene of that grid, whose raster covers the ring `footprint` (n, 2 map metres).

    Things may stand elsewhere than they are seen: by any of `moves` (m, 2 map metres) or between them.

    `what` is the setting that errors name. Returns the record for `scene.json`: `source`, `step` (m) and `filled`, the share of
    the footprint without own data.
    Raises `DtmMissing`, `DtmPartial` (with the uncovered share), `DtmAbsurd`.
    """
    try:
        height = float(str(dtm))
    except ValueError:
        with _opened(str(dtm), what) as source, _canvas(source, grid, moves) as canvas:
            area = _covered_area(source, grid, footprint, canvas, what, moves)
            coarse, filled = _survey(canvas, area, f"{what} {source.name}")
            with _writing(path, canvas, grid.crs) as target:
                _fill(canvas, coarse, target)
        return {"source": str(dtm), "step": [canvas.transform.a, -canvas.transform.e], "filled": round(filled, 6)}
    check_number(height)
    left, bottom, right, top = grid.bounds
    left, bottom, right, top = _around(grid, moves)
    side = max(right - left, top - bottom)
    canvas = Canvas(Affine(side / 2, 0.0, left, 0.0, -side / 2, top), 2, 2, lambda first, last: None)
    with _writing(path, canvas, grid.crs) as target:
        target.write(np.full((1, 2, 2), height, np.float32))
    return {"source": height, "step": None, "filled": 0.0}


def _around(grid: Grid, moves: np.ndarray) -> tuple[float, float, float, float]:
    """Bounds (left, bottom, right, top) of the scene as seen and as it stands, and of `AROUND` metres about both."""
    left, bottom, right, top = grid.bounds
    (west, south), (east, north) = np.minimum(moves.min(axis=0), 0.0), np.maximum(moves.max(axis=0), 0.0)
    return left + west - AROUND, bottom + south - AROUND, right + east + AROUND, top + north + AROUND


def extremes(path: str | Path) -> tuple[float, float]:
    """The lowest and the highest terrain (m) of a scene's `dtm.tif`."""
    import rasterio

    low, high = np.inf, -np.inf
    with rasterio.open(path) as source:
        for _, window in source.block_windows(1):
            heights = source.read(1, window=window)
            low, high = min(low, float(heights.min())), max(high, float(heights.max()))
    return low, high


def check_number(height: float) -> None:
    """Raise `DtmAbsurd` for a number that is no height (m) on Earth."""
    if not LOWEST <= height <= HIGHEST:
        raise DtmAbsurd(
            f"dtm={height:g}: the ground cannot be {height:g} m high; give metres above the scene's vertical datum"
        )


def check(dtm: str, grid: Grid, footprint: np.ndarray, vertical_crs: str | None = None, what: str = "dtm") -> list[str]:
    """Look at a terrain model, a number or a file's header: placed, in a known unit and datum, as large as the scene.

    `what` is the setting that errors name. Returns what is doubtful. Raises `DtmMissing`, `DtmPartial`, `DtmAbsurd`, `DtmDatum`.
    """
    try:
        check_number(float(dtm))
    except ValueError:
        with _opened(dtm, what) as source:
            return _doubts(source, grid, footprint, vertical_crs, what)
    return []


def _doubts(
    source: rasterio.DatasetReader, grid: Grid, footprint: np.ndarray, vertical_crs: str | None, what: str
) -> list[str]:
    imagery.complete(source)
    with _canvas(source, grid) as canvas:
        _covered_area(source, grid, footprint, canvas, what)
    _check_datum(source, vertical_crs, what)
    crs = imagery.crs_of(source)
    in_feet = crs.is_projected and crs.axis_info[0].unit_conversion_factor != 1.0
    if in_feet and not (source.units[0] or "").strip() and metres_per_unit(source) == 1.0:
        return [
            f"{what} {source.name} is in a CRS in feet and does not say its heights' unit: metres are assumed; if they are feet, "
            "say so (gdal_edit.py -units ft)"
        ]
    return []


def _check_datum(source: rasterio.DatasetReader, vertical_crs: str | None, what: str) -> None:
    """Refuse a terrain model that says another vertical datum than `vertical_crs`."""
    import pyproj

    if vertical_crs is None:
        return
    own = pyproj.CRS.from_wkt(source.crs.to_wkt())
    wanted = pyproj.CRS.from_user_input(vertical_crs)
    if own.is_compound:
        there = own.sub_crs_list[1]
        same, called = there.datum.name == wanted.datum.name, there.name
    elif len(own.axis_info) == 3:
        same, called = False, "ellipsoidal heights"
    else:
        return
    if not same:
        raise DtmDatum(
            f"{what} {source.name} has {called}, vertical_crs={vertical_crs} is {wanted.name}: convert the terrain model "
            "(gdalwarp -t_srs with a compound CRS), or give the vertical_crs it has"
        )


@contextlib.contextmanager
def _opened(path: str, what: str):
    try:
        with imagery.opened(path) as source:
            imagery.crs_of(source)
            yield source
    except (imagery.RasterMissing, imagery.NotARaster, imagery.NotGeoreferenced) as error:
        instead = "; or give one height in metres, as in dtm=120" if what == "dtm" else ""
        raise DtmMissing(f"{what}: {error}{instead}") from error


def metres_per_unit(source: rasterio.DatasetReader) -> float:
    """Metres per unit of the heights: by the band's unit, else by the CRS's vertical axis, else 1."""
    import pyproj

    unit = (source.units[0] or "").strip().lower()
    if unit:
        if unit not in METRES:
            raise DtmAbsurd(
                f"{source.name} gives heights in '{unit}': convert them to metres, or correct the band's unit"
            )
        return METRES[unit]
    crs = pyproj.CRS.from_wkt(source.crs.to_wkt())
    return crs.sub_crs_list[1].axis_info[0].unit_conversion_factor if crs.is_compound else 1.0


@contextlib.contextmanager
def _canvas(source: rasterio.DatasetReader, grid: Grid, moves: np.ndarray = STAYS):
    """The canvas over the scene, where it stands, and 250 m around it, on the DTM's own pixels where it is in the scene's CRS."""
    import pyproj
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT
    from rasterio.windows import Window

    left, bottom, right, top = _around(grid, moves)
    t, nodata = source.transform, source.nodata
    factor, scale, offset = metres_per_unit(source), source.scales[0], source.offsets[0]

    def heights(dataset: rasterio.DatasetReader, window: Window) -> np.ndarray:
        with imagery.reading(source, window):
            values = dataset.read(1, window=window, out_dtype="float32")
        if (factor, scale, offset) != (1.0, 1.0, 0.0):
            values = ((values * np.float64(scale) + offset) * factor).astype(np.float32)
        values[(dataset.read_masks(1, window=window) == 0) | ~np.isfinite(values)] = np.nan
        return values

    own = imagery.crs_name(imagery.crs_of(source)) == grid.crs and t.b == 0 and t.d == 0 and t.a > 0 and t.e < 0
    if own:
        step_x, step_y, x0, y0 = t.a, -t.e, t.c, t.f
    else:
        step_x = step_y = round(float(np.mean(_step(source, grid))), 6)
        x0 = y0 = 0.0
    first_col, first_row = int(np.floor((left - x0) / step_x)), int(np.floor((y0 - top) / step_y))
    width = int(np.ceil((right - x0) / step_x)) - first_col
    height = int(np.ceil((y0 - bottom) / step_y)) - first_row
    transform = Affine(step_x, 0.0, x0 + first_col * step_x, 0.0, -step_y, y0 - first_row * step_y)

    def own_rows(first: int, last: int) -> np.ndarray:
        out = np.full((last - first, width), np.nan, np.float32)
        c0, c1 = max(first_col, 0), min(first_col + width, source.width)
        r0, r1 = max(first_row + first, 0), min(first_row + last, source.height)
        if c0 < c1 and r0 < r1:
            inside = heights(source, Window(c0, r0, c1 - c0, r1 - r0))
            out[r0 - first_row - first : r1 - first_row - first, c0 - first_col : c1 - first_col] = inside
        return out

    if own:
        yield Canvas(transform, width, height, own_rows)
        return
    with WarpedVRT(
        source,
        crs=pyproj.CRS.from_user_input(grid.crs).to_wkt(),
        transform=transform,
        width=width,
        height=height,
        resampling=Resampling.bilinear,
        tolerance=0.001,
        XSCALE=1.0,  # plain bilinear: GDAL would smooth where the CRSs are turned to each other
        YSCALE=1.0,
        src_nodata=nodata,
        nodata=np.nan,
        dtype="float64" if source.dtypes[0] == "float64" else "float32",
        **imagery.unwrapped(source),
    ) as warped:
        yield Canvas(
            transform, width, height, lambda first, last: heights(warped, Window(0, first, width, last - first))
        )


def _step(source: rasterio.DatasetReader, grid: Grid) -> tuple[float, float]:
    """Sides (m, grid CRS) of the DTM's pixel at the scene's centre, where the DTM may reach far beyond."""
    import pyproj

    left, bottom, right, top = grid.bounds
    there = pyproj.Transformer.from_crs(grid.crs, imagery.crs_of(source), always_xy=True)
    col, row = ~source.transform * there.transform((left + right) / 2, (bottom + top) / 2)
    cols, rows = np.array([col, col + 1, col]), np.array([row, row, row + 1])
    x, y = there.transform(*(source.transform * (cols, rows)), direction="INVERSE")
    return float(np.hypot(x[1] - x[0], y[1] - y[0])), float(np.hypot(x[2] - x[0], y[2] - y[0]))


def _covered_area(
    source: rasterio.DatasetReader, grid: Grid, footprint: np.ndarray, canvas: Canvas, what: str, moves=STAYS
):
    """The raster's footprint within the grid (shapely polygon); raises `DtmPartial` where the DTM ends before it does."""
    import pyproj
    import shapely
    from shapely import affinity

    seen = shapely.make_valid(shapely.Polygon(footprint)).intersection(shapely.box(*grid.bounds))
    stays = not moves.any()
    area = seen if stays else shapely.union_all([affinity.translate(seen, *move) for move in moves]).convex_hull
    extent = shapely.Polygon(imagery.outline(source, pyproj.CRS.from_user_input(grid.crs)))
    # What stands a little beyond the terrain model is filled from its rim, what is seen there is not.
    slack = max(canvas.transform.a, -canvas.transform.e) if stays else AROUND
    outside = area.difference(extent.buffer(slack))
    if outside.area > 1e-6 * area.area:
        raise DtmPartial(_partial(f"{what} {source.name}", outside.area / area.area))
    return area


def _partial(name: str, share: float) -> str:
    return (
        f"{name} leaves {max(100 * share, 0.01):.2f} % of the scene uncovered: give a terrain model that covers the "
        "raster (better 250 m more on all sides), clip the scene to it (aoi), or give one height in metres"
    )


def _survey(canvas: Canvas, area, name: str) -> tuple[np.ndarray, float]:
    """A coarse copy (≤ 1024 px a side) without holes, and the share of the area without data; refuses absurd heights."""
    from rasterio.features import geometry_mask
    from scipy.ndimage import distance_transform_edt

    every = -(-max(canvas.width, canvas.height) // COARSE)
    coarse, within, missing, total = [], [], 0, 0
    for top in range(0, canvas.height, STRIP):
        heights = canvas.rows(top, min(top + STRIP, canvas.height))
        inside = geometry_mask(
            [area], heights.shape, canvas.transform * Affine.translation(0, top), invert=True, all_touched=True
        )
        missing, total = missing + int((np.isnan(heights) & inside).sum()), total + int(inside.sum())
        absurd = heights[(heights < LOWEST) | (heights > HIGHEST)]
        if absurd.size:
            raise DtmAbsurd(
                f"{name} holds heights like {absurd[0]:g} m: if that marks missing data, declare it "
                f"(gdal_edit.py -a_nodata {absurd[0]:g}); if heights are not in metres, convert them"
            )
        kept = slice(-top % every, None, every)
        coarse.append(heights[kept, ::every].copy())
        within.append(inside[kept, ::every].copy())
    heights, inside = np.concatenate(coarse), np.concatenate(within)
    hole = np.isnan(heights)
    if hole.all():
        raise DtmPartial(_partial(name, 1.0))
    if hole.any():
        sampling = (-canvas.transform.e * every, canvas.transform.a * every)
        distance, nearest = distance_transform_edt(hole, sampling=sampling, return_indices=True)
        far = inside & (distance > AROUND)
        if far.any():
            raise DtmPartial(_partial(name, far.sum() / inside.sum()))
        heights = heights[tuple(nearest)]
    return heights, missing / max(total, 1)


def _fill(canvas: Canvas, coarse: np.ndarray, target: rasterio.io.DatasetWriter) -> None:
    """Write the canvas strip by strip; holes are interpolated from neighbours, the inside of large ones from `coarse`."""
    from rasterio.fill import fillnodata
    from rasterio.windows import Window
    from scipy.ndimage import map_coordinates

    every = -(-max(canvas.width, canvas.height) // COARSE)
    for first in range(0, canvas.height, STRIP):
        last = min(first + STRIP, canvas.height)
        top, bottom = max(first - REACH, 0), min(last + REACH, canvas.height)
        heights = canvas.rows(top, bottom)
        hole = np.isnan(heights)
        if hole.any():
            heights = fillnodata(heights, ~hole, REACH)
            rows, cols = np.nonzero(np.isnan(heights))
            heights[rows, cols] = map_coordinates(coarse, [(rows + top) / every, cols / every], order=1, mode="nearest")
        core = heights[first - top : last - top]
        target.write(core, 1, window=Window(0, first, canvas.width, last - first))


@contextlib.contextmanager
def _writing(path: str | Path, canvas: Canvas, crs: str):
    import rasterio

    with (
        store.whole(path) as temporary,
        rasterio.open(
            temporary,
            "w",
            driver="GTiff",
            count=1,
            dtype="float32",
            width=canvas.width,
            height=canvas.height,
            crs=crs,
            transform=canvas.transform,
            tiled=True,
            blockxsize=256,
            blockysize=256,
            compress="deflate",
            predictor=3,
            BIGTIFF="IF_SAFER",
        ) as target,
    ):
        yield target
