"""Label images: 0 for none, a number for each section."""

from __future__ import annotations

import numpy as np


def rims(labels: np.ndarray) -> np.ndarray:
    """Section pixels (s, s) that have a 4-neighbour of another label."""
    rim = np.zeros(labels.shape, bool)
    vertical, horizontal = labels[1:] != labels[:-1], labels[:, 1:] != labels[:, :-1]
    rim[1:] |= vertical
    rim[:-1] |= vertical
    rim[:, 1:] |= horizontal
    rim[:, :-1] |= horizontal
    return rim & (labels > 0)
