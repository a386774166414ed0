"""What `run.json` says of a run."""

import hashlib
import json

import pyarrow as pa
import pytest
import shapely
import toy_city as toy

from kibs_steps import store, view
from kibs_steps.publish import run
from kibs_steps.scene import Direction, Region

MODEL = {
    "file": "models/free/corners.onnx",
    "sha256": "00ff",
    "contract": {
        "task": "corners",
        "head": "dense",
        "gsd": 0.38,
        "tile": 256,
        "margin": 16,
        "heights": {"edges": [0, 1, 2], "centres": [0.5, 1.5], "fallback": 6.1},
        "trained_on": {"data": ["simulated"], "licence": "CC BY-NC 4.0", "seed": 1},
    },
}


def test_everything_is_recorded(tmp_path, capsys):
    scene = toy.make_scene(tmp_path / "scene")
    rows = toy.buildings_table(scene).to_pylist()
    rows[0] |= {"status": "two_corners", "status_reason": "2 corners: level at 6.25 m"}
    rows[1] |= {"status": "two_corners", "status_reason": "2 corners: level at 7.5 m"}
    store.write_table(tmp_path / "buildings.parquet", pa.Table.from_pylist(rows))
    solids = [
        {
            "building_id": building,
            "lod": lod,
            "lod_reason": reason,
            "valid": lod != "0",
            "position_corrected": True,
            "roof_type": "gable",
            "faithful": share,
        }
        for building, lod, reason, share in (
            (11, "2.0", "", 1.0),
            (13, "2.0", "", 0.5),
            (14, "1.2", "roof self-intersects at 12.5, 3.1", 0.0),
        )
    ]
    store.write_table(tmp_path / "solids.parquet", pa.Table.from_pylist(solids))
    store.write_json(tmp_path / "corners.json", MODEL)
    for name, text in {
        "scene.tsv": "s\th:m:s\tmax_rss\n1.5\t0:00:01\t120.5\n",
        "planes/r000c000.tsv": "s\th:m:s\tmax_rss\n2.0\t0:00:02\t90\n",
        "planes/r000c001.tsv": "s\th:m:s\tmax_rss\n0.5\t0:00:00\t-\n",
        "planes/r003c000.tsv": "s\th:m:s\tmax_rss\n9.0\t0:00:09\t90\n",  # of larger tiles, once
        "glb.tsv": "s\th:m:s\tmax_rss\n9.0\t0:00:09\t90\n",
    }.items():
        path = tmp_path / "benchmarks" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    out = tmp_path / "run.json"
    arguments = [
        "--scene",
        scene.folder / "scene.json",
        "--inputs",
        scene.raster,
        "--models",
        tmp_path / "corners.json",
    ]
    arguments += [
        "--tile",
        64,
        "--margin",
        8,
        "--block",
        4,
        "--settings",
        '{"planes": "robust"}',
        "--sections",
        tmp_path / "buildings.parquet",
    ]
    arguments += ["--solids", tmp_path / "solids.parquet", "--benchmarks", tmp_path / "benchmarks", "--out", out]
    run.main([str(a) for a in arguments])
    assert "corners.onnx: CC BY-NC 4.0" in capsys.readouterr().out
    found = json.loads(out.read_text())
    (raster,) = found["inputs"]
    with open(scene.raster, "rb") as file:
        assert raster["sha256"] == hashlib.file_digest(file, "sha256").hexdigest()
    assert found["licence"] == "corners.onnx: CC BY-NC 4.0"
    assert found["models"][0]["heights"] == {"bins": 2, "highest": 2, "fallback": 6.1}
    assert found["settings"] == {"planes": "robust"}
    sections, buildings = found["results"]["sections"], found["results"]["buildings"]
    assert sections["status"] == {"ok": 2, "two_corners": 2}
    assert sections["reasons"] == {"# corners: level at # m": 2}
    assert buildings["lod"] == {"2.0": 2, "1.2": 1}
    assert buildings["valid"] == 3
    assert buildings["lod2"] == {"with_ok_section": 2, "lod2": 0, "share": 0.0, "without_solid": 0}
    assert list(buildings["reasons"].values()) == [1]
    assert found["times"]["planes"] == {"jobs": 2, "seconds": 2.5, "longest": 2.0, "peak_mb": 90.0}
    assert found["times"]["scene"]["jobs"] == 1
    assert "glb" not in found["times"]
    assert found["versions"]["numpy"]
    assert found["scene"]["position_corrected"]


def test_reasons_count_together_and_keep_their_level():
    texts = [
        "2.0: face 5 is 12.5 mm off its plane; 1.3: it has 2 parts",
        "2.0: face 16 is 3 mm off its plane; 1.3: it has 4 parts",
    ]
    assert run.reasons(texts) == {"2.0: face # is # mm off its plane; 1.3: it has # parts": 2}
    assert run.reasons(["2.0 and 1.3: no section has an area", None]) == {"2.0 and 1.3: no section has an area": 1}


def test_regions_alone_move_roofs_too(tmp_path):
    scene = toy.make_scene(tmp_path, direction=None)
    assert not run.facts(scene)["position_corrected"]
    region = Region(shapely.box(*scene.grid.bounds), Direction(181.0, 60.0, view.lean(181.0, 60.0)))
    assert run.facts(scene._replace(regions=(region,)))["position_corrected"]


def test_a_missing_input_is_named(tmp_path):
    with pytest.raises(run.InputMissing, match=r"gone\.tif"):
        run.inputs([str(tmp_path / "gone.tif")], tmp_path / "cache.json")


def test_the_share_of_full_roofs():
    """Of buildings with a section that is ok: full where nine tenths of their sections are faithful, whatever it is called."""
    sections = pa.table({"building_id": [1, 2, 3, 4, 5, 5, 6], "status": ["ok"] * 4 + ["too_small", "ok", "too_small"]})
    solids = [(1, "2.0", 1.0), (2, "2.2", 0.9), (3, "2.0", 0.89), (4, "1.3", 1.0), (5, "2.0", None), (6, "0", None)]
    table = pa.Table.from_pylist([{"building_id": b, "lod": lod, "faithful": f} for b, lod, f in solids])
    assert run.lod2(sections, table) == {"with_ok_section": 5, "lod2": 3, "share": 0.6, "without_solid": 1}
    assert run.lod2(sections.slice(4, 1), table)["share"] is None
