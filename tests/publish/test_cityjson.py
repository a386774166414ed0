"""CityJSON and CityJSONSeq: valid after the schema where that is at hand, and consistent in themselves."""

import importlib.util
import json
import os
import re
from pathlib import Path

import houses
import numpy as np
import pyarrow as pa
import pytest
import toy_city

from kibs_steps import features, gate, solids, store
from kibs_steps.publish import cityjson


def city(tmp_path, cut=("r000c000", "r000c001"), extra=()):
    """Publish four houses, spread over blocks; return both files."""
    scene = toy_city.make_scene(tmp_path)
    tables = {name: [] for name in cut}
    apart = [*houses.BOX, ([(9, 0), (14, 0), (14, 4), (9, 4)], (0, 0, 4))]
    sunk = [([(0, 0), (4, 0), (4, 4), (0, 4)], (0, 0, -3.0))]
    for k, house in enumerate((houses.HIP, houses.COURTYARD, apart, sunk)):
        place = (toy_city.X0 + 10 + 30 * k, toy_city.Y0 - 50)
        base = float(toy_city.GROUND.at(np.array([place]))[0]) + 1.5
        ids = [100 * k + i for i in range(1, len(house) + 1)]
        tables[cut[(k + 1) % len(cut)]].append(houses.building_table(house, place=place, base=base, ids=ids))
    none = houses.building_table(houses.BOX).slice(0, 0)
    by_block = {name: pa.concat_tables([none, *rows]) for name, rows in tables.items()}
    store.write_by_block(tmp_path / "buildings.parquet", by_block)
    sequences = []
    for name in cut:
        sequences.append(str(tmp_path / f"{name}.city.jsonl"))
        arguments = ["--scene", str(scene.folder / "scene.json"), "--buildings", str(tmp_path / "buildings.parquet")]
        arguments += ["--name", name, "--out", sequences[-1], "--attributes", str(tmp_path / f"{name}.parquet")]
        arguments += ["--meshes", str(tmp_path / f"{name}.meshes.parquet")]
        solids.main(arguments)
    out, lines = tmp_path / "city.city.json", tmp_path / "city.city.jsonl"
    arguments = [
        "--scene",
        str(scene.folder / "scene.json"),
        "--solids",
        *sequences,
        "--out",
        str(out),
        "--seq",
        str(lines),
    ]
    cityjson.main([*arguments, *extra])
    return out, lines


def faces_of(geometry, vertices):
    return [[[tuple(vertices[i]) for i in ring] for ring in surface] for surface in geometry["boundaries"][0]]


def test_one_city_with_shared_vertices_and_semantics(tmp_path):
    out, _ = city(tmp_path)
    content = json.loads(out.read_text())
    assert (content["type"], content["version"]) == ("CityJSON", "2.0")
    vertices = content["vertices"]
    assert all(isinstance(v, int) for vertex in vertices for v in vertex)
    assert len({tuple(v) for v in vertices}) == len(vertices)
    used = set()
    for thing in content["CityObjects"].values():
        for geometry in thing.get("geometry", []):
            assert isinstance(geometry["lod"], str)
            used |= {int(i) for i in re.findall(r"\d+", json.dumps(geometry["boundaries"]))}
            if geometry["type"] == "Solid":
                faces = faces_of(geometry, vertices)
                assert gate.check(faces) == []
                (values,) = geometry["semantics"]["values"]
                assert len(values) == len(faces)
                kinds = {geometry["semantics"]["surfaces"][k]["type"] for k in values}
                assert kinds == {"RoofSurface", "WallSurface", "GroundSurface"}
    assert used == set(range(len(vertices)))


def test_buildings_parts_and_those_without_a_solid(tmp_path):
    content = json.loads(city(tmp_path)[0].read_text())
    objects = content["CityObjects"]
    assert list(objects) == [
        "building-1",
        "building-101",
        "building-201",
        "building-201-1",
        "building-201-2",
        "building-301",
    ]
    assert [objects[k]["type"] for k in objects] == ["Building"] * 3 + ["BuildingPart"] * 2 + ["Building"]
    assert objects["building-201"]["children"] == ["building-201-1", "building-201-2"]
    (flat,) = objects["building-301"]["geometry"]
    assert (flat["type"], flat["lod"]) == ("MultiSurface", "0")
    attributes = objects["building-301"]["attributes"]
    assert (attributes["lod"], attributes["valid"], attributes["building_id"]) == ("0", False, 301)
    assert "above the ground" in attributes["lod_reason"]
    assert objects["building-1"]["attributes"]["roof_type"] == "hip"


