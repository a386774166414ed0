"""Edited: roof sections corrected by hand, in the place of those that were found.

In: a polygon layer like `roof_sections_image` of `city.gpkg` (outlines where they are *seen*, column `section_id`), as edited
in QGIS; what was
stitched; all corners. Out: sections and corners by block, as `stitch` writes them, for `planes`. A section that was not
touched keeps its
outline to the bit, its id and all that is known of it. One that was changed keeps its id; of several with one id (split in two)
the one that holds the id's pixel, else the first. New ones get an id from their place. Heights come from the corners, not from
the layer's z.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, scene, store
from kibs_steps.corners import CORNERS
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Tiling
from kibs_steps.heightmap import EMPTY, LIFT
from kibs_steps.stitch import SECTIONS, distinct_corners, owner_blocks, section_ids, touches_edge

LAYER = "roof_sections_image"
PUBLISHED = "roof_sections"  # the other layer of `city.gpkg` that has sections, where they stand
UNREADABLE = "sections {path} cannot be read ({error}): give the edited city.gpkg or a GeoPackage"
ELSEWHERE = "sections {path} lie outside the raster, which is in {crs}: check the layer's CRS, and that it belongs to the raster"
EMPTY_LAYER = f"sections {{path}} holds no polygons: give the layer {LAYER} as edited"
SAME = 0.01  # px: an outline that moved less was not touched, but perhaps saved in another CRS
ALIKE = 0.8  # of what an outline and its former one cover together both must, or heights over the former say nothing


class SectionsUnusable(KibsError):
    """A layer of edited sections that cannot be read as polygons."""


def layer_of(path: str | Path) -> str | None:
    """The layer that holds the sections: that of `city.gpkg`, else a file's first of polygons, or its first of any kind."""
    import pyogrio

    layers = {str(name): str(kind) for name, kind in pyogrio.list_layers(path)}
    return LAYER if LAYER in layers else next((name for name, kind in layers.items() if "Polygon" in kind), None)


def _say_which(path: str | Path) -> None:
    """Warn of other layers that look like edited sections: of a file with `LAYER` that one is read."""
    import pyogrio

    names = [str(name) for name, kind in pyogrio.list_layers(path) if "Polygon" in str(kind)]
    if LAYER not in names:
        return
    others = [name for name in names if name not in (LAYER, PUBLISHED)]
    others = [name for name in others if "section_id" in pyogrio.read_info(path, layer=name)["fields"]]
    if others:
        print(
            f"warning: sections {path}: layer {LAYER} is read, not {', '.join(others)}: give a file of its own if that is meant",
            file=sys.stderr,
        )


