"""Solids against closed form: volumes, ladders, courtyards, noise; every published shell passes the gate."""

import json
from collections import Counter

import houses
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
import toy_city
from houses import FLAT, built, shells_are_valid
from hypothesis import given, settings
from hypothesis import strategies as st

from kibs_steps import features, gate, solids, store, terrain
from kibs_steps.shells import GROUND, ROOF, WALL
from kibs_steps.stitch import simplified


@pytest.mark.parametrize("name", sorted(houses.VOLUME))
@pytest.mark.parametrize("degrees", [0.0, 23.0])
def test_volumes_are_those_of_closed_form(name, degrees):
    _, solid, row = built(houses.turned(houses.HOUSES[name], degrees))
    assert (row["lod"], row["lod_reason"], row["valid"]) == ("2.0", "", True)
    assert row["volume"] == pytest.approx(houses.VOLUME[name], rel=1e-3)
    assert shells_are_valid(solid)


def test_exact_sections_keep_every_vertex():
    house = houses.turned(houses.WITH_WING, 31.0, (3.3, 4.7))
    sections, solid, _ = built(house)
    got = {p for shell in solid.shells for s in shell if s.kind == ROOF for ring in s.rings for p in ring}
    got = np.array([p[:2] for p in got]) / 1000 + sections.origin - (500_000, 5_400_000)
    for ring, _ in house:
        for corner in ring:
            assert np.hypot(*(got - corner).T).min() < 0.005


def test_the_ground_is_the_lowest_terrain_under_the_footprint():
    dip = np.full((40, 40), 10.0)
    dip[18, 22] = 8.5  # one pixel of 1 m under the middle of the house
    dtm = terrain.Terrain(dip, 500_000.0 - 17.5, 5_400_000.0 + 22.5, (1.0, 1.0))
    _, solid, row = built(houses.GABLE, dtm, base=10.0)
    assert row["ground_z"] == pytest.approx(8.5)
    (ground,) = [s for s in solid.shells[0] if s.kind == GROUND]
    assert {p[2] for ring in ground.rings for p in ring} == {8500}


def test_a_courtyard_has_walls_of_its_own():
    _, solid, row = built(houses.COURTYARD)
    (shell,) = solid.shells
    (ground,) = [s for s in shell if s.kind == GROUND]
    assert len(ground.rings) == 2
    assert sum(s.kind == WALL and s.exterior for s in shell) == 8
    assert len(row["footprint"].interiors) == 1


def test_a_section_with_another_inside_its_hole():
    ring, hole = shapely.box(0, 0, 12, 12), shapely.box(4, 4, 8, 8)
    sections = solids.Sections(
        np.array([1, 2]), [ring - hole, hole], np.array([[0, 0, 4.0], [0, 0, 6.5]]), ["ok"] * 2, np.full(2, 0.1), (0, 0)
    )
    solid = solids.build(sections, FLAT)
    assert solid.lod == "2.0"
    assert sum(gate.volume([s.rings for s in shell]) for shell in solid.shells) == pytest.approx(
        (144 * 4 + 16 * 2.5) * 1e9
    )


def test_a_dormer_lying_on_its_roof_is_cut_out_of_it():
    dormer = ([(3, 1), (5, 1), (5, 3), (3, 3)], (0, 0, 6.0))
    _, solid, row = built([*houses.GABLE, dormer])
    assert (solid.lod, len(solid.shells)) == ("2.0", 1)
    assert row["volume"] == pytest.approx(houses.VOLUME["gable"] + 4 * (6.0 - 4.5), rel=1e-3)


def test_where_high_and_low_alternate_the_corner_is_chamfered():
    _, solid, row = built(houses.CHEQUERED)
    assert (row["lod"], len(solid.shells)) == ("2.0", 1)
    assert row["volume"] == pytest.approx(500.0, abs=0.1)
    assert shells_are_valid(solid)


