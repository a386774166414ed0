"""SIGKILL at random moments, to a step or to everything: the same command (with --nolock) ends in the same bytes."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest
from stepping import wait_for

RULES = [
    "scene", "models.contract", "tiles", "sections", "blend", "corners", "stitch", "planes", "ground", "buildings", "solids",
    "publish.geopackage", "publish.cityjson", "publish.points", "publish.rasters", "publish.preview", "publish.glb",
    "publish.obj", "publish.tiles3d", "publish.dsm", "publish.ksr", "publish.viewer", "publish.run",
]  # fmt: skip


def kill_when(town, rule: str, delay: float, everything: bool) -> bool:
    """Start the run and kill it, or just the step, `delay` seconds after a step of that rule has started; whether it was hit."""
    town.seen()
    process = town.start("--nolock")
    end = time.monotonic() + 600
    hit = False
    while not hit and process.poll() is None and time.monotonic() < end:
        hit = wait_for(town.steps / "seen", f"kibs_steps.{rule} ", 0.2)
    time.sleep(delay)
    if everything:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    else:
        for pid in children(process.pid):
            os.kill(pid, signal.SIGKILL)
    process.wait()
    return hit


def children(session: int) -> list[int]:
    """The callers of steps that run in a session."""
    found = []
    for entry in os.listdir("/proc"):
        try:
            if entry.isdigit() and os.getsid(int(entry)) == session:
                with open(f"/proc/{entry}/cmdline", "rb") as file:
                    words = file.read().split(b"\0")
                if b"-IS" in words and any(word.startswith(b"kibs_steps.") for word in words):
                    found.append(int(entry))
        except (OSError, ProcessLookupError):
            continue
    return found


def test_five_kills_in_one_run(undisturbed, fresh):
    """Each time later in the run, and once more from there; then the last one goes through."""
    rng = np.random.default_rng(1)
    for rule in ("scene", "sections", "corners", "planes", "publish.geopackage"):
        assert kill_when(fresh, rule, float(rng.uniform(0, 0.3)), everything=True), rule
    fresh.finish("--nolock")
    assert fresh.digests() == undisturbed.digests()


@pytest.mark.long
@pytest.mark.parametrize("number", range(3 * len(RULES)))
def test_one_of_many_kills(undisturbed, fresh, number):
    """Every rule three times, twice with everything round it."""
    rng = np.random.default_rng(number)
    rule, everything = RULES[number % len(RULES)], number // len(RULES) != 1
    assert kill_when(fresh, rule, float(rng.exponential(0.15)), everything)
    fresh.finish("--nolock")
    assert fresh.digests() == undisturbed.digests()


def test_a_killed_step_is_tried_again(undisturbed, fresh):
    """Nobody has to start anything: the rules of blocks have a second attempt."""
    process = fresh.start()
    assert wait_for(fresh.steps / "seen", "kibs_steps.sections ", 600)
    for pid in children(process.pid):
        os.kill(pid, signal.SIGKILL)
    process.wait()
    assert (fresh.results / "city.gpkg").exists()
    assert fresh.digests() == undisturbed.digests()
