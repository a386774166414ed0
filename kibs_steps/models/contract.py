"""The contract a model carries: all that is needed to run it, in the ONNX file itself.

`metadata_props["kibs"]` holds JSON after `contract.schema.json`; a file without it may have a sidecar of the same name with
the suffix `.json`. In: an ONNX file. Out (as a step): `models/{task}.json`, the contract with the file's name and sha256, so
that what depends on a model reruns when its content changes and not otherwise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kibs_steps import cli, store
from kibs_steps.errors import KibsError
from kibs_steps.models import joining, perceptron, scoring, walls

KEY = "kibs"
LARGEST = 2**31 - 1  # bytes: protobuf reads no more
WARN_BEYOND, REFUSE_BEYOND = (
    3.0,
    5.0,
)  # deg outside trained_on: 3° lower is +12 % of height, 5° is +21 % (PAPER, geometry)


class NotAModel(KibsError):
    """The file is not a readable ONNX model."""


class NoContract(KibsError):
    """The model has no contract, neither inside nor beside it."""


class ExternalData(KibsError):
    """A model that keeps weights in other files."""


class ModelTooLarge(KibsError):
    """A model file that is larger than an ONNX file can be."""


class ContractMismatch(KibsError):
    """The contract breaks the schema, or does not fit its use."""


class AngleOutsideTraining(KibsError):
    """The scene is seen or lit from where the model has never been."""


class Model(NamedTuple):
    """A model file and what it promises."""

    path: Path
    sha256: str
    contract: dict[str, Any]

    @property
    def licence_line(self) -> str:
        """What a user should know before using the model's results."""
        return f"{self.path}: licence {self.contract['trained_on']['licence']}"


def validate(contract: Any, source: str) -> dict[str, Any]:
    """Return the contract if it fits the schema; otherwise raise `ContractMismatch` naming the field."""
    import jsonschema

    schema = json.loads(resources.files(__package__).joinpath("contract.schema.json").read_text())
    error = jsonschema.exceptions.best_match(jsonschema.Draft202012Validator(schema).iter_errors(contract))
    if error:
        place = ".".join(map(str, error.absolute_path)) or "the contract"
        raise ContractMismatch(f"{source}: {place}: {error.message}. Export the model again, or correct its contract")
    if contract["margin"] * 2 >= contract["tile"]:
        raise ContractMismatch(
            f"{source}: margin {contract['margin']} px leaves nothing of a {contract['tile']} px tile"
        )
    if contract["task"] in ("corners", "both") and "heights" not in contract:
        raise ContractMismatch(f"{source}: a model of corners must say its `heights` bins")
    if contract["task"] == "corners" and "blend" not in contract:
        raise ContractMismatch(f"{source}: a model of corners must say what `blend` it was trained on")
    for name, traits in (("join", joining.TRAITS), ("score", scoring.TRAITS)):
        if name in contract and not perceptron.leads(contract[name], len(traits)):
            raise ContractMismatch(
                f"{source}: {name}: its layers do not lead from {len(traits)} traits to one number. Make it anew with "
                "kibs_steps.learn.joins"
            )
    if "walls" in contract and not walls.leads(contract["walls"]):
        raise ContractMismatch(
            f"{source}: walls: its layers do not lead from {walls.TRAITS} traits to one number. Make it anew with "
            "kibs_steps.learn.lifting"
        )
    lacking = [name for name in thresholds_asked(contract) if name not in contract["thresholds"]]
    if lacking:
        raise ContractMismatch(f"{source}: thresholds: {', '.join(lacking)} is not said: decoding needs it")
    heights = contract.get("heights")
    if heights and len(heights["edges"]) != len(heights["centres"]) + 1:
        raise ContractMismatch(f"{source}: heights: {len(heights['centres'])} centres need one edge more")
    return contract


def thresholds_asked(contract: dict[str, Any]) -> list[str]:
    """The thresholds without which a model's outputs cannot be decoded (`models.heads`)."""
    if contract["head"] == "instances":
        return ["score", *(["min_area"] if contract["task"] != "corners" else [])]
    asked = {"sections": ["roof", "min_area"], "corners": ["corner"], "both": ["roof", "min_area", "corner"]}
    return asked[contract["task"]]


def load(path: str | Path, task: str | None = None) -> Model:
    """Read and check the contract of an ONNX file; `task` (sections, corners) must be among what the model does.

    Raises `NotAModel`, `NoContract`, `ContractMismatch`.
    """
    import onnx

    path = Path(path)
    if not path.is_file():
        raise NotAModel(f"no model at {path}: give `models=` a folder with sections.onnx and corners.onnx")
    size = path.stat().st_size
    if size > LARGEST:
        raise ModelTooLarge(f"{path} has {size / 2**30:.1f} GiB, an ONNX file at most 2: give a smaller model")
    data = path.read_bytes()
    try:
        proto = onnx.load_model_from_string(data)
        found = {p.key: p.value for p in proto.metadata_props}
        if not proto.graph.output:
            raise ValueError("no graph")
    except Exception as error:  # protobuf raises its own kinds, by version
        raise NotAModel(f"{path} is not an ONNX model ({type(error).__name__})") from error
    elsewhere = next(_external(proto.graph), None)
    if elsewhere is not None:
        raise ExternalData(
            f"{path} keeps weights outside itself, in {elsewhere}: save it as one file (onnx.save_model of the loaded model with "
            "save_as_external_data=False), so that its checksum stands for all of it"
        )
    sidecar = path.with_suffix(".json")
    try:
        if KEY in found:
            contract = json.loads(found[KEY])
        elif sidecar.is_file():
            contract = json.loads(sidecar.read_text(encoding="utf-8"))
        else:
            raise NoContract(
                f"{path} carries no contract: store it in metadata_props[{KEY!r}] or beside the model as {sidecar.name} "
                "(docs/architecture.md, Models)"
            )
    except json.JSONDecodeError as error:
        raise ContractMismatch(f"{path}: the contract is not JSON ({error})") from error
    validate(contract, str(path))
    if "walls" in contract and "surface" not in (output.name for output in proto.graph.output):
        raise ContractMismatch(
            f"{path}: its contract has `walls`, which need its output `surface`: export it again with that"
        )
    if task and contract["task"] not in (task, "both"):
        raise ContractMismatch(f"{path} is a model of {contract['task']}, used here for {task}: swap the files?")
    return Model(path, hashlib.sha256(data).hexdigest(), contract)


