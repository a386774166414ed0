"""Set A: whole scenes with exact truth, through the workflow itself, judged by its own `evaluate`.

Renderings of a city file no model was trained on (or, without one, of procedural cities of seeds no training uses) from the
view of the paper's two images, from nadir, and from a view whose cone is kept out of all training. Out: figures per view.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.accuracy.methods import Method
from kibs_steps import fingerprint, store
from kibs_steps.errors import KibsError
from kibs_steps.simulate import scene as simulation

ROOT = Path(__file__).parents[2]
HELD_OUT_VIEW = simulation.HELD_OUT_CONE[:2]  # azimuth, elevation (deg); training shows nothing within the cone
VIEWS = {
    "A mourmelon": (181.1, 59.3),
    "A sissonne": (172.9, 66.6),
    "A nadir": (0.0, 90.0),
    "A held-out view": HELD_OUT_VIEW,
}
SUN = (155.0, 45.0)
SEED = 77_001_001


class BrokenRun(KibsError):
    """A run of the workflow that failed."""


def make(folder: Path, size: int, gsd: float, city: Path | None) -> dict[str, dict[str, Any]]:
    """Render every view once into `folder`; the scenes' settings by set name. Finished ones are left as they are."""
    found = {}
    for number, (name, (azimuth, elevation)) in enumerate(VIEWS.items()):
        kind = f"{city.stem}-{fingerprint.of_file(city, folder / 'fingerprints.json')[:8]}" if city else "procedural"
        place = folder / f"{kind}-{size}-{gsd:g}-{azimuth:g}-{elevation:g}"
        if not (place / "angles.json").is_file():  # written last
            simulation.main(
                [
                    f"--seed={SEED + (0 if city else number)}",
                    f"--size={size}",
                    f"--gsd={gsd}",
                    f"--view-azimuth={azimuth}",
                    f"--view-elevation={elevation}",
                    f"--sun-azimuth={SUN[0]}",
                    f"--sun-elevation={SUN[1]}",
                    "--style=mixed",
                    *([f"--city={city}"] if city else ["--relief=3"]),
                    f"--out={place}",
                ]
            )
        found[name] = {
            "raster": str((place / "scene.tif").resolve()),
            "dtm": str((place / "dtm.tif").resolve()),
            "truth": str((place / "truth.gpkg").resolve()),
            "truth_frame": "map",
            "view_azimuth": azimuth,
            "view_elevation": elevation,
            "sun_azimuth": SUN[0],
            "sun_elevation": SUN[1],
            "allow_angles": True,
        }
    return found


def run(method: Method, scenes: dict[str, dict[str, Any]], folder: Path, cores: int) -> dict[str, dict[str, Any]]:
    """Figures of one method by set name; the workflow runs in `folder` and makes again only what changed.

    Raises `BrokenRun`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = {name: name.replace(" ", "_") for name in scenes}
    config = {"scenes": {names[name]: {**settings, **method.settings} for name, settings in scenes.items()}}
    (folder / "scenes.json").write_text(json.dumps(config, indent=2))
    targets = [f"results/{name}/evaluation.json" for name in names.values()]
    words = ["-s", str(ROOT / "Snakefile"), "--configfile", "scenes.json", "--cores", str(cores), "--nolock"]
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", *words, *targets], cwd=folder, capture_output=True, text=True
    )
    if done.returncode:
        raise BrokenRun(f"{method.name}: the workflow failed in {folder}:\n{(done.stdout + done.stderr)[-3000:]}")
    return {name: chosen(store.read_json(folder / f"results/{names[name]}/evaluation.json")) for name in scenes}


def chosen(evaluation: dict[str, Any]) -> dict[str, Any]:
    """Of an evaluation what the table shows."""
    pixels, sections = evaluation["pixels"]["all"], evaluation["sections"]["all"]
    planes, corners = evaluation["planes"]["all"], evaluation["corners"]
    figures = {
        "iou": pixels["iou"],
        **{key: sections[key] for key in ("ap50", "mean_best_iou", "pq")},
        "corner_precision": corners["precision"],
        "corner_recall": corners["recall"],
        "slope_error": planes.get("slope_mae"),
        "azimuth_error": planes.get("azimuth_mae"),
    }
    for key, group in (("found", "found"), ("roof", "all_truth")):
        heights = evaluation["heights"][group]
        figures |= {f"{key}_{name}": heights["all"].get(name) for name in ("mae", "rmse", "nmad", "bias")}
        bins = {name: part.get("mae") for name, part in heights.items() if name.endswith(" m")}
        figures[f"{key}_mae_by_height"] = {name: value for name, value in bins.items() if value is not None}
    return figures
