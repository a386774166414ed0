"""Rasters of any size for measuring: cities put together from simulated scenes, written window by window.

A **library** of simulated scenes (kinds of town, seeds) is made once. The raster is a lattice of patches of `PATCH` px; each
shows another scene than its neighbours, from a random place on, mirrored in columns or not, with brightness, contrast and
colour of its own. Roofs cut at a patch's edge are part of the bargain; mirroring turns shadows, not the view's lean, which is
all but along columns at the view used. Same seed, same bytes.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyogrio
import rasterio
from affine import Affine
from rasterio.windows import Window

GSD = 0.38
PATCH = 1024  # px: no multiple of a block's side, so blocks differ
SIDE = 1400  # px of a library scene
STYLES = ("farm", "town", "farm", "farm", "village", "farm", "farm", "industry", "farm", "farm")  # as round Mourmelon
VIEW = {"view_azimuth": 181.1, "view_elevation": 59.3, "sun_azimuth": 155.0, "sun_elevation": 45.0}
DENSEST = 300  # buildings per km² that the library must reach
ORIGIN = (500_000.0, 5_400_000.0)
DTM_STEP = 2.0  # m


def library(folder: Path, count: int) -> list[Path]:
    """The simulated scenes, made where they are missing; those with too few buildings are left out."""
    scenes = []
    for k in range(count):
        scene = folder / f"scene{k:02d}"
        if not (scene / "truth.gpkg").exists():
            angles = [f"--{name.replace('_', '-')}={value}" for name, value in VIEW.items()]
            call = [sys.executable, "-m", "kibs_steps.simulate.scene", f"--seed={9000 + k}", f"--size={SIDE}"]
            style = f"--style={STYLES[k % len(STYLES)]}"
            subprocess.run([*call, style, f"--gsd={GSD}", *angles, f"--out={scene}"], check=True)
        scenes.append(scene)
    return scenes


def density(scenes: list[Path]) -> float:
    """Buildings per km² of the library."""
    found = 0
    for scene in scenes:
        table = pyogrio.read_dataframe(scene / "truth.gpkg", layer="sections_image", read_geometry=False)
        found += table["building_id"].nunique()
    return found / (len(scenes) * (SIDE * GSD / 1000) ** 2)


def chosen(rows: int, cols: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Scene number (rows, cols) of every patch: never that of the patch above, to the left, or diagonal to it."""
    numbers = np.full((rows + 1, cols + 2), -1)
    for row in range(1, rows + 1):
        for col in range(1, cols + 1):
            near = {numbers[row - 1, col - 1], numbers[row - 1, col], numbers[row - 1, col + 1], numbers[row, col - 1]}
            numbers[row, col] = rng.choice([k for k in range(count) if k not in near])
    return numbers[1:, 1:-1]


def patch(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A patch (3, PATCH, PATCH) uint8 of a scene's image: cut, perhaps mirrored, with radiometry of its own."""
    row, col = rng.integers(0, image.shape[1] - PATCH + 1, 2)
    part = image[:, row : row + PATCH, col : col + PATCH]
    if rng.random() < 0.5:
        part = part[:, :, ::-1]
    gain, offset = rng.uniform(0.85, 1.15) * rng.uniform(0.97, 1.03, 3), rng.uniform(-12, 12)
    curve = np.arange(256)[None] * gain[:, None] + offset
    tables = np.clip(np.rint(curve), 0, 255).astype(np.uint8)
    return np.stack([table[band] for table, band in zip(tables, part, strict=True)])


def raster(path: Path, width: int, height: int, scenes: list[Path], seed: int = 0) -> None:
    """Write the raster, a row of patches at a time."""
    rng = np.random.default_rng(seed)
    images = [rasterio.open(scene / "scene.tif").read() for scene in scenes]
    rows, cols = -(-height // PATCH), -(-width // PATCH)
    numbers = chosen(rows, cols, len(images), rng)
    form = {
        "tiled": True,
        "blockxsize": 512,
        "blockysize": 512,
        "compress": "zstd",
        "zstd_level": 1,
        "BIGTIFF": "IF_SAFER",
    }
    place = {"crs": "EPSG:32631", "transform": Affine(GSD, 0, ORIGIN[0], 0, -GSD, ORIGIN[1])}
    part = path.with_suffix(".part.tif")
    with rasterio.open(
        part,
        "w",
        driver="GTiff",
        count=3,
        dtype="uint8",
        width=width,
        height=height,
        photometric="RGB",
        **place,
        **form,
    ) as target:
        for i in range(rows):
            for j in range(cols):
                window = Window(j * PATCH, i * PATCH, min(PATCH, width - j * PATCH), min(PATCH, height - i * PATCH))
                target.write(patch(images[numbers[i, j]], rng)[:, : window.height, : window.width], window=window)
    part.rename(path)


def terrain(path: Path, width: int, height: int) -> None:
    """Write rolling hills under a raster of that size (px) and 300 m around it, in strips."""
    left, top = ORIGIN[0] - 300, ORIGIN[1] + 300
    cols, rows = (int(np.ceil((length * GSD + 600) / DTM_STEP)) for length in (width, height))
    part = path.with_suffix(".part.tif")
    with rasterio.open(
        part, "w", driver="GTiff", count=1, dtype="float32", width=cols, height=rows, crs="EPSG:32631", tiled=True,
        transform=Affine(DTM_STEP, 0, left, 0, -DTM_STEP, top), compress="zstd", zstd_level=1, predictor=3,
    ) as target:  # fmt: skip
        x = np.arange(cols) * DTM_STEP
        for first in range(0, rows, 512):
            y = np.arange(first, min(first + 512, rows)) * DTM_STEP
            heights = 100 + 8 * np.sin(x / 900)[None] + 6 * np.cos(y / 700)[:, None]
            target.write(heights.astype(np.float32), 1, window=Window(0, first, cols, len(y)))
    part.rename(path)
