"""Features: the type of a roof, and what a house of known form says of itself."""

import itertools

import houses
import numpy as np
import pytest
import shapely
from houses import FLAT, built

from kibs_steps import features, solids
from kibs_steps.faces import Face


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("box", "flat"),
        ("shed", "shed"),
        ("gable", "gable"),
        ("hip", "hip"),
        ("pyramid", "pyramid"),
        ("with_wing", "complex"),
    ],
)
def test_roof_types(name, kind):
    assert built(houses.turned(houses.HOUSES[name], 37.0))[2]["roof_type"] == kind


def test_two_slopes_falling_towards_each_other_are_no_gable():
    butterfly = [(ring, (0, -b, 6 + 8 * b if b < 0 else 6)) for ring, (_, b, _) in houses.GABLE]
    assert built(butterfly)[2]["roof_type"] == "complex"


def test_the_type_of_a_roof_does_not_depend_on_ids():
    """Slopes that face 0°, 20° and 40°: the middle one goes with either."""
    facing = np.radians([0, 20, 40])
    planes = np.array([(-0.5 * np.sin(a), -0.5 * np.cos(a), 5.0) for a in facing])
    for wide in (4000, 5000, 6000):  # mm: the middle one is the smallest, as large as the others, the largest
        ends = np.cumsum([0, 5000, wide, 5000])
        squares = [[[(a, 0), (b, 0), (b, 5000), (a, 5000)]] for a, b in itertools.pairwise(ends.tolist())]
        kinds = {
            features.roof_type([Face(i, squares[k]) for i, k in enumerate(order)], planes[list(order)])
            for order in itertools.permutations(range(3))
        }
        assert len(kinds) == 1


def test_attributes_of_a_gable_house():
    _, _, row = built(houses.GABLE, base=0.0)
    assert (row["ground_z"], row["eave_z"], row["ridge_z"], row["height"]) == (0.0, 3.0, 6.0, 6.0)
    assert (row["n_sections"], row["position_corrected"], row["footprint_area"]) == (2, True, 80.0)
    assert row["footprint"].equals(shapely.box(500_000, 5_400_000, 500_010, 5_400_008))
    assert row["outline"].geom_type == "MultiPolygon"
    assert row["outline"].area == pytest.approx(80.0)


def test_a_buildings_uncertainty_is_that_of_its_sections_by_area():
    large, small = shapely.box(0, 0, 9, 8), shapely.box(9, 0, 12, 8)
    flat = np.array([[0, 0, 4.0], [0, 0, 6.5]])
    sections = solids.Sections(
        np.array([1, 2]), [large, small], flat, ["ok"] * 2, np.array([0.2, 0.6]), (0, 0), spread=np.array([0.4, 1.2])
    )
    solid = solids.build(sections, FLAT)
    row = features.attributes(1, sections, solid)
    assert (row["height_sigma"], row["position_sigma"], row["position_corrected"]) == (0.3, 0.6, True)
    unknown = features.attributes(1, sections._replace(spread=np.full(2, np.nan)), solid)
    assert (unknown["position_sigma"], unknown["position_corrected"]) == (None, False)


def test_roof_surfaces_say_how_they_lie():
    """A gable's two slopes fall north and south of the grid, which is turned against true north by 1.5°."""
    sections, solid, row = built(houses.GABLE)
    line = features.feature(row, sections, solid, (500_000, 5_400_000), 1.5)
    (geometry,) = line["CityObjects"]["building-1"]["geometry"]
    roofs = {s["section_id"]: s for s in geometry["semantics"]["surfaces"] if s["type"] == "RoofSurface"}
    for number, (ring, (_, b, _)) in enumerate(houses.GABLE, start=1):
        slope = np.arctan(abs(b))
        assert roofs[number]["slope"] == pytest.approx(np.degrees(slope), abs=0.01)
        assert roofs[number]["azimuth"] == (1.5 if b < 0 else 181.5)
        assert roofs[number]["area"] == pytest.approx(shapely.Polygon(ring).area / np.cos(slope), abs=0.01)
