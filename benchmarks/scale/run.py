"""The scale benchmark: a city of N Mpx through the whole workflow, beside its floor and beside the paper's way.

    python benchmarks/scale/run.py --out FOLDER --sizes 1 10 86 --cores 2

Every measurement is kept in FOLDER/measured.json as soon as it is there; what is there is not measured again, so the same
command goes on after a kill. FOLDER/table.md is the table. A half-finished workflow run is not resumed but begun anew,
because its time would mean nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import rasterio

sys.path.insert(0, str(Path(__file__).parent))
import patchwork
import rivals
import watch

from kibs_steps.errors import KibsError

ROOT = Path(__file__).parents[2]
SIZES = {
    "1": (1000, 1000),
    "10": (3200, 3150),
    "86": (8687, 9890),
    "804": (30564, 26320),
}  # Mpx: px; the last two the paper's
PAPER_TILES = {"86": 1755, "804": 18400}  # at the paper's stride
UNEQUAL = ("run.json", ".fingerprints.json")  # what two runs may differ in


def snakemake(scene: str, folder: Path, models: str, cores: int, *flags: str) -> list[str]:
    """The user's command for a scene of the benchmark."""
    settings = {
        "scene": scene,
        "raster": folder / "raster.tif",
        "dtm": folder / "dtm.tif",
        "models": models,
        **patchwork.VIEW,
    }
    config = [f"{key}={value}" for key, value in settings.items()]
    call = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", str(cores), *flags]
    return [*call, "--config", *config]


