"""Samples: one training tile with its truth, also partial truth (docs/architecture.md, "Training samples").

The one shape that all sources of training data (`dataset`, `own`) give and all users (`examples`, `validation`) take.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kibs_steps import fingerprint, store

UNKNOWN = 255
CORRECTED = "corrected.json"  # beside sets of samples that were corrected by hand: their `contents`


class Sample(NamedTuple):
    """One tile (s, s) with its truth; see docs/architecture.md, "Training samples"."""

    rgb: np.ndarray
    labels: np.ndarray
    roof: np.ndarray
    height: np.ndarray
    surface: np.ndarray
    corners: np.ndarray
    corner_heights: np.ndarray
    corners_known: np.ndarray
    geometry: np.ndarray

    @classmethod
    def ground(cls, rgb: np.ndarray) -> Sample:
        """Ground alone: no roofs, nothing unknown but its kind."""
        size = rgb.shape[:2]
        return cls(
            rgb,
            np.zeros(size, np.int32),
            np.zeros(size, np.uint8),
            np.full(size, np.nan, np.float32),
            np.full(size, UNKNOWN, np.uint8),
            np.zeros((0, 2), np.float32),
            np.zeros(0, np.float32),
            np.ones(size, np.uint8),
            np.zeros(6, np.float32),
        )

    @classmethod
    def load(cls, path: str | Path) -> Sample:
        """Read a kept sample."""
        with np.load(path, allow_pickle=False) as arrays:
            return cls(**{name: arrays[name] for name in cls._fields})

    def save(self, path: str | Path) -> None:
        """Keep it in one compressed file."""
        with store.whole(path, summed=False) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **self._asdict())

    def window(self, row: int, col: int, size: int) -> Sample:
        """The part from (row, col), `size` px wide and high."""
        part = (slice(row, row + size), slice(col, col + size))
        corners = self.corners - np.float32([col, row])
        inside = (corners >= 0).all(1) & (corners < size).all(1)
        return Sample(
            *(a[part] for a in self[:5]),
            corners[inside],
            self.corner_heights[inside],
            self.corners_known[part],
            self.geometry,
        )


def contents(folder: str | Path) -> dict[str, str]:
    """What the samples in the folders of a folder hold, whenever they were written: a hash by SET/NAME.npz."""
    found = {}
    for path in sorted(Path(folder).glob("*/[!.]*.npz")):
        with zipfile.ZipFile(path) as arrays:
            parts = [[part.filename, part.CRC] for part in arrays.infolist()]
        found[path.relative_to(folder).as_posix()] = fingerprint.of_values(parts)
    return found
