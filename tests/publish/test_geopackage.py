"""City as a GeoPackage: every layer as DESIGN fixes it, read back by GDAL; the same bytes at another time."""

import sqlite3
import subprocess
import time
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyogrio
import pytest
import shapely
import toy_city as toy

from kibs_steps import store
from kibs_steps.publish import geopackage, styles

LAYERS = {
    "buildings": "MultiPolygon",
    "footprints": "Polygon",
    "roof_sections": "Polygon Z",
    "roof_sections_image": "Polygon Z",
    "corners": "Point Z",
    "blocks": "Polygon",
}


def solids_table():
    """`solids.parquet` of the toy city: one building without a solid."""
    by_building = {}
    for _, building, outline in toy.roofs():
        by_building.setdefault(building, []).append(shapely.force_2d(outline))
    rows = []
    for building, parts in by_building.items():
        shape = shapely.union_all(parts)
        lod = "0" if building == 14 else "2.0"
        rows.append(
            {
                "building_id": building,
                "lod": lod,
                "lod_reason": "not closed" if lod == "0" else "",
                "valid": lod != "0",
                "position_corrected": True,
                "n_sections": len(parts),
                "ground_z": 13.0,
                "eave_z": 20.0,
                "ridge_z": 25.0,
                "height": 12.0,
                "volume": None if lod == "0" else 1234.5,
                "footprint_area": shape.area,
                "roof_type": "gable",
                "height_sigma": 0.5,
                "position_sigma": 0.3,
                "faithful": 1.0,
                "outline": shapely.to_wkb(shapely.MultiPolygon([shape])),
                "footprint": None if lod == "0" else shapely.to_wkb(shape),
            }
        )
    return pa.Table.from_pylist(rows)


def corners_table(scene):
    """`filed_corners.parquet`: every vertex of every section."""
    rows = []
    for section, _, outline in toy.roofs():
        seen = shapely.get_coordinates(toy.seen_outline(scene, outline), include_z=True)
        for (x, y, z), (col, row, h) in zip(shapely.get_coordinates(outline, include_z=True), seen, strict=True):
            rows.append({"section_id": section, "x": x, "y": y, "z": z, "col": col, "row": row, "height": h,
                         "sigma": 0.4, "score": 0.8})  # fmt: skip
    return pa.Table.from_pylist(rows)


@pytest.fixture
def city(tmp_path):
    """The toy city's tables, split over two blocks, and a function that writes its GeoPackage."""
    scene = toy.make_scene(tmp_path)
    sections, solids, corners = toy.buildings_table(scene), solids_table(), corners_table(scene)
    for name, table, cut in (("buildings", sections, 2), ("solids", solids, 1), ("corners", corners, 7)):
        store.write_table(tmp_path / f"{name}0.parquet", table.slice(cut))
        store.write_table(tmp_path / f"{name}1.parquet", table.slice(0, cut))
    store.write_json(tmp_path / "blocks.json", {"r000c001": {"status": "failed", "reason": "no data"}})
    model = {"file": "models/free/corners.onnx", "contract": {"trained_on": {"licence": "CC BY-NC 4.0"}}}
    store.write_json(tmp_path / "corners.json", model)

    def write(name="city.gpkg", order=(0, 1)):
        arguments = [
            "--scene",
            tmp_path / "scene.json",
            "--tile",
            64,
            "--margin",
            8,
            "--block",
            4,
            "--out",
            tmp_path / name,
        ]
        for option, table in (("sections", "buildings"), ("solids", "solids"), ("corners", "corners")):
            arguments += [f"--{option}", *(tmp_path / f"{table}{i}.parquet" for i in order)]
        arguments += ["--blocks", tmp_path / "blocks.json", "--models", tmp_path / "corners.json"]
        geopackage.main([str(a) for a in arguments])
        return tmp_path / name

    return scene, write


def test_every_layer_is_read_back(city):
    scene, write = city
    path = write()
    kinds = dict(pyogrio.list_layers(path))
    assert {name: kind for name, kind in kinds.items() if name != "layer_styles"} == LAYERS
    for name in LAYERS:
        assert pyogrio.read_info(path, layer=name)["crs"] == toy.CRS
    assert "CC BY-NC 4.0" in pyogrio.read_info(path, layer="buildings")["dataset_metadata"]["LICENCE"]

    sections = pyogrio.read_dataframe(path, layer="roof_sections")
    assert tuple(sections.columns[:-1]) == geopackage.SECTION_COLUMNS
    assert sections["section_id"].tolist() == [11, 12, 13, 14]
    assert sections["azimuth"].isna().tolist() == [False, False, True, False]
    expected = [outline for _, _, outline in toy.roofs()]
    np.testing.assert_allclose(
        shapely.get_coordinates(sections.geometry, include_z=True), shapely.get_coordinates(expected, include_z=True)
    )
    seen = pyogrio.read_dataframe(path, layer="roof_sections_image")
    pixels = shapely.get_coordinates([toy.seen_outline(scene, o) for o in expected], include_z=True)
    found = shapely.get_coordinates(seen.geometry, include_z=True)
    np.testing.assert_allclose(scene.grid.to_image(found[:, :2]), pixels[:, :2], atol=1e-6)
    np.testing.assert_allclose(found[:, 2], pixels[:, 2])

    buildings = pyogrio.read_dataframe(path, layer="buildings")
    assert tuple(buildings.columns[:-1]) == geopackage.BUILDING_COLUMNS
    assert buildings["building_id"].tolist() == [11, 13, 14]
    assert len(pyogrio.read_dataframe(path, layer="footprints")) == 2
    corners = pyogrio.read_dataframe(path, layer="corners")
    assert tuple(corners.columns[:-1]) == geopackage.CORNER_COLUMNS
    assert len(corners) == corners_table(scene).num_rows
    assert corners.geometry.z.max() == 40.0


