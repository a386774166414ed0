"""Own: training samples of a user's raster and annotation, and their split into training, validation and testing.

In: a raster, its terrain and angles, and either roof sections with heights (PolygonZ, drawn where they are seen or where they
stand, as `kibs_steps.truth` reads them: height = z − DTM at the ground-corrected position), or plain outlines of buildings as
seen (roofs known, sections, corners and heights not), or no annotation but a model whose guesses stand in for outlines
(`learn.guessed`; all tiles are for training then). Out, below `--out`: `training/`, `validation/`, `testing/` with one
`learn.samples.Sample` per tile (npz); `truth.gpkg`, the annotation with its column `split`; `own.json`, which records inputs,
rule, seed and counts. The same inputs and seed give the same tiles in the same sets.

Two splits, 60/20/20. `shuffle` is the paper's: tiles in random order; neighbours share roofs and margins, so its test set is
easier than a new place. `blocks` draws squares of tiles instead and leaves out training tiles within a buffer of the others.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, evaluate, fingerprint, metrics, sources, store, tiles, truth
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.georeference import SAME_GSD
from kibs_steps.grid import Window
from kibs_steps.learn import dataset, guessed
from kibs_steps.learn.samples import CORRECTED, UNKNOWN, Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import runtime
from kibs_steps.scene import Scene
from kibs_steps.simulate import rendering
from kibs_steps.truth import Truth

SPLITS = ("training", "validation", "testing")
SHARES = (0.6, 0.2, 0.2)
LEFT_OUT = -1  # in the buffer between training and the other sets
GUESSED = 200  # most tiles that a model guesses, at some seconds each
DOUBT = 3  # px about a building's outline in which nobody knows whether there is a corner


class NothingToLearn(KibsError):
    """Data of which no training tile can be made."""


class Place(NamedTuple):
    """A tile of the training grid: its row and column there, and its window (px)."""

    row: int
    col: int
    window: Window


def places(width: int, height: int, side: int) -> list[Place]:
    """Tiles of `side` px that cover a grid without overlap; the last ones are moved in so that none sticks out.

    Raises `NothingToLearn` for a grid smaller than a tile.
    """
    if min(width, height) < side:
        raise NothingToLearn(f"the raster is {width}×{height} px on the model grid, a training tile {side} px")
    rows, cols = -(-height // side), -(-width // side)
    return [
        Place(i, j, Window(min(j * side, width - side), min(i * side, height - side), side, side))
        for i in range(rows)
        for j in range(cols)
    ]


def shuffled(count: int, seed: int) -> NDArray[np.int64]:
    """The paper's split (count,): codes 0, 1, 2 of tiles in random order, shares exact to a tile."""
    code = np.empty(count, np.int64)
    ends = np.rint(np.cumsum(SHARES) * count).astype(int)
    code[np.random.default_rng(seed).permutation(count)] = np.searchsorted(ends, np.arange(count), side="right")
    return code


