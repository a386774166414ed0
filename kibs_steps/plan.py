"""The plan of a run: from `config.yaml` to scenes, their grids, blocks and signatures, before any job starts.

A **signature** is a hash of all content a step's result depends on: input files, models, settings, the package's version. The
workflow gives it to every rule as a parameter, so Snakemake reruns exactly the steps whose content changed, whatever the
dates of files say and wherever an earlier run was killed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from kibs_steps import fingerprint, sources, tiled
from kibs_steps import settings as user_settings
from kibs_steps.grid import Block, Tiling
from kibs_steps.models import contract, suite
from kibs_steps.settings import BadConfig

RUN_KEYS = ("scene", "scenes", "train")
DETECTING = ("tiles", "sections", "blend", "corners", "single", "feed")
STANDING = ("planes", "ground")
BLOCK_STEPS = (*DETECTING, *STANDING, "solids")  # steps with a job per block, in the order of the data
DEFAULTS = {
    "models": "research",
    "method": "two_stage",
    "mode": "default",
    "planes": "robust",
    "block": 4,
    "feed": "models",
    "truth_frame": "map",
    "truth_z": "absolute",
    "allow_angles": False,
    "provider": "cpu",
    "threads": 1,
    "looks": 8,
    "lod_label": "2.0",
    "drape": False,
    "suppose": False,
}
SIMULATED = {"size": 1200, "gsd": 0.38, "style": "mixed", "relief": 0.0, "slope": 0.0, "crs": "EPSG:32631"}
AS_SIMULATED = {"truth_frame": "map", "truth_z": "absolute", "projection_height": None, "bands": None}
NAMED = ("truth", "sections", "regions", "footprints", "dsm", "aoi", "metadata")  # settings that are files
TASKS = {"two_stage": ("sections", "corners"), "single": ("both",)}
PAPER_MODE = {"planes": "paper"}  # besides the stride and the rule at seams
REACH = 7.5  # px: half the paper's corner square q = 15, unless the model's contract says otherwise
TOLERANCE = 1.5  # px: how far smoothing may move a pixel outline


class Plan(NamedTuple):
    """One scene: settings (defaults filled in), its files, grid size, tiles, blocks, models and signatures by step.

    `left_out` are the blocks the city is made without, each from a step on.
    """

    name: str
    settings: dict[str, Any]
    raster: str
    dtm: str
    truth: str | None
    tiling: Tiling
    blocks: list[Block]
    models: dict[str, contract.Model]
    signature: dict[str, str]
    warnings: list[str]
    left_out: dict[str, str]

    def having(self, step: str) -> list[Block]:
        """The blocks that are not left out at that step or before."""
        done = BLOCK_STEPS[: BLOCK_STEPS.index(step) + 1]
        return [b for b in self.blocks if self.left_out.get(b.name) not in done]

    @property
    def terrain_files(self) -> list[str]:
        """The terrain file, or nothing where the terrain is a number or remote."""
        try:
            float(self.dtm)
        except ValueError:
            return sources.files(self.dtm)
        return []

    @property
    def named_files(self) -> list[str]:
        """The files that settings name besides raster and terrain."""
        named = [str(self.settings[key]) for key in NAMED if self.settings.get(key)]
        return [path for path in named if Path(path).exists()]

    @property
    def remote(self) -> list[str]:
        """Raster and terrain that are read by URL."""
        return [path for path in (self.raster, self.dtm) if sources.is_remote(path)]

    def blocks_read(self, copy: str) -> str:
        """The raster that blocks read: `copy` (a path) where the raster's own layout is too slow."""
        return copy if self.settings.get("simulate") is None and tiled.needed(self.raster) else self.raster

    @property
    def supposes(self) -> bool:
        """Whether the networks are told directions that the image looks like."""
        return supposes(self.settings, self.models)

    @property
    def seam_rule(self) -> str:
        """Which pieces of neighbouring tiles are one section: `sections.links_across`."""
        return "touch" if self.settings["mode"] == "paper" else "overlap"

    @property
    def reach(self) -> float:
        """How far a corner may lie from its section, px."""
        return self.models["corners"].contract["thresholds"].get("corner_radius", REACH)

    @property
    def measured(self) -> bool:
        """Whether heights come from a surface model, so that the 3D model has nothing to do."""
        two = self.settings["feed"] == "models" and self.settings["method"] == "two_stage"
        return two and bool(self.settings.get("dsm"))

    @property
    def tolerance(self) -> float:
        """How far smoothing may move an outline, px; truth keeps its exact outlines."""
        return 0.0 if self.settings["feed"] == "truth" else TOLERANCE


