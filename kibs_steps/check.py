"""Check: what a run would do, before it does it. Run as `snakemake check`.

In: the settings of scenes, and how many blocks of each step are still to do. Out, printed: grid, bands, view, terrain, models
and licences, time, disk, and everything doubtful about the inputs. Nothing is written. Of the data, a sample of the raster
and one tile through each network are looked at; times are estimates from that tile and from figures measured once.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kibs_steps import cli, failures, georeference, imagery, inputs, scene, sources
from kibs_steps import plan as plans
from kibs_steps import view as geometry
from kibs_steps.models import runtime
from kibs_steps.plan import Plan

# Seconds on one core per Mpx beside the networks, and per job; bytes on disk per pixel. Planes and ground were timed on
# the demo (1.44 Mpx of town), the others set so that the demo's whole time comes out: good for "minutes or hours", no more.
SECONDS = {"tiles": 0.5, "sections": 2.0, "blend": 0.5, "corners": 0.5, "planes": 0.5, "ground": 0.3, "solids": 20.0}
OTHER_SECONDS = 10.0  # stitch, buildings and the published files
JOB_SECONDS = 0.6
BYTES = {"blocks": 5.0, "published": 4.0}


class Estimate(NamedTuple):
    """Seconds on one core, and bytes on disk."""

    seconds: float
    size: float


def estimate(
    pixels: int, tiles: int, todo: Mapping[str, float], jobs: int, tile_seconds: Mapping[str, float]
) -> Estimate:
    """What a scene takes: `todo` is the share of blocks that each step is still to do, `tile_seconds` a tile's time in each
    network.
    """
    mpx = pixels / 1e6
    blocks = sum(seconds * mpx * todo.get(step, 0.0) for step, seconds in SECONDS.items())
    networks = sum(seconds * tiles * todo.get(step, 0.0) for step, seconds in tile_seconds.items())
    rest = OTHER_SECONDS * mpx if any(todo.values()) else 0.0
    share = max(todo.values(), default=0.0)
    return Estimate(blocks + networks + rest + JOB_SECONDS * jobs, pixels * sum(BYTES.values()) * share)


def duration(seconds: float) -> str:
    """A time in words, no more exact than it is known."""
    if seconds < 90:
        return f"{max(10, math.ceil(seconds / 10) * 10)} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def size(bytes_: float) -> str:
    """A number of bytes in words."""
    return f"{bytes_ / 1e9:.1f} GB" if bytes_ >= 1e9 else f"{max(bytes_ / 1e6, 0.1):.1f} MB"


def tile_seconds(plan: Plan) -> dict[str, float]:
    """Seconds that each network a run uses takes for one tile of the scene here and now, on one core."""
    side = plan.tiling.tile
    image = np.random.default_rng(0).integers(60, 180, (side, side, 3)).astype(np.uint8)
    settings, found = plan.settings, {}
    view, sun = min(plans.views(settings), key=lambda v: v["elevation"], default=None), plans.direction(settings, "sun")
    leans = (d and geometry.lean(d["azimuth"], d["elevation"]) for d in (view, sun))
    told = runtime.geometry_vector(*leans, plan.models["sections"].contract["gsd"])
    for task, model in plan.models.items():
        if task == "corners" and (plan.measured or settings["method"] == "single"):
            continue  # no 3D model is used, or one network gives both
        network = runtime.open_network(model, told, settings["provider"], settings["threads"], settings["looks"])
        start = time.process_time()
        network(image)
        found[task] = time.process_time() - start
    return found


def doubts(plan: Plan, results: Path, needed: float) -> list[str]:
    """Everything that makes a run's result, or its end, less than sure."""
    found = [*plan.warnings, *inputs.check(plan, results)]
    settings = plan.settings
    if settings.get("simulate") is None:
        with imagery.opened(plan.raster) as source:
            facts = scene.facts(source, plan.models["sections"].contract["gsd"], inputs.bands_of(settings))
        found += facts["warnings"]
        if facts["coverage"] < 0.99:
            found.append(f"{100 * (1 - facts['coverage']):.0f} % of the raster is nodata: nothing is found there")
        if facts["stretch"]:
            ranges = ", ".join(f"{low:g}-{high:g}" for low, high, _ in facts["stretch"])
            found.append(f"{facts['dtype']} values are brought to 8 bit from {ranges} (1st to 99th percentile)")
        if settings.get("view_azimuth") is None and not any(said.startswith("view angles unknown") for said in found):
            there = " outside the regions" if settings.get("regions") else ""
            found.append(f"view angles unknown{there}: roofs are not moved to where they stand")
        if not plan.terrain_files and not sources.is_remote(plan.dtm):
            found.append(f"the ground is taken as level at {float(plan.dtm):g} m")
    if plan.truth is None and settings.get("simulate") is None:
        found.append("no truth is given: nothing says how good the result is")
    free = shutil.disk_usage(next(p for p in (results, Path()) if p.exists())).free
    if needed > free:
        found.append(f"the run needs about {size(needed)}, the disk has {size(free)} free")
    return list(dict.fromkeys(found))