def in_blocks(found: list[Place], seed: int, block: int, buffer: int) -> NDArray[np.int64]:
    """The split by squares of `block` × `block` tiles: codes (count,), LEFT_OUT for training and validation tiles within
    `buffer` px of a tile of a later set."""
    squares = sorted({(p.row // block, p.col // block) for p in found})
    drawn = dict(zip(squares, shuffled(len(squares), seed).tolist(), strict=True))
    code = np.array([drawn[p.row // block, p.col // block] for p in found])
    corner = np.array([(p.window.col, p.window.row) for p in found])
    side = found[0].window.width
    for own in (0, 1):
        mine, others = np.flatnonzero(code == own), np.flatnonzero(code > own)
        gap = np.abs(corner[mine, None] - corner[None, others]).max(axis=2, initial=0) - side
        code[mine[(gap < buffer).any(axis=1)]] = LEFT_OUT
    return code


def section_sample(scene: Scene, sections: Truth, window: Window, unknown: NDArray[np.bool_]) -> Sample:
    """One tile with its sections, seen heights and corners; `unknown` (h, w) is where nothing was annotated."""
    rgb, valid = tiles.read_window(scene, window)
    seen, height = truth.visible_labels(sections, scene, window.grown(2))
    vertices = metrics.merge_corners(evaluate.truth_corners(sections, seen, window))
    seen, height = seen[2:-2, 2:-2], height[2:-2, 2:-2]
    blank = unknown | ~valid
    _, whole = np.unique(np.append(seen.ravel(), 0), return_inverse=True)
    whole = whole[:-1].reshape(seen.shape).astype(np.int32)
    # Of a roof that goes on where nothing is known neither rim nor middle are; it is roof all the same.
    cut = np.unique(whole[cv2.dilate(blank.astype(np.uint8), np.ones((3, 3))) > 0])
    labels = np.where(blank | np.isin(whole, cut[cut > 0]), -1, whole).astype(np.int32)
    roof = (whole > 0) & ~blank
    place = vertices.place - [window.col, window.row]
    shown = vertices.seen.copy()
    row, col = np.clip(np.floor(place[:, ::-1]).astype(int), 0, window.width - 1).T
    shown &= ~blank[row, col]
    return Sample.ground(rgb)._replace(
        labels=labels,
        roof=np.where(blank, UNKNOWN, roof).astype(np.uint8),
        height=np.where(roof, height, np.nan).astype(np.float32),
        surface=np.where(roof, rendering.ON_ROOF, UNKNOWN).astype(np.uint8),
        corners=place[shown].astype(np.float32),
        corner_heights=vertices.height[shown].astype(np.float32),
        corners_known=(~blank).astype(np.uint8),
        geometry=geometry_of(scene),
    )


def building_sample(scene: Scene, outlines: NDArray[np.object_], window: Window, unknown: NDArray[np.bool_]) -> Sample:
    """One tile of which only the buildings are known; outlines in image coordinates (px)."""
    rgb, valid = tiles.read_window(scene, window)
    building = drawn(outlines, window)
    blank = unknown | ~valid
    near = cv2.dilate(building.astype(np.uint8), np.ones((2 * DOUBT + 1,) * 2)) > 0
    return Sample.ground(rgb)._replace(
        labels=np.where(blank | building, -1, 0).astype(np.int32),
        roof=np.where(blank, UNKNOWN, building).astype(np.uint8),
        surface=np.where(building & ~blank, rendering.ON_ROOF, UNKNOWN).astype(np.uint8),
        corners_known=(~(near | blank)).astype(np.uint8),
        geometry=geometry_of(scene),
    )


def geometry_of(scene: Scene) -> NDArray[np.float32]:
    """The networks' geometry input (6,) of a scene."""
    lean = scene.view and scene.view.lean
    return runtime.geometry_vector(lean, scene.sun and scene.sun.lean, scene.grid.gsd)[0]


def drawn(outlines: NDArray[np.object_], window: Window) -> NDArray[np.bool_]:
    """Which pixels (h, w) of a window have their centre in one of the outlines (px)."""
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    near = outlines[shapely.STRtree(outlines).query(shapely.box(*_bounds(window)))] if len(outlines) else outlines
    if not len(near):
        return np.zeros((window.height, window.width), bool)
    place = Affine.translation(window.col, window.row)
    return rasterize(near, out_shape=(window.height, window.width), transform=place, dtype=np.uint8) > 0


def _bounds(window: Window) -> tuple[int, int, int, int]:
    return window.col, window.row, window.col + window.width, window.row + window.height


def outlines_on(scene: Scene, path: str | Path, called: str) -> NDArray[np.object_]:
    """Polygons of a vector file, `called` as the setting that names it, in image coordinates (px), as they are drawn: nothing is
    moved by the view.

    Raises `NoOverlap` where none lies in the raster.
    """
    layer = truth.read_layer(path, "image", called)
    flat = layer._replace(polygons=shapely.force_3d(shapely.force_2d(layer.polygons), 0.0))
    on_grid = truth.to_grid(flat, scene.grid)
    found = shapely.transform(shapely.force_2d(on_grid), scene.grid.to_image)
    if not shapely.intersects(found, shapely.box(0, 0, scene.grid.width, scene.grid.height)).any():
        raise truth.NoOverlap(f"{called} {path}: no polygon lies in {scene.raster}: check the layer's CRS and place")
    return found


def codes_of(points: NDArray[np.float64], found: list[Place], code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Split of image positions (n, 2 px): that of the first tile that holds them; 2 outside all tiles and in the buffer."""
    split = np.full(len(points), 2, np.int64)
    for place, own in reversed(list(zip(found, code.tolist(), strict=True))):
        left, top, right, bottom = _bounds(place.window)
        col, row = points.T
        split[(col >= left) & (col < right) & (row >= top) & (row < bottom)] = own if own >= 0 else 2
    return split


class Teacher(NamedTuple):
    """A model whose guesses are learned: what it sees of a window, and its licence."""

    glance: guessed.Glance
    licence: str


def teaching(path: str | Path, scene: Scene, side: int) -> Teacher:
    """A dense model for sections that looks at samples of `side` px of a scene. Raises `ContractMismatch` for another model,
    `NothingToLearn` for another GSD, or samples that are larger than its tile."""
    model = contracts.load(path, "sections")
    if model.contract["head"] != "dense":
        raise contracts.ContractMismatch(f"{path} gives no roof probability: --guess takes a dense model for sections")
    if abs(scene.grid.gsd / model.contract["gsd"] - 1) > SAME_GSD:
        raise NothingToLearn(
            f"{path} is for {model.contract['gsd']:g} m per px, the tiles are to be of {scene.grid.gsd:g}: give one for that"
        )
    if side > model.contract["tile"]:
        raise NothingToLearn(f"--tile {side}: {path} looks at {model.contract['tile']} px: make samples no larger")
    network = runtime.open_network(model, geometry_of(scene)[None])
    return Teacher(guessed.glancing(scene, network, model.contract["tile"]), model.contract["trained_on"]["licence"])


def drawn_places(found: list[Place], seed: int, most: int = GUESSED) -> list[Place]:
    """Tiles to guess: all, or of many `most` drawn at random, in their order."""
    kept = np.random.default_rng(seed).permutation(len(found))[:most]
    return [found[i] for i in sorted(kept.tolist())]


def write_truth(path: Path, sections: Truth, scene: Scene, split: NDArray[np.int64]) -> None:
    """The annotation where it stands, absolute heights, with the split of each section: `truth=` of a later evaluation."""
    import geopandas
    import pyogrio

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2000-01-01T00:00:00.000Z"})
    frame = geopandas.GeoDataFrame(
        {"section_id": sections.ids, "split": split}, geometry=list(sections.standing), crs=scene.grid.crs
    )
    with store.whole(path, summed=False) as temporary:
        temporary.unlink()
        pyogrio.write_dataframe(frame, temporary, layer="sections_map", driver="GPKG", geometry_type="Polygon Z")


def record_of(
    args: argparse.Namespace,
    scene: Scene,
    rule: str,
    code: NDArray[np.int64],
    heights: list[NDArray[np.float32]],
    teacher: Teacher | None,
) -> dict[str, Any]:
    """`own.json`: what the samples were made of, their split by `rule` and `code` (one of each tile), angles, and the moments of
    the training corners' `heights` (m; of each tile)."""
    known = np.concatenate([*heights, np.zeros(0, np.float32)])
    known = known[np.isfinite(known)]
    counts = {name: int((code == i).sum()) for i, name in enumerate(SPLITS)} | {"left_out": int((code < 0).sum())}
    cache = args.out / "fingerprints.json"
    record = {
        "raster": sources.content(sources.place(args.raster), cache),
        "dtm": args.dtm if _is_number(args.dtm) else sources.content(sources.place(args.dtm), cache),
        "annotation": fingerprint.of_source(args.truth or args.buildings or args.guess, cache),
        "annotated": fingerprint.of_source(args.annotated, cache) if args.annotated else None,
        "aoi": fingerprint.of_source(args.aoi, cache) if args.aoi and Path(args.aoi).exists() else args.aoi,
        "read": [args.bands, args.projection_height, args.truth_frame, args.truth_z],
        "split": {"rule": rule, "seed": args.seed, "shares": SHARES, "tile": args.tile, "tiles": counts}
        | ({"square": args.square, "buffer": args.buffer} if rule == "blocks" else {}),
        "gsd": args.gsd,
        "view": scene.view and [scene.view.azimuth, scene.view.elevation],
        "sun": scene.sun and [scene.sun.azimuth, scene.sun.elevation],
        "corners": {
            "count": len(known),
            "mean_height": float(known.mean()) if len(known) else None,
            "sigma": float(known.std()) if len(known) else None,
        },
    }
    return {**record, "licence": teacher.licence} if teacher else record


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    """The options of `main`."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.own", description=main.__doc__)
    parser.add_argument("--raster", required=True)
    parser.add_argument("--dtm", required=True, help="terrain: a file, or one height in m")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--truth", help="roof sections with heights")
    what.add_argument("--buildings", help="outlines of buildings as seen in the raster, without sections")
    what.add_argument("--guess", help="no annotation: a dense model for sections (ONNX), whose sure roofs are learned")
    parser.add_argument("--truth-frame", choices=truth.FRAMES, default="map")
    parser.add_argument("--truth-z", choices=truth.VERTICAL, default="absolute")
    parser.add_argument("--annotated", help="polygons outside which nothing was annotated")
    for key in ("view", "sun"):
        parser.add_argument(f"--{key}-azimuth", type=float)
        parser.add_argument(f"--{key}-elevation", type=float)
    parser.add_argument("--projection-height", type=float)
    parser.add_argument("--bands", type=lambda text: tuple(map(int, text.split(","))))
    parser.add_argument("--aoi")
    parser.add_argument("--gsd", type=float, default=dataset.GSD, help="of the models to train, m")
    parser.add_argument("--tile", type=int, default=320, help="side of a sample, px")
    parser.add_argument("--split", choices=["shuffle", "blocks"], default="blocks")
    parser.add_argument("--seed", type=int, default=0, help="of the split")
    parser.add_argument("--square", type=int, default=4, help="side of a block of tiles that stay together")
    parser.add_argument("--buffer", type=int, default=64, help="px between training and other sets (blocks)")
    parser.add_argument("--out", required=True, type=Path)
    args = parser.parse_args(argv)
    if args.guess and args.annotated:
        parser.error("--annotated goes with --truth or --buildings: of what a model guesses nothing is annotated")
    return args


def main(argv: list[str] | None = None) -> None:
    """Make training samples of a raster and its annotation."""
    args = _arguments(argv)
    if (corrected := args.out / CORRECTED).exists():
        raise NothingToLearn(
            f"{corrected}: the samples there were corrected by hand and would be lost: choose another --out (train.own: name), "
            f"or delete {args.out}"
        )
    dtm = float(args.dtm) if _is_number(args.dtm) else args.dtm
    scene = scenes.build(
        args.out.name,
        args.raster,
        dtm,
        args.gsd,
        args.out / "scene",
        bands=args.bands,
        aoi=args.aoi,
        view=(args.view_azimuth, args.view_elevation),
        sun=(args.sun_azimuth, args.sun_elevation),
        projection_height=args.projection_height,
    )
    found = places(scene.grid.width, scene.grid.height, args.tile)
    annotated = outlines_on(scene, args.annotated, "annotated") if args.annotated else None
    if annotated is not None:  # the shares are those of what is known
        found = [place for place in found if drawn(annotated, place.window).any()]
        if not found:
            raise NothingToLearn(
                f"{args.annotated} covers no pixel of {args.raster}: draw areas within which every roof is drawn"
            )
    rule = "none" if args.guess else args.split
    teacher = teaching(args.guess, scene, args.tile) if args.guess else None
    if teacher:
        found = drawn_places(found, args.seed)
        code = np.zeros(len(found), np.int64)
    else:
        blocks = rule == "blocks"
        code = in_blocks(found, args.seed, args.square, args.buffer) if blocks else shuffled(len(found), args.seed)
        if not (code == 0).any():
            raise NothingToLearn(
                f"{args.raster}: none of its {len(found)} tiles is for training (--split {rule} --seed {args.seed}): choose "
                "--split shuffle (split: shuffle), or another seed"
            )
    sections, buildings = None, np.zeros(0, object)
    if args.truth:
        layer = truth.read_layer(args.truth, args.truth_frame)
        store.write_table(args.out / "scene/truth.parquet", truth.table(layer, scene, args.truth_frame, args.truth_z))
        sections = truth.read(args.out / "scene/truth.parquet", scene)
    elif args.buildings:
        buildings = outlines_on(scene, args.buildings, "buildings")
    for name in SPLITS:  # tiles of an earlier cut would be of another set now
        shutil.rmtree(args.out / name, ignore_errors=True)
    heights = []
    roofs = 0
    for number, (place, own) in enumerate(zip(found, code.tolist(), strict=True)):
        if own == LEFT_OUT:
            continue
        window = place.window
        unknown = np.zeros((window.height, window.width), bool) if annotated is None else ~drawn(annotated, window)
        if teacher:
            sample = guessed.sample(teacher.glance, window, geometry_of(scene))
        elif sections is None:
            sample = building_sample(scene, buildings, window, unknown)
        else:
            sample = section_sample(scene, sections, window, unknown)
        if (sample.roof == UNKNOWN).all() and not sample.corners_known.any():
            code[number] = LEFT_OUT
            continue
        roofs += int((sample.roof == 1).sum())
        if own == 0:
            heights.append(sample.corner_heights)
        sample.save(args.out / SPLITS[own] / f"r{place.row:03d}c{place.col:03d}.npz")
    if teacher and not roofs:
        raise NothingToLearn(f"{args.guess} is sure of no roof in {args.raster}: give another model, or an annotation")
    if sections is not None:
        middle = shapely.get_coordinates(shapely.point_on_surface(shapely.force_2d(sections.seen)))
        write_truth(args.out / "truth.gpkg", sections, scene, codes_of(middle, found, code))
    record = record_of(args, scene, rule, code, heights, teacher)
    store.write_json(args.out / "own.json", record, summed=False)
    counts = record["split"]["tiles"]
    print(f"{args.out}: {', '.join(f'{n} {name}' for name, n in counts.items())} tiles")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


if __name__ == "__main__":
    cli.run(main)