def read(path: str | Path, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Ids (n,), 0 where there is none, and outlines (n,) in image coordinates (px): those that meet the raster.

    Raises `SectionsUnusable`.
    """
    import geopandas
    import pandas as pd
    import pyogrio

    try:
        _say_which(path)
        frame = geopandas.read_file(path, layer=layer_of(path))
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise SectionsUnusable(UNREADABLE.format(path=path, error=error)) from error
    if "geometry" not in frame:
        raise SectionsUnusable(EMPTY_LAYER.format(path=path))
    rows = len(frame)
    frame["row"] = np.arange(rows)
    # Parts of collections too, which editing may leave, and of what is in them.
    frame = frame[frame.geometry.notna()].explode().explode(ignore_index=True)
    frame = frame[frame.geom_type == "Polygon"]
    if frame.empty:
        raise SectionsUnusable(EMPTY_LAYER.format(path=path))
    if frame.crs is None:
        raise SectionsUnusable(f"sections {path} says no CRS: assign {grid.crs.splitlines()[0]}")
    frame = frame.to_crs(grid.crs)
    own = pd.to_numeric(frame["section_id"], errors="coerce") if "section_id" in frame else pd.Series(0, frame.index)
    ids = own.fillna(0).clip(0, 2**62).astype(np.int64).to_numpy()
    outlines = shapely.transform(shapely.force_2d(frame.geometry.to_numpy()), lambda xy: _at_corners(grid.to_image(xy)))
    outlines = np.array([_polygon(g) for g in outlines], object)
    usable = np.array([g is not None for g in outlines])
    if not usable.any():
        raise SectionsUnusable(EMPTY_LAYER.format(path=path))
    if lost := rows - frame["row"][usable].nunique():
        print(f"warning: sections {path}: {lost} of {rows} rows have no area and are left out", file=sys.stderr)
    ids, outlines = ids[usable], outlines[usable]
    shown = shapely.intersects(outlines, shapely.box(0, 0, grid.width, grid.height))
    if not shown.any():
        raise SectionsUnusable(ELSEWHERE.format(path=path, crs=grid.crs.splitlines()[0]))
    if lost := int((~shown).sum()):
        print(f"warning: sections {path}: {lost} outlines lie outside the raster and are left out", file=sys.stderr)
    return ids[shown], outlines[shown]


def _at_corners(pixels: np.ndarray) -> np.ndarray:
    """Places (n, 2 px), those exactly at pixels' corners that a way through map coordinates moved from there by less than
    `SAME`: by them traced outlines are told from drawn ones."""
    corners = np.round(pixels)
    return np.where(np.abs(pixels - corners) < SAME, corners, pixels)


def _polygon(outline: shapely.Geometry) -> shapely.Geometry | None:
    """A valid polygon of an outline drawn by hand: the largest part where it crosses itself; none of coordinates that are no
    numbers."""
    if not np.isfinite(shapely.get_coordinates(outline)).all():
        return None
    if outline.is_valid:
        return outline if outline.area > 0 else None
    mended = shapely.make_valid(outline, method="structure", keep_collapsed=False)
    parts = [p for p in shapely.get_parts(mended) if p.geom_type == "Polygon" and p.area > 0]
    return max(parts, key=shapely.area, default=None)


def named(ids: np.ndarray, outlines: np.ndarray, known: set[int], grid: Grid) -> np.ndarray:
    """Ids (n,), each once: the given one where it is known, else one from the outline's place."""
    given = ids.copy()
    pixel = np.stack([(ids - 1) % grid.width + 0.5, (ids - 1) // grid.width + 0.5], axis=1)
    holds = np.array([shapely.contains_xy(o, *p) for o, p in zip(outlines, pixel, strict=True)], bool)
    order = np.lexsort((np.arange(len(ids)), ~holds))  # those that hold their id's pixel choose first
    taken: set[int] = set()
    for k in order:
        if given[k] in known and given[k] not in taken:
            taken.add(int(given[k]))
        else:
            given[k] = 0
    fresh = section_ids(outlines, grid)
    for k in np.flatnonzero(given == 0):
        name = int(fresh[k])
        while name in taken or name in known:
            name = name % (grid.width * grid.height) + 1
        given[k] = name
        taken.add(name)
    return given


def same(one: shapely.Geometry, other: shapely.Geometry) -> bool:
    """Whether two outlines have the same vertices, wherever their rings begin."""
    counts = [shapely.get_num_coordinates(shapely.get_rings(outline)).tolist() for outline in (one, other)]
    return sorted(counts[0]) == sorted(counts[1]) and bool(shapely.hausdorff_distance(one, other) < SAME)


def _alike(one: shapely.Geometry, other: shapely.Geometry) -> bool:
    """Whether two outlines cover nearly the same."""
    both = shapely.area(shapely.intersection(one, other))
    return bool(both >= ALIKE * (shapely.area(one) + shapely.area(other) - both))


def edited(
    ids: np.ndarray, outlines: np.ndarray, before: pa.Table, corners: pa.Table, grid: Grid
) -> tuple[pa.Table, pa.Table]:
    """Sections after `stitch.SECTIONS`, by id, and the corners; `before` is what was stitched.

    Corners that belonged to a section that was touched are free again, and the height map's sums over its old outline are gone
    unless the new one is much like it (`ALIKE`); how far walls lift it stays.
    """
    row_of = {section: k for k, section in enumerate(before["section_id"].to_pylist())}
    old = shapely.from_wkb(before["outline"].to_numpy(zero_copy_only=False))
    ids = named(ids, outlines, set(row_of), grid)
    order = np.argsort(ids)
    ids, outlines = ids[order], shapely.orient_polygons(outlines[order])
    rows = [row_of.get(int(k)) for k in ids]
    touched = np.array(
        [r is None or not same(old[r], o) for r, o in zip(rows, outlines, strict=True)],
        bool,
    )
    edge = touches_edge(outlines, grid)
    column = {name: before[name].to_pylist() for name in SECTIONS.names}
    values: dict[str, list] = {name: [] for name in SECTIONS.names}
    for k, row in enumerate(rows):
        found = {"section_id": int(ids[k]), "outline": shapely.to_wkb(outlines[k]), "score": 1.0, "split": 2}
        found |= {"edge": bool(edge[k]), "void": False, "owner": 0, "sums": EMPTY}
        if row is not None:
            found |= {name: column[name][row] for name in ("score", "split", "void")}
            heights = column["sums"][row][:LIFT] if _alike(old[row], outlines[k]) else EMPTY[:LIFT]
            found["sums"] = [*heights, *column["sums"][row][LIFT:]]
        if not touched[k]:
            found = {name: column[name][row] for name in SECTIONS.names}
        for name, value in found.items():
            values[name].append(value)
    table = pa.table([pa.array(values[f.name], f.type) for f in SECTIONS], schema=SECTIONS)
    owner = corners["owner"].to_numpy()
    kept = np.where(np.isin(owner, table["owner"].to_numpy()), owner, 0)
    return table, corners.set_column(corners.column_names.index("owner"), "owner", pa.array(kept, pa.int64()))


def main(argv: list[str] | None = None) -> None:
    """Take sections corrected by hand instead of those that were stitched."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.edited", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--layer", required=True, help="the edited layer: roof_sections_image of a GeoPackage")
    parser.add_argument("--stitched", required=True, help="stitched/sections.parquet")
    parser.add_argument("--found", nargs="*", default=[], help="corners.parquet of every block")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--left-out", nargs="*", default=[], help="blocks that the city is made without")
    parser.add_argument("--reach", type=float, required=True, help="how far corners may lie from their section, px")
    parser.add_argument("--sections", required=True, help="out: sections of all blocks")
    parser.add_argument("--corners", required=True, help="out: corners of all blocks")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    tiling = Tiling(args.tile, args.margin, args.block)
    before = store.read_table(args.stitched)
    corners = distinct_corners(pa.concat_tables([CORNERS.empty_table(), *(store.read_table(f) for f in args.found)]))
    sections, corners = edited(*read(args.layer, facts.grid), before, corners, facts.grid)
    outlines = shapely.from_wkb(sections["outline"].to_numpy(zero_copy_only=False))
    block_of = owner_blocks(sections["section_id"].to_numpy(), facts.grid, tiling)
    tree = shapely.STRtree(shapely.points(np.stack([corners["col"].to_numpy(), corners["row"].to_numpy()], axis=1)))
    by_block, near = {}, {}
    for block in tiling.blocks(facts.grid.width, facts.grid.height):
        mine = np.flatnonzero((block_of == (block.row, block.col)).all(axis=1))
        by_block[block.name] = sections.take(pa.array(mine))
        reached = (
            np.unique(tree.query(outlines[mine], predicate="dwithin", distance=args.reach)[1]) if len(mine) else mine
        )
        near[block.name] = corners.take(pa.array(reached))
    if lost := {name: len(by_block[name]) for name in args.left_out if len(by_block[name])}:
        print(
            f"warning: sections {args.layer}: {sum(lost.values())} in {', '.join(lost)} are left out, as these blocks failed",
            file=sys.stderr,
        )
    store.write_by_block(args.sections, by_block)
    store.write_by_block(args.corners, near)


if __name__ == "__main__":
    cli.run(main)
