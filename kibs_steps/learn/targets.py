"""What the network is asked for, drawn from a sample's labels: rims, distances, perturbed sections, corners, heights.

In: arrays of one tile as in `learn.samples.Sample`. Out: target maps of the same tile; pixels that say nothing carry the
value IGNORED (masks) or NaN (heights). Pure functions.
"""

from __future__ import annotations

import cv2
import numpy as np

from kibs_steps.labels import rims

IGNORED = 255
HEIGHT_STRIDE = 4
SURFACE_STRIDE = 2
BLEND = {"inside": [None, None, 255], "rim": [None, None, 128], "outside": [None, None, 0]}


def distance(labels: np.ndarray, clip: float) -> np.ndarray:
    """Distance of section pixels to their section's rim line as a share of the section's greatest, float32 (h, w) in 0–1.

    Measured between pixel centres, plus the half pixel from the rim pixel's centre to the line; 0 off sections. Where a section
    is wider than 2·`clip` px the share is of `clip`: so every section has a summit of 1, small ones a small one.
    """
    inner = ((labels > 0) & ~rims(labels)).astype(np.uint8)
    if not inner.all():
        far = cv2.distanceTransform(inner, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    else:
        far = np.full(labels.shape, clip, np.float32)
    far = np.minimum(far + 0.5, clip)
    known = np.maximum(labels, 0)
    greatest = np.zeros(int(known.max(initial=0)) + 1, np.float32)
    np.maximum.at(greatest, known.ravel(), far.ravel())
    return np.where(labels > 0, far / np.maximum(greatest, 0.5)[known], 0.0).astype(np.float32)


def surface(kinds: np.ndarray, count: int) -> np.ndarray:
    """Share of each of `count` kinds of surface in cells of SURFACE_STRIDE px, float32 (count, h/2, w/2); zero where unknown."""
    rows, cols = (n // SURFACE_STRIDE for n in kinds.shape)
    cells = kinds.reshape(rows, SURFACE_STRIDE, cols, SURFACE_STRIDE)
    shares = np.stack([(cells == kind).mean((1, 3)) for kind in range(count)]).astype(np.float32)
    shares[:, (cells == IGNORED).any((1, 3))] = 0
    return shares


def slope(labels: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Rise of each section's plane per px of column and row (m/px, image frame) at the cells' middles, float32 (2, h/4, w/4).

    Planes are fitted by least squares to the `height` (h, w) of each section's pixels; NaN off sections and where heights
    are unknown.
    """
    known = np.where(np.isfinite(height), np.maximum(labels, 0), 0)
    n = int(known.max(initial=0)) + 1
    row, col = (a.ravel().astype(float) for a in np.mgrid[: labels.shape[0], : labels.shape[1]])
    index, h = known.ravel(), np.nan_to_num(height).ravel().astype(float)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(index, values, n) / np.maximum(np.bincount(index, minlength=n), 1)

    c, r, z = col - mean(col)[index], row - mean(row)[index], h - mean(h)[index]
    cc, rr, cr, cz, rz = mean(c * c), mean(r * r), mean(c * r), mean(c * z), mean(r * z)
    determinant = cc * rr - cr**2
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.stack([rr * cz - cr * rz, cc * rz - cr * cz]) / determinant
    plane[:, (determinant < 0.05) | (np.arange(n) == 0)] = np.nan
    middle = known[HEIGHT_STRIDE // 2 :: HEIGHT_STRIDE, HEIGHT_STRIDE // 2 :: HEIGHT_STRIDE]
    return plane[:, middle].astype(np.float32)


def centre(labels: np.ndarray, farthest: float = 64.0) -> np.ndarray:
    """Way (col, row) px from the cells' middles to the middle of their section, no longer than `farthest`, float32 (2, h/4, w/4).

    NaN off sections and on those that the tile cuts: their middle is not known.
    """
    known = np.maximum(labels, 0)
    n = int(known.max(initial=0)) + 1
    row, col = (a.ravel() + 0.5 for a in np.mgrid[: labels.shape[0], : labels.shape[1]])
    count = np.maximum(np.bincount(known.ravel(), minlength=n), 1)
    middle = np.stack([np.bincount(known.ravel(), place, n) / count for place in (col, row)])
    cut = np.unique(np.concatenate([known[0], known[-1], known[:, 0], known[:, -1]]))
    middle[:, np.append(cut, 0)] = np.nan
    half = HEIGHT_STRIDE // 2
    at = known[half::HEIGHT_STRIDE, half::HEIGHT_STRIDE]
    rows, cols = np.mgrid[half : labels.shape[0] : HEIGHT_STRIDE, half : labels.shape[1] : HEIGHT_STRIDE]
    way = middle[:, at] - np.stack([cols, rows])
    return (way * np.minimum(1, farthest / np.maximum(np.hypot(*way), 1e-6))).astype(np.float32)


def edge(labels: np.ndarray) -> np.ndarray:
    """uint8 (h, w): 1 on rims, 0 elsewhere, IGNORED where sections are unknown (label −1)."""
    target = rims(labels).astype(np.uint8)
    target[labels < 0] = IGNORED
    return target


def section_weight(labels: np.ndarray, usual_area: float = 150.0) -> np.ndarray:
    """Weight of each pixel, float32 (h, w): small sections count more than their pixels, large ones a little less."""
    known = np.maximum(labels, 0)
    area = np.bincount(known.ravel())
    weight = np.clip(np.sqrt(usual_area / np.maximum(area, 1)), 0.7, 3.0)
    weight[0] = 1.0
    return weight[known].astype(np.float32)


def perturbed(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Section labels as a model might get them wrong: some dropped, merged, split, grown, shrunk, shifted or made up.

    `labels` is int32 (h, w) without −1; the result has its shape and type.
    """
    height, width = labels.shape
    wrong = labels.copy()
    ids = np.unique(wrong[wrong > 0])
    if ids.size:
        table = np.arange(wrong.max() + 1, dtype=labels.dtype)
        for a, b in _touching(wrong):
            if rng.random() < 0.06:
                table[b] = table[a]
        table[ids[rng.random(ids.size) < 0.06]] = 0
        wrong = table[wrong]
        new = int(wrong.max()) + 1
        rows, cols = np.mgrid[:height, :width]
        for i in ids[rng.random(ids.size) < 0.04]:
            r, c = np.nonzero(wrong == i)
            if r.size:
                angle = rng.uniform(0, np.pi)
                side = (rows - r.mean()) * np.cos(angle) + (cols - c.mean()) * np.sin(angle) > 0
                wrong[(wrong == i) & side] = new
                new += 1
    if rng.random() < 0.25:
        wrong[rims(wrong)] = 0
    elif rng.random() < 0.3:
        grown = cv2.dilate(wrong.astype(np.float32), np.ones((3, 3))).astype(labels.dtype)
        wrong = np.where(wrong > 0, wrong, grown)
    if rng.random() < 0.4:
        move = np.float32([[1, 0, rng.integers(-2, 3)], [0, 1, rng.integers(-2, 3)]])
        wrong = cv2.warpAffine(wrong.astype(np.float32), move, (width, height), flags=cv2.INTER_NEAREST)
        wrong = wrong.astype(labels.dtype)
    for _ in range(rng.integers(0, 3)):
        box = ((rng.random(2) * (width, height)), rng.uniform(8, 40, 2), rng.uniform(0, 180))
        made_up = cv2.fillPoly(np.zeros((height, width), np.uint8), [cv2.boxPoints(box).astype(np.int32)], 1)
        wrong[(made_up > 0) & (wrong == 0)] = int(wrong.max()) + 1
    return wrong


def _touching(labels: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of sections that share a rim."""
    pairs = [
        np.stack([a.ravel(), b.ravel()], axis=1)
        for a, b in ((labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1]))
    ]
    pairs = np.sort(np.concatenate(pairs), axis=1)
    pairs = np.unique(pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs[:, 0] > 0)], axis=0)
    return [(int(a), int(b)) for a, b in pairs]


def corner_heat(corners: np.ndarray, size: tuple[int, int], sigma: float = 1.2) -> np.ndarray:
    """Heatmap float32 (h, w): a Gaussian round every corner's pixel, exactly 1 in it; the larger where they overlap.

    `corners` (n, 2) px (col, row); those outside the tile are left out. CenterNet (Zhou et al. 2019).
    """
    heat = np.zeros(size, np.float32)
    reach = int(3 * sigma)
    steps = np.arange(-reach, reach + 1)
    kernel = np.exp(-(steps[:, None] ** 2 + steps**2) / (2 * sigma**2)).astype(np.float32)
    for col, row in _pixels(corners, size):
        top, left = max(row - reach, 0), max(col - reach, 0)
        bottom, right = min(row + reach + 1, size[0]), min(col + reach + 1, size[1])
        part = kernel[top - row + reach : bottom - row + reach, left - col + reach : right - col + reach]
        np.maximum(heat[top:bottom, left:right], part, out=heat[top:bottom, left:right])
    return heat


def corner_offset(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Corner − pixel centre (col, row) px in each corner's pixel, float32 (2, h, w); NaN in all others."""
    offset = np.full((2, *size), np.nan, np.float32)
    pixels = _pixels(corners, size)
    inside = _inside(corners, size)
    offset[:, pixels[:, 1], pixels[:, 0]] = (corners[inside] - pixels - 0.5).T
    return offset


def corner_height(corners: np.ndarray, heights: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Height of the corner in each cell of HEIGHT_STRIDE px, float32 (h/4, w/4) m; NaN where there is none, or unknown."""
    cells = np.full((size[0] // HEIGHT_STRIDE, size[1] // HEIGHT_STRIDE), np.nan, np.float32)
    pixels = _pixels(corners, size) // HEIGHT_STRIDE
    cells[pixels[:, 1], pixels[:, 0]] = heights[_inside(corners, size)]
    return cells


def roof_height(height: np.ndarray) -> np.ndarray:
    """Mean height of the roof pixels in each cell of HEIGHT_STRIDE px, float32 (h/4, w/4) m; NaN off roofs."""
    rows, cols = (n // HEIGHT_STRIDE for n in height.shape)
    cells = height.reshape(rows, HEIGHT_STRIDE, cols, HEIGHT_STRIDE)
    known = np.isfinite(cells)
    count = known.sum((1, 3))
    total = np.where(known, cells, 0.0).sum((1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def height_bins() -> tuple[np.ndarray, np.ndarray]:
    """Edges (B + 1,) and centres (B,) in m of the height distribution: 0.5 m wide to 10 m, 1 m to 20 m, then coarser to 60 m."""
    edges = np.concatenate(
        [np.arange(0, 10, 0.5), np.arange(10, 20, 1.0), np.arange(20, 32, 2.0), [32, 36, 42, 50, 60]]
    )
    return edges, (edges[1:] + edges[:-1]) / 2


def height_distribution(height: np.ndarray, edges: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Soft labels (…, B) over the bins: a Gaussian about each height, as wide as its bin or 0.4 m; zero where NaN."""
    sigma = np.maximum(np.diff(edges) / 2, 0.4)
    z = (height[..., None] - centres) / sigma
    density = np.exp(-0.5 * np.minimum(z**2, 200.0)) + 1e-30
    density = np.where(np.isfinite(height)[..., None], density, 0.0)
    return (density / np.maximum(density.sum(-1, keepdims=True), 1e-30)).astype(np.float32)


def _inside(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    corners = np.asarray(corners, float).reshape(-1, 2)
    return (corners >= 0).all(1) & (corners[:, 0] < size[1]) & (corners[:, 1] < size[0])


def _pixels(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The pixels (col, row) that hold the corners inside the tile."""
    corners = np.asarray(corners, float).reshape(-1, 2)
    return np.floor(corners[_inside(corners, size)]).astype(int)
