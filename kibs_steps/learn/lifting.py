"""Lifting: learns the small network that tells from walls and shadows how far a section is to be lifted (`models.walls`).

In: a dense 3D model (ONNX) that gives `surface`. Simulated tiles are shown with sections as a 2D model might find them. Traits
are taken once from what the model sees and once from the true kinds of surface, so that what a wall says is learned where
walls are seen clearly, too. Out: the contract's `walls`, in the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from kibs_steps import cli
from kibs_steps.blend import blend
from kibs_steps.learn import augmentation, dataset, examples, sources, targets
from kibs_steps.learn.fitting import rounded
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import runtime, walls
from kibs_steps.simulate import citymodel

SEED = 77_000_000  # of scenes and of everything drawn
WIDTH, INNER = 32, 3  # channels, layers between the first and the last
BATCH, RATE, DECAY = 256, 3e-3, 1e-3
ROUNDS = 5  # how often every section is looked at
VARIED = 0.5  # share of tiles with a radiometry of their own
UNLIT = 0.25  # share of tiles whose sun nobody tells
KNOWN = 0.5  # share of a section's pixels whose height is known
FEWEST = 12  # px of a section whose height is known
HEAVIEST = 400  # px of a section, beyond which it weighs no more
SOFT = 0.5  # m: σ of the answers
FEW = 100  # sections, fewer teach nothing


class Lesson(NamedTuple):
    """Of sections (n): traits `along` and `whole` (`walls.Traits`), the true lift (m), and how much each weighs."""

    along: np.ndarray
    whole: np.ndarray
    lift: np.ndarray
    weight: np.ndarray


def lessons(
    sample: Sample,
    model: contracts.Model,
    session: Callable[[np.ndarray], runtime.Network],
    rng: np.random.Generator,
    windows: Sequence[np.ndarray] = (),
    unlit: float = UNLIT,
) -> Iterator[Lesson]:
    """What a tile teaches: by the surfaces that a model sees, then by the true ones.

    `windows` (n, s, s, 3) are what most tiles are to look like, `unlit` is the share of those whose sun is not told.
    """
    if (alike := augmentation.in_the_look(sample, windows, rng)) is not None:
        sample = alike
    elif rng.random() < VARIED:
        sample = sample._replace(rgb=augmentation.radiometry(sample.rgb, rng))
    sample = augmentation.without_geometry(sample, rng, (0.0, unlit))
    labels = examples.supposed(sample, rng)
    blended = blend(sample.rgb, labels, **model.contract["blend"])
    surface, height = shown(blended, session(sample.geometry[None]), model.contract["tile"])
    true = targets.surface(sample.surface, walls.KINDS).astype(np.float32)
    for kinds in (surface, true):
        seen = walls.traits(labels, kinds, height, model.contract["heights"], sample.geometry)
        off = np.where(sample.labels > 0, sample.height - seen.height, np.nan)
        lift, weight = np.full(len(seen.labels), np.nan), np.zeros(len(seen.labels))
        for i, label in enumerate(seen.labels):
            errors = off[labels == label]
            errors = errors[np.isfinite(errors)]
            if len(errors) >= max(KNOWN * seen.area[i], FEWEST):
                lift[i], weight[i] = np.median(errors), np.sqrt(min(len(errors), HEAVIEST))
        known = np.isfinite(lift)
        yield Lesson(seen.along[known], seen.whole[known], lift[known], weight[known])


def shown(rgb: np.ndarray, network: runtime.Network, tile: int) -> tuple[np.ndarray, np.ndarray]:
    """`surface` and `height` that a network for tiles of `tile` px sees of an image (s, s, 3), which may be smaller: beyond it
    lies its mirror image."""
    side = len(rgb)
    outputs = network(np.pad(rgb, ((0, tile - side), (0, tile - side), (0, 0)), mode="symmetric"))
    found = (outputs[name] for name in ("surface", "height"))
    surface, height = (maps[:, : len(maps[0]) * side // tile, : len(maps[0]) * side // tile] for maps in found)
    return surface, height


class Network(nn.Module):
    """Convolutions over five offsets: the network that `walls.likely` runs, as scores."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv1d(walls.TRAITS, WIDTH, 5, padding=2)
        self.whole = nn.Linear(walls.WHOLE, WIDTH)
        self.inner = nn.ModuleList(nn.Conv1d(WIDTH, WIDTH, 5, padding=2) for _ in range(INNER))
        self.last = nn.Conv1d(WIDTH, 1, 5, padding=2)

    def forward(self, along: torch.Tensor, whole: torch.Tensor) -> torch.Tensor:
        x = F.relu(self.first(along) + self.whole(whole)[:, :, None])
        for layer in self.inner:
            x = F.relu(x + layer(x))
        return self.last(x)[:, 0]

    def terms(self) -> dict[str, Any]:
        """The contract's `walls`."""
        convolutions = (self.first, *self.inner, self.last)
        layers = [
            {"weights": rounded(c.weight.permute(2, 1, 0).flatten(0, 1)), "bias": rounded(c.bias)} for c in convolutions
        ]
        return {"layers": layers, "whole": rounded(self.whole.weight.T), "bias": rounded(self.whole.bias)}


