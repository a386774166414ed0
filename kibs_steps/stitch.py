"""Stitch: pieces of one section that meet across seams become one section with one id.

Links between pieces come from pairs of tiles (`sections.links_across`), those inside blocks already found, those between
blocks found here from the stored strips; a section is a connected group of linked pieces. A piece whose larger part lies
beyond its own tile's core and which no neighbour confirms is voted out: the tile that answers for that place does not see it.
Union-find has no order, so results depend neither on the order of blocks nor on their size.

In: all blocks' pieces, links, seams and corners. Out: `stitched/sections.parquet` (each section in the block that holds its id
pixel) and `stitched/corners.parquet` (the corners within reach of each block's sections), both with a column `block`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from kibs_steps import cli, scan_order, scene, store
from kibs_steps.grid import Block, Grid, Tiling
from kibs_steps.sections import SEAM_RULES, links_across

CUT = 2.0  # px: smoothing moves an outline no further
SAME_CORNER = 3.0  # px: two tiles' views of one corner lie closer than two corners of a roof

SECTIONS = pa.schema(
    [
        ("section_id", pa.int64()),
        ("outline", pa.binary()),
        ("score", pa.float64()),
        ("split", pa.int64()),
        ("edge", pa.bool_()),
        ("void", pa.bool_()),
        ("owner", pa.int64()),
    ]
)


def groups(n: int, links: np.ndarray) -> np.ndarray:
    """Group number (n,) of each piece, from links (m, 2): connected components."""
    graph = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def confirmed(core_area: np.ndarray, full_area: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Which pieces stand: those linked to another, or with at least half of their pixels in their own tile's core."""
    linked = np.zeros(len(core_area), bool)
    linked[links.ravel()] = True
    return (core_area > 0) & (linked | (2 * core_area >= full_area))


def block_links(
    seams: dict[tuple[int, int], dict[str, np.ndarray]],
    first_piece: dict[tuple[int, int], dict[int, int]],
    rule: str = "overlap",
) -> np.ndarray:
    """Links (n, 2) between pieces of neighbouring blocks, as piece numbers; both dicts are by block (row, col)."""
    found = [np.zeros((0, 2), np.int64)]
    for (row, col), sides in seams.items():
        for side, other_side, neighbour in (("east", "west", (row, col + 1)), ("south", "north", (row + 1, col))):
            if neighbour in seams and sides[side].size:
                number, other = first_piece[row, col], first_piece[neighbour]
                pairs = links_across(sides[side], seams[neighbour][other_side], side, rule)
                found.append(np.array([(number[a], other[b]) for a, b in pairs.tolist()], np.int64).reshape(-1, 2))
    return np.concatenate(found)


def united(
    outlines: np.ndarray, group: np.ndarray, score: np.ndarray, void: np.ndarray, split: np.ndarray, owner: np.ndarray
) -> dict[str, list]:
    """Sections from piece outlines (n,) grouped by `group`: union, then one section per connected part.

    Scores are means weighted by area. Returns columns geometry, score, void, split, owner.
    """
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(group[order]) != 0]) if len(order) else np.zeros(0, int)
    area = shapely.area(outlines)
    columns: dict[str, list] = {"geometry": [], "score": [], "void": [], "split": [], "owner": []}
    for members in np.split(order, starts[1:]) if len(order) else []:
        whole = outlines[members[0]] if len(members) == 1 else shapely.union_all(outlines[members])
        weight = area[members] / area[members].sum()
        for part in shapely.get_parts(whole):
            columns["geometry"].append(part)
            columns["score"].append(float((weight * score[members]).sum()))
            columns["void"].append(bool(void[members].any()))
            columns["split"].append(int(split[members].max()))
            columns["owner"].append(int(owner[members].max()))
    return columns


def section_ids(outlines: np.ndarray, grid: Grid) -> np.ndarray:
    """Ids (n,) from position: row·width + col + 1 of the pixel that holds a point inside the section.

    Two sections so thin that they share the pixel get the next free number, in order of their outlines.
    """
    point = shapely.get_coordinates(shapely.point_on_surface(outlines))
    col = np.clip(np.floor(point[:, 0]), 0, grid.width - 1).astype(np.int64)
    row = np.clip(np.floor(point[:, 1]), 0, grid.height - 1).astype(np.int64)
    ids = row * grid.width + col + 1
    taken: set[int] = set()
    for i in np.lexsort((np.array([shapely.to_wkb(g) for g in outlines], object), ids)):
        while int(ids[i]) in taken:
            ids[i] += 1
        taken.add(int(ids[i]))
    return ids


