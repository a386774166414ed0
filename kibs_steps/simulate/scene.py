"""Simulated scenes: random tiles for training, and whole scenes of made-up or real cities.

Run as a program it writes one scene: `scene.tif`, `dtm.tif`, `truth.gpkg`, `angles.json`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kibs_steps import cli, store
from kibs_steps import view as geometry
from kibs_steps.errors import KibsError
from kibs_steps.georeference import convergence, in_true_metres
from kibs_steps.grid import Grid
from kibs_steps.scene import Direction
from kibs_steps.simulate import citymodel, real
from kibs_steps.simulate.camera import CLEAR, Camera
from kibs_steps.simulate.city import MIXTURES, STYLES, procedural
from kibs_steps.simulate.citymodel import CityModel
from kibs_steps.simulate.draped import House
from kibs_steps.simulate.pieces import ROOF, City, pick
from kibs_steps.simulate.rendering import Rendering, render
from kibs_steps.terrain import Terrain, flat

# Azimuth, elevation and half angle (deg) of views that random scenes never show: models are judged there.
HELD_OUT_CONE = (250.0, 62.0, 5.0)
STEEP, ABOVE = (
    0.2,
    80.0,
)  # share of random views that are of this elevation (deg) and more: orthophotos, near-nadir images
SMALLEST = 64  # px
USUAL_CRS = "EPSG:32631"
TALL_STYLES = ("centre", "perimeter")
TALL_CITIES = 0.55  # of the tiles of tall buildings show real cities, if there are any
TALL_GROWN = 0.8  # of those have grown


def _direction(azimuth: float, elevation: float, convergence: float = 0.0) -> Direction:
    return Direction(azimuth, elevation, geometry.lean(azimuth, elevation, convergence))


def geometry_vector(view: Direction, sun: Direction, gsd: float) -> np.ndarray:
    """The networks' geometry input, float32 (6,): lean of view (col, row) and of shadows, px per m of height, known flags.

    A roof point at height h is shown at ground px + h·[0:2], its shadow tip falls at ground px + h·[2:4].
    """
    (kx, ky), (sx, sy) = view.lean, sun.lean
    return np.array([-kx / gsd, ky / gsd, -sx / gsd, sy / gsd, 1.0, 1.0], np.float32)


def relief(
    rng: np.random.Generator,
    bounds: tuple[float, float, float, float],
    step: float,
    amplitude: float,
    slope: float,
    base: float = 0.0,
) -> Terrain:
    """Terrain over `bounds` (left, bottom, right, top): smooth waves of `amplitude` (m) on a plane of `slope` (m/m), float32."""
    x = np.arange(bounds[0] + step / 2, bounds[2] + step / 2, step)
    y = np.arange(bounds[3] - step / 2, bounds[1] - step / 2, -step)
    angle = rng.uniform(0, 2 * np.pi)
    cx, cy = x - x.mean(), y - y.mean()
    z = base + slope * (np.cos(angle) * cx[None] + np.sin(angle) * cy[:, None])
    for _ in range(3 if amplitude else 0):
        length, turn, phase = rng.uniform(150, 500), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        wave = 2 * np.pi / length * (np.cos(turn) * cx[None] + np.sin(turn) * cy[:, None]) + phase
        z = z + amplitude / 3 * np.sin(wave)
    return Terrain(z.astype(np.float32).astype(np.float64), float(x[0]), float(y[0]), (step, step))


def _roofs_within(city: City, side: float) -> int:
    """Sections whose first corner stands in the square from (0, 0) to (side, side) m."""
    return sum(f.kind == ROOF and 0 < f.ring[0, 0] < side and 0 < f.ring[0, 1] < side for f in city.faces)


def _random_view(rng: np.random.Generator, low: float, high: float) -> tuple[float, float]:
    """Azimuth and elevation (deg) of a satellite, oblique views more often than steep ones, or (share STEEP) of an aeroplane
    from about above; never within HELD_OUT_CONE."""
    while True:
        azimuth = rng.uniform(0, 360)
        least = max(low, min(ABOVE, high)) if rng.random() < STEEP else low
        elevation = min(rng.triangular(least, least + 0.3 * (high - least), high) if high > least else least, 89.9)
        held_azimuth, held_elevation, cone = HELD_OUT_CONE
        off = abs((azimuth - held_azimuth + 180) % 360 - 180)
        if high == low or np.hypot(off * np.cos(np.radians(held_elevation)), elevation - held_elevation) > cone:
            return azimuth, elevation


def random_scene(
    rng: np.random.Generator,
    size: int = 256,
    gsd: float = 0.38,
    view_elevation: tuple[float, float] = (45, 90),
    sun_elevation: tuple[float, float] = (15, 75),
    backgrounds: list[tuple[np.ndarray, np.ndarray]] | None = None,
    style: str | None = None,
    cities: Sequence[CityModel] = (),
    city_share: float = 0.3,
    houses: Sequence[House] = (),
    house_share: float = 0.2,
    view: tuple[float, float] | None = None,
    sun: tuple[float, float] | None = None,
    tall: bool = False,
) -> tuple[Rendering, np.ndarray]:
    """A random tile of `size`² px with its truth, and the networks' geometry vector (float32 (6,), docs/architecture.md).

    `city_share` of the tiles show a part of one of the real `cities`, if there are any; the others are procedural, of one `style`
    or of any, `house_share` of them with photographed `houses`, if there are any. `view` and `sun` (azimuth, elevation deg) stand
    in for random directions within the ranges. `tall`: a city's centre or perimeter blocks, or a real city whose houses have
    mostly grown, so that heights above 10 m are not the exception.
    """
    if tall:
        city_share, houses, style = TALL_CITIES, (), style or str(rng.choice(TALL_STYLES))
    side = size * gsd
    grid = Grid("", 0.0, side, gsd, size, size)
    seen_from = _direction(*(view or _random_view(rng, *view_elevation)))
    lit_from = _direction(*(sun or (rng.uniform(0, 360), rng.uniform(*sun_elevation))))
    style = style or str(
        rng.choice(
            [*STYLES, "mixed", "town"], p=[0.13, 0.12, 0.09, 0.17, 0.15, 0.07, 0.02, 0.04, 0.05, 0.02, 0.08, 0.06]
        )
    )
    model = pick(rng, cities) if len(cities) and rng.random() < city_share else None
    # Tall buildings outside lean into the tile.
    margin = 40.0 if model else {"centre": 55.0, "perimeter": 40.0, "estate": 40.0}.get(style, 25.0)
    terrain = flat(0.0)
    if rng.random() < 0.35:
        low, high = -margin - 60, side + margin + 60
        terrain = relief(rng, (low, low, high, high), 2.0, rng.uniform(0, 6), rng.uniform(0, 0.15))
    wide = side + 2 * margin
    stock = houses if len(houses) and not model and rng.random() < house_share else ()
    if len(stock):
        style = pick(rng, ("suburb", "suburb", "suburb", "village", "town", "farm"))

    def build() -> City:
        if model:
            area = (-margin, -margin, wide - margin, wide - margin)
            return real.city(rng, model, area, terrain, TALL_GROWN if tall else real.GROWN)
        return procedural(rng, wide, wide, terrain, style, (-margin, -margin), stock)

    city = build()
    # Tiles with hardly a roof teach little: most of them are drawn again.
    while _roofs_within(city, side) < 4 and rng.random() < 0.75:
        city = build()
    picture = render(city, terrain, grid, seen_from, lit_from, rng, backgrounds if rng.random() < 0.5 else None)
    return picture, geometry_vector(seen_from, lit_from, gsd)


def simulate(
    seed: int,
    grid: Grid,
    view: Direction,
    sun: Direction,
    style: str = "mixed",
    amplitude: float = 0.0,
    slope: float = 0.0,
    base: float = 100.0,
    model: CityModel | None = None,
    look: Camera | None = None,
) -> tuple[Rendering, Terrain]:
    """One scene over `grid`: its rendering and its terrain (2 m posting, 250 m beyond the grid).

    `amplitude` (m) and `slope` (m/m) shape the terrain, `base` (m) is its mean height. With a `model` the scene shows that
    city where it stands, on its own terrain. `look`: the camera, drawn at random if None.
    """
    rng = np.random.default_rng(seed)
    left, bottom, right, top = grid.bounds
    around = (left - 250, bottom - 250, right + 250, top + 250)
    margin = 60.0
    if model:
        terrain = real.surveyed_terrain(model, around, 2.0)
        within = (left - margin, bottom - margin, right + margin, top + margin)
        city = real.as_surveyed(rng, model, within, terrain)
        return render(city, terrain, grid, view, sun, rng, look=look), terrain
    terrain = relief(rng, around, 2.0, amplitude, slope, base)
    city = procedural(
        rng, right - left + 2 * margin, top - bottom + 2 * margin, terrain, style, (left - margin, bottom - margin)
    )
    return render(city, terrain, grid, view, sun, rng, look=look), terrain


def split_of(x_y: np.ndarray, seed: int) -> int:
    """Split of a building by the 100 m square it stands in: 0 training (60 %), 1 validation, 2 testing (20 % each)."""
    square = (np.floor(np.asarray(x_y) / 100.0).astype(np.int64) % 2**32).tolist()  # a seed is not negative
    return int(np.searchsorted([0.6, 0.8], np.random.default_rng([seed, *square]).random(), side="right"))


def _write_truth(path: Path, picture: Rendering, grid: Grid, seed: int) -> None:
    import geopandas
    import pyogrio
    import shapely

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2000-01-01T00:00:00.000Z"})
    splits: dict[int, int] = {}
    for s in picture.sections:
        splits.setdefault(s.building, split_of(s.outline_map[0, :2], seed))
    columns = {
        "section_id": [s.section for s in picture.sections],
        "building_id": [s.building for s in picture.sections],
        "visible": [s.visible for s in picture.sections],
        "split": [splits[s.building] for s in picture.sections],
    }

    def seen(ring: np.ndarray) -> np.ndarray:
        return np.column_stack([grid.to_map(ring[:, :2]), ring[:, 2]])

    layers = {
        "sections_image": [
            shapely.Polygon(seen(s.outline_seen), [seen(h) for h in s.holes_seen]) for s in picture.sections
        ],
        "sections_map": [shapely.Polygon(s.outline_map, list(s.holes_map)) for s in picture.sections],
    }
    with store.whole(path) as temporary:
        temporary.unlink()
        for name, shapes in layers.items():
            frame = geopandas.GeoDataFrame(columns, geometry=shapes, crs=grid.crs)
            pyogrio.write_dataframe(
                frame, temporary, layer=name, driver="GPKG", geometry_type="Polygon Z", append=name != "sections_image"
            )


def _write_raster(path: Path, values: np.ndarray, crs: str, x0: float, y0: float, step: float) -> None:
    import rasterio
    from affine import Affine

    bands = np.atleast_3d(values).transpose(2, 0, 1) if values.ndim == 3 else values[None]
    with (
        store.whole(path) as temporary,
        rasterio.open(
            temporary,
            "w",
            driver="GTiff",
            count=len(bands),
            height=bands.shape[1],
            width=bands.shape[2],
            dtype=bands.dtype,
            crs=crs,
            transform=Affine(step, 0, x0, 0, -step, y0),
            tiled=True,
            blockxsize=256,
            blockysize=256,
            compress="deflate",
            photometric="RGB" if len(bands) == 3 else "MINISBLACK",
        ) as target,
    ):
        target.write(bands)


def _origin(crs: str, gsd: float, size: int, model: CityModel | None) -> tuple[float, float]:
    """An upper-left corner on a multiple of the GSD (millimetres kept): near the centre of the CRS's area of use, or so that
    the middle of the city model's buildings is in the middle."""
    import pyproj

    try:
        system = pyproj.CRS(crs)
    except pyproj.exceptions.CRSError as error:
        raise UnusableScene(
            f"--crs {crs} is not a coordinate reference system: give one in metres, such as EPSG:32631"
        ) from error
    if not system.is_projected or abs(system.axis_info[0].unit_conversion_factor - 1) > 1e-9:
        raise UnusableScene(f"--crs {crs} is not projected in metres: give a UTM zone, such as EPSG:32631")
    if model:
        x, y = np.median([b.centre for b in model.buildings], axis=0) + size * gsd / 2 * np.array([-1.0, 1.0])
        return round(round(x / gsd) * gsd, 3), round(round(y / gsd) * gsd, 3)
    west, south, east, north = system.area_of_use.bounds if system.area_of_use else (2.0, 48.0, 4.0, 50.0)
    latitude = 49.2 if south < 49.2 < north else (south + north) / 2
    x, y = pyproj.Transformer.from_crs(system.geodetic_crs, system, always_xy=True).transform(
        (west + east) / 2 + 0.02, latitude
    )
    return round(round(x / gsd) * gsd, 3), round(round(y / gsd) * gsd, 3)


