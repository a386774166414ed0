"""Buildings: what shares an edge belongs together, whatever the order and the blocks; steps and footprints divide."""

import geopandas
import houses
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
import shapely.affinity
import toy_city

from kibs_steps import buildings, store
from kibs_steps.grid import Tiling

LEVEL = (0.0, 0.0, 5.0, 0.0, 0.0)


def level(z):
    return (0.0, 0.0, z, 0.0, 0.0)


def grouped(shapes, planes=None, lean=(0.0, 0.0), footprint=None, ids=None, clusters=False):
    """Building ids (cluster ids) of sections 1, 2, 3 …"""
    n = len(shapes)
    ids = np.arange(1, n + 1) if ids is None else np.asarray(ids)
    planes = np.array(planes or [LEVEL] * n)
    return buildings.buildings(ids, np.array(shapes, object), planes, lean, footprint)[int(clusters)].tolist()


def box(x0, y0, x1, y1):
    return shapely.box(x0, y0, x1, y1)


def test_neighbours_on_a_common_edge_are_one_building():
    assert grouped([box(0, 0, 5, 5), box(5, 0, 9, 5), box(20, 0, 25, 5)]) == [1, 1, 3]


def test_an_edge_must_be_half_a_metre_long():
    assert grouped([box(0, 0, 5, 5), box(5, 4.6, 9, 9)]) == [1, 2]
    assert grouped([box(0, 0, 5, 5), box(5, 4.4, 9, 9)]) == [1, 1]


def test_a_common_corner_is_no_edge():
    assert grouped([box(0, 0, 5, 5), box(5, 5, 9, 9)]) == [1, 2]
    assert grouped([box(0, 0, 5, 5), box(5.3, 5.3, 9, 9)]) == [1, 2]


@pytest.mark.parametrize("shift", [-0.8, -0.3, 0.0, 0.3, 0.9])
def test_gaps_and_overlaps_below_a_metre_are_bridged(shift):
    assert grouped([box(0, 0, 5, 5), box(5 + shift, 0.2, 9, 5.4)]) == [1, 1]


def test_a_lane_divides():
    assert grouped([box(0, 0, 5, 5), box(6.2, 0, 9, 5)]) == [1, 2]


def test_what_a_step_hides_is_bridged_along_the_lean_only():
    planes = [level(8.0), level(5.5)]
    beside = [box(0, 0, 5, 5), box(6.6, 0, 11, 5)]
    assert grouped(beside, planes, lean=(0.6, 0.0)) == [1, 1]  # 2.5 m of step hide 1.5 m
    assert grouped(beside, planes, lean=(0.0, 0.6)) == [1, 2]
    assert grouped(beside, [level(8.0), level(8.0)], lean=(0.6, 0.0)) == [1, 2]


def test_a_step_above_three_metres_divides():
    shapes = [box(0, 0, 5, 5), box(5, 0, 9, 5)]
    assert grouped(shapes, [level(8.0), level(5.1)]) == [1, 1]
    assert grouped(shapes, [level(8.0), level(4.9)]) == [1, 2]


def test_the_step_counts_along_the_edge_not_at_the_middle():
    # Two slopes meeting in a ridge: far apart at their centroids, together along the edge.
    shapes = [box(0, 0, 20, 20), box(0, 20, 20, 40)]
    planes = [(0.0, 1.0, 20.0, 0.0, 20.0), (0.0, -0.2, 20.0, 0.0, 20.0)]
    assert grouped(shapes, planes) == [1, 1]


def test_a_dormer_on_a_roof_belongs_to_it():
    assert grouped([box(0, 0, 10, 10), box(4, 4, 6, 6)], [level(6.0), level(7.0)]) == [1, 1]
    assert grouped([box(0, 0, 10, 10), box(4, 4, 6, 6)], [level(6.0), level(12.0)]) == [1, 2]


def test_what_reaches_under_a_much_higher_roof_is_another_building_of_its_cluster():
    """So that their solids are tiled together and do not stand in each other."""
    shapes, planes = [box(0, 0, 10, 10), box(4, 4, 6, 6), box(8, 30, 9, 31)], [level(12.0), level(6.0), level(6.0)]
    assert grouped(shapes, planes) == [1, 2, 3]
    assert grouped(shapes, planes, clusters=True) == [1, 1, 3]
    shapes[1] = box(9.8, 9.8, 12, 12)  # over each other by 0.04 m² only
    assert grouped(shapes, planes, clusters=True) == [1, 2, 3]


def test_a_section_in_a_hole_belongs_to_the_ring_round_it():
    assert grouped([box(0, 0, 10, 10) - box(4, 4, 6, 6), box(4, 4, 6, 6)]) == [1, 1]


def test_footprints_divide():
    shapes = np.array([box(0, 0, 5, 5), box(5, 0, 10, 5), box(10, 0, 15, 5), box(15, 0, 20, 5)])
    prints = np.array([box(0, 0, 5.2, 5), box(4.9, 0, 15, 5)])
    standing = buildings.standing_in(shapes, prints)
    assert standing.tolist() == [0, 1, 1, -1]
    assert grouped(shapes, footprint=standing) == [1, 2, 2, 4]


def test_bad_outlines_stay_alone():
    empty, bowtie = shapely.Polygon(), shapely.Polygon([(0, 0), (5, 5), (5, 0), (0, 5)])
    assert grouped([empty, box(20, 0, 25, 5), bowtie, None]) == [1, 2, 3, 4]