def simplified(outlines: np.ndarray, tolerance: float) -> np.ndarray:
    """Pixel outlines (along pixel edges) smoothed to straight rims, shared rims alike on both sides (px).

    Every pixel corner is made a vertex first, so that where three sections meet all three have it.
    """
    if not len(outlines):
        return outlines
    dense = shapely.transform(shapely.segmentize(outlines, 1.0), np.round)
    smooth = shapely.coverage_simplify(dense, tolerance)
    # A section of a few pixels can collapse: it keeps its pixels.
    bad = ~shapely.is_valid(smooth) | shapely.is_empty(smooth) | (shapely.area(smooth) <= 0)
    return np.where(bad, outlines, smooth)


def distinct_corners(corners: pa.Table) -> pa.Table:
    """Corners seen by two tiles kept once: among corners of different tiles closer than `SAME_CORNER` px, the best score.

    Corners with an owner (truth) are never merged. Sorted by position.
    """
    table = corners.sort_by([(key, "ascending") for key in ("row", "col", "owner", "tile_row", "tile_col")])
    if not len(table):
        return table
    xy = np.stack([table["col"].to_numpy(), table["row"].to_numpy()], axis=1)
    tile = np.stack([table["tile_row"].to_numpy(), table["tile_col"].to_numpy()], axis=1)
    score, owner = table["score"].to_numpy(), table["owner"].to_numpy()
    pairs = cKDTree(xy).query_pairs(SAME_CORNER, output_type="ndarray")
    pairs = pairs[(tile[pairs[:, 0]] != tile[pairs[:, 1]]).any(axis=1) & (owner[pairs] == 0).all(axis=1)]
    rivals: dict[int, list[int]] = {}
    for a, b in pairs.tolist():
        rivals.setdefault(a, []).append(b)
        rivals.setdefault(b, []).append(a)
    gone: set[int] = set()
    for i in sorted(rivals, key=lambda i: (-score[i], i)):
        if i not in gone:
            gone.update(rivals[i])
    keep = np.array([i not in gone for i in range(len(table))])
    return table.filter(pa.array(keep))


def touches_edge(outlines: np.ndarray, grid: Grid) -> np.ndarray:
    """Which outlines (px) reach the raster's edge."""
    x0, y0, x1, y1 = shapely.bounds(outlines).T if len(outlines) else np.zeros((4, 0))
    return (x0 <= 0.5) | (y0 <= 0.5) | (x1 >= grid.width - 0.5) | (y1 >= grid.height - 0.5)


def stitch(
    blocks: list[Block],
    pieces: list[pa.Table],
    links: list[pa.Table],
    seams: list[dict[str, np.ndarray]],
    corners: list[pa.Table],
    grid: Grid,
    tiling: Tiling,
    tolerance: float,
    reach: float,
    rule: str = "overlap",
) -> tuple[list[pa.Table], list[pa.Table]]:
    """Sections and corners of each block (tables after `SECTIONS` and `corners.CORNERS`), from all blocks' detections.

    `tolerance` (px) smooths pixel outlines, 0 leaves outlines as they are; `reach` (px) is how far from a section its
    corners may lie; `rule` as in `sections.links_across`: by `touch` the first piece in scan order also gives the split.
    """
    # Pieces are numbered by tile, whatever block a tile belongs to, so that sums over them do not depend on blocks.
    every = pa.concat_tables(pieces)
    order = np.lexsort([every[key].to_numpy() for key in ("label", "tile_col", "tile_row")])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    every = every.take(pa.array(order))
    number: dict[tuple[int, int], dict[int, int]] = {}
    used, all_links = 0, [np.zeros((0, 2), np.int64)]
    for block, table, inner in zip(blocks, pieces, links, strict=True):
        labels = table["label"].to_pylist()
        own = dict(zip(labels, rank[used : used + len(labels)].tolist(), strict=True))
        number[block.row, block.col] = own
        pairs = zip(inner["first"].to_pylist(), inner["second"].to_pylist(), strict=True)
        all_links.append(np.array([(own[a], own[b]) for a, b in pairs], np.int64).reshape(-1, 2))
        used += len(labels)
    all_links.append(block_links({(b.row, b.col): s for b, s in zip(blocks, seams, strict=True)}, number, rule))
    link = np.concatenate(all_links)
    stands = confirmed(every["core_area"].to_numpy(), every["full_area"].to_numpy(), link)
    outlines = shapely.from_wkb(every["outline"].to_numpy(zero_copy_only=False)[stands])
    group, split = groups(len(every), link)[stands], every["split"].to_numpy()[stands]
    if rule == "touch":
        split = scan_order.first_come(outlines, group, split)
    columns = united(
        outlines,
        group,
        every["score"].to_numpy()[stands],
        every["void"].to_numpy(zero_copy_only=False)[stands],
        split,
        every["owner"].to_numpy()[stands],
    )
    whole = shapely.normalize(np.array(columns["geometry"], object))
    ids = section_ids(whole, grid)
    order = np.argsort(ids)
    whole, ids = whole[order], ids[order]
    edge = touches_edge(whole, grid)
    smooth = simplified(whole, tolerance) if tolerance > 0 else whole
    table = pa.table(
        [
            ids,
            shapely.to_wkb(smooth),
            np.array(columns["score"], float)[order],
            np.array(columns["split"], np.int64)[order],
            edge,
            np.array(columns["void"], bool)[order],
            np.array(columns["owner"], np.int64)[order],
        ],
        schema=SECTIONS,
    )
    kept = distinct_corners(pa.concat_tables(corners))
    block_of = owner_blocks(ids, grid, tiling)
    xy = shapely.points(np.stack([kept["col"].to_numpy(), kept["row"].to_numpy()], axis=1))
    tree = shapely.STRtree(xy)
    sections_out, corners_out = [], []
    for block in blocks:
        mine = np.flatnonzero((block_of == (block.row, block.col)).all(axis=1))
        sections_out.append(table.take(pa.array(mine)))
        near = np.unique(tree.query(smooth[mine], predicate="dwithin", distance=reach)[1]) if len(mine) else mine
        corners_out.append(kept.take(pa.array(near)))
    return sections_out, corners_out


