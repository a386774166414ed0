"""`snakemake train` on a small user-style data set, and the workflow with what it made on another raster."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyogrio
import pytest

pytest.importorskip("torch", reason="training needs the extra `learn` (torch)")
pytest.importorskip("pycocotools", reason="training needs the extra `learn` (pycocotools)")

from kibs_steps.models import contract
from kibs_steps.simulate import scene as simulation

ROOT = Path(__file__).parents[2]
ANGLES = {"view_azimuth": 120.0, "view_elevation": 65.0, "sun_azimuth": 155.0, "sun_elevation": 45.0}


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", "1", *words],
        cwd=folder,
        capture_output=True,
        text=True,
    )


def snakemake(folder: Path, *words: str) -> str:
    done = run(folder, *words)
    logs = "".join(f"{p}:\n{p.read_text()}" for p in folder.glob("runs/*/logs/*.log"))
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:] + logs[-3000:]
    return done.stdout + done.stderr


def test_train_on_own_data_then_build_another_raster(tmp_path):
    import torch

    for name, seed in (("known", 3), ("new", 4)):
        angles = [f"--{k.replace('_', '-')}={v}" for k, v in ANGLES.items()]
        size = [f"--seed={seed}", "--size=340", "--style=suburb", f"--out={tmp_path / name}"]
        simulation.main([*size, *angles])
    scene = {"raster": "known/scene.tif", "dtm": "known/dtm.tif", "truth": "known/truth.gpkg", **ANGLES}
    train = {
        "name": "town",
        "own": ["known"],
        "split": "shuffle",
        "tiles": 0,
        "steps": 20,
        "minutes": 30,
        "joins": 2,
        "lifts": 2,
    }
    train |= {"scene": "known", "thresholds": {"surer": 0.7}}
    # A scene's models are looked for when Snakemake starts, so the configuration of training names the shipped ones.
    (tmp_path / "config.yaml").write_text(json.dumps({"scenes": {"known": scene}, "train": train}))
    snakemake(tmp_path, "train")
    record = json.loads((tmp_path / "runs/town/own/known/own.json").read_text())
    assert record["split"] | {"tiles": 0} == {
        "rule": "shuffle",
        "seed": 0,
        "shares": [0.6, 0.2, 0.2],
        "tile": 320,
        "tiles": 0,
    }
    for task in ("sections", "corners", "both"):
        made = contract.load(tmp_path / "models/town" / f"{task}.onnx", task)
        trained = made.contract["trained_on"]
        assert made.contract["thresholds"].get("surer") == (0.7 if task != "corners" else None)
        assert trained["data"] == ["own samples: known", "made to look like known"]
        assert trained["view_elevation"] == [62.0, 68.0]
        assert "owner" in trained["licence"]
        if task != "sections":
            assert made.contract["heights"]["fallback"] == round(record["corners"]["mean_height"], 2)
    assert "own samples: known" in (tmp_path / "models/town/README.md").read_text()
    assert (tmp_path / "models/town/curves.png").stat().st_size > 1000
    assert json.loads((tmp_path / "runs/town/both/done.json").read_text())["steps"] == 20

    # A set that goes on from this one, taught by another that lies beside it, makes nothing of either anew.
    (tmp_path / "models/teacher").mkdir()
    shutil.copy(ROOT / "models/free/sections.onnx", tmp_path / "models/teacher/sections.onnx")
    own = [{"scene": "known", "guess": "teacher"}]
    more = {**train, "name": "again", "init": "town", "own": own, "steps": 2}
    (tmp_path / "more.yaml").write_text(json.dumps({"scenes": {"known": scene}, "train": more}))
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "models").glob("*/*")}
    snakemake(tmp_path, "runs/again/both/done.json", "--configfile", "more.yaml")
    assert made == {path: path.stat().st_mtime_ns for path in (tmp_path / "models").glob("*/*")}
    assert json.loads((tmp_path / "runs/again/both/done.json").read_text())["steps"] == 2
    licence = json.loads((tmp_path / "runs/again/own/known/own.json").read_text())["licence"]
    assert "CC BY-SA 4.0" in licence
    # Trained anew, the set it started from is another: what was made from the old one does not pass for new.
    first = tmp_path / "runs/town/both/checkpoint.pt"
    torch.save({**torch.load(first, weights_only=True), "step": 21}, first)
    assert run(tmp_path, "runs/again/both/done.json", "--configfile", "more.yaml").returncode != 0
    assert "started from other weights" in (tmp_path / "runs/again/logs/training_both.log").read_text()
    assert (tmp_path / "runs/again/both/checkpoint.pt").is_file()

    other = {**scene, **{key: scene[key].replace("known", "new") for key in ("raster", "dtm", "truth")}}
    given = [f"{k}={v}" for k, v in {**other, "scene": "new", "models": "models/town", "method": "single"}.items()]
    snakemake(tmp_path, "results/new/city.gpkg", "results/new/evaluation.json", "--config", *given)
    assert (tmp_path / "results/new/evaluation.json").is_file()
    assert {"roof_sections", "buildings"} <= {
        name for name, _ in pyogrio.list_layers(tmp_path / "results/new/city.gpkg")
    }
    refused = run(tmp_path, "-n", "--config", *given, "view_elevation=80")
    assert refused.returncode != 0
    assert "outside what it was trained on" in refused.stdout + refused.stderr


@pytest.mark.long
def test_training_killed_without_warning_goes_on_from_its_last_checkpoint(tmp_path):
    import torch

    simulation.main(["--seed=3", "--size=340", "--style=suburb", f"--out={tmp_path / 'known'}"])
    scene = {"raster": "known/scene.tif", "dtm": "known/dtm.tif", "truth": "known/truth.gpkg"}
    train = {"name": "town", "own": ["known"], "split": "shuffle", "tiles": 0, "steps": 250, "minutes": 60}
    (tmp_path / "config.yaml").write_text(json.dumps({"scenes": {"known": scene}, "train": train}))
    run = tmp_path / "runs/town/both"
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", "2", "train"]
    first = subprocess.Popen(command, cwd=tmp_path, start_new_session=True, stderr=subprocess.DEVNULL)
    while not (run / "checkpoint.pt").exists():
        assert first.poll() is None
        time.sleep(0.5)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    kept = torch.load(run / "checkpoint.pt", weights_only=True)["step"]
    assert 0 < kept < 250

    snakemake(tmp_path, "train", "--nolock", "--rerun-incomplete")
    assert json.loads((run / "done.json").read_text())["steps"] == 250
    said = [
        int(n) for n in re.findall(r"^step (\d+) ", (tmp_path / "runs/town/logs/training_both.log").read_text(), re.M)
    ]
    assert said == [n for n in range(50, 251, 50) if n > kept]


def test_what_is_wrong_with_training_stops_no_other_run(tmp_path):
    simulation.main(["--size=70", f"--out={tmp_path / 'a'}", "--seed=3", "--style=suburb"])
    scene = {"raster": "a/scene.tif", "dtm": "a/dtm.tif", **ANGLES}
    train = {"name": "town", "init": "nowhere", "tiles": 5}
    (tmp_path / "config.yaml").write_text(json.dumps({"scenes": {"known": scene}, "train": train}))
    built = run(tmp_path, "-n", "--config", "scene=known")
    assert built.returncode == 0, built.stdout + built.stderr
    refused = run(tmp_path, "-n", "train")
    assert refused.returncode
    assert "train.init: nowhere" in refused.stdout + refused.stderr