def test_a_ring_that_touches_itself_in_a_point_is_chamfered():
    ring = [  # six boxes round a courtyard that is open in one point only
        ([(0, 0), (10, 0), (10, 5), (0, 5)], (0, 0, 3)),
        ([(0, 5), (5, 5), (5, 10), (0, 10)], (0, 0, 3)),
        ([(0, 10), (10, 10), (10, 15), (0, 15)], (0, 0, 3)),
        ([(10, 5), (15, 5), (15, 10), (10, 10)], (0, 0, 3)),
        ([(10, 10), (15, 10), (15, 20), (10, 20)], (0, 0, 3)),
    ]
    _, solid, row = built(ring)
    assert row["lod"] == "2.0"
    assert shells_are_valid(solid)


def test_a_section_that_touches_itself_round_a_higher_one_is_chamfered():
    inner, low = shapely.Polygon([(0, 5), (4, 3), (4, 7)]), shapely.Polygon([(0, 5), (4, 7), (4, 12), (0, 12)])
    outer = shapely.box(0, 0, 12, 12) - inner - low
    shapes, planes = [outer, inner, low], np.zeros((3, 3))
    for z in ([4.0, 6.0, 3.0], [4.0, 3.0, 6.0], [4.0, 6.0, 4.0]):
        planes[:, 2] = z
        sections = solids.Sections(np.arange(1, 4), shapes, planes.copy(), ["ok"] * 3, np.full(3, 0.1), (0, 0))
        solid = solids.build(sections, FLAT)
        assert solid.lod == "2.0"
        assert shells_are_valid(solid)


@pytest.mark.parametrize("sliver", [[(0, 8), (10, 8), (10, 8.0004)], [(0, 8), (5, 8), (10, 8)]])
def test_a_section_without_area_spoils_no_house(sliver):
    ((_, sections),) = solids.clusters_of(houses.building_table([*houses.GABLE, (sliver, (0, 0, 3))]))
    solid = solids.build(sections, terrain.flat(0.0))
    row = features.attributes(1, sections, solid)
    assert (row["lod"], row["roof_type"], row["lod_reason"]) == ("2.0", "gable", "")


def test_parts_that_do_not_touch_are_building_parts():
    apart = [*houses.BOX, ([(9, 0), (14, 0), (14, 4), (9, 4)], (0, 0, 4))]
    sections, solid, row = built(apart)
    assert len(solid.shells) == 2
    assert row["volume"] == pytest.approx(60 + 80)
    feature = features.feature(row, sections, solid, (500_000, 5_400_000), 0.0)
    assert feature["CityObjects"]["building-1"]["children"] == ["building-1-1", "building-1-2"]
    assert feature["CityObjects"]["building-1-2"]["parents"] == ["building-1"]


def test_flat_ground_has_one_height_everywhere():
    """What is read between pixels of one height differs from it in the last digits."""
    for height in (97.3, 120.0):
        ground = terrain.Terrain(np.full((2, 2), np.float32(height)).astype(float), 0.0, 700.0, (700.0, 700.0))
        corners = np.random.default_rng(0).uniform(50, 600, (60, 2))
        found = {solids.lowest_ground([shapely.box(x, y, x + 9.1, y + 7.7)], (0, 0), ground) for x, y in corners}
        assert found == {round(height * 1000)}


def test_level_placeholders_alone_are_no_lod2():
    row = built(houses.GABLE, status=["no_corners"] * 2)[2]
    assert (row["lod"], row["lod_reason"]) == ("1.3", "2.0: no section has a fitted plane")


def test_a_placeholder_follows_its_neighbour():
    lost = [houses.GABLE[0], (houses.GABLE[1][0], (0, 0, 5.0))]
    _, solid, row = built(lost, status=["ok", "no_corners"])
    assert row["lod"] == "2.0"
    inner = [s for s in solid.shells[0] if s.kind == WALL and not s.exterior]
    assert inner == []  # no step along the ridge: the placeholder was tilted to meet it


def test_planes_that_nearly_agree_meet_in_the_ridge():
    off = [houses.GABLE[0], (houses.GABLE[1][0], (0, -0.75, 9.2))]
    _, solid, row = built(off)
    assert [s for s in solid.shells[0] if s.kind == WALL and not s.exterior] == []
    assert row["volume"] == pytest.approx(houses.VOLUME["gable"] + 40 * 0.2, rel=1e-3)


