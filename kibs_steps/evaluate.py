"""Evaluate: what was found against the truth, with metrics that can be compared and the paper's beside them.

In: `truth.parquet`, `labels.tif`, `heights.tif`, section tables, corner tables. Out: `evaluation.json`, a table, a picture.

A pixel is **found** where truth and prediction both say roof. A section is **matched** where a truth section and a
predicted one overlap with IoU ≥ 0.5, each used once, best score first. Truth is what can be *seen* (`truth.visible_labels`):
roofs hidden behind walls are nobody's miss. The raster is gone through window by window; only counts are kept, so memory does
not grow with it. Quantiles are read from histograms of 1 cm.
"""

from __future__ import annotations

import argparse
import csv
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, metrics, store, sums, truth
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.scene import Scene
from kibs_steps.truth import Truth

SPLITS = ("training", "validation", "testing")  # by code; what has none is testing
HEIGHT_EDGES = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 30.0)  # m above ground; the last bin is open
SIDE = 1024  # px: side of the windows
CACHE = 64  # MB that GDAL may keep; its default grows with the machine

PAPER_TABLES = {
    "caveats": [
        "The paper's IoU is recall (hits / truth pixels); compare it with paper_iou, not with iou.",
        "The paper's accuracy is 100 - mean absolute percentage error; compare it with paper_accuracy.",
        "The paper's difference cells equal (1 - accuracy) x mean roof height; compare them with paper_difference.",
        "The Mourmelon MSE is smaller than the squared difference in all columns, which no errors can be.",
        "The paper's truth went through the same lossy post-processing as its prediction; ours is the annotation itself.",
    ],
    "columns": list(SPLITS),
    "mourmelon": {
        "mean_roof_height": 6.36,
        "paper_iou": [0.8856, 0.8696, 0.8855],
        "paper_accuracy": [76.87, 74.03, 74.85],
        "paper_difference": [1.47, 1.65, 1.60],
        "mse": [1.99, 2.51, 2.35],
    },
    "sissonne": {
        "mean_roof_height": 7.53,
        "paper_iou": [0.8867, 0.7349, 0.7521],
        "paper_accuracy": [74.28, 71.08, 72.57],
        "paper_difference": [1.94, 2.18, 2.06],
        "mse": [7.21, 8.29, 7.41],
    },
}


class RastersDisagree(KibsError):
    """Predicted rasters that do not lie on the scene's grid."""


class Reading(NamedTuple):
    """What one pass over the windows leaves: pairs, errors of found pixels and of all truth pixels, truth corners, and
    small images for the picture."""

    pairs: metrics.Pairs
    found: metrics.Errors
    everything: metrics.Errors
    corners: metrics.Corners
    truth_small: NDArray[np.int32]
    labels_small: NDArray[np.int64]
    error_small: NDArray[np.float32]


