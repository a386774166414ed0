"""Simulated scenes against closed forms: lean, shadows, occlusion, labels, heights on slopes, same seed same bytes."""

import cities
import cv2
import numpy as np
import pytest
import shapely

from kibs_steps import georeference
from kibs_steps import terrain as dtm
from kibs_steps import view as geometry
from kibs_steps.grid import Grid
from kibs_steps.simulate import outdoors, scene, works
from kibs_steps.simulate.camera import CLEAR, Camera
from kibs_steps.simulate.pieces import CLUTTER, OBJECT, ROOF, WALL, City, Face, Paint, Place
from kibs_steps.simulate.rendering import ON_ROOF, OTHER
from kibs_steps.simulate.roofs import prism
from kibs_steps.simulate.site import Site
from kibs_steps.simulate.surfaces import Material, palette

GRID = Grid("", 0.0, 60.0, 0.3, 200, 200)
PLAIN = Camera(0.4, (0, 0, 0), 0.0, 0.0, (0.0, 0.0), 0.0, 1.0, 0.0, 0.0, 1.0, (1, 1, 1), 1.0, 0)
MATERIALS = [Material((0.3, 0.3, 0.3), 0, 0), Material((0.3, 0.3, 0.3), 0, 0)]
GROUND = [Paint(np.array([[-99.0, -99.0], [199, -99], [199, 199], [-99, 199]]), 0)]


def block(x0, y0, x1, y1, height, section, base=0.0, kind=ROOF, turn=0.0):
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)
    middle, spin = ring.mean(0), np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    top, sides = prism((ring - middle) @ spin + middle, base, base + height)
    return [Face(top, (), kind, section, section, 1), *(Face(s, (), WALL, 0, section, 1) for s in sides)]


def shoot(faces, view=(180, 60), sun=(90, 45), terrain=None, grid=GRID, materials=MATERIALS):
    return scene.render(
        City(faces, GROUND, materials),
        terrain or dtm.flat(0.0),
        grid,
        scene._direction(*view),
        scene._direction(*sun),
        np.random.default_rng(0),
        look=PLAIN,
    )


def test_flat_roof_is_shown_where_the_paper_says():
    picture = shoot(block(20, 20, 32, 32, 9.0, 1, turn=0.3), view=(30, 55))
    k = np.array(geometry.lean(30, 55))
    rows, cols = np.nonzero(picture.section == 1)
    middle = GRID.to_map(np.array([cols.mean() + 0.5, rows.mean() + 0.5]))
    assert np.allclose(middle, [26, 26] - 9.0 * k, atol=0.05)
    assert np.allclose(picture.height[rows, cols], 9.0, atol=1e-4)
    assert np.isnan(picture.height[picture.section == 0]).all()
    truth = picture.sections[0]
    assert np.allclose(GRID.to_map(truth.outline_seen[:, :2]), truth.outline_map[:, :2] - 9.0 * k)
    assert truth.visible == pytest.approx(1.0, abs=0.02)
    assert sorted(picture.corner_heights.tolist()) == pytest.approx([9.0] * 4)


def test_shadow_tip_falls_at_the_papers_distance():
    # A thin mast's top: its shadow ends at roof corner + h (cot el·v − cot sun·s) in the image.
    height, view, sun = 10.0, (180, 60), (100, 40)
    picture = shoot(block(29.5, 29.5, 30.5, 30.5, height, 0, kind=OBJECT), view, sun)
    s = np.array(geometry.lean(*sun))
    dark = picture.rgb.mean(2) < 0.6 * np.median(picture.rgb)
    tips = np.array([30, 30]) - height * s  # on the ground, where the image shows it
    rows, cols = np.nonzero(dark)
    away = GRID.to_map(np.stack([cols + 0.5, rows + 0.5], -1))
    reach = (away - [30, 30]) @ (-s / np.hypot(*s))
    farthest = away[np.argsort(reach)[-4:]].mean(0)
    assert np.abs(farthest - tips).max() < 1.0
    vector = scene.geometry_vector(scene._direction(*view), scene._direction(*sun), GRID.gsd)
    ground = GRID.to_image(np.array([30.0, 30.0]))
    assert np.allclose(ground + height * vector[2:4], GRID.to_image(tips), atol=1e-4)
    top = GRID.to_image(np.array([30, 30]) - height * np.array(geometry.lean(*view)))
    assert np.allclose(ground + height * vector[:2], top, atol=1e-4)


