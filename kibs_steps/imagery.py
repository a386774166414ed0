"""Imagery: what a raster file says of itself, before any model sees it.

Its horizontal CRS and pixel size in metres, which bands are red, green and blue, which pixels hold data, and the
**stretch** that brings its values to 8 bit. Everything is read from the header or from a sample, so the cost does not
grow with the raster. Out: values for `scene.json`.
"""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kibs_steps import sources
from kibs_steps.errors import KibsError

if TYPE_CHECKING:
    import pyproj
    import rasterio

STRETCH_PERCENTILES = (1.0, 99.0)
STRETCH_GAMMA = 0.6
SAMPLE_PIXELS = 4_000_000
LATTICE = 32
CACHE = 256 * 2**20  # bytes that GDAL keeps of rasters; its default is a share of the machine's memory


class RasterMissing(KibsError):
    """There is no file under that name."""


class NotARaster(KibsError):
    """A file that cannot be read as a raster."""


class RasterDamaged(KibsError):
    """A raster whose header is sound and whose pixels cannot be read."""


class NotGeoreferenced(KibsError):
    """A raster that does not say where on Earth it lies."""


class BandsUnusable(KibsError):
    """No red, green and blue can be taken from the raster."""


class NoData(KibsError):
    """A raster without a single pixel of data."""


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator[rasterio.DatasetReader]:
    """The open raster; raises `RasterMissing` or `NotARaster`."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

    remote = sources.is_remote(str(path))
    settings = {"GDAL_CACHEMAX": CACHE, **(sources.GDAL if remote else {})}
    with rasterio.Env(**settings), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            source = rasterio.open(path)
        except RasterioIOError as error:
            if not remote and not Path(path).exists():
                raise RasterMissing(f"raster {path} does not exist: check the path") from error
            raise NotARaster(
                f"{path} cannot be read as a raster ({error}): give a GeoTIFF or another GDAL format"
            ) from error
    with source, rasterio.Env(**settings):
        if not source.count:
            raise NotARaster(f"{path} holds no image of its own: name one of its subdatasets, {source.subdatasets[:3]}")
        yield source


def complete(source: rasterio.DatasetReader) -> None:
    """Raise `RasterDamaged` for a TIFF that ends before its last block: a copy or a download that broke off."""
    if source.driver != "GTiff" or not Path(source.name).is_file():
        return
    size = Path(source.name).stat().st_size
    bands = source.indexes[:1] if source.interleaving and source.interleaving.name == "pixel" else source.indexes
    for band in bands:
        rows, cols = source.block_shapes[band - 1]
        for j in range(-(-source.height // rows)):
            for i in range(-(-source.width // cols)):
                start = source.get_tag_item(f"BLOCK_OFFSET_{i}_{j}", "TIFF", bidx=band)
                length = source.get_tag_item(f"BLOCK_SIZE_{i}_{j}", "TIFF", bidx=band)
                if start and length and int(start) + int(length) > size:
                    raise RasterDamaged(
                        f"{source.name} is cut off: it has {size} bytes, its pixels go on to byte {int(start) + int(length)} "
                        "or further: copy or download it again"
                    )


@contextlib.contextmanager
def reading(source: rasterio.DatasetReader, place: object) -> Iterator[None]:
    """Raise `RasterDamaged`, naming the place, where pixels cannot be read."""
    from rasterio.errors import RasterioError

    try:
        yield
    except RasterioError as error:
        raise RasterDamaged(
            f"{source.name} cannot be read at {place} ({error.__cause__ or error}): the file is damaged; copy it again"
        ) from error


def crs_of(source: rasterio.DatasetReader) -> pyproj.CRS:
    """The raster's horizontal CRS; raises `NotGeoreferenced` where there is none or pixels are not placed in it."""
    import pyproj

    if source.crs is None or source.transform.is_identity:
        lacking = "no CRS" if source.crs is None else "no geotransform"
        raise NotGeoreferenced(
            f"{source.name} has {lacking}: assign the right one (gdal_edit.py -a_srs, -a_ullr); an image with only RPCs or "
            "ground control points must be orthorectified on a terrain model first (gdalwarp -rpc or -tps)"
        )
    crs = pyproj.CRS.from_wkt(source.crs.to_wkt())
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    crs = crs.to_2d() if len(crs.axis_info) > 2 else crs  # an image has no heights that a third axis could count
    if not (crs.is_projected or crs.is_geographic):
        raise NotGeoreferenced(f"{source.name} has a local CRS ({crs.name}): assign its real one (gdal_edit.py -a_srs)")
    return crs


