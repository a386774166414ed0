"""Sections corrected by hand: what was not touched stays to the bit, what was gets the id one expects."""

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
import toy_city

from kibs_steps import edited, inputs, store
from kibs_steps.corners import CORNERS
from kibs_steps.grid import Grid
from kibs_steps.heightmap import EMPTY
from kibs_steps.stitch import SECTIONS, section_ids


@pytest.fixture
def world(tmp_path):
    """A scene, its stitched sections and corners, and the layer as it was published."""
    facts = toy_city.make_scene(tmp_path)
    outlines = np.array([shapely.box(c, 40, c + 20, 60).normalize() for c in (20, 41, 80, 120)])
    ids = section_ids(outlines, facts.grid)
    n = len(ids)
    columns = [
        ids,
        shapely.to_wkb(outlines),
        [0.9] * n,
        [0, 1, 2, 2],
        [False] * n,
        [True, False, False, False],
        [5, 6, 7, 8],
        [[k + 1.0] * len(EMPTY) for k in range(n)],
    ]
    stitched = pa.table([pa.array(c, f.type) for c, f in zip(columns, SECTIONS, strict=True)], schema=SECTIONS)
    rows = [
        (0, 0, x, y, 6.0, 0.5, 0.8, o)
        for g, o in zip(outlines, (5, 6, 7, 8), strict=True)
        for x, y in shapely.get_coordinates(g)[:-1]
    ]
    corners = pa.table(
        [pa.array(c, f.type) for c, f in zip(zip(*rows, strict=True), CORNERS, strict=True)], schema=CORNERS
    )
    standing = shapely.transform(outlines, facts.grid.to_map)
    layer = geopandas.GeoDataFrame({"section_id": ids}, geometry=standing, crs=toy_city.CRS)
    return facts, stitched, corners, layer


def run(tmp_path, world, layer, crs=None, left_out=()):
    facts, stitched, corners, _ = world
    (layer if crs is None else layer.to_crs(crs)).to_file(tmp_path / "edit.gpkg", layer="roof_sections_image")
    store.write_by_block(tmp_path / "stitched.parquet", {"r000c000": stitched, "r000c001": stitched.slice(0, 0)})
    store.write_table(tmp_path / "corners.parquet", corners)
    out = tmp_path / "sections.parquet", tmp_path / "edited_corners.parquet"
    edited.main(
        ["--scene", str(facts.folder / "scene.json"), "--layer", str(tmp_path / "edit.gpkg"),
         "--stitched", str(tmp_path / "stitched.parquet"),
         "--found", str(tmp_path / "corners.parquet"), "--tile", "120", "--margin", "10", "--block", "1", "--reach", "7.5",
         "--left-out", *left_out,
         "--sections", str(out[0]), "--corners", str(out[1])]
    )  # fmt: skip
    return pq.read_table(out[0]), pq.read_table(out[1])


def test_nothing_touched_is_nothing_changed(tmp_path, world):
    sections, corners = run(tmp_path, world, world[3])
    assert sections.select(SECTIONS.names).sort_by("section_id").equals(world[1].sort_by("section_id"))
    assert set(corners["owner"].to_pylist()) == {5, 6, 7, 8}


def test_blocks_are_by_the_ids_pixel(tmp_path, world):
    sections, _ = run(tmp_path, world, world[3])
    block = dict(zip(sections["section_id"].to_pylist(), sections["block"].to_pylist(), strict=True))
    for section in block:
        col = (section - 1) % toy_city.WIDTH
        assert block[section] == f"r000c{col // 100:03d}"