def planning(scene: str, folder: Path, work: Path, models: str) -> dict[str, float]:
    """Seconds Snakemake needs before the first job: a dry run of everything, and the CPU time of it."""
    call = snakemake(scene, folder, models, 1, "-n", "--quiet", "all")
    start, before = time.monotonic(), os.times()
    subprocess.run(call, cwd=work, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {"wall": round(time.monotonic() - start, 2), "cpu": round(cpu, 2)}


def workflow(size: str, folder: Path, out: Path, models: str, cores: int, nice: int) -> dict[str, Any]:
    """Run the whole workflow on a raster from nothing; raises if it fails."""
    work = out / (f"work{size}" if cores > 1 else f"work{size}on1")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    scene = f"city{size}"
    plan = planning(scene, folder, work, models)
    shutil.rmtree(work / ".snakemake", ignore_errors=True)
    found = watch.watched(
        snakemake(scene, folder, models, cores, "--quiet", "all"), work, work.with_suffix(".log"), nice
    )
    if found["code"]:
        raise SystemExit(f"the workflow failed: see {work.with_suffix('.log')}")
    results = work / "results" / scene
    counts = [pq.read_table(f, columns=["building_id"]) for f in sorted(results.glob("blocks/*/solids.parquet"))]
    with rasterio.open(folder / "raster.tif") as source:
        pixels, raw = source.width * source.height, source.width * source.height * 3
    return {
        **found,
        "planning": plan,
        "mpx": round(pixels / 1e6, 3),
        "raster_bytes": raw,
        "buildings": sum(map(len, counts)),
        "sections": pq.read_metadata(results / "buildings.parquet").num_rows,
        "published": watch.used(results) - watch.used(results / "blocks"),
        "sha256": {f.name: digest(f) for f in sorted(results.iterdir()) if f.is_file() and f.name not in UNEQUAL},
    }


def digest(path: Path) -> str:
    """sha256 of a file."""
    with path.open("rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()


def model_files(models: str) -> list[Path]:
    """The networks that a run of these models calls on every tile, each once."""
    folder = ROOT / "models" / models if (ROOT / "models" / models).is_dir() else Path(models)
    return sorted(folder.glob("*.onnx"))


def tiles_of(width: int, height: int, stride: int) -> int:
    """How many tiles cover a raster."""
    return -(-width // stride) * -(-height // stride)


def flood(results: Path) -> dict[str, Any]:
    """One flood fill in a quarter and half the width of a run's labels and in the whole."""
    with rasterio.open(results / "labels.tif") as source:
        whole = source.read(1)
    largest = max(whole.shape)
    return rivals.growth(lambda side: whole[:side, :side], [largest // 4, largest // 2, largest])


def measured(out: Path, key: str, measure: Any) -> Any:
    """A measurement, from FOLDER/measured.json if it is there, else made and kept."""
    file = out / "measured.json"
    known = json.loads(file.read_text()) if file.exists() else {}
    if key not in known:
        print(f"measuring {key} …", flush=True)
        value = measure()
        known = json.loads(file.read_text()) if file.exists() else {}
        known[key] = {"date": datetime.now(UTC).isoformat(timespec="minutes"), "value": value}
        file.write_text(json.dumps(known, indent=1))
    return known[key]["value"]


def table(known: dict[str, Any], cores: int) -> str:
    """The measurements as Markdown."""
    values = {key: entry["value"] for key, entry in known.items()}
    floor, pair = values.get("floor"), values.get("pair")
    lines = [
        f"{cores} cores of {platform.processor() or platform.machine()}, {datetime.now(UTC):%Y-%m-%d}; floor = the same models "
        "by bare onnxruntime on the same tiles and cores.",
        "",
        "| Mpx | buildings | wall, s | s per Mpx | CPU, s | floor, s | wall − 1.5 × floor − 30 ms per building, s | "
        "peak MB of a process | disk / raster | jobs | planning, s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for size in SIZES:
        run = values.get(f"workflow {size}")
        if not run:
            continue
        bare = floor["per_tile"] * tiles_of(*SIZES[size], floor["stride"]) if floor else float("nan")
        rest = run["wall"] - 1.5 * bare - 0.03 * run["buildings"]
        jobs = sum(s["jobs"] for name, s in run["steps"].items() if name not in ("shell", "snakemake"))
        lines.append(
            f"| {run['mpx']} | {run['buildings']} | {run['wall']:.0f} | {run['wall'] / run['mpx']:.2f} | {run['cpu']:.0f} | "
            f"{bare:.0f} | {rest:.0f} | {run['peak_mb']:.0f} | {run['disk'] / run['raster_bytes']:.2f} | {jobs:.0f} | "
            f"{run['planning']['wall']} |"
        )
    largest = [size for size in SIZES if f"workflow {size}" in values]
    if largest:
        run = values[f"workflow {largest[-1]}"]
        lines += [
            "",
            f"Steps of the {run['mpx']} Mpx run:",
            "",
            "| step | jobs | CPU, s | share | peak MB |",
            "|---|---|---|---|---|",
        ]
        total = sum(s["cpu"] for s in run["steps"].values()) or 1.0
        for name, step in run["steps"].items():
            share = step["cpu"] / total
            lines.append(f"| {name} | {step['jobs']:.0f} | {step['cpu']:.1f} | {share:.1%} | {step['peak_mb']:.0f} |")
    single, alone = (
        values.get("floor on 1 core"),
        [key for key in values if key.endswith("on 1 core") and "workflow" in key],
    )
    for key in alone:
        one, many = values[key], values.get(key.removesuffix(" on 1 core"))
        if not many or not single or not floor:
            continue
        ours, bare = one["wall"] / many["wall"], single["per_tile"] / floor["per_tile"]
        lines += [
            "",
            f"{one['mpx']} Mpx, {floor['cores']} cores against one: {ours:.2f} × faster, the bare model loop {bare:.2f} ×, ratio "
            f"{ours / bare:.2f}; published files the same bytes: {'yes' if one['sha256'] == many['sha256'] else 'NO'}.",
        ]
    lines += ["", "The paper's way, same cores:", ""]
    if pair and floor and "per_tile" in pair:
        paper = pair["per_tile"] * PAPER_TILES["86"]
        ours = floor["per_tile"] * tiles_of(*SIZES["86"], floor["stride"])
        lines.append(
            f"- its two Mask R-CNNs (random weights): {pair['per_tile']:.2f} s per tile, {paper:.0f} s for the "
            f"{PAPER_TILES['86']:,} tiles of 86 Mpx; our networks {ours:.0f} s: {paper / ours:.0f} ×"
        )
    elif pair:
        lines.append(f"- its two Mask R-CNNs: not measured ({pair['reason']})")
    flooding = values.get("flood fill")
    if flooding:
        lines.append(
            f"- labelling by flood_fill: {flooding['seconds']} s a section at "
            f"{[round(size, 1) for size in flooding['mpx']]} Mpx, growing with size to the power {flooding['exponent']}"
        )
        for size in PAPER_TILES:
            run = values.get(f"workflow {size}")
            if not run:
                continue
            city = run["sections"] * flooding["factor"] * run["mpx"] ** flooding["exponent"]
            line = f"- {size} Mpx: labelling its {run['sections']:,} sections {city / 3600:.1f} h by that law"
            if pair and "per_tile" in pair:
                paper = city + pair["per_tile"] * PAPER_TILES[size]
                line += f"; models and labelling {paper / 3600:.1f} h, our whole road {run['wall']:.0f} s: "
                line += f"{paper / run['wall']:.0f} ×"
            lines.append(line)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure what is asked for and not measured yet, and write the table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for rasters, runs and results")
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=["1", "10"], help="Mpx")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--one-core", nargs="*", choices=list(SIZES), default=[], help="Mpx to run on one core too")
    parser.add_argument("--models", default="research", help="a model set, as the workflow's key")
    parser.add_argument("--library", type=int, default=24, help="simulated scenes that the rasters are made of")
    parser.add_argument("--floor-tiles", type=int, default=16, help="tiles per core that the floor is measured on")
    parser.add_argument(
        "--pair-tiles", type=int, default=4, help="tiles the paper's networks are measured on; 0: not at all"
    )
    parser.add_argument("--nice", type=int, default=0, help="niceness of the workflow")
    args = parser.parse_args()
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    scenes = patchwork.library(out / "library", args.library)
    dense = measured(out, "buildings per km2", lambda: round(patchwork.density(scenes), 1))
    if dense < patchwork.DENSEST:
        print(f"warning: {dense} buildings per km², {patchwork.DENSEST} are wanted", file=sys.stderr)
    for size in args.sizes:
        folder = out / f"raster{size}"
        folder.mkdir(exist_ok=True)
        if not (folder / "dtm.tif").exists():
            patchwork.raster(folder / "raster.tif", *SIZES[size], scenes)
            patchwork.terrain(folder / "dtm.tif", *SIZES[size])

    files = model_files(args.models)
    from kibs_steps.models import contract

    terms = contract.load(files[0]).contract
    stride = terms["tile"] - 2 * terms["margin"]
    for cores in sorted({1, args.cores}):
        key = "floor" if cores == args.cores else "floor on 1 core"
        measured(
            out,
            key,
            lambda n=cores: {"per_tile": rivals.per_tile(files, args.floor_tiles, n), "stride": stride, "cores": n},
        )
    runs = [(size, args.cores, f"workflow {size}") for size in args.sizes]
    runs += [(size, 1, f"workflow {size} on 1 core") for size in args.one_core]
    for size, cores, key in runs:
        run = (size, out / f"raster{size}", out, args.models, cores, args.nice)
        measured(out, key, lambda r=run: workflow(*r))
    if args.pair_tiles:
        measured(out, "pair", lambda: paper_models(out, args.pair_tiles, args.cores))
    largest = next(size for size in reversed(SIZES) if (out / f"work{size}").is_dir())
    measured(out, "flood fill", lambda: flood(out / f"work{largest}" / "results" / f"city{largest}"))
    text = table(json.loads((out / "measured.json").read_text()), args.cores)
    (out / "table.md").write_text(text)
    print(text)


def paper_models(out: Path, tiles: int, cores: int) -> dict[str, Any]:
    """Seconds per tile of the paper's pair, or why it cannot be measured here."""
    try:
        paths = rivals.pair(out / "pair")
    except (ImportError, KibsError) as error:
        return {"reason": str(error)}
    with rasterio.open(sorted(out.glob("raster*/raster.tif"))[0]) as source:
        image = source.read(window=((0, 700), (0, 700))).astype(np.float32)
    tile = 230
    places = [(tile * (k // 3), tile * (k % 3)) for k in range(tiles)]
    sample = np.stack([image[:, r : r + tile, c : c + tile] for r, c in places])
    mean, std = np.array([123.675, 116.28, 103.53], np.float32), np.array([58.395, 57.12, 57.375], np.float32)
    return {
        "per_tile": rivals.pair_per_tile(paths, (sample - mean[:, None, None]) / std[:, None, None], cores),
        "tiles": tiles,
    }


if __name__ == "__main__":
    main()
