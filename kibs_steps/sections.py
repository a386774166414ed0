"""Sections: every roof section of a block, by the 2D model, tile by tile, joined across the block's inner seams.

A **piece** is what one tile sees of a section inside its own core. Neighbouring tiles see a common strip of 2 × margin px
along their seam; two pieces are **linked**, i.e. are one section, when on that strip each is the other's best match. Links
depend on two tiles alone, so neither the order of work nor the cut into blocks changes the sections (PAPER, reconciliation).

In: `tiles.tif`, the model. Out: `sections.tif` (stack of tile windows, piece labels unique in the block), `pieces.parquet`,
`links.parquet` (inner seams), `seams.npz` (label strips along the block's four sides, for `stitch`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from kibs_steps import cli, raster, scene, store, supposed
from kibs_steps.grid import Block, Grid, Tile, Tiling, Window
from kibs_steps.labels import rims
from kibs_steps.models import scoring

MIN_STRIP_IOU = 0.3  # two views of one section share most of the strip; a neighbour's rim shares a pixel line
SIDES = ("north", "south", "west", "east")
SEAM_RULES = ("overlap", "touch")


WHITE = 250  # of 255, in all bands: clipped
BURNT = 0.5  # share of a tile's data


class View(NamedTuple):
    """What one tile sees: labels (s, s) int32 over its full window, zero outside the data, and a score per label.

    `evidence` (n, 21) is what its core shows of each label (`scoring.evidence`), zero from models that do not tell. Labels begin
    at `used` + 1; some may lie wholly outside the data.
    """

    tile: Tile
    labels: np.ndarray
    scores: np.ndarray
    evidence: np.ndarray
    used: int


def core_of(view: np.ndarray, tile: Tile, margin: int) -> np.ndarray:
    """The core's part of a full-window array (s, s)."""
    return view[margin : margin + tile.core.height, margin : margin + tile.core.width]


def strip(view: np.ndarray, tile: Tile, side: str, margin: int) -> np.ndarray:
    """The 2·margin px wide strip about one side of the tile's core, as that tile sees it, along the core's length."""
    p, w, h = margin, tile.core.width, tile.core.height
    return {
        "north": view[: 2 * p, p : p + w],
        "south": view[h : h + 2 * p, p : p + w],
        "west": view[p : p + h, : 2 * p],
        "east": view[p : p + h, w : w + 2 * p],
    }[side]


def links_across(first: np.ndarray, second: np.ndarray, side: str = "east", rule: str = "overlap") -> np.ndarray:
    """Pairs (n, 2) of labels that are one section, from two tiles' views of the same strip; `side` as the first tile has it.

    Rule `touch` is the paper's (`scan_order.touching`). By rule `overlap` a pair is linked when each label overlaps the other
    more than any other, at an IoU of at least `MIN_STRIP_IOU` on the strip. Ties go to the smaller label.
    """
    if rule == "touch":
        from kibs_steps import scan_order

        return scan_order.touching(first, second, side)
    both = (first > 0) & (second > 0)
    pairs, overlap = np.unique(np.stack([first[both], second[both]], axis=1), axis=0, return_counts=True)
    if not len(pairs):
        return np.zeros((0, 2), np.int64)
    areas = [dict(zip(*np.unique(x[x > 0], return_counts=True), strict=True)) for x in (first, second)]
    best: list[dict[int, int]] = [{}, {}]
    for i in np.lexsort((pairs[:, 1], pairs[:, 0], -overlap)):
        for k in (0, 1):
            best[k].setdefault(int(pairs[i, k]), int(i))
    linked = [
        i
        for i, ((a, b), n) in enumerate(zip(pairs, overlap, strict=True))
        if best[0][int(a)] == best[1][int(b)] == i and n >= MIN_STRIP_IOU * (areas[0][a] + areas[1][b] - n)
    ]
    return pairs[linked].astype(np.int64)


