"""Feed: a truth layer in the place of both models, so that all steps after them can be tried against the truth itself.

In: `truth.parquet`. Out, per block: `pieces.parquet`, `links.parquet`, `seams.npz`, `corners.parquet` as the models' steps
write them. A truth section is one piece with its exact outline, in the block that holds its inner point; every vertex of it
is a corner with its exact height, owned by it.
"""

from __future__ import annotations

import argparse

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, scene, store
from kibs_steps.corners import CORNERS
from kibs_steps.grid import Block, Grid, Tiling
from kibs_steps.models import scoring
from kibs_steps.sections import PIECES, SIDES
from kibs_steps.stitch import owner_blocks, section_ids

SIGMA = 0.01  # m: an annotation's own height is as good as exact


def feed(truth: pa.Table, block: Block, grid: Grid, tiling: Tiling) -> tuple[pa.Table, pa.Table]:
    """Pieces and corners of one block from the truth (docs/architecture.md, truth.parquet)."""
    seen = shapely.from_wkb(truth["outline_seen"].to_numpy(zero_copy_only=False))
    inside = (
        (shapely.bounds(seen)[:, [2, 3]] > 0).all(axis=1)
        & (shapely.bounds(seen)[:, [0, 1]] < [grid.width, grid.height]).all(axis=1)
        if len(seen)
        else np.zeros(0, bool)
    )
    truth, seen = truth.filter(pa.array(inside)), seen[inside]
    mine = (owner_blocks(section_ids(seen, grid), grid, tiling) == (block.row, block.col)).all(axis=1)
    truth, seen = truth.filter(pa.array(mine)), seen[mine]
    owner = truth["truth_id"].to_numpy()
    area = np.ceil(shapely.area(seen)).astype(np.int64)
    n = len(seen)
    place = [np.full(n, block.row * tiling.block), np.full(n, block.col * tiling.block)]
    pieces = pa.table(
        [
            owner,
            *place,
            np.ones(n),
            area,
            area,
            np.zeros(n, bool),
            shapely.to_wkb(shapely.force_2d(seen)),
            truth["split"].to_numpy(),
            owner,
            pa.array(list(scoring.none(n)), PIECES.field("evidence").type),
        ],
        schema=PIECES,
    )
    xyz, index = shapely.get_coordinates(seen, include_z=True, return_index=True)
    vertex = np.unique(np.column_stack([owner[index], xyz]), axis=0) if n else np.zeros((0, 4))
    m = len(vertex)
    columns = [np.full(m, place[0][0] if n else 0), np.full(m, place[1][0] if n else 0)]
    columns += [vertex[:, 1], vertex[:, 2], vertex[:, 3], np.full(m, SIGMA), np.ones(m), vertex[:, 0].astype(np.int64)]
    return pieces, pa.table(columns, schema=CORNERS)


def main(argv: list[str] | None = None) -> None:
    """Write the truth of one block as if the models had found it."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.feed", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--truth", required=True, help="truth.parquet")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--pieces", required=True, help="out: pieces.parquet")
    parser.add_argument("--links", required=True, help="out: links.parquet")
    parser.add_argument("--seams", required=True, help="out: seams.npz")
    parser.add_argument("--corners", required=True, help="out: corners.parquet")
    args = parser.parse_args(argv)
    tiling = Tiling(args.tile, args.margin, args.block)
    grid = scene.read(args.scene).grid
    pieces, corners = feed(store.read_table(args.truth), tiling.block_of(args.name), grid, tiling)
    none = np.zeros(0, np.int64)
    store.write_table(args.pieces, pieces)
    store.write_table(args.links, pa.table({"first": none, "second": none}))
    store.write_arrays(args.seams, {side: np.zeros((0, 0), np.int32) for side in SIDES})
    store.write_table(args.corners, corners)


if __name__ == "__main__":
    cli.run(main, pandas=False)
