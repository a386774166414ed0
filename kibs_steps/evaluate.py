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

from kibs_steps import cli, store, truth
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.scene import Scene
from kibs_steps.truth import Truth

SPLITS = ("training", "validation", "testing")  # by code; what has none is testing
HEIGHT_EDGES = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 30.0)  # m above ground; the last bin is open
MATCH = 0.5  # IoU
LEVEL = 3.0  # deg: below this slope a roof has no azimuth
CORNER_RADIUS = 2.0  # px
TALL = 1.0  # m: relative errors are taken above this height
SIDE = 1024  # px: side of the windows
CACHE = 64  # MB that GDAL may keep; its default grows with the machine
CENTIMETRES = 10_000  # errors beyond ± 100 m fall into the last bin

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


class ImpossibleFigures(KibsError):
    """Error figures that no set of errors can have."""


class Pairs(NamedTuple):
    """How often a truth section (0 none) and a predicted one (0 none) share a pixel; each pair once."""

    truth: NDArray[np.int64]
    predicted: NDArray[np.int64]
    pixels: NDArray[np.int64]


class Errors(NamedTuple):
    """Height errors of pixels (prediction − truth, m) by group; sums (groups,), `histogram` (groups, bins of 1 cm)."""

    pixels: NDArray[np.int64]
    error: NDArray[np.float64]
    absolute: NDArray[np.float64]
    square: NDArray[np.float64]
    height: NDArray[np.float64]
    baseline: NDArray[np.float64]
    tall: NDArray[np.int64]
    relative: NDArray[np.float64]
    histogram: NDArray[np.int64]

    def of(self, groups: NDArray | slice) -> Errors:
        """All pixels of some groups as one."""
        return Errors(*(field[groups].sum(axis=0, keepdims=True) for field in self))


class Predicted(NamedTuple):
    """Predicted sections: id, score (0–1), split, gradient of the plane (m/m), status."""

    ids: NDArray[np.int64]
    score: NDArray[np.float64]
    split: NDArray[np.int64]
    gradient: NDArray[np.float64]
    status: NDArray[np.object_]


class Corners(NamedTuple):
    """Corners: image coordinates (n, 2) px, height above ground (n,) m, and whether they can be seen."""

    place: NDArray[np.float64]
    height: NDArray[np.float64]
    seen: NDArray[np.bool_]


def count_pairs(truth_labels: NDArray, labels: NDArray) -> Pairs:
    """Pairs of two label images of one shape; pixels with neither are left out."""
    either = (truth_labels > 0) | (labels > 0)
    key = (truth_labels[either].astype(np.int64) << 32) | labels[either].astype(np.int64)
    key, pixels = np.unique(key, return_counts=True)
    return Pairs(key >> 32, key & 0xFFFFFFFF, pixels)


def merge_pairs(parts: list[Pairs]) -> Pairs:
    """Pairs of all windows as one."""
    both = np.concatenate([np.stack([p.truth, p.predicted]) for p in parts] or [np.zeros((2, 0), np.int64)], axis=1)
    pixels = np.concatenate([p.pixels for p in parts] or [np.zeros(0, np.int64)])
    key, place = np.unique((both[0] << 32) | both[1], return_inverse=True)
    total = np.zeros(len(key), np.int64)
    np.add.at(total, place, pixels)
    return Pairs(key >> 32, key & 0xFFFFFFFF, total)


def no_errors(groups: int) -> Errors:
    """An empty tally."""
    whole, real = np.zeros(groups, np.int64), np.zeros(groups)
    histogram = np.zeros((groups, 2 * CENTIMETRES + 1), np.int64)
    return Errors(whole, real, real, real, real, real, whole, real, histogram)


def tally(group: NDArray[np.int64], predicted: NDArray, true: NDArray, fallback: float, groups: int) -> Errors:
    """The errors of pixels (n,): `group` index, heights above ground (m), and `fallback`, the baseline's one answer."""
    error = predicted.astype(float) - true
    tall = true > TALL

    def total(values: NDArray, where: NDArray | slice = np.s_[:]) -> NDArray[np.float64]:
        return np.bincount(group[where], values[where], groups)

    centimetre = np.clip(np.rint(error * 100), -CENTIMETRES, CENTIMETRES).astype(np.int64) + CENTIMETRES
    bins = 2 * CENTIMETRES + 1
    return Errors(
        np.bincount(group, minlength=groups),
        total(error),
        total(np.abs(error)),
        total(error**2),
        total(true.astype(float)),
        total(np.abs(fallback - true)),
        np.bincount(group[tall], minlength=groups),
        np.bincount(group[tall], np.abs(error[tall]) / true[tall], groups),
        np.bincount(group * bins + centimetre, minlength=groups * bins).reshape(groups, bins),
    )


