"""Joining: which basins of a watershed are one roof section, learned from what lies between them and what they look like.

A watershed of a network's maps finds several basins in most sections. Neighbours are joined step by step: **traits** of every
pair (the rim between them, the roof on both sides, the shape of both together) go through a small network of the contract
(`join`) that tells how likely they are one section, and pairs that are each other's likeliest join, until none is likely enough.
Traits follow from sums that add up as basins join; nothing depends on the order of work. (Agglomeration by a learned policy, as
Nunez-Iglesias et al. 2013 do for neurons.)

In: basins of one tile, its image, the network's maps. Out: sections. Pixels count from 0, so a pixel's middle is a whole number
here; only differences matter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kibs_steps.models import perceptron, regions

# Sums over the pixel edges between two basins, and the highest pass.
RIM = ("length", "x", "y", "xx", "xy", "yy", "edge", "level", "contrast", "pass")
TRAITS = (
    "rim edge",  # means along the common rim
    "rim level",
    "highest pass",
    "lower summit",
    "higher summit",
    "lower rise",  # of the lower summit above the pass
    "smaller area",  # log px
    "larger area",
    "rim share",  # log of the rim's length against the smaller side's width
    "rim bend",  # 0 for a straight rim
    "brightness apart",  # of the two means
    "colour apart",
    "brightness told apart",  # in standard deviations
    "rim contrast",
    "evenness least",  # standard deviation of brightness within a side
    "evenness most",
    "roof least",
    "roof most",
    "edge least",
    "edge most",
    "slope apart",  # m per px, as the network sees the two planes
    "slope told apart",  # in standard deviations
    "slope least",
    "slope most",
    "aims apart",  # of the middles that pixels see, in sides of a square of both areas
    "aims told apart",  # in standard deviations
    "aim off together",  # of the middle that pixels see from the shape's own, in sides of a square of its area
    "aim off least",
    "aim off most",
    "fill together",  # share of the ellipse of inertia
    "fill least",
    "fill most",
)
STEPS = 60  # more than any tile takes: each joins at least the likeliest pair, most join a third of all basins


class Graph(NamedTuple):
    """Basins, as sums (n, 19), and pairs of neighbours (m, 2), the smaller number first, counted from 0, with sums of their
    common rim (m, 10): columns regions.COLUMNS and RIM, float64."""

    basins: np.ndarray
    pairs: np.ndarray
    rims: np.ndarray


def sections(
    basins: np.ndarray, rgb: np.ndarray, maps: dict[str, np.ndarray], level: np.ndarray, join: dict[str, Any]
) -> np.ndarray:
    """Sections (s, s) int32, 0 none, of basins 1…n (s, s) by the contract's `join`; image and maps as in `graph`."""
    found = joined(graph(basins, rgb, maps, level), lambda seen: perceptron.likely(seen, join), join["least"])
    return np.append(0, found + 1)[basins].astype(np.int32)


def graph(basins: np.ndarray, rgb: np.ndarray, maps: dict[str, np.ndarray], level: np.ndarray) -> Graph:
    """Sums of basins 1…n (s, s) and of their common rims: rgb uint8 (s, s, 3), a network's `maps` (C, s, s), `level` (s, s) that
    whose summits they are."""
    edge = maps["edge"][0]
    grey = rgb.mean(axis=2) / 255.0
    pairs, rims = [], []
    for down, right in ((1, 0), (0, 1)):
        one, other = np.s_[down:, right:], np.s_[: basins.shape[0] - down, : basins.shape[1] - right]
        row, col = np.nonzero((basins[one] != basins[other]) & (basins[one] > 0) & (basins[other] > 0))
        here, there = (row + down, col + right), (row, col)
        pairs.append(np.sort(np.stack([basins[here], basins[there]], axis=1), axis=1).astype(np.int64) - 1)
        x, y = col + right / 2, row + down / 2
        height = np.minimum(level[here], level[there])
        contrast = np.abs(grey[here] - grey[there])
        along = np.maximum(edge[here], edge[there])
        rims.append(np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y, along, height, contrast, height]))
    sums = regions.sums(basins, rgb, maps, level)
    return Graph(sums, *_gathered(np.concatenate(pairs), np.concatenate(rims).astype(np.float64)))


