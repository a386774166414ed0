"""Loss terms of the dense network: from its logits and a batch of targets to named numbers.

A term is a mean over what is known: pixels without truth do not count. In: raw maps by name (`architectures.Dense.logits`),
targets by name (`examples.example`). Pure functions.
"""

from __future__ import annotations

import numpy as np
import torch
from torch.nn import functional as F

from kibs_steps.learn import targets
from kibs_steps.learn.architectures import CENTRE_UNIT

EDGES, CENTRES = targets.height_bins()
STEEPEST = 1.5  # m of height per px: faces that turn away from the view rise endlessly

Batch = dict[str, torch.Tensor]


def section_losses(raw: Batch, batch: Batch) -> Batch:
    """Loss terms of sections from logits; pixels without truth do not count."""
    roof, known = batch["roof"], batch["sections_known"]
    judged = (roof != targets.IGNORED).float()
    truth = (roof == 1).float()
    logit = raw["roof"][:, 0]
    probability = torch.sigmoid(logit) * judged
    overlap = 2 * (probability * truth).sum() + 1
    dice = 1 - overlap / ((probability + truth * judged).sum() + 1)
    entropy = F.binary_cross_entropy_with_logits(logit, truth, reduction="none")
    edge = (batch["edge"] == 1).float()
    edge_entropy = F.binary_cross_entropy_with_logits(raw["edge"][:, 0], edge, reduction="none")
    far = raw["distance"][:, 0]
    # Ground far from any section is easy and plentiful; sections carry the weight.
    weight = known * torch.where(batch["distance"] > 0, 4.0, 1.0)
    far_error = (torch.sigmoid(far) - batch["distance"]).abs()
    far_entropy = F.binary_cross_entropy_with_logits(far, batch["distance"], reduction="none")
    total = weight.sum().clamp(min=1)
    half = targets.HEIGHT_STRIDE // 2
    cells = (
        torch.isfinite(batch["centre"]) * known[:, None, half :: targets.HEIGHT_STRIDE, half :: targets.HEIGHT_STRIDE]
    )
    centre_error = (raw["centre"] - torch.nan_to_num(batch["centre"]) / CENTRE_UNIT).abs() * cells
    return {
        "roof": (entropy * judged).sum() / judged.sum().clamp(min=1) + 0.5 * dice,
        "edge": (edge_entropy * known * (1 + 3 * edge)).sum() / known.sum().clamp(min=1),
        "distance": (weight * (far_error + 0.5 * far_entropy)).sum() / total,
        "centre": 0.5 * centre_error.sum() / cells.sum().clamp(min=1),
    }


def corner_losses(raw: Batch, batch: Batch) -> Batch:
    """Loss terms of corners: focal heatmap and L1 offset (CenterNet, Zhou et al. 2019)."""
    heat, known = batch["heat"], batch["corners_known"].float()
    logit = raw["corner"][:, 0]
    probability = torch.sigmoid(logit).clamp(1e-4, 1 - 1e-4)
    peak = (heat == 1).float() * known
    hit = -((1 - probability) ** 2) * F.logsigmoid(logit) * peak
    miss = -((1 - heat) ** 4) * probability**2 * F.logsigmoid(-logit) * known * (1 - peak)
    at_corner = torch.isfinite(batch["offset"])
    offset = 0.5 * torch.tanh(raw["offset"])
    offset_error = (offset - torch.nan_to_num(batch["offset"])).abs() * at_corner
    return {
        "corner": 0.4 * (hit + miss).sum() / peak.sum().clamp(min=1),
        "offset": offset_error.sum() / at_corner.sum().clamp(min=1),
    }


def surface_losses(raw: Batch, batch: Batch) -> Batch:
    """Loss term of the kinds of surface, which both sections and heights follow from."""
    share = batch["surface"]
    known = share.sum(1) > 0
    surface = -(share * F.log_softmax(raw["surface"], dim=1)).sum(1)
    return {"surface": surface.sum() / known.sum().clamp(min=1)}


def slope_losses(raw: Batch, batch: Batch) -> Batch:
    """Loss terms of the slope of roofs, which tells sections apart and goes with heights."""
    sloped = torch.isfinite(batch["slope"])
    truth = torch.nan_to_num(batch["slope"]).clamp(-STEEPEST, STEEPEST)
    return {
        name: 3 * ((raw[name] - truth).abs() * sloped).sum() / sloped.sum().clamp(min=1)
        for name in ("slope", "roof_slope")
        if name in raw
    }


def height_losses(raw: Batch, batch: Batch) -> Batch:
    """Loss terms of heights: their distribution and its mean."""
    log_height = F.log_softmax(raw["height"], dim=1)
    centres = torch.from_numpy(CENTRES).float().to(log_height.device)

    def height_loss(height: torch.Tensor) -> torch.Tensor:
        cells = torch.isfinite(height).nonzero(as_tuple=True)
        soft = targets.height_distribution(height[cells].cpu().numpy().astype(np.float64), EDGES, CENTRES)
        chosen = log_height.permute(0, 2, 3, 1)[cells]
        off = F.smooth_l1_loss(chosen.exp() @ centres, height[cells], reduction="sum", beta=1.0)
        return (0.2 * off - (torch.from_numpy(soft).to(chosen.device) * chosen).sum()) / max(len(cells[0]), 1)

    return {
        "height": 0.4 * height_loss(batch["corner_height"]),
        "roof_height": 0.6 * height_loss(batch["roof_height"]),
    }


TERMS = {
    "sections": (section_losses, surface_losses, slope_losses),
    "corners": (corner_losses, surface_losses, height_losses, slope_losses),
    "both": (section_losses, corner_losses, surface_losses, height_losses, slope_losses),
}


def losses(raw: Batch, batch: Batch, task: str) -> Batch:
    """All loss terms of a task."""
    return {name: value for terms in TERMS[task] for name, value in terms(raw, batch).items()}
