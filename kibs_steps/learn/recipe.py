"""Recipe: what `snakemake train` does, from the config key `train` to the options of its programs; needs no torch.

`own` names scenes of the same configuration that have a raster, terrain and truth, or gives such data itself (keys as of a
scene, and `buildings`, `guess`, `annotated`; with `scene` only what differs from that one's); `scene` names the scene a model is
fine-tuned for: tiles are simulated at its angles (also those that `metadata` tell) and made to look like its raster.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

from kibs_steps.errors import KibsError
from kibs_steps.plan import BadConfig, folder_of, layered

DEFAULTS = {
    "name": "mine",
    "family": "dense",
    "networks": "shared",
    "data": None,
    "free": False,
    "own": [],
    "split": "blocks",
    "scene": None,
    "init": None,
    "minutes": 90,
    "steps": None,
    "gsd": None,
    "blur": None,
    "seed": 0,
    "tiles": 4000,
    "cities": [],
    "leave_out": [],
    "validation": 0,
    "joins": 120,
    "lifts": 300,
    "patience": 10,
    "shares": None,
    "thresholds": {},
    "device": "cpu",
}
PARTS = ("azimuth", "elevation")
ANGLES = tuple(f"{name}_{part}" for name in ("view", "sun") for part in PARTS)
OWN = ("raster", "dtm", "truth", "buildings", "guess", "annotated", "truth_frame", "truth_z", *ANGLES)
OWN += ("projection_height", "bands", "aoi")
ANNOTATIONS = ("truth", "buildings", "guess")
# network that is trained -> models made of it
SHARED = {"both": ("both", "sections", "corners")}
SEPARATE = {"sections": ("sections",), "corners": ("corners",)}
ALONE = {"sections": ("sections",)}
FAMILY_OF = {"dense": "dense", "instances": "maskrcnn"}  # of the head that a contract names


class Recipe(NamedTuple):
    """One `train`: the set's name, model by task -> network, models that are taken as they are by task, options of `learn.own` by
    data, of `learn.look` by scene, of `learn.training` by network, of `learn.export` by task, there of `learn.joins` too where
    basins are joined and of `learn.lifting` where sections are lifted; the weights that a network starts from, the model that
    the one of a task is like (no file or one), and the files of the cities that tiles show."""

    name: str
    network_of: dict[str, str]
    taken: dict[str, str]
    own: dict[str, dict[str, Any]]
    look: dict[str, dict[str, Any]]
    training: dict[str, list[str]]
    export: dict[str, list[str]]
    joins: dict[str, list[str]]
    lifts: dict[str, list[str]]
    starts: dict[str, list[str]]
    like: dict[str, list[str]]
    cities: list[str]

    def files(self, own: str) -> list[str]:
        """The files of one own data set that are there."""
        given = self.own[own]
        return _files([given.get(key) for key in ("raster", "dtm", *ANNOTATIONS, "annotated", "aoi")])

    def seen(self, scene: str) -> list[str]:
        """The files that tell how a scene looks."""
        return _files([self.look[scene].get(key) for key in ("raster", "aoi")])


def _files(named: list[Any]) -> list[str]:
    """Of inputs those that are files or folders that are there."""
    return [str(f) for f in named if f is not None and Path(str(f)).exists()]


def recipe(config: dict[str, Any], base: Path, told: Collection[str] = ()) -> Recipe:
    """The recipe of a checked configuration; `base` is the workflow's folder, keys `told` on the command line stand above those
    of scenes. Raises `BadConfig`."""
    train = {**DEFAULTS, **(config.get("train") or {})}
    common = {k: v for k, v in config.items() if k in (*OWN, "metadata", "regions")}
    scenes = {str(name): own for name, own in (config.get("scenes") or {}).items()}

    def layers_of(name: str, wanted_by: str) -> list[dict[str, Any]]:
        if name not in scenes and name != str(config.get("scene")):
            raise BadConfig(f"train.{wanted_by}: there is no scene {name!r} in the configuration")
        # What the command line says of one scene is not meant for another.
        meant = config.get("scene") in (None, "") or name == str(config["scene"])
        last = {k: v for k, v in common.items() if meant and k in told}
        return [common, scenes.get(name) or {}, last]

    own: dict[str, dict[str, Any]] = {}
    for i, item in enumerate(train["own"]):
        item = {"scene": item} if isinstance(item, str) else item
        before = layers_of(item["scene"], "own") if "scene" in item else [common]
        given = layered(*before, item)
        name = str(item.get("name", item.get("scene", f"own{i}")))
        if "truth" not in item and ("buildings" in item or "guess" in item):
            given.pop("truth", None)
        chosen = {k: given[k] for k in OWN if given.get(k) is not None}
        if "guess" in chosen:
            chosen["guess"] = str(guessing(chosen["guess"], base))
        if given.get("regions"):
            raise BadConfig(
                f"train.own: {name} has regions: one view is learned from. Give each region its own aoi and angles"
            )
        for key in ("raster", "dtm"):
            if key not in chosen:
                raise BadConfig(f"train.own: {name} has no {key}")
        if sum(key in chosen for key in ANNOTATIONS) != 1:
            raise BadConfig(
                f"train.own: {name} needs one of truth (roof sections), buildings (outlines) and guess (a model set)"
            )
        if "guess" in chosen and "annotated" in chosen:
            raise BadConfig(f"train.own: {name} has annotated, but of what a model guesses nothing is: leave one out")
        if name in own:
            raise BadConfig(f"train.own: two data sets are called {name}: give one another name")
        own[name] = chosen
    teachers = [train["init"], *(item.get("guess") for item in train["own"] if not isinstance(item, str))]
    if any(_same_set(teacher, str(train["name"]), base) for teacher in teachers if teacher):
        raise BadConfig(f"train: the set {train['name']} cannot be made from itself: give what is trained another name")
    if train["blur"] and train["family"] != "dense":
        raise BadConfig("train.blur: networks of family maskrcnn see the image as it is: leave it out")
    if not own and not train["data"] and not train["tiles"]:
        raise BadConfig("train: nothing to learn from: give own, data or tiles")
    cities = list(map(str, train["cities"]))
    if lost := [city for city in cities if not Path(city).is_file()]:
        raise BadConfig(f"train.cities: {lost[0]} is not there: name a CityJSON file")

    options = [f"--{key}={train[key]}" for key in ("minutes", "seed", "tiles", "validation", "patience", "device")]
    options += [f"--family={train['family']}"]
    options += [f"--{key}={train[key]}" for key in ("data", "steps", "gsd", "blur") if train[key] is not None]
    options += ["--free"] if train["free"] else []
    for key in ("cities", "leave_out"):
        if train[key]:
            options += [f"--{key.replace('_', '-')}", *map(str, train[key])]
    if train["shares"]:
        options.append("--shares=" + ",".join(f"{k}={v}" for k, v in train["shares"].items()))
    look, untold = {}, []
    if train["scene"]:
        scene = layered(*layers_of(train["scene"], "scene"))
        if scene.get("regions"):
            raise BadConfig(
                f"train.scene: {train['scene']} has regions: name a scene of one view, with its own aoi and angles"
            )
        for name in ("view", "sun"):
            if sum(scene.get(f"{name}_{a}") is not None for a in PARTS) == 1:
                raise BadConfig(f"train.scene: {train['scene']}: give {name}_azimuth and {name}_elevation, or neither")
        if scene.get("raster") is not None:
            look[train["scene"]] = {k: scene[k] for k in ("raster", "bands", "aoi") if scene.get(k) is not None}
        elif scene.get("view_azimuth") is None:
            raise BadConfig(f"train.scene: {train['scene']} has no raster to look like, and no view to simulate for")
        told = [name for name in ("view", "sun") if all(scene.get(f"{name}_{a}") is not None for a in PARTS)]
        untold = [name for name in ("view", "sun") if name not in told]
        options += [f"--{name}-{a}={scene[f'{name}_{a}']}" for name in told for a in PARTS]
        options += ["--untold", *untold] if untold else []
    exports = {"shared": SHARED, "separate": SEPARATE, "sections": ALONE}[train["networks"]]
    exports = SEPARATE if train["family"] == "maskrcnn" and exports is SHARED else exports
    taken = {"corners": str(taking(train["init"], "corners", train["gsd"], base))} if exports is ALONE else {}
    training, starts = {}, {}
    for network in exports:
        starts[network] = [str(weights(train["init"], network, base))] if train["init"] else []
        training[network] = [*options, f"--task={network}"]
    network_of = {task: network for network, tasks in exports.items() for task in tasks}
    models = {task: like_model(train["init"], task, base) if train["init"] else None for task in network_of}
    like = {task: [str(path)] if path else [] for task, path in models.items()}
    thresholds = [f"--thresholds={json.dumps(train['thresholds'])}"] if train["thresholds"] else []
    export = {task: thresholds if task != "corners" else [] for task in network_of}
    shown = [f"--scenes={train['joins']}"]
    if "prominence" in train["thresholds"]:
        shown.append(f"--prominence={train['thresholds']['prominence']}")
    shown += [f"--data={train['data']}"] if train["data"] and not train["free"] else []
    for key in ("cities", "leave_out"):
        shown += [f"--{key.replace('_', '-')}", *map(str, train[key])] if train[key] else []
    shown += ["--untold", *untold] if untold else []
    dense = train["family"] == "dense"
    joins = {task: shown if task != "corners" and dense and train["joins"] else [] for task in network_of}
    lifting = [f"--tiles={train['lifts']}", *(["--cities", *map(str, train["cities"])] if train["cities"] else [])]
    lifting += ["--untold", *untold] if untold else []
    seen = dense and train["lifts"] and "view" not in untold  # from an unknown view nobody knows where walls are shown
    lifts = {task: lifting if task == "corners" and seen else [] for task in network_of}
    return Recipe(
        str(train["name"]), network_of, taken, own, look, training, export, joins, lifts, starts, like, cities
    )


def of_run(config: dict[str, Any], base: Path, told: Collection[str], words: Collection[str]) -> Recipe:
    """The recipe in a run that is asked for by the `words` of a command line: what is wrong in it stops those alone that want
    what it makes. Raises `BadConfig` in these."""
    asked = any(word == "train" or word.startswith(("runs/", "models/")) for word in words)
    try:
        found = recipe(config, base, told)
        if asked:
            _to_be_made(found, str((config.get("train") or {}).get("family", DEFAULTS["family"])), base)
    except KibsError:
        if asked:
            raise
        return recipe({}, base)
    return found


def _to_be_made(found: Recipe, family: str, base: Path) -> None:
    """Raise `BadConfig` where a set of that name is there that no run here has made and that would be written over, or where a
    model that the training starts from, or keeps, is of another family."""
    for folder in {(base / "models" / found.name).resolve(), (Path("models") / found.name).resolve()}:
        if any(folder.glob("*.onnx")) and not (Path("runs") / found.name).is_dir():
            raise BadConfig(
                f"train.name: {folder} holds a model set that was not trained here: give what is trained another name"
            )
    from kibs_steps.models import contract

    for path in sorted({*(file for files in found.like.values() for file in files), *found.taken.values()}):
        own = FAMILY_OF[contract.load(path).contract["head"]]
        if own != family:
            raise BadConfig(
                f"train: {path} is of family {own}, what is trained of {family}: name a set of that family in `init`, or "
                "train both networks without (networks: separate)"
            )


def own_options(given: dict[str, Any], split: str, seed: int, gsd: float | None = None) -> list[str]:
    """The options of `learn.own` for one data set, its tiles at `gsd` (None: as usual)."""
    listed = dict(given)
    if "truth" not in listed:
        listed = {k: v for k, v in listed.items() if not k.startswith("truth")}
    return [*_options(listed, gsd), f"--split={split}", f"--seed={seed}"]


def look_options(given: dict[str, Any], seed: int, gsd: float | None = None) -> list[str]:
    """The options of `learn.look` for one scene, its windows at `gsd` (None: as usual)."""
    return [*_options(given, gsd), f"--seed={seed}"]


def _options(given: dict[str, Any], gsd: float | None) -> list[str]:
    listed = {k: ",".join(map(str, v)) if isinstance(v, list) else v for k, v in given.items()}
    return [f"--{k.replace('_', '-')}={v}" for k, v in listed.items()] + ([f"--gsd={gsd}"] if gsd else [])


def like_model(init: str, task: str, base: Path) -> Path | None:
    """The model beside the weights that a training starts from, whose thresholds and licence hold on; None if there is none."""
    folder = Path(init).parent if Path(init).is_file() else folder_of(init, base)
    path = folder / f"{task}.onnx"
    return path if path.is_file() else None


def _same_set(teacher: str, name: str, base: Path) -> bool:
    """Whether a set, or a model in it, is the one to be made."""
    folder = Path(teacher).parent if Path(teacher).is_file() else folder_of(teacher, base)
    return teacher == name or folder.resolve() == (Path("models") / name).resolve()


def taking(init: str | None, task: str, gsd: float | None, base: Path) -> Path:
    """The model of another task that a set which is trained in part keeps from the one it started from, at its GSD (None: the
    usual one). Raises `BadConfig`."""
    path = like_model(init, task, base) if init else None
    if path is None:
        raise BadConfig(
            f"train: networks: sections keeps the {task} of the set that `init` names: {init or 'it'} has no {task}.onnx; name "
            "one that has, or train both (networks: separate)"
        )
    from kibs_steps.learn.dataset import GSD
    from kibs_steps.models import contract

    own = contract.load(path, task).contract["gsd"]
    if own != (gsd or GSD):
        raise BadConfig(
            f"train: {path} is for {own:g} m per px, the sections are to be for {gsd or GSD:g}: name a set for that in `init` "
            "(research/gsd-0.25), or another gsd"
        )
    return path


def guessing(models: str, base: Path) -> Path:
    """The model of a set, or a file, whose guesses are learned. Raises `BadConfig` where there is none."""
    path = Path(models) if Path(models).is_file() else folder_of(models, base) / "sections.onnx"
    if not path.is_file():
        raise BadConfig(f"train.own: guess: {models} is no file, and there is no {path}")
    return path


def weights(init: str, network: str, base: Path) -> Path:
    """The weights to start from: a file, or of a model set its `NETWORK.pt`, `weights.pt` or only `.pt` file, or what the run
    that made it here has learned."""
    if Path(init).is_file():
        return Path(init)
    folder = folder_of(init, base)
    named = [folder / f"{network}.pt", folder / "weights.pt"]
    found = [f for f in named if f.is_file()] or sorted(folder.glob("*.pt"))
    run = Path("runs") / folder.name / network
    if not found and (run / "done.json").is_file():
        return run / "checkpoint.pt"
    if not found or (len(found) > 1 and found[0] not in named):
        apart = "" if network != "both" else " (a set with sections.pt and corners.pt needs networks: separate)"
        raise BadConfig(f"train.init: {init} is no file, and {folder} holds no {network}.pt or weights.pt{apart}")
    return found[0]
