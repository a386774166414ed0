"""A scene on a real Slurm of three nodes: a job fails and is submitted again, the run is killed and goes on, bytes are those of
a local run, blocks are worked on by all nodes."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cluster
import numpy as np
import pytest
import toy

ROOT = Path(__file__).parents[2]
SAME_BYTES = [
    "city.gpkg",
    "city.city.json",
    "city.city.jsonl",
    "points.txt",
    "heights.tif",
    "labels.tif",
    "preview.png",
]
SIZE = (280, 90)

LACKING = cluster.lacking()
if not importlib.util.find_spec("snakemake_executor_plugin_slurm"):
    LACKING.append("snakemake-executor-plugin-slurm")
pytestmark = pytest.mark.skipif(bool(LACKING), reason=f"not installed here: {', '.join(LACKING)}")


def world(folder: Path) -> Path:
    """A folder with a painted raster of three blocks and toy models."""
    folder.mkdir()
    toy.raster(folder / "town.tif", toy.paint(toy.houses(np.random.default_rng(5), *SIZE), *SIZE))
    toy.models(folder / "models")
    return folder


def command(*flags: str) -> list[str]:
    """Snakemake on the toy scene."""
    settings = {"scene": "town", "raster": "town.tif", "dtm": 100, "models": "models", "block": 2, **toy.VIEW}
    config = [f"{k}={v}" for k, v in settings.items()]
    files = [f"results/town/{name}" for name in SAME_BYTES]
    return [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), *files, *flags, "--config", *config]


SLURM = ["--profile", str(ROOT / "workflow/profiles/slurm"), "--slurm-no-account", "--latency-wait", "10", "--nolock"]
SLURM += ["--seconds-between-status-checks", "1", "--slurm-init-seconds-before-status-checks", "1"]


def digests(folder: Path) -> dict[str, str]:
    """sha256 of every published file that must not vary."""
    return {f: hashlib.sha256((folder / "results/town" / f).read_bytes()).hexdigest() for f in SAME_BYTES}


def watched_python(slurm: cluster.Cluster, fails_once: str) -> Path:
    """Let jobs call a `python` that notes node and command in the file returned, and fails once when told `fails_once`."""
    notes, failed = slurm.folder / "steps.txt", slurm.folder / "failed"
    slurm.script(
        "python",
        f'echo "$SLURMD_NODENAME $*" >> "{notes}"\n'
        f'case "$*" in {fails_once}) if mkdir "{failed}" 2>/dev/null; then echo "planned failure" >&2; exit 1; fi ;; esac\n'
        f'exec "{sys.executable}" "$@"',
    )
    return notes


def test_killed_run_with_a_failing_job_gives_the_bytes_of_a_local_run(tmp_path):
    folder = world(tmp_path / "remote")
    with cluster.Cluster(tmp_path / "slurm", nodes=3, cpus=2) as slurm:
        notes = watched_python(slurm, "*kibs_steps.solids*r000c001*")
        first = subprocess.Popen(
            command(*SLURM),
            cwd=folder,
            env=slurm.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        deadline = time.monotonic() + 240
        while not list(folder.glob("results/town/blocks/*/detected/pieces.parquet")) and time.monotonic() < deadline:
            assert first.poll() is None, "the run ended before it was killed"
            time.sleep(0.1)
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
        slurm.cancel()
        assert not (folder / "results/town/city.gpkg").exists()
        again = subprocess.run(command(*SLURM), cwd=folder, env=slurm.environment, capture_output=True, text=True)
        assert again.returncode == 0, again.stdout[-3000:] + again.stderr[-5000:]
        steps, states = notes.read_text().splitlines(), {job["JobState"] for job in slurm.ended()}
    assert (slurm.folder / "failed").is_dir()
    assert "FAILED" in states
    assert re.search(r"restart", again.stdout + again.stderr)
    nodes = {line.split()[0] for line in steps if "kibs_steps.sections" in line}
    assert nodes == {"n1", "n2", "n3"}
    local = world(tmp_path / "local")
    done = subprocess.run(command("--cores", "1"), cwd=local, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert digests(folder) == digests(local)
