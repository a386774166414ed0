"""Buildings: which roof sections belong together.

Two sections share an edge where their outlines run along each other, facing, for at least 0.5 m. In the map frame they seldom
touch exactly: their planes are fitted apart, and each outline was moved by its own height, so across a step of Δz a
strip of up to |k·n|·Δz (k the lean, n the edge's normal) was hidden in the image and is missing. A **building** is a connected
group of sections that share edges, split where the step along the edge is higher than 3 m, and between footprints if given.

Buildings that share edges all the same (across a high step, or a footprint's line), or of which one reaches under the other's
roof, form a **cluster**: they share party walls, and their solids do not stand in each other.

In: all blocks' `ground.parquet`. Out: `buildings.parquet`, the same rows with `building_id` and `cluster_id`, the smallest
`section_id` of each, and `block`: the block whose core holds the cluster's id pixel, so neither is ever cut. Blocks and
the order of sections do not matter. Of the whole scene only numbers are in memory; outlines are read block by block, with those
near.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, scene, store
from kibs_steps.grid import Tiling
from kibs_steps.inputs import FootprintsUnusable
from kibs_steps.planes import middle_of
from kibs_steps.stitch import groups, owner_blocks
from kibs_steps.view import Lean

SHARED = 0.5  # m, shortest shared edge
APART = 1.0  # m, how far apart (or over each other) outlines that share an edge may run
SLACK = 0.5  # m, the same where a step explains the gap
STEP = 3.0  # m, higher steps divide buildings
FACING = -0.7  # cosine between the directions of two outlines that face each other
OVERLAP = 0.25  # m², sections over each other by as much are together
AT_ONCE = 250_000  # edge pairs held in memory
KEPT = 48  # blocks held in memory: some rows of them
PLANE = ("plane_a", "plane_b", "plane_c", "x0", "y0")


def buildings(
    ids: np.ndarray,
    outlines: np.ndarray,
    planes: np.ndarray,
    lean: Lean,
    footprint: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Building id (n,) and cluster id (n,) of each section.

    `ids` (n,) section ids; `outlines` (n,) polygons, map frame (m); `planes` (n, 5) as a, b, c, x0, y0 of
    z = a(x−x0) + b(y−y0) + c; `lean` of the view, one or (n, 2); `footprint` (n,) number of the
    footprint each section stands in, −1 none.
    """
    lean = np.broadcast_to(np.asarray(lean, float), (len(ids), 2))
    every = Sections(ids, outlines, planes, lean)
    found = adjacent(every, np.ones(len(ids), bool), max(APART, hidden(lean)))
    return named(ids, found, footprint)


class Sections(NamedTuple):
    """Sections: ids (n,), outlines (n,) in the map frame (m), planes (n, 5), lean of the view (n, 2)."""

    ids: np.ndarray
    outlines: np.ndarray
    planes: np.ndarray
    lean: np.ndarray

    def take(self, rows: np.ndarray) -> Sections:
        """Some of the sections."""
        return Sections(*(column[rows] for column in self))


class Adjacent(NamedTuple):
    """Pairs (m, 2) of sections that touch or overlap, and whether their step there lets them be one building (m,)."""

    pairs: np.ndarray
    together: np.ndarray


def adjacent(found: Sections, own: np.ndarray, reach: float) -> Adjacent:
    """The pairs of sections that touch whose smaller id is one of the `own` (n,) bool, `reach` (m) apart at most."""
    order = np.argsort(found.ids, kind="stable")
    found = found.take(order)
    flat = shapely.force_2d(found.outlines)
    flat = np.where(shapely.is_missing(flat), shapely.Polygon(), flat)
    whole = shapely.make_valid(flat)
    pairs = shapely.STRtree(whole).query(whole, predicate="dwithin", distance=reach).T
    pairs = pairs[(pairs[:, 0] < pairs[:, 1]) & own[order[pairs[:, 0]]]]
    length, step = shared_edges(flat, found.planes, pairs, found.lean)
    long = length >= SHARED
    together, touching = long & (step <= STEP), long.copy()
    rest = np.flatnonzero(~long)
    touching[rest], together[rest] = _overlapping(whole, found.planes, pairs[rest])
    return Adjacent(order[pairs[touching]], together[touching])


