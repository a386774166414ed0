"""Supposed directions: from where an image looks to be seen and lit, where nobody told.

A network that knows view and sun finds far more, and it can tell which ones suit: told wrong ones it is unsure of what it sees.
So the 2D model looks at a few tiles as seen and lit from one direction after another, and the one it is surest with is supposed.
Networks are told so; nothing is moved by it, for a lean that nobody measured is no measure of places.

In: `scene.json` without view or sun (or both), the raster, the 2D model. Out: `supposed.json`: `view` and `sun`, each with
azimuth and elevation (deg) and lean, or null where there is nothing to look at.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kibs_steps import cli, georeference, scene, store
from kibs_steps import view as geometry
from kibs_steps.grid import Grid, Tile, Tiling, Window
from kibs_steps.scene import Direction, Scene

if TYPE_CHECKING:
    from kibs_steps.models import runtime

NADIR = Direction(0.0, 90.0, (0.0, 0.0))
AZIMUTHS = tuple(range(0, 360, 45))  # deg
VIEW_ELEVATIONS = (62.0, 50.0, 75.0)  # deg, the usual one first
SUN_ELEVATIONS = (45.0, 30.0, 60.0)
LOOKED_OVER = 12  # tiles, of which the network says how much roof they show
TRIED = 3  # tiles of most roof
LEAST_ROOF = 0.005  # of the tiles: with less there is nothing to tell a view by


class Doubt(NamedTuple):
    """What a network says of the tiles it looks at: mean entropy of roofs and rims (nats), share of roof."""

    entropy: float
    roof: float

    @property
    def by_roof(self) -> float:
        """Entropy for the roof that is seen: who sees little is easily sure."""
        return self.entropy / max(self.roof, LEAST_ROOF)


Look = Callable[[Direction | None, Direction | None], Doubt]


class Supposed(NamedTuple):
    """View and sun as networks are told; None for what is not known."""

    view: Direction | None
    sun: Direction | None


NOTHING = Supposed(None, None)
Networks = Callable[[Window], "runtime.Network"]  # a tile's core -> the network that looks at it, told where


def directions(look: Look, view: Direction | None, sun: Direction | None, turned: float = 0.0) -> Supposed:
    """View and sun with which a `look` (at a view and a sun) leaves least doubt; those given are kept.

    The sun first, for shadows tell most, by the entropy; then the view, nadir too, by the entropy for the roof seen.
    Azimuths are tried at the usual elevation, then other elevations at the best of them. `turned`: meridian convergence (deg).
    """
    if sun is None:
        sun = _surest(lambda tried: look(view, tried).entropy, SUN_ELEVATIONS, turned)
    if view is None:
        view = _surest(lambda tried: look(tried, sun).by_roof, VIEW_ELEVATIONS, turned, [NADIR])
    return Supposed(view, sun)


def _surest(
    doubt: Callable[[Direction], float], elevations: Sequence[float], turned: float, others: Sequence[Direction] = ()
) -> Direction:
    def at(azimuth: float, elevation: float) -> Direction:
        return Direction(azimuth, elevation, geometry.lean(azimuth, elevation, turned))

    tried = [*others, *(at(azimuth, elevations[0]) for azimuth in AZIMUTHS)]
    doubts = [doubt(direction) for direction in tried]
    best = tried[int(np.argmin(doubts))]
    if best not in others:
        finer = [at(best.azimuth, elevation) for elevation in elevations[1:]]
        tried += finer
        doubts += [doubt(direction) for direction in finer]
    return tried[int(np.argmin(doubts))]


def doubt(roof: np.ndarray, edge: np.ndarray) -> Doubt:
    """What roof and rim probabilities (n,) of pixels with data say."""
    chances = np.clip(np.stack([roof, edge]).astype(np.float64), 1e-4, 1 - 1e-4)
    entropy = -(chances * np.log(chances) + (1 - chances) * np.log1p(-chances)).sum(axis=0)
    return Doubt(float(entropy.mean()), float((roof > 0.5).mean()))


def looked_over(tiling: Tiling, grid: Grid) -> list[Tile]:
    """Up to `LOOKED_OVER` tiles, evenly spread over the raster in reading order."""
    tiles = [
        t for block in tiling.blocks(grid.width, grid.height) for t in tiling.tiles(block, grid.width, grid.height)
    ]
    chosen = np.unique(np.linspace(0, len(tiles) - 1, min(LOOKED_OVER, len(tiles))).round().astype(int))
    return [tiles[k] for k in chosen]


def told(facts: Scene, core: Window, supposed: Supposed = NOTHING) -> np.ndarray:
    """What networks are told of view and sun in the middle of a tile's `core` (1, 6): what the scene knows there, else what is
    supposed."""
    from kibs_steps.models import runtime

    view, sun = facts.view_of(core) or supposed.view, facts.sun or supposed.sun
    return runtime.geometry_vector(view and view.lean, sun and sun.lean, facts.grid.gsd)


def telling(facts: Scene, path: str | None) -> Callable[[Window], np.ndarray]:
    """From a tile's core to what networks are told of view and sun there (1, 6)."""
    supposed = read(path) if path else NOTHING
    return lambda core: told(facts, core, supposed)


