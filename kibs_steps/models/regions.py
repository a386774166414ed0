"""Regions: what an image and a dense network's maps say of basins and sections, as sums that add up where parts become one.

In: labels with image and maps. Out: sums by region and, from sums alone, what a region looks like: its shape, how even its colour
is, how flat the plane that the network sees, and where its pixels say that its middle is.
"""

from __future__ import annotations

import numpy as np

SUMS = (
    *("area", "x", "y", "xx", "xy", "yy"),
    *("red", "green", "blue", "bright²"),
    *("roof", "edge"),
    *("slope x", "slope y", "slope²"),  # m per px of column and row
    *("aim x", "aim y", "aim²"),  # px: where pixels see the middle of their section
)
COLUMNS = (*SUMS, "summit")  # and the highest level
COLOUR = slice(6, 9)
SLOPE = slice(12, 14)
AIM = slice(15, 17)


def sums(
    labels: np.ndarray,
    rgb: np.ndarray,
    maps: dict[str, np.ndarray],
    level: np.ndarray,
    n: int | None = None,
    origin: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Sums (n, 19) over the pixels of regions 1…n of labels (s, s), float64: columns COLUMNS.

    `rgb` is uint8 (s, s, 3), `maps` (C, s, s) are roof and edge in 0–1, perhaps slope and centre; `level` (s, s) is what summits
    stand on. The first pixel's middle lies at `origin` (col, row). Where a network shows no slope there is none; where it
    shows no centre, pixels see it in themselves.
    """
    n = int(labels.max(initial=0)) if n is None else n
    row, col = np.nonzero(labels)
    at = labels[row, col]
    colour = rgb[row, col] / 255.0
    x, y = col + float(origin[0]), row + float(origin[1])
    none = np.zeros((2, len(at)))
    slope, way = (maps[name][:, row, col].astype(float) if name in maps else none for name in ("slope", "centre"))
    aim = np.stack([way[0] + x, way[1] + y])
    columns = (
        *(x, y, x * x, x * y, y * y),
        *(*colour.T, colour.mean(axis=1) ** 2),
        *(maps[name][0][row, col].astype(float) for name in ("roof", "edge")),
        *(*slope, (slope**2).sum(axis=0)),
        *(*aim, (aim**2).sum(axis=0)),
    )
    summit = np.full(n + 1, -np.inf)
    np.maximum.at(summit, at, level[row, col].astype(float))
    found = [np.bincount(at, minlength=n + 1), *(np.bincount(at, values, n + 1) for values in columns), summit]
    return np.column_stack(found)[1:]


def merged(parts: np.ndarray, number: np.ndarray, n: int) -> np.ndarray:
    """Sums (n, …) of what parts (k, …) of equal `number` (k,), counted from 0, are together; of the last column the highest."""
    whole = np.zeros((n, parts.shape[1]))
    np.add.at(whole, number, parts)
    whole[:, -1] = -np.inf
    np.maximum.at(whole[:, -1], number, parts[:, -1])
    return whole


def spread(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Greater and smaller standard deviation (px) of the places of pixels, squares of 1 px, from sums (n, ≥ 6): number, x, y, xx,
    xy, yy."""
    number = found[:, 0]
    x, y, xx, xy, yy = (found[:, k] / number for k in range(1, 6))
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    middle, off = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return np.sqrt(np.maximum(middle + off, 0) + 1 / 12), np.sqrt(np.maximum(middle - off, 0) + 1 / 12)


def fill(found: np.ndarray) -> np.ndarray:
    """How much of its ellipse of inertia a shape covers: 1 for an ellipse, 3/π (0.95) for a rectangle, little for what
    has arms."""
    long, short = spread(found)
    return found[:, 0] / (4 * np.pi * long * short)


def mean(found: np.ndarray, columns: slice | str) -> np.ndarray:
    """Means (n,) or (n, k) of some columns over a region's pixels."""
    if isinstance(columns, str):
        return found[:, COLUMNS.index(columns)] / found[:, 0]
    return found[:, columns] / found[:, :1]


def brightness_variance(found: np.ndarray) -> np.ndarray:
    """Variance (n,) of brightness, the mean of the three bands in 0–1."""
    return np.maximum(mean(found, "bright²") - mean(found, COLOUR).mean(axis=1) ** 2, 0)


def slope_variance(found: np.ndarray) -> np.ndarray:
    """Variance (n,) of the slope, (m per px)²: 0 where the network sees one plane."""
    return np.maximum(mean(found, "slope²") - (mean(found, SLOPE) ** 2).sum(axis=1), 0)


def aim_variance(found: np.ndarray) -> np.ndarray:
    """Variance (n,) of where pixels see the middle, px²."""
    return np.maximum(mean(found, "aim²") - (mean(found, AIM) ** 2).sum(axis=1), 0)


def aim_off(found: np.ndarray) -> np.ndarray:
    """How far the middle that pixels see is from the region's own, in sides of a square of its area: 0 for a whole section."""
    return np.linalg.norm(mean(found, AIM) - mean(found, slice(1, 3)), axis=1) / np.sqrt(found[:, 0])
