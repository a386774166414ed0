"""A suite: several model sets in one folder, made for several GSDs and angles, of which each scene takes the one that fits.

A **set** is the files a method needs: `sections.onnx` and `corners.onnx`, or `both.onnx`. Several sets in a folder have a common
ending per set (`both-025.onnx`, `both-038.onnx`) or a subfolder each. In: a folder, a method's tasks, what the scene is like.
Out: one set.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kibs_steps.models import contract as contracts
from kibs_steps.models.contract import Model

SAME_GSD = 0.005  # of the GSD: less is no difference

Set = dict[str, Model]


def sets(folder: Path, tasks: tuple[str, ...]) -> list[Set]:
    """All sets of a folder and its subfolders, in order of their paths; models are loaded and agree within their set.

    Raises what `contract.load` and `contract.agree` raise, and `NotAModel` where there is no set.
    """
    found = []
    for place in (folder, *sorted(p for p in folder.glob("[!.]*") if p.is_dir())):
        for path in sorted(place.glob(f"{tasks[0]}*.onnx")):
            ending = path.name.removeprefix(tasks[0])
            files = {task: place / f"{task}{ending}" for task in tasks}
            if all(file.is_file() for file in files.values()):
                found.append({task: contracts.load(file, task) for task, file in files.items()})
    for one in found:
        contracts.agree(list(one.values()))
    if not found:
        wanted = " and ".join(f"{task}.onnx" for task in tasks)
        raise contracts.NotAModel(
            f"no model at {folder}: give `models=` a folder with {wanted}"
            + (", or set `method=single`: a both.onnx is there" if len(tasks) > 1 and _holds(folder, "both") else "")
            + (
                ", or set `method=two_stage`: that is what is there"
                if len(tasks) == 1 and _holds(folder, "corners")
                else ""
            )
        )
    return found


def _holds(folder: Path, task: str) -> bool:
    return any(folder.glob(f"{task}*.onnx")) or any(folder.glob(f"[!.]*/{task}*.onnx"))


def choose(found: list[Set], gsd: float | None, view: dict[str, float] | None, sun: dict[str, float] | None) -> Set:
    """The set for a scene of `gsd` (m/px; None unknown) seen and lit from `view` and `sun` (azimuth, elevation deg, or None).

    The set whose models were trained nearest to the scene's angles, all that cover them being equally near; then the nearest
    GSD that is not finer than the raster (else the coarsest); then the set that is told what is known of the scene and kept from
    what is not, the view counting first; then the set of the narrowest range of views, the widest where the view is unknown;
    then by path.
    """
    known = {"view": view is not None, "sun": sun is not None}

    def rank(one: Set) -> tuple:
        off = max(outside(model.contract["trained_on"], view, sun) for model in one.values())
        own = next(iter(one.values())).contract["gsd"]
        finer = gsd is not None and own < gsd * (1 - SAME_GSD)
        untold = {name for model in one.values() for name in contracts.untold(model)}
        unlike = [known[name] == (name in untold) for name in known]
        width = min(_view_range(model.contract["trained_on"]) for model in one.values())
        special = width if view is not None else -width  # an unknown view may be any
        return round(off, 6), finer, -own if finer else own, unlike, special, str(next(iter(one.values())).path)

    return min(found, key=rank)


def outside(trained: dict[str, Any], view: dict[str, float] | None, sun: dict[str, float] | None) -> float:
    """How far (deg) the scene's angles lie outside `trained_on`, the farthest of them; 0 where nothing is known."""
    found = [0.0]
    for name, direction in (("view", view), ("sun", sun)):
        for angle in ("azimuth", "elevation"):
            allowed = trained.get(f"{name}_{angle}")
            if direction is not None and allowed is not None:
                found.append(contracts.beyond(direction[angle], allowed, circular=angle == "azimuth"))
    return max(found)


def _view_range(trained: dict[str, Any]) -> float:
    """Elevations times azimuths (deg²) that a model was trained on: less is more special."""
    low, high = trained.get("view_elevation", (0.0, 90.0))
    first, last = trained.get("view_azimuth", (0.0, 360.0))
    return (high - low) * min((last - first) % 360 or (360.0 if last != first else 0.0), 360.0)
