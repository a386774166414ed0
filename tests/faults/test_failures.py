"""What a failed run says, and when it is worth publishing the rest."""

from __future__ import annotations

import subprocess
import sys
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import pytest

from kibs_steps import cli, errors, failures, store, verify
from kibs_steps.failures import Failure

Block = namedtuple("Block", "name")
TOWN = SimpleNamespace(blocks=[Block("r000c000"), Block("r000c001")], left_out={})


@pytest.fixture
def nested(monkeypatch, tmp_path):
    """The command lines that would be run; each publishes what it was asked to."""
    asked = []

    def run(command, check):
        asked.append(command)
        store.write_json(tmp_path / "town/run.json", {"failed_blocks": store.read_json(tmp_path / "town/failed.json")})

    monkeypatch.setattr(subprocess, "run", run)
    return asked


def lost(reason="no luck", block="r000c001", step="sections") -> Failure:
    return Failure("town", block, step, "x.log", reason)


def test_one_block_lost(nested, tmp_path):
    argv = ["--cores", "2", "--config", "scene=town"]
    assert failures.publish_rest([lost()], {"town": TOWN}, argv, {"scene": "town"}, tmp_path)
    assert nested[0][3:] == [*argv, "--nolock", "--config", "scene=town", "leave_out=town/r000c001/sections"]
    told = failures.told([lost()], True, {"town": TOWN}, tmp_path).split("\n")
    assert told[0] == "error: town r000c001, sections: no luck (log: x.log)"
    assert told[1].startswith("1 of 2 blocks failed; the rest of the city is published")


@pytest.mark.parametrize(
    "found",
    [
        [Failure("town", "", "scene", "x.log", "bad raster")],
        [lost(), Failure("town", "", "stitch", "x.log", "boom")],
        [lost(f"x.parquet is damaged: {errors.AGAIN} and it is made again")],
        [lost(), lost(f"no space left: free some of the disk, then {errors.AGAIN}", "r000c000")],
        [lost(), lost(block="r000c000")],
    ],
    ids=["no block", "another job too", "damage", "a full disk", "every block"],
)
def test_nothing_to_publish(nested, tmp_path, found):
    assert not failures.publish_rest(found, {"town": TOWN}, [], {}, tmp_path)
    assert nested == []
    assert "is published" not in failures.told(found, False, {"town": TOWN}, tmp_path)


def test_a_scene_of_which_nothing_is_left_spoils_no_other(nested, tmp_path):
    """Town loses one of two blocks, hut its only one: town is published, hut is told and not tried again."""
    plans = {"hut": SimpleNamespace(blocks=[Block("r000c000")], left_out={}), "town": TOWN}
    found = [Failure("hut", "r000c000", "sections", "y.log", "no roof"), lost()]
    assert failures.publish_rest(found, plans, ["--cores", "2"], {}, tmp_path)
    assert [command[-2:] for command in nested] == [["scene=town", "leave_out=town/r000c001/sections"]]
    assert not (tmp_path / "hut").exists()
    told = failures.told(found, True, plans, tmp_path)
    assert "hut: all its blocks failed, so nothing of it is published" in told
    assert "1 of 2 blocks failed; the rest of the city is published" in told


def test_what_is_published_tells_why_blocks_failed_this_time(tmp_path):
    for name, reason in (("failed", "new"), ("run", "old")):
        record = {"r000c001": {"status": "failed", "reason": reason}}
        store.write_json(tmp_path / f"{name}.json", record if name == "failed" else {"failed_blocks": record})
    assert not failures._published(tmp_path)
    store.write_json(tmp_path / "run.json", {"failed_blocks": store.read_json(tmp_path / "failed.json")})
    assert failures._published(tmp_path)


def test_a_record_of_failures_goes_once_the_city_is_whole(tmp_path):
    store.write_json(tmp_path / failures.RECORD, {"r000c001": {}})
    failures.settle(tmp_path)  # nothing is published yet
    store.write_json(tmp_path / "run.json", {"failed_blocks": {"r000c001": {}}})
    failures.settle(tmp_path)
    assert store.read_json(tmp_path / failures.RECORD)
    store.write_json(tmp_path / "run.json", {"failed_blocks": {}})
    failures.settle(tmp_path)
    assert not (tmp_path / failures.RECORD).exists()
    assert not verify.findings(tmp_path)[0]


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        ("warning: x\nerror: first\nerror: last one\n", "last one"),
        ("Traceback (most recent call last):\n  File x\nValueError: odd\n", "ValueError: odd"),
        ("", "it was killed (out of memory, a time limit?)"),
    ],
)
def test_reasons(tmp_path, log, reason):
    (tmp_path / "a.log").write_text(log)
    assert failures.reason(tmp_path / "a.log") == reason
    assert failures.reason(tmp_path / "none.log") == "it was killed (out of memory, a time limit?)"