class UnusableScene(KibsError):
    """A scene that cannot be simulated as asked."""


def main(argv: list[str] | None = None) -> None:
    """Simulate one scene and write its raster, terrain, truth and angles."""
    import pyproj

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=1200, help="pixels per side")
    parser.add_argument("--gsd", type=float, default=0.38, help="metres per pixel")
    parser.add_argument("--view-azimuth", type=float, default=181.1, help="degrees from true north, to the satellite")
    parser.add_argument("--view-elevation", type=float, default=59.3, help="degrees above the horizon")
    parser.add_argument("--sun-azimuth", type=float, default=155.0)
    parser.add_argument("--sun-elevation", type=float, default=45.0)
    parser.add_argument("--style", choices=[*STYLES, *MIXTURES], default="mixed")
    parser.add_argument(
        "--look", choices=["any", "clear"], default="any", help="camera and air: drawn at random, or good"
    )
    parser.add_argument("--relief", type=float, default=0.0, help="amplitude of the terrain's waves in metres")
    parser.add_argument("--slope", type=float, default=0.0, help="slope of the terrain in percent")
    parser.add_argument(
        "--city", type=Path, help="a CityJSON or CityJSONSeq file to show, where it stands, on its own ground"
    )
    parser.add_argument("--crs", help=f"a projected CRS in metres ({USUAL_CRS}); a city file's own comes first")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    args = parser.parse_args(argv)
    if args.size < SMALLEST or not args.gsd > 0:
        raise UnusableScene(f"--size must be {SMALLEST} px at least, --gsd positive")
    for name, least in (("view", 20), ("sun", 5)):
        if not least <= getattr(args, f"{name}_elevation") <= 90:
            raise UnusableScene(f"--{name}-elevation must be between {least} and 90 degrees")
    model = citymodel.read(args.city) if args.city else None
    crs = model.crs if model and model.crs else args.crs
    if model and not model.crs and args.crs is None:
        raise UnusableScene(f"{args.city} does not say its reference system: name it with --crs (simulate.crs)")
    crs = crs or USUAL_CRS
    grid = Grid(crs, *_origin(crs, args.gsd, args.size, model), args.gsd, args.size, args.size)
    if not in_true_metres(pyproj.CRS(crs), np.array(grid.bounds).reshape(2, 2).mean(axis=0)):
        raise UnusableScene(f"{crs}: there its metre is not one on the ground; give a UTM zone, such as EPSG:32631")
    turned = convergence(grid)
    view = _direction(args.view_azimuth, args.view_elevation, turned)
    sun = _direction(args.sun_azimuth, args.sun_elevation, turned)
    look = CLEAR if args.look == "clear" else None
    picture, terrain = simulate(
        args.seed, grid, view, sun, args.style, args.relief, args.slope / 100.0, model=model, look=look
    )
    if not picture.sections:
        raise UnusableScene("the scene shows no roof: give another --seed or --style, or a larger --size")
    step = terrain.step[0]
    _write_raster(args.out / "scene.tif", picture.rgb, crs, grid.x0, grid.y0, grid.gsd)
    _write_raster(
        args.out / "dtm.tif",
        terrain.heights.astype(np.float32),
        crs,
        terrain.x0 - step / 2,
        terrain.y0 + step / 2,
        step,
    )
    _write_truth(args.out / "truth.gpkg", picture, grid, args.seed)
    angles = {name: getattr(args, name) for name in ("view_azimuth", "view_elevation", "sun_azimuth", "sun_elevation")}
    store.write_json(args.out / "angles.json", angles)


if __name__ == "__main__":
    cli.run(main)
