"""Heads: a network's raw outputs decoded to detections, the same for every architecture.

Sections become a label image (s, s), 0 none, 1…n, with a score each. Corners become a table: position (col, row) in px with
sub-pixel part, height (mean and σ over the height bins, m), score. `dense` heads are named maps, `instances` are the boxes,
labels, scores and masks of a Mask R-CNN (docs/architecture.md, Models).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from kibs_steps.labels import rims
from kibs_steps.models import joining, scoring

PROMINENCE = 0.2  # of a section's summit, where the contract does not say
SMOOTH = 0.5  # px: summits one pixel wide are noise


class Sections(NamedTuple):
    """Label image (s, s) int32 with labels 1…n, and scores (n,) in 0–1."""

    labels: np.ndarray
    scores: np.ndarray


class Corners(NamedTuple):
    """Columns of equal length: col, row (px), height and sigma (m above ground), score (0–1)."""

    col: np.ndarray
    row: np.ndarray
    height: np.ndarray
    sigma: np.ndarray
    score: np.ndarray


def decode_sections(outputs: dict[str, np.ndarray], contract: dict[str, Any], rgb: np.ndarray) -> Sections:
    """Sections of one tile, rgb uint8 (s, s, 3), from the outputs of either head."""
    if contract["head"] == "dense":
        return dense_sections(outputs, contract["thresholds"], rgb, contract.get("score"), contract.get("join"))
    return instance_sections(outputs, contract["tile"], contract["thresholds"])


def alone(found: Sections, outputs: dict[str, np.ndarray], contract: dict[str, Any]) -> Sections:
    """Sections of a tile that is looked at alone: without those that are not sure (`scoring.sure`), numbered anew.

    Where tiles are stitched that is asked of whole sections.
    """
    if contract["head"] != "dense":
        return found
    roof = mean_by_label(outputs["roof"][0], found.labels, len(found.scores))
    stays = scoring.sure(roof, found.scores, contract["thresholds"])
    if stays.all():
        return found
    number = np.append(0, np.where(stays, np.cumsum(stays), 0)).astype(np.int32)
    return Sections(number[found.labels], found.scores[stays])


def decode_corners(outputs: dict[str, np.ndarray], contract: dict[str, Any]) -> Corners:
    """Corners of one tile from the outputs of either head."""
    if contract["head"] == "dense":
        return dense_corners(
            outputs["corner"][0],
            outputs["offset"],
            outputs["height"],
            contract["heights"],
            contract["thresholds"],
            contract["tile"],
        )
    return instance_corners(outputs, contract["heights"], contract["thresholds"])


def dense_sections(
    maps: dict[str, np.ndarray],
    thresholds: dict[str, float],
    rgb: np.ndarray,
    score: dict[str, Any] | None = None,
    join: dict[str, Any] | None = None,
) -> Sections:
    """Sections where the distance to the rim rises to a summit of its own, flooded over the roof (watershed).

    `maps` (C, s, s) are `roof`, `edge`, `distance` in 0–1 and perhaps `slope` and `centre`. Of all summits of distance − edge
    those count that rise `prominence` above the pass to a higher one; their basins are joined further by what was learned of them
    and their image, `rgb` (`joining`, the contract's `join`). Every roof area is at least one section. Sections under
    `min_area` px are given to the neighbour they touch most, or dropped when alone. `score` is the network that tells from
    `scoring.traits` how likely a section is right; without it its score is its mean roof probability.
    """
    roof, edge, distance = (maps[name][0] for name in ("roof", "edge", "distance"))
    found, level = basins(roof, edge, distance, thresholds)
    if not found.any():
        return Sections(found, np.zeros(0, np.float32))
    labels = found if join is None else joining.sections(found, rgb, maps, level, join)
    labels = absorb_small(labels, int(thresholds["min_area"]))
    return Sections(labels, scoring.scores(scoring.evidence(labels, rims(labels), rgb, maps), score))


def basins(
    roof: np.ndarray, edge: np.ndarray, distance: np.ndarray, thresholds: dict[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Watershed basins (s, s) int32 of the summits that count, 0 off the roof, and the level (s, s) float32 they are found in."""
    from scipy import ndimage

    mask = roof > thresholds["roof"]
    level = ndimage.gaussian_filter((distance - edge).astype(np.float32), SMOOTH)
    if not mask.any():
        return np.zeros(roof.shape, np.int32), level
    every = flood(summits(level, mask), mask, level)
    return joined_basins(every, level, thresholds.get("prominence", PROMINENCE)), level


def summits(level: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Local maxima of `level` (s, s) among 8 neighbours of the mask, plateaus as one, labelled 1…n: one or more an area."""
    from scipy import ndimage

    inside = np.where(mask, level, -np.inf)
    return ndimage.label(mask & (inside >= ndimage.maximum_filter(inside, size=3)), np.ones((3, 3)))[0]


def joined_basins(basins: np.ndarray, level: np.ndarray, prominence: float) -> np.ndarray:
    """Watershed basins 1…n (s, s) joined across every pass that lies less than `prominence` below the lower of two summits.

    Passes are taken from the highest down, so a summit's prominence is that of topography: its rise above the highest pass
    that leads to a higher summit.
    """
    n = int(basins.max(initial=0))
    summit = np.full(n + 1, -np.inf, level.dtype)
    np.maximum.at(summit, basins.ravel(), level.ravel())
    passes = []
    for a, b in (
        ((slice(1, None),), (slice(None, -1),)),
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
    ):
        differ = (basins[a] != basins[b]) & (basins[a] > 0) & (basins[b] > 0)
        pair = np.sort(np.stack([basins[a][differ], basins[b][differ]], 1), axis=1)
        passes.append(np.column_stack([pair, np.minimum(level[a][differ], level[b][differ])]))
    passes = np.concatenate(passes)
    passes = passes[np.lexsort((passes[:, 1], passes[:, 0], -passes[:, 2]))]
    # Where the highest pass between two basins does not join them no lower one does.
    highest = np.unique(passes[:, :2], axis=0, return_index=True)[1]
    passes = passes[np.sort(highest)]
    parent = np.arange(n + 1)

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return int(i)

    for first, second, height in passes:
        a, b = root(int(first)), root(int(second))
        if a != b:
            low, high = (a, b) if (summit[a], -a) < (summit[b], -b) else (b, a)
            if summit[low] - height < prominence:
                parent[low] = high
    return np.array([root(i) for i in range(n + 1)], np.int32)[basins]


def flood(markers: np.ndarray, mask: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Watershed of `level` (high inside sections) from `markers` (s, s) int, inside `mask`."""
    from skimage.segmentation import watershed

    return watershed(-level, markers.astype(np.int32), mask=mask).astype(np.int32)


def absorb_small(labels: np.ndarray, min_area: int) -> np.ndarray:
    """Give sections under `min_area` px to the neighbour with the longest common rim (4-neighbours); drop lone ones.

    Labels of the result are 1…n in order of first appearance.
    """
    from scipy import ndimage

    labels = labels.astype(np.int32)
    area = np.bincount(labels.ravel())
    small = [int(i) for i in np.flatnonzero((area > 0) & (area < min_area)) if i > 0]
    boxes = ndimage.find_objects(labels) if small else []
    for label in sorted(small, key=lambda i: (area[i], i)):
        if area[label] >= min_area:
            continue  # by what it was given itself
        place = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in boxes[label - 1])
        part = labels[place]
        own = part == label
        rim = cv2.dilate(own.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))).astype(bool) & ~own
        around = part[rim]
        around = around[around > 0]
        taker = int(np.bincount(around).argmax()) if around.size else 0
        part[own] = taker
        if taker:  # which may be a small one itself
            area[taker] += area[label]
            both = zip(boxes[label - 1], boxes[taker - 1], strict=True)
            boxes[taker - 1] = tuple(slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in both)
    return relabelled(labels)


