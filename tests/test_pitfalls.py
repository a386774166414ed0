"""What breaks solids elsewhere, each a test: every result passes a gate that was written apart from the builder."""

import json

import houses
import independent
import numpy as np
import pytest
import shapely

from kibs_steps import features, gate, solids, terrain
from kibs_steps.shells import ROOF, WALL

try:
    import by_cgal
except ImportError:
    by_cgal = None

FLAT = terrain.flat(0.0)


def made(polygons, planes, building=None, status=None, **how):
    """Solids (by building) of sections, each held against the independent gate and CGAL."""
    n = len(polygons)
    building = np.zeros(n, int) if building is None else np.asarray(building)
    sections = solids.Sections(
        np.arange(1, n + 1),
        list(polygons),
        np.array(planes, float),
        status or ["ok"] * n,
        np.full(n, 0.05),
        (0, 0),
        **how,
    )
    found = {}
    for name, mine, solid in solids.together(sections, building, FLAT):
        row = features.attributes(name, mine, solid)
        feature = features.feature(row, mine, solid, (0, 0), 0.0)
        xyz = np.array(feature["vertices"], float) / 1000
        for thing in feature["CityObjects"].values():
            for geometry in thing.get("geometry", []):
                if geometry["type"] == "Solid":
                    assert independent.faults(geometry["boundaries"][0], xyz) == []
                    if by_cgal is not None:
                        assert by_cgal.faults(geometry["boundaries"][0], xyz) == []
        json.dumps(feature, allow_nan=False)
        found[name] = row, solid
    return found


def one(polygons, planes, **how):
    ((row, solid),) = made(polygons, planes, **how).values()
    return row, solid


def level(*heights):
    return [(0, 0, z) for z in heights]


def ring(house):
    return [shapely.Polygon(r) for r, _ in house], [p for _, p in house]


