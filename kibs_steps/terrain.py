"""The terrain model as steps use it: heights (m) at map positions, read by window from the scene's own `dtm.tif`.

`scene` writes that file: scene CRS, metres, no holes, a little larger than the scene, so reading it needs no more care.
Between pixel centres heights are bilinear; beyond the outermost centres the edge value holds.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np


class Terrain(NamedTuple):
    """A height raster (rows, cols) whose upper-left *pixel centre* is (x0, y0); `step` is the pixel side in m (x, y)."""

    heights: np.ndarray
    x0: float
    y0: float
    step: tuple[float, float]

    def __call__(self, x_y: np.ndarray) -> np.ndarray:
        """Heights (n,) in m at map positions (n, 2)."""
        x_y = np.asarray(x_y, float)
        rows, cols = self.heights.shape
        col = np.clip((x_y[..., 0] - self.x0) / self.step[0], 0.0, cols - 1.0)
        row = np.clip((self.y0 - x_y[..., 1]) / self.step[1], 0.0, rows - 1.0)
        left, top = np.nan_to_num(col).astype(np.int64), np.nan_to_num(row).astype(np.int64)
        right, below = np.minimum(left + 1, cols - 1), np.minimum(top + 1, rows - 1)
        along, down = col - left, row - top
        above = self.heights[top, left] * (1 - along) + self.heights[top, right] * along
        under = self.heights[below, left] * (1 - along) + self.heights[below, right] * along
        return above * (1 - down) + under * down


def flat(height: float) -> Terrain:
    """Flat ground at one height."""
    return Terrain(np.full((1, 1), height, np.float64), 0.0, 0.0, (1.0, 1.0))


def read(
    path: str | Path, bounds: tuple[float, float, float, float], margin: float = 200.0, step: float = 0.0
) -> Terrain:
    """The part of a scene's `dtm.tif` within `margin` metres of `bounds` (left, bottom, right, top).

    With a `step` (m) only every so many pixels are read, as far apart as that or a little less.
    """
    from rasterio.windows import Window

    from kibs_steps import raster

    with raster.opened(path) as source:
        t = source.transform
        left, right = (bounds[0] - margin - t.c) / t.a, (bounds[2] + margin - t.c) / t.a
        top, bottom = (bounds[3] + margin - t.f) / t.e, (bounds[1] - margin - t.f) / t.e
        c0, c1 = max(int(left) - 1, 0), min(int(right) + 2, source.width)
        r0, r1 = max(int(top) - 1, 0), min(int(bottom) + 2, source.height)
        c0, r0 = min(c0, source.width - 1), min(r0, source.height - 1)
        window = Window(c0, r0, max(c1 - c0, 1), max(r1 - r0, 1))
        every = max(1, int(step // t.a))
        shape = (-(-window.height // every), -(-window.width // every))
        heights = source.read(1, window=window, out_shape=shape).astype(np.float64)
    width, height = t.a * window.width / shape[1], -t.e * window.height / shape[0]
    return Terrain(heights, t.c + c0 * t.a + width / 2, t.f + r0 * t.e - height / 2, (width, height))
