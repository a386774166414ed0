"""Height map: what the 3D model says of the heights all over a section, as sums that fix a plane.

Corners alone leave many a section without a plane, and each carries the whole error of one place. A dense 3D model also gives the
height of every cell of its map, so every piece of a section takes along the sums of least squares over its cells, in image
coordinates (px) and metres above ground. Sums of pieces add up to those of their section exactly, whatever tiles and blocks
they come from. `points` turns a section's sums into four points with heights that any fit of a plane can use beside corners.
How far walls and shadows lift a section (`models.walls`) is added up beside them, weighted by how much of them was looked at: a
tile sees the foot of some walls and not of others, and pieces that were lifted apart would tilt the whole.

Most of a cell's error is that of the whole section; only `LOCAL` of its σ tells cells apart, and so bounds slopes.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

SUMS = ("n", "x", "y", "h", "xx", "xy", "yy", "xh", "yh", "sigma")  # of cells: number, col, row, height, products, σ
SUMS += ("lift", "looks")  # of pieces: lift (m) times looks, looks
NUMBER, SIGMA, LIFT, LOOKS = map(SUMS.index, ("n", "sigma", "lift", "looks"))
CELL = 16.0  # px²: what counts as one cell, whatever the map's stride
EMPTY = [0.0] * len(SUMS)  # no cells
LOCAL = 0.3  # tried on the demo: slopes are as little too flat as corners and cells together allow
FLATTEST = 0.04  # px²: spread of the cells of a piece one cell wide

HEIGHTS = pa.schema([("label", pa.int64()), ("sums", pa.list_(pa.float64(), len(SUMS)))])


def cells_of(labels: NDArray, stride: int) -> NDArray:
    """Label (rows, cols) of each cell: that of the pixel right below its middle."""
    return labels[stride // 2 :: stride, stride // 2 :: stride]


def sums_by_label(
    labels: NDArray, mean: NDArray, sigma: NDArray, col: float, row: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The labels above 0 among cells (rows, cols) and their sums (n, 12), not lifted.

    `mean` and `sigma` (m above ground) are the height map's cells; the tile's upper left corner lies at (`col`, `row`) px of the
    image, `labels` (s, s) are its pixels, 0 where the tile has no say.
    """
    stride = labels.shape[0] // mean.shape[0]
    label = cells_of(labels, stride)[: mean.shape[0], : mean.shape[1]]
    i, j = np.nonzero(label)
    found, at = np.unique(label[i, j], return_inverse=True)
    x, y = col + (j + 0.5) * stride, row + (i + 0.5) * stride
    h, s = mean[i, j].astype(np.float64), sigma[i, j].astype(np.float64)
    terms = (np.ones(len(h)), x, y, h, x * x, x * y, y * y, x * h, y * h, s)
    sums = np.zeros((len(found), len(SUMS)))
    for k, term in enumerate(terms):
        sums[:, k] = np.bincount(at, term, len(found)) * (stride**2 / CELL)
    return found.astype(np.int64), sums


def lifts(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far (m) sections with these sums (n, 12) are lifted: the mean over their pieces by looks, 0 without any."""
    return sums[:, LIFT] / np.where(sums[:, LOOKS] > 0, sums[:, LOOKS], 1.0)


def table(labels: NDArray[np.int64], sums: NDArray[np.float64]) -> pa.Table:
    """Rows after `HEIGHTS`."""
    flat = pa.array(np.ascontiguousarray(sums).ravel(), pa.float64())
    return pa.table([labels, pa.FixedSizeListArray.from_arrays(flat, len(SUMS))], schema=HEIGHTS)


def column(lists: pa.ChunkedArray, width: int = len(SUMS)) -> NDArray[np.float64]:
    """A column of lists of one length, such as sums, as an array (n, width)."""
    parts = [part.flatten().to_numpy(zero_copy_only=False) for part in lists.chunks]
    return np.concatenate([*parts, np.zeros(0)]).reshape(-1, width)


def plane(sums: NDArray[np.float64]) -> tuple[float, float, float]:
    """Height above ground (m) as a·col + b·row + c (px), by least squares over a section's cells; level across a piece one cell
    wide."""
    middle, gradient, height, *_ = _moments(sums)
    return float(gradient[0]), float(gradient[1]), float(height - gradient @ middle)


def points(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Four points (4, 4: col, row px, height, σ m) that fix the same plane as a section's cells, not lifted; none (0, 4) without
    cells.

    They lie on the cells' principal axes, so their least squares plane is that of the cells wherever σ is one.
    """
    n, sigma = sums[NUMBER], sums[SIGMA]
    if n <= 0:
        return np.zeros((0, 4))
    middle, gradient, height, width, axes = _moments(sums)
    arms = np.sqrt(2 * np.maximum(width, 0.0))[:, None] * axes.T
    away = np.concatenate([arms, -arms])
    each = LOCAL * sigma / n * np.sqrt(4 / n)
    return np.column_stack([middle + away, height + away @ gradient, np.full(4, each)])


def _moments(sums: NDArray[np.float64]) -> tuple[NDArray, NDArray, float, NDArray, NDArray]:
    """Of a section's cells: middle (px), gradient (m per px), mean height (m), spread (px²) along their principal axes."""
    n, x, y, h, xx, xy, yy, xh, yh = sums[:SIGMA]
    middle = np.array([x, y]) / n
    spread = np.array([[xx, xy], [xy, yy]]) / n - np.outer(middle, middle)
    with_height = np.array([xh, yh]) / n - middle * (h / n)
    width, axes = np.linalg.eigh(spread)
    gradient = axes @ np.where(width > FLATTEST, axes.T @ with_height / np.maximum(width, FLATTEST), 0.0)
    return middle, gradient, h / n, width, axes
