"""Blend: the image the 3D model sees, the sections found by the 2D model painted into it.

The colours are part of the model's contract: a value per band for pixels inside sections, on their rims (a 4-neighbour of
another label) and outside, where null keeps the image's own band (PAPER, 3D roof corners; finding 5).

In: `tiles.tif`, `sections.tif`. Out: `blended.tif`, RGB uint8, the same stack of tile windows as `sections.tif`, each tile
blended with its own detections, so that a tile's corners do not depend on how tiles are grouped into blocks.
"""

from __future__ import annotations

import argparse

import numpy as np

from kibs_steps import cli, raster, scene, sections, store
from kibs_steps.grid import Tiling
from kibs_steps.labels import rims

Bands = list[int | None]


def blend(rgb: np.ndarray, labels: np.ndarray, inside: Bands, rim: Bands, outside: Bands) -> np.ndarray:
    """The blended image (s, s, 3) uint8 of an image and its section labels (s, s)."""
    out = rgb.copy()
    for where, colours in ((labels > 0, inside), (rims(labels), rim), (labels == 0, outside)):
        for band, value in enumerate(colours):
            out[where, band] = rgb[where, band] if value is None else value
    return out


def main(argv: list[str] | None = None) -> None:
    """Blend the sections of one block into its image."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.blend", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--tiles", required=True, help="tiles.tif of the block")
    parser.add_argument("--labels", required=True, help="sections.tif of the block")
    parser.add_argument("--model", required=True, help="models/corners.json")
    parser.add_argument("--name", required=True, help="block name")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--out", required=True, help="blended.tif")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    contract = store.read_json(args.model)["contract"]
    tiling = Tiling(contract["tile"], args.margin, args.block)
    block = tiling.block_of(args.name)
    core = tiling.block_core(block, facts.grid.width, facts.grid.height)
    tiles = tiling.tiles(block, facts.grid.width, facts.grid.height)
    rgb = raster.read(args.tiles)[..., :3]
    labels = sections.unstack(raster.read(args.labels), tiles, tiling.tile)
    blended = {
        (t.row, t.col): blend(
            sections.tile_image(rgb, t, tiling, core, facts.grid),
            labels[t.row, t.col],
            **contract["blend"],
        )
        for t in tiles
    }
    raster.write(args.out, sections.stack(blended, tiling.tile))


if __name__ == "__main__":
    cli.run(main)
