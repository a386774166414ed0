"""A section is right where it meets a true one; a score tells which are."""

import numpy as np
import toy
from scipy import ndimage

from kibs_steps.learn import calibration
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import heads


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


def scene(seed: int):
    """Square roofs, some of them cut into quarters by edges that are none: maps, sample."""
    rng = np.random.default_rng(seed)
    labels, edge = np.zeros((96, 96), np.int32), np.zeros((96, 96))
    for i, (row, col) in enumerate(np.argwhere(np.ones((4, 4))) * 24 + 4, start=1):
        labels[row : row + 16, col : col + 16] = i
        if rng.random() < 0.5:
            edge[row : row + 16, col + 7 : col + 9] = edge[row + 7 : row + 9, col : col + 16] = 0.9
    roof = (labels > 0).astype(float)
    distance = np.minimum(ndimage.distance_transform_edt((roof > 0) & (edge == 0)) / 5, 1)
    sample = Sample.ground(np.zeros((96, 96, 3), np.uint8))._replace(labels=labels, roof=roof.astype(np.uint8))
    return {"roof": roof[None], "edge": edge[None], "distance": distance[None]}, sample


def test_a_score_tells_right_from_wrong():
    """Quarters are wrong and squares are right: on other scenes the one score low, the other high."""
    contract = {"head": "dense", "thresholds": {"roof": 0.5, "prominence": 0.2, "min_area": 6}}
    score = calibration.score([scene(seed) for seed in range(6)], contract, steps=300)
    contracts.validate(toy.contract("sections", score=score), "fitted")
    maps, sample = scene(99)
    found = heads.decode_sections(maps, {**contract, "score": score}, sample.rgb)
    right = calibration.right(found.labels, sample.labels)
    assert 0 < right.sum() < len(right)
    assert found.scores[right].min() > 0.8
    assert found.scores[~right].max() < 0.2
    again = calibration.score([scene(seed) for seed in range(6)], contract, steps=300)
    assert again == score


def test_what_is_unknown_says_nothing():
    maps, sample = scene(0)
    contract = {"head": "dense", "thresholds": {"roof": 0.5, "prominence": 0.2, "min_area": 6}}
    assert calibration.score([(maps, sample._replace(labels=np.full_like(sample.labels, -1)))], contract) is None
