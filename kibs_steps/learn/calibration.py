"""How likely is a found section right? A logistic regression on its traits, fitted on scenes not trained on.

A mean roof probability says little about a section: small ones, and those whose rim has no edge, are wrong more often. The
weights go into the contract (`score`), and a section's score is then the probability that it meets a true one at IoU ≥ 0.5.

In: found sections with their traits (`models.scoring.traits`), true labels. Out: weights by trait, and a bias.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

RIDGE = 1.0  # weight of the squared coefficients (in standard deviations of their trait)


def right(found: np.ndarray, truth: np.ndarray, overlap: float = 0.5) -> np.ndarray:
    """Whether each section 1…n of `found` (s, s) meets a section of `truth` (s, s; 0 none, −1 unknown) at that IoU: bool (n,)."""
    n, m = int(found.max(initial=0)), int(truth.max(initial=0))
    asked = np.maximum(truth, 0)
    joint = np.bincount((found * (m + 1) + asked).ravel(), minlength=(n + 1) * (m + 1)).reshape(n + 1, m + 1)
    union = joint.sum(1)[:, None] + joint.sum(0)[None] - joint
    return (joint / np.maximum(union, 1))[1:, 1:].max(1, initial=0) >= overlap


def weights(traits: Sequence[dict[str, np.ndarray]], hits: Sequence[np.ndarray]) -> dict[str, float]:
    """Coefficients by trait and the `bias` of the most likely logistic model, with a small penalty on large ones."""
    names = list(traits[0])
    x = np.concatenate([np.column_stack([t[name] for name in names]) for t in traits])
    y = np.concatenate(list(hits)).astype(float)
    mean, spread = x.mean(0), x.std(0) + 1e-6
    z = np.column_stack([(x - mean) / spread, np.ones(len(x))])

    def cost(w: np.ndarray) -> tuple[float, np.ndarray]:
        logit = z @ w
        gradient = z.T @ (1 / (1 + np.exp(-logit)) - y)
        gradient[:-1] += RIDGE * w[:-1]
        return float((np.logaddexp(0, logit) - y * logit).sum() + RIDGE / 2 * (w[:-1] ** 2).sum()), gradient

    w = minimize(cost, np.zeros(z.shape[1]), jac=True, method="L-BFGS-B").x
    slopes = w[:-1] / spread
    found = {name: round(float(v), 5) for name, v in zip(names, slopes, strict=True)}
    return {**found, "bias": round(float(w[-1] - slopes @ mean), 5)}
