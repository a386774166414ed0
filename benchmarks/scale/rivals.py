"""What the workflow is measured against: the bare models, the paper's models, the paper's labelling.

The **floor** is the time the shipped models alone need for all tiles, by bare onnxruntime on the same cores: no reading, no
decoding, no files. The **pair** is the paper's two Mask R-CNNs with random weights: cost only. **Flood fill** is the paper's
labelling, scikit-image's `flood_fill` from every section's first pixel in scan order, sections being a pixel apart; a fill is
timed at three sizes, up to the whole raster, and a city takes one for each of its sections.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def passes(contract: dict[str, Any]) -> int:
    """How often a model is run on every tile."""
    upright = 2 if contract.get("mirrored") else 1
    return upright if contract.get("upright") else contract.get("flips", 1)


def _bare(path: str, tiles: int, seed: int) -> float:
    """Seconds that one process needs for `tiles` tiles by one model, all its passes, its session being open."""
    import onnxruntime as ort

    from kibs_steps.models import contract as contracts

    model = contracts.load(path)
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    s = model.contract["tile"]
    rng = np.random.default_rng(seed)
    feed = {"image": rng.normal(size=(1, 3, s, s)).astype(np.float32)}
    if model.contract.get("geometry_input"):
        feed["geometry"] = np.array([[0.1, -1.5, 0.5, -0.9, 1, 1]], np.float32)
    session.run(None, feed)
    start = time.monotonic()
    for _ in range(tiles * passes(model.contract)):
        session.run(None, feed)
    return time.monotonic() - start


def _share(queue: multiprocessing.Queue, barrier: Any, paths: list[str], tiles: int, seed: int) -> None:
    barrier.wait()
    queue.put(sum(_bare(path, tiles, seed) for path in paths))


def per_tile(paths: list[Path], tiles: int, cores: int) -> float:
    """Wall seconds per tile of the models, `cores` processes sharing the tiles; measured on `tiles` tiles per process."""
    queue, barrier = multiprocessing.Queue(), multiprocessing.Barrier(cores)
    names = [str(p) for p in paths]
    workers = [multiprocessing.Process(target=_share, args=(queue, barrier, names, tiles, k)) for k in range(cores)]
    for worker in workers:
        worker.start()
    spent = [queue.get() for _ in workers]
    for worker in workers:
        worker.join()
    return max(spent) / (tiles * cores)


def pair(folder: Path) -> list[Path]:
    """The paper's two networks with random weights as ONNX files, exported where they are missing.

    Exporting needs torchvision, or its operators in plain torch (`tests/torchvision_cpu_ops.py`); the files need neither. Raises
    `maskrcnn.NoTorchvision`.
    """
    import torch

    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    import torchvision_cpu_ops

    torchvision_cpu_ops.usable()
    from kibs_steps.learn import maskrcnn

    paths = []
    for task in maskrcnn.TASKS:
        path = folder / f"maskrcnn_{task}.onnx"
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            torch.manual_seed(0)
            maskrcnn.to_onnx(maskrcnn.network(task).eval(), str(path), maskrcnn.TILE)
        paths.append(path)
    return paths


def pair_per_tile(paths: list[Path], images: np.ndarray, cores: int) -> float:
    """Wall seconds per tile of the pair on a sample (n, 3, s, s) float32 of normalised tiles, spread over the cores."""
    with multiprocessing.Pool(cores) as pool:
        parts = np.array_split(images, cores)
        return max(pool.starmap(_pair_share, [([str(p) for p in paths], part) for part in parts])) / len(images)


def _pair_share(paths: list[str], images: np.ndarray) -> float:
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    sessions = [ort.InferenceSession(path, options, providers=["CPUExecutionProvider"]) for path in paths]
    names = [session.get_inputs()[0].name for session in sessions]
    start = time.monotonic()
    for image in images:
        for session, name in zip(sessions, names, strict=True):
            session.run(None, {name: image if len(session.get_inputs()[0].shape) == 3 else image[None]})
    return time.monotonic() - start


def apart(labels: np.ndarray) -> np.ndarray:
    """The pixels (rows, cols) bool of labelled sections less those that touch a section above or to the left of them.

    The paper keeps sections a pixel apart, so that each is an area of its own.
    """
    roofs = labels > 0
    for axis in (0, 1):
        before = np.roll(labels, 1, axis)
        touches = (before > 0) & (before != labels)
        np.moveaxis(touches, axis, 0)[0] = False
        roofs &= ~touches
    return roofs


def flooded(roofs: np.ndarray) -> int:
    """The paper's labelling of a mask (rows, cols) of roof pixels: number of areas found."""
    return len(fills(roofs, np.flatnonzero(roofs)))


def fills(roofs: np.ndarray, starts: np.ndarray) -> list[float]:
    """Seconds of each fill, from those of the pixels `starts` (places in the flattened mask) that no fill has reached yet."""
    from skimage.segmentation import flood_fill

    image = np.where(roofs, np.int32(-1), np.int32(0))
    spent = []
    for row, col in zip(*np.unravel_index(starts, roofs.shape), strict=True):
        if image[row, col] == -1:
            start = time.monotonic()
            image = flood_fill(image, (int(row), int(col)), len(spent) + 1, connectivity=1)
            spent.append(time.monotonic() - start)
    return spent


def law(sizes: list[float], seconds: list[float]) -> tuple[float, float]:
    """Exponent and factor of the power law seconds = factor · size^exponent through measurements (least squares of logs)."""
    exponent, intercept = np.polyfit(np.log(sizes), np.log(seconds), 1)
    return float(exponent), float(np.exp(intercept))


def growth(labels: Callable[[int], np.ndarray], sides: list[int], most: int = 12) -> dict[str, Any]:
    """Seconds of one fill in label images (side, side) of the given sides, a mean of at most `most`; the law through them (size
    in Mpx)."""
    flooded(np.ones((2, 2), bool))  # imports what it needs
    sizes, seconds = [], []
    for side in sides:
        roofs = apart(labels(side))
        starts = np.flatnonzero(roofs)
        seconds.append(float(np.mean(fills(roofs, starts[np.linspace(0, len(starts) - 1, most).astype(int)]))))
        sizes.append(roofs.size / 1e6)
    exponent, factor = law(sizes, seconds)
    return {"mpx": sizes, "seconds": seconds, "exponent": round(exponent, 3), "factor": factor}
