"""Look: how a scene that a model is fine-tuned for looks: windows of its raster as networks see it.

No annotation is needed: training tiles are made as sharp and coloured as these windows (`augmentation.likened`).
In: a raster, its terrain, a GSD. Out: `look.npy`, windows (n, s, s, 3) uint8 in which nearly every pixel holds data.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from kibs_steps import cli, store, tiles
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.grid import Window
from kibs_steps.learn import dataset
from kibs_steps.scene import Scene

SIDE = 256  # px
MOST = 64  # windows
TRIES = 8  # places looked at for every window wanted
FILLED = 0.95  # least share of a window's pixels that hold data
PLAIN = 1 / 3  # of the usual contrast: windows with less are water or a field, and no tile is to look like those


class NothingToSee(KibsError):
    """A raster of which no window shows enough."""


def windows(scene: Scene, seed: int, most: int = MOST, side: int = SIDE) -> np.ndarray:
    """Windows (n, s, s, 3) uint8 of a scene's image on the model grid, drawn at random, without those that are nearly
    of one colour; smaller ones of a small raster.

    Raises `NothingToSee` where none holds enough data.
    """
    rng = np.random.default_rng(seed)
    side = min(side, scene.grid.width, scene.grid.height)
    found = []
    for _ in range(TRIES * most):
        col, row = (int(rng.integers(n - side + 1)) for n in (scene.grid.width, scene.grid.height))
        rgb, valid = tiles.read_window(scene, Window(col, row, side, side))
        if valid.mean() >= FILLED:
            found.append(rgb)
        if len(found) == most:
            break
    if not found:
        raise NothingToSee(
            f"{scene.raster}: of {TRIES * most} windows of {side} px none holds data in {FILLED:.0%} of its pixels: set `aoi` to "
            "the part that does"
        )
    kept = np.stack(found)
    contrast = kept.std(axis=(1, 2)).mean(axis=1)
    return kept[contrast >= PLAIN * np.median(contrast)]


def main(argv: list[str] | None = None) -> None:
    """Write windows of a raster."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.look", description=main.__doc__)
    parser.add_argument("--raster", required=True)
    parser.add_argument("--bands", type=lambda text: tuple(map(int, text.split(","))))
    parser.add_argument("--aoi")
    parser.add_argument("--gsd", type=float, default=dataset.GSD, help="of the models to train, m")
    parser.add_argument("--seed", type=int, default=0, help="of the windows' places")
    parser.add_argument("--out", required=True, type=Path, help="look.npy")
    args = parser.parse_args(argv)
    # The image alone counts: on flat ground it is where it is.
    scene = scenes.build("look", args.raster, 0.0, args.gsd, args.out.parent / "look", bands=args.bands, aoi=args.aoi)
    found = windows(scene, args.seed)
    with store.whole(args.out, summed=False) as temporary, open(temporary, "wb") as file:
        np.save(file, found)
    print(f"{args.out}: {len(found)} windows of {found.shape[1]} px")


if __name__ == "__main__":
    cli.run(main)