def read_through(scene: Scene, sections: Truth, labels: str, heights: str, fallback: float, longest: int) -> Reading:
    """Go through truth and prediction window by window; `longest` px bounds the small images."""
    import rasterio
    from rasterio.windows import Window as RasterWindow

    grid = scene.grid
    step = max(1, -(-max(grid.width, grid.height) // longest))
    shape = (-(-grid.height // step), -(-grid.width // step))
    small = (np.zeros(shape, np.int32), np.zeros(shape, np.int64), np.full(shape, np.nan, np.float32))
    n_groups = len(SPLITS) * len(HEIGHT_EDGES)
    split_of = _lookup(sections.ids, sections.split, 2)
    pairs, corners = [], []
    found, everything = metrics.no_errors(n_groups), metrics.no_errors(n_groups)
    for path in (labels, heights):
        sums.check(path)
    with rasterio.Env(GDAL_CACHEMAX=CACHE), rasterio.open(labels) as label_file, rasterio.open(heights) as height_file:
        for file in (label_file, height_file):
            _check_grid(file, grid)
        for window in grid.windows(SIDE):
            place = RasterWindow(window.col, window.row, window.width, window.height)
            predicted, z = label_file.read(1, window=place), height_file.read(1, window=place)
            seen, true = truth.visible_labels(sections, scene, window.grown(2))
            corners.append(truth_corners(sections, seen, window))
            seen, true = seen[2:-2, 2:-2], true[2:-2, 2:-2]
            pairs.append(metrics.count_pairs(seen, predicted))

            roof = seen > 0
            height, answer = true[roof].astype(float), z[roof].astype(float)
            bins = np.clip(np.searchsorted(HEIGHT_EDGES, height, side="right") - 1, 0, None)
            group = split_of(seen[roof]) * len(HEIGHT_EDGES) + bins
            hit = (predicted[roof] > 0) & np.isfinite(answer)
            part = metrics.tally(group[hit], answer[hit], height[hit], fallback, n_groups)
            found = metrics.Errors(*map(np.add, found, part))
            part = metrics.tally(group, np.where(hit, answer, 0.0), height, fallback, n_groups)
            everything = metrics.Errors(*map(np.add, everything, part))

            error = np.where(roof & (predicted > 0), z - true, np.nan)
            rows, cols = (slice(-start % step, None, step) for start in (window.row, window.col))
            r0, c0 = -(-window.row // step), -(-window.col // step)
            for image, values in zip(small, (seen, predicted, error), strict=True):
                some = values[rows, cols]
                image[r0 : r0 + some.shape[0], c0 : c0 + some.shape[1]] = some
    vertices = metrics.Corners(*map(np.concatenate, zip(*corners, strict=True)))
    return Reading(metrics.merge_pairs(pairs), found, everything, metrics.merge_corners(vertices), *small)


def _check_grid(file: Any, grid: Grid) -> None:
    same = (file.width, file.height) == (grid.width, grid.height)
    if not (same and file.transform.almost_equals(grid.transform, 1e-6)):
        raise RastersDisagree(
            f"{file.name} ({file.width}×{file.height} px) does not lie on the scene's grid ({grid.width}×{grid.height} px at "
            f"{grid.x0:.2f}, {grid.y0:.2f}): evaluate the rasters this scene published"
        )


def _lookup(ids: NDArray[np.int64], values: NDArray, missing: Any):
    """A function from ids (n,) to values (n,); `missing` for what is not there."""
    order = np.argsort(ids, kind="stable")
    ids, values = np.append(ids[order], np.iinfo(np.int64).max), np.append(values[order], missing)

    def of(wanted: NDArray) -> NDArray:
        place = np.searchsorted(ids, wanted)
        return np.where(ids[place] == wanted, values[place], missing)

    return of


def truth_corners(sections: Truth, seen: NDArray[np.int32], window: Window) -> metrics.Corners:
    """The corners of truth sections in a window. One can be seen if its section shows within a pixel of it.

    `seen` are labels of the window grown by 2 px.
    """
    near = sections.near(window)
    if not len(near.ids):
        return metrics.Corners(np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool))
    rings, owner = shapely.get_rings(near.seen, return_index=True)
    points, ring = shapely.get_coordinates(rings, include_z=True, return_index=True)
    closing = np.append(ring[1:] != ring[:-1], True)
    points, ids = points[~closing], near.ids[owner[ring[~closing]]]
    col, row = np.floor(points[:, :2]).astype(np.int64).T
    inside = (col >= window.col) & (col < window.col + window.width)
    inside &= (row >= window.row) & (row < window.row + window.height)
    points, ids, col, row = points[inside], ids[inside], col[inside] - window.col + 2, row[inside] - window.row + 2
    shows = np.zeros(len(ids), bool)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            shows |= seen[row + dr, col + dc] == ids
    return metrics.Corners(points[:, :2], points[:, 2], shows)


def read_sections(paths: list[str]) -> tuple[metrics.Predicted, NDArray[np.object_]]:
    """Predicted sections of all blocks, by id, and their outlines (px)."""
    columns = ["section_id", "score", "split", "plane_a", "plane_b", "status", "outline"]
    rows = pa.concat_tables([store.read_table(path, columns) for path in paths]).sort_by("section_id")
    c = {name: rows[name].to_numpy() for name in columns}
    split = np.where(np.isin(c["split"], (0, 1)), c["split"], 2).astype(np.int64)
    gradient = np.column_stack([c["plane_a"], c["plane_b"]]).astype(float)
    found = metrics.Predicted(c["section_id"], c["score"].astype(float), split, gradient, c["status"])
    return found, shapely.from_wkb(c["outline"])


def read_corners(paths: list[str]) -> metrics.Corners:
    """Found corners of all blocks, each once however many sections it was filed to, at the mean of its heights there."""
    columns = ["col", "row", "height"]
    rows = pa.concat_tables([store.read_table(path, columns) for path in paths])
    values = np.column_stack([rows[name].to_numpy() for name in columns]).astype(float)
    place, at, count = np.unique(values[:, :2], axis=0, return_inverse=True, return_counts=True)
    height = np.bincount(at.ravel(), values[:, 2], len(place)) / count
    return metrics.Corners(place, height, np.ones(len(place), bool))


def evaluation(
    reading: Reading, sections: Truth, predicted: metrics.Predicted, corners: metrics.Corners | None, fallback: float
) -> dict[str, Any]:
    """All figures of one scene, after PAPER's "Metrics"."""
    pairs, n_bins = reading.pairs, len(HEIGHT_EDGES)
    ids = np.unique(pairs.predicted[pairs.predicted > 0])
    score = _lookup(predicted.ids, predicted.score, 0.0)(ids)
    over = metrics.overlaps(pairs, score)
    split_t = _lookup(sections.ids, sections.split, 2)(over.truth)
    split_p = _lookup(predicted.ids, predicted.split, 2)(over.predicted)
    largest = np.lexsort((over.iou, over.second))  # what overlaps a truth section belongs to its split
    split_p[over.second[largest]] = split_t[over.first[largest]]
    pair_split = np.where(
        pairs.truth > 0,
        _lookup(over.truth, split_t, 2)(pairs.truth),
        _lookup(over.predicted, split_p, 2)(pairs.predicted),
    )

    everything = np.ones(len(over.truth), bool), np.ones(len(over.predicted), bool)
    figures: dict[str, Any] = {
        "pixels": {"all": metrics.pixel_figures(pairs)},
        "sections": {"all": metrics.section_figures(over, score, *everything)},
    }
    for code, name in enumerate(SPLITS):
        figures["pixels"][name] = metrics.pixel_figures(pairs, pair_split == code)
        figures["sections"][name] = metrics.section_figures(over, score, split_t == code, split_p == code)
    hidden = int(np.isin(sections.ids, over.truth, invert=True).sum())
    figures["sections"]["all"]["hidden"] = hidden

    for name, errors in (("found", reading.found), ("all_truth", reading.everything)):
        group = np.arange(len(errors.pixels))
        by_split = {
            split: metrics.height_figures(errors.of(group // n_bins == code)) for code, split in enumerate(SPLITS)
        }
        by_bin = {label: metrics.height_figures(errors.of(group % n_bins == i)) for i, label in enumerate(bin_names())}
        figures.setdefault("heights", {})[name] = {
            "all": metrics.height_figures(errors.of(np.s_[:])),
            **by_split,
            **by_bin,
        }

    figures["planes"] = matched_planes(over, sections, predicted)
    if corners is not None:
        figures["corners"] = metrics.corner_figures(reading.corners, corners)
    figures["baseline"] = {"answer": fallback, "meaning": "this height above ground everywhere"}
    figures["paper"] = PAPER_TABLES
    return figures


def bin_names() -> list[str]:
    """Names of the height bins."""
    ends = [f"{edge:g}" for edge in HEIGHT_EDGES]
    return [f"{low}-{high} m" for low, high in pairwise(ends)] + [f"over {ends[-1]} m"]


def matched_planes(over: metrics.Overlaps, sections: Truth, predicted: metrics.Predicted) -> dict[str, Any]:
    """Plane errors of the matched sections: all, and by status."""
    place_t = _lookup(sections.ids, np.arange(len(sections.ids)), -1)(over.truth[over.first[over.matched]])
    place_p = _lookup(predicted.ids, np.arange(len(predicted.ids)), -1)(over.predicted[over.second[over.matched]])
    known = place_p >= 0
    place_t, place_p = place_t[known], place_p[known]
    true = truth.planes_of(sections.standing[place_t])[:, :2]
    found, status = predicted.gradient[place_p], predicted.status[place_p]
    usable = np.isfinite(found).all(axis=1)
    figures = {"all": metrics.plane_figures(true[usable], found[usable])}
    for name in sorted(set(status[usable])):
        figures[name] = metrics.plane_figures(true[usable & (status == name)], found[usable & (status == name)])
    return figures


def rows(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """The figures as a table: one row per group (all, splits, height bins)."""
    table = []
    for group in ("all", *SPLITS, *bin_names()):
        row: dict[str, Any] = {"group": group}
        for kind in ("pixels", "sections", "planes"):
            row |= {f"{kind}_{name}": value for name, value in figures[kind].get(group, {}).items()}
        for kind in ("found", "all_truth"):
            row |= {f"height_{kind}_{name}": value for name, value in figures["heights"][kind][group].items()}
        table.append(row)
    return table


def summary(figures: dict[str, Any]) -> str:
    """The figures that matter in a few lines."""
    pixels, sections = figures["pixels"]["all"], figures["sections"]["all"]
    found, everything = (figures["heights"][kind]["all"] for kind in ("found", "all_truth"))

    def say(value: float | None, unit: str = "", digits: int = 2) -> str:
        return "-" if value is None else f"{value:.{digits}f}{unit}"

    lines = [
        f"roof pixels   IoU {say(pixels['iou'], digits=3)}  precision {say(pixels['precision'], digits=3)}  "
        f"recall (the paper's 'IoU') {say(pixels['recall'], digits=3)}",
        f"sections      AP50 {say(sections['ap50'], digits=3)}  PQ {say(sections['pq'], digits=3)}  "
        f"{sections['matched']} matched of {sections['truth']} true, {sections['predicted']} predicted",
    ]
    for name, one in (("found", found), ("all truth", everything)):
        if one["pixels"]:
            lines.append(
                f"heights       {name}: MAE {say(one['mae'], ' m')}  RMSE {say(one['rmse'], ' m')}  "
                f"bias {say(one['bias'], ' m')}  LE90 {say(one['le90'], ' m')}  "
                f"({say(one['mae_to_baseline'])} of the baseline's MAE)"
            )
    planes = figures["planes"]["all"]
    if planes["sections"]:
        lines.append(
            f"planes        slope {say(planes['slope_mae'], '°', 1)}  azimuth {say(planes['azimuth_mae'], '°', 1)}"
        )
    if "corners" in figures:
        corners = figures["corners"]
        lines.append(f"corners       precision {say(corners['precision'])}  recall {say(corners['recall'])}")
    return "\n".join(lines)


def draw(
    path: str, scene: Scene, reading: Reading, sections: Truth, outlines: NDArray, figures: dict[str, Any]
) -> None:
    """The picture: agreement with both outlines, and the error of heights."""
    from PIL import Image, ImageDraw

    from kibs_steps import picture

    rgb, scale = picture.overview(scene, max(reading.truth_small.shape) if scene.grid.width > 1000 else 1000)
    size = (rgb.shape[1], rgb.shape[0])

    def large(image: NDArray) -> NDArray:
        return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.NEAREST))

    seen, predicted = reading.truth_small > 0, reading.labels_small > 0
    error = large(reading.error_small)
    both, missed, invented = (large(mask) for mask in (seen & predicted, seen & ~predicted, ~seen & predicted))
    grey = np.repeat(rgb.mean(axis=2, keepdims=True), 3, axis=2) * 0.55 + 100
    left, right = rgb * 0.75 + 50, grey.copy()
    colours = {"found": (57, 158, 99), "missed": (46, 98, 178), "not there": (206, 62, 58)}
    for mask, colour in zip((both, missed, invented), colours.values(), strict=True):
        left[mask] = left[mask] * 0.45 + np.array(colour) * 0.55
    known = np.isfinite(error)
    right[known] = picture.ramp(error[known], -3.0, 3.0, picture.DIFFERENCES)
    right[missed] = (120, 120, 120)
    left, right = (np.clip(image, 0, 255).astype(np.uint8) for image in (left, right))

    drawn = [(sections.seen, (255, 255, 255)), (outlines, (250, 215, 60))]
    shapes = np.concatenate([shapely.to_wkb(shapely.force_2d(o)) for o, _ in drawn])
    ink = np.concatenate([np.tile(np.uint8(c), (len(o), 1)) for o, c in drawn])
    panels = [picture.paint(left, shapes, ink, scale, cover=0.0, width=0.8), Image.fromarray(right)]
    one = figures["heights"]["found"]["all"]
    titles = ["white: truth as seen; yellow: predicted", "error of heights where found (grey: missed)"]
    iou, pq = figures["pixels"]["all"]["iou"] or 0.0, figures["sections"]["all"]["pq"] or 0.0
    note = f"IoU {iou:.3f}   PQ {pq:.3f}" + (f"   MAE {one['mae']:.2f} m" if one["pixels"] else "")
    page = picture.sheet(panels, titles, f"{scene.name}: evaluation", note)
    pen = ImageDraw.Draw(page)
    foot = page.height - 28
    picture.swatches(pen, (16, foot), [(colour, name) for name, colour in colours.items()])
    picture.colour_bar(pen, (330, foot), ("-3 m", "+3 m"), picture.DIFFERENCES)
    picture.scale_bar(pen, (610, foot), scale / scene.grid.gsd, 160)
    picture.write(path, page)


def main(argv: list[str] | None = None) -> None:
    """Compare a scene's sections and heights with the truth."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.evaluate", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--truth", required=True, help="truth.parquet")
    parser.add_argument("--labels", required=True, help="labels.tif")
    parser.add_argument("--heights", required=True, help="heights.tif")
    parser.add_argument("--sections", required=True, nargs="+", help="buildings.parquet of all blocks")
    parser.add_argument("--corners", nargs="+", help="filed_corners.parquet of all blocks")
    parser.add_argument("--fallback-height", type=float, default=6.1, help="the baseline's answer everywhere, m")
    parser.add_argument("--out", required=True, help="evaluation.json")
    parser.add_argument("--picture", help="evaluation.png")
    parser.add_argument("--table", help="evaluation.csv")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    sections = truth.read(args.truth, scene)
    predicted, outlines = read_sections(args.sections)
    corners = read_corners(args.corners) if args.corners else None
    reading = read_through(scene, sections, args.labels, args.heights, args.fallback_height, longest=1600)
    figures = evaluation(reading, sections, predicted, corners, args.fallback_height)
    store.write_json(args.out, {"scene": scene.name, **figures})
    if args.table:
        table = rows(figures)
        with store.whole(args.table) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, table[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)
    if args.picture:
        draw(args.picture, scene, reading, sections, outlines, figures)
    print(summary(figures))


if __name__ == "__main__":
    cli.run(main)
