"""Metadata: the directions to satellite and sun as an image's vendor gives them.

In: one file, told apart by its content: Maxar/WorldView `.IMD` or its XML twin, Airbus DIMAP XML (Pléiades, SPOT), a STAC
item, or rational
polynomial coefficients (`.RPB`, `_RPC.TXT`, or a raster that carries them). Out: `Angles` after PAPER's conventions: azimuths
clockwise
from true north **from the target**, elevations above the horizon at the target.

Vendors word these angles differently:
- Maxar: `meanSatAz`, `meanSatEl` (older: `satAz`, `satEl`) are what is wanted.
- DIMAP: `INCIDENCE_ANGLE` is measured at the target, so elevation = 90° − it. `AZIMUTH_ANGLE` is the direction of the *image's
lines*; the
  satellite stands at that minus atan2(tan across-track, tan along-track incidence), as the Orfeo ToolBox and ACOLITE have it.
- STAC: `view:azimuth` is worded from the sub-satellite point to the scene, the satellite is at 180° more; `view:off_nadir` is
  measured at the sensor and is not used, but must agree with `view:incidence_angle`.
- RPC: while a point rises by dZ, its place in the image stays when it moves by k·dZ toward the satellite; k is the lean.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from kibs_steps.errors import KibsError

LARGEST = 20_000_000  # bytes: no text file of metadata is larger
RISE = 100.0  # m, by which a point is lifted to see where the RPC sends it
EARTH = 6371.0  # km
ORBITS = (400.0, 850.0)  # km, heights of satellites that see details of half a metre


class MetadataUnusable(KibsError):
    """A metadata file that cannot be read, or does not say where the satellite stood."""


class Angles(NamedTuple):
    """Directions to satellite and sun, deg; None where the file does not tell."""

    view_azimuth: float | None
    view_elevation: float | None
    sun_azimuth: float | None = None
    sun_elevation: float | None = None


def read(path: str | Path) -> Angles:
    """The angles in a metadata file. Raises `MetadataUnusable`."""
    path = Path(path)
    if not path.is_file():
        raise MetadataUnusable(f"metadata {path} is not there: give the vendor's .IMD, .XML, STAC .json or RPC file")
    with path.open("rb") as source:
        head = source.read(4096)
    text = path.read_text(encoding="utf-8-sig", errors="replace") if _is_text(head, path) else None
    if text is None:
        found = of_rpc(*_raster_rpc(path))
    elif text.lstrip().startswith("{"):
        found = of_stac(_parsed(json.loads, text, path), path)
    elif text.lstrip().startswith("<"):
        found = of_xml(_parsed(ElementTree.fromstring, text, path), path)
    elif re.search(r"lineNumCoef|LINE_NUM_COEFF", text):
        found = of_rpc(*rpc_of_text(text, path))
    else:
        found = of_imd(text, path)
    if found.view_azimuth is None or found.view_elevation is None:
        raise MetadataUnusable(f"metadata {path} does not say where the satellite stood: {_HELP}")
    return Angles(*(None if v is None else round(float(v), 6) for v in found))


_HELP = "give view_azimuth and view_elevation instead"


def _is_text(head: bytes, path: Path) -> bool:
    return b"\0" not in head and path.stat().st_size <= LARGEST


def _parsed(parse: Callable[[str], Any], text: str, path: Path) -> Any:
    try:
        return parse(text.encode() if parse is ElementTree.fromstring else text)
    except (ValueError, ElementTree.ParseError) as error:
        raise MetadataUnusable(f"metadata {path} is damaged ({error}): fetch it again, or {_HELP}") from error


def of_imd(text: str, path: Path) -> Angles:
    """Angles of a Maxar `.IMD`: `key = value;` lines, the first image's values."""
    values = {key.lower(): value for key, value in reversed(re.findall(r"(\w+)\s*=\s*\"?([-+.\deE]+)\"?\s*;", text))}
    return _maxar(values, path)


def _maxar(values: dict[str, str], path: Path) -> Angles:
    def number(*keys: str) -> float | None:
        return next((_number(values[key.lower()], key, path) for key in keys if values.get(key.lower())), None)

    azimuth = number("meanSatAz", "satAz")
    sun = number("meanSunAz", "sunAz"), number("meanSunEl", "sunEl")
    return Angles(azimuth, number("meanSatEl", "satEl"), *sun)


