"""Metrics: from tallies of pixels, overlaps and corners to the figures of PAPER's "Metrics and tables".

Pure functions on arrays. Tallies (`Pairs`, `Errors`) of windows add up to those of the whole raster, so a city is judged in flat
memory; figures are plain numbers, None where nothing was there to judge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kibs_steps.errors import KibsError

MATCH = 0.5  # IoU
LEVEL = 3.0  # deg: below this slope a roof has no azimuth
CORNER_RADIUS = 2.0  # px
TALL = 1.0  # m: relative errors are taken above this height
CENTIMETRES = 10_000  # errors beyond ± 100 m fall into the last bin


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