def scenes(config: dict[str, Any], schema: dict[str, Any], told: Collection[str] = ()) -> dict[str, dict[str, Any]]:
    """Settings of every scene to build, by name, after the schema; defaults are filled in. Raises `BadConfig`.

    A scene's own keys stand above those for all scenes, and keys `told` on the command line above both.
    """
    config = user_settings.plain(config, schema)
    user_settings.check(config, schema)
    common = {k: v for k, v in config.items() if k not in RUN_KEYS}
    listed = {str(name): own for name, own in (config.get("scenes") or {}).items()}
    wanted = [str(config["scene"])] if config.get("scene") not in (None, "") else list(listed)
    if not wanted:
        raise BadConfig(
            "no scene to build: add one under `scenes:` in config.yaml, or give --config scene=NAME raster=FILE"
        )
    last = {k: v for k, v in common.items() if k in told}
    return {name: {**DEFAULTS, **layered(common, listed.get(name) or {}, last)} for name in wanted}


def plan(name: str, settings: dict[str, Any], base: Path, results: Path) -> Plan:
    """Plan one scene. `base` is the workflow's folder (for `models/NAME`), `results` where results go.

    Raises named errors for whatever makes the run impossible.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise BadConfig(f"scene name {name!r}: use letters, digits, '.', '_' and '-' only, it names a folder")
    settings = {**settings, **named(settings, results)}
    if settings["mode"] == "paper":
        settings = {**settings, **PAPER_MODE}
    models = models_for(settings, base)
    terms = models["sections"].contract
    # The paper's tiles overlap by p in all, ours by p on each side (PAPER, finding 6).
    margin = max(terms["margin"] // 2, 1) if settings["mode"] == "paper" else terms["margin"]
    tiling = Tiling(terms["tile"], margin, int(settings["block"]))
    cache = results / ".fingerprints.json"
    folder = results / name
    simulated = settings.get("simulate")
    if simulated is not None:
        for key in ("raster", "dtm", "truth"):
            if settings.get(key) is not None:
                raise BadConfig(
                    f"scene {name} is simulated and makes its own {key}: leave out {key}, or name another scene (scene=NAME)"
                )
        usual = {k: v for k, v in SIMULATED.items() if k != "crs" or not simulated.get("city")}  # a city has its own
        simulated = {**usual, **simulated}
        settings = {**settings, "simulate": simulated, **AS_SIMULATED}
        if settings.get("aoi"):
            raise BadConfig(f"scene {name}: a simulated scene is as large as simulate.size says: leave out aoi")
        for key in ("view_azimuth", "view_elevation", "sun_azimuth", "sun_elevation"):
            if key not in settings:
                raise BadConfig(f"scene {name}: a simulated scene needs {key}")
        raster, dtm, truth = (str(folder / "simulated" / f) for f in ("scene.tif", "dtm.tif", "truth.gpkg"))
        if abs(simulated["gsd"] / terms["gsd"] - 1) > 0.005:
            raise BadConfig(f"scene {name}: simulate.gsd {simulated['gsd']} m, the models work at {terms['gsd']} m")
        width = height = int(simulated["size"])
        city = simulated.get("city")
        if city and not Path(city).is_file():
            raise BadConfig(f"scene {name}: simulate.city {city} is not there: name a CityJSON file")
        source = fingerprint.of_values(
            {k: v for k, v in simulated.items() if k != "city"},
            *([fingerprint.of_file(city, cache)] if city else []),
            [settings[f"{k}_{a}"] for k in ("view", "sun") for a in ("azimuth", "elevation")],
        )
        truth_source = source
    else:
        raster, dtm, truth = settings.get("raster"), settings.get("dtm"), settings.get("truth")
        if not raster:
            raise BadConfig(f"scene {name}: which raster? Give raster=FILE (or `simulate:`)")
        if dtm is None:
            raise BadConfig(
                f"scene {name}: which terrain? Give dtm=FILE, or dtm=NUMBER for flat ground at that height (m)"
            )
        raster, dtm = sources.place(raster), sources.place(str(dtm))
        width, height = grid_size(raster, terms["gsd"], settings.get("aoi"))
        source = [sources.content(f, cache) for f in (raster, dtm)]
        truth_source = fingerprint.of_source(truth, cache) if truth and Path(truth).exists() else truth
    if settings["feed"] == "truth" and not truth:
        raise BadConfig(f"scene {name}: feed=truth needs truth=FILE")
    blocks = tiling.blocks(width, height)
    left_out = leaving_out(name, str(settings.get("leave_out") or ""), blocks)
    image = source if simulated is not None else source[0]
    signature = signatures(settings, source, image, truth_source, models, tiling, cache, left_out)
    warnings = [] if settings["feed"] == "truth" else angle_warnings(settings, models)
    return Plan(name, settings, raster, dtm, truth, tiling, blocks, models, signature, warnings, left_out)


def named(settings: dict[str, Any], results: Path) -> dict[str, str]:
    """The files that settings name as Snakemake can take them: what lies in the folder of results by its absolute path, since
    rules would make it again. Raises `BadConfig` for names that it would take for patterns."""
    found = {}
    for key in ("raster", "dtm", "models", *NAMED):
        path = settings.get(key)
        if not isinstance(path, str) or sources.is_remote(path):
            continue
        if re.search(r"\{.+\}", path):
            raise BadConfig(
                f"{key} {path}: Snakemake takes what stands in braces for a pattern: give it another name, or a link"
            )
        if Path(os.path.normpath(path)).is_relative_to(results):
            found[key] = os.path.abspath(path)
    return found


def leaving_out(name: str, text: str, blocks: list[Block]) -> dict[str, str]:
    """The blocks of one scene that `leave_out=SCENE/BLOCK/STEP,…` names, with the step each is left out from."""
    found = {}
    for item in filter(None, text.split(",")):
        scene, block, step = [*item.split("/"), "", ""][:3]
        if step not in BLOCK_STEPS:
            raise BadConfig(f"leave_out: {item}: give SCENE/BLOCK/STEP, the step one of {', '.join(BLOCK_STEPS)}")
        if scene == name:
            if block not in {b.name for b in blocks}:
                raise BadConfig(f"leave_out: {item}: the scene has blocks {blocks[0].name} to {blocks[-1].name}")
            found[block] = step
    return dict(sorted(found.items()))


def angles_of(settings: dict[str, Any]) -> dict[str, float]:
    """The angles that the scene's `metadata` tells, by their keys; what is set itself comes before them."""
    if not settings.get("metadata"):
        return {}
    from kibs_steps import metadata

    return {key: value for key, value in metadata.read(settings["metadata"])._asdict().items() if value is not None}