def test_tall_building_hides_the_low_one_behind():
    faces = block(20, 20, 30, 24, 20.0, 1) + block(20, 25, 30, 30, 3.0, 2)
    picture = shoot(faces, view=(180, 50))
    share = {s.section: s.visible for s in picture.sections}
    assert share[1] == pytest.approx(1.0, abs=0.02)
    assert share[2] == 0.0
    assert not (picture.section == 2).any()
    assert 2 not in picture.corner_sections
    assert {s.section: s.visible for s in shoot(faces, view=(0, 50)).sections}[2] == pytest.approx(1.0, abs=0.02)


def test_a_look_changes_the_picture_and_nothing_else():
    grid = Grid("", 0.0, 60.0, 0.4, 150, 150)
    view, sun = scene._direction(181, 60), scene._direction(155, 45)
    clear, blurred = (
        scene.simulate(5, grid, view, sun, "rows", look=look)[0] for look in (CLEAR, CLEAR._replace(blur=1.6))
    )
    assert (clear.section == blurred.section).all()
    assert np.array_equal(clear.height, blurred.height, equal_nan=True)
    fine = [np.abs(np.diff(picture.rgb.mean(2), axis=1)).mean() for picture in (clear, blurred)]
    assert fine[0] > 1.5 * fine[1]


def test_things_on_a_roof_belong_to_its_section():
    faces = block(20, 20, 32, 32, 6.0, 1)
    top, sides = prism(np.array([[25.0, 25], [26, 25], [26, 26], [25, 26]]), 6.0, 7.5)
    faces += [Face(r, (), CLUTTER, 0, 1, 0) for r in (top, *sides)]
    picture = shoot(faces)
    assert picture.sections[0].visible == pytest.approx(1.0, abs=0.02)
    assert np.allclose(picture.height[picture.section == 1], 6.0, atol=1e-4)


@pytest.mark.parametrize("style", ["suburb", "rows", "village", "perimeter", "industry"])
def test_labels_agree_with_the_outlines(style):
    checked, seed = 0, 4
    while checked < 2:
        picture, _ = scene.random_scene(np.random.default_rng(seed), size=200, style=style)
        checked, seed = checked + labels_agree(picture), seed + 1


def labels_agree(picture):
    """Sections whose label image has been compared with their outline."""
    checked = 0
    for truth in picture.sections:
        if truth.visible < 0.97 or truth.holes_seen:
            continue
        ring = np.round((truth.outline_seen[:, :2] - 0.5) * 16).astype(np.int32)
        drawn = cv2.fillPoly(np.zeros(picture.section.shape, np.uint8), [ring], 1, shift=4) > 0
        label = picture.section == truth.section
        grown = cv2.dilate(label.astype(np.uint8), np.ones((3, 3))) > 0
        assert (drawn & ~grown).sum() <= 0.04 * drawn.sum() + 4
        assert (label & ~(cv2.dilate(drawn.astype(np.uint8), np.ones((3, 3))) > 0)).sum() == 0
        checked += 1
    return checked


def test_corners_lie_at_section_heights():
    picture, _ = scene.random_scene(np.random.default_rng(11), size=160, style="suburb")
    assert len(picture.corners) > 10
    rings = {s.section: s.outline_seen for s in picture.sections}
    for corner, height, section in zip(picture.corners, picture.corner_heights, picture.corner_sections, strict=True):
        there = np.abs(rings[section][:, :2] - corner).max(1) < 0.01
        assert np.abs(rings[section][there, 2] - height).min() < 1e-3