def relabelled(labels: np.ndarray) -> np.ndarray:
    """The same sections with labels 1…n in order of first appearance, row by row."""
    values, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(np.where(values == 0, -1, first), kind="stable")
    new = np.empty(len(values), np.int32)
    offset = 0 if values[order[0]] == 0 else 1
    new[order] = np.arange(len(values)) + offset
    return new[inverse].reshape(labels.shape)


def mean_by_label(values: np.ndarray, labels: np.ndarray, n: int | None = None) -> np.ndarray:
    """Mean of `values` over each label 1…n, 0 where a label has no pixel; `n` is the greatest label if not given."""
    n = int(labels.max(initial=0)) if n is None else n
    total = np.bincount(labels.ravel(), values.ravel().astype(np.float64), n + 1)
    count = np.bincount(labels.ravel(), minlength=n + 1)
    return (total / np.maximum(count, 1))[1:].astype(np.float32)


def instance_sections(outputs: dict[str, np.ndarray], size: int, thresholds: dict[str, float]) -> Sections:
    """Paste Mask R-CNN's 28×28 masks, best score last on top; sections under `min_area` px are dropped or absorbed."""
    labels = np.zeros((size, size), np.int32)
    scores = outputs["scores"]
    keep = np.flatnonzero(scores >= thresholds["score"])
    order = keep[np.lexsort((keep, scores[keep]))]
    for number, i in enumerate(order, start=1):
        window, mask = pasted(outputs["boxes"][i], outputs["masks"][i], size)
        labels[window][mask > thresholds.get("mask", 0.5)] = number
    kept = scores[order]
    final = absorb_small(labels, int(thresholds["min_area"]))
    old = np.zeros(int(final.max(initial=0)), np.int64)
    for new in range(1, len(old) + 1):
        old[new - 1] = np.bincount(labels[(final == new) & (labels > 0)]).argmax()
    return Sections(final, kept[old - 1].astype(np.float32) if len(old) else np.zeros(0, np.float32))