def page(plan: Plan, results: Path, todo: Mapping[str, int]) -> str:
    """What `snakemake check` prints of one scene. `todo` is the number of blocks that each step is still to do."""
    settings = plan.settings
    if settings.get("simulate") is not None:
        side = int(settings["simulate"]["size"])
        width, height, gsd = side, side, settings["simulate"]["gsd"]
        crs = settings["simulate"].get("crs", "the city's CRS")
        image = f"simulated, seed {settings['simulate']['seed']}"
    else:
        grid = georeference.model_grid(plan.raster, plan.models["sections"].contract["gsd"], settings.get("aoi"))
        width, height, gsd, crs = grid.width, grid.height, grid.gsd, grid.crs.splitlines()[0][:40]
        with imagery.opened(plan.raster) as source:
            bands = ",".join(map(str, imagery.colour_bands(source, inputs.bands_of(settings))[0]))
            image = f"{plan.raster}: {source.width} x {source.height} px, {source.dtypes[0]}, bands {bands} as red, green, blue"
    rows, cols = plan.tiling.shape(width, height)
    fed = settings["feed"] == "truth"
    networks = {} if fed else tile_seconds(plan)
    jobs = sum(todo.values())
    share = {step: n / len(plan.blocks) for step, n in todo.items()}
    needs = estimate(width * height, rows * cols, share, jobs, networks)
    models = (
        "none: the truth is fed in their place"
        if fed
        else "; ".join(dict.fromkeys(m.licence_line for m in plan.models.values()))
    )
    waiting = ", ".join(f"{step} {n}" for step, n in todo.items() if n)
    lines = {
        "image": image,
        "grid": f"{width} x {height} px of {gsd:g} m in {crs}: {width * height / 1e6:.2f} Mpx, "
        f"{width * height * gsd**2 / 1e6:.2f} km², {rows * cols} tiles in {len(plan.blocks)} blocks",
        "view": _direction(settings, "view") + (f"; regions {settings['regions']}" if settings.get("regions") else ""),
        "sun": _direction(settings, "sun"),
        "terrain": plan.dtm,
        "models": models,
        "to do": f"{waiting} of {len(plan.blocks)} blocks" if jobs else "nothing: all blocks are made",
        "time": f"about {duration(needs.seconds)} on one core (a rough estimate: one tile was timed here"
        f"{'; fed truth needs no network' if fed else ''})",
        "disk": f"about {size(needs.size)} in {results / plan.name}",
    }
    record = results / plan.name / failures.RECORD
    if record.is_file():
        lines["failed"] = f"blocks failed in the last run and are tried again: see {record}"
    text = [f"scene {plan.name}", *(f"  {key:8} {value}" for key, value in lines.items())]
    return "\n".join([*text, *(f"  {'doubtful':8} {doubt}" for doubt in doubts(plan, results, needs.size))])


def _direction(settings: dict[str, Any], name: str) -> str:
    azimuth, elevation = (settings.get(f"{name}_{angle}") for angle in ("azimuth", "elevation"))
    if azimuth is None or elevation is None:
        return "unknown"
    text = f"azimuth {azimuth:g}°, elevation {elevation:g}°"
    if name == "view":
        text += f": a roof 10 m up is shown {10 / math.tan(math.radians(elevation)):.1f} m from where it stands"
    return text


def main(argv: list[str] | None = None) -> None:
    """Say what a run would do, how long it would take, and what is doubtful."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.check", description=main.__doc__)
    parser.add_argument("--base", required=True, help="the workflow's folder")
    parser.add_argument("--results", required=True, help="folder of results")
    parser.add_argument("--scenes", required=True, help="JSON: settings by scene")
    parser.add_argument("--todo", required=True, help="JSON: blocks still to do, by scene and step")
    args = parser.parse_args(argv)
    todo = json.loads(args.todo)
    for name, settings in json.loads(args.scenes).items():
        plan = plans.plan(name, settings, Path(args.base), Path(args.results))
        print(page(plan, Path(args.results), todo[name]))
        sys.stdout.flush()


if __name__ == "__main__":
    cli.run(main)
