"""Perceptrons: the small networks of a contract (`join`, `score`) that tell from a few traits how likely something is.

In: traits, and terms of a contract: `mean` and `spread` of the traits, `layers`. Out: probabilities.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def likely(traits: np.ndarray, terms: dict[str, Any]) -> np.ndarray:
    """Probabilities (m,) from traits (m, k), clipped to five standard deviations: layers with ReLU between, then logistic."""
    x = np.clip((traits - terms["mean"]) / terms["spread"], -5, 5)
    *hidden, last = terms["layers"]
    for layer in hidden:
        x = np.maximum(x @ np.asarray(layer["weights"]) + layer["bias"], 0)
    return 1 / (1 + np.exp(-(x @ np.asarray(last["weights"]) + last["bias"])[:, 0]))


def leads(terms: dict[str, Any], n: int) -> bool:
    """Whether terms lead from n traits to one number, each layer taking what the one before gives."""
    sides = [n]
    for layer in terms["layers"]:
        rows, width = len(layer["weights"]), len(layer["bias"])
        if rows != sides[-1] or any(len(row) != width for row in layer["weights"]):
            return False
        sides.append(width)
    return sides[-1] == 1 and len(terms["mean"]) == len(terms["spread"]) == n
