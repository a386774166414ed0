"""Real Snakemake runs on the toy world: reruns follow content, kills are survived, cores and blocks do not matter."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import toy

ROOT = Path(__file__).parents[2]
SNAKEMAKE = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile")]
PUBLISHED = [
    "city.gpkg",
    "city.city.json",
    "city.city.jsonl",
    "city.glb",
    "city.obj",
    "city.mtl",
    "tiles3d/tileset.json",
    "points.txt",
    "ksr/points.ply",
    "heights.tif",
    "labels.tif",
    "dsm.tif",
    "preview.png",
    "viewer.html",
    "run.json",
]
SAME_BYTES = [f for f in PUBLISHED if f != "run.json"]
MAIN = ["city.gpkg", "city.city.jsonl", "points.txt", "heights.tif", "labels.tif"]  # what most tests make do with
SIZE = (150, 110)


def command(folder: Path, cores: int = 2, only: Sequence[str] = (), **settings: object) -> list[str]:
    """The user's command, run from a folder of their own; `only` some of the published files."""
    base = {"scene": "town", "raster": "town.tif", "dtm": 100, "models": "models", "block": 2, **toy.VIEW, **settings}
    config = [f"{k}={v}" for k, v in base.items()]
    return [*SNAKEMAKE, *(f"results/town/{name}" for name in only), "--cores", str(cores), "--config", *config]