def write(path: str | Path, contract: dict[str, Any]) -> None:
    """Give the model in an ONNX file another contract. Raises `ContractMismatch` for one that is none."""
    import onnx

    proto = onnx.load(str(path))
    onnx.helper.set_model_props(proto, {KEY: json.dumps(validate(contract, str(path)))})
    with store.whole(path, summed=False) as temporary:
        onnx.save(proto, str(temporary))


def _external(graph: Any) -> Iterator[str]:
    """Names of the files in which a graph, or one inside it, keeps tensors."""
    from onnx.external_data_helper import uses_external_data

    tensors = list(graph.initializer)
    for node in graph.node:
        for attribute in node.attribute:
            tensors += [attribute.t, *attribute.tensors]
            for inner in (attribute.g, *attribute.graphs):
                yield from _external(inner)
    for tensor in tensors:
        if uses_external_data(tensor):
            yield next((entry.value for entry in tensor.external_data if entry.key == "location"), "?")


def agree(models: list[Model]) -> None:
    """All models of a run work on one grid: refuse others."""
    for field in ("gsd", "tile", "margin"):
        values = {m.contract[field] for m in models}
        if len(values) > 1:
            files = ", ".join(f"{m.path.name}: {m.contract[field]}" for m in models)
            raise ContractMismatch(f"the models disagree on {field} ({files}): take two that were made together")


def untold(model: Model) -> list[str]:
    """The directions (`view`, `sun`) that are kept from a model: it is for images of which they are not known."""
    return model.contract["trained_on"].get("untold", [])


def beyond(value: float, allowed: list[float], circular: bool = False) -> float:
    """How far (deg) a value lies outside a range; azimuths wrap around (a range from 350 to 10 spans north)."""
    low, high = allowed
    if not circular:
        return max(low - value, value - high, 0.0)
    if high - low >= 360 or (value - low) % 360 <= (high - low) % 360:
        return 0.0
    return min((low - value) % 360, (value - high) % 360)


def check_angles(model: Model, view: dict | None, sun: dict | None, allow: bool = False) -> list[str]:
    """Warnings for angles outside the model's `trained_on`; beyond 5° raises `AngleOutsideTraining` unless allowed.

    Unknown angles (None) only warn: the network is told, and nothing is moved.
    """
    warnings = []
    trained = model.contract["trained_on"]
    for name, direction in (("view", view), ("sun", sun)):
        if direction is None:
            if name == "view":
                warnings.append(
                    "view angles unknown: roofs are not moved to where they stand, heights are less certain"
                )
            continue
        for angle in ("azimuth", "elevation"):
            allowed = trained.get(f"{name}_{angle}")
            if allowed is None:
                continue
            off = beyond(direction[angle], allowed, circular=angle == "azimuth")
            text = (
                f"{model.path}: {name} {angle} {direction[angle]:g}° is {off:.1f}° outside what it was trained on "
                f"({allowed[0]:g}-{allowed[1]:g}°)"
            )
            if off > REFUSE_BEYOND and not allow:
                less = ", leave out sun_azimuth and sun_elevation" if name == "sun" else ""
                raise AngleOutsideTraining(f"{text}: choose another model{less}, or set `allow_angles: true`")
            if off > WARN_BEYOND:
                warnings.append(text)
    return warnings


def normalise(rgb: np.ndarray, contract: dict[str, Any]) -> np.ndarray:
    """Network input (1, 3, s, s) float32 of an image (s, s, 3) uint8, after the contract's channel order, scale, mean, std."""
    spec = contract["input"]
    if spec["channels"] == "BGR":
        rgb = rgb[..., ::-1]
    x = (rgb.astype(np.float32) * np.float32(spec["scale"]) - np.float32(spec["mean"])) / np.float32(spec["std"])
    return np.ascontiguousarray(x.transpose(2, 0, 1)[None])


def main(argv: list[str] | None = None) -> None:
    """Print a model's contract, or write it with the file's hash for a workflow."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.models.contract", description=main.__doc__)
    parser.add_argument("model", help="ONNX file")
    parser.add_argument("--task", choices=["sections", "corners"], help="refuse a model that does not do this")
    parser.add_argument("--out", help="write JSON here instead of printing it")
    args = parser.parse_args(argv)
    model = load(args.model, args.task)
    content = {"file": str(model.path), "sha256": model.sha256, "contract": model.contract}
    if args.out:
        store.write_json(args.out, content)
    else:
        print(json.dumps(content, indent=2))


if __name__ == "__main__":
    cli.run(main)
