"""Scan order: the paper's reconciliation of tiles, a flood fill over the whole mosaic, first come, first served.

In the mosaic sections are pixel-separated areas over black, coloured by their tile's set: blue 200 training, 210 validation,
220 testing. From the first pixel in scan order not filled yet, `flood_fill` with a tolerance of 70 gives that pixel's colour to
all it reaches. Black is further than 70 from every colour and the colours are nearer than 70 to each other, so what it reaches
is the area of touching pixels (8-neighbours), whatever their colours: no picture of the whole raster is needed to know it.
Areas that meet only across the common corner of four tiles are not joined.
"""

from __future__ import annotations

import numpy as np
import shapely
from scipy import ndimage

CODES = (200, 210, 220)  # blue of training, validation, testing (PAPER, corners, planes, stitching, output)


def apart(labels: np.ndarray) -> np.ndarray:
    """Labels (rows, cols) without the pixels that have an 8-neighbour of another section."""
    highest = ndimage.maximum_filter(labels, 3)
    lowest = ndimage.minimum_filter(np.where(labels > 0, labels, np.iinfo(labels.dtype).max), 3)
    return np.where((highest == labels) & (lowest == labels), labels, 0)


def touching(first: np.ndarray, second: np.ndarray, side: str) -> np.ndarray:
    """Pairs (n, 2) of labels that a flood fill joins across a seam, from two tiles' views of the strip about it.

    The seam runs along the middle of the strips (2p wide); `side` is where the second tile lies, east or south of the first.
    """
    if side == "south":
        first, second = first.T, second.T
    middle = first.shape[1] // 2
    last, following = apart(first)[:, middle - 1], apart(second)[:, middle]
    length = len(last)
    near = [
        np.stack([last[max(0, -d) : length - max(0, d)], following[max(0, d) : length - max(0, -d)]], axis=1)
        for d in (-1, 0, 1)
    ]
    pairs = np.concatenate(near)
    return np.unique(pairs[(pairs > 0).all(axis=1)], axis=0).astype(np.int64).reshape(-1, 2)


def first_come(outlines: np.ndarray, group: np.ndarray, split: np.ndarray) -> np.ndarray:
    """Split (n,) of pieces when each group takes that of its first pixel in scan order; outlines along pixel edges (px)."""
    points, owner = shapely.get_coordinates(outlines, return_index=True)
    order = np.lexsort((points[:, 0], points[:, 1], group[owner]))
    _, first = np.unique(group[owner[order]], return_index=True)
    leader = dict(zip(group[owner[order]][first].tolist(), split[owner[order]][first].tolist(), strict=True))
    return np.array([leader[g] for g in group.tolist()], split.dtype)
