"""A known house in, its sections, corners and heights out exactly, in every version and shape of the format."""

import json
import os
from pathlib import Path

import cities
import numpy as np
import pytest
import shapely

from kibs_steps.simulate import citymodel
from kibs_steps.simulate.citymodel import UnusableCity
from kibs_steps.zbuffer import Polygon

SHIFT = (84000.0, 446000.0, -2.0)
HOUSE = cities.gable(84010.0, 446020.0)


def corners(faces):
    return sorted(tuple(np.round(p, 6).tolist()) for face in faces for p in face.ring)


@pytest.mark.parametrize("version", ["0.8", "1.1", "2.0"])
@pytest.mark.parametrize("solid", [True, False])
@pytest.mark.parametrize("semantics", [True, False])
def test_a_gable_house_comes_out_as_it_went_in(tmp_path, version, solid, semantics):
    path = cities.write(tmp_path / "c.json", [HOUSE], version=version, solid=solid, semantics=semantics, shift=SHIFT)
    model = citymodel.read(path)
    (building,) = model.buildings
    assert model.crs == "EPSG:28992"
    assert len(building.roofs) == 2
    assert len(building.walls) == 4
    assert building.base == pytest.approx(5.0)
    assert building.centre == pytest.approx((84015.0, 446024.0))
    expected = sorted(tuple(map(float, p)) for ring, kind in HOUSE if kind == "RoofSurface" for p in ring)
    assert corners(building.roofs) == expected


def test_a_sequence_is_the_same_city(tmp_path):
    houses = [HOUSE, cities.gable(84040.0, 446020.0, 5.5)]
    whole = citymodel.read(cities.write(tmp_path / "c.json", houses, shift=SHIFT))
    parts = citymodel.read(cities.write_sequence(tmp_path / "c.jsonl", houses, shift=SHIFT))
    assert [b.name for b in whole.buildings] == [b.name for b in parts.buildings] == ["b0", "b1"]
    for a, b in zip(whole.buildings, parts.buildings, strict=True):
        assert corners(a.roofs) == corners(b.roofs)


def test_the_highest_detail_counts(tmp_path):
    document = cities.document([HOUSE], shift=SHIFT)
    part = document["CityObjects"]["b0-0"]
    low = json.loads(json.dumps(part["geometry"][0]))
    low["lod"] = "1.2"
    low["boundaries"][0] = low["boundaries"][0][:1]
    part["geometry"].insert(0, low)
    (tmp_path / "c.json").write_text(json.dumps(document))
    assert len(citymodel.read(tmp_path / "c.json").buildings[0].roofs) == 2


def test_a_building_that_has_lod3_too_is_shown_by_its_lod2(tmp_path):
    document = cities.document([HOUSE], shift=SHIFT)
    part = document["CityObjects"]["b0-0"]
    part["geometry"].append({**part["geometry"][0], "lod": "3"})
    (tmp_path / "c.json").write_text(json.dumps(document))
    assert len(citymodel.read(tmp_path / "c.json").buildings[0].roofs) == 2


def test_a_building_of_lod3_alone_is_shown_by_that(tmp_path):
    model = citymodel.read(cities.write(tmp_path / "c.json", [HOUSE], lod=3.0, shift=SHIFT))
    assert len(model.buildings[0].roofs) == 2


def test_a_terrace_is_a_roof(tmp_path):
    """OuterFloorSurfaces look up, and are seen from above."""
    document = cities.document([HOUSE], shift=SHIFT)
    document["CityObjects"]["b0-0"]["geometry"][0]["semantics"]["surfaces"][0]["type"] = "OuterFloorSurface"
    (tmp_path / "c.json").write_text(json.dumps(document))
    assert len(citymodel.read(tmp_path / "c.json").buildings[0].roofs) == 2


def test_surfaces_that_show_their_inner_sides_are_turned(tmp_path):
    """Of a MultiSurface nobody says which way it turns."""
    turned = [(ring[::-1], kind) for ring, kind in HOUSE]
    model = citymodel.read(cities.write(tmp_path / "c.json", [turned], solid=False, semantics=False, shift=SHIFT))
    expected = sorted(tuple(map(float, p)) for ring, kind in HOUSE if kind == "RoofSurface" for p in ring)
    assert corners(model.buildings[0].roofs) == expected
    valley = [
        ([[0, 0, 9], [5, 0, 6], [5, 8, 6], [0, 8, 9]], "RoofSurface"),
        ([[5, 0, 6], [10, 0, 9], [10, 8, 9], [5, 8, 6]], "RoofSurface"),
    ]
    roofs = citymodel.read(cities.write(tmp_path / "v.json", [valley], solid=False, semantics=False)).buildings[0].roofs
    assert len(roofs) == 2  # roofs alone enclose nothing


