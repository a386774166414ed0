"""Clip: roofs that dive into the ground end there, and what is made of those that mostly do."""

import houses
import numpy as np
import pytest
import shapely
from houses import FLAT, built, shells_are_valid

from kibs_steps import clip, shells, solids, terrain
from kibs_steps.faces import Face


def test_a_roof_that_dives_into_the_ground_ends_there():
    steep = [([(0, 0), (10, 0), (10, 10), (0, 10)], (0, 0.8, -1.0))]
    _, solid, row = built(steep)
    assert row["lod"] == "2.0"
    assert "section 1 comes down to -1.00 m above the ground" in row["lod_reason"]
    assert row["eave_z"] == pytest.approx(0.5, abs=0.01)
    assert row["volume"] == pytest.approx(10 * (7.0**2 - 0.5**2) / 1.6, rel=2e-3)
    assert shells_are_valid(solid)


def test_a_cut_roof_stands_on_the_ground_under_what_stays_of_it():
    """On a hillside the lowest ground lies under the part that is cut off."""
    hillside = terrain.Terrain(
        np.tile(np.arange(200) * 0.3, (200, 1)), -10.25, 60.0, (0.5, 0.5)
    )  # rises by 0.6 to the east
    dives = solids.Sections(
        np.array([1]), [shapely.box(0, 0, 10, 6)], np.array([[0.9, 0, 5.2]]), ["ok"], np.full(1, 0.1), (0, 0)
    )
    solid = solids.build(dives, hillside)
    assert solid.lod == "2.0"
    rim = shapely.get_coordinates(shapely.segmentize(solid.base, 0.1))
    assert solid.ground / 1000 == pytest.approx(hillside(rim).min(), abs=0.002)
    lowest = min(
        z for shell in solid.shells for s in shell if s.kind == "RoofSurface" for ring in s.rings for *_, z in ring
    )
    assert lowest - solid.ground == pytest.approx(500, abs=2)
    assert shells_are_valid(solid)


def test_of_a_house_only_the_section_that_dives_is_cut():
    house = [*houses.HIP, ([(14, 1), (22, 1), (22, 8), (14, 8)], (-0.5, 0, 10.8))]
    _, solid, row = built(house)
    assert row["lod"] == "2.0"
    assert row["lod_reason"].startswith("2.0: section 5 comes down to")
    assert row["volume"] == pytest.approx(houses.VOLUME["hip"] + 7 * (3.8**2 - 0.5**2) / 1.0, rel=2e-3)
    assert row["footprint"].bounds[2] - 500_000 == pytest.approx(20.6, abs=0.02)
    assert shells_are_valid(solid)


def test_a_cut_may_leave_several_parts():
    comb = shapely.box(0, 0, 12, 10) - shapely.box(3, -1, 5, 6) - shapely.box(7, -1, 9, 6)
    sections = solids.Sections(np.array([1]), [comb], np.array([[0, 0.5, -0.5]]), ["ok"], np.full(1, 0.1), (0, 0))
    solid = solids.build(sections, FLAT)
    assert solid.lod == "2.0"
    assert shells_are_valid(solid)
    assert solid.base.bounds[1] == pytest.approx(2.0, abs=0.01)


def test_neighbours_that_both_dive_are_both_cut():
    """Two faces share an edge at different heights: each is cut where its own plane comes down, whichever is first."""
    squares = [
        [(0, 0), (10_000, 0), (10_000, 10_000), (0, 10_000)],
        [(10_000, 0), (20_000, 0), (20_000, 10_000), (10_000, 10_000)],
    ]
    both = [Face(k, [ring]) for k, ring in enumerate(squares)]
    planes = np.array([[0, 0.1, 0.2], [0, 0.1, 0.1]])
    for order in (both, both[::-1]):
        for face in clip.clipped(order, planes, {0, 1}, 500):
            assert min(shells.height(planes[face.section], p) for p in face.rings[0]) >= 499


def test_a_roof_mostly_below_ground_is_made_level_and_told():
    house = [*houses.HIP, ([(14, 1), (22, 1), (22, 8), (14, 8)], (-2.0, 0, 33.0))]
    _, solid, row = built(house)
    assert row["lod"] == "2.0"
    assert "of a section would lie below the ground" in row["lod_reason"]
    assert row["eave_z"] == pytest.approx(0.5, abs=0.01)
    assert shells_are_valid(solid)


def test_a_roof_wholly_below_ground_stays_as_a_footprint():
    _, solid, row = built([(ring, (0, 0, -2.0)) for ring, _ in houses.BOX])
    assert (row["lod"], row["valid"], solid.shells) == ("0", False, [])
    assert row["footprint"].area == pytest.approx(20.0)
    assert (row["volume"], row["height"], row["roof_type"]) == (None, None, None)
    assert "above the ground" in row["lod_reason"]


def test_a_cut_roof_whose_short_edges_are_drawn_together_stays_above_the_ground():
    """Cut at the lowest height, this one ended 2 mm below it once tidied, and was made level."""
    dives = [(-5.41, -5.95), (-3.78, 2.03), (-7.38, 5.98), (1.73, 2.56), (-4.17, -6.17)]
    beside = [(5.5, 1.15), (7.74, -0.52), (5.58, -4.97), (1.1, -7.09), (-4.17, -6.17), (1.73, 2.56)]
    _, solid, row = built([(dives, (-0.925, 0.434, -0.687)), (beside, (0, 0, 6.0))])
    assert row["lod_reason"] == "2.0: section 1 comes down to -1.18 m above the ground"
    assert row["faithful"] == 1.0
    assert shells_are_valid(solid)
