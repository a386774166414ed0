"""How basins of a watershed are joined to sections, learned for a model on scenes its training has not seen.

A policy that is only taught what to do in the beginning meets pairs later that it never saw. So it is taught in rounds: pairs
met on the way are added to those known, and it is learned anew from all of them (DAgger, Ross et al. 2011). Basins belong to
what most of their pixels do; pairs of small basins weigh less, as little hangs on them.

In: a dense model for sections with its contract; simulated scenes at the directions it is for. Out: the same model with `join`
(`models.joining`) and a `score` (`learn.calibration`) that fits what is then found.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from kibs_steps import cli, photographs
from kibs_steps.errors import KibsError
from kibs_steps.learn import augmentation, calibration, dataset, fitting, sources
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import heads, joining, perceptron, runtime
from kibs_steps.simulate import citymodel

SEED = 454545  # of scenes that no training and no test draws
ROUNDS = 3
LEAST = 0.6  # of 0.5 to 0.7 the best in the mean of village, photographs, made-up scenes and two real cities
PROMINENCE = 0.1  # of a summit: lower ones never count
LARGE = 400  # px: of two larger basins a pair weighs no more
VARIED, FORGOTTEN = 0.5, 0.2  # shares of scenes


class NothingToJoin(KibsError):
    """A model finds no neighbouring basins in any scene."""


class Lesson(NamedTuple):
    """A tile to learn from: the graph of its basins, and how many of their pixels (n, 2 + sections) are unknown, ground, and of
    each true section."""

    graph: joining.Graph
    shares: np.ndarray


class Pairs(NamedTuple):
    """Traits (m, 32), whether a pair is one section (m,), weights (m,)."""

    traits: np.ndarray
    one: np.ndarray
    weight: np.ndarray


def lesson(maps: dict[str, np.ndarray], sample: Sample, thresholds: dict[str, float]) -> Lesson:
    """What a model's maps of a sample teach."""
    basins, level = heads.basins(maps["roof"][0], maps["edge"][0], maps["distance"][0], thresholds)
    truth = np.maximum(sample.labels, -1) + 1
    shares = np.zeros((int(basins.max(initial=0)) + 1, int(truth.max()) + 1))
    np.add.at(shares, (basins, truth), 1)
    return Lesson(joining.graph(basins, sample.rgb, maps, level), shares[1:])


def met(lessons: Sequence[Lesson], chance: Callable[[np.ndarray], np.ndarray] | None) -> Pairs:
    """All pairs met on the way that `chance` leads, or without it those there are in the beginning.

    Pairs of ground alone, and those that touch unknown ground, teach nothing.
    """
    found: list[Pairs] = []
    for graph, shares in lessons:

        def watch(seen: joining.Graph, traits: np.ndarray, of: np.ndarray, shares: np.ndarray = shares) -> None:
            total = np.zeros((len(seen.basins), shares.shape[1]))
            np.add.at(total, of, shares)
            first, second = total.argmax(axis=1)[seen.pairs].T
            known = (first > 0) & (second > 0) & (np.maximum(first, second) > 1)
            weight = np.sqrt(np.minimum(seen.basins[seen.pairs, 0].min(axis=1), LARGE))
            found.append(Pairs(traits[known].astype(np.float32), (first == second)[known], weight[known]))

        if chance:
            joining.joined(graph, chance, LEAST, watch)
        elif len(graph.pairs):
            watch(graph, joining.traits(graph), np.arange(len(graph.basins)))
    return together(found)


def together(found: Sequence[Pairs]) -> Pairs:
    """All pairs as one table."""
    none = Pairs(np.zeros((0, len(joining.TRAITS)), np.float32), np.zeros(0, bool), np.zeros(0))
    return Pairs(*(np.concatenate(part) for part in zip(none, *found, strict=True)))


def learned(pairs: Pairs, steps: int = fitting.STEPS, seed: int = 0) -> dict[str, Any]:
    """The contract's `join` that fits these pairs. Raises `NothingToJoin` without any."""
    if not len(pairs.one):
        raise NothingToJoin("no two basins of known roofs touch: train the network first, or give more scenes")
    return {**fitting.fitted(pairs.traits, pairs.one, pairs.weight, steps, seed), "least": LEAST}


def policy(
    lessons: Sequence[Lesson], rounds: int = ROUNDS, steps: int = fitting.STEPS, seed: int = 0
) -> dict[str, Any]:
    """The contract's `join`, taught in rounds of so many steps each."""
    known = met(lessons, None)
    join = learned(known, steps, seed)
    for _ in range(rounds):
        known = together([known, met(lessons, lambda seen, join=join: perceptron.likely(seen, join))])
        join = learned(known, steps, seed)
    return join


