"""Scores: evidence that adds up over parts, traits of a known square, the network of the contract."""

import numpy as np
import pytest

from kibs_steps.labels import rims
from kibs_steps.models import perceptron, scoring

N = len(scoring.TRAITS)
SCORE = {
    "mean": [0.5] * N,
    "spread": [2.0] * N,
    "layers": [{"weights": [[0.1 * k] for k in range(N)], "bias": [-0.3]}],
}


def seen(seed: int, side: int = 40):
    """Random images and maps, and the labels of a few overlapping rectangles: labels, rim, rgb, maps."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((side, side), np.int32)
    for label in range(1, 6):
        row, col = rng.integers(0, side - 4, 2)
        labels[row : row + rng.integers(3, 20), col : col + rng.integers(3, 20)] = label
    rgb = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
    sides = {"roof": 1, "edge": 1, "distance": 1, "slope": 2, "centre": 2}
    return (
        labels,
        rims(labels),
        rgb,
        {name: rng.random((n, side, side)).astype(np.float32) for name, n in sides.items()},
    )


@pytest.mark.parametrize("seed", range(5))
def test_evidence_of_parts_adds_up_to_that_of_the_whole(seed):
    labels, rim, rgb, maps = seen(seed)
    whole = scoring.evidence(labels, rim, rgb, maps, origin=(1000, 2000))
    parts = []
    for row, col in ((0, 0), (0, 23), (17, 0), (17, 23)):
        part = np.s_[row : 17 if row == 0 else 40, col : 23 if col == 0 else 40]
        cut = {name: values[:, *part] for name, values in maps.items()}
        origin = (1000 + col, 2000 + row)
        parts.append(scoring.evidence(labels[part], rim[part], rgb[part], cut, len(whole), origin))
    for label, expected in enumerate(whole):
        found = scoring.together(np.stack(parts)[:, label])
        np.testing.assert_allclose(found, expected)
    shifted = scoring.evidence(labels, rim, rgb, maps)
    some = shifted[:, scoring.EVIDENCE.index("area")] > 0
    np.testing.assert_allclose(scoring.traits(shifted[some]), scoring.traits(whole[some]), rtol=1e-6, atol=1e-6)


def test_traits_of_a_square():
    """6 × 6 px: 20 px of rim; edge 0.8 on it and 0.1 inside, roof 0.9, distance 1 in one pixel; one half looks 0.3 m per px down
    the columns and is dark, the other 0.4 along the rows and bright; all pixels see their middle 3 px east of it."""
    labels = np.zeros((10, 10), np.int32)
    labels[2:8, 2:8] = 1
    rim = rims(labels)
    rows, cols = np.mgrid[:10, :10].astype(float)
    slope, distance = np.zeros((2, 10, 10)), np.zeros((10, 10))
    slope[1, :, :5], slope[0, :, 5:], distance[4, 4] = 0.3, 0.4, 1.0
    rgb = np.where(cols < 5, 51, 102)[..., None].repeat(3, axis=2).astype(np.uint8)
    maps = {
        "roof": np.full((1, 10, 10), 0.9),
        "edge": np.where(rim, 0.8, 0.1)[None],
        "distance": distance[None],
        "slope": slope,
        "centre": np.stack([7.5 - cols, 4.5 - rows]),
    }
    found = scoring.traits(scoring.evidence(labels, rim, rgb, maps))[0]
    expected = {
        "area": np.log(36),
        "roof": 0.9,
        "rim": 0.8,
        "inside": 0.1,
        "summit": 0.9,
        "rim length": 400 / 576,
        "fill": 3 / np.pi,
        "evenness": 0.1,
        "slope": np.hypot(0.15, 0.2),
        "warp": np.hypot(0.15, 0.2),
        "aim off": 3 / 6,
        "aim spread": 0,
    }
    assert dict(zip(scoring.TRAITS, found, strict=True)) == pytest.approx(expected, abs=1e-6)


def test_scores_are_those_of_the_network_and_without_one_the_mean_roof():
    found = scoring.evidence(*seen(7))
    found[1] = 0  # nothing told
    told = np.arange(len(found)) != 1
    expected = perceptron.likely(scoring.traits(found[told]), SCORE)
    np.testing.assert_allclose(scoring.scores(found, SCORE)[told], expected, rtol=1e-6)
    roof, area = (found[:, scoring.EVIDENCE.index(name)] for name in ("roof", "area"))
    np.testing.assert_allclose(scoring.scores(found, None)[told], (roof / area)[told], rtol=1e-6)
    assert scoring.scores(found, SCORE)[1] == scoring.scores(found, None)[1] == 0
