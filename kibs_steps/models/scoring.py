"""Scoring: how likely a section that a dense network shows is right.

In: a network's maps and the labels decoded from them. Out: **evidence**, sums that can be added up where a section is cut by
seams; **traits**, what tells good sections from bad ones; and from them, by the weights of the contract, a score.
"""

from __future__ import annotations

import numpy as np

EVIDENCE = ("area", "length", "roof", "rim", "inside", "summit")


def evidence(
    labels: np.ndarray, rim: np.ndarray, roof: np.ndarray, edge: np.ndarray, distance: np.ndarray, n: int | None = None
) -> np.ndarray:
    """What the maps say of each section 1…n (n, 6), columns `EVIDENCE`: number of pixels and of `rim` pixels, sums of `roof`, of
    `edge` on the rim and inside, highest distance − edge. That of a section's parts adds up to its own (`together`)."""
    n = int(labels.max(initial=0)) if n is None else n
    level = distance - edge
    summit = np.full(n + 1, -np.inf, level.dtype)  # numpy is quick where no value changes its type
    np.maximum.at(summit, labels.ravel(), level.ravel())

    def total(where: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
        weights = None if values is None else values[where].astype(np.float64)
        return np.bincount(labels[where], weights, n + 1)

    on, off = rim & (labels > 0), ~rim & (labels > 0)
    columns = [total(on | off), total(on), total(on | off, roof), total(on, edge), total(off, edge), summit]
    return np.column_stack(columns)[1:].astype(np.float64)


def none(n: int) -> np.ndarray:
    """Evidence (n, 6) of sections of which nothing is told."""
    return np.zeros((n, len(EVIDENCE)))


def together(parts: np.ndarray) -> np.ndarray:
    """Evidence (6,) of a section from that of its parts (k, 6)."""
    return np.append(parts[:, :-1].sum(axis=0), parts[:, -1].max())


def traits(found: np.ndarray) -> dict[str, np.ndarray]:
    """What tells good sections from bad ones, (n,) each, from their `evidence` (n, 6): area (log px), mean roof probability, mean
    edge on the rim and inside, height of the summit, and the rim's length against that of a square of the same area."""
    area, length, roof, rim, inside, summit = found.T
    return {
        "log_area": np.log(np.maximum(area, 1)),
        "roof": roof / np.maximum(area, 1),
        "rim": rim / np.maximum(length, 1),
        "inside": inside / np.maximum(area - length, 1),
        "summit": summit,
        "rim_length": length**2 / (16.0 * np.maximum(area, 1)),
    }


def sure(found: np.ndarray, least: float) -> np.ndarray:
    """Which sections (n,) bool are roofs by their `evidence` (n, 6): of a mean roof probability of `least`, or nothing told."""
    return (found[:, 0] == 0) | (traits(found)["roof"] >= least)


def scores(found: np.ndarray, score: dict[str, float] | None) -> np.ndarray:
    """How likely sections are right (n,) float32, from their `evidence` and the contract's weights of `traits`; without weights
    their mean roof probability."""
    seen = traits(found)
    if score is None:
        return seen["roof"].astype(np.float32)
    logit = sum((score[name] * value for name, value in seen.items()), start=np.float64(score["bias"]))
    return (1 / (1 + np.exp(-logit))).astype(np.float32)
