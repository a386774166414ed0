"""Sources: what a training run learns from, gathered from command-line options.

Simulated tiles come from a pool that a background process renders while training goes on; roof photographs and chips from a
data folder; a user's own samples from the folders `learn.own` writes. Out: an endless mixture of training tiles, validation
tiles, and what a contract must say of the data: names, licence, angles.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from kibs_steps import fingerprint, photographs, store
from kibs_steps.learn import augmentation, dataset
from kibs_steps.learn.samples import CORRECTED, Sample
from kibs_steps.models import runtime
from kibs_steps.simulate import citymodel, draped

NAMES = ("simulated", "pasted", "chips", "own")
SHARES = {"simulated": 0.62, "pasted": 0.23, "chips": 0.15, "own": 0.3}  # of those there are, scaled to sum to 1
NON_COMMERCIAL = "CC BY-NC 4.0: trained on roof photographs under that licence, so not for commercial use"
SHARE_ALIKE = "CC BY-SA 4.0: trained on SpaceNet-2 images under that licence"
SIMULATED = "MIT, as the code: trained on simulated scenes only"
AND = "; and "  # between the terms of a licence
OWN = "as the owner of the training data decides"
CITIES = "as the owners of the city models decide that its simulated scenes show"
TALL_EVERY = 3  # one simulated tile in so many shows tall buildings
DIRECTIONS = tuple(runtime.TOLD)  # that networks are told, where they are known
HELD_OUT = 900_000  # seeds of simulated validation tiles begin here
TOLD_ANGLES = 3.0  # deg: how far from the one view of its training a fine-tuned model may be used


class Sources(NamedTuple):
    """Training tiles, validation samples, and `trained_on` of the contract (with `corner_heights`: mean, σ in m)."""

    mixture: dataset.Mixture
    validation: list[Sample]
    about: dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options that say what to learn from."""
    parser.add_argument("--data", help="data folder with roofgraph/roofgraph.tar and chips/; none: no photographs")
    parser.add_argument("--roofgraph", help="tar or extracted folder, if not DATA/roofgraph/roofgraph.tar")
    parser.add_argument(
        "--free", action="store_true", help="of DATA take what is under a free licence alone: chips of SpaceNet-2"
    )
    add_left_out(parser)
    parser.add_argument("--own", nargs="*", default=[], help="folders of own samples (learn.own)")
    parser.add_argument("--gsd", type=float, default=dataset.GSD, help="of the model to train, m per px")
    parser.add_argument(
        "--pool",
        help="folder of simulated tiles of one GSD, shared between runs (default: pool or pool-GSD beside OUT)",
    )
    parser.add_argument("--tiles", type=int, default=4000, help="simulated tiles to render into the pool (0: none)")
    parser.add_argument("--cities", nargs="*", default=[], help="CityJSON files that simulated tiles show parts of")
    parser.add_argument("--shares", type=shares, default={}, help="as in simulated=0.5,pasted=0.2,chips=0.1,own=0.2")
    parser.add_argument(
        "--forget",
        type=float,
        default=augmentation.FORGOTTEN,
        help="share of tiles whose view, and whose sun, is not told",
    )
    add_look(parser)
    parser.add_argument("--validation", type=int, default=0, help="simulated validation tiles, besides the own ones")
    for name in ("view", "sun"):
        parser.add_argument(f"--{name}-azimuth", type=float, help="simulate for one scene: its angle, deg")
        parser.add_argument(f"--{name}-elevation", type=float)


def add_left_out(parser: argparse.ArgumentParser) -> None:
    """The option that keeps places of the chips for testing."""
    parser.add_argument(
        "--leave-out", nargs="*", default=[], choices=photographs.CHIPS, help="places of the chips to keep for testing"
    )


def add_look(parser: argparse.ArgumentParser) -> None:
    """The options that say which scene tiles are to look like."""
    parser.add_argument(
        "--look", help="windows of the scene to fine-tune for (learn.look): most tiles are made to look so"
    )
    parser.add_argument(
        "--untold", nargs="*", default=[], choices=DIRECTIONS, help="what no tile is told, as the scene's is unknown"
    )


def windows_of(args: argparse.Namespace) -> np.ndarray:
    """Windows (n, s, s, 3) uint8 that tiles are to look like; none without `--look`."""
    return np.load(args.look) if args.look else np.zeros((0, 1, 1, 3), np.uint8)