def _gathered(pairs: np.ndarray, rims: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every pair once, in order, with the sums of all its rims."""
    if not len(pairs):
        return pairs, rims
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs, rims = pairs[order], rims[order]
    first = np.flatnonzero(np.append(True, (np.diff(pairs, axis=0) != 0).any(axis=1)))
    sums = np.add.reduceat(rims, first, axis=0)
    sums[:, -1] = np.maximum.reduceat(rims[:, -1], first)
    return pairs[first], sums


def merged(seen: Graph, number: np.ndarray) -> Graph:
    """The graph once basins of equal `number` (n,), counted from 0, are one."""
    sums = regions.merged(seen.basins, number, int(number.max(initial=-1)) + 1)
    pairs = np.sort(number[seen.pairs], axis=1)
    apart = pairs[:, 0] != pairs[:, 1]
    return Graph(sums, *_gathered(pairs[apart], seen.rims[apart]))


def joined(
    seen: Graph,
    chance: Callable[[np.ndarray], np.ndarray],
    least: float,
    watch: Callable[[Graph, np.ndarray, np.ndarray], None] | None = None,
) -> np.ndarray:
    """The section (n,), counted from 0, of every basin of a graph.

    `chance` tells from traits (m, 32) how likely pairs are one section; those of at least `least` may join. `watch` is called
    before every step with the graph, its traits and the section of every basin so far.
    """
    of = np.arange(len(seen.basins))
    for _ in range(STEPS):
        if not len(seen.pairs):
            break
        shown = traits(seen)
        if watch:
            watch(seen, shown, of)
        number = partners(seen.pairs, chance(shown), len(seen.basins), least)
        if number.max() + 1 == len(seen.basins):
            break
        seen, of = merged(seen, number), number[of]
    return of


def partners(pairs: np.ndarray, chance: np.ndarray, n: int, least: float) -> np.ndarray:
    """New numbers (n,), counted from 0, once pairs (m, 2) have joined that are each other's likeliest; of equals the first."""
    best = np.full(n, -np.inf)
    np.maximum.at(best, pairs.ravel(), np.repeat(chance, 2))
    ready = (chance >= least) & (chance >= best[pairs].max(axis=1))
    number, free = np.arange(n), np.ones(n, bool)
    for one, other in pairs[ready]:
        if free[one] and free[other]:
            number[other] = one
            free[[one, other]] = False
    return np.unique(number, return_inverse=True)[1]


def traits(seen: Graph) -> np.ndarray:
    """What tells whether pairs of neighbours are one section, (m, 32), columns TRAITS; the same whichever is named first."""
    one, other = seen.basins[seen.pairs[:, 0]], seen.basins[seen.pairs[:, 1]]
    length = seen.rims[:, 0]
    areas = np.sort(np.stack([one[:, 0], other[:, 0]]), axis=0)
    summits = np.sort(np.stack([one[:, -1], other[:, -1]]), axis=0)
    apart, tilted, aimed = (
        regions.mean(one, columns) - regions.mean(other, columns)
        for columns in (regions.COLOUR, regions.SLOPE, regions.AIM)
    )
    brightness = apart.mean(axis=1)
    varied, warped, scattered = (
        np.stack([variance(one), variance(other)])
        for variance in (regions.brightness_variance, regions.slope_variance, regions.aim_variance)
    )
    whole = one + other
    tilt, aim = np.linalg.norm(tilted, axis=1), np.linalg.norm(aimed, axis=1)
    long, short = regions.spread(seen.rims)

    def both(of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return np.sort(np.stack([of(one), of(other)]), axis=0)

    return np.column_stack(
        [
            seen.rims[:, 6] / length,
            seen.rims[:, 7] / length,
            seen.rims[:, -1],
            *summits,
            summits[0] - seen.rims[:, -1],
            *np.log(areas),
            np.log(length / np.sqrt(areas[0])),
            short / long,
            np.abs(brightness),
            np.sqrt(((apart - brightness[:, None]) ** 2).sum(axis=1)),
            np.abs(brightness) / np.sqrt(varied.sum(axis=0) + 1e-4),
            seen.rims[:, 8] / length,
            *np.sort(np.sqrt(varied), axis=0),
            *both(lambda side: regions.mean(side, "roof")),
            *both(lambda side: regions.mean(side, "edge")),
            tilt,
            tilt / np.sqrt(warped.sum(axis=0) + 1e-4),
            *both(lambda side: np.linalg.norm(regions.mean(side, regions.SLOPE), axis=1)),
            aim / np.sqrt(areas.sum(axis=0)),
            aim / np.sqrt(scattered.sum(axis=0) + 1),
            regions.aim_off(whole),
            *both(regions.aim_off),
            regions.fill(whole),
            *both(regions.fill),
        ]
    )
