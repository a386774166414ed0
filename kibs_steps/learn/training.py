"""Training a network within a time budget, resumed where a kill left it.

Family `dense`: one network learns sections, corners and heights at once. Part of its tiles are blended with sections as a model
might find them: so the same weights serve as 2D model on the image and as 3D model on the blended one (`learn.export`). Or it
learns one task alone (`--task`), from plain tiles only or blended ones only.
Family `maskrcnn`: the paper's network for one task (`learn.maskrcnn`).

In: what `learn.sources` mixes: simulated tiles, a data folder (`roofgraph/`, `chips/`), a user's own samples. Out, below `--out`:
`checkpoint.pt` (weights, their running mean, optimiser, steps and seconds used; written whole every few minutes), `log/` for
TensorBoard and, at the end, `done.json`. The same command continues a run that was killed; with its budget used it ends at once.
With validation tiles a run also ends early, when the loss on them has not fallen for `patience` looks; its best weights are
kept.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from kibs_steps import cli, store
from kibs_steps.learn import dataset, examples, maskrcnn, sources
from kibs_steps.learn.architectures import Dense, normalised
from kibs_steps.learn.losses import CENTRES, Batch, losses
from kibs_steps.models.contract import ContractMismatch

SIZE = 192  # px, side of a dense network's training tiles
IMAGENET = "ImageNet (encoder)"
SECTIONS_SEEN = 0.25  # m per px at which a network for sections alone sees the image


class Settings(NamedTuple):
    """What a run is: stored with its checkpoint."""

    seed: int
    size: int = SIZE
    batch: int = 8
    rate: float = 2e-3
    decay: float = 0.02
    family: str = "dense"
    task: str = "both"
    zoom: float = 1.0
    gsd: float = dataset.GSD
    blur: float = 0.0


class Best(NamedTuple):
    """The lowest validation loss so far, the step it was seen at, looks since then, and the averaged weights of that step."""

    loss: float
    step: int
    since: int
    average: Batch


class Onwards(torch.utils.data.Sampler):
    """Indices from `start` without end: a resumed run sees new tiles, not its first ones again."""

    def __init__(self, start: int):
        self.start = start

    def __iter__(self):
        return iter(range(self.start, 2**31))


def brief(device: str) -> torch.autocast:
    """Networks in bfloat16 where the machine is quick at it; elsewhere it is several times slower than float32."""
    return torch.autocast(device, torch.bfloat16, enabled=device == "cuda" or torch.cpu._is_avx512_bf16_supported())


def dense_terms(model: Dense, batch: Batch) -> Batch:
    """All loss terms of a batch for a dense network."""
    image = normalised(batch["image"]).contiguous(memory_format=torch.channels_last)
    with brief(image.device.type):
        raw = model.logits(image, batch["geometry"])
    return losses({k: v.float() for k, v in raw.items()}, batch, model.task)


def instance_terms(model: nn.Module, batch: dict[str, Any]) -> Batch:
    """All loss terms of a batch for a Mask R-CNN."""
    with brief(batch["image"].device.type):
        return {name: value.float() for name, value in maskrcnn.loss_terms(model, batch).items()}


def network(task: str = "both", family: str = "dense", zoom: float = 1.0, blur: float = 0.0) -> nn.Module:
    """A new network that gives the outputs of a task; a dense one sees the image `blur` px blurred and enlarged `zoom` times."""
    return maskrcnn.network(task) if family == "maskrcnn" else Dense(len(CENTRES), task, zoom, blur)


def usual_zoom(task: str, gsd: float, init: str | Path | None = None) -> float:
    """The zoom unless another is asked for: a network for sections alone sees the ground as that whose weights it starts from,
    else at about SECTIONS_SEEN m per px."""
    if task != "sections":
        return 1.0
    before = settings_of(init)
    seen = before["gsd"] / before["zoom"] if before and before["task"] == task else SECTIONS_SEEN
    return max(1.0, round(2 * gsd / seen) / 2)


def usual_blur(gsd: float, init: str | Path | None = None) -> float:
    """The blur (px) unless another is asked for: as many metres as for the weights that a run starts from."""
    before = settings_of(init) or {}
    return before.get("blur", 0.0) * before.get("gsd", gsd) / gsd


def settings_of(init: str | Path | None) -> dict[str, Any] | None:
    """What weights tell of the run that made them (`Settings`); None where they tell nothing."""
    return torch.load(init, weights_only=True, map_location="cpu").get("settings") if init else None


def moved(batch: Any, device: torch.device) -> Any:
    """A batch (tensors in dicts and lists) on a device."""
    if isinstance(batch, dict):
        return {k: moved(v, device) for k, v in batch.items()}
    if isinstance(batch, list):
        return [moved(v, device) for v in batch]
    return batch.to(device, non_blocking=True)


def start_from(model: nn.Module, checkpoint: str | Path) -> None:
    """Fills a network with the averaged weights of another run, those it exports (`averaged`). Raises `ContractMismatch` where
    they are no numbers."""
    average = averaged(torch.load(checkpoint, weights_only=True, map_location="cpu"))
    bad = [name for name, value in average.items() if not torch.isfinite(value).all()]
    if bad:
        raise ContractMismatch(f"{checkpoint}: {bad[0]} is not finite: start from other weights")
    model.load_state_dict(average)


def averaged(state: dict[str, Any]) -> Batch:
    """Of a checkpoint the averaged weights that count: those with the lowest loss on validation tiles, else the last ones."""
    return (state.get("best") or {}).get("average") or state["average"]


def learning_rate(used: float, top: float) -> float:
    """Rate at a share `used` of the budget: 3 % warm-up, then a cosine to a hundredth."""
    if used < 0.03:
        return top * (0.05 + 0.95 * used / 0.03)
    return top * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min((used - 0.03) / 0.97, 1.0))))


def update_average(average: Batch, model: nn.Module, step: int) -> None:
    """Running mean of weights and norms, over about the last 500 steps, fewer at the start."""
    keep = min(0.998, (1 + step) / (10 + step))
    for name, value in model.state_dict().items():
        if value.is_floating_point():
            average[name].lerp_(value, 1 - keep)
        else:
            average[name].copy_(value)


def validated(model: nn.Module, average: Batch, batches: Sequence[Any], terms: Callable) -> float:
    """Mean loss of the averaged weights on validation batches; the network itself is left as it was."""
    own = {name: value.clone() for name, value in model.state_dict().items()}
    model.load_state_dict(average)
    norms = [part for part in model.modules() if isinstance(part, nn.BatchNorm2d) and part.training]
    for norm in norms:
        norm.eval()
    with torch.no_grad():
        total = sum(float(sum(terms(model, batch).values())) for batch in batches)
    model.load_state_dict(own)
    for norm in norms:
        norm.train()
    return total / len(batches)


def train(
    model: nn.Module,
    data: Dataset,
    settings: Settings,
    out: Path,
    seconds: float,
    save_every: float = 60.0,
    steps: int | None = None,
    workers: int = 1,
    device: str = "cpu",
    validation: Sequence[dict[str, np.ndarray]] = (),
    patience: int = 10,
    look_every: int = 500,
    about: dict[str, Any] | None = None,
    sources: str = "",
) -> int:
    """Train until `seconds` of work (or `steps` in all) are used, counting what earlier calls on `out` used; returns steps.

    With `validation` examples their loss is looked at every `look_every` steps, and the run ends after `patience` looks
    without a lower one. `about` (data, licence, angles) is kept in the checkpoint for the contract, `sources` tells what is
    learned from (`sources.signature`). Raises `ContractMismatch` if `out` holds another run.
    """
    from torch.utils.tensorboard import SummaryWriter

    path = out / "checkpoint.pt"
    torch.manual_seed(settings.seed)
    is_dense = settings.family == "dense"
    terms_of = dense_terms if is_dense else instance_terms
    collate = torch.utils.data.default_collate if is_dense else maskrcnn.collated
    where = torch.device(device)
    model = model.to(where, memory_format=torch.channels_last).train()
    optimiser = torch.optim.AdamW(model.parameters(), lr=settings.rate, weight_decay=settings.decay, fused=True)
    average = {name: value.detach().clone() for name, value in model.state_dict().items()}
    step, used, best = 0, 0.0, Best(math.inf, 0, 0, {})
    if path.exists():
        state = torch.load(path, weights_only=True, map_location=where)
        if Settings(**state["settings"]) != settings:
            raise ContractMismatch(f"{path} is another run ({state['settings']}): choose another --out, or delete it")
        if sources and state.get("sources", sources) != sources:
            raise ContractMismatch(
                f"{path} learned from other data, or started from other weights: choose another --out (train.name), or delete it"
            )
        model.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        average = state["average"]
        step, used = state["step"], state["seconds"]
        best = Best(**state.get("best", best._asdict()))
    loader = DataLoader(
        data,
        batch_size=settings.batch,
        sampler=Onwards(step * settings.batch),
        num_workers=workers,
        prefetch_factor=4 if workers else None,
        collate_fn=collate,
        pin_memory=where.type == "cuda",
    )
    parts = [validation[i : i + settings.batch] for i in range(0, len(validation), settings.batch)]
    judged = [moved(collate(list(part)), where) for part in parts]
    best = best if judged else Best(math.inf, 0, 0, {})
    writer = SummaryWriter(str(out / "log"))

    def keep() -> None:
        content = {
            "model": model.state_dict(),
            "average": average,
            "optimiser": optimiser.state_dict(),
            "settings": settings._asdict(),
            "step": step,
            "seconds": used,
            "best": best._asdict(),
            "about": about or {},
            "sources": sources,
            "converged": best.since >= patience if judged else None,
        }
        with store.whole(path, summed=False) as temporary:
            torch.save(content, temporary)

    saved, now = used, time.monotonic()
    batches = iter(loader)
    while used < seconds and (steps is None or step < steps) and (not judged or best.since < patience):
        batch = moved(next(batches), where)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(max(used / seconds, step / steps if steps else 0.0), settings.rate)
        terms = terms_of(model, batch)
        optimiser.zero_grad()
        sum(terms.values()).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()
        step += 1
        update_average(average, model, step)
        if judged and step % look_every == 0:
            loss = validated(model, average, judged, terms_of)
            writer.add_scalar("validation/loss", loss, step)
            if loss < best.loss:
                best = Best(loss, step, 0, {name: value.clone() for name, value in average.items()})
            else:
                best = best._replace(since=best.since + 1)
        before, now = now, time.monotonic()
        used += now - before
        if step % 20 == 0:
            for name, value in terms.items():
                writer.add_scalar(f"loss/{name}", value.item(), step)
            writer.add_scalar("rate", optimiser.param_groups[0]["lr"], step)
        if step % 50 == 0:
            said = " ".join(f"{name} {value.item():.3f}" for name, value in terms.items())
            print(f"step {step} {used / 60:.1f} min {said}", flush=True)
        if used - saved > save_every:
            keep()
            saved = used
    if used > saved or not path.exists():
        keep()
    writer.close()
    return step


def main(argv: list[str] | None = None) -> None:
    """Train a network on simulated, real and own tiles."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.training", description=main.__doc__)
    parser.add_argument("--out", required=True, help="folder of this run")
    parser.add_argument("--family", choices=["dense", "maskrcnn"], default="dense")
    parser.add_argument("--task", choices=["both", "sections", "corners"], help="what to learn (maskrcnn: not both)")
    parser.add_argument("--minutes", type=float, default=30, help="budget, all calls together")
    parser.add_argument("--steps", type=int, help="end after so many steps in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, help="highest learning rate")
    parser.add_argument("--batch", type=int, help="tiles per step")
    parser.add_argument("--size", type=int, help="side of a dense network's training tiles, px")
    parser.add_argument("--zoom", type=float, help="how many times larger a dense network sees the image")
    parser.add_argument(
        "--blur",
        type=float,
        help="deviation of a Gaussian (px) through which a dense network sees the image, now and ever after (default: as the "
        "weights it starts from, else 0)",
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2, help="of torch, on a CPU")
    parser.add_argument("--workers", type=int, default=1, help="processes that prepare tiles")
    parser.add_argument("--patience", type=int, default=10, help="looks at the validation tiles without a lower loss")
    parser.add_argument(
        "--init", help="checkpoint or weights to start from (default: ImageNet encoder; maskrcnn: none)"
    )
    sources.add_arguments(parser)
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(1)  # the loader's processes are forked: they would wait for threads that only their parent has
    out = Path(args.out)
    if args.family == "maskrcnn":
        if args.blur:
            parser.error("--blur is for dense networks")
        task = args.task or "sections"
        settings = Settings(
            args.seed, maskrcnn.TILE, args.batch or 2, args.rate or 2e-4, family="maskrcnn", task=task, gsd=args.gsd
        )
    else:
        task = args.task or "both"
        rate, zoom = args.rate or 2e-3, args.zoom or usual_zoom(task, args.gsd, args.init)
        blur = usual_blur(args.gsd, args.init) if args.blur is None else args.blur
        if not 0 <= blur <= 5:
            parser.error(f"--blur {blur:g}: give px between 0 (none) and 5")
        if zoom <= 0 or zoom % 0.5:
            parser.error(f"--zoom {zoom:g}: it goes by halves (1, 1.5, 2), so that tiles have whole cells of stride 32")
        if zoom != 1 and task != "sections":
            parser.error("--zoom is for a network for sections alone (--task sections): offsets and slopes are in px")
        if (size := args.size or SIZE) * zoom % 32:
            parser.error(f"--size {size}: times the zoom, {zoom:g}, it must be a multiple of 32")
        settings = Settings(args.seed, size, args.batch or 8, rate, task=task, zoom=zoom, gsd=args.gsd, blur=blur)
    torch.manual_seed(settings.seed)
    model = network(settings.task, settings.family, settings.zoom, settings.blur)
    if args.init:
        start_from(model, args.init)
    elif args.family == "dense":
        model.encoder.load_imagenet()
    dense = args.family == "dense"
    found = sources.gather(args, settings.size, dense, settings.task == "corners" and not dense)
    kept = [
        examples.example_of(sample, np.random.default_rng([args.seed, i, 2]), settings.family, settings.task)
        for i, sample in enumerate(found.validation)
    ]
    found.about["init"] = Path(args.init).name if args.init else IMAGENET if args.family == "dense" else "none"
    steps = train(
        model,
        examples.Examples(found.mixture, settings.family, settings.task),
        settings,
        out,
        args.minutes * 60,
        steps=args.steps,
        workers=args.workers,
        device=args.device,
        validation=kept,
        patience=args.patience,
        about=found.about,
        sources=sources.signature(args),
    )
    store.write_json(out / "done.json", {"settings": settings._asdict(), "steps": steps, **found.about}, summed=False)
    print(f"{out / 'checkpoint.pt'}: {steps} steps")


if __name__ == "__main__":
    cli.run(main)