def learned(lesson: Lesson, rounds: int = ROUNDS) -> dict[str, Any]:
    """The contract's `walls` that tells the lifts of a lesson best."""
    torch.manual_seed(SEED)
    network = Network()
    along, whole, lift, weight = (torch.from_numpy(np.asarray(part, np.float32)) for part in lesson)
    offsets = torch.from_numpy(walls.OFFSETS).float()
    lift = lift.clamp(float(offsets[0]), float(offsets[-1]))
    weight = weight / weight.mean()
    steps = max(rounds * len(lift) // BATCH, 1)
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps + 1)
    for _ in range(steps):
        part = torch.randint(len(lift), (BATCH,))
        shares = F.log_softmax(network(along[part], whole[part]), dim=1)
        answer = torch.softmax(-0.5 * ((offsets - lift[part, None]) / SOFT) ** 2, dim=1)
        mean = (shares.exp() * offsets).sum(dim=1)
        loss = -(answer * shares).sum(dim=1) + 0.3 * F.smooth_l1_loss(mean, lift[part], reduction="none")
        optimiser.zero_grad()
        (loss * weight[part]).mean().backward()
        optimiser.step()
        schedule.step()
    return network.terms()


def tiles(
    pool: str | None, count: int, contract: dict[str, Any], cities: Sequence[citymodel.CityModel]
) -> Iterator[Sample]:
    """At most so many tiles in which roofs lean, as is known: of a pool, or simulated, seen and lit as the contract says; every
    third of these shows tall buildings."""
    if pool:
        files = sorted(Path(pool).glob("[!.]*.npz"))
        chosen = (Sample.load(files[i]) for i in np.random.default_rng(SEED).permutation(len(files)))
        yield from islice((sample for sample in chosen if runtime.leans(sample.geometry)), count)
        return
    view, sun = (sources.middle(contract["trained_on"], name) for name in sources.DIRECTIONS)
    for number in range(count):
        sample = dataset.simulated(
            np.random.default_rng([SEED, number]),
            contract["tile"],
            view=view,
            sun=sun,
            cities=cities,
            gsd=contract["gsd"],
            tall=number % sources.TALL_EVERY == sources.TALL_EVERY - 1,
        )
        if runtime.leans(sample.geometry):
            yield sample


def main(argv: list[str] | None = None) -> None:
    """Learn how walls and shadows lift sections, and write it into a 3D model."""
    import onnx

    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.lifting", description=main.__doc__)
    parser.add_argument("--model", required=True, help="ONNX file of a dense model for corners; gets `walls`")
    parser.add_argument(
        "--tiles", type=int, default=300, help="at most so many tiles to learn from: simulated ones in which roofs lean"
    )
    parser.add_argument("--pool", help="folder of tiles of the model's GSD that a training rendered, to take them from")
    parser.add_argument("--cities", nargs="*", default=[], help="CityJSON files that some of them show parts of")
    sources.add_look(parser)
    args = parser.parse_args(argv)
    model = contracts.load(args.model, "corners")
    proto = onnx.load(args.model)
    if "surface" not in (output.name for output in proto.graph.output):
        parser.error(f"{args.model} does not give `surface`, by which walls are seen: export its weights anew")
    torch.set_num_threads(1)
    session = runtime.opened(model, threads=1)
    cities = tuple(map(citymodel.read, args.cities))
    windows, unlit = sources.windows_of(args), 1.0 if "sun" in args.untold else UNLIT
    found: list[Lesson] = []
    for number, sample in enumerate(tiles(args.pool, args.tiles, model.contract, cities)):
        found += lessons(sample, model, session, np.random.default_rng([SEED, number, 1]), windows, unlit)
        if number % 100 == 99:
            print(f"{number + 1} of {args.tiles} tiles", flush=True)
    sections = sum(len(lesson.lift) for lesson in found)
    if sections < FEW:
        print(f"{args.model} stays as it is: {len(found) // 2} tiles with {sections // 2} sections teach nothing")
        return
    taught = Lesson(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    contracts.write(args.model, {**model.contract, "walls": learned(taught)})
    print(f"{args.model}: lifts learned on {len(found) // 2} tiles")


if __name__ == "__main__":
    cli.run(main)