def _number(text: str, key: str, path: Path) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise MetadataUnusable(f"metadata {path}: {key} = {text!r} is no number: {_HELP}")
    return value


def of_xml(root: ElementTree.Element, path: Path) -> Angles:
    """Angles of a Maxar XML or an Airbus DIMAP, versions 1 and 2."""
    values = {e.tag.split("}")[-1].lower(): (e.text or "").strip() for e in reversed(list(root.iter()))}
    if "meansataz" in values or "sataz" in values:
        return _maxar(values, path)
    places = [e for e in root.iter() if e.tag.split("}")[-1] == "Located_Geometric_Values"]
    for place in places:
        inner = {e.tag.split("}")[-1].lower(): (e.text or "").strip() for e in place.iter()}
        if inner.get("location_type", "").lower() == "center" or len(places) == 1:
            values = values | inner
            break

    def number(key: str) -> float | None:
        return _number(values[key.lower()], key, path) if values.get(key.lower()) else None

    incidence, azimuth = number("INCIDENCE_ANGLE"), number("AZIMUTH_ANGLE")
    across, along = number("INCIDENCE_ANGLE_ACROSS_TRACK"), number("INCIDENCE_ANGLE_ALONG_TRACK")
    if azimuth is not None and across is not None and along is not None:
        azimuth -= np.degrees(np.arctan2(np.tan(np.radians(across)), np.tan(np.radians(along))))
    else:  # that of the image's lines is not the satellite's
        azimuth = number("SATELLITE_AZIMUTH_ANGLE")
    if incidence is None:
        incidence = number("SATELLITE_INCIDENCE_ANGLE")
    return Angles(
        None if azimuth is None else azimuth % 360.0,
        None if incidence is None else 90.0 - abs(incidence),
        number("SUN_AZIMUTH"),
        number("SUN_ELEVATION"),
    )


def of_stac(item: dict[str, Any], path: Path) -> Angles:
    """Angles of a STAC item with the view extension."""
    properties = item.get("properties")
    if not isinstance(properties, dict):
        raise MetadataUnusable(f"metadata {path} is no STAC item (it has no properties): {_HELP}")

    def number(key: str) -> float | None:
        value = properties.get(f"view:{key}")
        return None if value is None else _number(str(value), f"view:{key}", path)

    azimuth, incidence, off_nadir = number("azimuth"), number("incidence_angle"), number("off_nadir")
    if incidence is None:
        raise MetadataUnusable(
            f"metadata {path} gives no view:incidence_angle (view:off_nadir is measured at the sensor, not at the target): "
            "give view_elevation = 90 minus the incidence angle, and view_azimuth"
        )
    if off_nadir is not None:
        low, high = (incidence_of(off_nadir, height) for height in ORBITS)
        if not low - 2.0 <= incidence <= high + 2.0:
            raise MetadataUnusable(
                f"metadata {path} contradicts itself: view:off_nadir {off_nadir:g}° goes with {low:.1f}–{high:.1f}°, "
                f"but view:incidence_angle is {incidence:g}° (some vendors write the elevation there): {_HELP}"
            )
    return Angles(
        None if azimuth is None else (azimuth + 180.0) % 360.0,
        90.0 - incidence,
        number("sun_azimuth"),
        number("sun_elevation"),
    )


def incidence_of(off_nadir: float, orbit: float) -> float:
    """Incidence angle at the target (deg) of a sensor's off-nadir angle (deg) from `orbit` km."""
    return float(np.degrees(np.arcsin(min(1.0, (EARTH + orbit) / EARTH * np.sin(np.radians(abs(off_nadir)))))))


class Rpc(NamedTuple):
    """Rational polynomials: offsets and scales of (line, sample, lat, long, height), four times 20 coefficients."""

    offset: np.ndarray
    scale: np.ndarray
    coefficients: np.ndarray

    def image(self, longitude: float, latitude: float, height: float) -> np.ndarray:
        """(line, sample) of a point (deg, deg, m)."""
        lat, lon, h = (np.array([latitude, longitude, height]) - self.offset[2:]) / self.scale[2:]
        terms = np.array(
            [1, lon, lat, h, lon * lat, lon * h, lat * h, lon**2, lat**2, h**2, lat * lon * h, lon**3, lon * lat**2,
             lon * h**2, lon**2 * lat, lat**3, lat * h**2, lon**2 * h, lat**2 * h, h**3]
        )  # fmt: skip
        numerator, denominator = (self.coefficients @ terms).reshape(2, 2).T
        return numerator / denominator * self.scale[:2] + self.offset[:2]


