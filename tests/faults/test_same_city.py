"""The same city however it is turned, mirrored, cut and ordered: truth fed through every step, compared where it stands."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import good_inputs
import numpy as np
import pyarrow.parquet as pq
import pytest
import rasters
import shapely

from kibs_steps import buildings, feed, ground, planes, solids, stitch, truth
from kibs_steps import scene as scenes
from kibs_steps.grid import Tiling

GSD, SIDE = 0.4, 400  # a square of 160 m about the central meridian, where grid north is true north
CENTRE = np.array([500_000.0, 5_400_000.0])
VIEW = (150.0, 62.0)
FLAT = 30.0


def city() -> list[shapely.Polygon]:
    """Gables of all directions and sizes, a shed and a flat roof: sections with z above the level ground at 30 m."""
    rng = np.random.default_rng(2)
    found = []
    for k, (x, y) in enumerate((x, y) for x in (-50, -17, 16, 49) for y in (-48, -16, 16, 48)):
        length, width, angle = rng.uniform(9, 15), rng.uniform(7, 10), rng.uniform(0, np.pi)
        eave, rise = FLAT + rng.uniform(3, 8), rng.uniform(1.5, 4) * (k % 4 != 3)
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        at = CENTRE + (x, y) + 0.137
        for side in (1, -1):
            place = [(-1, 0), (1, 0), (1, side), (-1, side)]
            corners = [
                (*(at + i * length / 2 * along + j * width / 2 * across), eave + rise * (1 - abs(j))) for i, j in place
            ]
            found.append(shapely.Polygon(corners))
    return found


def build(
    folder: Path,
    shapes: list[shapely.Polygon],
    view: tuple[float, float],
    block: int = 2,
    tile: int = 120,
    shift: int = 0,
    order: Callable[[list], list] = list,
) -> Path:
    """All steps from truth to solids in one folder, by their own command lines; `shift` px moves the grid, and so all tiles."""
    folder.mkdir()
    left, top = CENTRE + np.array([-1.0, 1.0]) * SIDE / 2 * GSD
    side = SIDE + shift
    image = np.full((3, side, side), 90, "uint8")
    place = rasters.Affine(GSD, 0, left - shift * GSD, 0, -GSD, top + shift * GSD)
    raster = rasters.write(folder / "a.tif", image, transform=place)
    made = scenes.build("s", raster, str(FLAT), GSD, folder, view=view)
    layer = good_inputs.vector(folder / "truth.gpkg", shapes)
    out = {name: str(folder / name) for name in ("truth.parquet", "scene.json", "sections.parquet", "corners.parquet")}
    truth.main(["--scene", out["scene.json"], "--truth", str(layer), "--frame", "map", "--out", out["truth.parquet"]])
    (folder / "model.json").write_text(json.dumps({"contract": {"heights": {"fallback": 6.0}}}))
    tiling = Tiling(tile, 10, block)
    blocks = [b.name for b in tiling.blocks(made.grid.width, made.grid.height)]
    cut = ["--tile", str(tile), "--margin", "10", "--block", str(block)]
    scene = ["--scene", out["scene.json"]]

    def of(name: str, *files: str) -> list[str]:
        return [str(folder / "blocks" / name / file) for file in files]

    for name in blocks:
        files = of(name, "fed/pieces.parquet", "fed/links.parquet", "fed/seams.npz", "fed/corners.parquet")
        outputs = sum(zip(("--pieces", "--links", "--seams", "--corners"), files, strict=True), ())
        feed.main([*scene, "--truth", out["truth.parquet"], *cut, "--name", name, *outputs])
    joined = ["--sections", out["sections.parquet"], "--corners", out["corners.parquet"]]
    folders = [f for name in order(blocks) for f in of(name, "fed")]
    stitch.main([*scene, *cut, "--tolerance", "0", "--reach", "7.5", "--folders", *folders, *joined])
    for name in blocks:
        plane, filed, standing = of(name, "planes.parquet", "filed.parquet", "ground.parquet")
        model = ["--model", str(folder / "model.json"), "--reach", "7.5"]
        planes.main([*scene, *joined, *model, "--name", name, "--planes", plane, "--filed", filed])
        ground.main([*scene, "--planes", plane, "--out", standing])
    every = [f for name in order(blocks) for f in of(name, "ground.parquet")]
    buildings.main([*scene, *cut, "--ground", *every, "--out", str(folder / "buildings.parquet")])
    for name in blocks:
        seq, table, meshes = of(name, "solids.city.jsonl", "solids.parquet", "meshes.parquet")
        given = ["--buildings", str(folder / "buildings.parquet"), "--name", name]
        solids.main([*scene, *given, "--out", seq, "--attributes", table, "--meshes", meshes])
    return folder


def houses(folder: Path, back: Callable[[np.ndarray], np.ndarray] = np.asarray) -> list[tuple]:
    """Every building where it stands, moved `back`: centre, area, heights, volume (0.01), level of detail, kind of roof."""
    found = []
    for path in sorted(folder.glob("blocks/*/solids.parquet")):
        for row in pq.read_table(path).to_pylist():
            x, y = back(shapely.get_coordinates(shapely.from_wkb(row["footprint"]).centroid) - CENTRE)[0]
            numbers = (x, y, row["footprint_area"], row["eave_z"], row["ridge_z"], row["volume"])
            found.append((row["lod"], row["roof_type"], row["n_sections"], *numbers))
    return sorted(found, key=lambda house: (round(house[3]), round(house[4])))


def alike(one: list[tuple], other: list[tuple]) -> None:
    """The same buildings: coordinates are whole millimetres, and the rest follows from them."""
    assert [h[:3] for h in one] == [h[:3] for h in other]
    numbers = [np.array([h[3:] for h in houses], float) for houses in (one, other)]
    assert np.abs(numbers[0] - numbers[1])[:, :2].max() < 0.003
    assert np.abs(numbers[0] - numbers[1])[:, 3:5].max() < 0.003
    assert np.abs(numbers[0] / numbers[1] - 1)[:, [2, 5]].max() < 1e-3


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = build(tmp_path_factory.mktemp("city") / "plain", city(), VIEW)
    found = houses(folder)
    assert len(found) == 16
    assert {h[0] for h in found} == {"2.0"}
    return folder


MOVES = {
    "turned by 90°": (lambda p: p @ [[0.0, 1.0], [-1.0, 0.0]], lambda p: p @ [[0.0, -1.0], [1.0, 0.0]], VIEW[0] - 90),
    "mirrored": (lambda p: p * [-1.0, 1.0], lambda p: p * [-1.0, 1.0], -VIEW[0]),
}


@pytest.mark.parametrize("name", MOVES)
def test_turned_and_mirrored(plain, tmp_path, name):
    there, back, azimuth = MOVES[name]

    def moved(points: np.ndarray) -> np.ndarray:
        return np.column_stack([there(points[:, :2] - CENTRE) + CENTRE, points[:, 2]])

    shapes = list(shapely.transform(city(), moved, include_z=True))
    alike(houses(plain), houses(build(tmp_path / "moved", shapes, (azimuth, VIEW[1])), back))


def test_another_tile_grid(plain, tmp_path):
    alike(houses(plain), houses(build(tmp_path / "shifted", city(), VIEW, shift=37)))
    alike(houses(plain), houses(build(tmp_path / "cut", city(), VIEW, block=1, tile=180)))


def test_blocks_in_another_order(plain, tmp_path):
    other = build(tmp_path / "order", city(), VIEW, order=lambda blocks: blocks[::-1])
    for path in sorted(plain.glob("blocks/*/solids.*")):
        assert path.read_bytes() == (other / path.relative_to(plain)).read_bytes()