def height_figures(errors: Errors) -> dict[str, float | int | None]:
    """MAE, RMSE, MSE, bias, NMAD, LE90 (m), MAPE (%, heights above 1 m) of one group's errors, the baseline's MAE and the
    share of it that remains, and the paper's `paper_accuracy` (%) and `paper_difference` (m).

    Raises `ImpossibleFigures` where MSE < MAE², which cannot be.
    """
    n = int(errors.pixels[0])
    if not n:
        return {"pixels": 0}
    mae, mse = float(errors.absolute[0]) / n, float(errors.square[0]) / n
    if mse < mae**2 * (1 - 1e-9) - 1e-12:
        raise ImpossibleFigures(f"MSE {mse} is below MAE² {mae**2}: the evaluation is wrong, please report it")
    values = (np.arange(2 * CENTIMETRES + 1) - CENTIMETRES) / 100.0
    weight = errors.histogram[0]
    median = _quantile(values, weight, 0.5)
    baseline = float(errors.baseline[0]) / n
    mean_height = float(errors.height[0]) / n
    mape = 100 * float(errors.relative[0]) / int(errors.tall[0]) if errors.tall[0] else None
    return {
        "pixels": n,
        "mae": mae,
        "rmse": mse**0.5,
        "mse": mse,
        "bias": float(errors.error[0]) / n,
        "nmad": 1.4826 * _quantile(np.abs(values - median), weight, 0.5),
        "le90": _quantile(np.abs(values), weight, 0.9),
        "mape": mape,
        "mean_height": mean_height,
        "baseline_mae": baseline,
        "mae_to_baseline": mae / baseline if baseline else None,
        "paper_accuracy": None if mape is None else 100 - mape,
        "paper_difference": None if mape is None else mape / 100 * mean_height,
    }


def _quantile(values: NDArray[np.float64], weight: NDArray[np.int64], share: float) -> float:
    """The smallest value that `share` of the weight does not exceed."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, share * total[-1])])


def pixel_figures(pairs: Pairs, chosen: NDArray[np.bool_] | slice = np.s_[:]) -> dict[str, float | int | None]:
    """IoU = TP/(TP+FP+FN), precision, recall of roof pixels, and `paper_iou`, which is recall under the paper's name."""
    t, p, n = (field[chosen] for field in pairs)
    tp, fp, fn = (int(n[where].sum()) for where in ((t > 0) & (p > 0), (t == 0) & (p > 0), (t > 0) & (p == 0)))
    recall = _ratio(tp, tp + fn)
    figures = {"iou": _ratio(tp, tp + fp + fn), "precision": _ratio(tp, tp + fp), "recall": recall, "paper_iou": recall}
    return {**figures, "true_positive": tp, "false_positive": fp, "false_negative": fn}


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


class Overlaps(NamedTuple):
    """Sections seen and predicted, and their overlaps: ids (sorted), IoU per overlapping pair, and the matched pairs.

    `first`, `second` index `truth` and `predicted`; `matched` marks the pairs that count.
    """

    truth: NDArray[np.int64]
    predicted: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    iou: NDArray[np.float64]
    matched: NDArray[np.bool_]


def overlaps(pairs: Pairs, score: NDArray[np.float64]) -> Overlaps:
    """IoU of all pairs that overlap; `score` (n,) is of the predicted sections in order of their id."""
    ids_t, place_t = np.unique(pairs.truth, return_inverse=True)
    ids_p, place_p = np.unique(pairs.predicted, return_inverse=True)
    area_t, area_p = (np.bincount(place, pairs.pixels) for place in (place_t, place_p))
    both = (pairs.truth > 0) & (pairs.predicted > 0)
    inter = pairs.pixels[both]
    iou = inter / (area_t[place_t[both]] + area_p[place_p[both]] - inter)
    real_t, real_p = ids_t[ids_t > 0], ids_p[ids_p > 0]
    first, second = (
        np.searchsorted(real, ids[both]) for real, ids in ((real_t, pairs.truth), (real_p, pairs.predicted))
    )

    # Without overlaps inside either map an IoU above 0.5 is alone; at 0.5 itself the better score comes first.
    matched = np.zeros(len(iou), bool)
    taken_t, taken_p = np.zeros(len(real_t), bool), np.zeros(len(real_p), bool)
    candidates = np.flatnonzero(iou >= MATCH)
    for i in candidates[np.lexsort((second[candidates], -iou[candidates], -score[second[candidates]]))]:
        if not taken_t[first[i]] and not taken_p[second[i]]:
            matched[i] = taken_t[first[i]] = taken_p[second[i]] = True
    return Overlaps(real_t, real_p, first, second, iou, matched)