def test_planes_that_do_not_agree_stay_a_step():
    off = [houses.GABLE[0], (houses.GABLE[1][0], (0, -0.75, 10.5))]
    _, solid, row = built(off)
    assert len([s for s in solid.shells[0] if s.kind == WALL and not s.exterior]) == 1
    assert row["volume"] == pytest.approx(houses.VOLUME["gable"] + 40 * 1.5)


def test_gaps_and_overlaps_of_half_a_metre_close():
    south, north = houses.GABLE
    for shift in (0.5, -0.5):
        moved = ([(x, y + shift) for x, y in north[0]], (0, -0.75, 9.0 + 0.75 * shift))
        _, solid, row = built([south, moved], sigma=0.3)
        assert (row["lod"], len(solid.shells)) == ("2.0", 1)
        assert [s for s in solid.shells[0] if s.kind == WALL and not s.exterior] == []
        assert row["footprint_area"] == pytest.approx(80 + 10 * shift, abs=0.5)


def test_what_a_high_roof_hid_goes_to_the_low_one_behind_it():
    high = ([(0, 0), (10, 0), (10, 8), (0, 8)], (0, 0, 6.0))
    low = ([(0, 8.9), (10, 8.9), (10, 14), (0, 14)], (0, 0, 4.5))
    _, solid, row = built([high, low])
    assert row["volume"] == pytest.approx(80 * 6 + 60 * 4.5, rel=0.01)
    assert len(solid.shells) == 1


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # making the outline with NaN, not the step
@pytest.mark.parametrize(
    "ring",
    [
        [(0, 0), (0, 0), (0, 0)],
        [(0, 0), (10, 0), (20, 0)],
        [(0, 0), (10, 10), (10, 0), (0, 10)],
        [(0, 0), (10, 0), (10, 8), (5, 8), (5, 40), (5, 8), (0, 8)],
        [(0, 0), (0.2, 0), (0.2, 0.2), (0, 0.2)],
        [(0, 0), (10, 0), (10, 8), (np.nan, 8), (0, 8)],
        [],
    ],
    ids=["point", "line", "bowtie", "spike", "tiny", "nan", "empty"],
)
def test_bad_outlines_never_raise_and_say_why(ring):
    for house in ([(ring, (0, 0, 4.0))], [(ring, (0, 0, 4.0)), *houses.GABLE]):
        sections, solid, row = built(house)
        assert shells_are_valid(solid)
        assert solid.lod == "2.0" or row["lod_reason"]
        json.dumps(features.feature(row, sections, solid, (500_000, 5_400_000), 0.0), allow_nan=False)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-15, 15), st.floats(-15, 15)), min_size=3, max_size=9),
    st.floats(-2, 2),
    st.floats(-2, 2),
)
def test_any_polygon_beside_a_house_is_survived(ring, a, b):
    _, solid, row = built([(ring, (a, b, 6.0)), *houses.WITH_WING])
    assert shells_are_valid(solid)
    assert solid.lod == "2.0" or row["lod_reason"]


def traced(house, gsd=0.38, degrees=17.0):
    """The house as a label image gives it: outlines along pixel corners, smoothed by 1.5 px; planes exact."""
    from affine import Affine
    from rasterio.features import rasterize, shapes

    house = houses.turned(house, degrees, (20.0, 20.0))
    place = Affine(gsd, 0, 0, 0, -gsd, 60.0)
    pieces = [(shapely.Polygon(ring), k + 1) for k, (ring, _) in enumerate(house)]
    labels = rasterize(pieces, (160, 160), transform=place, dtype="int32")
    found = [(int(v), shapely.geometry.shape(g)) for g, v in shapes(labels, mask=labels > 0)]
    largest = [max((g for v, g in found if v == k + 1), key=shapely.area) for k in range(len(house))]
    smooth = simplified(np.array(largest), 1.5)
    sections = list(shapely.transform(smooth, lambda p: np.column_stack([p[:, 0] * gsd, 60.0 - p[:, 1] * gsd])))
    planes = np.array([plane for _, plane in house])
    n = len(house)
    return solids.Sections(np.arange(1, n + 1), sections, planes, ["ok"] * n, np.full(n, 0.15), (0, 0), True)


