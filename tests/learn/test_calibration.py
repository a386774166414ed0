"""Weights of a known law come back; a section is right where it meets a true one."""

import numpy as np

from kibs_steps.learn import calibration
from kibs_steps.models import heads


def test_weights_of_a_known_law_come_back():
    rng = np.random.default_rng(0)
    n = 20000
    traits = {"log_area": rng.normal(5, 1, n), "rim": rng.uniform(0, 1, n)}
    logit = 1.5 * traits["log_area"] - 2.0 * traits["rim"] - 6.0
    hits = rng.random(n) < 1 / (1 + np.exp(-logit))
    found = calibration.weights([traits], [hits])
    np.testing.assert_allclose([found["log_area"], found["rim"], found["bias"]], (1.5, -2.0, -6.0), atol=0.2)


def test_right_is_iou_by_brute_force():
    rng = np.random.default_rng(1)
    found = np.kron(rng.integers(0, 5, (4, 4)), np.ones((5, 5), int))
    truth = np.roll(found, 1, axis=0)
    truth[:3] = -1
    expected = []
    for i in range(1, found.max() + 1):
        ious = [
            ((found == i) & (truth == j)).sum() / ((found == i) | (truth == j)).sum() for j in range(1, truth.max() + 1)
        ]
        expected.append(max(ious) >= 0.5)
    np.testing.assert_array_equal(calibration.right(found, truth), expected)


def test_scores_follow_the_weights():
    """With weight on the area alone, the larger of two sections scores higher, by the logistic function of its logarithm."""
    roof = np.zeros((32, 32))
    roof[2:8, 2:8] = roof[12:30, 4:28] = 1
    weights = dict.fromkeys(("roof", "rim", "inside", "summit", "rim_length"), 0.0) | {"log_area": 1.0, "bias": -5.0}
    found = heads.dense_sections(roof, 0 * roof, roof, {"roof": 0.5, "prominence": 0.2, "min_area": 4}, weights)
    area = np.bincount(found.labels.ravel())[1:]
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp(5.0) / area), rtol=1e-5)
