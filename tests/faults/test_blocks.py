"""A block that fails is retried and reported, the rest of the city is published, and the same command completes it."""

from __future__ import annotations

import json

import pyogrio
import pytest


def last_lines(text: str, n: int = 2) -> list[str]:
    return text.strip().split("\n")[-n:]


@pytest.mark.parametrize(("step", "fault"), [("sections", "no luck today"), ("solids", "kill")])
def test_the_rest_is_published(undisturbed, fresh, step, fault):
    fresh.fault(**{f"{step}_r000c001": fault})
    done = fresh.run()
    assert done.returncode != 0
    said = "no luck today" if fault != "kill" else "it was killed"
    first, last = last_lines(done.stderr)
    assert first.startswith(f"error: town r000c001, {step}: {said}")
    assert f"results/town/logs/{step}/r000c001.log" in first
    assert last.startswith("1 of 2 blocks failed; the rest of the city is published in results/")
    assert fresh.seen().count(f"kibs_steps.{step} ") >= 3, "the block is tried twice, the other once"

    blocks = pyogrio.read_dataframe(fresh.results / "city.gpkg", layer="blocks").set_index("block")
    assert blocks.status.to_dict() == {"r000c000": "ok", "r000c001": "failed"}
    assert said in blocks.reason["r000c001"]
    record = json.loads((fresh.results / "run.json").read_text())
    assert list(record["failed_blocks"]) == ["r000c001"]
    whole = pyogrio.read_dataframe(undisturbed.results / "city.gpkg", layer="buildings")
    rest = pyogrio.read_dataframe(fresh.results / "city.gpkg", layer="buildings")
    assert 0 < len(rest) < len(whole)

    partial = fresh.digests()
    again = fresh.run()
    assert again.returncode != 0
    assert "1 of 2 blocks failed" in last_lines(again.stderr)[-1]
    started = [line for line in fresh.seen().split("\n") if line and "models.contract" not in line]
    assert {line.split()[0] for line in started} == {f"kibs_steps.{step}"}, "nothing else is made again"
    assert fresh.digests() == partial

    fresh.fault()
    fresh.finish()
    assert fresh.digests() == undisturbed.digests()


def test_a_section_cut_by_a_missing_block_says_so(undisturbed, fresh):
    fresh.fault(tiles_r000c000="cannot read")
    assert fresh.run().returncode != 0
    sections = pyogrio.read_dataframe(fresh.results / "city.gpkg", layer="roof_sections_image")
    blocks = pyogrio.read_dataframe(fresh.results / "city.gpkg", layer="blocks").set_index("block")
    cut = sections[sections.distance(blocks.geometry["r000c000"]) < 0.01]
    assert set(cut.status) == {"cloud_or_nodata"}


def test_a_full_disk_is_told_and_the_same_command_goes_on(undisturbed, fresh):
    """No block is given up for it: the city without it would be just as much in want of room."""
    fresh.fault(planes_r000c000="full")
    done = fresh.run()
    assert done.returncode != 0
    assert "no space left for results/town/blocks/r000c000/planes.parquet: free some of the disk" in done.stderr
    assert last_lines(done.stderr, 1)[0].startswith(("error: town r000c000, planes: no space left", "Mend the cause"))
    assert not (fresh.results / "city.gpkg").exists()
    fresh.fault()
    fresh.finish()
    assert fresh.digests() == undisturbed.digests()