@pytest.mark.parametrize(
    ("error", "last", "traced"),
    [
        (errors.KibsError("say so"), "error: say so", False),
        (MemoryError(), "error: there is not enough memory", False),
        (ValueError("odd"), "error: ValueError (odd): a mistake in KIBS", True),
    ],
)
def test_the_last_line_is_ours(capsys, error, last, traced):
    def main():
        raise error

    with pytest.raises(SystemExit) as end:
        cli.run(main)
    said = capsys.readouterr().err
    assert end.value.code == 1
    assert said.strip().split("\n")[-1].startswith(last)
    assert ("Traceback" in said) == traced


def test_a_reader_that_has_seen_enough_is_no_fault(tmp_path):
    code = "from kibs_steps import cli; cli.run(lambda: print('x\\n' * 1_000_000))"
    done = subprocess.run(["bash", "-c", f'"{sys.executable}" -c "{code}" | head -1'], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("x\n", "")


def test_a_disk_that_is_full(tmp_path, monkeypatch):
    """Also when the library that writes does not notice; what was there stays."""
    store.write_json(tmp_path / "a.json", 1)
    monkeypatch.setattr(store.shutil, "disk_usage", lambda _: SimpleNamespace(free=10))
    with pytest.raises(store.DiskFull, match=r"no space left for .*a\.json: free some of the disk"):
        store.write_json(tmp_path / "a.json", 2)
    monkeypatch.undo()
    assert store.read_json(tmp_path / "a.json") == 1
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["a.json"]


def test_verify_leaves_a_users_files_alone(tmp_path):
    folder = tmp_path / "town"
    store.write_json(folder / "city.gpkg", {"old": 1})
    store.write_json(folder / "blocks/r0/planes.parquet", 1)
    (folder / "my project.qgz").write_text("mine")
    (folder / "city.gpkg").write_text("edited")
    (folder / "blocks/r0/stray.parquet").write_text("from nowhere")
    found, read = verify.findings(folder)
    assert read == 2
    verify.mend(found, folder)
    assert (folder / "my project.qgz").read_text() == "mine"
    assert (folder / "city.gpkg.changed").read_text() == "edited"
    assert not (folder / "city.gpkg").exists()
    assert [p.name for p in (folder / "blocks/r0").iterdir() if p.is_file()] == ["planes.parquet"]
    assert Path(folder, "city.gpkg.changed") not in {f.path for f in verify.findings(folder)[0]}


def test_verify_keeps_every_edit_and_asks_for_tiles_anew(tmp_path, monkeypatch):
    """A second edit does not replace the first; one damaged tile takes the list with it, for which alone a rule is asked."""
    folder = tmp_path / "town"
    for text in ("hours of work", "a touch"):
        store.write_json(folder / "city.gpkg", 1)
        (folder / "city.gpkg").write_text(text)
        verify.mend(verify.findings(folder)[0], folder)
    assert [(folder / f"city.gpkg{end}").read_text() for end in (".changed", ".2.changed")] == [
        "hours of work",
        "a touch",
    ]
    for name in ("tileset.json", "0_0.glb"):
        store.write_json(folder / "tiles3d" / name, 1)
    (folder / "tiles3d/0_0.glb").write_bytes(b"damaged")
    (folder / ".tmp-tiles3d").mkdir()
    (folder / ".tmp-tiles3d/.tmp-x-0_0.glb").write_bytes(b"left by a kill")
    with pytest.raises(verify.Damaged, match="1 of 2"):
        verify.main([str(folder)])
    assert sorted(p.name for p in (folder / "tiles3d").iterdir() if p.is_file()) == ["0_0.glb.changed"]
    assert not (folder / ".tmp-tiles3d").exists()


def test_the_rest_is_asked_for_as_the_whole_was():
    """`--config scene=` is every scene, not one called None."""
    words = failures.command(["all"], {"scene": None, "block": 2}, ["town/r0c0/sections"])
    assert {"scene=", "block=2", "leave_out=town/r0c0/sections"} <= set(words)
