"""The preview: drawn where things are, in the colours they mean, the same bytes every time."""

import numpy as np
import pytest
import shapely
import toy_city as toy
from PIL import Image

from kibs_steps import picture, store
from kibs_steps.publish import preview


def draw(folder, scene, table):
    store.write_table(folder / "b.parquet", table)
    out = folder / "preview.png"
    preview.main(
        ["--scene", str(scene.folder / "scene.json"), "--sections", str(folder / "b.parquet"), "--out", str(out)]
    )
    return out


def test_same_bytes_and_a_sensible_size(tmp_path):
    scene = toy.make_scene(tmp_path)
    table = toy.buildings_table(scene)
    out = draw(tmp_path, scene, table)
    first = out.read_bytes()
    draw(tmp_path, scene, table)
    assert out.read_bytes() == first
    with Image.open(out) as image:
        assert 1000 < max(image.size) <= 2600
        assert image.mode == "RGB"


def test_a_large_raster_is_decimated(tmp_path):
    scene = toy.make_scene(tmp_path, size=(3000, 1000))
    rgb, scale = picture.overview(scene, 1200)
    assert rgb.shape == (400, 1200, 3)
    assert scale == pytest.approx(0.4)


@pytest.mark.parametrize("longest", [350, 1200])
def test_the_overview_does_not_depend_on_how_much_is_read_at_once(tmp_path, monkeypatch, longest):
    """But for rounding: a window's kernel weights begin at another place."""
    scene = toy.make_scene(tmp_path, size=(700, 500))
    whole, _ = picture.overview(scene, longest)
    monkeypatch.setattr(picture, "AT_ONCE", 130)
    parts, _ = picture.overview(scene, longest)
    assert np.abs(parts.astype(int) - whole).max() <= 1


def test_the_picture_does_not_depend_on_how_many_outlines_are_points_at_once(tmp_path, monkeypatch):
    scene = toy.make_scene(tmp_path)
    table = toy.buildings_table(scene)
    drawn = draw(tmp_path, scene, table).read_bytes()
    monkeypatch.setattr(picture, "SOME", 1)
    assert draw(tmp_path, scene, table).read_bytes() == drawn


def test_roofs_are_painted_where_they_are(tmp_path):
    """On the right panel a roof's own colour fills its place on the map; the courtyard is ground."""
    scene = toy.make_scene(tmp_path)
    outline = toy.roofs()[2][2]
    scale = 2.0
    seen = shapely.to_wkb(shapely.transform([outline], scene.grid.to_image))
    panel, _ = preview.standing_panel(scene, scene.grid, seen, np.zeros((1, 2)), np.array([25.0]), scale)
    pixels = np.asarray(panel).astype(int)
    colour = preview.by_height(np.array([25.0]))[0][0]
    for point, is_roof in (((82, 62), True), ((108, 88), True), ((95, 75), False), ((40, 20), False)):
        col, row = (int(v / toy.GSD * scale) for v in point)
        assert (np.abs(pixels[row, col] - colour).max() <= 2) == is_roof


def test_seen_outlines_are_drawn_on_the_raster():
    rgb = np.full((60, 60, 3), 100, np.uint8)
    square = shapely.Polygon(shapely.box(10, 10, 30, 30).exterior, [shapely.box(15, 15, 25, 25).exterior.coords])
    drawn = np.asarray(picture.paint(rgb, shapely.to_wkb([square]), np.array([[255, 0, 0]], np.uint8), 2.0, cover=0.5))
    np.testing.assert_allclose(drawn[24, 24], [177.5, 50, 50], atol=1)
    assert drawn[40, 40].tolist() == [100, 100, 100]
    assert drawn[4, 4].tolist() == [100, 100, 100]


def test_colours_of_directions():
    colours = picture.directions(np.array([0.0, 40, 40, 40]), np.array([np.nan, 0, 120, 240])).astype(int)
    assert colours[0].tolist() == [255, 255, 255]
    assert [int(c.argmax()) for c in colours[1:]] == [0, 1, 2]


def test_nice_lengths():
    assert [picture.nice_length(x) for x in (1, 1.9, 3, 7, 10, 49.9, 99, 0.3)] == [1, 1, 2, 5, 10, 20, 50, 0.2]


def test_nothing_found(tmp_path):
    scene = toy.make_scene(tmp_path)
    assert draw(tmp_path, scene, toy.buildings_table(scene).slice(0, 0)).stat().st_size > 1000