def finished(folder: Path, words: Sequence[str]) -> str:
    """What a command that ends well printed."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-5000:]
    return done.stdout + done.stderr


def run(folder: Path, *flags: str, cores: int = 2, only: Sequence[str] = (), **settings: object) -> str:
    """Run the workflow to its end and return what it printed."""
    return finished(folder, [*command(folder, cores, only, **settings), *flags])


def jobs(output: str) -> dict[str, int]:
    """How many jobs of each rule an output tells of, but for the target itself."""
    found: dict[str, int] = {}
    for rule in re.findall(r"^(?:localrule|rule) (\w+):", output, re.M):
        found[rule] = found.get(rule, 0) + 1
    found.pop("all", None)
    return found


def digests(folder: Path, scene: str = "town", files: Sequence[str] = SAME_BYTES) -> dict[str, str]:
    """sha256 of published files that must not vary."""
    return {f: hashlib.sha256((folder / "results" / scene / f).read_bytes()).hexdigest() for f in files}


def world(folder: Path) -> Path:
    """A folder with a painted raster and toy models."""
    folder.mkdir(parents=True, exist_ok=True)
    toy.raster(folder / "town.tif", toy.paint(toy.houses(np.random.default_rng(5), *SIZE), *SIZE))
    toy.models(folder / "models")
    return folder


@pytest.fixture(scope="session")
def town(tmp_path_factory) -> Path:
    """A finished run that tests copy or look at, never change."""
    folder = world(tmp_path_factory.mktemp("town"))
    run(folder)
    return folder


@pytest.fixture
def copy(town, tmp_path) -> Path:
    """A finished run to play with (dates kept)."""
    folder = tmp_path / "copy"
    shutil.copytree(town, folder, copy_function=shutil.copy2)
    return folder


def test_all_published_files_are_there(town):
    for name in PUBLISHED:
        assert (town / "results/town" / name).stat().st_size > 0
    assert not list(town.rglob(".tmp-*"))
    layers = {name for name, _ in pyogrio.list_layers(town / "results/town/city.gpkg")}
    assert {"buildings", "footprints", "roof_sections", "roof_sections_image", "corners", "blocks"} <= layers


def test_points_txt(town):
    """One `x y z id` per section corner, in map metres, id 2 without a split."""
    lines = (town / "results/town/points.txt").read_text().splitlines()
    rows = np.array([line.split() for line in lines], float)
    assert rows.shape[1] == 4
    assert set(rows[:, 3]) == {2}
    assert (np.abs(rows[:, 0] - toy.X0 - 30) < 60).all()
    assert (rows[:, 2] > 100).all()


def test_nothing_to_do_is_quick_and_touching_is_nothing(copy):
    (copy / "town.tif").touch()
    (copy / "models/corners.onnx").touch()
    start = time.monotonic()
    output = run(copy)
    assert jobs(output) == {}
    print(f"a run with nothing to do took {time.monotonic() - start:.1f} s")


def test_snakemake_looks_at_ready_jobs_once_per_job(tmp_path):
    """Not every second besides, in ever more chains, as its default limit of jobs per second would have it."""
    world(tmp_path)
    output = run(tmp_path, "--verbose", cores=1, only=["labels.tif"])
    looks, done = output.count("Ready jobs: "), output.count("Finished jobid: ")
    assert done > 5
    assert looks <= done + 1


def test_another_corner_model_reruns_corners_only(copy):
    before = digests(copy)
    toy.corners_model(copy / "models/corners.onnx", bias=1.0)
    done = jobs(run(copy))
    assert not {"scene", "tiles", "sections"} & set(done)
    assert {"blend", "corners", "stitch", "planes", "solids"} <= set(done)
    assert digests(copy)["points.txt"] != before["points.txt"]


def test_another_view_reruns_from_the_planes(copy):
    (copy / "results/town/report.html").touch()
    told = run(copy, view_azimuth=95)
    done = jobs(told)
    assert {"scene", "planes", "ground"} <= set(done)
    assert not {"tiles", "sections", "blend", "corners", "stitch"} & set(done)
    assert "town: report.html of an earlier run, not made anew" in told
    assert "not made anew" not in run(copy, only=["report.html"], view_azimuth=95)


def test_another_terrain_reruns_from_the_planes(copy):
    done = jobs(run(copy, dtm=101, only=MAIN))
    assert {"scene", "planes", "ground"} <= set(done)
    assert not {"tiles", "sections", "blend", "corners", "stitch"} & set(done)


def test_everything_may_be_forced(copy):
    before = digests(copy)
    assert {"blend", "corners", "solids", "geopackage"} <= set(jobs(run(copy, "--forceall")))
    assert digests(copy) == before


def test_results_without_their_records_are_not_taken_for_made(copy):
    """What made them is written in .snakemake alone: with other settings they would stay as they are."""
    shutil.rmtree(copy / ".snakemake")
    done = subprocess.run(command(copy, view_azimuth=95), cwd=copy, capture_output=True, text=True)
    assert done.returncode != 0
    assert "results/town was not made here, or the folder .snakemake was deleted" in done.stderr


def test_what_another_scene_made_may_be_an_input(copy):
    assert "rule tiles" in run(copy, "--dry-run", scene="new", dtm="results/town/dtm.tif")


def test_a_set_in_the_place_of_the_trained_one_is_not_trained(copy):
    """`train` would write models/mine; who builds a city with it wants it as it is."""
    shutil.copytree(copy / "models", copy / "models/mine")
    assert not {"trained", "exported"} & set(jobs(run(copy, "--dry-run", models="models/mine")))


def test_a_missing_provider_is_told_before_any_work(tmp_path):
    folder = world(tmp_path)
    done = subprocess.run(command(folder, provider="openvino"), cwd=folder, capture_output=True, text=True)
    assert done.returncode != 0
    assert "provider=openvino: this onnxruntime has" in done.stderr
    assert not (folder / "results/town").exists()


def test_a_deleted_picture_of_the_evaluation_is_made_again(copy):
    layer = pyogrio.read_dataframe(copy / "results/town/city.gpkg", layer="roof_sections_image")
    layer.to_file(copy / "truth.gpkg")
    told = {"truth": "truth.gpkg", "truth_frame": "map", "truth_z": "above_ground"}
    run(copy, **told)
    (copy / "results/town/evaluation.png").unlink()
    assert set(jobs(run(copy, **told))) == {"evaluation"}


def test_deleted_block_is_redone_alone(copy):
    before = digests(copy)
    shutil.rmtree(copy / "results/town/blocks/r000c001")
    done = jobs(run(copy))
    assert all(n == 1 for n in done.values())
    assert {"tiles", "sections", "corners", "planes", "ground", "solids"} <= set(done)
    assert "stitch" not in done
    assert digests(copy) == before


def test_deleted_result_is_made_again(copy):
    before = digests(copy)
    (copy / "results/town/city.gpkg").unlink()
    assert set(jobs(run(copy))) == {"geopackage"}
    assert digests(copy) == before


def test_temporary_files_of_a_killed_run_are_removed_unless_kept(copy):
    """A kill after the last job that reads them, before Snakemake deletes them, leaves them as `--notemp` does."""
    blended = copy / "results/town/blocks/r000c001/blended.tif"
    shutil.rmtree(blended.parent)
    run(copy, "--notemp")
    (copy / "results/town/points.txt").unlink()
    run(copy, "--notemp")
    assert blended.exists()
    (copy / "results/town/points.txt").unlink()
    assert set(jobs(run(copy))) == {"points"}
    assert not blended.exists()


def test_cores_do_not_matter(town, tmp_path):
    """The town was made on two cores."""
    folder = world(tmp_path / "again")
    run(folder, cores=1)
    assert digests(folder) == digests(town)


def test_block_size_gives_the_same_sections(town, tmp_path):
    """All layers but `blocks` are alike whether the town is four blocks or one."""
    folder = world(tmp_path / "other")
    run(folder, block=4, only=MAIN)
    for layer in ("roof_sections", "roof_sections_image", "buildings", "footprints", "corners"):
        frames = []
        for f in (folder, town):
            frame = pyogrio.read_dataframe(f / "results/town/city.gpkg", layer=layer)
            frames.append(sorted(zip(*(map(str, frame[c]) for c in sorted(frame.columns)), strict=True)))
        assert frames[0] == frames[1], layer
    same = ["points.txt", "heights.tif", "labels.tif"]
    assert digests(folder, files=same) == digests(town, files=same)


def test_killed_run_goes_on_to_the_same_bytes(town, tmp_path):
    """SIGKILL to snakemake and its jobs in the middle; the same command with --nolock finishes alike."""
    folder = world(tmp_path / "killed")
    process = subprocess.Popen(
        command(folder, only=MAIN),
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not list(folder.glob("results/town/blocks/*/detected/pieces.parquet")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (folder / "results/town/city.gpkg").exists()
    run(folder, "--nolock", only=MAIN)
    assert digests(folder, files=MAIN) == digests(town, files=MAIN)


def test_bad_input_is_told_in_words(tmp_path):
    folder = world(tmp_path / "bad")
    done = subprocess.run(command(folder, raster="nowhere.tif"), cwd=folder, capture_output=True, text=True)
    assert done.returncode != 0
    assert "nowhere.tif" in done.stderr
    done = subprocess.run(command(folder, planes="clever"), cwd=folder, capture_output=True, text=True)
    assert done.returncode != 0
    assert "planes" in done.stderr


def test_names_with_spaces_and_accents(tmp_path):
    """Files may be called what their owners like; nothing is built from names by a shell."""
    folder = world(tmp_path / "été à la mer")
    shutil.move(folder / "town.tif", folder / "l'image; touch x.tif")
    run(folder, raster="l'image; touch x.tif", only=["city.gpkg", "run.json", "preview.png"])
    assert (folder / "results/town/city.gpkg").is_file()
    assert not (folder / "x.tif").exists()


def test_run_json_tells_models_and_counts(town):
    record = json.loads((town / "results/town/run.json").read_text())
    text = json.dumps(record)
    assert "CC0-1.0" in text
    assert hashlib.sha256((town / "models/sections.onnx").read_bytes()).hexdigest() in text


def test_edited_sections_rerun_from_the_planes(copy):
    """One section deleted by hand: the others keep their ids, and nothing is detected again."""
    layer = pyogrio.read_dataframe(copy / "results/town/city.gpkg", layer="roof_sections_image")
    layer.iloc[1:].to_file(copy / "edited.gpkg", layer="roof_sections_image")
    done = jobs(run(copy, sections="edited.gpkg", only=MAIN))
    assert {"edited", "planes", "ground", "buildings", "solids", "geopackage"} <= set(done)
    assert not {"scene", "tiles", "sections", "blend", "corners", "stitch"} & set(done)
    found = pyogrio.read_dataframe(copy / "results/town/city.gpkg", layer="roof_sections")
    assert sorted(found["section_id"]) == sorted(layer["section_id"].iloc[1:])


def test_heights_of_a_surface_model_need_no_corner_model(tmp_path):
    """Flat roofs of 12.5 m on ground at 100 m: the DSM says so, and so do the buildings."""
    folder = world(tmp_path / "dsm")
    with rasterio.open(folder / "town.tif") as source:
        shape, transform, crs = (source.height, source.width), source.transform, source.crs
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": crs, "transform": transform}
    with rasterio.open(folder / "dsm.tif", "w", height=shape[0], width=shape[1], **profile) as target:
        target.write(np.full((1, *shape), 112.5, np.float32))
    output = run(folder, dsm="dsm.tif", only=MAIN)
    assert not {"blend", "corners"} & set(jobs(output))
    found = pyogrio.read_dataframe(folder / "results/town/city.gpkg", layer="roof_sections")
    assert len(found) > 3
    assert np.abs(found["height_mean"] - 12.5).max() < 0.05
