"""The conda environments hold what pyproject.toml asks for, with the same lower bounds."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONDA_NAME = {"torch": "pytorch"}
DRIVES_THE_JOBS = {"snakemake"}  # runs outside the jobs' environments


def parsed(requirements):
    """Name to lower bound."""
    pairs = (re.fullmatch(r"([\w-]+)\s*>=\s*([\w.]+)", r.strip()) for r in requirements)
    return {m[1]: m[2] for m in pairs if m}


def listed(name):
    entries = yaml.safe_load((ROOT / "envs" / f"{name}.yaml").read_text())["dependencies"]
    flat = [e for e in entries if isinstance(e, str)]
    return parsed(flat + [p for e in entries if isinstance(e, dict) for p in e["pip"]])


@pytest.mark.parametrize(("env", "extra"), [("run", []), ("learn", PROJECT["optional-dependencies"]["learn"])])
def test_environment_matches_pyproject(env, extra):
    wanted = {
        CONDA_NAME.get(k, k): v for k, v in parsed(PROJECT["dependencies"] + extra).items() if k not in DRIVES_THE_JOBS
    }
    found = listed(env)
    assert found.pop("python") == PROJECT["requires-python"].removeprefix(">=")
    assert found == wanted
    script = (ROOT / "envs" / f"{env}.post-deploy.sh").read_text()
    assert "pip install --no-deps ." in script