def tile_images(
    rgb: np.ndarray, valid: np.ndarray, tiling: Tiling, block: Block, grid: Grid
) -> Iterator[tuple[Tile, np.ndarray, np.ndarray]]:
    """Every tile of a block image (core grown by the margin; rgb uint8, valid bool): tile, image (s, s, 3), data mask (s, s)."""
    core = tiling.block_core(block, grid.width, grid.height)
    for tile in tiling.tiles(block, grid.width, grid.height):
        yield tile, tile_image(rgb, tile, tiling, core, grid), tile_image(valid, tile, tiling, core, grid, "constant")


def view_of(
    tile: Tile,
    image: np.ndarray,
    outputs: dict[str, np.ndarray] | None,
    contract: dict,
    margin: int,
    data: np.ndarray,
    used: int,
) -> View:
    """What a network's outputs for a tile's image (None: not looked at) mean where there is data; labels from `used` + 1 on."""
    from kibs_steps.models import heads

    if outputs is None:
        return View(tile, np.zeros(data.shape, np.int32), np.zeros(0, np.float32), scoring.none(0), used)
    found = heads.decode_sections(outputs, contract, image)
    labels, shown = np.where(data, found.labels, 0), scoring.none(len(found.scores))
    if contract["head"] == "dense":
        seen = (core_of(a, tile, margin) for a in (labels, rims(labels), image))
        maps = {name: core_of(m.transpose(1, 2, 0), tile, margin).transpose(2, 0, 1) for name, m in outputs.items()}
        shown = scoring.evidence(*seen, maps, len(found.scores), (tile.core.col, tile.core.row))
    return View(tile, np.where(labels > 0, labels + used, 0).astype(np.int32), found.scores, shown, used)


def detect(
    rgb: np.ndarray,
    valid: np.ndarray,
    tiling: Tiling,
    block: Block,
    grid: Grid,
    networks: supposed.Networks,
    contract: dict,
) -> list[View]:
    """Run the 2D model on every tile of a block image (core grown by the margin; rgb uint8, valid bool), told where it is.

    Tiles without data are not run. Labels are numbered through the block, tile after tile.
    """
    views, used = [], 0
    for tile, image, data in tile_images(rgb, valid, tiling, block, grid):
        seen = core_of(data, tile, tiling.margin).any()
        views.append(
            view_of(tile, image, networks(tile.core)(image) if seen else None, contract, tiling.margin, data, used)
        )
        used += len(views[-1].scores)
    return views


def window_in_block(window: Window, core: Window, margin: int) -> Window:
    """A grid window in the pixels of a block image, which starts at the core's corner less the margin."""
    return Window(window.col - core.col + margin, window.row - core.row + margin, window.width, window.height)


def tile_image(
    image: np.ndarray, tile: Tile, tiling: Tiling, core: Window, grid: Grid, beyond: str = "symmetric"
) -> np.ndarray:
    """What a network sees of a tile, (s, s, …), cut from the image of its block (its `core` grown by the margin).

    Beyond the grid it sees the tile's own part of the grid mirrored: repeated border pixels are streaks, which pass for roofs.
    `beyond` is a mode of `numpy.pad`.
    """
    window = tiling.window(tile)
    inside = window.within(grid)
    place = window_in_block(inside, core, tiling.margin)
    part = image[place.row : place.row + place.height, place.col : place.col + place.width]
    top, left = inside.row - window.row, inside.col - window.col
    around = [(top, window.height - top - inside.height), (left, window.width - left - inside.width)]
    return np.pad(part, around + [(0, 0)] * (image.ndim - 2), beyond)


def inner_links(views: list[View], margin: int, rule: str = "overlap") -> np.ndarray:
    """Links (n, 2) across all seams between the given tiles."""
    at = {(v.tile.row, v.tile.col): v for v in views}
    found = [np.zeros((0, 2), np.int64)]
    for (row, col), view in at.items():
        for side, other_side, neighbour in (("east", "west", (row, col + 1)), ("south", "north", (row + 1, col))):
            other = at.get(neighbour)
            if other is not None:
                here = strip(view.labels, view.tile, side, margin)
                there = strip(other.labels, other.tile, other_side, margin)
                found.append(links_across(here, there, side, rule))
    return np.concatenate(found)