@pytest.mark.parametrize("name", ["box", "gable", "hip", "l_house", "with_wing", "courtyard"])
def test_ragged_outlines_become_straight(name):
    sections = traced(houses.HOUSES[name])
    solid = solids.build(sections, FLAT)
    assert solid.lod == "2.0"
    exact = built(houses.HOUSES[name])[1]
    walls = [sum(s.kind == WALL and s.exterior for shell in x.shells for s in shell) for x in (solid, exact)]
    assert walls[0] <= walls[1] + 2
    volumes = [sum(gate.volume([s.rings for s in shell]) for shell in x.shells) for x in (solid, exact)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.05)


def shares(height, outline, lean=(0.0, 0.0), n=4):
    """LODs of all houses, each blurred and turned n times."""
    rng = np.random.default_rng(7)
    lods = Counter()
    for house in houses.HOUSES.values():
        for _ in range(n):
            seen = houses.turned(houses.blurred(house, rng, height, outline, lean), rng.uniform(0, 90))
            _, solid, _ = built(seen, sigma=max(height, 0.05))
            assert shells_are_valid(solid)
            lods[solid.lod] += 1
    return lods["2.0"] / lods.total()


def test_clean_houses_are_lod2():
    assert shares(0.0, 0.0) >= 0.95


def test_most_houses_stay_lod2_under_noise():
    assert shares(0.3, 0.3) >= 0.9
    assert shares(0.3, 0.1, lean=(0.1, 0.6)) >= 0.9


def test_noise_averages_out_in_the_volume():
    rng = np.random.default_rng(3)
    off = []
    for _ in range(12):
        row = built(houses.blurred(houses.HIP, rng, 0.2, 0.2), sigma=0.2)[2]
        off.append(row["volume"] / houses.VOLUME["hip"] - 1)
    assert abs(np.mean(off)) < 0.03


def test_the_order_of_rows_does_not_matter():
    rng = np.random.default_rng(5)
    table = houses.building_table(houses.blurred(houses.WITH_WING, rng, 0.2, 0.2))
    lines = set()
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(len(table))
        ((building, sections),) = solids.clusters_of(table.take(pa.array(order)))
        solid = solids.build(sections, FLAT)
        row = features.attributes(int(building[0]), sections, solid)
        lines.add(json.dumps(features.feature(row, sections, solid, (500_000, 5_400_000), 0.0)))
    assert len(lines) == 1


def test_a_block_is_written_with_attributes_and_semantics(tmp_path):
    scene = toy_city.make_scene(tmp_path)
    place = (toy_city.X0 + 40, toy_city.Y0 - 60)
    base = float(toy_city.GROUND.at(np.array([place]))[0])
    house = houses.turned(houses.HIP, 12.0)
    table = houses.building_table(house, place=place, base=base + 1.0, ids=[7, 5, 9, 11], sigma=0.2)
    store.write_by_block(tmp_path / "buildings.parquet", {"r000c000": table, "r000c001": table.slice(0, 0)})
    for name, expected in (("r000c000", 1), ("r000c001", 0)):
        out, attributes = tmp_path / f"{name}.city.jsonl", tmp_path / f"{name}.parquet"
        arguments = ["--scene", str(scene.folder / "scene.json"), "--buildings", str(tmp_path / "buildings.parquet")]
        arguments += ["--name", name, "--lod-label", "2.2", "--meshes", str(tmp_path / f"{name}.meshes.parquet")]
        solids.main([*arguments, "--out", str(out), "--attributes", str(attributes)])
        head, *lines = [json.loads(line) for line in out.read_text().splitlines()]
        rows = pq.read_table(attributes)
        assert rows.schema.equals(features.ATTRIBUTES)
        assert (len(lines), len(rows)) == (expected, expected)
        assert head["transform"]["scale"] == [0.001] * 3
    head, feature = [json.loads(line) for line in (tmp_path / "r000c000.city.jsonl").read_text().splitlines()]
    (row,) = pq.read_table(tmp_path / "r000c000.parquet").to_pylist()
    assert (row["building_id"], row["lod"], row["roof_type"], row["position_corrected"]) == (5, "2.2", "hip", True)
    xyz = np.array(feature["vertices"]) * head["transform"]["scale"] + head["transform"]["translate"]
    footprint = shapely.from_wkb(row["footprint"])
    assert xyz[:, 2].min() == pytest.approx(row["ground_z"], abs=1e-6)
    assert row["ground_z"] == pytest.approx(toy_city.GROUND.at(shapely.get_coordinates(footprint)).min(), abs=0.01)
    assert np.allclose([*xyz[:, :2].min(axis=0), *xyz[:, :2].max(axis=0)], footprint.bounds)
    (geometry,) = feature["CityObjects"]["building-5"]["geometry"]
    roofs = [s for s in geometry["semantics"]["surfaces"] if s["type"] == "RoofSurface"]
    assert sorted(s["section_id"] for s in roofs) == [5, 7, 9, 11]
    assert {(s["status"], s["height_sigma"]) for s in roofs} == {("ok", 0.2)}
    assert [round(s["slope"], 1) for s in roofs] == [36.9] * 4