def test_heights_on_a_sloping_plane():
    x = np.arange(-100, 200, 2.0)
    slope = dtm.Terrain(np.tile(50 + 0.12 * x, (150, 1)), -100.0, 199.0, (2.0, 2.0))
    base = float(slope(np.array([[20.0, 30.0]]))[0])
    picture = shoot(block(20, 20, 40, 40, 8.0, 1, base), view=(250, 50), terrain=slope)
    rows, cols = np.nonzero(picture.section == 1)
    seen = GRID.to_map(np.stack([cols + 0.5, rows + 0.5], -1))
    above = picture.height[rows, cols].astype(float)
    place, z = geometry.ground_position(seen, above, slope, geometry.lean(250, 50))
    assert np.allclose(z, base + 8.0, atol=1e-3)
    assert (place > 19.7).all()
    assert (place < 40.3).all()
    # The true building stands where its outline says, and that is where the image position rule puts it.
    shown = geometry.image_position(
        picture.sections[0].outline_map[:, :2], picture.sections[0].outline_map[:, 2], geometry.lean(250, 50), slope
    )
    assert np.allclose(GRID.to_image(shown), picture.sections[0].outline_seen[:, :2], atol=1e-4)
    assert abs(len(rows) * 0.09 - 400 / (1 - 0.12 * geometry.lean(250, 50)[0])) < 12


def test_random_views_are_of_satellites_and_some_from_above():
    rng = np.random.default_rng(3)
    views = np.array([scene._random_view(rng, 45, 90) for _ in range(2000)])
    assert 0.2 < (views[:, 1] >= 80).mean() < 0.3
    assert 0.25 < (views[:, 1] < 60).mean() < 0.33  # of the triangle 0.365, of four in five
    azimuth, elevation, cone = scene.HELD_OUT_CONE
    away = np.hypot((views[:, 0] - azimuth) * np.cos(np.radians(elevation)), views[:, 1] - elevation)
    assert away.min() > cone
    assert {scene._random_view(rng, 59.3, 59.3)[1] for _ in range(20)} == {59.3}


def test_same_seed_same_bytes():
    a, g = scene.random_scene(np.random.default_rng(5), size=128)
    b, h = scene.random_scene(np.random.default_rng(5), size=128)
    c, _ = scene.random_scene(np.random.default_rng(6), size=128)
    assert a.rgb.tobytes() == b.rgb.tobytes()
    assert a.section.tobytes() == b.section.tobytes()
    assert g.tobytes() == h.tobytes()
    assert a.rgb.tobytes() != c.rgb.tobytes()


def test_tanks_greenhouses_and_ships_have_no_sections():
    kit = palette(np.random.default_rng(1))
    site = Site(np.random.default_rng(2), dtm.flat(0.0), kit, (0, 0, 120, 120), 0.0)
    site.turn = 0.0
    for i, (x, y) in enumerate([(20.0, 20.0), (20.0, 50.0), (20.0, 80.0), (20.0, 100.0)]):
        site.tank(Place(x, y, 0.0), 4.0 + i, 8.0)
    works._greenhouses(site, -10, -20, 30, 20)
    works._ship(site, Place(95.0, 60.0, 1.0), 20.0, 4.0)
    assert len(site.faces) > 100
    picture = shoot(site.faces, grid=Grid("", 0.0, 120.0, 0.6, 200, 200), materials=kit.materials)
    assert not picture.section.any()
    assert not picture.sections
    assert not (picture.surface == ON_ROOF).any()
    assert (picture.surface == OTHER).mean() > 0.1


@pytest.mark.parametrize("seed", range(4))
def test_roundabouts_with_their_islands_are_ground(seed):
    kit = palette(np.random.default_rng(seed))
    site = Site(np.random.default_rng(seed), dtm.flat(0.0), kit, (0, 0, 120, 120), 0.0)
    site.turn = 0.0
    outdoors._roundabout(site, -50, -50, 50, 50)
    rings = [shapely.Polygon(paint.ring) for paint in site.paints]
    assert all(ring.is_valid for ring in rings)
    assert len(rings) > 9 + 4  # carriageways and the round in the middle, and an island in each arm at least
    picture = shoot(site.faces, grid=Grid("", 0.0, 120.0, 0.6, 200, 200), materials=kit.materials)
    assert not picture.section.any()
    assert not (picture.surface == ON_ROOF).any()


def test_backgrounds_are_used_where_usable():
    photograph = np.full((300, 300, 3), (250, 10, 250), np.uint8)
    usable = np.zeros((300, 300), bool)
    usable[:, :150] = True
    city = City([], GROUND, MATERIALS)
    args = (city, dtm.flat(0.0), GRID, scene._direction(0, 80), scene._direction(90, 45))
    with_it = scene.render(*args, np.random.default_rng(1), [(photograph, usable)], PLAIN)
    pink = (with_it.rgb[..., 0] > 2.0 * with_it.rgb[..., 1]).mean()
    assert 0.05 < pink <= 1.0