def section_figures(
    found: Overlaps, score: NDArray[np.float64], in_truth: NDArray[np.bool_], in_predicted: NDArray[np.bool_]
) -> dict[str, float | int | None]:
    """AP50, mean best IoU, panoptic quality of the chosen truth and predicted sections (masks over `found`'s ids).

    AP50 is the area under the precision envelope at 101 recalls (COCO's rule). PQ = ΣIoU / (TP + FP/2 + FN/2).
    """
    n_truth, n_predicted = int(in_truth.sum()), int(in_predicted.sum())
    best = np.zeros(len(found.truth))
    np.maximum.at(best, found.first, found.iou)
    hit = found.matched & in_truth[found.first]
    quality, n_hit = float(found.iou[hit].sum()), int(hit.sum())
    false = n_predicted - int((found.matched & in_predicted[found.second]).sum())
    return {
        "truth": n_truth,
        "predicted": n_predicted,
        "matched": n_hit,
        "ap50": _average_precision(found, score, in_predicted, n_truth),
        "mean_best_iou": _ratio(float(best[in_truth].sum()), n_truth),
        "pq": _ratio(quality, n_hit + false / 2 + (n_truth - n_hit) / 2),
        "sq": _ratio(quality, n_hit),
        "rq": _ratio(n_hit, n_hit + false / 2 + (n_truth - n_hit) / 2),
    }


def _average_precision(
    found: Overlaps, score: NDArray[np.float64], in_predicted: NDArray[np.bool_], n_truth: int
) -> float | None:
    if not n_truth:
        return None
    right = np.zeros(len(found.predicted), bool)
    right[found.second[found.matched]] = True
    order = np.flatnonzero(in_predicted)
    order = order[np.argsort(-score[order], kind="stable")]
    hits = np.cumsum(right[order])
    precision = np.maximum.accumulate((hits / np.arange(1, len(order) + 1))[::-1])[::-1]
    place = np.searchsorted(hits / n_truth, np.linspace(0, 1, 101) - 1e-12)
    return float(np.append(precision, 0.0)[np.minimum(place, len(precision))].mean())


def plane_figures(true: NDArray[np.float64], found: NDArray[np.float64]) -> dict[str, float | int | None]:
    """Errors (deg) of slope, azimuth and normal of matched planes, given by their gradients (n, 2) in m/m.

    Azimuths are compared where both slopes are at least 3°.
    """
    if not len(true):
        return {"sections": 0}
    slope_t, slope_f = (np.degrees(np.arctan(np.hypot(*g.T))) for g in (true, found))
    steep = (slope_t >= LEVEL) & (slope_f >= LEVEL)
    azimuth_t, azimuth_f = (np.degrees(np.arctan2(-g[steep, 0], -g[steep, 1])) for g in (true, found))
    turn = np.abs((azimuth_f - azimuth_t + 180) % 360 - 180)
    normals = [np.column_stack([-g, np.ones(len(g))]) / np.sqrt(1 + (g**2).sum(axis=1))[:, None] for g in (true, found)]
    lean = np.degrees(np.arccos(np.clip((normals[0] * normals[1]).sum(axis=1), -1, 1)))
    return {
        "sections": len(true),
        "slope_mae": float(np.abs(slope_f - slope_t).mean()),
        "slope_bias": float((slope_f - slope_t).mean()),
        "normal_mae": float(lean.mean()),
        "normal_median": float(np.median(lean)),
        "azimuth_sections": int(steep.sum()),
        "azimuth_mae": float(turn.mean()) if steep.any() else None,
        "azimuth_median": float(np.median(turn)) if steep.any() else None,
    }


