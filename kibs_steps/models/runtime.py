"""Running a model: one onnxruntime session, the same answer on every machine's core count.

Threads and provider (what computes: the processor, a GPU) are arguments, never derived from the machine, because sums in
another order differ in their last bits.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kibs_steps import store
from kibs_steps.errors import KibsError
from kibs_steps.models import contract as contracts

GPU_MEMORY = 2 * 2**30  # bytes a job may take of a GPU, which several jobs share
PROVIDERS: dict[str, tuple[str, str, dict[str, object]]] = {  # onnxruntime's name, the package that has it, its options
    "cpu": ("CPUExecutionProvider", "onnxruntime", {}),
    "cuda": (
        "CUDAExecutionProvider",
        "onnxruntime-gpu",
        {
            "gpu_mem_limit": GPU_MEMORY,
            "arena_extend_strategy": "kSameAsRequested",
            "cudnn_conv_algo_search": "HEURISTIC",  # the fastest of one run is not that of the next, and gives other bits
            "use_tf32": 0,
        },
    ),
    "openvino": ("OpenVINOExecutionProvider", "onnxruntime-openvino", {"device_type": "CPU", "precision": "FP32"}),
}

MOST_LOOKS = 8  # at a tile: a square has no more symmetries
LEANING = 0.25  # px per metre of height: what leans less is seen from above
TOLD = {"view": [0, 1, 4], "sun": [2, 3, 5]}  # what networks are told: columns of the geometry input
DIRECTED = ("offset", "slope", "centre")  # maps whose two channels are a vector (col, row) of the image
FULL = ("roof", "edge", "distance", "slope", "centre")  # maps that are needed at every pixel, whatever their stride

Network = Callable[[np.ndarray], dict[str, np.ndarray]]  # image (s, s, 3) uint8 -> named maps, batch axis dropped


class ProviderMissing(KibsError):
    """An onnxruntime without the provider that is asked for."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of a step that runs a model: `--provider`, `--threads`, `--looks`."""
    parser.add_argument("--provider", choices=list(PROVIDERS), default="cpu", help="where onnxruntime computes")
    parser.add_argument("--threads", type=int, default=1, help="cores of one session")
    parser.add_argument("--looks", type=int, default=MOST_LOOKS, help="most symmetric views in which a tile is seen")


def geometry_vector(view: tuple[float, float] | None, sun: tuple[float, float] | None, gsd: float) -> np.ndarray:
    """The vector (1, 6) float32 that tells a network view and sun, from their leans (m per m; east, north) or None.

    A roof point at height h stands at P and is shown at P − h·k, so in image axes (col = east, row = south) at
    (−k_x, +k_y)/GSD px per metre; its shadow falls at P − h·k_sun likewise.
    """
    vector = np.zeros((1, 6), np.float32)
    if view is not None:
        vector[0, 0:2] = -view[0] / gsd, view[1] / gsd
        vector[0, 4] = 1.0
    if sun is not None:
        vector[0, 2:4] = -sun[0] / gsd, sun[1] / gsd
        vector[0, 5] = 1.0
    return vector


def open_network(
    model: contracts.Model, geometry: np.ndarray, provider: str = "cpu", threads: int = 1, looks: int = MOST_LOOKS
) -> Network:
    """The network of a model for one geometry (1, 6), as `opened` gives them."""
    return opened(model, provider, threads, looks)(geometry)


def opened(
    model: contracts.Model, provider: str = "cpu", threads: int = 1, looks: int = MOST_LOOKS
) -> Callable[[np.ndarray], Network]:
    """A session of a model: for a geometry (1, 6) a function from an image (s, s, 3) uint8 to the model's named outputs without
    their batch axis.

    Dense models are run on the symmetric views of the tile that `shown` gives, at most on `looks`, and their maps averaged.
    The geometry goes to models whose contract asks for it, but for what is kept from them (`untold`). `provider` is a key of
    `PROVIDERS`; `threads` within an operator. Raises `ProviderMissing`.
    """
    import onnxruntime as ort

    available(provider)
    name, _, settings = PROVIDERS[provider]
    if provider == "openvino":
        settings = {**settings, "num_of_threads": threads}
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    session = ort.InferenceSession(model.path.read_bytes(), options, providers=[(name, settings)])
    if session.get_providers()[0] != name:
        raise ProviderMissing(
            f"provider={provider}: onnxruntime fell back to {session.get_providers()[0]}: check its drivers"
        )
    names = [o.name for o in session.get_outputs()]
    wants_geometry = bool(model.contract.get("geometry_input"))
    dense = model.contract["head"] == "dense"

    def run(rgb: np.ndarray, geometry: np.ndarray) -> dict[str, np.ndarray]:
        feed = {"image": contracts.normalise(rgb, model.contract)}
        if wants_geometry:
            feed["geometry"] = geometry
        outputs = dict(zip(names, session.run(names, feed), strict=True))
        return {name: at_pixels(name, value[0], len(rgb)) for name, value in outputs.items()} if dense else outputs

    def looking(geometry: np.ndarray) -> Network:
        geometry = told(model, geometry)
        if not dense:
            return lambda rgb: run(rgb, geometry)
        views = shown(model.contract, geometry)[:looks]

        def network(rgb: np.ndarray) -> dict[str, np.ndarray]:
            total: dict[str, np.ndarray] = {}
            for flip in views:
                for name, value in flip.back(run(flip.image(rgb), flip.geometry(geometry))).items():
                    total[name] = total[name] + value if name in total else value
            return {name: value / np.float32(len(views)) for name, value in total.items()} if len(views) > 1 else total

        return network

    return looking


