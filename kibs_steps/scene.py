"""Scene: the facts about one raster, checked once and written to `scene.json`.

In: a georeferenced raster, a terrain model (file or number), the scene's configuration. Out: `scene.json` (this module's
`Scene`) and `dtm.tif`, the terrain in the scene's CRS in metres without holes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from kibs_steps import cli, store, terrain
from kibs_steps import view as geometry
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.view import Surface

if TYPE_CHECKING:
    import pyproj
    import rasterio
    import shapely

COARSEST = 1.6  # times the model's GSD
SAME_GSD = 0.005  # a raster whose GSD differs less from the model's is used as it is
DEGREES = 4326  # EPSG: longitude and latitude in degrees from Greenwich
SCALE_ERROR = 0.01  # of a projection, beyond which its metres are no metres


class GsdTooCoarse(KibsError):
    """A raster that does not show what the models look for."""


class AnglesUnusable(KibsError):
    """A view or sun direction that is incomplete or impossible."""


class AoiUnusable(KibsError):
    """An area of interest that selects nothing of the raster."""


class VerticalCrsUnusable(KibsError):
    """A vertical CRS that is none."""


class Direction(NamedTuple):
    """A direction to the satellite or the sun: azimuth and elevation (deg), and its lean (m/m, grid axes east, north)."""

    azimuth: float
    elevation: float
    lean: tuple[float, float]


class Region(NamedTuple):
    """A part of the image (polygon, image map frame, m) that was seen from another direction, as in an aerial mosaic."""

    outline: shapely.Geometry
    view: Direction


class Scene(NamedTuple):
    """What every later step needs to know; `view` and `sun` are None when unknown.

    `regions` have a view of their own; `view` holds outside them. `stretch` is (low, high, gamma) per band, `nodata` the value
    that marks missing data in all bands
    (`imagery.stretch_of`, `imagery.nodata_of`).
    """

    name: str
    raster: str
    bands: tuple[int, int, int]
    stretch: tuple[tuple[float, float, float], ...] | None
    grid: Grid
    view: Direction | None
    sun: Direction | None
    projection_height: float | None
    folder: Path
    nodata: float | None = None
    regions: tuple[Region, ...] = ()
    displaced: float = 0.0  # m, how far from where it is seen the ground itself may stand (`projection_height`)

    @property
    def lean(self) -> tuple[float, float]:
        """Lean of the view, m per m of height; (0, 0) when the view is unknown: nothing is moved then."""
        return self.view.lean if self.view else (0.0, 0.0)

    def views(self, seen: np.ndarray) -> list[Direction | None]:
        """From where the image shows the points seen at `seen` (n, 2 image map metres)."""
        import shapely

        found = [self.view] * len(seen)
        for region in self.regions:
            for k in np.flatnonzero(shapely.intersects_xy(region.outline, *np.asarray(seen, float).T)):
                found[k] = region.view
        return found

    def view_of(self, part: Window) -> Direction | None:
        """From where the image shows the middle of a window (px), for what takes one direction for all of it."""
        middle = np.array([[part.col + part.width / 2, part.row + part.height / 2]])
        return self.views(self.grid.to_map(middle))[0]

    def leans(self, seen: np.ndarray) -> np.ndarray:
        """Lean (n, 2) at points seen at `seen` (n, 2 image map metres); (0, 0) where the view is unknown."""
        if not self.regions:
            return np.broadcast_to(np.array(self.lean, float), (len(seen), 2))
        return np.array([v.lean if v else (0.0, 0.0) for v in self.views(seen)], float).reshape(-1, 2)

    def terrain(
        self, bounds: tuple[float, float, float, float], margin: float = 200.0, step: float = 0.0
    ) -> terrain.Terrain:
        """The DTM around `bounds` (left, bottom, right, top, map metres) and where what is seen there stands, no finer than a
        `step` (m) asks for."""
        return terrain.read(self.folder / "dtm.tif", bounds, margin + self.displaced, step)

    def projected_on(self, dtm: Surface) -> Surface:
        """The surface the image was projected on: the DTM, or the constant `projection_height`."""
        return dtm if self.projection_height is None else terrain.flat(self.projection_height)


def read(path: str | Path) -> Scene:
    """Read `scene.json`."""
    content = store.read_json(path)

    def direction(key: str) -> Direction | None:
        d = content[key]
        return d and Direction(d["azimuth"], d["elevation"], tuple(d["lean"]))

    nodata = content.get("nodata")
    return Scene(
        name=content["name"],
        raster=content["raster"],
        bands=tuple(content["bands"]),
        stretch=content["stretch"] and tuple(map(tuple, content["stretch"])),
        grid=Grid(**content["grid"]),
        view=direction("view"),
        sun=direction("sun"),
        projection_height=content["projection_height"],
        folder=Path(path).parent,
        nodata=None if nodata is None else float(nodata),
        regions=_regions_in(content),
        displaced=content.get("displaced", 0.0),
    )


def _regions_in(content: dict[str, Any]) -> tuple[Region, ...]:
    if not content.get("regions"):
        return ()
    import shapely

    return tuple(
        Region(shapely.from_wkt(r["outline"]), Direction(r["azimuth"], r["elevation"], tuple(r["lean"])))
        for r in content["regions"]
    )


def model_grid(raster: str | Path, gsd: float, aoi: str | Path | None = None) -> Grid:
    """The model grid of a raster for a model of that GSD (m/px), clipped to the bounds of `aoi`; reads headers only.

    A north-up raster in a projected CRS in metres keeps its CRS: its own pixels where its GSD is within 0.5 % of the
    model's, else pixels of the model's GSD over the same bounds. Any other gets the WGS 84 UTM zone of its centre.
    Raises `GsdTooCoarse`, `AoiUnusable` and what `imagery.opened` and `imagery.crs_of` raise.
    """
    from kibs_steps import imagery

    with imagery.opened(raster) as source:
        grid = _grid_of(source, gsd)
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
    if north_up and _in_true_metres(crs, imagery.outline(source, crs, 1).mean(axis=0)):
        return crs, True
    longitude, latitude = imagery.outline(source, pyproj.CRS.from_epsg(DEGREES), 1).mean(axis=0)
    return _utm(longitude, latitude), False


def _grid_of(source: rasterio.DatasetReader, gsd: float) -> Grid:
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


def _in_true_metres(crs: pyproj.CRS, centre: np.ndarray) -> bool:
    """Whether a map metre of this CRS is a metre on the ground, within 1 %: not so in feet, degrees and Mercator."""
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


def direction(
    azimuth: float | None, elevation: float | None, grid: Grid, of: str = "view", lowest: float = 20.0
) -> Direction | None:
    """A direction with its lean in the grid's axes at the scene's centre; None if neither angle is known.

    Degrees; azimuth clockwise from true north, from the target; elevation at the target, in (`lowest`, 90]. Raises
    `AnglesUnusable` naming the keys `{of}_azimuth` and `{of}_elevation`.
    """
    if azimuth is None and elevation is None:
        return None
    if azimuth is None or elevation is None:
        there, lacking = ("elevation", "azimuth") if azimuth is None else ("azimuth", "elevation")
        raise AnglesUnusable(f"{of}_{there} is given without {of}_{lacking}: give both, or neither if it is unknown")
    if not -360.0 <= azimuth <= 360.0:
        raise AnglesUnusable(f"{of}_azimuth={azimuth:g} is no azimuth: give degrees clockwise from north, 0 to 360")
    if not lowest < elevation <= 90.0:
        raise AnglesUnusable(
            f"{of}_elevation={elevation:g} is outside ({lowest:g}, 90]: give degrees above the horizon at the target (90 minus "
            "the incidence angle; not the sensor's off-nadir angle)"
        )
    lean = (0.0, 0.0) if elevation == 90.0 else geometry.lean(azimuth, elevation, convergence(grid))
    return Direction(float(azimuth) % 360.0, float(elevation), lean)


def convergence(grid: Grid) -> float:
    """Meridian convergence (deg) at the grid's centre: the angle from true to grid north, clockwise."""
    import pyproj

    crs = pyproj.CRS.from_user_input(grid.crs)
    left, bottom, right, top = grid.bounds
    _, (x, y) = _ground_metre(crs, (left + right) / 2.0, (bottom + top) / 2.0)
    return round(float(np.degrees(np.arctan2(-x, y))), 6)


