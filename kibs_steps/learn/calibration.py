"""How likely is a found section right? A small network on its traits, fitted on scenes not trained on.

A mean roof probability says little about a section: small ones, those whose rim has no edge, and those whose pixels see other
middles than its own are wrong more often. The network goes into the contract (`score`), and a section's score is then the
probability that it meets a true one at IoU ≥ 0.5.

In: a network's maps of samples, sections found in them. Out: the contract's `score`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from kibs_steps.labels import rims
from kibs_steps.learn import fitting
from kibs_steps.learn.samples import Sample
from kibs_steps.models import heads, scoring

STEPS = 1500


def right(found: np.ndarray, truth: np.ndarray, overlap: float = 0.5) -> np.ndarray:
    """Whether each section 1…n of `found` (s, s) meets a section of `truth` (s, s; 0 none, −1 unknown) at that IoU: bool (n,)."""
    n, m = int(found.max(initial=0)), int(truth.max(initial=0))
    asked = np.maximum(truth, 0)
    joint = np.bincount((found * (m + 1) + asked).ravel(), minlength=(n + 1) * (m + 1)).reshape(n + 1, m + 1)
    union = joint.sum(1)[:, None] + joint.sum(0)[None] - joint
    return (joint / np.maximum(union, 1))[1:, 1:].max(1, initial=0) >= overlap


def score(
    shown: Iterable[tuple[dict[str, np.ndarray], Sample]], contract: dict[str, Any], steps: int = STEPS
) -> dict[str, Any] | None:
    """The `score` that fits what a contract's decoding finds in maps of samples; None if it finds nothing.

    Sections mostly on unknown ground say nothing.
    """
    traits, hits = [np.zeros((0, len(scoring.TRAITS)))], [np.zeros(0, bool)]
    for maps, sample in shown:
        found = heads.decode_sections(maps, contract, sample.rgb).labels
        known = heads.mean_by_label(sample.labels >= 0, found) > 0.5
        traits.append(scoring.traits(scoring.evidence(found, rims(found), sample.rgb, maps)[known]))
        hits.append(right(found, sample.labels)[known])
    seen, answers = np.concatenate(traits), np.concatenate(hits)
    return fitting.fitted(seen, answers, np.ones(len(seen)), steps) if len(seen) else None
