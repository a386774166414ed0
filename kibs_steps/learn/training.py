"""Training the dense network within a time budget, resumed where a kill left it.

One network learns sections, corners and heights at once. Part of its tiles are blended with sections as a model might find them:
so the same weights serve as 2D model on the image and as 3D model on the blended one (`learn.export`).

In: a data folder (`roofgraph/`, `chips/`), and a pool of simulated tiles which a background process fills. Out, below `--out`:
`checkpoint.pt` (weights, their running mean, optimiser, steps and seconds used; written whole every few minutes) and
`log/` for TensorBoard. The same command continues a run that was killed; with its budget used it ends at once.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset

from kibs_steps import cli, store
from kibs_steps.blend import blend
from kibs_steps.learn import dataset, targets
from kibs_steps.learn.architectures import SURFACES, Dense, normalised
from kibs_steps.models.contract import ContractMismatch

DISTANCE_CLIP = 5.0  # px
BLEND = {"inside": [None, None, 255], "rim": [None, None, 128], "outside": [None, None, 0]}
SHARES = (0.62, 0.23, 0.15)  # simulated, pasted houses, chips
BLENDED = 0.4  # share of tiles that are shown blended
EDGES, CENTRES = targets.height_bins()

Batch = dict[str, torch.Tensor]


class Settings(NamedTuple):
    """What a run is: stored with its checkpoint."""

    seed: int
    size: int = 192
    batch: int = 8
    rate: float = 2e-3
    decay: float = 0.02


class Examples(Dataset):
    """Tiles of a mixture with their targets, as arrays a DataLoader can stack."""

    def __init__(self, mixture: dataset.Mixture):
        self.mixture = mixture

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self.mixture.seed, index, 1])
        return example(self.mixture[index], rng, bool(rng.random() < BLENDED))


class Onwards(torch.utils.data.Sampler):
    """Indices from `start` without end: a resumed run sees new tiles, not its first ones again."""

    def __init__(self, start: int):
        self.start = start

    def __iter__(self):
        return iter(range(self.start, 2**31))


def example(sample: dataset.Sample, rng: np.random.Generator, blended: bool) -> dict[str, np.ndarray]:
    """Image, plain or blended with sections as a model might find them, geometry and all targets.

    A blended image shows the sections: what it is asked for is corners and heights.
    """
    size = sample.labels.shape
    plain = np.float32(not blended)
    return {
        "image": (painted(sample, rng) if blended else sample.rgb).transpose(2, 0, 1).copy(),
        "geometry": sample.geometry,
        "roof": np.where(blended, np.uint8(targets.IGNORED), sample.roof),
        "edge": targets.edge(sample.labels),
        "distance": targets.distance(sample.labels, DISTANCE_CLIP),
        "sections_known": plain * (sample.labels >= 0).astype(np.float32) * targets.section_weight(sample.labels),
        "heat": targets.corner_heat(sample.corners, size),
        "offset": targets.corner_offset(sample.corners, size),
        "corners_known": sample.corners_known,
        "surface": targets.surface(sample.surface, SURFACES),
        "slope": targets.slope(sample.labels, sample.height),
        "corner_height": targets.corner_height(sample.corners, sample.corner_heights, size),
        "roof_height": targets.roof_height(sample.height),
    }


def painted(sample: dataset.Sample, rng: np.random.Generator) -> np.ndarray:
    """The image (s, s, 3) uint8 blended with sections, mostly wrong in the ways models are wrong."""
    labels = np.maximum(sample.labels, 0)
    areas = ndimage.label((sample.labels < 0) & (sample.roof == 1))[0]
    labels = np.where(areas > 0, areas + labels.max(), labels).astype(np.int32)
    if rng.random() < 0.85:
        labels = targets.perturbed(labels, rng)
    return blend(sample.rgb, labels, **BLEND)


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
    return {
        "roof": (entropy * judged).sum() / judged.sum().clamp(min=1) + 0.5 * dice,
        "edge": (edge_entropy * known * (1 + 3 * edge)).sum() / known.sum().clamp(min=1),
        "distance": (weight * (far_error + 0.5 * far_entropy)).sum() / total,
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


def height_losses(raw: Batch, batch: Batch) -> Batch:
    """Loss terms of what heights follow from: kinds of surface, heights (their distribution and its mean), slopes."""
    log_height = F.log_softmax(raw["height"], dim=1)
    centres = torch.from_numpy(CENTRES).float()

    def height_loss(height: torch.Tensor) -> torch.Tensor:
        cells = torch.isfinite(height).nonzero(as_tuple=True)
        soft = targets.height_distribution(height[cells].numpy().astype(np.float64), EDGES, CENTRES)
        chosen = log_height.permute(0, 2, 3, 1)[cells]
        off = F.smooth_l1_loss(chosen.exp() @ centres, height[cells], reduction="sum", beta=1.0)
        return (0.2 * off - (torch.from_numpy(soft) * chosen).sum()) / max(len(cells[0]), 1)

    share = batch["surface"]
    known = share.sum(1) > 0
    surface = -(share * F.log_softmax(raw["surface"], dim=1)).sum(1)
    sloped = torch.isfinite(batch["slope"])
    slope_error = (raw["slope"] - torch.nan_to_num(batch["slope"]).clamp(-1.5, 1.5)).abs() * sloped
    return {
        "surface": surface.sum() / known.sum().clamp(min=1),
        "height": 0.4 * height_loss(batch["corner_height"]),
        "roof_height": 0.6 * height_loss(batch["roof_height"]),
        "slope": 3 * slope_error.sum() / sloped.sum().clamp(min=1),
    }


def losses(raw: Batch, batch: Batch) -> Batch:
    """All loss terms."""
    return {**section_losses(raw, batch), **corner_losses(raw, batch), **height_losses(raw, batch)}


def network(task: str = "both") -> Dense:
    """A new network that gives the maps of a task."""
    return Dense(len(CENTRES), task)


def start_from(model: Dense, checkpoint: str | Path) -> None:
    """Fills a network with the averaged weights of another run."""
    model.load_state_dict(torch.load(checkpoint, weights_only=True, map_location="cpu")["average"])


def learning_rate(used: float, top: float) -> float:
    """Rate at a share `used` of the budget: 3 % warm-up, then a cosine to a hundredth."""
    if used < 0.03:
        return top * (0.05 + 0.95 * used / 0.03)
    return top * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min((used - 0.03) / 0.97, 1.0))))


def update_average(average: Batch, model: Dense, step: int) -> None:
    """Running mean of weights and norms, over about the last 500 steps, fewer at the start."""
    keep = min(0.998, (1 + step) / (10 + step))
    for name, value in model.state_dict().items():
        if value.is_floating_point():
            average[name].lerp_(value, 1 - keep)
        else:
            average[name].copy_(value)


def save(path: Path, model: Dense, average: Batch, optimiser: Any, settings: Settings, step: int, used: float) -> None:
    """Write the checkpoint whole."""
    content = {
        "model": model.state_dict(),
        "average": average,
        "optimiser": optimiser.state_dict(),
        "settings": settings._asdict(),
        "step": step,
        "seconds": used,
    }
    with store.whole(path) as temporary:
        torch.save(content, temporary)


def train(
    model: Dense,
    data: Dataset,
    settings: Settings,
    out: Path,
    seconds: float,
    save_every: float = 60.0,
    steps: int | None = None,
    workers: int = 1,
) -> int:
    """Train until `seconds` of work (or `steps` in all) are used, counting what earlier calls on `out` used; returns steps.

    Raises `ContractMismatch` if `out` holds another run.
    """
    from torch.utils.tensorboard import SummaryWriter

    path = out / "checkpoint.pt"
    fast_bfloat16 = torch.cpu._is_avx512_bf16_supported()  # elsewhere bfloat16 is several times slower than float32
    torch.manual_seed(settings.seed)
    model = model.to(memory_format=torch.channels_last).train()
    optimiser = torch.optim.AdamW(model.parameters(), lr=settings.rate, weight_decay=settings.decay, fused=True)
    average = {name: value.detach().clone() for name, value in model.state_dict().items()}
    step, used = 0, 0.0
    if path.exists():
        state = torch.load(path, weights_only=True, map_location="cpu")
        if Settings(**state["settings"]) != settings:
            raise ContractMismatch(f"{path} is another run ({state['settings']}): choose another --out, or delete it")
        model.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        average = state["average"]
        step, used = state["step"], state["seconds"]
    loader = DataLoader(
        data,
        batch_size=settings.batch,
        sampler=Onwards(step * settings.batch),
        num_workers=workers,
        prefetch_factor=4 if workers else None,
    )
    writer = SummaryWriter(str(out / "log"))
    saved = used
    now = time.monotonic()
    batches = iter(loader)
    while used < seconds and (steps is None or step < steps):
        batch = next(batches)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(used / seconds, settings.rate)
        image = normalised(batch["image"]).contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=fast_bfloat16):
            raw = model.logits(image, batch["geometry"])
        terms = losses({k: v.float() for k, v in raw.items()}, batch)
        loss = sum(terms.values())
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()
        step += 1
        update_average(average, model, step)
        before, now = now, time.monotonic()
        used += now - before
        if step % 20 == 0:
            for name, value in terms.items():
                writer.add_scalar(f"loss/{name}", value.item(), step)
            writer.add_scalar("rate", optimiser.param_groups[0]["lr"], step)
        if step % 50 == 0:
            parts = " ".join(f"{name} {value.item():.3f}" for name, value in terms.items())
            print(f"step {step} {used / 60:.1f} min {parts}", flush=True)
        if used - saved > save_every:
            save(path, model, average, optimiser, settings, step, used)
            saved = used
    if used > saved or not path.exists():
        save(path, model, average, optimiser, settings, step, used)
    writer.close()
    return step


def fill_pool(pool: Path, count: int, seed: int, chips: list[dataset.Chip]) -> None:
    """Render simulated tiles into a folder until it holds `count`, leaving what is there."""
    os.nice(10)
    cv2.setNumThreads(1)
    backgrounds = [(chip.rgb, ~chip.building) for chip in chips]
    pool.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = pool / f"{seed}-{number:06d}.npz"
        if not path.exists():
            dataset.save(path, dataset.simulated(np.random.default_rng([seed, number]), backgrounds=backgrounds))


def main(argv: list[str] | None = None) -> None:
    """Train the network on simulated and real tiles."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.training", description=main.__doc__)
    parser.add_argument("--data", required=True, help="data folder with roofgraph/roofgraph.tar and chips/")
    parser.add_argument("--out", required=True, help="folder of this run")
    parser.add_argument("--roofgraph", help="tar or extracted folder, if not DATA/roofgraph/roofgraph.tar")
    parser.add_argument("--pool", help="folder of simulated tiles, shared between runs (default: OUT/../pool)")
    parser.add_argument("--tiles", type=int, default=4000, help="simulated tiles to render into the pool (0: none)")
    parser.add_argument("--minutes", type=float, default=30, help="budget, all calls together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=2e-3, help="highest learning rate")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--init", help="checkpoint of another run to start from (default: ImageNet encoder)")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    data, out = Path(args.data), Path(args.out)
    pool = Path(args.pool) if args.pool else out.parent / "pool"
    graphs = dataset.read_roof_graphs(args.roofgraph or data / "roofgraph" / "roofgraph.tar")
    chips = dataset.read_chips(data / "chips")
    if args.tiles:
        renderer = multiprocessing.get_context("fork").Process(
            target=fill_pool, args=(pool, args.tiles, args.seed, chips), daemon=True
        )
        renderer.start()
    settings = Settings(args.seed, rate=args.rate)
    model = network()
    if args.init:
        start_from(model, args.init)
    else:
        model.encoder.load_imagenet()
    training = [graph for graph in graphs if not dataset.held_out(graph)]
    mixture = dataset.Mixture(pool, training, chips, SHARES, settings.size, args.seed)
    steps = train(model, Examples(mixture), settings, out, args.minutes * 60)
    print(f"{out / 'checkpoint.pt'}: {steps} steps")


if __name__ == "__main__":
    cli.run(main)