def drawn(seen, apart, z=(9.0, 3.0)):
    """A high section and a low one west of it, `apart` m on the map; `seen` are their columns in the image (px)."""
    east, west = shapely.box(10, 0, 20, 10), shapely.box(0 - apart, 0, 10 - apart, 10)
    return solids.Sections(
        np.array([1, 2]),
        [east, west],
        np.array([[0.0, 0.0, z[0]], [0.0, 0.0, z[1]]]),
        ["ok", "ok"],
        np.full(2, 0.1),
        (0, 0),
        seen=np.array([shapely.box(a, 0.5, b, 20.5) for a, b in seen], object),
    )


@pytest.mark.parametrize(
    ("seen", "apart", "closed"),
    [
        (((20.25, 40.25), (0.25, 20.25)), 1.2, True),  # they meet in the image: the step hid the strip
        (((20.25, 40.25), (-3.75, 16.25)), 1.2, False),  # an alley is seen between them
        (((20.25, 40.25), (2.25, 22.25)), 1.2, False),  # drawn whole, with what the high one hides: the alley is real
    ],
)
def test_a_gap_between_drawn_sections_is_closed_only_where_a_step_hid_it(seen, apart, closed):
    sections = drawn(seen, apart)
    fit = solids.fit_of(sections, np.array([[1.0, 0.0]] * 2), 0.38)
    one = solids.build(sections, FLAT, fit=fit)
    footprint = sum(shapely.area(shapely.get_parts(one.base)))
    assert footprint == pytest.approx(200.0 + (10 * apart if closed else 0.0), abs=0.1)
    assert shells_are_valid(one)


def under(low):
    """A roof 9 m high over 10 x 10 m, and a building 3 m high whose outline is `low`."""
    planes = np.array([[0.0, 0.0, 9.0], [0.0, 0.0, 3.0]])
    outlines = [shapely.box(0, 0, 10, 10), shapely.box(*low)]
    return solids.Sections(np.array([1, 2]), outlines, planes, ["ok", "ok"], np.full(2, 0.1), (0, 0))


def test_a_low_building_ends_where_another_ones_roof_begins():
    found = solids.together(under((5, 2, 14, 8)), np.array([1, 2]), FLAT)
    assert [(built.building, built.solid.lod) for built in found] == [(1, "2.0"), (2, "2.0")]
    bases = [shapely.union_all(shapely.get_parts(built.solid.base)) for built in found]
    assert bases[0].intersection(bases[1]).area < 1e-6
    assert [base.area for base in bases] == pytest.approx([100.0, 24.0], rel=1e-3)


def test_a_building_wholly_under_another_ones_roof_is_told_not_built():
    high, low = solids.together(under((4, 4, 6, 6)), np.array([1, 2]), FLAT)
    assert (high.solid.lod, high.solid.reason) == ("2.0", "")
    assert (low.solid.lod, low.solid.shells) == ("0", [])
    assert "under the roofs of the buildings it touches" in low.solid.reason
    assert low.solid.base.area == pytest.approx(4.0)
