"""Stitch: pieces of one section that meet across seams become one section with one id.

Links between pieces come from pairs of tiles (`sections.links_across`), those inside blocks already found, those between
blocks found here from the stored strips; a section is a connected group of linked pieces. A piece whose larger part lies
beyond its own tile's core and which no neighbour confirms is voted out: the tile that answers for that place does not see it.
Union-find has no order, so results depend neither on the order of blocks nor on their size.

Which pieces belong together is found for the whole raster at once, from numbers alone. Outlines are joined in a **sweep** over
the rows of blocks: a section leaves as soon as nothing below can touch it, so memory holds a row of blocks, not the city.

In: all blocks' pieces, links, seams, corners and heights. Out: `stitched/sections.parquet` (each section in the block that holds
its id pixel) and `stitched/corners.parquet` (the corners within reach of each block's sections), both with a column `block`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, heightmap, scene, store
from kibs_steps.corners import CORNERS
from kibs_steps.grid import Block, Grid, Tiling
from kibs_steps.models import scoring
from kibs_steps.sections import SEAM_RULES, links_across

CUT = 2.0  # px: smoothing moves an outline no further
SAME_CORNER = 3.0  # px: two tiles' views of one corner lie closer than two corners of a roof
NEAR = 4.0  # px: sections closer than this are smoothed together; smoothing moves no outline as far
NUMBERS = ["label", "tile_row", "tile_col", "core_area", "full_area"]
FACTS = ["label", "outline", "score", "void", "split", "owner", "evidence"]

SECTIONS = pa.schema(
    [
        ("section_id", pa.int64()),
        ("outline", pa.binary()),
        ("score", pa.float64()),
        ("split", pa.int64()),
        ("edge", pa.bool_()),
        ("void", pa.bool_()),
        ("owner", pa.int64()),
        ("sums", heightmap.HEIGHTS.field("sums").type),
    ]
)


class Detections(NamedTuple):
    """How to read what was found in a block: its pieces (the columns asked for), links, seams, corners, heights."""

    pieces: Callable[[Block, list[str]], pa.Table]
    links: Callable[[Block], pa.Table]
    seams: Callable[[Block], dict[str, np.ndarray]]
    corners: Callable[[Block], pa.Table]
    heights: Callable[[Block], pa.Table]


class Joined(NamedTuple):
    """Of every piece of the raster, numbered by tile and label: its group, whether it stands, its block row.

    `number` gives, by block name, the numbers of the block's pieces in their table's order.
    """

    number: dict[str, np.ndarray]
    group: np.ndarray
    stands: np.ndarray
    row: np.ndarray

    def last_row(self) -> np.ndarray:
        """The last block row in which each group has a piece that stands."""
        last = np.full(self.group.max(initial=-1) + 1, -1)
        np.maximum.at(last, self.group[self.stands], self.row[self.stands])
        return last


class Parts(NamedTuple):
    """Columns of outlines (px) on their way: piece number (or 0), group, geometry, score, void, split, owner,
    evidence (n, 21), sums of heights (n, 12)."""

    number: np.ndarray
    group: np.ndarray
    geometry: np.ndarray
    score: np.ndarray
    void: np.ndarray
    split: np.ndarray
    owner: np.ndarray
    evidence: np.ndarray
    sums: np.ndarray

    def take(self, rows: np.ndarray) -> Parts:
        """The chosen rows."""
        return Parts(*(column[rows] for column in self))

    @staticmethod
    def joined(some: list[Parts]) -> Parts:
        """Rows of several, one after the other."""
        return Parts(*(np.concatenate(columns) for columns in zip(*some, strict=True)))


NOTHING = Parts(
    *(np.zeros(0, kind) for kind in (np.int64, np.int64, object, float, bool, np.int64, np.int64)),
    scoring.none(0),
    np.zeros((0, len(heightmap.SUMS))),
)


def groups(n: int, links: np.ndarray) -> np.ndarray:
    """Group number (n,) of each piece, from links (m, 2): connected components."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def confirmed(core_area: np.ndarray, full_area: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Which pieces stand: those linked to another, or with at least half of their pixels in their own tile's core."""
    linked = np.zeros(len(core_area), bool)
    linked[links.ravel()] = True
    return (core_area > 0) & (linked | (2 * core_area >= full_area))