def unwrapped(source: rasterio.DatasetReader) -> dict[str, Any]:
    """How a `WarpedVRT` is to place a raster in degrees that goes beyond ±180° (0 to 360°, or across the 180th meridian): counted
    from the meridian in its middle, as GDAL would look for its pixels 360° away. Nothing for others."""
    import pyproj
    from affine import Affine

    t = source.transform
    if not crs_of(source).is_geographic or (source.bounds.left >= -180.0 and source.bounds.right <= 180.0):
        return {}
    middle = round((source.bounds.left + source.bounds.right) / 2)
    wkt = pyproj.CRS.from_wkt(source.crs.to_wkt()).to_wkt("WKT1_GDAL")
    numberless = re.sub(r',AUTHORITY\["[^"]*","[^"]*"\]', "", wkt)
    moved = re.sub(r'PRIMEM\["[^"]*",0\]', f'PRIMEM["{middle} degrees east",{middle}]', numberless)
    if moved == numberless:
        raise NotGeoreferenced(
            f"{source.name} has longitudes beyond 180°, counted from another meridian than Greenwich: warp it to EPSG:4326 first"
        )
    return {"src_crs": moved, "src_transform": Affine(t.a, t.b, t.c - middle, t.d, t.e, t.f)}


def crs_name(crs: pyproj.CRS) -> str:
    """ "EPSG:n" if the CRS has a number there, else its WKT."""
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else crs.to_wkt()


def outline(source: rasterio.DatasetReader, crs: pyproj.CRS, per_side: int = 32) -> np.ndarray:
    """The raster's edge as a ring (4·per_side, 2) in `crs`, dense enough to follow its curve there."""
    along = np.linspace(0.0, 1.0, per_side, endpoint=False)
    still, back = np.zeros(per_side), 1.0 - along
    col = np.concatenate([along, still + 1.0, back, still]) * source.width
    row = np.concatenate([still, along, still + 1.0, back]) * source.height
    return _placed(source, col, row, crs)


def pixel_size(source: rasterio.DatasetReader, crs: pyproj.CRS) -> tuple[float, float]:
    """Sides (m) of the raster's central pixel, along columns and rows, in a CRS in metres."""
    col, row = source.width / 2.0, source.height / 2.0
    corner, right, below = _placed(source, np.array([col, col + 1, col]), np.array([row, row, row + 1]), crs)
    return float(np.hypot(*(right - corner))), float(np.hypot(*(below - corner)))


def _placed(source: rasterio.DatasetReader, col: np.ndarray, row: np.ndarray, crs: pyproj.CRS) -> np.ndarray:
    import pyproj

    x, y = source.transform * (col, row)
    own = crs_of(source)
    if crs_name(own) != crs_name(crs):
        x, y = pyproj.Transformer.from_crs(own, crs, always_xy=True).transform(x, y)
    points = np.column_stack([x, y])
    if not np.isfinite(points).all():
        raise NotGeoreferenced(f"{source.name} lies outside the area of its CRS ({own.name}): assign the right one")
    return points


def colour_bands(source: rasterio.DatasetReader, chosen: tuple[int, ...] | None = None) -> tuple[tuple[int, ...], str]:
    """The band numbers of red, green and blue, and a warning ("" if there is no doubt).

    `chosen` wins; then colour interpretation, then band descriptions, then the usual orders: three bands are RGB, eight
    are WorldView's (coastal, blue, green, yellow, red, red edge, two near infrared).
    Raises `BandsUnusable` for fewer than three bands, or for a choice the raster does not have.
    """
    count = source.count
    if chosen is not None:
        if len(chosen) != 3 or not all(1 <= band <= count for band in chosen):
            raise BandsUnusable(
                f"bands={','.join(map(str, chosen))}: give three numbers from 1 to {count}, as in bands=1,2,3"
            )
        return tuple(chosen), ""
    if count < 3:
        palette = (
            "; a palette is expanded by gdal_translate -expand rgb" if source.colorinterp[0].name == "palette" else ""
        )
        raise BandsUnusable(
            f"{source.name} has {count} band(s), the models need red, green and blue: give bands=1,1,1 to use one band "
            f"for all three{palette}"
        )
    for names in ([c.name for c in source.colorinterp], [_colour(text) for text in source.descriptions]):
        if {"red", "green", "blue"} <= set(names):
            return tuple(names.index(colour) + 1 for colour in ("red", "green", "blue")), ""
    if count == 3:
        return (1, 2, 3), ""
    if count == 8:
        return (5, 3, 2), ""
    return (1, 2, 3), (
        f"{source.name} does not say which of its {count} bands are red, green and blue: 1,2,3 are used; if it is a "
        "WorldView or other product in the order blue, green, red, give bands=3,2,1"
    )


def _colour(description: str | None) -> str:
    # "Red Edge", "Deep Blue" and "Coastal Blue" are bands beside red and blue.
    words = re.sub(r"[\W_]+", " ", (description or "").lower())
    found = re.search(r"(?<!deep )(?<!coastal )\b(red|green|blue)\b(?! edge)", words)
    return found.group(1) if found else ""


def nodata_of(source: rasterio.DatasetReader) -> float | None:
    """The value that marks a pixel without data if all bands have it; None where a mask, or nothing, does.

    Without a declared value or a mask, integers of more than 8 bit take 0 (the vendors' fill) and floats NaN.
    """
    if source.nodata is not None:
        return float(source.nodata) if np.isfinite(source.nodata) else float("nan")
    if _masked(source) or _alpha(source) is not None or source.dtypes[0] in ("uint8", "int8"):
        return None
    return 0.0 if np.issubdtype(source.dtypes[0], np.integer) else float("nan")