def test_program_writes_a_scene_twice_the_same(tmp_path):
    import geopandas
    import rasterio

    for name in ("a", "b"):
        scene.main(["--seed", "4", "--size", "220", "--relief", "4", "--slope", "5", "--out", str(tmp_path / name)])
    for file in ("scene.tif", "dtm.tif", "truth.gpkg", "angles.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    with rasterio.open(tmp_path / "a" / "scene.tif") as raster, rasterio.open(tmp_path / "a" / "dtm.tif") as ground:
        assert raster.count == 3
        assert ground.bounds.left <= raster.bounds.left - 249
        assert ground.bounds.top >= raster.bounds.top + 249
        bounds = raster.bounds
    seen = geopandas.read_file(tmp_path / "a" / "truth.gpkg", layer="sections_image")
    stands = geopandas.read_file(tmp_path / "a" / "truth.gpkg", layer="sections_map")
    assert list(seen.columns) == list(stands.columns) == ["section_id", "building_id", "visible", "split", "geometry"]
    surface = dtm.read(tmp_path / "a" / "dtm.tif", bounds)
    turned = georeference.convergence(Grid("EPSG:32631", bounds.left, bounds.top, 0.38, 220, 220))
    k = geometry.lean(181.1, 59.3, turned)
    for a, b in zip(seen.geometry[:20], stands.geometry[:20], strict=True):
        image, place = np.array(a.exterior.coords), np.array(b.exterior.coords)
        moved, z = geometry.ground_position(image[:, :2], image[:, 2], surface, k)
        assert np.allclose(moved, place[:, :2], atol=0.01)
        assert np.allclose(z, place[:, 2], atol=0.01)


@pytest.mark.parametrize("slope", [-0.3, 0.0, 0.15, 0.3])
@pytest.mark.parametrize("elevation", [45.0, 59.3])
def test_a_roof_that_nothing_hides_is_wholly_visible_on_slopes_too(slope, elevation):
    x = np.arange(-250, 310, 2.0)
    rise = np.repeat((slope * (x - 30))[::-1][:, None], len(x), 1)
    hill = dtm.Terrain(rise, x[0], x[-1], (2.0, 2.0))
    picture = shoot(block(22, 26, 38, 36, 12.0, 1, base=-1.0), (180, elevation), terrain=hill)
    (section,) = picture.sections
    assert section.visible > 0.96


@pytest.mark.parametrize("place", [(-10.0, 100.0), (-740_000.0, -1_040_000.0)])
def test_squares_of_negative_coordinates_have_a_split(place):
    x, y = np.meshgrid(place[0] + 100.0 * np.arange(40), place[1] + 100.0 * np.arange(40))
    splits = [scene.split_of(at, 3) for at in np.column_stack([x.ravel(), y.ravel()])]
    assert np.bincount(splits, minlength=3) / len(splits) == pytest.approx([0.6, 0.2, 0.2], abs=0.05)


def test_unusable_requests_say_so(tmp_path):
    with pytest.raises(scene.UnusableScene, match="shows no roof: give another --seed"):
        scene.main(["--style", "farm", "--size", "64", "--out", str(tmp_path)])
    with pytest.raises(scene.UnusableScene, match="size must be 64 px"):
        scene.main(["--size", "1", "--out", str(tmp_path)])
    nowhere = cities.write(tmp_path / "c.json", [cities.gable(4_468_000.0, 5_334_000.0)], crs=None)
    with pytest.raises(scene.UnusableScene, match="does not say its reference system: name it with --crs"):
        scene.main(["--city", str(nowhere), "--out", str(tmp_path)])
    with pytest.raises(scene.UnusableScene, match="projected in metres"):
        scene.main(["--crs", "EPSG:4326", "--out", str(tmp_path)])
    with pytest.raises(scene.UnusableScene, match="not one on the ground"):
        scene.main(["--crs", "EPSG:3857", "--out", str(tmp_path)])
    with pytest.raises(scene.UnusableScene, match="elevation"):
        scene.main(["--view-elevation", "3", "--out", str(tmp_path)])