def facts(source: rasterio.DatasetReader, gsd: float, bands: tuple[int, ...] | None = None) -> dict[str, Any]:
    """What `scene.json` says of the raster itself: bands, stretch, dtype, nodata, source, coverage, tags, warnings.

    Raises `imagery.BandsUnusable` and `imagery.NoData`.
    """
    import pyproj

    from kibs_steps import imagery

    imagery.complete(source)
    chosen, doubt = imagery.colour_bands(source, bands)
    warnings = [doubt] if doubt else []
    nodata = imagery.nodata_of(source)
    values, valid = imagery.sample(source, chosen, nodata)
    black = float((valid & (values == 0).all(axis=0)).mean())
    if nodata is None and black == 1.0:
        raise imagery.NoData(f"{source.name} is black everywhere: give the image itself, not a mask or an empty copy")
    if nodata is None and black > 0.05:
        warnings.append(
            f"{100 * black:.0f} % of {source.name} is black (0,0,0) and counts as data: if it is missing data, declare it "
            "(gdal_edit.py -a_nodata 0)"
        )
    crs = imagery.crs_of(source)
    grid = _grid_of(source, gsd)
    own = max(imagery.pixel_size(source, pyproj.CRS.from_user_input(grid.crs)))
    if own > (1 + SAME_GSD) * gsd:
        warnings.append(
            f"{source.name} has pixels of {own:.2f} m, coarser than the models' {gsd:g} m: it is enlarged and shows less detail "
            "than they know"
        )
    tags = source.tags()
    return {
        "bands": list(chosen),
        "stretch": imagery.stretch_of(values, valid),
        "dtype": source.dtypes[0],
        "nodata": "nan" if nodata is not None and np.isnan(nodata) else nodata,
        "source": {"width": source.width, "height": source.height, "crs": imagery.crs_name(crs), "gsd": round(own, 6)},
        "coverage": round(float(valid.mean()), 6),
        "date": tags.get("TIFFTAG_DATETIME"),
        "licence": tags.get("TIFFTAG_COPYRIGHT"),
        "warnings": warnings,
    }