class Stock(NamedTuple):
    """What scenes may show beside made-up houses: real cities, photographed roofs, and the ground those are laid on; windows of
    an image that they are to look like, and which of view and sun are never told."""

    cities: Sequence[citymodel.CityModel] = ()
    graphs: Sequence[photographs.RoofGraph] = ()
    chips: Sequence[photographs.Chip] = ()
    shown: Sequence[np.ndarray] = ()
    untold: Sequence[str] = ()


NOTHING = Stock()


def scene(contract: dict[str, Any], number: int, stock: Stock = NOTHING) -> Sample:
    """A scene of a model's tile, seen and lit as its contract says it is for, some with a radiometry of their own, some without
    telling from where; of four one shows photographed roofs, if there are any, the others are simulated."""
    rng = np.random.default_rng([SEED, number])
    if len(stock.graphs) and len(stock.chips) and number % 4 == 3:
        chip = stock.chips[rng.integers(len(stock.chips))]
        ground = dataset.without_truth(dataset.chip_sample(chip, rng, contract["tile"], contract["gsd"]))
        sample = dataset.pasted_houses(ground, stock.graphs, rng, gsd=contract["gsd"])
        alike = augmentation.in_the_look(sample, stock.shown, rng)
        return sample if alike is None else alike
    view, sun = (sources.middle(contract["trained_on"], name) for name in sources.DIRECTIONS)
    sample = dataset.simulated(
        rng,
        contract["tile"],
        view_elevation=tuple(contract["trained_on"].get("view_elevation", dataset.VIEWS)),
        view=view,
        sun=sun,
        cities=stock.cities,
        gsd=contract["gsd"],
        tall=number % sources.TALL_EVERY == sources.TALL_EVERY - 1,
    )
    if (alike := augmentation.in_the_look(sample, stock.shown, rng)) is not None:
        sample = alike
    elif rng.random() < VARIED:
        sample = sample._replace(rgb=augmentation.radiometry(sample.rgb, rng))
    shares = tuple(1.0 if name in stock.untold else FORGOTTEN for name in sources.DIRECTIONS)
    return augmentation.without_geometry(sample, rng, shares)


def main(argv: list[str] | None = None) -> None:
    """Learn how a model's basins are joined to sections, and write it into the model."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.joins", description=main.__doc__)
    parser.add_argument("--model", required=True, help="ONNX file of a dense model for sections, or both; gets `join`")
    parser.add_argument("--scenes", type=int, default=120, help="simulated scenes of a tile each to learn from")
    parser.add_argument("--steps", type=int, default=fitting.STEPS, help="of learning, each of four times")
    parser.add_argument(
        "--prominence",
        type=float,
        default=PROMINENCE,
        help="of a basin's summit: lower ones are joined before all others",
    )
    parser.add_argument("--data", help="data folder with roof photographs, which some of them show")
    parser.add_argument("--roofgraph", help="tar or extracted folder, if not DATA/roofgraph/roofgraph.tar")
    sources.add_left_out(parser)
    parser.add_argument("--cities", nargs="*", default=[], help="CityJSON files that some of them show parts of")
    sources.add_look(parser)
    args = parser.parse_args(argv)
    model = contracts.load(args.model, "sections")
    if model.contract["head"] != "dense":
        parser.error(f"{args.model} finds whole sections: there is nothing to join")
    torch.set_num_threads(1)
    stock = Stock(tuple(map(citymodel.read, args.cities)), shown=sources.windows_of(args), untold=args.untold)
    if args.data:
        graphs = photographs.read_roof_graphs(args.roofgraph or Path(args.data) / "roofgraph" / "roofgraph.tar")
        shown = [graph for graph in graphs if not photographs.held_out(graph)]
        chips = [
            c for c in photographs.read_chips(Path(args.data) / "chips") if c.name.split("/")[0] not in args.leave_out
        ]
        stock = stock._replace(graphs=shown, chips=chips)
    samples, maps = [], []
    for number in range(args.scenes):
        samples.append(scene(model.contract, number, stock))
        maps.append(runtime.open_network(model, samples[-1].geometry[None], threads=1)(samples[-1].rgb))
        if number % 20 == 19:
            print(f"{number + 1} of {args.scenes} scenes", flush=True)
    contract = {**model.contract, "thresholds": {**model.contract["thresholds"], "prominence": args.prominence}}
    lessons = [lesson(shown, sample, contract["thresholds"]) for shown, sample in zip(maps, samples, strict=True)]
    try:
        contract["join"] = policy(lessons, steps=args.steps)
    except NothingToJoin as error:
        print(f"{args.model} stays as it is: {error}")
        return
    contract["score"] = calibration.score(zip(maps, samples, strict=True), contract)
    contracts.write(args.model, contract)
    print(f"{args.model}: joins learned on {len(samples)} scenes")


if __name__ == "__main__":
    cli.run(main)