def read(path: str) -> Supposed:
    """Read `supposed.json`."""
    content = store.read_json(path)
    found = (content[name] for name in ("view", "sun"))
    return Supposed(*(d and Direction(d["azimuth"], d["elevation"], tuple(d["lean"])) for d in found))


def main(argv: list[str] | None = None) -> None:
    """Say from where a scene without angles looks to be seen and lit."""
    from kibs_steps.models import runtime
    from kibs_steps.sections import tile_image
    from kibs_steps.tiles import read_window

    parser = argparse.ArgumentParser(prog="python -m kibs_steps.supposed", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--raster", help="a copy to read instead of the scene's raster")
    parser.add_argument("--model", required=True, help="models/sections.json")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    runtime.add_options(parser)
    parser.add_argument("--out", required=True, help="out: supposed.json")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    facts = facts._replace(raster=args.raster or facts.raster)
    task = store.read_json(args.model)["contract"]["task"]
    model = runtime.from_record(args.model, task)
    tiling = Tiling(model.contract["tile"], args.margin, args.block)
    session = runtime.opened(model, args.provider, args.threads, looks=1)

    def network(view: Direction | None, sun: Direction | None) -> runtime.Network:
        return session(runtime.geometry_vector(view and view.lean, sun and sun.lean, facts.grid.gsd))

    plain = network(facts.view, facts.sun)
    seen = []
    for tile in looked_over(tiling, facts.grid):
        rgb, valid = read_window(facts, tile.core.grown(args.margin))
        image = tile_image(rgb, tile, tiling, tile.core, facts.grid)
        data = tile_image(valid, tile, tiling, tile.core, facts.grid, "constant")
        if data.any():
            seen.append((float((plain(image)["roof"][0] * data).sum()), image, data))
    shown = [(image, data) for _, image, data in sorted(seen, key=lambda one: -one[0])[:TRIED]]

    def look(view: Direction | None, sun: Direction | None) -> Doubt:
        run = network(view, sun)
        maps = [(run(image), data) for image, data in shown]
        return doubt(*(np.concatenate([found[name][0][data] for found, data in maps]) for name in ("roof", "edge")))

    known = Supposed(facts.view, facts.sun)
    found = directions(look, *known, georeference.convergence(facts.grid)) if shown else known
    store.write_json(args.out, {name: d and d._asdict() for name, d in found._asdict().items()})
    for name, key, before, direction in (
        ("seen", "view", facts.view, found.view),
        ("lit", "sun", facts.sun, found.sun),
    ):
        if before is None and direction is not None:
            print(
                f"the image looks {name} from azimuth {direction.azimuth:g}°, elevation {direction.elevation:g}°, to some 25°: "
                f"networks are told so; set {key}_azimuth and {key}_elevation where they are known"
            )


if __name__ == "__main__":
    cli.run(main, pandas=False)