def test_order_does_not_matter():
    rng = np.random.default_rng(0)
    corner = rng.integers(0, 40, (60, 2))
    shapes = np.array([box(x, y, x + 6, y + 5) for x, y in corner], object)
    ids = rng.permutation(1000)[:60]
    planes = [level(z) for z in rng.uniform(3, 9, 60)]
    whole = dict(zip(ids.tolist(), grouped(shapes, planes, ids=ids), strict=True))
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(60)
        again = grouped(shapes[order], [planes[k] for k in order], ids=ids[order])
        assert dict(zip(ids[order].tolist(), again, strict=True)) == whole
    for section, building in whole.items():
        assert building <= section
        assert whole[building] == building


def test_ids_do_not_matter():
    """Neither of two neighbours that face each other at an angle comes first."""
    random = np.random.default_rng(1)
    found = []
    for _ in range(300):
        one = box(0, 0, random.uniform(4, 14), random.uniform(4, 9))
        other = shapely.affinity.rotate(
            box(0, 0, random.uniform(4, 14), random.uniform(4, 9)), random.normal(0, 8), origin=(0, 0)
        )
        other = shapely.affinity.translate(other, random.uniform(-6, 8), one.bounds[3] + random.uniform(-0.2, 1.2))
        planes = [(*random.normal(0, 0.3, 2), random.uniform(4, 8), 0.0, 0.0) for _ in range(2)]
        leans = np.array([(0.3, 0.5), (-0.2, 0.6)])
        forth = grouped([one, other], planes, leans)
        back = grouped([other, one], planes[::-1], leans[::-1])
        assert len(set(forth)) == len(set(back))
        found.append(len(set(forth)))
    assert 30 < found.count(1) < 270


def test_chunks_do_not_matter(monkeypatch):
    rng = np.random.default_rng(1)
    shapes = [box(x, y, x + 6, y + 5) for x, y in rng.integers(0, 60, (80, 2))]
    whole = grouped(shapes)
    monkeypatch.setattr(buildings, "AT_ONCE", 50)
    assert grouped(shapes) == whole


def run(tmp_path, tables, tiling, footprints=None):
    """`buildings.parquet` of tables by block, and its rows by block."""
    scene = toy_city.make_scene(tmp_path)
    paths = []
    for name, table in tables.items():
        paths.append(tmp_path / "blocks" / name / "ground.parquet")
        store.write_table(paths[-1], table)
    out = tmp_path / "buildings.parquet"
    arguments = [
        "--scene",
        str(scene.folder / "scene.json"),
        "--tile",
        str(tiling.tile),
        "--margin",
        str(tiling.margin),
    ]
    arguments += ["--block", str(tiling.block), "--ground", *map(str, paths), "--out", str(out)]
    buildings.main(arguments + (["--footprints", str(footprints)] if footprints else []))
    return out


def section_id(col, row):
    return row * toy_city.WIDTH + col + 1


def test_a_building_goes_whole_to_the_block_of_its_smallest_section(tmp_path):
    tiling = Tiling(100, 10, 1)  # blocks of 80 px: 4 × 3 of them
    place = (toy_city.X0 + 38.0, toy_city.Y0 - 20.0)
    table = houses.ground_table(houses.GABLE, place=place, ids=[section_id(85, 30), section_id(70, 40)])
    other = houses.ground_table(houses.BOX, place=(toy_city.X0 + 100, toy_city.Y0 - 100), ids=[section_id(205, 195)])
    tables = {"r000c000": table.slice(1, 1), "r000c001": table.slice(0, 1), "r002c002": other}
    out = run(tmp_path, tables, tiling)
    rows = pq.read_table(out).to_pylist()
    first = section_id(85, 30)
    assert [(r["section_id"], r["building_id"], r["block"]) for r in rows] == [
        (first, first, "r000c001"),
        (section_id(70, 40), first, "r000c001"),
        (section_id(205, 195), section_id(205, 195), "r002c002"),
    ]
    assert store.read_table(out, block="r000c000").num_rows == 0
    before = out.read_bytes()
    backwards = dict(reversed(tables.items()))
    assert run(tmp_path, backwards, tiling).read_bytes() == before


def test_footprints_file_in_another_crs_divides(tmp_path):
    place = (toy_city.X0 + 38.0, toy_city.Y0 - 20.0)
    table = houses.ground_table(houses.GABLE, place=place, ids=[section_id(80, 30), section_id(80, 20)])
    x, y = place
    prints = geopandas.GeoDataFrame(geometry=[box(x, y, x + 10, y + 4), box(x, y + 4, x + 10, y + 8)], crs=toy_city.CRS)
    prints.to_crs("EPSG:4326").to_file(tmp_path / "footprints.gpkg")
    tiling = Tiling(100, 10, 8)
    for file, expected in ((None, 1), (tmp_path / "footprints.gpkg", 2)):
        rows = pq.read_table(run(tmp_path, {"r000c000": table}, tiling, file))
        assert len(set(rows["building_id"].to_pylist())) == expected


def test_unusable_footprints_say_what_to_do(tmp_path):
    (tmp_path / "notes.txt").write_text("no polygons")
    with pytest.raises(buildings.FootprintsUnusable, match="give a GeoPackage"):
        buildings.read_footprints(tmp_path / "notes.txt", "EPSG:32631")
    points = geopandas.GeoDataFrame(geometry=[shapely.Point(0, 0)], crs="EPSG:32631")
    points.to_file(tmp_path / "points.gpkg")
    with pytest.raises(buildings.FootprintsUnusable, match="no polygons"):
        buildings.read_footprints(tmp_path / "points.gpkg", "EPSG:32631")


def test_no_sections_at_all(tmp_path):
    empty = houses.ground_table([])
    out = run(tmp_path, {"r000c000": empty}, Tiling(100, 10, 8))
    assert pq.read_table(out).num_rows == 0
    assert pa.types.is_int64(pq.read_schema(out).field("building_id").type)