def joined(blocks: list[Block], found: Detections, rule: str, stride: int) -> Joined:
    """Which pieces of all blocks are one section. Reads numbers and seams only, seams of two rows of blocks at a time; a seam is
    one of tiles, each `stride` px long, as it is inside blocks."""
    tables = {b.name: found.pieces(b, NUMBERS) for b in blocks}
    column = {name: np.concatenate([t[name].to_numpy() for t in tables.values()]) for name in NUMBERS}
    # Pieces are numbered by tile, whatever block a tile belongs to, so that sums over them do not depend on blocks.
    order = np.lexsort([column[key] for key in ("label", "tile_col", "tile_row")])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    cuts = np.cumsum([len(t) for t in tables.values()])[:-1]
    number = dict(zip(tables, np.split(rank, cuts), strict=True))
    labels = {name: t["label"].to_numpy() for name, t in tables.items()}
    row = np.empty(len(order), np.int64)
    for block in blocks:
        row[number[block.name]] = block.row

    def numbered(block: Block, values: np.ndarray) -> np.ndarray:
        by_label = np.argsort(labels[block.name])
        return number[block.name][by_label[np.searchsorted(labels[block.name], values, sorter=by_label)]]

    links = [np.zeros((0, 2), np.int64)]
    at: dict[tuple[int, int], tuple[Block, dict[str, np.ndarray]]] = {}
    for block in sorted(blocks, key=lambda b: (b.row, b.col)):
        inner = found.links(block)
        links.append(np.stack([numbered(block, inner[name].to_numpy()) for name in ("first", "second")], axis=1))
        seams = found.seams(block)
        for place, side, other_side in (
            ((block.row, block.col - 1), "east", "west"),
            ((block.row - 1, block.col), "south", "north"),
        ):
            if place in at and seams[other_side].size:
                neighbour, theirs = at[place]
                along = 0 if side == "east" else 1
                cuts = np.arange(stride, seams[other_side].shape[along], stride)
                strips = (np.split(strip, cuts, axis=along) for strip in (theirs[side], seams[other_side]))
                pairs = np.concatenate([links_across(*two, side, rule) for two in zip(*strips, strict=True)])
                links.append(np.stack([numbered(neighbour, pairs[:, 0]), numbered(block, pairs[:, 1])], axis=1))
        at.pop((block.row - 1, block.col), None)
        at[block.row, block.col] = block, seams
    link = np.concatenate(links)
    stands = confirmed(column["core_area"][order], column["full_area"][order], link)
    return Joined(number, groups(len(order), link), stands, row)


def united(pieces: Parts, scorer: dict[str, Any] | None = None, thresholds: dict[str, float] | None = None) -> Parts:
    """Sections from pieces in order of number: the union of every group, then one section per connected part.

    Scores are those of the pieces' evidence together, by the `scorer` (the contract's `score`); without evidence means
    weighted by area.
    Every part of a group has the score and the sums of heights of the whole. What is no roof by all its evidence and the
    contract's `thresholds` (`scoring.roofs`) is left out.
    """
    order = np.argsort(pieces.group, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(pieces.group[order]) != 0]) if len(order) else np.zeros(0, int)
    area = shapely.area(pieces.geometry)
    rows = []
    for members in np.split(order, starts[1:]) if len(order) else []:
        some = pieces.take(members)
        whole = some.geometry[0] if len(members) == 1 else shapely.union_all(some.geometry)
        score = float((area[members] / area[members].sum() * some.score).sum())
        evidence = scoring.together(some.evidence)
        facts = (
            score,
            bool(some.void.any()),
            int(some.split.max()),
            int(some.owner.max()),
            evidence,
            some.sums.sum(axis=0),
        )
        rows += [(part, *facts) for part in shapely.get_parts(whole)]
    if not rows:
        return NOTHING
    geometry, score, void, split, owner, evidence, sums = map(np.array, zip(*rows, strict=True))
    score = np.where(scoring.told(evidence), scoring.scores(evidence, scorer), score)
    none = np.zeros(len(rows), np.int64)
    found = Parts(none, none, shapely.normalize(geometry), score, void, split, owner, evidence, sums)
    return found.take(scoring.roofs(evidence, score, thresholds or {}))


def of_pieces(labels: np.ndarray, heights: pa.Table) -> np.ndarray:
    """Sums of heights (n, 12) of a block's pieces with these labels, zero for those without."""
    sums = np.zeros((len(labels), len(heightmap.SUMS)))
    if len(heights):
        known = heights["label"].to_numpy()
        order = np.argsort(known)
        place = np.minimum(np.searchsorted(known, labels, sorter=order), len(known) - 1)
        there = known[order[place]] == labels
        sums[there] = heightmap.column(heights["sums"])[order[place[there]]]
    return sums


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