def shares(text: str) -> dict[str, float]:
    """Shares by source, of `name=number,…`."""
    found = dict(part.split("=") for part in text.split(",") if part)
    if unknown := set(found) - set(NAMES):
        raise argparse.ArgumentTypeError(f"no source {sorted(unknown)}: they are {', '.join(NAMES)}")
    return {name: float(value) for name, value in found.items()}


def gather(args: argparse.Namespace, size: int, upright: bool = True, heights_needed: bool = False) -> Sources:
    """Sources of a run with tiles of `size` px; starts rendering.

    `upright`: tiles as dense networks see them; else turned at random. `heights_needed`: leave out what has no heights. Raises
    `NoTrainingData`.
    """
    named = "pool" if args.gsd == dataset.GSD else f"pool-{args.gsd:g}"
    pool = Path(args.pool) if args.pool else Path(args.out).parent / named
    graphs, chips = [], []
    if args.data:
        data = Path(args.data)
        roof_graphs = args.roofgraph or data / "roofgraph" / "roofgraph.tar"
        graphs = [] if args.free else photographs.read_roof_graphs(roof_graphs)
        places = (photographs.FREE if args.free else set(photographs.CHIPS)) - set(args.leave_out)
        chips = [c for c in photographs.read_chips(data / "chips") if c.name.split("/")[0] in places]
    training = [graph for graph in graphs if not photographs.held_out(graph)]
    own = [path for folder in args.own for path in sorted(Path(folder, "training").glob("[!.]*.npz"))]
    if args.own and not own:
        raise photographs.NoTrainingData(
            f"no training samples in {', '.join(args.own)}: make them with kibs_steps.learn.own"
        )
    for folder in args.own:
        gsd = store.read_json(Path(folder) / "own.json").get("gsd", args.gsd)
        if gsd != args.gsd:
            raise photographs.NoTrainingData(
                f"{folder} holds samples at {gsd:g} m per px, the model is to be of {args.gsd:g}: "
                f"make them again with learn.own --gsd={args.gsd:g}"
            )
    if own and (side := min(Sample.load(own[0]).labels.shape)) < size:
        raise photographs.NoTrainingData(
            f"{own[0]} is {side} px wide, a training tile {size} px: make own samples again with learn.own --tile {size} or more"
        )
    view = _direction(args.view_azimuth, args.view_elevation)
    sun = _direction(args.sun_azimuth, args.sun_elevation)
    if args.tiles:
        _claim(pool, args, view, sun)
        cities = tuple(map(citymodel.read, args.cities))
        houses = draped.houses(training, draped.read_heights(roof_graphs)) if training else []
        look = (args.tiles, args.seed, chips, view, sun, cities, houses, args.gsd)
        multiprocessing.get_context("fork").Process(target=fill_pool, args=(pool, *look), daemon=True).start()
    wanted = {**SHARES, **args.shares}
    if heights_needed:
        wanted |= {"pasted": 0.0, "chips": 0.0}
    shown = windows_of(args)
    mixture = dataset.Mixture(
        pool,
        training,
        chips,
        [wanted[name] for name in NAMES],
        size,
        args.seed,
        own,
        upright,
        args.gsd,
        tuple(1.0 if name in args.untold else args.forget for name in DIRECTIONS),
        shown,
    )
    if args.tiles and not own and not chips:
        _wait_for_first(pool)
    there = {
        "simulated": bool(args.tiles) or any(pool.glob("[!.]*.npz")),  # to be rendered, or rendered before
        "pasted": bool(training and chips),
        "chips": bool(chips),
        "own": bool(own),
    }
    if not any(there[name] and wanted[name] for name in NAMES):
        shared = ", ".join(f"{name} {wanted[name]:g}" for name in NAMES)
        raise photographs.NoTrainingData(
            f"nothing to learn from: there is {' and '.join(filter(there.get, NAMES)) or 'nothing'}, the shares are {shared}"
        )
    kept = [path for folder in args.own for path in sorted(Path(folder, "validation").glob("[!.]*.npz"))]
    validation = [Sample.load(path) for path in kept]
    validation += [
        dataset.simulated(np.random.default_rng([args.seed, HELD_OUT + i]), view=view, sun=sun, gsd=args.gsd)
        for i in range(args.validation)
    ]
    validation = [
        prepared(as_seen(sample, i, shown, args.untold), size, upright) for i, sample in enumerate(validation)
    ]
    return Sources(mixture, validation, about(args, there["simulated"], bool(graphs), bool(chips), view, sun))


