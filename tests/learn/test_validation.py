"""Measures against cases counted by hand."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from kibs_steps.learn import validation
from kibs_steps.learn.samples import Sample
from kibs_steps.models import heads


@pytest.fixture
def truth() -> np.ndarray:
    labels = np.zeros((40, 40), np.int32)
    labels[0:10, 0:10] = 1
    labels[0:10, 10:20] = 2
    labels[20:30, 20:30] = 3
    labels[38:40, 38:40] = 4  # too small to ask for
    labels[0:10, 30:40] = -1
    return labels


def test_perfect_sections_have_precision_one(truth):
    found = np.maximum(truth, 0)
    match = validation.matches(found, np.full(4, 0.9), truth)
    assert match.truths == 3
    assert match.hits.all()
    assert validation.average_precision([match]) == pytest.approx(1.0)


def test_a_merged_and_an_invented_section_cost(truth):
    found = np.zeros_like(truth)
    found[0:10, 0:20] = 1  # two in one: overlap exactly one half with either
    found[20:30, 20:30] = 2
    found[20:30, 0:10] = 3  # not there
    found[0:10, 30:40] = 4  # on unknown ground: not judged
    match = validation.matches(found, np.array([0.5, 0.9, 0.8, 0.99]), truth, overlap=0.51)
    assert match.hits.tolist() == [True, False, False]
    assert validation.average_precision([match]) == pytest.approx(1 / 3)


def test_roof_iou_leaves_unknown_out():
    truth = np.array([[1, 1, 0, 255]], np.uint8)
    found = np.array([[True, False, True, True]])
    assert validation.roof_iou([(found, truth)]) == pytest.approx(1 / 3)


def test_sections_on_roofs_are_counted_where_roofs_are_known():
    found = np.zeros((4, 10), np.int32)
    found[:, :2], found[:, 2:4], found[:, 4:6], found[:, 6:8] = 1, 2, 3, 4
    roof = np.zeros((4, 10), np.uint8)
    roof[:, :2] = 1  # 1: on a roof; 2: beside it
    roof[:, 4:6] = [1, 255]  # 3: its known half is roof
    roof[:, 6:8], roof[0, 6] = 255, 0  # 4: hardly known, not asked
    assert validation.on_roofs([(found, roof)]) == 2 / 3
    assert validation.on_roofs([(found, roof), (found, np.zeros_like(roof))]) == 2 / 7
    assert validation.on_roofs([(np.zeros_like(found), roof)]) == 0.0


@pytest.mark.skipif("KIBS_DATA" not in os.environ, reason="needs real data: set KIBS_DATA")
def test_village_scenes_are_judged_only_where_they_are_annotated():
    scenes = validation.village(Path(os.environ["KIBS_DATA"]) / "village", 256)
    assert len(scenes) == 11
    for scene in scenes:
        assert scene.rgb.shape == (256, 256, 3)
        judged = scene.roof != validation.dataset.UNKNOWN
        assert judged.sum() == round(51.2 / 0.38) ** 2
        assert (scene.labels[~judged] == -1).all()
        assert ((scene.labels != 0) == (scene.roof == 1))[judged].all()


def shown(labels: np.ndarray, rim: float) -> dict[str, np.ndarray]:
    """A model's maps of sections it sees whole, with edges of height `rim` between them."""
    between = cv2.morphologyEx(labels.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
    inside = (~between & (labels > 0)).astype(np.uint8)
    distance = np.minimum(cv2.distanceTransform(inside, cv2.DIST_L2, 3) / 5, 1)
    maps = {"roof": (labels > 0) * 0.9, "edge": between * rim, "distance": distance}
    return {name: value[None].astype(np.float32) for name, value in maps.items()}


def test_the_best_decoding_keeps_apart_what_is_apart():
    labels = np.zeros((64, 64), np.int32)
    labels[8:30, 8:30], labels[8:30, 30:52], labels[36:60, 8:52] = 1, 2, 3
    sample = Sample.ground(np.zeros((64, 64, 3), np.uint8))
    sample = sample._replace(labels=labels, roof=(labels > 0).astype(np.uint8))
    contract = {"head": "dense", "thresholds": {"roof": 0.95, "prominence": 0.9, "min_area": 12}}
    sets = [([shown(labels, 0.6)], [sample]), ([shown(labels, 0.8)], [sample])]
    thresholds, score = validation.best_decoding(sets, contract)
    assert thresholds["roof"] < 0.9
    found = heads.decode_sections(
        sets[0][0][0], {**contract, "thresholds": {**thresholds, "min_area": 12}, "score": score}, sample.rgb
    )
    match = validation.matches(found.labels, found.scores, labels)
    assert match.hits.all()
    assert match.truths == len(match.hits) == 3