@pytest.mark.parametrize(
    "flaw", ["few semantics", "wild semantic", "no rings", "odd lod", "no type", "number", "flat terrain", "mark"]
)
def test_ordinary_flaws_are_survived(tmp_path, flaw):
    document = cities.document([HOUSE], shift=SHIFT)
    objects = document["CityObjects"]
    geometry = objects["b0-0"]["geometry"][0]
    if flaw == "few semantics":
        geometry["semantics"]["values"][0].pop(0)
        geometry["semantics"]["values"][0] = [None, *geometry["semantics"]["values"][0]][:6]
    if flaw == "wild semantic":
        geometry["semantics"]["values"][0][-1] = 9
    if flaw == "no rings":
        geometry["boundaries"][0].append([])
    if flaw == "odd lod":
        objects["bench"] = {
            "type": "CityFurniture",
            "geometry": [{"type": "MultiSurface", "lod": "2.2.1", "boundaries": []}],
        }
        objects["b0-0"]["geometry"].append({"type": "MultiSurface", "lod": None, "boundaries": []})
    if flaw == "no type":
        objects["thing"] = {"geometry": []}
    if flaw == "number":
        document["metadata"]["referenceSystem"] = 28992
    if flaw == "flat terrain":
        objects["ground"] = {
            "type": "TINRelief",
            "geometry": [{"type": "CompositeSurface", "lod": "1", "boundaries": [[[0, 1, 0]]]}],
        }
    text = json.dumps(document)
    (tmp_path / "c.json").write_text("\ufeff" + text if flaw == "mark" else text, encoding="utf-8")
    model = citymodel.read(tmp_path / "c.json")
    assert len(model.buildings[0].roofs) == 2
    assert model.crs == "EPSG:28992"
    assert model.terrain is None


def test_a_group_of_buildings_is_no_building(tmp_path):
    document = cities.document([HOUSE, cities.gable(84040.0, 446020.0, 5.5)], shift=SHIFT)
    tops = [name for name, item in document["CityObjects"].items() if item["type"] == "Building"]
    document["CityObjects"]["street"] = {"type": "CityObjectGroup", "children": tops, "geometry": []}
    for name in tops:
        document["CityObjects"][name]["parents"] = ["street"]
    (tmp_path / "c.json").write_text(json.dumps(document))
    assert [b.name for b in citymodel.read(tmp_path / "c.json").buildings] == tops


@pytest.mark.parametrize(
    ("system", "crs"),
    [
        ("https://www.opengis.net/def/crs/EPSG/0/7415", "EPSG:28992"),
        ("https://www.opengis.net/def/crs/EPSG/0/28992/", "EPSG:28992"),
        ("urn:ogc:def:crs:EPSG::25832", "EPSG:25832"),
        ("urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::7837", "EPSG:25832"),
        (
            "https://www.opengis.net/def/crs-compound?1=https://www.opengis.net/def/crs/EPSG/0/28992&"
            "2=https://www.opengis.net/def/crs/EPSG/0/5709",
            "EPSG:28992",
        ),
        (None, None),
    ],
)
def test_the_horizontal_system_is_read(tmp_path, system, crs):
    document = cities.document([HOUSE], shift=SHIFT)
    document["metadata"] = {"referenceSystem": system} if system else {}
    (tmp_path / "c.json").write_text(json.dumps(document))
    assert citymodel.read(tmp_path / "c.json").crs == crs


@pytest.mark.parametrize("number", [2263, 5709])
def test_coordinates_that_are_not_metres_in_plan_are_refused(tmp_path, number):
    document = cities.document([HOUSE], shift=SHIFT)
    document["metadata"] = {"referenceSystem": f"https://www.opengis.net/def/crs/EPSG/0/{number}"}
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(UnusableCity, match="not metres"):
        citymodel.read(tmp_path / "c.json")


def test_facets_of_a_vault_are_no_one_plane():
    angle = np.radians(np.arange(60.0, 121.0, 1.5))
    x, z = -16.0 * np.cos(angle), 16.0 * np.sin(angle)
    facets = [
        Polygon(np.array([[a, 0, p], [b, 0, q], [b, 10, q], [a, 10, p]]))
        for a, b, p, q in zip(x, x[1:], z, z[1:], strict=False)
    ]
    found = citymodel.sections(facets)
    assert 2 <= len(found) < len(facets)
    for face in found:
        points = face.ring - face.ring.mean(axis=0)
        assert np.abs(points @ np.linalg.svd(points)[2][-1]).max() < citymodel.ARCHED
    assert sum(shapely.Polygon(face.ring[:, :2]).area for face in found) == pytest.approx(160.0, abs=0.1)