def named(ids: np.ndarray, found: Adjacent, footprint: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Building id (n,) and cluster id (n,) of sections: the smallest id of those each is connected to."""
    together = found.together
    if footprint is not None:
        together = together & (footprint[found.pairs[:, 0]] == footprint[found.pairs[:, 1]])
    return _smallest(ids, found.pairs[together]), _smallest(ids, found.pairs)


def _smallest(ids: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    group = groups(len(ids), pairs)
    smallest = np.full(group.max(initial=-1) + 1, np.iinfo(np.int64).max)
    np.minimum.at(smallest, group, ids)
    return smallest[group]


def hidden(lean: Lean) -> float:
    """Widest strip (m) of a building that its own steps can hide in an image of that lean (of these leans)."""
    return SLACK + float(np.hypot(*np.asarray(lean, float).T).max(initial=0.0)) * STEP


def shared_edges(
    outlines: np.ndarray, planes: np.ndarray, pairs: np.ndarray, lean: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Length (m) of the edge that each pair (m.

    2) of sections shares, and the mean height of the step along it (m); `lean` (n, 2).
    """
    parts, section = shapely.get_parts(outlines, return_index=True)
    rings, part = shapely.get_rings(shapely.orient_polygons(parts), return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    edge = np.flatnonzero(np.diff(ring) == 0)
    start, end = xy[edge], xy[edge + 1]
    of = section[part[ring[edge]]]
    by = np.argsort(of, kind="stable")
    start, end, of = start[by], end[by], of[by]
    first = np.searchsorted(of, np.arange(len(outlines) + 1))
    count = np.diff(first)
    combinations = count[pairs[:, 0]] * count[pairs[:, 1]]
    length, moment = np.zeros(len(pairs)), np.zeros(len(pairs))
    cuts = np.flatnonzero(np.diff(np.cumsum(combinations) // AT_ONCE)) + 1
    for some in np.split(np.arange(len(pairs)), cuts):
        a, b = pairs[some].T
        pair = np.repeat(some, combinations[some])
        k = np.arange(len(pair)) - np.repeat(np.cumsum(combinations[some]) - combinations[some], combinations[some])
        width = np.repeat(count[b], combinations[some])
        i = np.repeat(first[a], combinations[some]) + k // np.maximum(width, 1)
        j = np.repeat(first[b], combinations[some]) + k % np.maximum(width, 1)
        along, step = _facing(start, end, of, planes, i, j, lean)
        length += np.bincount(pair, along, minlength=len(pairs))
        moment += np.bincount(pair, along * step, minlength=len(pairs))
    return length, moment / np.maximum(length, 1e-9)


def _facing(
    start: np.ndarray,
    end: np.ndarray,
    of: np.ndarray,
    planes: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    lean: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How far (m) edges i and j run along each other, and the step (m) there; 0 m where they do not."""
    span = end - start
    u = span / np.maximum(np.hypot(*span.T), 1e-9)[:, None]
    facing = (u[i] * u[j]).sum(axis=1) <= FACING
    way = np.where(facing[:, None], u[i] - u[j], [1.0, 0.0])  # the line between both: neither edge comes first
    way /= np.hypot(*way.T)[:, None]
    first, last = (((p - start[i]) * way).sum(axis=1) for p in (start[i], end[i]))
    after, before = (((p - start[i]) * way).sum(axis=1) for p in (start[j], end[j]))
    low, high = np.maximum(first, before), np.minimum(last, after)
    along = np.where(facing, np.maximum(high - low, 0.0), 0.0)
    middle = (low + high) / 2
    here, there = (
        start[k] + np.clip((middle - a) / np.where(facing, b - a, 1.0), 0.0, 1.0)[:, None] * span[k]
        for k, a, b in ((i, first, last), (j, after, before))
    )
    step = np.abs(_heights(planes[of[i]], here) - _heights(planes[of[j]], there))
    normal = np.stack([way[:, 1], -way[:, 0]], axis=1)
    leans = np.maximum(*(np.abs((normal * lean[of[k]]).sum(axis=1)) for k in (i, j)))
    reach = SLACK + leans * np.minimum(step, STEP)
    near = np.abs(((there - here) * normal).sum(axis=1)) <= np.maximum(APART, reach)
    return np.where(near, along, 0.0), step


def _heights(planes: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Heights (n,) of planes (n, 5) at positions (n, 2)."""
    return planes[:, 0] * (xy[:, 0] - planes[:, 3]) + planes[:, 1] * (xy[:, 1] - planes[:, 4]) + planes[:, 2]


def _overlapping(outlines: np.ndarray, planes: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m,) bool: pairs that cover each other by `OVERLAP`; (m,) bool: those with a step of at most `STEP` there, as a dormer and
    its roof."""
    over, together = np.zeros((2, len(pairs)), bool)
    if len(pairs):
        touch = np.flatnonzero(shapely.intersects(outlines[pairs[:, 0]], outlines[pairs[:, 1]]))
        shared = shapely.intersection(outlines[pairs[touch, 0]], outlines[pairs[touch, 1]])
        large = shapely.area(shared) >= OVERLAP
        touch = touch[large]
        centre = shapely.get_coordinates(shapely.centroid(shared[large]))
        first, second = (_heights(planes[pairs[touch, k]], centre) for k in (0, 1))
        over[touch], together[touch] = True, np.abs(first - second) <= STEP
    return over, together


def standing_in(outlines: np.ndarray, footprints: np.ndarray) -> np.ndarray:
    """Number (n,) of the footprint that each section overlaps most, −1 none."""
    sections, footprints = shapely.make_valid(shapely.force_2d(outlines)), shapely.make_valid(footprints)
    section, footprint = shapely.STRtree(footprints).query(sections, predicate="intersects")
    area = shapely.area(shapely.intersection(sections[section], footprints[footprint]))
    order = np.lexsort((-footprint, area))  # the largest area, then the first footprint, is written last
    found = np.full(len(outlines), -1)
    found[section[order]] = np.where(area[order] > 0, footprint[order], -1)
    return found


def read_footprints(path: str | Path, crs: str) -> np.ndarray:
    """The polygons of a vector file, in `crs`. Raises `FootprintsUnusable`."""
    import geopandas
    from pyogrio.errors import DataLayerError, DataSourceError

    try:
        frame = geopandas.read_file(path)
    except (DataSourceError, DataLayerError) as error:
        raise FootprintsUnusable(f"footprints {path} cannot be read ({error}): give a GeoPackage or GeoJSON") from error
    frame = frame[frame.geom_type.isin(["Polygon", "MultiPolygon"])]
    if frame.empty:
        raise FootprintsUnusable(f"footprints {path} holds no polygons: give a layer of building outlines")
    if frame.crs is None:
        raise FootprintsUnusable(f"footprints {path} says no CRS: assign one")
    return shapely.force_2d(frame.to_crs(crs).geometry.to_numpy())


def main(argv: list[str] | None = None) -> None:
    """Group the sections of all blocks to buildings."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.buildings", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--footprints", help="polygons that divide buildings")
    parser.add_argument("--ground", nargs="+", required=True, help="ground.parquet of every block")
    parser.add_argument("--out", required=True, help="out: buildings.parquet of all blocks")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    tiling = Tiling(args.tile, args.margin, args.block)
    prints = read_footprints(args.footprints, facts.grid.crs) if args.footprints else None
    known = numbers(args.ground, facts, prints)
    building, cluster = named(known.ids, adjacency(args.ground, known), known.footprint)
    names = {(block.row, block.col): block.name for block in tiling.blocks(facts.grid.width, facts.grid.height)}
    block_of = owner_blocks(cluster, facts.grid, tiling)
    schema = store.read_table(args.ground[0]).schema
    more = {"building_id": building, "cluster_id": cluster}
    table_of = functools.lru_cache(maxsize=KEPT)(store.read_table)
    with store.by_block(args.out, pa.schema([*schema, *(pa.field(name, pa.int64()) for name in more)])) as append:
        for place, name in names.items():
            mine = np.flatnonzero((block_of == place).all(axis=1))
            mine = mine[np.lexsort((known.ids[mine], building[mine]))]
            append(name, _rows(mine, known, args.ground, table_of, schema, more))


class Numbers(NamedTuple):
    """What is known of the sections of all blocks while their outlines are not in memory.

    `ids` (n,), `file` (n,) and `row` (n,): where each stands; `bounds` (n, 4) map m; `lean` (n, 2); `footprint` (n,) or None.
    """

    ids: np.ndarray
    file: np.ndarray
    row: np.ndarray
    bounds: np.ndarray
    lean: np.ndarray
    footprint: np.ndarray | None


def numbers(paths: list[str], facts: scene.Scene, footprints: np.ndarray | None) -> Numbers:
    """Reads every block once."""
    found = []
    for k, path in enumerate(paths):
        table = store.read_table(path, ["section_id", "outline", "outline_map"])
        outlines, pixels = (_shapes(table[name]) for name in ("outline_map", "outline"))
        n = len(table)
        prints = np.zeros(n, int) if footprints is None else standing_in(outlines, footprints)
        lean = np.broadcast_to(np.asarray(facts.leans(middle_of(pixels, facts)), float), (n, 2))
        bounds = shapely.bounds(outlines).reshape(-1, 4)
        found.append((table["section_id"].to_numpy(), np.full(n, k), np.arange(n), bounds, lean, prints))
    ids, file, row, bounds, lean, prints = map(np.concatenate, zip(*found, strict=True))
    return Numbers(ids, file, row, bounds, lean, None if footprints is None else prints)


def adjacency(paths: list[str], known: Numbers) -> Adjacent:
    """Which sections of all blocks touch (as rows of `known`): block after block, each with what is near it."""
    reach = max(APART, hidden(known.lean))
    block_of = functools.lru_cache(maxsize=KEPT)(_outlines_and_planes)
    pairs, together = [np.zeros((0, 2), np.int64)], [np.zeros(0, bool)]
    for k in range(len(paths)):
        own = known.file == k
        if not own.any():
            continue
        low, high = np.fmin.reduce(known.bounds[own, :2]) - reach, np.fmax.reduce(known.bounds[own, 2:]) + reach
        near = own | ((known.bounds[:, :2] <= high) & (known.bounds[:, 2:] >= low)).all(axis=1)
        rows = np.flatnonzero(near)
        parts = []
        for file in np.unique(known.file[rows]):
            outlines, planes = block_of(paths[file])
            mine = rows[known.file[rows] == file]
            parts.append((mine, outlines[known.row[mine]], planes[known.row[mine]]))
        rows, outlines, planes = map(np.concatenate, zip(*parts, strict=True))
        found = adjacent(Sections(known.ids[rows], outlines, planes, known.lean[rows]), own[rows], reach)
        pairs.append(rows[found.pairs])
        together.append(found.together)
    return Adjacent(np.concatenate(pairs), np.concatenate(together))


def _shapes(column: pa.ChunkedArray) -> np.ndarray:
    return shapely.from_wkb(column.to_numpy(zero_copy_only=False), on_invalid="ignore")


def _outlines_and_planes(path: str) -> tuple[np.ndarray, np.ndarray]:
    table = store.read_table(path, ["outline_map", *PLANE])
    return _shapes(table["outline_map"]), np.column_stack([table[name].to_numpy() for name in PLANE])


def _rows(
    rows: np.ndarray,
    known: Numbers,
    paths: list[str],
    table_of: Callable[[str], pa.Table],
    schema: pa.Schema,
    more: dict[str, np.ndarray],
) -> pa.Table:
    """Rows of `known` as a table, in that order, with more columns."""
    parts, order = [schema.empty_table()], []
    for file in np.unique(known.file[rows]):
        mine = np.flatnonzero(known.file[rows] == file)
        parts.append(table_of(paths[file]).take(pa.array(known.row[rows[mine]])))
        order.append(mine)
    place = np.argsort(np.concatenate([np.zeros(0, np.int64), *order]), kind="stable")
    table = pa.concat_tables(parts).take(pa.array(place))
    for name, values in more.items():
        table = table.append_column(name, pa.array(values[rows]))
    return table


if __name__ == "__main__":
    cli.run(main)
