"""Whatever is thrown at them: settings and rasters are taken or refused by name, label maps become valid solids."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import rasterio
import rasterio.features
import shapely
import yaml
from hypothesis import HealthCheck, example, given
from hypothesis import settings as rules
from hypothesis import strategies as st

from kibs_steps import buildings, gate, ground, heightmap, planes, scene, sections, solids, stitch, terrain, tiles
from kibs_steps import plan as plans
from kibs_steps.corners import CORNERS
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.settings import BadConfig

SCHEMA = yaml.safe_load((Path(__file__).parents[2] / "workflow/schemas/config.schema.yaml").read_text())
KEYS = sorted(SCHEMA["$defs"]["scene"]["properties"]) + sorted(SCHEMA["properties"]) + ["", "veiw", "Block", "a b"]
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["models", "1,2,3"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=3),
    max_leaves=6,
)


ORDINARY = (0.38, 0.0, 0.0, -0.4)  # pixels that are not refused


@given(st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=5))
@example({"scene": "s", "raster": "a.tif", "dtm": 0})
@rules(max_examples=300, suppress_health_check=[HealthCheck.too_slow])
def test_settings_are_taken_or_refused(config):
    try:
        found = plans.scenes(config, SCHEMA)
    except BadConfig:
        assert set(config) != {"scene", "raster", "dtm"} or config["raster"] != "a.tif"
        return
    assert all(isinstance(values, dict) for values in found.values())


@given(
    dtype=st.sampled_from(["uint8", "int16", "uint16", "uint32", "float32", "float64"]),
    bands=st.integers(1, 9),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    nodata=st.sampled_from([None, 0, 7, 255]),
    crs=st.sampled_from([None, "EPSG:32631", "EPSG:4326", "EPSG:3857", "EPSG:2263"]),
    cells=st.tuples(*[st.sampled_from([-0.4, -0.1, 0.0, 0.1, 0.3, 0.38, 0.5, 2.0])] * 4),
    seed=st.integers(0, 9),
)
@example("uint8", 3, (40, 40), None, "EPSG:32631", ORDINARY, 1)
@example("uint16", 4, (40, 40), 0, "EPSG:2263", ORDINARY, 1)
@rules(max_examples=80, suppress_health_check=[HealthCheck.too_slow])
def test_rasters_are_read_or_refused(tmp_path_factory, dtype, bands, size, nodata, crs, cells, seed):
    """What is read has the size asked for and 8 bit, and the same pixels give the same colours in any window."""
    a, b, d, e = cells
    x, y = (4.0, 51.0) if crs == "EPSG:4326" else (500_000.0, 5_400_000.0)
    scale = 1e-5 if crs == "EPSG:4326" else 1.0
    rng = np.random.default_rng(seed)
    values = rng.choice([0, 7, 100, 200, 255], (bands, *size)).astype(dtype)
    if dtype.startswith("float"):
        values[rng.random(values.shape) < 0.1] = np.nan
    path = tmp_path_factory.mktemp("fuzz") / "a.tif"
    shape = {"count": bands, "height": size[0], "width": size[1], "dtype": dtype}
    try:
        place = {"crs": crs, "transform": rasterio.Affine(a * scale, b * scale, x, d * scale, e * scale, y)}
        with (
            warnings.catch_warnings(),
            rasterio.open(path, "w", driver="GTiff", nodata=nodata, **place, **shape) as out,
        ):
            warnings.simplefilter("ignore")
            out.write(values)
    except rasterio.errors.RasterioError:
        return
    try:
        made = scene.build("s", path, "0", 0.38, path.parent, view=(180.0, 60.0))
    except KibsError:
        assert cells != ORDINARY or crs is None or bands < 3 or min(size) < 40
        return
    width, height = min(made.grid.width, 60), min(made.grid.height, 60)
    rgb, valid = tiles.read_window(made, Window(-5, -5, width + 10, height + 10))
    assert rgb.shape == (height + 10, width + 10, 3)
    assert rgb.dtype == np.uint8
    assert valid.shape == rgb.shape[:2]
    again, _ = tiles.read_window(made, Window(0, 0, width, height))
    assert (again[valid[5:-5, 5:-5]] == rgb[5:-5, 5:-5][valid[5:-5, 5:-5]]).all()


SIDE, GSD = 48, 0.38
GRID = Grid("EPSG:32631", 500_000.0, 5_400_000.0, GSD, SIDE, SIDE)
LEAN = (0.01, -0.594)
FACTS = scene.Scene("s", "", (1, 2, 3), None, GRID, scene.Direction(181.1, 59.3, LEAN), None, None, Path())


def label_map(rng: np.random.Generator) -> np.ndarray:
    """Labels (side, side): cells of a Voronoi diagram within some rectangles, bitten by noise, islands and holes and all."""
    row, col = np.mgrid[:SIDE, :SIDE] + 0.5
    roof = np.zeros((SIDE, SIDE), bool)
    for _ in range(int(rng.integers(1, 5))):
        angle, at = rng.uniform(0, np.pi), rng.uniform(12, SIDE - 12, 2)
        size = rng.uniform(4, 18, 2)
        x, y = col - at[0], row - at[1]
        roof |= (np.abs(x * np.cos(angle) + y * np.sin(angle)) < size[0]) & (
            np.abs(y * np.cos(angle) - x * np.sin(angle)) < size[1]
        )
    seeds = rng.uniform(0, SIDE, (int(rng.integers(1, 7)), 2))
    nearest = np.argmin((col[..., None] - seeds[:, 0]) ** 2 + (row[..., None] - seeds[:, 1]) ** 2, axis=-1)
    labels = np.where(roof, nearest + 1, 0).astype(np.int32)
    share = rng.choice([0.0, 0.0, 0.0, 0.02])
    labels[rng.random(labels.shape) < share] = int(rng.integers(0, 4))
    return labels


def tables(labels: np.ndarray, rng: np.random.Generator) -> tuple[pa.Table, pa.Table]:
    """The map as `stitch` would hand it on: a section per connected part, corners near outlines and anywhere, wild heights."""
    parts = [
        part
        for wkb in sections.pixel_outlines(labels, Window(0, 0, SIDE, SIDE)).values()
        for part in shapely.get_parts(shapely.from_wkb(wkb))
    ]
    whole = np.array(parts, object)
    n = len(whole)
    ids = stitch.section_ids(whole, GRID) if n else np.zeros(0, np.int64)
    smooth = stitch.simplified(whole, 1.5)
    spots = shapely.get_coordinates(smooth)
    chosen = spots[rng.random(len(spots)) < rng.choice([0.0, 0.3, 1.0])] if len(spots) else np.zeros((0, 2))
    where = np.concatenate(
        [chosen + rng.normal(0, 0.7, chosen.shape), rng.uniform(0, SIDE, (int(rng.integers(0, 4)), 2))]
    )
    height = rng.choice([rng.uniform(2, 12, len(where)), rng.uniform(-5, 300, len(where))], p=[0.85, 0.15])
    m, flags = len(where), rng.random((2, n)) < 0.05
    # Half of the maps with heights all over the sections, of the same wild kind.
    cells = np.zeros((n, len(heightmap.SUMS)))
    if rng.random() < 0.5 and n:
        labels = np.zeros((SIDE, SIDE), np.int64)
        for k, part in enumerate(whole, start=1):
            burnt = rasterio.features.rasterize([part], (SIDE, SIDE))
            labels[burnt > 0] = k
        mean = rng.choice([rng.uniform(2, 12), rng.uniform(-5, 300)], p=[0.9, 0.1]) + rng.normal(
            0, 1, (SIDE // 4, SIDE // 4)
        )
        known, found = heightmap.sums_by_label(labels, mean, rng.uniform(0.1, 3, mean.shape), 0.0, 0.0)
        cells[known - 1] = found
    sums = heightmap.table(ids, cells)["sums"]
    table = pa.table(
        [ids, shapely.to_wkb(smooth), np.full(n, 0.9), np.full(n, 2), *flags, np.zeros(n, np.int64), sums],
        schema=stitch.SECTIONS,
    )
    columns = [np.zeros(m, np.int64), np.zeros(m, np.int64), where[:, 0], where[:, 1], height]
    columns += [rng.uniform(0.05, 3, m), np.ones(m), np.zeros(m, np.int64)]
    return table, pa.table(columns, schema=CORNERS)


def slope(rng: np.random.Generator) -> terrain.Terrain:
    """Ground of any slope up to 20 % about 100 m."""
    row, col = np.mgrid[:60, :60]
    a, b = rng.uniform(-0.2, 0.2, 2) * rng.integers(0, 2)
    return terrain.Terrain(100.0 + 2.0 * (a * (col - 30) + b * (row - 30)), GRID.x0 - 45, GRID.y0 + 45, (2.0, 2.0))


def cities(number: int, first: int = 0) -> tuple[int, int]:
    """Random maps through planes, ground, buildings and solids: how many have sections of at least 4 m² alone, and how many
    of those yield a solid for every building.
    """
    fair = solid = 0
    for seed in range(first, first + number):
        rng = np.random.default_rng(seed)
        table, corners = tables(label_map(rng), rng)
        dtm = slope(rng)
        rule = ["robust", "paper"][seed % 2]
        found, _ = planes.planes(table, corners, FACTS, dtm, (6.0, 2.0), 7.5, rule)
        standing = ground.ground(found, FACTS, dtm)
        outlines = shapely.from_wkb(standing["outline_map"].to_numpy(zero_copy_only=False))
        plane = np.stack([standing[k].to_numpy() for k in ("plane_a", "plane_b", "plane_c", "x0", "y0")], axis=1)
        owner, cluster = buildings.buildings(standing["section_id"].to_numpy(), outlines, plane, FACTS.lean, None)
        standing = standing.append_column("building_id", pa.array(owner))
        standing = standing.append_column("cluster_id", pa.array(cluster))
        standing = standing.sort_by([("building_id", "ascending"), ("section_id", "ascending")])
        made = [
            one.solid
            for owners, cluster in solids.clusters_of(standing)
            for one in solids.together(
                cluster, owners, dtm, "2.0", solids.fit_of(cluster, np.array([FACTS.lean]), FACTS.grid.gsd)
            )
        ]
        for one in made:
            for shell in one.shells:
                faces = [surface.rings for surface in shell]
                assert gate.check(faces) == [], seed
                assert gate.volume(faces) > 0, seed
        if len(table) and min(standing["area"].to_pylist()) >= 4.0:
            fair += 1
            solid += all(one.shells for one in made)
    return fair, solid


def test_label_maps_become_valid_solids():
    fair, solid = cities(60)
    assert fair >= 10
    assert solid >= 0.95 * fair


@pytest.mark.long
def test_ten_thousand_label_maps():
    fair, solid = cities(10_000, first=1_000)
    print(f"{solid} of {fair} fair maps gave a solid for every building")
    assert solid >= 0.95 * fair