def signature(args: argparse.Namespace) -> str:
    """What a run learns from and starts from, as a hash: with other data it is another run."""
    records = [store.read_json(Path(folder) / "own.json") for folder in args.own]
    view, sun = _direction(args.view_azimuth, args.view_elevation), _direction(args.sun_azimuth, args.sun_elevation)
    init = fingerprint.of_source(args.init, Path(args.out) / "fingerprints.json") if args.init else None
    cities = city_files(args)
    corrected = [store.read_json(path) for folder in args.own if (path := Path(folder) / CORRECTED).is_file()]
    look = fingerprint.of_file(args.look, Path(args.out) / "fingerprints.json") if args.look else None
    alike = [look, sorted(args.untold)] if args.look or args.untold else []
    alike += [corrected] if corrected else []
    return fingerprint.of_values(
        records, bool(args.data), args.free, sorted(args.leave_out), cities, view, sun, init, *alike
    )


def city_files(args: argparse.Namespace) -> list[str]:
    """What the city models hold that simulated tiles show."""
    cache = Path(args.out) / "fingerprints.json"
    return sorted(fingerprint.of_file(city, cache) for city in args.cities)


def as_seen(sample: Sample, number: int, shown: Sequence[np.ndarray], untold: Sequence[str]) -> Sample:
    """The validation sample of a number as one of the windows of the scene to fine-tune for, told what is known of that."""
    rng = np.random.default_rng([0, number])
    if len(shown):
        sample = sample._replace(rgb=augmentation.likened(sample.rgb, shown[number % len(shown)], rng))
    return augmentation.without_geometry(sample, rng, tuple(float(name in untold) for name in DIRECTIONS))


