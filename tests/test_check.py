"""`snakemake check` tells grid, models, time, disk and doubts, and writes nothing."""

from __future__ import annotations

from pathlib import Path

import good_inputs
import numpy as np
import pytest
import yaml

from kibs_steps import check, plan

SCHEMA = yaml.safe_load((Path(__file__).parents[1] / "workflow/schemas/config.schema.yaml").read_text())
STEPS = ("tiles", "sections", "corners", "planes", "ground", "solids")


def test_a_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = {**good_inputs.good(tmp_path), "dtm": 30}
    ((name, values),) = plan.scenes(config, SCHEMA).items()
    planned = plan.plan(name, values, tmp_path, tmp_path / "results")
    before = {p for p in tmp_path.rglob("*") if "fingerprints" not in p.name}
    text = check.page(planned, tmp_path / "results", dict.fromkeys(STEPS, len(planned.blocks)))
    assert {p for p in tmp_path.rglob("*") if "fingerprints" not in p.name} == before
    for told in ("110 x 90 px of 0.38 m in EPSG:32631", "6 tiles in 2 blocks", "licence CC0-1.0", "5.9 m from where it stands",
                 "sections 2", "one core", "results/s", "level at 30 m", "no truth is given"):  # fmt: skip
        assert told in text, told
    done = check.page(planned, tmp_path / "results", dict.fromkeys(STEPS, 0))
    assert "nothing: all blocks are made" in done


def test_only_what_a_run_does_is_timed(tmp_path, monkeypatch):
    """As many looks as the scene gets, told its view; no 3D model where a surface model gives the heights."""
    config = {**good_inputs.good(tmp_path), "dtm": 30, "looks": 1}
    seen = []

    def spy(model, geometry, provider, threads, looks):
        seen.append((model.contract["task"], geometry.round(3).tolist()[0], looks))
        return lambda rgb: {}

    monkeypatch.setattr(check.runtime, "open_network", spy)
    for more in ({}, {"dsm": str(tmp_path / "dtm.tif")}):
        ((name, values),) = plan.scenes({**config, **more}, SCHEMA).items()
        planned = plan.plan(name, values, tmp_path, tmp_path / "results")
        assert set(check.tile_seconds(planned)) == ({"sections"} if more else {"sections", "corners"})
    tasks, told, looks = zip(*seen, strict=True)
    assert tasks == ("sections", "corners", "sections")
    assert set(looks) == {1}
    assert told[0][4:] == [1.0, 0.0]
    assert told[0][1] == pytest.approx(-np.cos(np.radians(1.1)) / np.tan(np.radians(59.3)) / 0.38, abs=1e-3)


def test_estimates_grow_with_what_is_to_do():
    tiles = {"sections": 0.1, "corners": 0.1}
    whole = check.estimate(10_000_000, 400, dict.fromkeys(STEPS, 1.0), 60, tiles)
    half = check.estimate(10_000_000, 400, dict.fromkeys(STEPS, 0.5), 30, tiles)
    none = check.estimate(10_000_000, 400, dict.fromkeys(STEPS, 0.0), 0, tiles)
    assert none == (0.0, 0.0)
    assert whole.seconds > half.seconds > 80
    assert check.duration(12.0) == "20 s"
    assert check.duration(1234.0) == "21 min"
    assert check.duration(40_000.0) == "11.1 h"


def test_a_page_of_a_simulated_city(tmp_path, monkeypatch):
    """Its CRS is in the city file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "city.json").write_text("{}")
    config = {k: v for k, v in good_inputs.good(tmp_path).items() if k not in ("raster", "dtm", "truth")}
    config |= {"simulate": {"seed": 1, "size": 128, "city": "city.json"}, "sun_azimuth": 150.0, "sun_elevation": 45.0}
    ((name, values),) = plan.scenes(config, SCHEMA).items()
    planned = plan.plan(name, values, tmp_path, tmp_path / "results")
    text = check.page(planned, tmp_path / "results", dict.fromkeys(STEPS, len(planned.blocks)))
    assert "128 x 128 px of 0.38 m in the city's CRS" in text
