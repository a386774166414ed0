"""Steps for fault injection: a `python` for the workflow's rules whose steps start in milliseconds and fail on demand.

Run as a script it is a server that has imported every step and forks a process for each `python -m kibs_steps.…` that the
`python` beside it (first in PATH) passes on: the same code on the same files, without two seconds of imports a job. A step whose
caller is killed is killed with it. `faults.json` in the server's folder says what goes wrong: {"sections r000c001": "kill"}.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import stat
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

MODULES = (
    "scene tiles sections blend corners truth feed stitch planes ground buildings solids evaluate verify check models.contract "
    "publish.geopackage publish.cityjson publish.points publish.rasters publish.preview publish.run publish.glb publish.obj "
    "publish.tiles3d publish.ksr publish.dsm publish.viewer"
)

CALLER = """#!{python} -IS
import json, os, shlex, socket, sys
if sys.argv[1:2] != ["-m"]:
    os.execv({python!r}, sys.argv)
with open({folder!r} + "/seen", "a") as seen:
    seen.write(shlex.join(sys.argv[2:]) + "\\n")
caller = socket.socket(socket.AF_UNIX)
caller.connect({folder!r} + "/socket")
socket.send_fds(caller, [json.dumps([sys.argv[2:], os.getcwd()]).encode()], [1, 2])
answer = caller.recv(16)
code = int(answer) if answer else 1
if code < 0:
    os.kill(os.getpid(), -code)
sys.exit(code)
"""


def step(argv: list[str], folder: Path) -> int:
    """Run a step in this process; returns the exit code."""
    from kibs_steps import cli

    name, sys.argv = argv[0].removeprefix("kibs_steps."), argv
    with contextlib.suppress(FileNotFoundError):
        for what, fault in json.loads((folder / "faults.json").read_text()).items():
            rule, _, block = what.partition(" ")
            if rule == name and (not block or block in argv):
                strike(fault)
    try:
        cli.run(import_module(f"kibs_steps.{name}").main)
    except SystemExit as end:
        return int(end.code or 0)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def strike(fault: str) -> None:
    """Go wrong as asked: die, fail, or find the disk full at the first file written."""
    if fault == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "full":
        os.replace = refuse
        return
    print(f"error: {fault}", file=sys.stderr, flush=True)
    os._exit(1)


def refuse(*_: object) -> None:
    """`os.replace` on a full disk."""
    raise OSError(28, "No space left on device")


def serve(folder: Path) -> None:
    """Fork a keeper for every caller, until the folder's socket goes away."""
    for name in MODULES.split():
        with contextlib.suppress(ModuleNotFoundError):
            import_module(f"kibs_steps.{name}")
    import geopandas  # noqa: F401 (steps import it where they use it)
    import onnxruntime  # noqa: F401

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(folder / "socket"))
    server.listen(64)
    print("ready", flush=True)
    while (folder / "socket").exists():
        if not select.select([server], [], [], 1.0)[0]:
            continue
        caller, _ = server.accept()
        if os.fork() == 0:
            server.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            keep(caller, folder)
        caller.close()


def keep(caller: socket.socket, folder: Path) -> None:
    """Run one step in a child and tell its caller how it ended; a caller that is gone ends it."""
    message, files, _, _ = socket.recv_fds(caller, 1 << 20, 2)
    argv, place = json.loads(message)
    child = os.fork()
    if child == 0:
        caller.close()
        os.chdir(place)
        for number, file in enumerate(files, 1):
            os.dup2(file, number)
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
        code = step(argv, folder)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    handle = os.pidfd_open(child)
    if caller in select.select([handle, caller], [], [])[0]:
        os.kill(child, signal.SIGKILL)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    with contextlib.suppress(BrokenPipeError):
        caller.send(str(os.waitstatus_to_exitcode(status)).encode())
    os._exit(0)


@contextlib.contextmanager
def stepper(folder: Path) -> Iterator[dict[str, str]]:
    """The environment for a Snakemake whose steps come from a warm process; `folder` takes `seen` and `faults.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    caller = folder / "bin/python"
    caller.parent.mkdir(exist_ok=True)
    caller.write_text(CALLER.format(python=sys.executable, folder=str(folder)))
    caller.chmod(caller.stat().st_mode | stat.S_IXUSR)
    single = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    server = subprocess.Popen(
        [sys.executable, __file__, str(folder)], stdout=subprocess.PIPE, env={**os.environ, **single}
    )
    try:
        assert server.stdout.readline() == b"ready\n"
        yield {**os.environ, **single, "PATH": f"{caller.parent}{os.pathsep}{os.environ['PATH']}"}
    finally:
        (folder / "socket").unlink(missing_ok=True)
        server.wait(30)


def wait_for(seen: Path, what: str, seconds: float) -> bool:
    """Wait until a step whose command holds `what` has started."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if seen.exists() and what in seen.read_text():
            return True
        time.sleep(0.01)
    return False


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