def available(provider: str) -> None:
    """Refuse what this onnxruntime was not made with. Raises `ProviderMissing`."""
    if provider == "cpu":
        return
    import onnxruntime as ort

    name, package, _ = PROVIDERS[provider]
    if name not in ort.get_available_providers():
        raise ProviderMissing(
            f"provider={provider}: this onnxruntime has {', '.join(ort.get_available_providers())}: install {package} in its "
            "place, or set provider=cpu"
        )


def told(model: contracts.Model, geometry: np.ndarray) -> np.ndarray:
    """What a model is told of a geometry (1, 6): what is kept from it (`untold`) is unknown."""
    geometry = geometry.copy()
    for direction in contracts.untold(model):
        geometry[:, TOLD[direction]] = 0
    return geometry


def at_pixels(name: str, maps: np.ndarray, side: int) -> np.ndarray:
    """Maps (C, s/k, s/k) of a tile of `side` px; those of `FULL` at every pixel (C, s, s), bilinear. Raises `ContractMismatch`
    where they are no whole part of the tile."""
    rows, cols = maps.shape[1:]
    if rows != cols or not rows or side % rows:
        raise contracts.ContractMismatch(
            f"output {name} is {cols} x {rows} for a tile of {side} px: it must be square, its side a whole part of the tile's"
        )
    if rows == side or name not in FULL:
        return maps
    import cv2

    return np.stack([cv2.resize(channel, (side, side), interpolation=cv2.INTER_LINEAR) for channel in maps])


class Flip(NamedTuple):
    """One of the eight symmetries of a square tile: transposed, then mirrored in columns, then in rows."""

    transpose: bool
    columns: bool
    rows: bool

    def image(self, rgb: np.ndarray) -> np.ndarray:
        """The image (s, s, 3) seen so."""
        rgb = rgb.transpose(1, 0, 2) if self.transpose else rgb
        return rgb[:: -1 if self.rows else 1, :: -1 if self.columns else 1]

    def geometry(self, vector: np.ndarray) -> np.ndarray:
        """The geometry input (1, 6) of the image seen so: its displacements (col, row) turn with the image."""
        vector = vector.copy()
        if self.transpose:
            vector[0, :4] = vector[0, [1, 0, 3, 2]]
        vector[0, [0, 2]] *= -1 if self.columns else 1
        vector[0, [1, 3]] *= -1 if self.rows else 1
        return vector

    def mirrored(self) -> Flip:
        """The same with left and right of what is seen exchanged."""
        return self._replace(columns=not self.columns)

    def back(self, maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Maps (C, s, s) of the flipped image as maps of the image itself; those of `DIRECTED` (col, row) turn with it."""
        out = {}
        for name, value in maps.items():
            value = value[:, :: -1 if self.rows else 1, :: -1 if self.columns else 1]
            if name in DIRECTED:
                value = value * np.array([-1 if self.columns else 1, -1 if self.rows else 1], np.float32)[:, None, None]
            if self.transpose:
                value = value.transpose(0, 2, 1)
                value = value[::-1] if name in DIRECTED else value
            out[name] = np.ascontiguousarray(value)
        return out


FLIPS = [Flip(bool(i & 4), bool(i & 1), bool(i & 2)) for i in range(8)]


def leans_up(col: float, row: float) -> bool:
    """Whether a lean (px per metre) points up in the image, less left than up and not right: one octant of eight."""
    return bool(row <= 0 and 0 <= -col <= -row)


def upright(geometry: np.ndarray) -> Flip:
    """The symmetry in which roofs lean up (`leans_up`), so that a network need learn one octant of views, not eight.

    Where the view's lean is zero or unknown the tile stays as it is.
    """
    return next((flip for flip in FLIPS if leans_up(*flip.geometry(geometry)[0, :2])), FLIPS[0])


def leans(geometry: np.ndarray) -> bool:
    """Whether roofs lean visibly in an image of a geometry (6,)."""
    return bool(np.hypot(*geometry[:2]) >= LEANING)


def shown(contract: dict[str, Any], geometry: np.ndarray) -> list[Flip]:
    """The symmetric views in which a dense model sees a tile of a geometry (1, 6).

    As many as its `flips`; models that want tiles `upright` see, where roofs lean visibly, the one in which they lean up, and if
    they are `mirrored` that with left and right exchanged too.
    """
    first = upright(geometry) if contract.get("upright") else FLIPS[0]
    if contract.get("upright") and leans(geometry[0]):
        return [first, first.mirrored()] if contract.get("mirrored") else [first]
    return [first, *(flip for flip in FLIPS if flip != first)][: contract.get("flips", 1)]


def from_record(path: str | Path, task: str) -> contracts.Model:
    """The model named in a workflow's `models/{task}.json`, with the contract that was checked when it was written.

    A file that changed since is refused.
    """
    record = store.read_json(path)
    model = contracts.Model(Path(record["file"]), record["sha256"], record["contract"])
    if not model.path.is_file():
        raise contracts.NotAModel(f"{model.path} is gone: put it back, or run the same command with other models")
    if hashlib.sha256(model.path.read_bytes()).hexdigest() != model.sha256:
        raise contracts.ContractMismatch(f"{model.path} changed while the workflow ran: run the same command again")
    if model.contract["task"] not in (task, "both"):
        raise contracts.ContractMismatch(f"{path} is of a model of {model.contract['task']}, used here for {task}")
    return model
