"""Verify: is everything on disk what was written? Run as `snakemake verify`.

In: the folder of a scene. Every file is compared with its checksums (`sums`), so truncated, emptied, changed, swapped and
missing files are found, whole folders read once. Intermediate files that are damaged are deleted, and the next run makes them
again; a published file is set aside as NAME.changed, because a user may have edited it.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from kibs_steps import cli, sums
from kibs_steps.errors import KibsError

INTERMEDIATE = ("blocks", "stitched", "edited", "models", "simulated")
ALONE = ("scene.json", "dtm.tif", "supposed.json", "surface.tif", "truth.parquet", "buildings.parquet")
OTHERS = ("logs", "benchmarks")  # folders whose files nobody reads back
ASIDE = ".changed"
TILES = "tiles3d"


class Damaged(KibsError):
    """Files that are not what was written."""


class Finding(NamedTuple):
    """A file and what is wrong with it."""

    path: Path
    what: str


def intermediate(path: Path, folder: Path) -> bool:
    """Whether a file of a scene's folder is made for other steps and not for users."""
    place = path.relative_to(folder)
    return place.parts[0] in INTERMEDIATE or str(place) in ALONE


def findings(folder: Path, temporary: Iterable[str] = ()) -> tuple[list[Finding], int]:
    """All that is wrong in a scene's folder, and how many files were read.

    `temporary` are names of files that Snakemake deletes after use: they may be gone.
    """
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.relative_to(folder).parts[0] not in OTHERS)
    summed = {p.parent.parent / p.name for p in files if p.parent.name == sums.FOLDER}
    files = [p for p in files if p.parent.name != sums.FOLDER and not p.name.startswith(".")]
    found = [Finding(p, "it is gone") for p in summed if not p.exists() and p.name not in temporary]
    read = 0
    for path in files:
        if path in summed:
            read += 1
            what = sums.problem(path)
        else:
            what = "it has no checksums" if intermediate(path, folder) else None
        if what:
            found.append(Finding(path, what))
    return sorted(found), read


def mend(found: Iterable[Finding], folder: Path) -> None:
    """Take damaged files away, so that the next run makes them again; published ones are kept as NAME.changed."""
    for path, _ in found:
        if path.exists() and not intermediate(path, folder):
            path.replace(aside(path))
        sums.discard(path)
        if path.parent.name == TILES:  # which are made together with their list, that alone is asked for
            sums.discard(path.with_name("tileset.json"))


def aside(path: Path) -> Path:
    """A free name to keep a published file under: NAME.changed, else NAME.2.changed, and so on."""
    endings = itertools.chain([ASIDE], (f".{number}{ASIDE}" for number in itertools.count(2)))
    return next(name for ending in endings if not (name := path.with_name(path.name + ending)).exists())


def main(argv: list[str] | None = None) -> None:
    """Compare all files of scenes with their checksums, and take away what must be made again."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.verify", description=main.__doc__)
    parser.add_argument("folders", nargs="+", help="results/SCENE")
    parser.add_argument("--temporary", nargs="*", default=[], help="names of files that may be gone")
    args = parser.parse_args(argv)
    lines, total = [], 0
    for folder in map(Path, args.folders):
        found, read = findings(folder, args.temporary) if folder.is_dir() else ([], 0)
        for leftover in list(folder.rglob(".tmp-*")):
            shutil.rmtree(leftover, ignore_errors=True) if leftover.is_dir() else leftover.unlink(missing_ok=True)
        mend(found, folder)
        lines += [f"  {path}: {what}" for path, what in found]
        total += read
    if lines:
        print("\n".join(lines))
        raise Damaged(
            f"{len(lines)} of {total} files are not what was written; they are taken away (published ones are kept as "
            f"NAME{ASIDE}): start snakemake as before, without verify, and they are made again"
        )
    print(f"{total} files are what was written")


if __name__ == "__main__":
    cli.run(main)