def corner_figures(true: Corners, found: Corners, radius: float = CORNER_RADIUS) -> dict[str, float | int | None]:
    """Precision and recall of corners within `radius` px, nearest pairs first, each corner once; errors of the matched.

    A hidden truth corner need not be found; what is found there is no mistake either.
    """
    place, height = true.place[true.seen], true.height[true.seen]
    first, second, distance = _nearest_pairs(place, found.place, radius)
    rest = np.setdiff1d(np.arange(len(found.height)), second)
    _, excused, _ = _nearest_pairs(true.place[~true.seen], found.place[rest], radius)
    n, n_found = len(first), len(found.height) - len(excused)
    error = found.height[second] - height[first]
    return {
        "truth": len(height),
        "predicted": n_found,
        "matched": n,
        "radius_px": radius,
        "precision": _ratio(n, n_found),
        "recall": _ratio(n, len(height)),
        "position_mae_px": float(distance.mean()) if n else None,
        "height_mae": float(np.abs(error).mean()) if n else None,
        "height_bias": float(error.mean()) if n else None,
    }


def _nearest_pairs(a: NDArray[np.float64], b: NDArray[np.float64], radius: float) -> tuple[NDArray, NDArray, NDArray]:
    """One-to-one pairs of points (n, 2) within a radius, nearest first: indices in `a`, in `b`, distances."""
    from scipy.spatial import cKDTree

    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    near = cKDTree(a).sparse_distance_matrix(cKDTree(b), radius, output_type="ndarray")
    taken_a, taken_b = np.zeros(len(a), bool), np.zeros(len(b), bool)
    keep = []
    for k in np.lexsort((near["j"], near["i"], near["v"])):
        i, j = near["i"][k], near["j"][k]
        if not taken_a[i] and not taken_b[j]:
            taken_a[i] = taken_b[j] = True
            keep.append(k)
    kept = near[np.array(keep, np.int64)]
    return kept["i"], kept["j"], kept["v"]


