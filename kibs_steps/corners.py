"""Corners: every roof corner of a block with its height above ground, by the 3D model on the blended tiles.

A tile answers for the corners in its core; those up to `SEAM` px beyond are kept too, because two tiles may each place a
corner on the seam just across it. `stitch` keeps one of the two. Where no section was found the model is not run.

In: `blended.tif`, `sections.tif`, the model. Out: `corners.parquet`: tile, position (px, image coordinates), height and σ (m),
score; `heights.parquet`: what the model's height map says of every piece of a section (`heightmap`).
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from kibs_steps import cli, heightmap, raster, scene, sections, store, supposed
from kibs_steps.grid import Tile, Tiling

if TYPE_CHECKING:
    from kibs_steps.models import heads

SEAM = 1.5  # px: further than the position error of one corner seen by two tiles

CORNERS = pa.schema(
    [
        ("tile_row", pa.int64()),
        ("tile_col", pa.int64()),
        ("col", pa.float64()),
        ("row", pa.float64()),
        ("height", pa.float64()),
        ("sigma", pa.float64()),
        ("score", pa.float64()),
        ("owner", pa.int64()),
    ]
)


def of_tile(found: heads.Corners, tile: Tile, tiling: Tiling) -> pa.Table:
    """A tile's corners in or just beyond its core, in image coordinates; `owner` 0: not filed yet."""
    window = tiling.window(tile)
    col, row = found.col + window.col, found.row + window.row
    keep = np.flatnonzero(
        (col >= tile.core.col - SEAM)
        & (col < tile.core.col + tile.core.width + SEAM)
        & (row >= tile.core.row - SEAM)
        & (row < tile.core.row + tile.core.height + SEAM)
    )
    n = len(keep)
    columns = [np.full(n, tile.row), np.full(n, tile.col), col[keep], row[keep]]
    columns += [found.height[keep], found.sigma[keep], found.score[keep], np.zeros(n, np.int64)]
    return pa.table(columns, schema=CORNERS)


def heights_of_tile(
    found: tuple[np.ndarray, np.ndarray] | None,
    labels: np.ndarray,
    tile: Tile,
    tiling: Tiling,
    lifted: tuple[np.ndarray, np.ndarray] | None = None,
) -> pa.Table:
    """Sums of a tile's height map (`heads.height_map`) over each label (s, s) in the tile's core, and of its `lifts`."""
    if found is None:
        return heightmap.HEIGHTS.empty_table()
    p, window = tiling.margin, tiling.window(tile)
    core = np.zeros_like(labels)
    inside = np.s_[p : p + tile.core.height, p : p + tile.core.width]
    core[inside] = labels[inside]
    known, sums = heightmap.sums_by_label(core, *found, window.col, window.row)
    if lifted is not None and len(known):
        lift, looks = (of[known - _before(labels)] for of in lifted)
        sums[:, heightmap.LIFT], sums[:, heightmap.LOOKS] = lift * looks, looks
    return heightmap.table(known, sums)


def lifts(
    outputs: dict[str, np.ndarray], labels: np.ndarray, geometry: np.ndarray, contract: dict
) -> tuple[np.ndarray, np.ndarray]:
    """How far (m) walls and shadows lift the sections of a tile, and how much of them is seen (`models.walls`); the first is no
    section, then follow the tile's labels (s, s) in their order. `geometry` (6,)."""
    from kibs_steps.models import walls

    numbers = np.where(labels > 0, labels.astype(np.int64) - _before(labels), 0)
    seen = walls.traits(numbers, outputs["surface"], outputs["height"], contract["heights"], geometry)
    return walls.lifts(numbers, seen, contract["walls"]), walls.looks(numbers, seen)


def _before(labels: np.ndarray) -> int:
    """The label before the first of a tile: they follow each other."""
    return int(labels[labels > 0].min()) - 1


def main(argv: list[str] | None = None) -> None:
    """Find the roof corners of one block and their heights."""
    from kibs_steps.models import heads, runtime

    parser = argparse.ArgumentParser(prog="python -m kibs_steps.corners", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--blended", required=True, help="blended.tif of the block")
    parser.add_argument("--labels", required=True, help="sections.tif of the block")
    parser.add_argument("--model", required=True, help="models/corners.json")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--supposed", help="supposed.json, where view or sun is not known")
    runtime.add_options(parser)
    parser.add_argument("--out", required=True, help="out: corners.parquet")
    parser.add_argument("--heights", required=True, help="out: heights.parquet")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    model = runtime.from_record(args.model, "corners")
    tiling = Tiling(model.contract["tile"], args.margin, args.block)
    block = tiling.block_of(args.name)
    tiles = tiling.tiles(block, facts.grid.width, facts.grid.height)
    labels = sections.unstack(raster.read(args.labels), tiles, tiling.tile)
    images = sections.unstack(raster.read(args.blended), tiles, tiling.tile)
    session = runtime.opened(model, args.provider, args.threads, args.looks)
    telling = supposed.telling(facts, args.supposed)
    tables, heights = [CORNERS.empty_table()], [heightmap.HEIGHTS.empty_table()]
    for tile in tiles:
        place = tile.row, tile.col
        if not labels[place].any():
            continue  # no section is near that could take its corners
        geometry = runtime.told(model, telling(tile.core))
        outputs = session(geometry)(images[place])
        lifted = None
        if "walls" in model.contract and runtime.leans(geometry[0]):  # from above, or nobody knows where, no wall shows
            lifted = lifts(outputs, labels[place], geometry[0], model.contract)
        tables.append(of_tile(heads.decode_corners(outputs, model.contract), tile, tiling))
        shown = heads.height_map(outputs, model.contract)
        heights.append(heights_of_tile(shown, labels[place], tile, tiling, lifted))
    store.write_table(args.out, pa.concat_tables(tables))
    store.write_table(args.heights, pa.concat_tables(heights))


if __name__ == "__main__":
    cli.run(main, pandas=False)
