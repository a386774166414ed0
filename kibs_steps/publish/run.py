"""Run: `run.json`, what made these results and how it went. The only published file that two runs may differ in.

In: the scene, the input files, the models' contracts, the settings, the tables of results, and the benchmark files Snakemake
writes (`benchmark:`), one per job. Out: versions, hashes, settings, licences, counts per status and level of detail, reasons
of fallbacks, times per step.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import re
from collections import Counter
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import pyarrow as pa

from kibs_steps import cli, fingerprint, sources, store
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.grid import Tiling
from kibs_steps.publish import licences
from kibs_steps.scene import Scene

LIBRARIES = (
    "kibs-steps",
    "snakemake",
    "numpy",
    "scipy",
    "rasterio",
    "pyproj",
    "shapely",
    "pyogrio",
    "pyarrow",
    "onnx",
    "onnxruntime",
    "opencv-python-headless",
    "scikit-image",
    "pillow",
)
MOST = 20  # reasons listed
SIMPLER = ("1.3", "1.2", "0")  # levels of detail below a full roof, whatever that is called
MOSTLY = 0.9
NUMBER = re.compile(r"(?P<level>(?:^|(?<=; )|(?<=^\d\.\d and ))\d(?:\.\d)?(?= and \d|: ))|-?\d[\d,]*(?:\.\d+)?")
# Formats are written beside `run.json`; which are done by then is chance.
FORMATS = {
    "cityjson", "dsm", "evaluation", "geopackage", "glb", "ksr", "obj", "paper_picture", "points", "preview", "rasters",
    "tiles3d", "viewer",
}  # fmt: skip


class InputMissing(KibsError):
    """An input of the run that is not there any more."""


def versions() -> dict[str, str | None]:
    """Versions of Python, of this package and of the libraries results depend on; None for what is not installed."""
    import pyogrio
    import pyproj
    import rasterio
    import shapely

    found: dict[str, str | None] = {"python": platform.python_version(), "platform": platform.platform()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    found["gdal (rasterio)"] = rasterio.__gdal_version__
    found["gdal (pyogrio)"] = ".".join(map(str, pyogrio.__gdal_version__))
    return {**found, "proj": pyproj.proj_version_str, "geos": shapely.geos_version_string}


def inputs(paths: list[str], cache: Path) -> list[dict[str, Any]]:
    """File, size (bytes) and sha256 of the inputs and of the files that belong to them (`fingerprint.companions`); `cache` as in
    `fingerprint.of_file`. Raises `InputMissing`.

    Of a remote source what its server says: entity tag, date and length.
    """
    remote = [{"file": path, "version": sources.version(path)[1:]} for path in paths if sources.is_remote(path)]
    found: list[str] = []
    for path in sources.files(*paths):
        if not Path(path).exists():
            raise InputMissing(f"input {path} is gone: put it back, or build the scene again from its new place")
        found += [path] if Path(path).is_file() else []
        found += map(str, fingerprint.companions(Path(path)))
    return remote + [
        {"file": path, "bytes": Path(path).stat().st_size, "sha256": fingerprint.of_file(path, cache)}
        for path in dict.fromkeys(found)
    ]


def model_summary(path: str) -> dict[str, Any]:
    """What matters of one `models/{task}.json`: file, hash, licence, grid, head, what it was trained on."""
    content = store.read_json(path)
    contract = content["contract"]
    trained = contract["trained_on"]
    kept = {
        key: contract[key] for key in ("task", "head", "gsd", "tile", "margin", "blend", "metrics") if key in contract
    }
    heights = contract.get("heights")
    if heights:
        kept["heights"] = {
            "bins": len(heights["centres"]),
            "highest": heights["edges"][-1],
            "fallback": heights["fallback"],
        }
    return {
        "file": content["file"],
        "sha256": content["sha256"],
        "licence": trained["licence"],
        **kept,
        "trained_on": trained,
    }


def counted(values: list[Any]) -> dict[str, int]:
    """How often each value occurs, most frequent first, then by name."""
    counts = Counter(str(value) for value in values if value is not None)
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def reasons(texts: list[str | None]) -> dict[str, int]:
    """How often each reason was given, its numbers but levels of detail left out so that like reasons count together; the `MOST`
    frequent."""
    alike = [NUMBER.sub(lambda found: found["level"] or "#", text) for text in texts if text]
    return dict(list(counted(alike).items())[:MOST])


def results(sections: pa.Table, solids: pa.Table) -> dict[str, Any]:
    """Counts of sections per status and split, of buildings per level of detail, and why some are less than they could be."""
    return {
        "sections": {
            "count": sections.num_rows,
            "status": counted(sections["status"].to_pylist()),
            "split": counted(sections["split"].to_pylist()),
            "reasons": reasons(sections["status_reason"].to_pylist()),
        },
        "buildings": {
            "count": solids.num_rows,
            "lod": counted(solids["lod"].to_pylist()),
            "valid": sum(map(bool, solids["valid"].to_pylist())),
            "position_corrected": sum(map(bool, solids["position_corrected"].to_pylist())),
            "roof_type": counted(solids["roof_type"].to_pylist()),
            "reasons": reasons(solids["lod_reason"].to_pylist()),
            "lod2": lod2(sections, solids),
        },
    }


def lod2(sections: pa.Table, solids: pa.Table) -> dict[str, Any]:
    """Of the buildings with at least one section of status `ok`, how many are LOD2 in deed.

    A building is, where at least `MOSTLY` of its sections over 4 m² own a roof face within 0.2 m of their plane
    (`features.faithful`); `share` is None without any such building.
    """
    pairs = zip(sections["building_id"].to_pylist(), sections["status"].to_pylist(), strict=True)
    good = {building for building, status in pairs if status == "ok"}
    rows = [row for row in solids.to_pylist() if row["building_id"] in good]
    full = [
        row for row in rows
        if row["lod"] not in SIMPLER and (row["faithful"] is None or row["faithful"] >= MOSTLY)
    ]  # fmt: skip
    return {
        "with_ok_section": len(rows),
        "lod2": len(full),
        "share": round(len(full) / len(rows), 4) if rows else None,
        "without_solid": sum(row["lod"] == "0" for row in solids.to_pylist()),
    }


def times(folder: str | Path, blocks: set[str]) -> dict[str, dict[str, float | int]]:
    """Jobs, seconds (sum and longest) and peak memory (MB) per step of the city, from Snakemake's benchmark files below `folder`.

    A step is a file `STEP.tsv` or a folder `STEP/` with one file per block; `blocks` are those the scene has, as files of others
    may be left from a run with another `block`. Formats do not count (`FORMATS`).
    """
    steps: dict[str, list[tuple[float, float]]] = {}
    folder = Path(folder)
    for path in sorted(folder.rglob("*.tsv")):
        place = path.relative_to(folder)
        of_block = len(place.parts) > 1
        step = place.parts[0] if of_block else place.stem
        if step in FORMATS or (of_block and place.stem not in blocks):
            continue
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file, delimiter="\t"):
                try:
                    spent = float(row["s"]), float(row["max_rss"])
                except (KeyError, TypeError, ValueError):  # a job too short to be measured has "-" or "NA" for memory
                    spent = float(row["s"]) if row.get("s") else 0.0, 0.0
                steps.setdefault(step, []).append(spent)
    return {
        step: {
            "jobs": len(spent),
            "seconds": round(sum(s for s, _ in spent), 3),
            "longest": round(max(s for s, _ in spent), 3),
            "peak_mb": round(max(m for _, m in spent), 1),
        }
        for step, spent in steps.items()
    }


def facts(scene: Scene) -> dict[str, Any]:
    """What is known of the raster: grid, directions, how it was projected."""
    return {
        "name": scene.name,
        "grid": scene.grid._asdict(),
        "bands": scene.bands,
        "view": scene.view and scene.view._asdict(),
        "sun": scene.sun and scene.sun._asdict(),
        "projection_height": scene.projection_height,
        "regions": [region.view._asdict() for region in scene.regions],
        "position_corrected": scene.view is not None or bool(scene.regions),
    }


def main(argv: list[str] | None = None) -> None:
    """Write down what made a scene's results."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.run", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--inputs", nargs="*", default=[], help="raster, terrain, truth …: hashed")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json")
    parser.add_argument("--settings", default="{}", help="the scene's settings, JSON text")
    parser.add_argument("--sections", required=True, nargs="+", help="buildings.parquet")
    parser.add_argument("--solids", required=True, nargs="+", help="solids.parquet of all blocks")
    parser.add_argument("--blocks", help="failed.json: blocks the city is made without, and why")
    parser.add_argument("--benchmarks", help="folder of Snakemake's benchmark files")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="tile margin, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--out", required=True, help="out: run.json")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    sections, solids = (
        pa.concat_tables([store.read_table(path, columns) for path in paths], promote_options="permissive")
        for paths, columns in (
            (args.sections, ["building_id", "status", "status_reason", "split"]),
            (args.solids, ["building_id", "lod", "lod_reason", "valid", "position_corrected", "roof_type", "faithful"]),
        )
    )
    line = licences.line(args.models)
    tiling = Tiling(args.tile, args.margin, args.block)
    names = {block.name for block in tiling.blocks(scene.grid.width, scene.grid.height)}
    content = {
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "scene": facts(scene),
        "licence": line,
        "models": [model_summary(path) for path in args.models],
        "settings": json.loads(args.settings),
        "inputs": inputs(args.inputs, scene.folder.parent / ".fingerprints.json"),
        "results": results(sections, solids),
        "failed_blocks": store.read_json(args.blocks) if args.blocks else {},
        "times": times(args.benchmarks, names) if args.benchmarks else {},
        "versions": versions(),
    }
    store.write_json(args.out, content)
    if line:
        print(f"licence of the models: {line}")


if __name__ == "__main__":
    cli.run(main, pandas=False)
