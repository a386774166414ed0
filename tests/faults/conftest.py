"""A small town of two blocks, undisturbed, and what all fault tests do with it."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import toy
from stepping import stepper

ROOT = Path(__file__).parents[2]
SIZE = (90, 48)


class Town(NamedTuple):
    """A folder to run the workflow in, and the environment of its steps."""

    folder: Path
    environment: dict[str, str]
    steps: Path

    @property
    def results(self) -> Path:
        return self.folder / "results/town"

    def command(self, *flags: str, cores: int = 1, **settings: object) -> list[str]:
        """The user's command."""
        base = {"scene": "town", "raster": "town.tif", "dtm": "dtm.tif", "models": "models", "block": 1}
        config = [f"{k}={v}" for k, v in {**base, **toy.VIEW, **settings}.items()]
        snakemake = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", str(cores)]
        return [*snakemake, *flags, "--config", *config]

    def start(self, *flags: str, **settings: object) -> subprocess.Popen:
        """Start it in a session of its own, so that all of it can be killed."""
        out = (self.folder / "output.txt").open("a")
        command = self.command(*flags, **settings)
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=out, stderr=out, start_new_session=True
        )

    def run(self, *flags: str, **settings: object) -> subprocess.CompletedProcess:
        """Run it to its end."""
        return subprocess.run(
            self.command(*flags, **settings), cwd=self.folder, env=self.environment, capture_output=True, text=True
        )

    def finish(self, *flags: str, **settings: object) -> str:
        """Run it to a good end; returns what it printed."""
        done = self.run(*flags, **settings)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-5000:]
        return done.stdout + done.stderr

    def digests(self) -> dict[str, str]:
        """sha256 of every file of the results but those that may differ."""
        return {
            str(p.relative_to(self.results)): hashlib.sha256(p.read_bytes()).hexdigest()
            for p in sorted(self.results.rglob("*"))
            if p.is_file()
            and p.relative_to(self.results).parts[0] not in ("logs", "benchmarks", "run.json", "report.html")
            and ".sums" not in p.parts
            and p.suffix != ".changed"
            and not p.name.endswith(".aux.xml")  # GDAL's, left by whoever reads a layer
            and not any(part.startswith(".tmp-") for part in p.parts)  # left by a killed step, read by none
        }

    def fault(self, **what: str) -> None:
        """From now on these go wrong: `sections_r000c001="kill"`; none without arguments."""
        content = {key.replace("_", " ", 1): fault for key, fault in what.items()}
        (self.steps / "faults.json").write_text(json.dumps(content))

    def seen(self) -> str:
        """The commands of all steps started since this was asked for last."""
        path = self.steps / "seen"
        text = path.read_text() if path.exists() else ""
        path.write_text("")
        return text


def lay_out(folder: Path) -> Path:
    """The raster, terrain and models of the town."""
    toy.raster(folder / "town.tif", toy.paint(toy.houses(np.random.default_rng(5), *SIZE), *SIZE))
    import rasters

    heights = np.fromfunction(lambda i, j: 100 + 0.02 * j, (320, 330)).astype("float32")
    rasters.dtm(folder / "dtm.tif", heights, toy.X0 - 300, toy.Y0 + 300)
    toy.models(folder / "models")
    return folder


@pytest.fixture(scope="session")
def warm(tmp_path_factory):
    """The process that steps are forked from."""
    folder = tmp_path_factory.mktemp("steps")
    with stepper(folder) as environment:
        yield environment, folder


@pytest.fixture(scope="session")
def undisturbed(warm, tmp_path_factory) -> Town:
    """A finished run that tests copy or look at, never change."""
    environment, steps = warm
    town = Town(lay_out(tmp_path_factory.mktemp("town")), environment, steps)
    town.finish()
    (town.folder / "commands").write_text(town.seen())
    return town


@pytest.fixture
def copy(undisturbed, tmp_path) -> Town:
    """A finished run to play with."""
    folder = tmp_path / "copy"
    shutil.copytree(undisturbed.folder, folder, copy_function=shutil.copy2)
    undisturbed.seen()
    undisturbed.fault()
    return undisturbed._replace(folder=folder)


@pytest.fixture
def fresh(undisturbed, tmp_path) -> Town:
    """The town's inputs without results."""
    undisturbed.seen()
    undisturbed.fault()
    (tmp_path / "fresh").mkdir()
    return undisturbed._replace(folder=lay_out(tmp_path / "fresh"))