def layered(*layers: dict[str, Any]) -> dict[str, Any]:
    """Settings of several places, later ones above those before. The last `metadata` among them is the one that is meant: its
    angles stand where it stands, below what is set beside it."""
    telling = max((i for i, layer in enumerate(layers) if "metadata" in layer), default=None)
    found: dict[str, Any] = {}
    for i, layer in enumerate(layers):
        found |= {**angles_of(layer), **layer} if i == telling else layer
    return found


def direction(settings: dict[str, Any], name: str) -> dict[str, float] | None:
    """Azimuth and elevation (deg) of `view` or `sun`, None unless both are given."""
    angles = {angle: settings.get(f"{name}_{angle}") for angle in ("azimuth", "elevation")}
    return angles if None not in angles.values() else None


def views(settings: dict[str, Any]) -> list[dict[str, float]]:
    """Azimuth and elevation (deg) of every view of the scene: its own, if it is known, and those of its `regions`."""
    own = direction(settings, "view")
    found = [own] if own else []
    if settings.get("regions"):
        from kibs_steps import regions

        found += regions.views(settings["regions"])
    return found


def models_for(settings: dict[str, Any], base: Path) -> dict[str, contract.Model]:
    """The models of a scene for `sections` and `corners` (one model twice where the method is `single`).

    Of a suite the set that fits the scene's GSD and angles is taken.
    """
    found = suite.sets(folder_of(settings["models"], base), TASKS[settings["method"]])
    if len(found) > 1:
        simulated = settings.get("simulate")
        gsd = {**SIMULATED, **simulated}["gsd"] if simulated else own_gsd(settings.get("raster"))
        if settings["suppose"]:  # something to tell is wanted
            found = [one for one in found if not any(map(contract.untold, one.values()))] or found
        lowest = min(views(settings), key=lambda view: view["elevation"], default=None)
        chosen = suite.choose(found, gsd, lowest, direction(settings, "sun"))
    else:
        (chosen,) = found
    return {task: chosen.get(task) or chosen["both"] for task in ("sections", "corners")}


def own_gsd(raster: str | None) -> float | None:
    """Pixel side (m) of a file's or URL's raster, None where there is none to read: that is refused later, with what to do."""
    from kibs_steps import georeference

    path = sources.place(raster or "")
    if sources.is_remote(path):
        sources.version(path)  # says better than GDAL what does not answer
    elif not Path(path).exists():
        return None
    return georeference.own_gsd(path)


def angle_warnings(settings: dict[str, Any], models: dict[str, contract.Model]) -> list[str]:
    """What the models say of the scene's angles; raises `contract.AngleOutsideTraining` where they refuse them."""
    sun = direction(settings, "sun")
    found = [
        contract.check_angles(model, view, sun, settings["allow_angles"])
        for view in views(settings) or [None]
        for model in models.values()
    ]
    return list(dict.fromkeys(warning for warnings in found for warning in warnings))


