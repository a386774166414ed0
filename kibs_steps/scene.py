"""Scene: the facts about one raster, checked once and written to `scene.json`.

In: a georeferenced raster, a terrain model (file or number), the scene's configuration. Out: `scene.json` (this module's
`Scene`) and `dtm.tif`, the terrain in the scene's CRS in metres without holes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from kibs_steps import cli, georeference, store, terrain
from kibs_steps import view as geometry
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.view import Surface

if TYPE_CHECKING:
    import rasterio
    import shapely


STOPS = 65  # points a side of the image at which it is asked where its ground stands
SETTLED = 8  # steps after which a place at the border of two regions is left to one of them


class AnglesUnusable(KibsError):
    """A view or sun direction that is incomplete or impossible."""


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

    def leans_of(self, standing: np.ndarray, dtm: Surface) -> np.ndarray:
        """Lean (n, 2) at things that *stand* at `standing` (n, 3 map metres): that of where the image shows them.

        Where that is follows from the lean itself: it is settled step by step from the place where they stand.
        """
        lean = self.leans(standing[:, :2])
        for _ in range(len(self.regions) and SETTLED):
            seen = geometry.image_position(standing[:, :2], standing[:, 2], lean, self.projected_on(dtm))
            before, lean = lean, self.leans(seen)
            if np.array_equal(before, lean):
                break
        return lean

    def terrain(
        self, bounds: tuple[float, float, float, float], margin: float = 200.0, step: float = 0.0
    ) -> terrain.Terrain:
        """The DTM around `bounds` (left, bottom, right, top, map metres) and where what is seen there stands, no finer than a
        `step` (m) asks for."""
        return terrain.read(self.folder / "dtm.tif", bounds, margin + self.displaced, step)

    @property
    def standing(self) -> Grid:
        """The grid laid over where the ground stands that the image shows: another one where it was projected on one height."""
        if self.projection_height is None:
            return self.grid
        left, bottom, right, top = self.grid.bounds
        x, y = np.meshgrid(np.linspace(left, right, STOPS), np.linspace(top, bottom, STOPS))
        seen = np.column_stack([x.ravel(), y.ravel()])
        dtm = self.terrain(self.grid.bounds, step=max(right - left, top - bottom) / STOPS / 4)
        place, _ = geometry.ground_position(seen, np.zeros(len(seen)), dtm, self.leans(seen), self.projected_on(dtm))
        pixels = self.grid.to_image(place)
        col, row = np.floor(pixels.min(axis=0)).astype(int).tolist()
        width, height = (np.ceil(pixels.max(axis=0)).astype(int) - (col, row)).tolist()
        return self.grid.part(Window(col, row, width, height))

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
    lean = (0.0, 0.0) if elevation == 90.0 else geometry.lean(azimuth, elevation, georeference.convergence(grid))
    return Direction(float(azimuth) % 360.0, float(elevation), lean)


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
    grid = georeference.grid_of(source, gsd)
    own = max(imagery.pixel_size(source, pyproj.CRS.from_user_input(grid.crs)))
    if own > (1 + georeference.SAME_GSD) * gsd:
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

    grid = georeference.model_grid(raster, gsd, aoi)
    directions = {
        "view": direction(*view, grid, "view"),
        "sun": direction(*sun, grid, "sun", lowest=5.0),
    }
    parts = region_layer.read(regions, grid) if regions else ()
    georeference.check_vertical(vertical_crs)
    if projection_height is not None and not abs(projection_height) <= terrain_model.HIGHEST:
        raise terrain_model.DtmAbsurd(f"projection_height={projection_height} is no height on Earth: give metres")
    with imagery.opened(raster) as source:
        found = facts(source, gsd, bands)
        footprint = imagery.outline(source, pyproj.CRS.from_user_input(grid.crs))
    if not shapely.Polygon(footprint).intersection(shapely.box(*grid.bounds)).area:
        raise georeference.AoiUnusable(
            f"aoi {aoi} lies beside the raster {raster}, which is turned in its CRS: move it"
        )
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
        wanted = moves_on(path, projection_height, leans)
        if len(moves) == len(wanted) and np.allclose(moves, wanted):
            break
        moves = wanted
        record = terrain_model.write(dtm, grid, footprint, path, moves=moves)
    return record, float(np.hypot(*moves.T).max())


def moves_on(path: str | Path, projection_height: float, leans: Sequence[tuple[float, float]]) -> np.ndarray:
    """How far (m, 2 map metres) ground of the lowest and the highest height of a `dtm.tif` stands from where it is seen."""
    from kibs_steps import dtm as terrain_model

    above = np.array(terrain_model.extremes(path)) - projection_height
    return (above[:, None, None] * np.array(leans)[None]).reshape(-1, 2)


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
