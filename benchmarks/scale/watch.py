"""Watching a command: wall time, CPU time and peak memory of every process it starts, and the disk it uses.

Read from /proc ten times a second; a process's memory is its high-water mark (VmHWM), so nothing is missed but what a
process did in its last tenth of a second.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

TICK = os.sysconf("SC_CLK_TCK")


def processes(root: int) -> dict[int, tuple[str, float, float]]:
    """Step name, CPU seconds and peak MB of the process `root` and all below it."""
    parent, cpu = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                stat = (entry / "stat").read_text().rsplit(")", 1)[1].split()
                parent[int(entry.name)] = int(stat[1])
                cpu[int(entry.name)] = (int(stat[11]) + int(stat[12])) / TICK
    found = {}
    for pid in parent:
        above = pid
        while above not in (root, 0, 1) and above in parent:
            above = parent[above]
        if above == root:
            with contextlib.suppress(OSError):
                peak = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
                words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
                found[pid] = step_of(words), cpu[pid], int(peak.group(1)) / 1024 if peak else 0.0
    return found


def step_of(words: list[str]) -> str:
    """The step a command line runs: `sections` for python -m kibs_steps.sections; "" for a shell."""
    if "-m" in words and words.index("-m") + 1 < len(words):
        return words[words.index("-m") + 1].removeprefix("kibs_steps.")
    return ""


def used(folder: Path) -> int:
    """Bytes on disk below a folder."""
    total = 0
    for base, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.stat(os.path.join(base, name)).st_blocks * 512
    return total


def watched(command: list[str], folder: Path, log: Path, nice: int = 0) -> dict[str, Any]:
    """Run a command in a folder to its end; returns wall and CPU seconds, peak MB per step, jobs, peak bytes on disk."""
    start, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    seen: dict[int, tuple[str, float, float]] = {}
    with log.open("w") as out:
        process = subprocess.Popen(
            command, cwd=folder, stdout=out, stderr=subprocess.STDOUT, preexec_fn=lambda: os.nice(nice)
        )
        disk = [0]
        done = threading.Event()

        def look_at_disk() -> None:
            while not done.wait(2.0):
                disk[0] = max(disk[0], used(folder))

        looker = threading.Thread(target=look_at_disk, daemon=True)
        looker.start()
        while process.poll() is None:
            for pid, fact in processes(process.pid).items():
                if fact[0] or pid not in seen:
                    seen[pid] = fact
            time.sleep(0.1)
        done.set()
        looker.join()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    steps: dict[str, dict[str, float]] = {}
    for name, cpu, peak in seen.values():
        step = steps.setdefault(name or "shell", {"jobs": 0, "cpu": 0.0, "peak_mb": 0.0})
        step["jobs"] += 1
        step["cpu"] = round(step["cpu"] + cpu, 2)
        step["peak_mb"] = round(max(step["peak_mb"], peak), 1)
    return {
        "code": process.returncode,
        "wall": round(time.monotonic() - start, 2),
        "cpu": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 2),
        "peak_mb": max((s["peak_mb"] for s in steps.values()), default=0.0),
        "disk": max(disk[0], used(folder)),
        "free": shutil.disk_usage(folder).free,
        "steps": dict(sorted(steps.items(), key=lambda item: -item[1]["cpu"])),
    }