def build(
    name: str,
    raster: str | Path,
    dtm: str | Path | float,
    gsd: float,
    folder: str | Path,
    *,
    bands: tuple[int, ...] | None = None,
    aoi: str | Path | None = None,
    view: tuple[float | None, float | None] = (None, None),
    sun: tuple[float | None, float | None] = (None, None),
    projection_height: float | None = None,
    vertical_crs: str | None = None,
    regions: str | Path | None = None,
) -> Scene:
    """Check everything and write `scene.json` and `dtm.tif` into `folder`; angles as (azimuth, elevation) in deg.

    Raises a `KibsError` for every input that cannot be used; nothing is written then but, perhaps, `dtm.tif`.
    """
    import pyproj
    import shapely

    from kibs_steps import dtm as terrain_model
    from kibs_steps import imagery
    from kibs_steps import regions as region_layer

    grid = model_grid(raster, gsd, aoi)
    directions = {
        "view": direction(*view, grid, "view"),
        "sun": direction(*sun, grid, "sun", lowest=5.0),
    }
    parts = region_layer.read(regions, grid) if regions else ()
    check_vertical(vertical_crs)
    if projection_height is not None and not abs(projection_height) <= terrain_model.HIGHEST:
        raise terrain_model.DtmAbsurd(f"projection_height={projection_height} is no height on Earth: give metres")
    with imagery.opened(raster) as source:
        found = facts(source, gsd, bands)
        footprint = imagery.outline(source, pyproj.CRS.from_user_input(grid.crs))
    if not shapely.Polygon(footprint).intersection(shapely.box(*grid.bounds)).area:
        raise AoiUnusable(f"aoi {aoi} lies beside the raster {raster}, which is turned in its CRS: move it")
    doubts = terrain_model.check(str(dtm), grid, footprint, vertical_crs)
    leans = [d.lean for d in (directions["view"], *(part.view for part in parts)) if d]
    ground, displaced = _ground(dtm, grid, footprint, Path(folder) / "dtm.tif", projection_height, leans)
    warnings = found.pop("warnings") + doubts
    if ground["filled"]:
        warnings.append(
            f"dtm {dtm} has no data on {100 * ground['filled']:.2f} % of the scene: filled from its neighbours"
        )
    content = {
        "name": name,
        "raster": str(raster),
        **found,
        "grid": grid._asdict(),
        **{key: d and d._asdict() for key, d in directions.items()},
        "projection_height": projection_height,
        "vertical_crs": vertical_crs,
        "displaced": round(displaced, 3),
        "dtm": ground,
        "regions": [{"outline": shapely.to_wkt(r.outline, rounding_precision=3), **r.view._asdict()} for r in parts],
        "warnings": warnings,
    }
    store.write_json(Path(folder) / "scene.json", content)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return read(Path(folder) / "scene.json")


