"""Damaged intermediates are noticed when read and by `snakemake verify`, and made again to the same bytes."""

from __future__ import annotations

import os
import shlex
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from kibs_steps import sums, verify

KINDS = ("truncate", "flip", "empty", "swap", "delete")
READ_DTM = ("kibs_steps.planes", "kibs_steps.ground", "kibs_steps.solids", "kibs_steps.publish.rasters")


def intermediates(town) -> list[Path]:
    """The files that later steps read, relative to the town's folder."""
    found = [
        p.relative_to(town.folder)
        for p in sorted(town.results.rglob("*"))
        if p.is_file() and ".sums" not in p.parts and verify.intermediate(p, town.results)
    ]
    assert len(found) > 25
    return found


def damage(path: Path, kind: str, rng: np.random.Generator, others: list[Path]) -> list[Path]:
    """Do it; returns the files that are not what was written now."""
    size = path.stat().st_size
    if kind == "truncate":
        os.truncate(path, int(rng.integers(1, size)))
    elif kind == "empty":
        os.truncate(path, 0)
    elif kind == "delete":
        path.unlink()
    elif kind == "flip":
        content = bytearray(path.read_bytes())
        content[int(rng.integers(size))] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
    else:
        alike = [o for o in others if o != path and o.suffix == path.suffix and o.read_bytes() != path.read_bytes()]
        if not alike:
            return damage(path, "flip", rng, others)
        other = alike[int(rng.integers(len(alike)))]
        one, two = path.read_bytes(), other.read_bytes()
        path.write_bytes(two)
        other.write_bytes(one)
        return [path, other]
    return [path]


def readers(commands: list[list[str]], path: Path) -> list[list[str]]:
    """The commands that read a file: those that name it, or its folder, after the one that wrote it."""
    if path.name == "dtm.tif":
        return [c for c in commands if c[0] in READ_DTM]
    naming = [c for c in commands if str(path) in c]
    folder = [c for c in commands if str(path.parent) in c]
    return naming[1:] + folder


def notice(command: list[str], paths: list[Path]) -> str:
    """How a step that reads one of the files takes it: "noticed", or "not read" when it ends well without having changed it."""
    module = import_module(command[0])
    before = {p: p.read_bytes() for p in paths if p.exists()}
    told = None
    try:
        module.main(command[1:])
    except (sums.DamagedFile, sums.MissingFile) as error:
        told = str(error)
    if told is not None:
        assert told.startswith(tuple(map(str, paths)))
        assert "run the same command again" in told
        return "noticed"
    assert before == {p: p.read_bytes() for p in paths if p.exists()}
    return "not read"


def in_turn(town, monkeypatch, number: int, seed: int) -> dict[str, int]:
    """Damage file after file, each put back afterwards; how the steps that read it, and `verify`, took it."""
    monkeypatch.chdir(town.folder)
    rng = np.random.default_rng(seed)
    commands = [shlex.split(line) for line in (town.folder / "commands").read_text().splitlines()]
    files = intermediates(town)
    backup = town.folder / "backup"
    shutil.copytree("results/town", backup)
    told: dict[str, int] = {}
    for k in range(number):
        path = files[int(rng.integers(len(files)))]
        kind = KINDS[k % len(KINDS)]
        wrong = damage(path, kind, rng, files)
        found = {f.path for f in verify.findings(Path("results/town"), ["blended.tif"])[0]}
        assert found == set(wrong), f"{kind} {path}"
        using = readers(commands, path)
        if using:
            answer = notice(using[int(rng.integers(len(using)))], wrong)
            assert answer == "noticed", f"{kind} {path}"
            told[kind] = told.get(kind, 0) + 1
        for file in wrong:
            place = backup / file.relative_to("results/town")
            shutil.copy2(place, file)
            shutil.copy2(sums.place(place), sums.place(file))
    assert verify.findings(Path("results/town"), ["blended.tif"])[0] == []
    return told


def test_every_damage_is_noticed(copy, monkeypatch):
    told = in_turn(copy, monkeypatch, 40, seed=1)
    assert set(told) == set(KINDS)


@pytest.mark.long
def test_two_hundred_damages_are_noticed(copy, monkeypatch):
    told = in_turn(copy, monkeypatch, 200, seed=2)
    print(told)
    assert sum(told.values()) > 180


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(4, 14))])
def test_verify_takes_away_and_the_run_makes_again(undisturbed, copy, monkeypatch, seed):
    """Many damages at once, published files among them; with the long ones more than 200 in all."""
    monkeypatch.chdir(copy.folder)
    rng = np.random.default_rng(seed)
    files = intermediates(copy)
    chosen = [files[i] for i in rng.permutation(len(files))[: 12 if seed == 3 else 20]]
    wrong: set[Path] = set()
    for k, path in enumerate(chosen):
        if path not in wrong:
            wrong |= set(damage(path, KINDS[k % len(KINDS)], rng, [f for f in files if f not in wrong]))
    for name in ("city.gpkg", "heights.tif"):
        wrong |= set(damage(Path("results/town", name), "flip", rng, []))
    Path("results/town/.tmp-left").mkdir()  # of a step that was killed
    for name in (".tmp-left/plain.tif", "blocks/r000c000/.tmp-left"):
        Path("results/town", name).touch()
    done = copy.run("verify")
    assert done.returncode != 0
    assert not list(Path("results/town").rglob(".tmp-*"))
    last = done.stderr.strip().split("\n")[-1]
    assert last.startswith(f"error: verify: {len(wrong)} of "), done.stdout + done.stderr
    assert "start snakemake as before, without verify" in last
    for path in wrong:
        assert str(path) in done.stdout + done.stderr
        assert not path.exists()
    assert Path("results/town/city.gpkg.changed").exists()
    copy.finish()
    needed = {name: digest for name, digest in undisturbed.digests().items() if (copy.results / name).exists()}
    assert copy.digests() == needed
    assert {"city.gpkg", "heights.tif", "city.city.json"} <= set(needed)


def test_a_reader_takes_damage_away_and_the_same_command_mends_it(undisturbed, copy):
    """Nothing but the same command is asked of the user: it fails once, says so, and is then as before."""
    path = copy.results / "blocks/r000c000/planes.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    (copy.results / "blocks/r000c000/ground.parquet").unlink()
    done = copy.run()
    assert done.returncode != 0
    assert (
        "blocks/r000c000/planes.parquet is damaged (its checksum is wrong at byte 0): it is deleted now" in done.stderr
    )
    assert done.stderr.strip().split("\n")[-1].endswith("it goes on where this run stopped.") or "again" in done.stderr
    copy.finish()
    assert copy.digests() == undisturbed.digests()