def cut_by(table: pa.Table, missing: np.ndarray) -> pa.Table:
    """The sections with `void` where they touch an area (px) the city is made without: their outline goes on there."""
    outlines = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False))
    cut = np.isin(np.arange(len(table)), shapely.STRtree(missing).query(outlines, "dwithin", distance=CUT)[0])
    void = table["void"].to_numpy(zero_copy_only=False) | cut
    return table.set_column(table.column_names.index("void"), "void", pa.array(void, pa.bool_()))


def missing_areas(blocks: list[Block], grid: Grid, tiling: Tiling) -> np.ndarray:
    """The cores (px) of the grid's blocks that are not among `blocks`."""
    cores = [
        tiling.block_core(b, grid.width, grid.height) for b in tiling.blocks(grid.width, grid.height) if b not in blocks
    ]
    return np.array([shapely.box(c.col, c.row, c.col + c.width, c.row + c.height) for c in cores], object)


def owner_blocks(ids: np.ndarray, grid: Grid, tiling: Tiling) -> np.ndarray:
    """Block (row, col) (n, 2) whose core holds each section's id pixel."""
    row, col = np.divmod(ids - 1, grid.width)
    side = tiling.stride * tiling.block
    return np.stack([np.minimum(row, grid.height - 1) // side, col // side], axis=1)


def main(argv: list[str] | None = None) -> None:
    """Join the detections of all blocks to sections."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.stitch", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--tolerance", type=float, required=True, help="smoothing of pixel outlines, px; 0 for none")
    parser.add_argument("--reach", type=float, required=True, help="how far corners may lie from their section, px")
    parser.add_argument("--seam-rule", choices=SEAM_RULES, default="overlap", help="which pieces are one section")
    parser.add_argument("--folders", nargs="+", required=True, help="detections: folders in the blocks' folders")
    parser.add_argument("--sections", required=True, help="out: sections of all blocks")
    parser.add_argument("--corners", required=True, help="out: corners of all blocks")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    tiling = Tiling(args.tile, args.margin, args.block)
    folders = [Path(f) for f in args.folders]
    blocks = [tiling.block_of(f.parent.name) for f in folders]
    found = stitch(
        blocks,
        [store.read_table(f / "pieces.parquet") for f in folders],
        [store.read_table(f / "links.parquet") for f in folders],
        [store.read_arrays(f / "seams.npz") for f in folders],
        [store.read_table(f / "corners.parquet") for f in folders],
        facts.grid,
        tiling,
        args.tolerance,
        args.reach,
        args.seam_rule,
    )
    missing = missing_areas(blocks, facts.grid, tiling)
    found = [cut_by(table, missing) for table in found[0]], found[1]
    names = [b.name for b in blocks]
    store.write_by_block(args.sections, dict(zip(names, found[0], strict=True)))
    store.write_by_block(args.corners, dict(zip(names, found[1], strict=True)))


if __name__ == "__main__":
    cli.run(main)