def test_moved_split_deleted_and_drawn(tmp_path, world):
    facts, _, _, layer = world
    ids = layer["section_id"].to_list()
    to_map = facts.grid.to_map
    drawn = shapely.transform(shapely.box(200, 100, 220, 130), to_map)
    west, east = (shapely.transform(shapely.box(*b), to_map) for b in ((80, 40, 84, 60), (84, 40, 100, 60)))
    stretched = shapely.transform(shapely.box(20, 40, 46, 60), to_map)
    rows = [(ids[0], stretched), (ids[2], west), (ids[2], east), (ids[3], layer.geometry[3]), (None, drawn)]
    frame = geopandas.GeoDataFrame(
        {"section_id": [r[0] for r in rows]}, geometry=[r[1] for r in rows], crs=toy_city.CRS
    )
    sections, corners = run(tmp_path, world, frame)
    found = {r["section_id"]: r for r in sections.to_pylist()}
    assert len(found) == 5
    assert ids[1] not in found
    assert {ids[0], ids[2], ids[3]} <= set(found)
    kept = shapely.from_wkb(found[ids[2]]["outline"])
    col, row = (ids[2] - 1) % facts.grid.width, (ids[2] - 1) // facts.grid.width
    assert shapely.contains_xy(kept, col + 0.5, row + 0.5)  # the half that holds the id's pixel
    assert (found[ids[3]]["owner"], found[ids[3]]["split"]) == (8, 2)
    assert (found[ids[0]]["owner"], found[ids[0]]["split"], found[ids[0]]["void"]) == (0, 0, True)
    assert found[ids[0]]["sums"] == [*EMPTY[:-2], 1.0, 1.0]  # heights over another outline, above the same walls
    assert found[ids[3]]["sums"] == [4.0] * len(EMPTY)
    new = set(found) - set(ids)
    assert len(new) == 2
    assert set(corners["owner"].to_pylist()) == {0, 8}
    again, _ = run(tmp_path, world, frame.iloc[::-1])
    assert {r["section_id"] for r in again.to_pylist()} == set(found)


def test_a_nudged_outline_keeps_the_heights_seen_below_it(tmp_path, world):
    """Else a roof whose corners were not found falls to a height that nobody measured, for one vertex moved by a pixel."""
    layer = world[3].copy()
    layer.geometry = [shapely.transform(shapely.box(21, 40, 40, 60), world[0].grid.to_map), *layer.geometry[1:]]
    sections, _ = run(tmp_path, world, layer)
    found = {r["section_id"]: r for r in sections.to_pylist()}[layer["section_id"][0]]
    assert found["owner"] == 0  # touched
    assert found["sums"] == [1.0] * len(EMPTY)


def test_pixel_corners_stay_pixel_corners(tmp_path):
    """By them `solids` tells traced outlines from drawn ones; most are off by the last bit on their way through map metres."""
    grid = Grid("EPSG:32631", 597_123.4, 5_752_345.6, 0.38, 320, 240)
    traced = shapely.Polygon([(10, 10), (31, 10), (31, 17), (44, 17), (44, 52.5), (10, 52)])
    there = shapely.transform(traced, grid.to_map)
    geopandas.GeoDataFrame(geometry=[there], crs=grid.crs).to_file(tmp_path / "a.gpkg")
    _, (outline,) = edited.read(tmp_path / "a.gpkg", grid)
    corners = {tuple(p) for p in shapely.get_coordinates(outline).tolist()}
    assert {(10, 10), (31, 10), (31, 17), (44, 17), (10, 52)} <= corners
    assert min(abs(row - 52.5) for _, row in corners) < 1e-6


def test_sections_that_lie_elsewhere_are_refused_or_told(tmp_path, capsys):
    """A layer with a wrong CRS would publish a whole city far away, one stray outline make every step visit what lies between."""
    grid = Grid("EPSG:32631", 590_000.0, 5_750_000.0, 0.5, 320, 240)
    here, far = (shapely.box(x, 5_749_950, x + 10, 5_749_960) for x in (590_050, 690_050))
    for name, shapes in (("both.gpkg", [here, far]), ("far.gpkg", [far])):
        geopandas.GeoDataFrame(geometry=shapes, crs=grid.crs).to_file(tmp_path / name)
    assert len(edited.read(tmp_path / "both.gpkg", grid)[1]) == 1
    assert "1 outlines lie outside the raster" in capsys.readouterr().err
    for look in (edited.read, inputs.check_sections):
        with pytest.raises(edited.SectionsUnusable, match="outside the raster"):
            look(tmp_path / "far.gpkg", grid)


def test_drawn_in_a_block_that_failed_is_told(tmp_path, world, capsys):
    run(tmp_path, world, world[3], left_out=["r000c001"])
    assert "1 in r000c001 are left out, as these blocks failed" in capsys.readouterr().err


def test_a_layer_in_degrees_is_brought_back(tmp_path, world):
    sections, _ = run(tmp_path, world, world[3], "EPSG:4326")
    assert set(sections["section_id"].to_pylist()) == set(world[3]["section_id"])
    before = {r["section_id"]: r for r in world[1].to_pylist()}
    for row in sections.to_pylist():  # to the bit: nothing was touched
        assert {name: row[name] for name in before[row["section_id"]]} == before[row["section_id"]]
    area = shapely.area(shapely.from_wkb(sections["outline"].to_pylist()))
    np.testing.assert_allclose(area, 400.0, rtol=1e-3)


