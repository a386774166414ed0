"""Single: sections and corners of a block by one network in one pass, in the place of `sections`, `blend` and `corners`.

Each tile is shown to the model once; its outputs are decoded twice, by the same rules as the two models' outputs are, so
the files are those of the three steps it replaces. Tiles without data are not looked at.

In: `tiles.tif`, the model (task `both`). Out: `sections.tif`, `pieces.parquet`, `links.parquet`, `seams.npz` (see `sections`) and
`corners.parquet`, `heights.parquet` (see `corners`).
"""

from __future__ import annotations

import argparse

import numpy as np
import pyarrow as pa

from kibs_steps import cli, corners, heightmap, raster, scene, sections, store, supposed
from kibs_steps.grid import Block, Grid, Tiling
from kibs_steps.models import heads, runtime


def detect(
    rgb: np.ndarray,
    valid: np.ndarray,
    tiling: Tiling,
    block: Block,
    grid: Grid,
    networks: supposed.Networks,
    contract: dict,
) -> tuple[list[sections.View], pa.Table, pa.Table]:
    """What every tile of a block image (core grown by the margin; rgb uint8, valid bool) sees, all its corners and heights."""
    views, used, tables, heights = [], 0, [corners.CORNERS.empty_table()], [heightmap.HEIGHTS.empty_table()]
    for tile, image, data in sections.tile_images(rgb, valid, tiling, block, grid):
        outputs = None
        if sections.core_of(data, tile, tiling.margin).any():
            outputs = networks(tile.core)(image)
            tables.append(corners.of_tile(heads.decode_corners(outputs, contract), tile, tiling))
        views.append(sections.view_of(tile, image, outputs, contract, tiling.margin, data, used))
        if outputs is not None:
            shown = heads.height_map(outputs, contract)
            heights.append(corners.heights_of_tile(shown, views[-1].labels, tile, tiling))
        used += len(views[-1].scores)
    return views, pa.concat_tables(tables), pa.concat_tables(heights)


def main(argv: list[str] | None = None) -> None:
    """Find the roof sections and corners of one block with one model."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.single", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--tiles", required=True, help="tiles.tif of the block")
    parser.add_argument("--model", required=True, help="models/sections.json, of a model that does both")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--supposed", help="supposed.json, where view or sun is not known")
    runtime.add_options(parser)
    parser.add_argument(
        "--seam-rule", choices=sections.SEAM_RULES, default="overlap", help="which pieces are one section"
    )
    parser.add_argument("--labels", required=True, help="out: sections.tif")
    parser.add_argument("--pieces", required=True, help="out: pieces.parquet")
    parser.add_argument("--links", required=True, help="out: links.parquet")
    parser.add_argument("--seams", required=True, help="out: seams.npz")
    parser.add_argument("--corners", required=True, help="out: corners.parquet")
    parser.add_argument("--heights", required=True, help="out: heights.parquet")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    model = runtime.from_record(args.model, "both")
    tiling = Tiling(model.contract["tile"], args.margin, args.block)
    block = tiling.block_of(args.name)
    core = tiling.block_core(block, facts.grid.width, facts.grid.height)
    image = raster.read(args.tiles)
    rgb, valid = image[..., :3], image[..., 3] > 0
    session = runtime.opened(model, args.provider, args.threads, args.looks)
    telling = supposed.telling(facts, args.supposed)
    views, table, heights = detect(
        rgb, valid, tiling, block, facts.grid, lambda core: session(telling(core)), model.contract
    )
    unclear = sections.unclear(rgb, valid, views, tiling, core, facts.grid)
    sections.write(views, unclear, tiling, core, args.seam_rule, args)
    store.write_table(args.corners, table)
    store.write_table(args.heights, heights)


if __name__ == "__main__":
    cli.run(main, pandas=False)