def test_blocks_cover_the_grid_and_keep_their_reason(city):
    scene, write = city
    blocks = pyogrio.read_dataframe(write(), layer="blocks")
    assert blocks.columns.tolist() == ["block", "status", "reason", "geometry"]
    assert blocks["block"].tolist() == ["r000c000", "r000c001", "r001c000", "r001c001"]
    assert blocks["status"].tolist() == ["ok", "failed", "ok", "ok"]
    assert blocks["reason"].tolist() == ["", "no data", "", ""]
    assert shapely.union_all(blocks.geometry).equals(shapely.box(*scene.grid.bounds))
    assert blocks.geometry.area.sum() == pytest.approx(shapely.box(*scene.grid.bounds).area)


def test_same_bytes_later_and_whatever_the_order_of_blocks(city):
    _, write = city
    first = write().read_bytes()
    time.sleep(1.1)
    assert write().read_bytes() == first
    assert write("other.gpkg", order=(1, 0)).read_bytes() == first


def test_it_is_geopackage_1_2_with_indexes_and_styles(city):
    _, write = city
    with sqlite3.connect(write()) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (10200,)
        names = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
        assert {f"rtree_{layer}_geom" for layer in LAYERS} <= names
        rows = database.execute("SELECT f_table_name, f_geometry_column, styleQML, useAsDefault FROM layer_styles")
        found = {name: (geometry, qml, default) for name, geometry, qml, default in rows}
        columns = [row[1] for row in database.execute("PRAGMA table_info(layer_styles)")]
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert columns[0] == "id"
    assert set(found) == set(LAYERS)
    for geometry, qml, default in found.values():
        assert geometry == "geom"
        assert default == 1
        assert ET.fromstring(qml.split(">", 1)[1]).find("renderer-v2/symbols/symbol/layer") is not None


def test_graduated_style_has_no_gap():
    root = ET.fromstring(styles.STYLES["buildings"][1].split(">", 1)[1])
    ranges = [(float(r.get("lower")), float(r.get("upper"))) for r in root.iter("range")]
    assert ranges[0][0] < 0
    assert all(one[1] == other[0] for one, other in pairwise(ranges))


def test_a_city_without_buildings(tmp_path):
    """Layers are there, with all their columns, when nothing was found."""
    scene = toy.make_scene(tmp_path)
    tables = toy.buildings_table(scene), solids_table(), corners_table(scene)
    content = geopackage.layers(*(lambda t=t: iter([t.slice(0, 0)]) for t in tables))
    geopackage.write(tmp_path / "empty.gpkg", content, toy.CRS, {})
    for name, kind in dict(pyogrio.list_layers(tmp_path / "empty.gpkg")).items():
        if name != "layer_styles":
            assert kind == LAYERS[name]
            assert pyogrio.read_info(tmp_path / "empty.gpkg", layer=name)["features"] == 0


def test_gdals_validator_is_content(city):
    """GDAL's `validate_gpkg` (package python3-gdal of Debian); skipped where the system's Python has none."""
    python = "/usr/bin/python3"
    module = "osgeo_utils.samples.validate_gpkg"
    if not Path(python).exists() or subprocess.run([python, "-c", f"import {module}"], capture_output=True).returncode:
        pytest.skip("GDAL's validate_gpkg is not installed (Debian: python3-gdal)")
    _, write = city
    done = subprocess.run([python, "-m", module, str(write())], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "error" not in done.stdout.lower() + done.stderr.lower()


def test_a_building_of_parts_has_a_footprint_row_for_each():
    parts = [shapely.box(0, 0, 10, 8), shapely.box(10.8, 0, 18.8, 8)]
    table = solids_table().slice(0, 2).to_pylist()
    table[0] |= {"outline": shapely.to_wkb(shapely.MultiPolygon(parts)), "footprint": shapely.to_wkb(parts[0])}
    table[1]["footprint"] = None  # no solid
    found = geopackage.footprints(pa.Table.from_pylist(table))
    assert shapely.area(shapely.from_wkb(found["geom"].to_pylist())).tolist() == [80, 64]
    assert found["building_id"].to_pylist() == [table[0]["building_id"]] * 2
    assert found["footprint_area"].to_pylist() == [80, 64]
