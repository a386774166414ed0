"""Real cities in scenes: buildings keep their shape wherever they are put, and surveyed ones stay where they are."""

import cities
import numpy as np
import pytest

from kibs_steps import georeference
from kibs_steps import terrain as dtm
from kibs_steps import view as geometry
from kibs_steps.grid import Grid
from kibs_steps.simulate import citymodel, real, scene
from kibs_steps.simulate.pieces import ROOF, WALL

HOUSES = [cities.gable(x, y, 5.0 + 0.01 * x, 8 + i % 3, 7, 3 + i % 2, 6) for i, (x, y) in enumerate(
    (x, y) for x in range(0, 90, 18) for y in range(0, 90, 15)
)]  # fmt: skip


@pytest.fixture
def model(tmp_path):
    return citymodel.read(cities.write(tmp_path / "c.json", HOUSES))


def shape(ring):
    """Edge lengths (mm) and rises of a ring: what moving and turning leaves alone."""
    edge = np.roll(ring, -1, axis=0) - ring
    return sorted(zip(np.round(np.hypot(*edge[:, :2].T), 3), np.round(edge[:, 2], 3), strict=True))


@pytest.mark.parametrize("relief", [0.0, 0.08])
def test_buildings_keep_their_shape_in_a_turned_window(model, relief):
    ground = scene.relief(np.random.default_rng(1), (-80, -80, 180, 180), 2.0, 0.0, relief)
    made = real.city(np.random.default_rng(3), model, (0, 0, 100, 100), ground)
    known = [shape(face.ring) for b in model.buildings for face in b.roofs]
    found = [f for f in made.faces if f.kind == ROOF]
    ours = [f for f in found if shape(f.ring) in known]
    assert len(ours) > 20
    for face in ours:
        feet = [f.ring for f in made.faces if f.kind == WALL and f.building == face.building]
        low = min(ring[:, 2].min() for ring in feet)
        assert low <= ground(np.concatenate(feet)[:, :2]).min() + 1e-6  # no house floats
        above = face.ring[:, 2] - ground(face.ring[:, :2])
        assert above.min() > 1.5  # no eave is buried


def test_a_house_grows_by_storeys_and_keeps_its_roof_and_its_feet(tmp_path):
    shed = cities.gable(60, 0, 2.0, 4, 3, 2, 0.5)
    house, low = citymodel.read(cities.write(tmp_path / "c.json", [HOUSES[0], shed])).buildings
    higher = real.grown(house, 2)
    for before, after in zip(house.roofs, higher.roofs, strict=True):
        assert np.allclose(after.ring - before.ring, [0, 0, 2 * real.STOREY_HEIGHT])
    for before, after in zip(house.walls, higher.walls, strict=True):
        up = before.ring[:, 2] > house.base + 1
        assert np.allclose((after.ring - before.ring)[up], [0, 0, 2 * real.STOREY_HEIGHT])
        assert np.array_equal(after.ring[~up], before.ring[~up])
    assert real.grown(low, 2) is low


def test_a_surveyed_city_is_seen_where_its_file_says(model, tmp_path):
    import geopandas

    path = cities.write(tmp_path / "c.json", HOUSES)
    out = tmp_path / "scene"
    scene.main(["--city", str(path), "--size", "260", "--gsd", "0.4", "--out", str(out)])
    stands = geopandas.read_file(out / "truth.gpkg", layer="sections_map")
    seen = geopandas.read_file(out / "truth.gpkg", layer="sections_image")
    assert stands.crs.to_epsg() == 28992
    known = {tuple(np.round(p, 3).tolist()) for b in model.buildings for f in b.roofs for p in f.ring}
    corners = np.concatenate([np.array(g.exterior.coords) for g in stands.geometry])
    assert len(stands) == 2 * len(HOUSES)
    assert {tuple(np.round(p, 3).tolist()) for p in corners} == known
    # The image shows them where the definition says, over the terrain that is written beside it.
    x0, y0 = 90 / 2 - 52, 90 / 2 + 52
    surface = dtm.read(out / "dtm.tif", (x0, y0 - 104, x0 + 104, y0))
    grid = Grid("EPSG:28992", x0, y0, 0.4, 260, 260)
    k = geometry.lean(181.1, 59.3, georeference.convergence(grid))
    for a, b in zip(seen.geometry, stands.geometry, strict=True):
        image, place = np.array(a.exterior.coords), np.array(b.exterior.coords)
        shown = geometry.image_position(place[:, :2], place[:, 2], k, surface)
        assert np.allclose(shown, image[:, :2], atol=0.02)


def test_terrain_under_a_city_follows_its_feet(model):
    ground = real.surveyed_terrain(model, (-50, -50, 140, 140), 2.0)
    middle = np.array([[45.0, 40.0]])
    assert ground(middle)[0] == pytest.approx(5.4, abs=0.15)


def test_random_tiles_show_cities_when_asked(model):
    picture, _ = scene.random_scene(np.random.default_rng(2), 128, cities=[model], city_share=1.0)
    assert len(picture.sections) > 4
    again, _ = scene.random_scene(np.random.default_rng(2), 128, cities=[model], city_share=1.0)
    assert picture.rgb.tobytes() == again.rgb.tobytes()


def mean_heights(tall, **options):
    """Mean roof height (m) of 24 random tiles."""
    found = []
    for seed in range(24):
        picture, _ = scene.random_scene(np.random.default_rng([7, seed]), 160, tall=tall, **options)
        found.append(float(picture.height[picture.section > 0].mean()))
    return found


def test_tall_tiles_hardly_show_low_houses():
    plain, tall = (np.array(mean_heights(tall)) for tall in (False, True))
    assert (plain < 7).mean() > 0.3
    assert (tall < 7).mean() < 0.1


def test_tall_tiles_of_a_city_show_houses_that_have_grown(model):
    plain, tall = (mean_heights(tall, cities=[model], city_share=1.0, style="centre") for tall in (False, True))
    assert max(plain) < 7 + (real.STOREYS + 1) * real.STOREY_HEIGHT  # no more storeys than there are
    # Half of the tiles grow by three storeys in the mean, or four in five: about 12 m against 15 m.
    assert np.mean(tall) > 1.15 * np.mean(plain)
