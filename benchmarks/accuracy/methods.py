"""Methods: the model sets that are compared, each a folder.

`both.onnx` is run as method `single`; `sections.onnx` with `corners.onnx` as `two_stage`, and where they are Mask R-CNNs in the
paper's mode. Out: a `Method` per folder and set of files, with what its contracts say of its training.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from kibs_steps.errors import KibsError
from kibs_steps.models import contract as contracts


class NoModels(KibsError):
    """A folder without model sets."""


class Method(NamedTuple):
    """A name, the workflow's settings, and the models for sections and corners (one model twice if it does both)."""

    name: str
    settings: dict[str, Any]
    models: dict[str, contracts.Model]

    @property
    def signature(self) -> list[str]:
        """What its results depend on."""
        return [*sorted(model.sha256 for model in self.models.values()), str(sorted(self.settings.items()))]

    @property
    def training(self) -> dict[str, Any]:
        """How it was trained, as far as the contracts say: initial weights, tiles seen, minutes, whether it had converged."""
        told = [model.contract["trained_on"] for model in {m.sha256: m for m in self.models.values()}.values()]

        def joined(key: str) -> str:
            return ", ".join(dict.fromkeys(str(t.get(key, "not told")) for t in told))

        converged = [t.get("converged") for t in told]
        state = "not told" if None in converged else "converged" if all(converged) else "not converged"
        return {
            "init": joined("init"),
            "tiles_seen": joined("tiles_seen"),
            "minutes": joined("minutes"),
            "state": state,
        }


def of(folder: Path) -> list[Method]:
    """The methods of a folder of model sets (or of one set), by name. Raises `NoModels`."""
    found = []
    for place in [folder, *sorted(p for p in folder.iterdir() if p.is_dir())] if folder.is_dir() else []:
        if (place / "both.onnx").is_file():
            model = contracts.load(place / "both.onnx", "both")
            settings = {"models": str(place.resolve()), "method": "single"}
            found.append(Method(f"{place.name} single", settings, {"sections": model, "corners": model}))
        if all((place / f"{task}.onnx").is_file() for task in ("sections", "corners")):
            models = {task: contracts.load(place / f"{task}.onnx", task) for task in ("sections", "corners")}
            contracts.agree(list(models.values()))
            papers = models["sections"].contract["head"] == "instances"
            settings = {"models": str(place.resolve()), "method": "two_stage", "mode": "paper" if papers else "default"}
            found.append(Method(f"{place.name} {'paper pair' if papers else 'two-stage'}", settings, models))
    if not found:
        raise NoModels(
            f"{folder} holds no model set: both.onnx, or sections.onnx and corners.onnx, in it or a subfolder"
        )
    return found
