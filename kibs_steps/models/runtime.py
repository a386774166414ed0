"""Running a model: one onnxruntime session, the same answer on every machine's core count.

Threads are an argument, never derived from the machine, because sums in another order differ in their last bits.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from kibs_steps import store
from kibs_steps.models import contract as contracts

Network = Callable[[np.ndarray], dict[str, np.ndarray]]  # image (s, s, 3) uint8 -> named maps, batch axis dropped


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


def open_network(model: contracts.Model, geometry: np.ndarray, threads: int = 1) -> Network:
    """A function from an image (s, s, 3) uint8 to the model's named outputs without their batch axis.

    `geometry` (1, 6) goes to models whose contract asks for it. CPU provider; `threads` intra-op threads.
    """
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    session = ort.InferenceSession(model.path.read_bytes(), options, providers=["CPUExecutionProvider"])
    names = [o.name for o in session.get_outputs()]
    wants_geometry = bool(model.contract.get("geometry_input"))
    dense = model.contract["head"] == "dense"

    def network(rgb: np.ndarray) -> dict[str, np.ndarray]:
        feed = {"image": contracts.normalise(rgb, model.contract)}
        if wants_geometry:
            feed["geometry"] = geometry
        outputs = session.run(names, feed)
        return {name: (value[0] if dense else value) for name, value in zip(names, outputs, strict=True)}

    return network


def from_record(path: str | Path, task: str) -> contracts.Model:
    """The model named in a workflow's `models/{task}.json`; a file that changed since is refused."""
    record = store.read_json(path)
    model = contracts.load(record["file"], task)
    if model.sha256 != record["sha256"]:
        raise contracts.ContractMismatch(f"{model.path} changed while the workflow ran: run the same command again")
    return model
