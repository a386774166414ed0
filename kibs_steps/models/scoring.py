"""Scoring: how likely a section that a dense network shows is right.

In: a network's maps, its image and the labels decoded from them. Out: **evidence**, sums that can be added up where a section is
cut by seams; **traits**, what tells good sections from bad ones; and from them, by the small network of the contract
(`score`), a score.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kibs_steps.models import perceptron, regions

EVIDENCE = ("length", "rim", *regions.COLUMNS)  # rim pixels, the sum of `edge` on them; then what regions say
TRAITS = (
    "area",  # log px
    "roof",  # means: on all pixels, `edge` on the rim and inside
    "rim",
    "inside",
    "summit",  # highest distance − edge
    "rim length",  # against that of a square of the same area
    "fill",  # share of the ellipse of inertia
    "evenness",  # standard deviation of brightness
    "slope",  # m per px, as the network sees the plane
    "warp",  # standard deviation of slope
    "aim off",  # of the middle that pixels see from the section's own, in sides of a square of its area
    "aim spread",
)


def evidence(
    labels: np.ndarray,
    rim: np.ndarray,
    rgb: np.ndarray,
    maps: dict[str, np.ndarray],
    n: int | None = None,
    origin: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """What image and maps say of each section 1…n of labels (s, s): (n, 21), columns EVIDENCE.

    `rim` is bool (s, s): where sections have their rim. The rest is as in `regions.sums`. What is said of a section's parts adds
    up to its own evidence (`together`).
    """
    n = int(labels.max(initial=0)) if n is None else n
    edge = maps["edge"][0]
    on = rim & (labels > 0)
    length, along = np.bincount(labels[on], minlength=n + 1), np.bincount(labels[on], edge[on].astype(float), n + 1)
    rest = regions.sums(labels, rgb, maps, maps["distance"][0] - edge, n, origin)
    return np.column_stack([length[1:], along[1:], rest])


def none(n: int) -> np.ndarray:
    """Evidence (n, 21) of sections of which nothing is told."""
    return np.zeros((n, len(EVIDENCE)))


def together(parts: np.ndarray) -> np.ndarray:
    """Evidence (21,) of a section from that of its parts (k, 21)."""
    return regions.merged(parts, np.zeros(len(parts), int), 1)[0]


def told(found: np.ndarray) -> np.ndarray:
    """Of which sections (n,) bool anything is told."""
    return found[:, EVIDENCE.index("area")] > 0


def traits(found: np.ndarray) -> np.ndarray:
    """What tells good sections from bad ones, (n, 12), columns TRAITS, from their `evidence` (n, 21)."""
    length, along = found[:, 0], found[:, 1]
    seen = found[:, 2:]
    area = seen[:, 0]
    edge = seen[:, regions.COLUMNS.index("edge")]
    return np.column_stack(
        [
            np.log(area),
            regions.mean(seen, "roof"),
            along / np.maximum(length, 1),
            (edge - along) / np.maximum(area - length, 1),
            seen[:, -1],
            length**2 / (16.0 * area),
            regions.fill(seen),
            np.sqrt(regions.brightness_variance(seen)),
            np.linalg.norm(regions.mean(seen, regions.SLOPE), axis=1),
            np.sqrt(regions.slope_variance(seen)),
            regions.aim_off(seen),
            np.sqrt(regions.aim_variance(seen) / area),
        ]
    )


def sure(roof: np.ndarray, scores: np.ndarray, thresholds: dict[str, float]) -> np.ndarray:
    """Which sections (n,) bool are roofs, by their mean roof probability (n,) and their scores (n,).

    It is at least `thresholds.sure`, or `surer` where a section is less `likely` right than that: pieces of yards look like no
    section that is known, but so do roofs of a kind never seen, of which the roof is sure.
    """
    least = thresholds.get("sure", 0.0)
    unlikely = scores < thresholds.get("likely", 0.0)
    return roof >= np.where(unlikely, thresholds.get("surer", least), least)


def roofs(found: np.ndarray, scores: np.ndarray, thresholds: dict[str, float]) -> np.ndarray:
    """Which sections (n,) bool are roofs by their `evidence` (n, 21), as `sure` asks; those of which nothing is told are."""
    known = told(found)
    stays = ~known
    stays[known] = sure(regions.mean(found[known, 2:], "roof"), scores[known], thresholds)
    return stays


def scores(found: np.ndarray, score: dict[str, Any] | None) -> np.ndarray:
    """How likely sections are right (n,) float32, from their `evidence` by the contract's `score`; without one their mean roof
    probability; 0 where nothing is told."""
    known = told(found)
    answer = np.zeros(len(found), np.float32)
    seen = found[known]
    answer[known] = regions.mean(seen[:, 2:], "roof") if score is None else perceptron.likely(traits(seen), score)
    return answer