def test_what_is_no_layer_of_polygons_is_refused(tmp_path, world):
    grid = world[0].grid
    with pytest.raises(edited.SectionsUnusable, match="cannot be read"):
        edited.read(tmp_path / "none.gpkg", grid)
    points = geopandas.GeoDataFrame(geometry=[shapely.Point(0, 0)], crs=toy_city.CRS)
    points.to_file(tmp_path / "points.gpkg")
    with pytest.raises(edited.SectionsUnusable, match="no polygons"):
        edited.read(tmp_path / "points.gpkg", grid)
    (tmp_path / "table.csv").write_text("section_id,height\n1,2\n")
    with pytest.raises(edited.SectionsUnusable, match="no polygons"):
        edited.read(tmp_path / "table.csv", grid)
    nowhere = geopandas.GeoDataFrame(geometry=[shapely.box(200, 95, 201, 96)], crs="EPSG:4326")
    nowhere.to_file(tmp_path / "nowhere.gpkg")
    with pytest.raises(edited.SectionsUnusable):
        edited.read(tmp_path / "nowhere.gpkg", grid)
    square = geopandas.GeoDataFrame(geometry=[shapely.transform(shapely.box(1, 1, 9, 9), grid.to_map)], crs=grid.crs)
    square.to_file(tmp_path / "points.gpkg", layer="drawn")  # beside the points
    assert len(edited.read(tmp_path / "points.gpkg", grid)[1]) == 1


def test_a_bowtie_becomes_its_larger_part(world):
    grid = world[0].grid
    assert edited._polygon(shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])).is_valid
    assert edited._polygon(shapely.Polygon([(0, 0), (1, 1), (2, 2)])) is None
    spiked = edited._polygon(shapely.Polygon([(0, 0), (10, 10), (10, 0), (12, 0), (10, 0), (0, 10)]))
    assert spiked.is_valid
    assert spiked.area == pytest.approx(25.0)
    assert grid.width == toy_city.WIDTH


def test_a_copy_beside_the_original_layer_is_told(tmp_path, capsys):
    grid = Grid("EPSG:32631", 590_000.0, 5_750_000.0, 0.5, 320, 240)
    square = shapely.box(590_010, 5_749_980, 590_020, 5_749_990)
    frame = geopandas.GeoDataFrame({"section_id": [1]}, geometry=[square], crs=grid.crs)
    for layer in (edited.LAYER, "my_edits"):
        frame.to_file(tmp_path / "a.gpkg", layer=layer)
    edited.read(tmp_path / "a.gpkg", grid)
    assert f"layer {edited.LAYER} is read, not my_edits" in capsys.readouterr().err


def test_rows_that_editing_left_odd_are_kept_or_told(tmp_path, capsys):
    """A polygon within a collection is a section, a new one may have a word for its id, what has no area is told."""
    grid = Grid("EPSG:32631", 590_000.0, 5_750_000.0, 0.5, 320, 240)

    def box(col, row):
        return shapely.Polygon(
            grid.to_map(np.array([[col, row], [col + 20, row], [col + 20, row + 20], [col, row + 20]]))
        )

    line = shapely.Polygon([(590_010, 5_749_990), (590_020, 5_749_990), (590_030, 5_749_990)])
    inner = shapely.MultiPolygon([box(10, 10)])
    mixed = shapely.GeometryCollection([inner, shapely.Point(590_000, 5_749_990)])
    table = {"section_id": ["10000", "new", "7"]}
    geopandas.GeoDataFrame(table, geometry=[mixed, box(50, 50), line], crs=grid.crs).to_file(tmp_path / "a.gpkg")
    ids, outlines = edited.read(tmp_path / "a.gpkg", grid)
    assert ids.tolist() == [10000, 0]
    assert shapely.area(outlines).round(6).tolist() == [400, 400]
    assert "1 of 3 rows have no area" in capsys.readouterr().err
    geopandas.GeoDataFrame(geometry=[line], crs=grid.crs).to_file(tmp_path / "b.gpkg")
    with pytest.raises(edited.SectionsUnusable, match="no polygons"):
        edited.read(tmp_path / "b.gpkg", grid)
