"""Failures: what went wrong in a run, in words, and the rest of the city published without the blocks that failed.

Jobs fail honestly, so nothing half-made looks like a result. When Snakemake has done what it could, the same command runs
once more with `leave_out=SCENE/BLOCK/STEP,…`: the plan leaves those blocks out from that step on, and the signatures say so.
The next run of the user's command plans with all blocks again; whatever was made without one then has another signature.

A failure whose message ends in "run the same command again" (a damaged file, a full disk) is not the block's: nothing is
published without it.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from kibs_steps import store, sums
from kibs_steps.errors import AGAIN, KibsError
from kibs_steps.plan import BLOCK_STEPS, Plan

LONGEST = 400  # characters of a reason
RECORD = "failed.json"


class Failure(NamedTuple):
    """A job that failed for good: its scene and block ("" where it has none), step, log and the reason it gave."""

    scene: str
    block: str
    step: str
    log: str
    reason: str

    @property
    def of_block(self) -> bool:
        """Whether the city can do without: one block failed, and by its own fault."""
        return self.step in BLOCK_STEPS and AGAIN not in self.reason


def reason(log: str | Path | None) -> str:
    """Why a job failed, from its log: the last error it told of, else its last line."""
    try:
        lines = Path(log).read_text(encoding="utf-8", errors="replace").split("\n") if log else []
    except OSError:
        lines = []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    said = errors or [line for line in lines if line.strip()]
    return said[-1].strip()[:LONGEST] if said else "it was killed (out of memory, a time limit?)"


def of_jobs(jobs: Iterable[Any]) -> list[Failure]:
    """Snakemake's failed jobs as failures, in order of scene, block and step."""
    found = []
    for job in jobs:
        for single in getattr(job, "jobs", [job]):
            wildcards = single.wildcards_dict
            log = str(single.log[0]) if len(single.log) else ""
            found.append(
                Failure(wildcards.get("scene", ""), wildcards.get("block", ""), single.name, log, reason(log or None))
            )
    return sorted(found)


def command(argv: list[str], config: dict[str, Any], leave_out: Iterable[str]) -> list[str]:
    """The command line `argv` once more, for the rest of the city; `config` is what `--config` gave it."""
    values = {**config, "leave_out": ",".join(sorted(leave_out))}
    text = [
        f"{key}={value!r}" if isinstance(value, (list, dict)) else f"{key}={'' if value is None else value}"
        for key, value in values.items()
    ]
    return [sys.executable, "-m", "snakemake", *argv, "--nolock", "--config", *text]


def publish_rest(
    found: list[Failure], plans: dict[str, Plan], argv: list[str], config: dict[str, Any], results: Path
) -> bool:
    """Publish every scene without its failed blocks; whether that was worth trying and went well."""
    gone = wholly_lost(found, plans)
    lost = [f for f in found if f.of_block and f.scene not in gone]
    by_scene = {f.scene for f in lost}
    if not lost or any(f.scene in by_scene and not f.of_block for f in found):
        return False
    leave_out = [f"{name}/{block}/{step}" for name, p in plans.items() for block, step in p.left_out.items()]
    for name in by_scene:
        path = results / name / RECORD
        known = store.read_json(path) if plans[name].left_out and path.is_file() else {}
        known |= {f.block: {"status": "failed", "reason": f"{f.step}: {f.reason}"} for f in lost if f.scene == name}
        store.write_json(path, dict(sorted(known.items())))
        leave_out += [f"{f.scene}/{f.block}/{f.step}" for f in lost if f.scene == name]
    print("Some blocks failed: the rest of the city is published without them.", file=sys.stderr, flush=True)
    # A scene of which nothing is left is not tried again: of several the others are made one by one.
    for only in [{"scene": name} for name in plans if name not in gone] if gone else [{}]:
        subprocess.run(command(argv, {**config, **only}, leave_out), check=False)
    # That run fails too where it lost blocks of its own and published the rest without them: the record tells.
    return all(_published(results / name) for name in by_scene)


def settle(folder: Path) -> None:
    """Forget which blocks of a scene failed once what is published is made with all of them."""
    try:
        whole = not store.read_json(folder / "run.json")["failed_blocks"]
    except (OSError, KibsError, KeyError):
        return
    if whole:
        sums.discard(folder / RECORD)


def wholly_lost(found: list[Failure], plans: dict[str, Plan]) -> set[str]:
    """The scenes of which no block is left."""
    lost = Counter(f.scene for f in found if f.of_block)
    return {name for name, p in plans.items() if lost[name] and lost[name] + len(p.left_out) >= len(p.blocks)}


def _published(folder: Path) -> bool:
    """Whether what is published says itself that it is made without the blocks that failed."""
    try:
        record = store.read_json(folder / "run.json")
        return record["failed_blocks"] == store.read_json(folder / RECORD)
    except KibsError:
        return False


def told(found: list[Failure], published: bool, plans: dict[str, Plan], results: Path) -> str:
    """The last lines of a failed run: what, where, what to do."""
    lines = []
    for f in found:
        where = " ".join(part for part in (f.scene, f.block) if part)
        log = f" (log: {f.log})" if f.log else ""
        lines.append(f"error: {where + ', ' if where else ''}{f.step}: {f.reason}{log}")
    gone = wholly_lost(found, plans)
    lost = sum(f.of_block and f.scene not in gone for f in found) if published else sum(f.of_block for f in found)
    if published:
        lines += [f"error: {name}: all its blocks failed, so nothing of it is published" for name in sorted(gone)]
        total = sum(len(plans[name].blocks) for name in {f.scene for f in found if f.of_block} - gone)
        lines.append(
            f"{lost} of {total} blocks failed; the rest of the city is published in {results}/, with these blocks marked in "
            "layer `blocks` of city.gpkg and in run.json. Run the same command again to try them again."
        )
    elif lost:
        lines.append("Mend the cause, then run the same command again: it goes on where this run stopped.")
    return "\n".join(lines)