def _ground(
    dtm: str | Path | float,
    grid: Grid,
    footprint: np.ndarray,
    path: Path,
    projection_height: float | None,
    leans: list[tuple[float, float]],
) -> tuple[dict[str, Any], float]:
    """Writes `dtm.tif` as far as all stands that the raster shows: its record, and how far (m) it is from where it is seen.

    An image projected on one height shows ground of height T moved by (T − that height) times the lean. How high the ground is
    there is only known once it is read, so it is written again until it reaches as far as its own heights ask for.
    """
    from kibs_steps import dtm as terrain_model

    record = terrain_model.write(dtm, grid, footprint, path)
    if projection_height is None or not leans:
        return record, 0.0
    moves = terrain_model.STAYS
    for _ in range(8):
        above = np.array(terrain_model.extremes(path)) - projection_height
        wanted = (above[:, None, None] * np.array(leans)[None]).reshape(-1, 2)
        if len(moves) == len(wanted) and np.allclose(moves, wanted):
            break
        moves = wanted
        record = terrain_model.write(dtm, grid, footprint, path, moves=moves)
    return record, float(np.hypot(*moves.T).max())


def check_vertical(vertical_crs: str | None) -> None:
    """Raise `VerticalCrsUnusable` for a vertical CRS that is none, is more than that, or does not count in metres."""
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


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


def main(argv: list[str] | None = None) -> None:
    """Check a raster and its terrain model and write scene.json and, beside it, dtm.tif."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.scene", description=main.__doc__)
    parser.add_argument("--name", required=True, help="the scene's name")
    parser.add_argument("--raster", required=True, help="georeferenced image")
    parser.add_argument("--dtm", required=True, help="terrain model: a raster, or one height in metres")
    parser.add_argument("--gsd", type=float, required=True, help="the models' GSD, m per pixel")
    parser.add_argument("--out", required=True, help="out: scene.json")
    parser.add_argument("--bands", type=_numbers, help="band numbers of red, green, blue, as in 5,3,2")
    parser.add_argument("--aoi", help="vector file: only the raster within its bounds is used")
    parser.add_argument("--view-azimuth", type=float, help="deg from true north to the satellite, seen from the target")
    parser.add_argument("--view-elevation", type=float, help="deg above the horizon at the target")
    parser.add_argument("--sun-azimuth", type=float, help="deg from true north")
    parser.add_argument("--sun-elevation", type=float, help="deg above the horizon")
    parser.add_argument(
        "--projection-height", type=float, help="m: the image was projected on this height, not the terrain"
    )
    parser.add_argument("--vertical-crs", help="CRS of absolute heights, as in EPSG:5773")
    parser.add_argument("--regions", help="polygons with view_azimuth, view_elevation, where the view varies")
    args = parser.parse_args(argv)
    build(
        args.name,
        args.raster,
        args.dtm,
        args.gsd,
        Path(args.out).parent,
        bands=args.bands,
        aoi=args.aoi,
        view=(args.view_azimuth, args.view_elevation),
        sun=(args.sun_azimuth, args.sun_elevation),
        projection_height=args.projection_height,
        vertical_crs=args.vertical_crs,
        regions=args.regions,
    )


if __name__ == "__main__":
    cli.run(main)
