"""Paper picture: `paper.tif`, sections and corners in the colours of the paper's intermediate images, for comparison with them.

Black where no roof is seen. A section is blue, 200 if its tile belongs to training, 210 validation, 220 testing, and
sections are pixel-separated; a corner is a square of `--square` px whose red is 200 + its height above ground in whole metres.
Red ends at 255, so heights above 55 m look alike: this is a picture, never where heights are kept.

In: sections and filed corners of all blocks. Out: an RGB GeoTIFF (COG) in the image frame, written window by window.
"""

from __future__ import annotations

import argparse

import numpy as np
import pyarrow as pa
import rasterio
from numpy.typing import NDArray

from kibs_steps import cli, scan_order, store
from kibs_steps import scene as scenes
from kibs_steps.grid import Window
from kibs_steps.publish import licences, rasters
from kibs_steps.scene import Scene

SQUARE = 15  # px, the paper's q
RED = 200


def painted(
    scene: Scene,
    sections: rasters.Sections,
    split: dict[int, int],
    corners: NDArray[np.float64],
    window: Window,
    square: int = SQUARE,
) -> NDArray[np.uint8]:
    """The picture (height, width, 3) of a window; `split` by section id, `corners` (n, 3): col, row (px), height (m)."""
    labels, _ = rasters.shown(sections, scene, window.grown(1))
    labels = scan_order.apart(labels)[1:-1, 1:-1]
    picture = np.zeros((window.height, window.width, 3), np.uint8)
    ids, place = np.unique(labels, return_inverse=True)
    blue = [0 if i == 0 else scan_order.CODES[split[int(i)]] for i in ids]
    picture[..., 2] = np.array(blue, np.uint8)[place].reshape(labels.shape)
    first = np.floor(corners[:, :2] - (square - 1) / 2).astype(int) - [window.col, window.row]
    inside = (first + square > 0).all(axis=1) & (first < [window.width, window.height]).all(axis=1)
    # Where squares overlap the higher corner is shown: the outcome does not depend on the order of the table.
    for (col, row), height in sorted(
        zip(first[inside].tolist(), corners[inside, 2].tolist(), strict=True), key=lambda c: c[1]
    ):
        part = picture[max(row, 0) : row + square, max(col, 0) : col + square, 0]
        np.maximum(part, np.uint8(np.clip(RED + round(height), RED, 255)), out=part)
    return picture


def main(argv: list[str] | None = None) -> None:
    """Write the sections and corners of a scene in the paper's colours."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.paper_picture", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--sections", required=True, help="buildings.parquet")
    parser.add_argument("--corners", required=True, nargs="+", help="filed_corners.parquet of all blocks")
    parser.add_argument(
        "--models", nargs="*", default=[], help="models/*.json: their licence goes into the file's tags"
    )
    parser.add_argument("--square", type=int, default=SQUARE, help="side of a corner's square, px")
    parser.add_argument("--out", required=True, help="out: paper.tif")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    sections = rasters.read([args.sections])
    table = store.read_table(args.sections, ["section_id", "split"])
    split = dict(zip(table["section_id"].to_pylist(), table["split"].to_pylist(), strict=True))
    filed = pa.concat_tables([store.read_table(path, ["col", "row", "height"]) for path in args.corners])
    corners = np.unique(np.column_stack([filed[name].to_numpy() for name in ("col", "row", "height")]), axis=0)
    tags = {"LICENCE": line} if (line := licences.line(args.models)) else {}
    with (
        rasterio.Env(GDAL_CACHEMAX=rasters.CACHE),
        rasters.cloud_optimized(args.out, scene.grid, "uint8", None, tags, bands=3) as target,
    ):
        for window in scene.grid.windows(rasters.SIDE):
            picture = painted(scene, sections, split, corners, window, args.square)
            target.write(picture.transpose(2, 0, 1), window=rasterio.windows.Window(*window))


if __name__ == "__main__":
    cli.run(main)