def clusters(outlines: np.ndarray) -> np.ndarray:
    """Cluster number (n,) of each outline: those within `NEAR` of each other, directly or through others, are together."""
    pairs = shapely.STRtree(outlines).query(outlines, predicate="dwithin", distance=NEAR).T
    return groups(len(outlines), pairs[pairs[:, 0] < pairs[:, 1]])


def distinct_corners(corners: pa.Table) -> pa.Table:
    """Corners seen by two tiles kept once: among corners of different tiles closer than `SAME_CORNER` px, the best score.

    Corners with an owner (truth) are never merged. Sorted by position.
    """
    from scipy.spatial import cKDTree

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


def within_reach(corners: pa.Table, outlines: np.ndarray, reach: float) -> pa.Table:
    """The corners (sorted by row) within `reach` px of any outline."""
    if not len(outlines) or not len(corners):
        return corners.slice(0, 0)
    x0, y0, x1, y1 = shapely.total_bounds(outlines) + np.array([-reach, -reach, reach, reach])
    rows = corners["row"].to_numpy()
    first, end = np.searchsorted(rows, [y0, np.nextafter(y1, np.inf)])
    band = corners.slice(first, end - first)
    col = band["col"].to_numpy()
    inside = np.flatnonzero((col >= x0) & (col <= x1))
    points = shapely.points(np.stack([col[inside], band["row"].to_numpy()[inside]], axis=1))
    near = np.unique(shapely.STRtree(points).query(outlines, predicate="dwithin", distance=reach)[1])
    return band.take(pa.array(inside[near]))


def touches_edge(outlines: np.ndarray, grid: Grid) -> np.ndarray:
    """Which outlines (px) reach the raster's edge."""
    x0, y0, x1, y1 = shapely.bounds(outlines).T if len(outlines) else np.zeros((4, 0))
    return (x0 <= 0.5) | (y0 <= 0.5) | (x1 >= grid.width - 0.5) | (y1 >= grid.height - 0.5)


def finished(sections: Parts, grid: Grid, tolerance: float) -> pa.Table:
    """Whole sections (with all that lie `NEAR` them) as a table after `SECTIONS`, by id."""
    ids = section_ids(sections.geometry, grid)
    order = np.argsort(ids)
    whole, ids = sections.take(order), ids[order]
    smooth = whole.geometry
    if tolerance > 0 and len(smooth):
        # Each cluster alone: what smoothing gives does not depend on which others are at hand.
        smooth, cluster = smooth.copy(), clusters(smooth)
        by_cluster = np.argsort(cluster, kind="stable")
        for members in np.split(by_cluster, np.flatnonzero(np.diff(cluster[by_cluster])) + 1):
            smooth[members] = simplified(smooth[members], tolerance)
    edge = touches_edge(whole.geometry, grid)
    columns = [ids, shapely.to_wkb(smooth), whole.score, whole.split, edge, whole.void, whole.owner]
    columns.append(heightmap.table(ids, whole.sums)["sums"].combine_chunks())
    return pa.table(columns, schema=SECTIONS)


def sweep(
    blocks: list[Block],
    found: Detections,
    grid: Grid,
    tiling: Tiling,
    tolerance: float,
    rule: str,
    scorer: dict[str, Any] | None,
    thresholds: dict[str, float] | None,
) -> Iterator[tuple[int, pa.Table]]:
    """The sections of each row of blocks (table after `SECTIONS`, by id), row after row."""
    whole = joined(blocks, found, rule, tiling.stride)
    last = whole.last_row()
    rows = sorted({b.row for b in blocks})
    side = tiling.stride * tiling.block
    waiting, open_ = NOTHING, NOTHING
    done: list[pa.Table] = [SECTIONS.empty_table()]
    unwritten = 0
    for row in rows:
        pieces = [waiting]
        for block in blocks:
            if block.row == row:
                table, number = found.pieces(block, FACTS), whole.number[block.name]
                shapes = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False))
                rest = [table[name].to_numpy(zero_copy_only=False) for name in FACTS[2:-1]]
                rest.append(heightmap.column(table["evidence"], len(scoring.EVIDENCE)))
                sums = of_pieces(table["label"].to_numpy(), found.heights(block))
                pieces.append(Parts(number, whole.group[number], shapes, *rest, sums).take(whole.stands[number]))
        every = Parts.joined(pieces)
        every = every.take(np.argsort(every.number))
        ready = last[every.group] <= row
        complete, waiting = every.take(ready), every.take(~ready)
        if rule == "touch":
            from kibs_steps import scan_order

            split = scan_order.first_come(complete.geometry, complete.group, complete.split)
            complete = complete._replace(split=split)
        open_ = Parts.joined([open_, united(complete, scorer, thresholds)])
        limit = (row + 1) * side
        leaves = np.ones(len(open_.group), bool)
        if tolerance > 0 and row != rows[-1]:
            shapes = np.concatenate([open_.geometry, waiting.geometry])
            cluster, low = clusters(shapes), shapely.bounds(shapes)[:, 3]
            stays = low + NEAR >= limit
            stays[len(leaves) :] = True
            leaves = ~np.isin(cluster, cluster[stays])[: len(leaves)]
        done.append(finished(open_.take(leaves), grid, tolerance))
        open_ = open_.take(~leaves)
        held = np.concatenate([open_.geometry, waiting.geometry])
        top = shapely.bounds(held)[:, 1].min(initial=np.inf) if row != rows[-1] else np.inf
        table = pa.concat_tables(done).sort_by("section_id")
        of = owner_blocks(table["section_id"].to_numpy(), grid, tiling)[:, 0]
        while unwritten < len(rows) and rows[unwritten] <= row and (rows[unwritten] + 1) * side <= top:
            leaving = of <= rows[unwritten]
            yield rows[unwritten], table.filter(pa.array(leaving))
            table, of = table.filter(pa.array(~leaving)), of[~leaving]
            unwritten += 1
        done = [table]