def prepared(sample: Sample, size: int, upright: bool) -> Sample:
    """The middle of a validation sample, upright if the network sees it so."""
    rows, cols = sample.labels.shape
    part = sample.window((rows - size) // 2, (cols - size) // 2, size)
    return augmentation.upright(part, np.random.default_rng(0)) if upright else part


def about(
    args: argparse.Namespace,
    simulates: bool,
    graphs: bool,
    chips: bool,
    view: tuple[float, float] | None,
    sun: tuple[float, float] | None,
) -> dict[str, Any]:
    """`trained_on` of the contract: data and licence of the sources used, angles, and heights of own corners."""
    records = [store.read_json(Path(folder) / "own.json") for folder in args.own]
    data = ["simulated scenes"] if simulates else []
    data += [f"simulated scenes of the city in {Path(city).name}" for city in args.cities]
    data += ["roof-graph photographs (Ren et al. 2021), pasted"] if graphs else []
    without = f", without {', '.join(args.leave_out)}" if args.leave_out else ""
    of = " of SpaceNet-2" if args.free else ""
    data += [f"chips with building masks{of}{without}"] if chips else []
    guessed = (", guessed by a model" if "licence" in record else "" for record in records)
    data += [f"own samples: {Path(folder).name}{by}" for folder, by in zip(args.own, guessed, strict=True)]
    data += [f"made to look like {Path(args.look).stem}"] if args.look else []
    bound = SHARE_ALIKE if args.free else NON_COMMERCIAL
    licence = bound if graphs or chips else OWN if args.own else SIMULATED
    teachers = [record["licence"] for record in records if "licence" in record]
    cities = [CITIES] if args.cities else []
    found: dict[str, Any] = {"data": data, "licence": together(licence, *teachers, *cities)}
    for name, direction in (("view", view), ("sun", sun)):
        # Simulated tiles show all directions unless one is asked for; own ones alone show theirs.
        shown = [direction] if simulates else [tuple(r[name]) if r[name] else None for r in records]
        if simulates and direction is None:
            continue
        found |= told(name, shown)
    if args.untold:
        found["untold"] = sorted(args.untold, key=DIRECTIONS.index)
    records = [record["corners"] for record in records]
    known = [record for record in records if record["count"]]
    if known:
        count = sum(r["count"] for r in known)
        mean = sum(r["count"] * r["mean_height"] for r in known) / count
        variance = sum(r["count"] * (r["sigma"] ** 2 + (r["mean_height"] - mean) ** 2) for r in known) / count
        found["corner_heights"] = [mean, float(np.sqrt(variance))]
    return found


def together(*licences: str) -> str:
    """What binds who learns from data under all of these, each term once; simulated scenes bind nobody."""
    terms = dict.fromkeys(term for licence in licences for term in licence.split(AND))
    return AND.join(term for term in terms if term != SIMULATED) or SIMULATED


def told(name: str, shown: list[tuple[float, float] | None]) -> dict[str, list[float] | None]:
    """The ranges (deg) of a contract for tiles shown from these directions (azimuth, elevation); None: no range is known."""
    if not shown or None in shown:
        return {f"{name}_azimuth": None, f"{name}_elevation": None}
    azimuth, elevation = np.array(shown).T
    turned = (azimuth - azimuth[0] + 180) % 360 - 180 + azimuth[0]
    around = [float((turned.min() - TOLD_ANGLES) % 360), float((turned.max() + TOLD_ANGLES) % 360)]
    high = float(min(elevation.max() + TOLD_ANGLES, 90.0))
    return {f"{name}_azimuth": around, f"{name}_elevation": [float(elevation.min() - TOLD_ANGLES), high]}


def middle(trained: dict[str, Any], name: str) -> tuple[float, float] | None:
    """The middle of the directions that a model is for, azimuth and elevation in deg; None for one that is for all azimuths."""
    azimuth, elevation = trained.get(f"{name}_azimuth"), trained.get(f"{name}_elevation")
    if not azimuth or not elevation or azimuth[1] - azimuth[0] >= 360:
        return None
    return (azimuth[0] + (azimuth[1] - azimuth[0]) % 360 / 2) % 360, sum(elevation) / 2


def _direction(azimuth: float | None, elevation: float | None) -> tuple[float, float] | None:
    return None if azimuth is None or elevation is None else (azimuth % 360, elevation)


def fill_pool(
    pool: Path,
    count: int,
    seed: int,
    chips: list[photographs.Chip],
    view: tuple[float, float] | None = None,
    sun: tuple[float, float] | None = None,
    cities: Sequence[citymodel.CityModel] = (),
    houses: Sequence[draped.House] = (),
    gsd: float = dataset.GSD,
) -> None:
    """Render simulated tiles into a folder until it holds `count`, leaving what is there."""
    os.nice(10)
    cv2.setNumThreads(1)
    backgrounds = [(chip.rgb, ~chip.building) for chip in chips]
    pool.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = pool / f"{seed}-{number:06d}.npz"
        if not path.exists():
            rng = np.random.default_rng([seed, number])
            sample = dataset.simulated(
                rng,
                backgrounds=backgrounds,
                view=view,
                sun=sun,
                cities=cities,
                houses=houses,
                gsd=gsd,
                tall=number % TALL_EVERY == TALL_EVERY - 1,
            )
            sample.save(path)


def _claim(pool: Path, args: argparse.Namespace, view: Any, sun: Any) -> None:
    """Say in a pool what its tiles show. Raises `NoTrainingData` where those that are there show something else."""
    shown = {
        "seed": args.seed,
        "gsd": args.gsd,
        "view": view and list(view),
        "sun": sun and list(sun),
        "cities": sorted(Path(city).name for city in args.cities),
        "city_files": city_files(args),
        "leave_out": sorted(args.leave_out),
        "photographs": bool(args.data),
        "free": bool(args.free),
    }
    record = pool / "pool.json"
    before = store.read_json(record) if record.is_file() else shown
    if {**shown, **before} != shown:  # older pools say less
        raise photographs.NoTrainingData(
            f"{pool} holds tiles of other settings ({before}, not {shown}): delete it, or choose another --pool (train.name)"
        )
    pool.mkdir(parents=True, exist_ok=True)
    store.write_json(record, shown, summed=False)


def _wait_for_first(pool: Path, seconds: float = 600.0) -> None:
    """Wait until the pool holds a tile. Raises `NoTrainingData` when none comes."""
    end = time.monotonic() + seconds
    while not any(pool.glob("[!.]*.npz")):
        if time.monotonic() > end:
            raise photographs.NoTrainingData(f"{pool} is still empty after {seconds:g} s: rendering does not work here")
        time.sleep(0.2)