def merge_corners(corners: Corners, within: float = 0.75) -> Corners:
    """Corners that sections share, once: those within `within` px and 1 m of height become their mean, seen if one is."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    n = len(corners.height)
    if not n:
        return corners
    near = cKDTree(corners.place).query_pairs(within, output_type="ndarray")
    near = near[np.abs(np.diff(corners.height[near], axis=1)[:, 0]) < 1.0]
    count, group = connected_components(coo_array((np.ones(len(near)), near.T), shape=(n, n)), directed=False)
    size = np.bincount(group, minlength=count)
    mean = [np.bincount(group, values, count) / size for values in (*corners.place.T, corners.height)]
    return Corners(np.column_stack(mean[:2]), mean[2], np.bincount(group, corners.seen, count) > 0)


class Reading(NamedTuple):
    """What one pass over the windows leaves: pairs, errors of found pixels and of all truth pixels, truth corners, and
    small images for the picture."""

    pairs: Pairs
    found: Errors
    everything: Errors
    corners: Corners
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
    found, everything = no_errors(n_groups), no_errors(n_groups)
    with rasterio.Env(GDAL_CACHEMAX=CACHE), rasterio.open(labels) as label_file, rasterio.open(heights) as height_file:
        for file in (label_file, height_file):
            _check_grid(file, grid)
        for window in grid.windows(SIDE):
            place = RasterWindow(window.col, window.row, window.width, window.height)
            predicted, z = label_file.read(1, window=place), height_file.read(1, window=place)
            seen, true = truth.visible_labels(sections, scene, window.grown(2))
            corners.append(_truth_corners(sections, seen, window))
            seen, true = seen[2:-2, 2:-2], true[2:-2, 2:-2]
            pairs.append(count_pairs(seen, predicted))

            roof = seen > 0
            height, answer = true[roof].astype(float), z[roof].astype(float)
            bins = np.clip(np.searchsorted(HEIGHT_EDGES, height, side="right") - 1, 0, None)
            group = split_of(seen[roof]) * len(HEIGHT_EDGES) + bins
            hit = (predicted[roof] > 0) & np.isfinite(answer)
            part = tally(group[hit], answer[hit], height[hit], fallback, n_groups)
            found = Errors(*map(np.add, found, part))
            part = tally(group, np.where(hit, answer, 0.0), height, fallback, n_groups)
            everything = Errors(*map(np.add, everything, part))

            error = np.where(roof & (predicted > 0), z - true, np.nan)
            rows, cols = (slice(-start % step, None, step) for start in (window.row, window.col))
            r0, c0 = -(-window.row // step), -(-window.col // step)
            for image, values in zip(small, (seen, predicted, error), strict=True):
                some = values[rows, cols]
                image[r0 : r0 + some.shape[0], c0 : c0 + some.shape[1]] = some
    vertices = Corners(*map(np.concatenate, zip(*corners, strict=True)))
    return Reading(merge_pairs(pairs), found, everything, merge_corners(vertices), *small)


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


def _truth_corners(sections: Truth, seen: NDArray[np.int32], window: Window) -> Corners:
    """The corners of truth sections in a window. One can be seen if its section shows within a pixel of it.

    `seen` are labels of the window grown by 2 px.
    """
    near = sections.near(window)
    if not len(near.ids):
        return Corners(np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool))
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
    return Corners(points[:, :2], points[:, 2], shows)


def read_sections(paths: list[str]) -> tuple[Predicted, NDArray[np.object_]]:
    """Predicted sections of all blocks, by id, and their outlines (px)."""
    columns = ["section_id", "score", "split", "plane_a", "plane_b", "status", "outline"]
    rows = pa.concat_tables([store.read_table(path, columns) for path in paths]).sort_by("section_id")
    c = {name: rows[name].to_numpy() for name in columns}
    split = np.where(np.isin(c["split"], (0, 1)), c["split"], 2).astype(np.int64)
    gradient = np.column_stack([c["plane_a"], c["plane_b"]]).astype(float)
    found = Predicted(c["section_id"], c["score"].astype(float), split, gradient, c["status"])
    return found, shapely.from_wkb(c["outline"])


def read_corners(paths: list[str]) -> Corners:
    """Found corners of all blocks, each once however many sections it was filed to."""
    columns = ["col", "row", "height"]
    rows = pa.concat_tables([store.read_table(path, columns) for path in paths])
    values = np.unique(np.column_stack([rows[name].to_numpy() for name in columns]).astype(float), axis=0)
    return Corners(values[:, :2], values[:, 2], np.ones(len(values), bool))


def evaluation(
    reading: Reading, sections: Truth, predicted: Predicted, corners: Corners | None, fallback: float
) -> dict[str, Any]:
    """All figures of one scene, after PAPER's "Metrics"."""
    pairs, n_bins = reading.pairs, len(HEIGHT_EDGES)
    ids = np.unique(pairs.predicted[pairs.predicted > 0])
    score = _lookup(predicted.ids, predicted.score, 0.0)(ids)
    over = overlaps(pairs, score)
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
        "pixels": {"all": pixel_figures(pairs)},
        "sections": {"all": section_figures(over, score, *everything)},
    }
    for code, name in enumerate(SPLITS):
        figures["pixels"][name] = pixel_figures(pairs, pair_split == code)
        figures["sections"][name] = section_figures(over, score, split_t == code, split_p == code)
    hidden = int(np.isin(sections.ids, over.truth, invert=True).sum())
    figures["sections"]["all"]["hidden"] = hidden

    for name, errors in (("found", reading.found), ("all_truth", reading.everything)):
        group = np.arange(len(errors.pixels))
        by_split = {split: height_figures(errors.of(group // n_bins == code)) for code, split in enumerate(SPLITS)}
        by_bin = {label: height_figures(errors.of(group % n_bins == i)) for i, label in enumerate(bin_names())}
        figures.setdefault("heights", {})[name] = {"all": height_figures(errors.of(np.s_[:])), **by_split, **by_bin}

    figures["planes"] = matched_planes(over, sections, predicted)
    if corners is not None:
        figures["corners"] = corner_figures(reading.corners, corners)
    figures["baseline"] = {"answer": fallback, "meaning": "this height above ground everywhere"}
    figures["paper"] = PAPER_TABLES
    return figures


def bin_names() -> list[str]:
    """Names of the height bins."""
    ends = [f"{edge:g}" for edge in HEIGHT_EDGES]
    return [f"{low}-{high} m" for low, high in pairwise(ends)] + [f"over {ends[-1]} m"]


def matched_planes(over: Overlaps, sections: Truth, predicted: Predicted) -> dict[str, Any]:
    """Plane errors of the matched sections: all, and by status."""
    place_t = _lookup(sections.ids, np.arange(len(sections.ids)), -1)(over.truth[over.first[over.matched]])
    place_p = _lookup(predicted.ids, np.arange(len(predicted.ids)), -1)(over.predicted[over.second[over.matched]])
    known = place_p >= 0
    place_t, place_p = place_t[known], place_p[known]
    true = truth.planes_of(sections.standing[place_t])[:, :2]
    found, status = predicted.gradient[place_p], predicted.status[place_p]
    usable = np.isfinite(found).all(axis=1)
    figures = {"all": plane_figures(true[usable], found[usable])}
    for name in sorted(set(status[usable])):
        figures[name] = plane_figures(true[usable & (status == name)], found[usable & (status == name)])
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
    shapes = np.concatenate([shapely.force_2d(o) for o, _ in drawn])
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
