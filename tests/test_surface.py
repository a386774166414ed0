"""Heights from a surface model: rays meet it in closed form, and roofs that a DSM shows come back as planes."""

import numpy as np
import pyarrow as pa
import pytest
import rasters
import shapely
import toy_city
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import ground, heightmap, planes, surface
from kibs_steps.stitch import SECTIONS
from kibs_steps.terrain import Terrain

STEP = 0.25


def sampled(heights_at):
    """A surface model of the toy scene, pixels of `STEP` m, from a function of map positions."""
    left, bottom, right, top = toy_city.X0 - 40, toy_city.Y0 - 160, toy_city.X0 + 200, toy_city.Y0 + 40
    x, y = np.arange(left, right, STEP), np.arange(top, bottom, -STEP)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    return Terrain(heights_at(grid.reshape(-1, 2)).reshape(grid.shape[:2]), left, top, (STEP, STEP))


def city_surface(places):
    heights = toy_city.GROUND.at(places)
    for _, _, outline in toy_city.roofs():
        inside = shapely.contains_xy(shapely.force_2d(outline), *places.T)
        heights[inside] = np.maximum(heights[inside], toy_city.plane_through(outline).at(places[inside]))
    return heights


@given(st.floats(0, 360), st.floats(50, 88), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_rays_meet_a_plane_where_closed_form_says(azimuth, elevation, east, north):
    lean = np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))]) / np.tan(np.radians(elevation))
    x, y = np.meshgrid(np.arange(0.0, 400.0, 4.0), np.arange(0.0, 400.0, 4.0))
    model = Terrain(30 + east * x - north * y, 0.0, 0.0, (4.0, 4.0))
    seen = np.array([[200.0, -200.0], [180.0, -230.0]])
    base = np.array([20.0, 25.0])
    expected = (30 + seen @ (east, north) - base * (lean @ (east, north))) / (1 - lean @ (east, north))
    found = surface.first_met(seen, np.tile(lean, (2, 1)), base, model)
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_a_ray_stops_at_the_first_thing_it_meets():
    """A tower of 20 m east of the pixel, seen from the east: the ray meets the tower, not the ground behind it."""
    heights = np.zeros((200, 200))
    heights[:, 105:115] = 20.0
    model = Terrain(heights, 0.0, 0.0, (1.0, 1.0))
    seen = np.array([[100.0, -50.0], [100.0, -50.0], [60.0, -50.0]])
    lean = np.array([[0.5, 0.0], [-0.5, 0.0], [0.5, 0.0]])
    found = surface.first_met(seen, lean, np.zeros(3), model)
    assert found[0] == pytest.approx(20.0, abs=0.1)  # at a height of 20 m the ray is at x = 110, on the tower
    assert found[1:] == pytest.approx([0.0, 0.0], abs=0.05)


@pytest.mark.parametrize("projection_height", [None, 5.0])
def test_roofs_of_a_surface_model_come_back(tmp_path, projection_height):
    facts = toy_city.make_scene(tmp_path, projection_height=projection_height)
    roofs = [roof for roof in toy_city.roofs() if roof[0] != 14]
    outlines = [shapely.force_2d(toy_city.seen_outline(facts, outline)) for _, _, outline in roofs]
    n = len(roofs)
    columns = [[r[0] for r in roofs], shapely.to_wkb(outlines), [1.0] * n, [2] * n, [False] * n, [False] * n, [0] * n]
    columns.append(
        [[50.0, 0, 0, 9000.0, 0, 0, 0, 0, 0, 1.0, 9.0, 1.0]] * n
    )  # what a model thinks of heights is of no account
    sections = pa.table([pa.array(c, f.type) for c, f in zip(columns, SECTIONS, strict=True)], schema=SECTIONS)
    owned, points = surface.measured(sections, facts, sampled(city_surface), toy_city.GROUND.at)
    table, _ = planes.planes(owned, points, facts, toy_city.GROUND.at, (6.0, 3.0), 7.5, "robust")
    assert table["status"].to_pylist() == ["ok"] * n
    result = ground.ground(table, facts, toy_city.GROUND.at)
    for row, (_, _, outline) in zip(result.to_pylist(), roofs, strict=True):
        found = shapely.get_coordinates(shapely.from_wkb(row["outline_map"]), include_z=True)
        np.testing.assert_allclose(found, shapely.get_coordinates(outline, include_z=True), atol=0.25)


@pytest.mark.parametrize("projection_height", [0.0, 700.0])
def test_a_surface_is_read_where_things_stand(tmp_path, projection_height):
    """Ground of 800 m in an image projected on less: a roof of 10 m stands up to 468 m from where it is seen."""
    image = rasters.write(tmp_path / "r.tif", rasters.picture(height=200, width=200))
    size, left, top = 1600, rasters.X0 - 600, rasters.Y0 + 500
    heights = np.full((size, size), 800.0, np.float32)
    terrain_model = rasters.dtm(tmp_path / "dtm.tif", heights, left, top, step=1.0)
    facts, _ = rasters.build(
        tmp_path, image, str(terrain_model), view=(180.0, 60.0), projection_height=projection_height
    )
    outline = shapely.box(80, 80, 120, 120)
    standing = facts.grid.to_map(shapely.get_coordinates(outline)) + (810 - projection_height) * np.array(facts.lean)
    (x0, y0), (x1, y1) = standing.min(axis=0), standing.max(axis=0)
    heights[int(top - y1) - 2 : int(top - y0) + 3, int(x0 - left) - 2 : int(x1 - left) + 3] = 810.0
    model = rasters.dtm(tmp_path / "dsm.tif", heights, left, top, step=1.0)
    out = tmp_path / "surface.tif"
    surface.main([f"--scene={facts.folder / 'scene.json'}", f"--dsm={model}", f"--out={out}"])
    columns = [[1], [shapely.to_wkb(outline)], [1.0], [2], [False], [False], [0], [heightmap.EMPTY]]
    sections = pa.table([pa.array(c, f.type) for c, f in zip(columns, SECTIONS, strict=True)], schema=SECTIONS)
    ground_there = facts.terrain(planes.map_bounds(sections, facts))
    _, points = surface.under(sections, facts, out, ground_there)
    np.testing.assert_allclose(points["height"].to_numpy(), 10.0, atol=0.05)


def test_every_section_has_points_however_small():
    for outline in (shapely.box(3, 3, 3.4, 3.4), shapely.box(0, 0, 2, 40), shapely.box(0, 0, 500, 300)):
        found = surface.points_in(outline)
        assert 1 <= len(found) <= 2 * surface.POINTS
        assert shapely.intersects_xy(shapely.buffer(outline, 1e-6), *found.T).all()