@pytest.mark.skipif(by_cgal is None, reason="cgal is not installed")
def test_cgal_refuses_what_is_broken():
    xyz = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float)
    cube = [[[3, 2, 1, 0]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]
    assert by_cgal.faults(cube, xyz) == []
    assert by_cgal.faults(cube[1:], xyz) == ["not closed"]
    assert "looks inward" in by_cgal.faults([[r[0][::-1]] for r in cube], xyz)
    pushed = np.vstack([xyz, xyz * 0.5 + (0.4, 0.4, 0.7)])
    assert "cuts itself" in by_cgal.faults(cube + [[[v + 8 for v in r[0]]] for r in cube], pushed)


def test_the_independent_gate_refuses_what_is_broken():
    xyz = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float)
    cube = [[[3, 2, 1, 0]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]
    assert independent.faults(cube, xyz) == []
    assert "no twin" in independent.faults(cube[1:], xyz)[0]
    assert "volume" in independent.faults([[r[0][::-1]] for r in cube], xyz)[0]
    bent = xyz.copy()
    bent[6, 2] = 1.02
    assert "off its plane" in independent.faults(cube, bent)[0]
    pushed = np.vstack([xyz, xyz * 0.5 + (0.4, 0.4, 0.7)])
    both = cube + [[[v + 8 for v in r[0]]] for r in cube]
    assert any("cuts" in text for text in independent.faults(both, pushed))


def test_a_courtyard_that_touches_the_outer_ring_in_a_point():
    outer, court = shapely.box(0, 0, 12, 12), shapely.Polygon([(0, 6), (4, 4), (4, 8)])
    row, _ = one([outer.difference(court)], level(4.0))
    assert row["lod"] == "2.0"
    assert row["volume"] == pytest.approx((144 - 8) * 4, rel=2e-3)


def test_blocks_that_touch_in_a_corner_are_two_parts():
    found = made([shapely.box(0, 0, 5, 5), shapely.box(5, 5, 9, 9)], level(4.0, 6.0))
    row, solid = found[0]
    assert row["lod"] == "2.0"
    assert row["volume"] == pytest.approx(25 * 4 + 16 * 6, rel=5e-3)
    assert len(solid.shells) == 2


def test_chessboard_steps():
    cells = [(x, y) for x in range(4) for y in range(4)]
    row, _ = one(
        [shapely.box(4 * x, 4 * y, 4 * x + 4, 4 * y + 4) for x, y in cells],
        level(*(4.0 + 2 * ((x + y) % 2) for x, y in cells)),
    )
    assert row["lod"] == "2.0"
    assert row["volume"] == pytest.approx(16 * 16 * 5, rel=2e-3)


def test_pinwheel():
    arms = [shapely.box(0, 0, 6, 3), shapely.box(6, 0, 9, 6), shapely.box(3, 6, 9, 9), shapely.box(0, 3, 3, 9)]
    row, _ = one([*arms, shapely.box(3, 3, 6, 6)], level(3, 4, 5, 6, 7))
    assert (row["lod"], row["faithful"]) == ("2.0", 1.0)
    assert row["volume"] == pytest.approx(18 * (3 + 4 + 5 + 6) + 9 * 7)


def test_t_junctions():
    row, _ = one(
        [shapely.box(0, 0, 12, 5), shapely.box(0, 5, 4, 9), shapely.box(4, 5, 9, 9), shapely.box(9, 5, 12, 9)],
        level(3, 4, 5, 4),
    )
    assert (row["lod"], row["faithful"]) == ("2.0", 1.0)
    assert row["volume"] == pytest.approx(60 * 3 + 16 * 4 + 20 * 5 + 12 * 4)


@pytest.mark.parametrize("step", [0.004, 0.0006])
def test_steps_of_millimetres(step):
    row, _ = one([shapely.box(0, 0, 5, 5), shapely.box(5, 0, 9, 5)], level(4.0, 4.0 + step))
    assert row["lod"] == "2.0"
    assert row["volume"] == pytest.approx(45 * 4, rel=1e-3)


def test_slivers_of_two_centimetres():
    row, _ = one(
        [shapely.box(0, 0, 5, 5), shapely.box(5, 0, 5.02, 5), shapely.box(5.02, 0, 9, 5)], level(4.0, 9.0, 5.0)
    )
    assert row["lod"] == "2.0"
    assert row["volume"] == pytest.approx(25 * 4 + 20 * 5, abs=1.0)


@pytest.mark.parametrize("gap", [0.02, -0.02, 0.3])
def test_gaps_and_overlaps_between_neighbours(gap):
    row, solid = one([shapely.box(0, 0, 5, 5), shapely.box(5 + gap, 0, 9, 5)], level(4.0, 4.0))
    assert (row["lod"], len(solid.shells)) == ("2.0", 1)
    assert row["footprint_area"] == pytest.approx(45, abs=0.2)


def test_a_plane_below_ground():
    row, _ = one([shapely.box(0, 0, 10, 10)], [(0, 0.8, -1.0)])
    assert row["lod"] == "2.0"
    assert row["eave_z"] == pytest.approx(0.5, abs=0.01)


def test_sections_with_holes_and_sections_in_them():
    inner = shapely.box(4, 4, 8, 8)
    island = shapely.box(5, 5, 6, 6)
    row, _ = one([shapely.box(0, 0, 12, 12) - inner, inner - island, island], level(4, 6, 8))
    assert (row["lod"], row["faithful"]) == ("2.0", 1.0)
    assert row["volume"] == pytest.approx(128 * 4 + 15 * 6 + 8)
    row, _ = one([shapely.box(0, 0, 12, 12) - inner], level(4))
    assert row["volume"] == pytest.approx(128 * 4)


def test_sections_of_one_pixel():
    pixel = shapely.box(0, 0, 0.38, 0.38)
    row, _ = one([pixel], level(4.0))
    assert row["lod"] == "0" or row["valid"]
    assert row["lod"] == "2.0" or row["lod_reason"]
    row, _ = one([shapely.box(0.38, 0, 6, 6), pixel], level(4.0, 6.0))
    assert row["lod"] == "2.0"
    assert row["volume"] == pytest.approx(5.62 * 6 * 4, rel=0.02)


def test_a_section_cut_by_the_rasters_edge_keeps_its_plane():
    polygons, planes = ring(houses.GABLE)
    cut = [p.intersection(shapely.box(0, -1, 6.3, 20)) for p in polygons]
    row, _ = one(cut, planes, status=["raster_edge"] * 2)
    assert (row["lod"], row["faithful"]) == ("2.0", 1.0)
    assert row["volume"] == pytest.approx(houses.VOLUME["gable"] * 0.63, rel=1e-3)


def row_of_houses(n, width=6.0):
    """n gable houses in a row, each half a metre higher or lower than the last: sections, planes, building of each."""
    polygons, planes, building = [], [], []
    for k in range(n):
        x = k * width
        up = 0.5 * (k % 3)
        polygons += [shapely.box(x, 0, x + width, 4), shapely.box(x, 4, x + width, 8)]
        planes += [(0, 0.75, 3 + up), (0, -0.75, 9 + up)]
        building += [k, k]
    return polygons, planes, building


def test_a_row_of_twenty_houses_as_one_building_and_as_twenty():
    polygons, planes, building = row_of_houses(20)
    volume = 48 * sum(4.5 + 0.5 * (k % 3) for k in range(20))
    row, solid = one(polygons, planes)
    assert (row["lod"], row["faithful"], len(solid.shells)) == ("2.0", 1.0, 1)
    assert row["volume"] == pytest.approx(volume, rel=1e-3)
    found = made(polygons, planes, building)
    assert len(found) == 20
    assert {row["lod"] for row, _ in found.values()} == {"2.0"}
    assert sum(row["volume"] for row, _ in found.values()) == pytest.approx(volume, rel=1e-3)
    for k in range(20):
        assert len(found[k][1].party) == 2 * ((k > 0) + (k < 19))


def plan_points(solid):
    return {p[:2] for shell in solid.shells for s in shell for r in s.rings for p in r}


def test_party_walls_of_different_heights_are_one_line():
    """Outlines that misfit by 20 cm: after that both buildings have the same vertices on the wall between them."""
    polygons = [shapely.box(0, 0, 8, 10), shapely.Polygon([(8.2, 1), (15, 1), (15, 9), (7.9, 9)])]
    found = made(polygons, level(12.0, 6.0), [0, 1])
    (_, high), (_, low) = found[0], found[1]
    shared = plan_points(high) & plan_points(low)
    assert len(shared) >= 2
    assert np.ptp([y for _, y in shared]) == pytest.approx(8000, abs=1000)
    assert {(v, u) for u, v in high.party} == set(low.party)
    areas = [shapely.union_all(shapely.make_valid([shapely.Polygon(r[0]) for r in grounds(s)])) for s in (high, low)]
    assert areas[0].intersection(areas[1]).area == 0.0
    walls = [s for shell in low.shells for s in shell if s.kind == WALL]
    assert any((w.rings[0][-1][:2], w.rings[0][0][:2]) in low.party for w in walls)


def grounds(solid):
    return [[[p[:2] for p in r] for r in s.rings] for shell in solid.shells for s in shell if s.kind == "GroundSurface"]


def test_party_walls_are_told_in_the_cityjson():
    polygons, planes, building = row_of_houses(3)
    n = len(polygons)
    sections = solids.Sections(
        np.arange(1, n + 1), polygons, np.array(planes, float), ["ok"] * n, np.full(n, 0.05), (0, 0)
    )
    name, mine, solid = solids.together(sections, np.array(building), FLAT)[1]
    feature = features.feature(features.attributes(name, mine, solid), mine, solid, (0, 0), 0.0)
    (geometry,) = feature["CityObjects"]["building-1"]["geometry"]
    kinds = [geometry["semantics"]["surfaces"][k] for k in geometry["semantics"]["values"][0]]
    assert sum(bool(k.get("party_wall")) for k in kinds) == 4
    assert not any(k["exterior"] for k in kinds if k.get("party_wall"))


def test_party_walls_are_those_that_are_published():
    """A roof that dives at its far end shares its wall as far as it stands; one without a solid leaves its neighbour's free."""
    polygons = [shapely.box(0, 0, 10, 8), shapely.box(0, -8, 10, 0)]
    party = {}
    for slope in (-0.7, -1.3):
        planes = np.array([[slope, 0, 6.0], [0, 0, 9.5]])
        sections = solids.Sections(np.arange(1, 3), polygons, planes, ["ok"] * 2, np.full(2, 0.3), (0, 0))
        party[slope] = [built.solid.party for built in solids.together(sections, np.array([1, 2]), FLAT)]
    (((start, end),), neighbours) = party[-0.7]
    assert (start, end[1]) == ((0, 0), 0)
    assert end[0] == pytest.approx(7857, abs=10)  # 0.5 m above the ground
    assert neighbours == {((10_000, 0), (0, 0))}
    assert party[-1.3] == [frozenset(), frozenset()]


def test_what_cannot_be_tiled_together_is_made_alone(monkeypatch):
    whole = solids.partition

    def fails(polygons, *rest):
        if len(polygons) > 2:
            raise solids.NoPartition("too many")
        return whole(polygons, *rest)

    monkeypatch.setattr(solids, "partition", fails)
    polygons, planes, building = row_of_houses(3)
    found = made(polygons, planes, building)
    assert [row["lod"] for row, _ in found.values()] == ["2.0"] * 3


def test_faithful_counts_faces_on_their_planes():
    polygons, planes = ring(houses.GABLE)
    row, solid = one(polygons, planes)
    assert row["faithful"] == 1.0
    n = len(polygons)
    off = solids.Sections(
        np.arange(1, n + 1),
        polygons,
        np.array(planes, float) + np.array([(0, 0, 0), (0, 0, 0.3)]),
        ["ok"] * n,
        np.full(n, 0.05),
        (0, 0),
    )
    assert features.faithful(off, solid) == 0.5
    assert features.faithful(off._replace(polygons=[shapely.box(0, 0, 1, 1)] * 2), solid) is None
    assert {s.kind for shell in solid.shells for s in shell} >= {ROOF, WALL}
    assert gate.check([s.rings for s in solid.shells[0]]) == []