def _masked(source: rasterio.DatasetReader) -> bool:
    from rasterio.enums import MaskFlags

    return any(MaskFlags.per_dataset in flags for flags in source.mask_flag_enums)


def _alpha(source: rasterio.DatasetReader) -> int | None:
    """The number of the alpha band, if there is one."""
    names = [colour.name for colour in source.colorinterp]
    return names.index("alpha") + 1 if "alpha" in names else None


def has_data(values: np.ndarray, nodata: float | None) -> np.ndarray:
    """Which pixels of `values` (bands, rows, cols) hold data: bool (rows, cols)."""
    valid = np.isfinite(values).all(axis=0) if values.dtype.kind == "f" else np.ones(values.shape[1:], bool)
    if nodata is not None and not np.isnan(nodata):
        valid &= (values != np.array(nodata).astype(values.dtype)).any(axis=0)
    return valid


def read(
    source: rasterio.DatasetReader, bands: tuple[int, ...], nodata: float | None, **region
) -> tuple[np.ndarray, np.ndarray]:
    """Raw values (bands, rows, cols) and which pixels hold data; `region` is rasterio's `window` and `out_shape`."""
    shape = region.pop("out_shape", None)
    with reading(source, region.get("window", "full size")):
        values = source.read(list(bands), out_shape=shape and (len(bands), *shape), **region)
        valid = has_data(values, nodata)
        if (alpha := _alpha(source)) is not None:  # GDAL's own mask leaves it out where a nodata value is declared too
            valid &= source.read(alpha, out_shape=shape, **region) > 0
        elif _masked(source):
            valid &= source.dataset_mask(out_shape=shape, **region) > 0
    return values, valid


def sample(
    source: rasterio.DatasetReader, bands: tuple[int, ...], nodata: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """As `read`, for statistics: all of a raster of up to 4 million pixels, of a larger one as many, in a lattice of windows.

    Raises `NoData` if not one pixel of the raster holds data.
    """
    from rasterio.windows import Window

    side = int(np.sqrt(SAMPLE_PIXELS)) // LATTICE
    if source.width * source.height <= SAMPLE_PIXELS:
        values, valid = read(source, bands, nodata)
    else:
        width, height = min(side, source.width), min(side, source.height)
        windows = [
            read(source, bands, nodata, window=Window(int(col), int(row), width, height))
            for row in np.linspace(0, source.height - height, LATTICE)
            for col in np.linspace(0, source.width - width, LATTICE)
        ]
        values = np.concatenate([values for values, _ in windows], axis=1)
        valid = np.concatenate([valid for _, valid in windows])
        if not valid.any():
            step = np.sqrt(source.width * source.height / SAMPLE_PIXELS)
            shape = (int(np.ceil(source.height / step)), int(np.ceil(source.width / step)))
            values, valid = read(source, bands, nodata, out_shape=shape)
    if not valid.any():
        raise NoData(f"{source.name} holds no data: every pixel is nodata or masked")
    return values, valid


def stretch_of(values: np.ndarray, valid: np.ndarray) -> tuple[tuple[float, float, float], ...] | None:
    """The stretch of a sample: per band (low, high, gamma), or None for uint8, which is used as it is.

    Low and high are each band's own 1st and 99th percentile and gamma is 0.6. Chosen on three 16-bit WorldView-2 images
    with 8-bit twins made for viewing: this rule gives the twins back within 0.7 grey levels (RMS), where 2–98 % with the
    same gamma is off by 5–11, one range for all three bands by 4–10 and a linear stretch by 30.
    """
    if values.dtype == np.uint8:
        return None
    ranges = (np.percentile(band[valid].astype(np.float64), STRETCH_PERCENTILES) for band in values)
    return tuple((float(low), float(high if high > low else low + 1.0), STRETCH_GAMMA) for low, high in ranges)


def stretched(values: np.ndarray, stretch: tuple[tuple[float, float, float], ...] | None) -> np.ndarray:
    """Raw values (bands, rows, cols) as uint8: 1 + 254·((v − low) / (high − low))^gamma, clipped to 1–255."""
    if stretch is None:
        return values
    out = np.empty(values.shape, np.uint8)
    for band, raw, (low, high, gamma) in zip(out, values, stretch, strict=True):
        if raw.dtype.itemsize == 2 and raw.dtype.kind in "iu":
            span = np.iinfo(raw.dtype)
            table = _curve(np.arange(span.min, span.max + 1), low, high, gamma)
            band[:] = table[raw.astype(np.int64) - span.min]
        else:
            band[:] = _curve(np.nan_to_num(raw, nan=low), low, high, gamma)
    return out


def _curve(values: np.ndarray, low: float, high: float, gamma: float) -> np.ndarray:
    share = np.clip((values.astype(np.float64) - low) / (high - low), 0.0, 1.0)
    return np.rint(1.0 + 254.0 * share**gamma).astype(np.uint8)