def stitch(
    blocks: list[Block],
    found: Detections,
    grid: Grid,
    tiling: Tiling,
    tolerance: float,
    reach: float,
    rule: str = "overlap",
    scorer: dict[str, Any] | None = None,
    thresholds: dict[str, float] | None = None,
) -> Iterator[tuple[Block, pa.Table, pa.Table]]:
    """Every block, row by row, with its sections and corners (tables after `SECTIONS` and `corners.CORNERS`).

    `tolerance` (px) smooths pixel outlines, 0 leaves outlines as they are; `reach` (px) is how far from a section its
    corners may lie; `rule` as in `sections.links_across`: by `touch` the first piece in scan order also gives the split.
    `scorer` is the model's `score`, of its `thresholds` those count that say what is sure (`models.scoring`).
    """
    corners = distinct_corners(pa.concat_tables([CORNERS.empty_table(), *(found.corners(b) for b in blocks)]))
    for row, table in sweep(blocks, found, grid, tiling, tolerance, rule, scorer, thresholds):
        of = owner_blocks(table["section_id"].to_numpy(), grid, tiling)[:, 1]
        for block in sorted((b for b in blocks if b.row == row), key=lambda b: b.col):
            mine = table.filter(pa.array(of == block.col))
            outlines = shapely.from_wkb(mine["outline"].to_numpy(zero_copy_only=False))
            yield block, mine, within_reach(corners, outlines, reach)


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
    parser.add_argument("--model", help="models/sections.json, for scores and what is sure")
    parser.add_argument("--without-corners", action="store_true", help="no corners were looked for")
    parser.add_argument("--with-heights", action="store_true", help="a model gave heights all over the sections")
    parser.add_argument("--sections", required=True, help="out: sections of all blocks")
    parser.add_argument("--corners", required=True, help="out: corners of all blocks")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    tiling = Tiling(args.tile, args.margin, args.block)
    folders = {f.parent.name: f for f in map(Path, args.folders)}
    found = Detections(
        pieces=lambda b, columns: store.read_table(folders[b.name] / "pieces.parquet", columns),
        links=lambda b: store.read_table(folders[b.name] / "links.parquet"),
        seams=lambda b: store.read_arrays(folders[b.name] / "seams.npz"),
        corners=lambda b: (
            CORNERS.empty_table() if args.without_corners else store.read_table(folders[b.name] / "corners.parquet")
        ),
        heights=lambda b: (
            store.read_table(folders[b.name] / "heights.parquet")
            if args.with_heights
            else heightmap.HEIGHTS.empty_table()
        ),
    )
    blocks = [tiling.block_of(name) for name in folders]
    missing = missing_areas(blocks, facts.grid, tiling)
    terms = store.read_json(args.model)["contract"] if args.model else {"thresholds": {}}
    with store.by_block(args.sections, SECTIONS) as sections, store.by_block(args.corners, CORNERS) as corners:
        settings = (
            args.tolerance,
            args.reach,
            args.seam_rule,
            terms.get("score"),
            terms["thresholds"],
        )
        for block, mine, near in stitch(blocks, found, facts.grid, tiling, *settings):
            sections(block.name, cut_by(mine, missing))
            corners(block.name, near)


if __name__ == "__main__":
    cli.run(main, pandas=False)