def pasted(box: np.ndarray, mask: np.ndarray, size: int) -> tuple[tuple[slice, slice], np.ndarray]:
    """A box's (x0, y0, x1, y1) window of the tile and the mask's probabilities there, bilinear."""
    from scipy import ndimage

    x0, y0 = np.floor(np.maximum(box[:2], 0)).astype(int)
    x1, y1 = np.ceil(np.minimum(box[2:], size)).astype(int)
    x1, y1 = max(x1, x0 + 1), max(y1, y0 + 1)
    n = mask.shape[-1]
    col = (np.arange(x0, x1) + 0.5 - box[0]) / max(box[2] - box[0], 1e-3) * n - 0.5
    row = (np.arange(y0, y1) + 0.5 - box[1]) / max(box[3] - box[1], 1e-3) * n - 0.5
    grid = np.meshgrid(row, col, indexing="ij")
    return (slice(y0, y1), slice(x0, x1)), ndimage.map_coordinates(mask, grid, order=1, mode="grid-constant")


def height_moments(distribution: np.ndarray, heights: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and σ (m) of distributions (B, n) over the contract's bins; a bin's own width counts into σ."""
    centres = np.asarray(heights["centres"], np.float64)
    widths = np.diff(np.asarray(heights["edges"], np.float64))
    p = distribution.astype(np.float64)
    p = p / np.maximum(p.sum(0), 1e-9)
    mean = (p * centres[:, None]).sum(0)
    variance = (p * ((centres[:, None] - mean) ** 2 + (widths**2 / 12)[:, None])).sum(0)
    return mean, np.sqrt(variance)


def height_map(outputs: dict[str, np.ndarray], contract: dict[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean and σ (m, (rows, cols)) of every cell of a dense 3D model's height map; None for models without one."""
    if contract["head"] != "dense":
        return None
    bins = outputs["height"]
    mean, sigma = height_moments(bins.reshape(len(bins), -1), contract["heights"])
    return mean.reshape(bins.shape[1:]), sigma.reshape(bins.shape[1:])


def dense_corners(
    corner: np.ndarray,
    offset: np.ndarray,
    height: np.ndarray,
    heights: dict[str, Any],
    thresholds: dict[str, float],
    side: int,
) -> Corners:
    """Peaks of the corner heatmap (maxima of 5×5 cells), moved by the offset map, with the height distribution read there.

    `corner` (s/k, s/k), `offset` (2, s/k, s/k) px of the tile from the cell's centre, `height` (B, s/l, s/l), of a tile of `side`
    s px, for any strides k and l.
    """
    peak = (corner >= thresholds["corner"]) & (corner >= cv2.dilate(corner, np.ones((5, 5), np.uint8)))
    row, col = np.nonzero(peak)
    score = corner[row, col].astype(np.float64)
    cell = side / len(corner)
    x = (col + 0.5) * cell + offset[0, row, col]
    y = (row + 0.5) * cell + offset[1, row, col]
    k = side / height.shape[1]
    mean, sigma = height_moments(bilinear(height, y / k - 0.5, x / k - 0.5), heights)
    return Corners(x.astype(np.float64), y.astype(np.float64), mean, sigma, score)


def bilinear(maps: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Values (B, n) of maps (B, rows, cols) at places between pixel centres; beyond the outermost ones the edge holds."""
    row, col = np.clip(row, 0, maps.shape[1] - 1), np.clip(col, 0, maps.shape[2] - 1)
    top, left = row.astype(np.int64), col.astype(np.int64)
    below, right = np.minimum(top + 1, maps.shape[1] - 1), np.minimum(left + 1, maps.shape[2] - 1)
    down, along = row - top, col - left
    above = maps[:, top, left] * (1 - along) + maps[:, top, right] * along
    under = maps[:, below, left] * (1 - along) + maps[:, below, right] * along
    return above * (1 - down) + under * down


def instance_corners(outputs: dict[str, np.ndarray], heights: dict[str, Any], thresholds: dict[str, float]) -> Corners:
    """Mask R-CNN's corner squares: the box's centre, the class as height bin (labels start at 1, 0 being background).

    Boxes of several classes over one corner (centres within `corner_nms` px) are one corner whose height is the mean of
    the classes weighted by score.
    """
    keep = outputs["scores"] >= thresholds["score"]
    boxes, labels, scores = outputs["boxes"][keep], outputs["labels"][keep].astype(int), outputs["scores"][keep]
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    reach = thresholds.get("corner_nms", 4.0)
    free = np.ones(len(scores), bool)
    rows = []
    for i in np.lexsort((np.arange(len(scores)), -scores)):
        if not free[i]:
            continue
        same = free & (np.abs(centre - centre[i]).max(axis=1) <= reach)
        free &= ~same
        distribution = np.zeros((len(heights["centres"]), 1))
        np.add.at(distribution[:, 0], labels[same] - 1, scores[same])
        mean, sigma = height_moments(distribution, heights)
        rows.append((*centre[i], mean[0], sigma[0], scores[i]))
    table = np.array(rows, np.float64).reshape(-1, 5)
    return Corners(*table.T)