def supposes(settings: dict[str, Any], models: dict[str, contract.Model]) -> bool:
    """Whether the networks are told directions that the image looks like: where the 2D model can say, and nobody else did."""
    unknown = None in (direction(settings, "view"), direction(settings, "sun")) and not settings.get("regions")
    terms = models["sections"].contract
    can = terms["head"] == "dense" and bool(terms.get("geometry_input")) and not contract.untold(models["sections"])
    return bool(settings["suppose"]) and settings["feed"] == "models" and unknown and can


def folder_of(models: str, base: Path) -> Path:
    """The folder of a model set: a name under the workflow's `models/` or under that where it runs (what was trained there), or
    a path."""
    named = (base / "models" / models, Path("models") / models)
    return next((folder for folder in named if folder.is_dir()), Path(models))


def grid_size(raster: str, gsd: float, aoi: str | None) -> tuple[int, int]:
    """Width and height (px) of the model grid over a raster, from its header."""
    from kibs_steps.georeference import model_grid

    grid = model_grid(raster, gsd, aoi)
    return grid.width, grid.height


def signatures(
    settings: dict[str, Any],
    source: Any,
    image: Any,
    truth: Any,
    models: dict[str, contract.Model],
    tiling: Tiling,
    cache: Path,
    left_out: dict[str, str],
) -> dict[str, str]:
    """Signature of every step: each hashes what it uses itself and the signatures it builds on."""
    h = fingerprint.of_values

    def without(*steps: str) -> list[str]:
        return sorted(block for block, step in left_out.items() if step in steps)

    pick = {k: settings.get(k) for k in settings}

    def some(*keys: str) -> list[Any]:
        return [pick.get(k) for k in keys]

    def content(key: str) -> Any:
        value = settings.get(key)
        return fingerprint.of_source(value, cache) if value and Path(value).exists() else value

    angles = [some("view_azimuth", "view_elevation", "sun_azimuth", "sun_elevation"), content("regions")]
    seen: dict[str, Any] = {task: angles if m.contract.get("geometry_input") else None for task, m in models.items()}
    # A contract may stand in a file of its own beside the network.
    known = {task: [m.sha256, m.contract] for task, m in models.items()}
    s = {"source": h(version("kibs-steps"), source), "image": h(version("kibs-steps"), image)}
    s["scene"] = h(
        s["source"],
        angles,
        some("projection_height", "bands", "vertical_crs"),
        content("aoi"),
        models["sections"].contract["gsd"],
    )
    s["truth"] = h(s["scene"], truth, some("truth_frame", "truth_z"))
    s["tiles"] = h(s["image"], some("bands"), content("aoi"), models["sections"].contract["gsd"], tiling)
    for task, model in models.items():
        s[f"model_{task}"] = h(*known[task], str(model.path))
    inference = some("provider", "threads", "looks")  # sums in another order differ in their last bits
    if supposes(settings, models):
        s["supposed"] = h(s["tiles"], known["sections"], angles, inference)
        seen = {task: told and [told, s["supposed"]] for task, told in seen.items()}
    s["sections"] = h(s["tiles"], known["sections"], seen["sections"], settings["mode"], inference)
    s["blend"] = h(s["sections"], known["corners"])
    s["corners"] = h(s["blend"], seen["corners"], inference)
    s["single"] = h(s["sections"])
    s["feed"] = h(s["truth"], tiling)
    # The corner model says how far corners may lie from their section, also where the truth is fed.
    detected = s["single" if settings["method"] == "single" else "sections" if settings.get("dsm") else "corners"]
    detected = s["feed"] if settings["feed"] == "truth" else detected
    s["stitch"] = h(detected, known["corners"], settings["mode"], without(*DETECTING))
    s["edited"] = h(s["stitch"], s["scene"], content("sections")) if settings.get("sections") else s["stitch"]
    s["surface"] = h(s["scene"], content("dsm"))
    s["planes"] = h(
        s["edited"],
        s["scene"],
        known["corners"],
        settings["planes"],
        s["surface"] if settings.get("dsm") else None,
    )
    s["buildings"] = h(s["planes"], content("footprints"), without(*STANDING))
    s["solids_of_block"] = h(s["buildings"], settings["lod_label"])
    s["solids"] = h(s["solids_of_block"], without("solids"))
    s["evaluate"] = h(s["planes"], s["truth"], without(*STANDING))
    s["glb"] = h(s["solids"], settings["drape"])
    s["run"] = h(
        s["solids"], s["evaluate"], json.dumps(settings, sort_keys=True, default=str), [content(key) for key in NAMED]
    )
    return s