def test_neighbours_in_one_plane_are_one_section():
    left = Polygon(np.array([[0, 0, 3], [4, 0, 3], [4, 2, 4.0], [4, 4, 5], [0, 4, 5]], float))
    right = Polygon(np.array([[4, 0, 3], [9, 0, 3], [9, 4, 5], [4, 4, 5], [4, 2, 4]], float))
    other = Polygon(np.array([[0, 4, 5], [9, 4, 5], [9, 8, 3], [0, 8, 3]], float))
    found = citymodel.sections([left, right, other])
    assert len(found) == 2
    merged = next(f for f in found if f.ring[:, 1].min() == 0)
    assert corners([merged]) == [(0, 0, 3), (0, 4, 5), (9, 0, 3), (9, 4, 5)]
    # The same plane without a shared edge stays apart, and so does another height.
    away = Polygon(right.ring + np.array([3.0, 0, 0]))
    higher = Polygon(right.ring + np.array([0, 0, 0.3]))
    assert len(citymodel.sections([left, away])) == 2
    assert len(citymodel.sections([left, higher])) == 2


def test_a_hole_stays_a_hole():
    hole = np.array([[3, 3, 6], [3, 5, 6], [5, 5, 6], [5, 3, 6]], float)
    (face,) = citymodel.sections([Polygon(np.array([[0, 0, 6], [9, 0, 6], [9, 9, 6], [0, 9, 6]], float), (hole,))])
    assert len(face.holes) == 1
    assert corners([Polygon(face.holes[0])]) == [(3, 3, 6), (3, 5, 6), (5, 3, 6), (5, 5, 6)]


def test_a_bent_surface_becomes_planar_ones():
    bent = Polygon(np.array([[0, 0, 3], [8, 0, 3], [8, 8, 3], [0, 8, 6]], float))
    found = citymodel.sections([bent])
    assert len(found) == 2
    assert sum(shapely.Polygon(f.ring[:, :2]).area for f in found) == pytest.approx(64)
    assert {p for f in found for p in corners([f])} == set(corners([bent]))


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("no json", "not JSON"),
        ('{"type": "FeatureCollection"}', "not CityJSON"),
        (json.dumps(cities.document([HOUSE], lod=1.2)), "LOD2"),
        (json.dumps(cities.document([])), "LOD2"),
        (json.dumps(cities.document([HOUSE], crs=4979)), "degrees"),
        (json.dumps(cities.document([HOUSE], crs=999999)), "not known"),
        (json.dumps({**cities.document([HOUSE]), "metadata": {"referenceSystem": "OGC:CRS84h"}}), "not known"),
        (json.dumps({**cities.document([HOUSE]), "vertices": []}), "not sound CityJSON"),
    ],
)
def test_other_files_are_refused_by_name(tmp_path, text, say):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(UnusableCity, match=say):
        citymodel.read(tmp_path / "c.json")
    with pytest.raises(UnusableCity, match="cannot be read"):
        citymodel.read(tmp_path / "none.json")


@pytest.mark.skipif("KIBS_DATA" not in os.environ, reason="no real data: KIBS_DATA is not set")
def test_sections_of_a_real_city_cover_its_roofs():
    path = Path(os.environ["KIBS_DATA"]) / "citymodels/tile_901_trimmed.jsonl"
    covered = 0.0
    for line in path.read_text().splitlines()[1:]:
        feature = json.loads(line)
        vertices = np.array(feature["vertices"]) * 0.001
        for item in feature["CityObjects"].values():
            for g in item["geometry"]:
                if float(g["lod"]) == 2.2:
                    kinds = [s["type"] for s in g["semantics"]["surfaces"]]
                    for rings, value in zip(g["boundaries"][0], g["semantics"]["values"][0], strict=True):
                        if kinds[value] == "RoofSurface":
                            outer, *holes = (vertices[r][:, :2] for r in rings)
                            covered += shapely.Polygon(outer, holes).area
    found = [f for b in citymodel.read(path).buildings for f in b.roofs]
    area = sum(shapely.Polygon(f.ring[:, :2], [h[:, :2] for h in f.holes]).area for f in found)
    assert area == pytest.approx(covered, rel=2e-4)