def of_rpc(rpc: Rpc, place: tuple[float, float, float]) -> Angles:
    """View angles of an RPC at a place (longitude, latitude, height). The sun is not in it."""
    import pyproj

    longitude, latitude, height = place
    step = 1e-4  # deg, about 10 m
    here = rpc.image(longitude, latitude, height)
    east = (rpc.image(longitude + step, latitude, height) - here) / step
    north = (rpc.image(longitude, latitude + step, height) - here) / step
    up = (rpc.image(longitude, latitude, height + RISE) - here) / RISE
    if not np.isfinite([east, north, up]).all() or np.linalg.matrix_rank(np.column_stack([east, north])) < 2:
        raise MetadataUnusable(f"the RPC sends places near {latitude:.4f}, {longitude:.4f} nowhere: {_HELP}")
    d_longitude, d_latitude = np.linalg.solve(np.column_stack([east, north]), -up)
    azimuth, _, length = pyproj.Geod(ellps="WGS84").inv(
        longitude, latitude, longitude + d_longitude * RISE, latitude + d_latitude * RISE
    )
    return Angles(azimuth % 360.0, float(np.degrees(np.arctan2(RISE, length))))


def rpc_of_text(text: str, path: Path) -> tuple[Rpc, tuple[float, float, float]]:
    """The coefficients of an `.RPB` or `_RPC.TXT`, and the centre they hold for."""
    text = text.replace(",", " ")
    values: dict[str, list[float]] = {}
    for key, content in re.findall(r"(\w+)\s*[=:]\s*(\(?[-+.\deE\s]+\)?)", text):
        numbers = re.findall(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?|[-+]?\.\d+(?:[eE][-+]?\d+)?", content)
        values[key.lower().replace("_", "").replace("coeff", "coef")] = [float(n) for n in numbers]

    def one(*keys: str) -> float:
        for key in keys:
            if values.get(key):
                return values[key][0]
        raise MetadataUnusable(f"metadata {path} is no whole RPC file: {keys[0]} is missing; {_HELP}")

    def twenty(name: str) -> list[float]:
        found = values.get(name) or [one(f"{name}{k}") for k in range(1, 21)]
        if len(found) != 20:
            raise MetadataUnusable(f"metadata {path}: {name} has {len(found)} coefficients instead of 20; {_HELP}")
        return found

    names = (("lineoff", "lineoffset"), ("sampoff", "sampoffset"), ("latoff", "latoffset"), ("longoff", "longoffset"))
    offset = np.array([one(*n) for n in (*names, ("heightoff", "heightoffset"))])
    scale = np.array([one(n) for n in ("linescale", "sampscale", "latscale", "longscale", "heightscale")])
    parts = [twenty(n) for n in ("linenumcoef", "linedencoef", "sampnumcoef", "sampdencoef")]
    return Rpc(offset, scale, np.array(parts)), (offset[3], offset[2], offset[4])


def _raster_rpc(path: Path) -> tuple[Rpc, tuple[float, float, float]]:
    """The coefficients a raster carries, in its own tags or in a file beside it."""
    import rasterio

    try:
        with warnings.catch_warnings(), rasterio.open(path) as source:
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            rpcs = source.rpcs
    except rasterio.errors.RasterioIOError as error:
        raise MetadataUnusable(f"metadata {path} is no file we know ({error}): {_HELP}") from error
    if rpcs is None:
        raise MetadataUnusable(f"metadata {path} is a raster without RPC: give the vendor's original, or {_HELP}")
    offset = [rpcs.line_off, rpcs.samp_off, rpcs.lat_off, rpcs.long_off, rpcs.height_off]
    scale = [rpcs.line_scale, rpcs.samp_scale, rpcs.lat_scale, rpcs.long_scale, rpcs.height_scale]
    parts = [rpcs.line_num_coeff, rpcs.line_den_coeff, rpcs.samp_num_coeff, rpcs.samp_den_coeff]
    return Rpc(np.array(offset), np.array(scale), np.array(parts)), (rpcs.long_off, rpcs.lat_off, rpcs.height_off)