def seams(views: list[View], margin: int) -> dict[str, np.ndarray]:
    """The label strips along the block's four sides, tile after tile."""
    rows = sorted({v.tile.row for v in views})
    cols = sorted({v.tile.col for v in views})
    at = {(v.tile.row, v.tile.col): v for v in views}

    def along(side: str) -> np.ndarray:
        if side in ("north", "south"):
            row = rows[0] if side == "north" else rows[-1]
            return np.concatenate([strip(at[row, c].labels, at[row, c].tile, side, margin) for c in cols], axis=1)
        col = cols[0] if side == "west" else cols[-1]
        return np.concatenate([strip(at[r, col].labels, at[r, col].tile, side, margin) for r in rows], axis=0)

    return {side: along(side) for side in SIDES}


PIECES = pa.schema(
    [
        ("label", pa.int64()),
        ("tile_row", pa.int64()),
        ("tile_col", pa.int64()),
        ("score", pa.float64()),
        ("core_area", pa.int64()),
        ("full_area", pa.int64()),
        ("void", pa.bool_()),
        ("outline", pa.binary()),
        ("split", pa.int64()),
        ("owner", pa.int64()),
        ("evidence", pa.list_(pa.float64(), len(scoring.EVIDENCE))),
    ]
)


def pieces(views: list[View], unclear: np.ndarray, tiling: Tiling, core: Window) -> pa.Table:
    """One row per piece: its outline along pixel edges (WKB, image coordinates), areas in px, whether it is void, which is where
    the block is `unclear`.

    `split` and `owner` are for truth that is fed instead of detections: 2 (none) and 0 here. `evidence` as in `View`.
    """
    rows = []
    p = tiling.margin
    for view in views:
        inside = core_of(view.labels, view.tile, p)
        outlines = pixel_outlines(inside, view.tile.core)
        full = np.bincount(view.labels.ravel(), minlength=1)
        own = np.bincount(inside.ravel(), minlength=len(full))
        place = window_in_block(view.tile.core, core, p)
        blank = unclear[place.row : place.row + place.height, place.col : place.col + place.width]
        near_blank = set(np.unique(inside[blank]).tolist())
        for label in np.unique(view.labels[view.labels > 0]).tolist():
            outline, number = outlines.get(label), label - view.used - 1
            rows.append(
                {
                    "label": label,
                    "tile_row": view.tile.row,
                    "tile_col": view.tile.col,
                    "score": float(view.scores[number]),
                    "core_area": int(own[label]),
                    "full_area": int(full[label]),
                    "void": label in near_blank,
                    "outline": outline,
                    "split": 2,
                    "owner": 0,
                    "evidence": view.evidence[number].tolist(),
                }
            )
    return pa.Table.from_pylist(rows, schema=PIECES)


def unclear(
    rgb: np.ndarray, valid: np.ndarray, views: list[View], tiling: Tiling, core: Window, grid: Grid
) -> np.ndarray:
    """Where sections of a block (its `core` with margins) cannot be trusted, bool (h, w): in and beside pixels without data, but
    for those beyond the raster, and in tiles that are burnt out."""
    p = tiling.margin
    block = core.grown(p)
    inside = block.within(grid)
    missing = np.zeros_like(valid)
    part = np.s_[inside.row - block.row : inside.row - block.row + inside.height,
                 inside.col - block.col : inside.col - block.col + inside.width]  # fmt: skip
    missing[part] = ~valid[part]
    # A burnt tile answers for itself: of one in the next block nothing is known here.
    return grown(missing) | burnt_out(rgb, valid, views, tiling, core)


def burnt_out(rgb: np.ndarray, valid: np.ndarray, views: list[View], tiling: Tiling, core: Window) -> np.ndarray:
    """Where the tiles of a block (its `core` with margins) show cloud, snow or glare instead of ground, bool (h, w).

    A tile does when most of its data is clipped to white: a white roof alone never fills a tile of a hundred metres.
    """
    found = np.zeros(valid.shape, bool)
    for view in views:
        place = window_in_block(view.tile.core, core, tiling.margin)
        part = np.s_[place.row : place.row + place.height, place.col : place.col + place.width]
        data = valid[part]
        white = data & (rgb[part] >= WHITE).all(axis=-1)
        found[part] = white.sum() > BURNT * max(data.sum(), 1)
    return found


