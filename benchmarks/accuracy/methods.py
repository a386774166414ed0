"""Methods: the model sets that are compared, each a folder.

`both.onnx` is run as method `single`; `sections.onnx` with `corners.onnx` as `two_stage`, and where they are Mask R-CNNs in the
paper's mode. Sets of the same GSD in subfolders, made for other angles, belong to the folder's method too, as in the workflow.
Out: a `Method` per folder and set of files, with what its contracts say of its training.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from kibs_steps.errors import KibsError
from kibs_steps.models import contract as contracts
from kibs_steps.models import suite


class NoModels(KibsError):
    """A folder without model sets."""


class Method(NamedTuple):
    """A name, the workflow's settings, and the sets of models of one GSD that scenes choose from, the folder's own first."""

    name: str
    settings: dict[str, Any]
    sets: list[suite.Set]

    @property
    def contract(self) -> dict[str, Any]:
        """The contract of the model for sections of the folder's own set."""
        return next(iter(self.sets[0].values())).contract

    def models(self, view: dict[str, float] | None) -> tuple[contracts.Model, contracts.Model]:
        """The models for sections and corners (one, twice, if it does both) of scenes seen from `view` (deg; None unknown)."""
        chosen = list(suite.choose(self.sets, self.contract["gsd"], view, None).values())
        return chosen[0], chosen[-1]

    @property
    def signature(self) -> list[str]:
        """What its results depend on."""
        return [
            *sorted(model.sha256 for one in self.sets for model in one.values()),
            str(sorted(self.settings.items())),
        ]

    @property
    def training(self) -> dict[str, Any]:
        """How it was trained, as far as the contracts say: initial weights, tiles seen, minutes, whether it had converged."""
        told = [model.contract["trained_on"] for one in self.sets for model in one.values()]

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
    """The methods of a folder of model sets (or of one set), by name; a set that belongs to one is none of its own.

    Raises `NoModels`.
    """
    found: list[Method] = []
    for place in [folder, *sorted(p for p in folder.iterdir() if p.is_dir())] if folder.is_dir() else []:
        if (place / "both.onnx").is_file():
            settings = {"models": str(place.resolve()), "method": "single"}
            found.append(Method(f"{place.name} single", settings, of_one_gsd(place, ("both",))))
        if all((place / f"{task}.onnx").is_file() for task in ("sections", "corners")):
            sets = of_one_gsd(place, ("sections", "corners"))
            papers = sets[0]["sections"].contract["head"] == "instances"
            settings = {"models": str(place.resolve()), "method": "two_stage", "mode": "paper" if papers else "default"}
            found.append(Method(f"{place.name} {'paper pair' if papers else 'two-stage'}", settings, sets))
    belong = {next(iter(one.values())).path for method in found for one in method.sets[1:]}
    found = [method for method in found if next(iter(method.sets[0].values())).path not in belong]
    if not found:
        raise NoModels(
            f"{folder} holds no model set: both.onnx, or sections.onnx and corners.onnx, in it or a subfolder"
        )
    return found


def of_one_gsd(place: Path, tasks: tuple[str, ...]) -> list[suite.Set]:
    """The set of a folder itself, then those beside it and in its subfolders that are of the same GSD."""
    found = suite.sets(place, tasks)
    own = next(one for one in found if one[tasks[0]].path == place / f"{tasks[0]}.onnx")
    gsd = own[tasks[0]].contract["gsd"]
    return [own, *(one for one in found if one is not own and one[tasks[0]].contract["gsd"] == gsd)]