def test_places_and_metadata(tmp_path):
    content = json.loads(city(tmp_path, extra=["--title", "Delft", "--date", "2024-05-01"])[0].read_text())
    facts = content["metadata"]
    assert facts["referenceSystem"] == "https://www.opengis.net/def/crs/EPSG/0/32631"
    assert (facts["title"], facts["referenceDate"]) == ("Delft", "2024-05-01")
    xyz = np.array(content["vertices"]) * content["transform"]["scale"] + content["transform"]["translate"]
    assert np.allclose(facts["geographicalExtent"], [*xyz.min(axis=0), *xyz.max(axis=0)], atol=1e-3)
    assert xyz[:, 0].min() == pytest.approx(toy_city.X0 + 10)
    assert xyz[:, 1].min() == pytest.approx(toy_city.Y0 - 50)


def test_licences_of_models_are_told(tmp_path):
    model = {"file": "models/corners.onnx", "contract": {"trained_on": {"licence": "CC-BY-NC-4.0"}}}
    store.write_json(tmp_path / "corners.json", model)
    out, lines = city(tmp_path, extra=["--models", str(tmp_path / "corners.json")])
    assert json.loads(out.read_text())["metadata"]["licence"] == "corners.onnx: CC-BY-NC-4.0"
    assert json.loads(lines.read_text().splitlines()[0])["metadata"]["licence"] == "corners.onnx: CC-BY-NC-4.0"


def test_the_sequence_tells_the_same_city(tmp_path):
    out, lines = city(tmp_path)
    whole = json.loads(out.read_text())
    head, *features = [json.loads(line) for line in lines.read_text().splitlines()]
    assert head["metadata"] == whole["metadata"]
    assert head["transform"] == whole["transform"]
    assert [f["id"] for f in features] == ["building-1", "building-101", "building-201", "building-301"]
    assert sum(len(f["CityObjects"]) for f in features) == len(whole["CityObjects"])
    for feature in features:
        for key, thing in feature["CityObjects"].items():
            assert thing.get("attributes") == whole["CityObjects"][key].get("attributes")
            for mine, theirs in zip(
                thing.get("geometry", []), whole["CityObjects"][key].get("geometry", []), strict=True
            ):
                if mine["type"] == "Solid":
                    assert faces_of(mine, feature["vertices"]) == faces_of(theirs, whole["vertices"])


def test_blocks_leave_no_trace(tmp_path):
    first = [p.read_bytes() for p in city(tmp_path / "a")]
    second = [p.read_bytes() for p in city(tmp_path / "b", cut=("r000c000",))]
    third = [p.read_bytes() for p in city(tmp_path / "c", cut=("r000c001", "r000c000", "r001c000"))]
    assert first == second == third


def test_a_damaged_block_is_named(tmp_path):
    _, _ = city(tmp_path)
    path = tmp_path / "r000c001.city.jsonl"
    path.write_text(path.read_text()[:-40])
    with pytest.raises(store.DamagedFile, match=r"r000c001.*is deleted now"):
        cityjson.index_of(path)
    path.write_text("")  # by another hand: no sums lie beside it
    with pytest.raises(store.DamagedFile, match="no CityJSON header"):
        cityjson.transform(path)


def test_reference_systems():
    assert cityjson.reference_system("EPSG:28992", None).endswith("/28992")
    assert cityjson.reference_system("EPSG:28992", "EPSG:5709").endswith("/7415")  # RD New + NAP
    assert cityjson.reference_system("EPSG:32631", "EPSG:5709").endswith("/32631")
    assert cityjson.reference_system("+proj=tmerc +lat_0=12.3 +lon_0=4.5 +ellps=GRS80 +units=m", None) is None


def test_an_empty_city(tmp_path):
    scene = toy_city.make_scene(tmp_path)
    (tmp_path / "none.city.jsonl").write_text(json.dumps(features.header((0, 0))) + "\n")
    out, lines = tmp_path / "city.city.json", tmp_path / "city.city.jsonl"
    arguments = ["--scene", str(scene.folder / "scene.json"), "--solids", str(tmp_path / "none.city.jsonl")]
    cityjson.main([*arguments, "--out", str(out), "--seq", str(lines)])
    content = json.loads(out.read_text())
    assert (content["CityObjects"], content["vertices"]) == ({}, [])


def test_the_official_schema_accepts_both_files(tmp_path):
    folder = os.environ.get("KIBS_DATA")
    checker = Path(folder or "").parent / "reference" / "cityjson_check.py"
    if not folder or not checker.exists():
        pytest.skip("KIBS_DATA is not set or has no ../reference/cityjson_check.py: no CityJSON schemas here")
    spec = importlib.util.spec_from_file_location("cityjson_check", checker)
    check = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(check)
    out, lines = city(tmp_path)
    texts = [out.read_text(), *lines.read_text().splitlines()]
    for text in texts:
        errors, warnings = check.check(json.loads(text))
        assert errors == []
        assert warnings == []