def grown(mask: np.ndarray) -> np.ndarray:
    """The mask and its 8-neighbours."""
    from scipy import ndimage

    return ndimage.binary_dilation(mask, np.ones((3, 3), bool))


def pixel_outlines(labels: np.ndarray, window: Window) -> dict[int, bytes]:
    """WKB (Multi)Polygon of every label of a window along its pixels' edges, in image coordinates (px)."""
    import shapely
    from rasterio.features import shapes
    from rasterio.transform import Affine

    parts: dict[int, list] = {}
    if labels.any():
        place = Affine.translation(window.col, window.row)
        for shape, value in shapes(labels.astype(np.int32), mask=labels > 0, connectivity=4, transform=place):
            rings = shape["coordinates"]
            parts.setdefault(int(value), []).append(shapely.Polygon(rings[0], rings[1:]))
    return {k: shapely.to_wkb(v[0] if len(v) == 1 else shapely.MultiPolygon(v)) for k, v in parts.items()}


def stack(arrays: dict[tuple[int, int], np.ndarray], side: int) -> np.ndarray:
    """Full-window arrays (s, s[, bands]) of tiles (row, col) laid side by side without overlap."""
    rows = sorted({r for r, _ in arrays})
    cols = sorted({c for _, c in arrays})
    any_array = next(iter(arrays.values()))
    out = np.zeros((len(rows) * side, len(cols) * side, *any_array.shape[2:]), any_array.dtype)
    for (r, c), array in arrays.items():
        i, j = rows.index(r) * side, cols.index(c) * side
        out[i : i + side, j : j + side] = array
    return out


def unstack(image: np.ndarray, tiles: list[Tile], side: int) -> dict[tuple[int, int], np.ndarray]:
    """The inverse of `stack` for the same tiles."""
    row0, col0 = min(t.row for t in tiles), min(t.col for t in tiles)
    return {(t.row, t.col): image[(t.row - row0) * side :, (t.col - col0) * side :][:side, :side] for t in tiles}


def write(
    views: list[View], unclear: np.ndarray, tiling: Tiling, core: Window, rule: str, out: argparse.Namespace
) -> None:
    """Write what the tiles of a block see to the files `out` names: labels, pieces, links, seams."""
    links = inner_links(views, tiling.margin, rule)
    raster.write(out.labels, stack({(v.tile.row, v.tile.col): v.labels.astype(np.uint32) for v in views}, tiling.tile))
    store.write_table(out.pieces, pieces(views, unclear, tiling, core))
    store.write_table(out.links, pa.table({"first": links[:, 0], "second": links[:, 1]}))
    store.write_arrays(out.seams, seams(views, tiling.margin))


def main(argv: list[str] | None = None) -> None:
    """Find the roof sections of one block."""
    from kibs_steps.models import runtime

    parser = argparse.ArgumentParser(prog="python -m kibs_steps.sections", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--tiles", required=True, help="tiles.tif of the block")
    parser.add_argument("--model", required=True, help="models/sections.json")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--supposed", help="supposed.json, where view or sun is not known")
    runtime.add_options(parser)
    parser.add_argument("--seam-rule", choices=SEAM_RULES, default="overlap", help="which pieces are one section")
    parser.add_argument("--labels", required=True, help="out: sections.tif")
    parser.add_argument("--pieces", required=True, help="out: pieces.parquet")
    parser.add_argument("--links", required=True, help="out: links.parquet")
    parser.add_argument("--seams", required=True, help="out: seams.npz")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    model = runtime.from_record(args.model, "sections")
    tiling = Tiling(model.contract["tile"], args.margin, args.block)
    block = tiling.block_of(args.name)
    core = tiling.block_core(block, facts.grid.width, facts.grid.height)
    image = raster.read(args.tiles)
    rgb, valid = image[..., :3], image[..., 3] > 0
    session = runtime.opened(model, args.provider, args.threads, args.looks)
    telling = supposed.telling(facts, args.supposed)
    views = detect(rgb, valid, tiling, block, facts.grid, lambda core: session(telling(core)), model.contract)
    write(views, unclear(rgb, valid, views, tiling, core, facts.grid), tiling, core, args.seam_rule, args)


if __name__ == "__main__":
    cli.run(main, pandas=False)
