"""Scores: evidence that adds up over parts, traits of a known square, the logistic law."""

import numpy as np
import pytest

from kibs_steps.labels import rims
from kibs_steps.models import scoring

WEIGHTS = {"bias": -1.0, "log_area": 0.5, "roof": 1.0, "rim": 2.0, "inside": -3.0, "summit": 0.2, "rim_length": -0.1}


def maps(seed: int, side: int = 40):
    """Random maps and the labels of a few overlapping rectangles."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((side, side), np.int32)
    for label in range(1, 6):
        row, col = rng.integers(0, side - 4, 2)
        labels[row : row + rng.integers(3, 20), col : col + rng.integers(3, 20)] = label
    return labels, rims(labels), *rng.random((3, side, side)).astype(np.float32)


@pytest.mark.parametrize("seed", range(5))
def test_evidence_of_parts_adds_up_to_that_of_the_whole(seed):
    shown = maps(seed)
    whole = scoring.evidence(*shown)
    quarters = [np.s_[:17, :23], np.s_[:17, 23:], np.s_[17:, :23], np.s_[17:, 23:]]
    parts = np.stack([scoring.evidence(*(m[q] for m in shown), n=len(whole)) for q in quarters])
    for label, expected in enumerate(whole):
        np.testing.assert_allclose(scoring.together(parts[:, label]), expected)


def test_traits_of_a_square():
    """6 × 6 px: 20 px of rim; edge 0.8 on it and 0.1 inside, roof 0.9, distance 1 in one pixel."""
    labels = np.zeros((10, 10), np.int32)
    labels[2:8, 2:8] = 1
    rim = rims(labels)
    edge, distance = np.where(rim, 0.8, 0.1), np.zeros((10, 10))
    distance[4, 4] = 1.0
    found = scoring.traits(scoring.evidence(labels, rim, np.full((10, 10), 0.9), edge, distance))
    expected = {"log_area": np.log(36), "roof": 0.9, "rim": 0.8, "inside": 0.1, "summit": 0.9, "rim_length": 400 / 576}
    assert {name: value[0] for name, value in found.items()} == pytest.approx(expected)


def test_scores_are_logistic_and_without_weights_the_mean_roof():
    found = scoring.evidence(*maps(7))
    seen = scoring.traits(found)
    logit = WEIGHTS["bias"] + sum(WEIGHTS[name] * seen[name] for name in seen)
    np.testing.assert_allclose(scoring.scores(found, WEIGHTS), 1 / (1 + np.exp(-logit)), rtol=1e-6)
    np.testing.assert_allclose(scoring.scores(found, None), found[:, 2] / found[:, 0], rtol=1e-6)
