"""Fitting the small networks of a contract (`models.perceptron`) to traits and answers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from torch import nn

HIDDEN = (24, 24)
MOST = 1_500_000  # rows to learn from at once
STEPS, BATCH, RATE, DECAY = 4000, 2048, 5e-3, 1e-3


def fitted(
    traits: np.ndarray, answers: np.ndarray, weight: np.ndarray, steps: int = STEPS, seed: int = 0
) -> dict[str, Any]:
    """Terms (`mean`, `spread`, `layers`) of the network that tells best from traits (m, k) the answers (m,) bool, which count by
    their weight (m,)."""
    chosen = np.random.default_rng(seed).permutation(len(answers))[:MOST]
    mean = traits[chosen].mean(axis=0).round(5)
    spread = (traits[chosen].std(axis=0) + 1e-4).round(5)
    x = torch.from_numpy(np.clip((traits[chosen] - mean) / spread, -5, 5)).float()
    y, w = (torch.from_numpy(part[chosen]).float() for part in (answers, weight))
    torch.manual_seed(seed)
    sides = (x.shape[1], *HIDDEN)
    parts = [part for a, b in itertools.pairwise(sides) for part in (nn.Linear(a, b), nn.ReLU())]
    network = nn.Sequential(*parts, nn.Linear(HIDDEN[-1], 1))
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=RATE / 500)
    for _ in range(steps):
        part = torch.randint(len(x), (BATCH,))
        loss = nn.functional.binary_cross_entropy_with_logits(network(x[part])[:, 0], y[part], reduction="none")
        optimiser.zero_grad()
        ((loss * w[part]).sum() / w[part].sum()).backward()
        optimiser.step()
        schedule.step()
    layers = [
        {"weights": rounded(layer.weight.T), "bias": rounded(layer.bias)}
        for layer in network
        if isinstance(layer, nn.Linear)
    ]
    return {"mean": mean.tolist(), "spread": spread.tolist(), "layers": layers}


def rounded(values: torch.Tensor) -> Any:
    """Nested lists of numbers that are short to write."""
    return values.detach().double().numpy().round(5).tolist()
