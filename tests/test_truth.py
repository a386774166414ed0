"""Truth: both frames from either, what may go wrong with a layer, and what is seen at a pixel."""

import json

import numpy as np
import pyogrio
import pytest
import rasters
import shapely
import toy_city as toy
from affine import Affine

from kibs_steps import raster, store, truth, view
from kibs_steps.grid import Grid, Window
from kibs_steps.scene import Direction, Region
from kibs_steps.simulate import scene as simulation


def write_layer(path, outlines, crs=toy.CRS, layer="anything", kind="Polygon Z", **columns):
    """A vector layer of outlines."""
    pyogrio.raw.write(
        path,
        layer=layer,
        geometry=shapely.to_wkb(np.array(outlines)),
        field_data=[np.asarray(c) for c in columns.values()],
        fields=list(columns),
        geometry_type=kind,
        crs=crs,
    )
    return path


def read(path, scene, frame="map", z="absolute"):
    """The truth table of a layer, with its geometries."""
    rows = truth.table(truth.read_layer(path, frame), scene, frame, z)
    return rows, shapely.from_wkb(rows["outline_seen"].to_numpy()), shapely.from_wkb(rows["outline_map"].to_numpy())


def coordinates(outlines):
    return shapely.get_coordinates(outlines, include_z=True)


def image_outlines(scene):
    """The toy's roofs as drawn on the raster: image map frame, height above ground; and the same with absolute z."""
    above, absolute = [], []
    for _, _, outline in toy.roofs():
        seen = coordinates(toy.seen_outline(scene, outline))
        place = scene.grid.to_map(seen[:, :2])
        for outlines, z in ((above, seen[:, 2]), (absolute, coordinates(outline)[:, 2])):
            outlines.append(shapely.set_coordinates(shapely.force_3d(outline), np.column_stack([place, z])))
    return above, absolute


@pytest.mark.parametrize("projection_height", [None, 3.0])
@pytest.mark.parametrize("frame_z", ["map absolute", "map above_ground", "image absolute", "image above_ground"])
def test_every_frame_and_height_gives_the_same_truth_on_a_slope(tmp_path, frame_z, projection_height):
    scene = toy.make_scene(tmp_path / "scene", projection_height=projection_height)
    standing = [outline for _, _, outline in toy.roofs()]
    frame, z = frame_z.split()
    if frame == "image":
        outlines = image_outlines(scene)[z == "absolute"]
    elif z == "absolute":
        outlines = standing
    else:
        outlines = shapely.transform(
            np.array(standing), lambda p: np.column_stack([p[:, :2], p[:, 2] - toy.GROUND.at(p[:, :2])]), include_z=True
        )
    _, seen, found = read(write_layer(tmp_path / "t.gpkg", outlines), scene, frame, z)
    np.testing.assert_allclose(coordinates(found), coordinates(standing), atol=1e-3)
    expected = coordinates([toy.seen_outline(scene, o) for o in standing])
    np.testing.assert_allclose(coordinates(seen), expected, atol=3e-3)


def test_height_is_taken_where_the_roof_stands_not_where_it_is_seen(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    _, seen, standing = read(write_layer(tmp_path / "t.gpkg", [toy.roofs()[2][2]]), scene)
    points, ground = coordinates(seen), coordinates(standing)
    np.testing.assert_allclose(points[:, 2], 40.0 - toy.GROUND.at(ground[:, :2]), atol=1e-4)
    displaced = 40.0 - toy.GROUND.at(scene.grid.to_map(points[:, :2]))
    assert np.abs(points[:, 2] - displaced).min() > 0.3


def test_another_crs_is_reprojected(tmp_path):
    from pyproj import Transformer

    scene = toy.make_scene(tmp_path / "scene")
    move = Transformer.from_crs(toy.CRS, 4326, always_xy=True)
    standing = np.array([outline for _, _, outline in toy.roofs()])
    degrees = shapely.transform(
        standing, lambda p: np.column_stack([*move.transform(p[:, 0], p[:, 1]), p[:, 2]]), include_z=True
    )
    _, _, found = read(write_layer(tmp_path / "t.gpkg", degrees, "EPSG:4326"), scene)
    np.testing.assert_allclose(coordinates(found), coordinates(standing), atol=1e-3)


def test_parts_holes_columns_and_the_layer_named_after_the_frame(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    north, south, block, _ = (outline for _, _, outline in toy.roofs())
    path = tmp_path / "t.gpkg"
    write_layer(path, [north], layer="first")
    houses = [shapely.MultiPolygon([north, south]), shapely.MultiPolygon([block])]
    write_layer(path, houses, layer="sections_map", kind="MultiPolygon Z", building_id=[7, 8], split=[0, 1])
    rows, _, found = read(path, scene)
    assert rows["truth_id"].to_pylist() == [1, 2, 3]
    assert rows["building"].to_pylist() == [7, 7, 8]
    assert rows["split"].to_pylist() == [0, 0, 1]
    assert rows["visible"].to_pylist() == [None] * 3
    assert len(found[2].interiors) == 1
    assert len(read(path, scene, "image", "above_ground")[0]) == 1


def test_own_section_ids_are_kept(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    outlines = [outline for _, _, outline in toy.roofs()]
    path = write_layer(tmp_path / "t.gpkg", outlines, section_id=[40, 30, 20, 10], visible=[1.0, 0.5, 0.25, 0.0])
    rows = read(path, scene)[0]
    assert rows["truth_id"].to_pylist() == [40, 30, 20, 10]
    assert rows["visible"].to_pylist() == [1.0, 0.5, 0.25, 0.0]
    texts = write_layer(tmp_path / "texts.gpkg", outlines, section_id=["40", "30", "20", "10"])
    assert read(texts, scene)[0]["truth_id"].to_pylist() == [40, 30, 20, 10]


def test_columns_that_mean_something_else_are_no_numbers(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    roofs = [outline for _, _, outline in toy.roofs()]
    n = len(roofs)
    texts = {name: ["yes"] * n for name in ("building", "visible")} | {"section_id": [f"a{k}" for k in range(n)]}
    rows, *_ = read(write_layer(tmp_path / "t.gpkg", roofs, split=np.resize([0, 1, 2, 3, -1], n), **texts), scene)
    assert rows["truth_id"].to_pylist() == list(range(1, n + 1))
    assert rows["building"].null_count == rows["visible"].null_count == n
    assert rows["split"].to_pylist() == np.resize([0, 1, 2, 2, 2], n).tolist()


def test_a_region_is_seen_as_a_view_is(tmp_path):
    """One view told as a region over all of the raster: the same pixels show the same roofs."""
    scene = toy.make_scene(tmp_path / "scene")
    around = Region(shapely.box(*scene.grid.bounds).buffer(100), scene.view)
    found = []
    for seen in (scene, scene._replace(view=None, regions=(around,))):
        found.append(truth.visible_labels(toy_truth(tmp_path, seen), seen, whole(seen)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-4)
    assert len(np.unique(found[0][0])) > 3


def test_a_roof_has_the_view_of_the_region_that_shows_it_not_of_the_one_it_stands_in(tmp_path):
    """A roof seen west of a border, from the east: it stands beyond the border, where the view is steeper."""
    scene = toy.make_scene(tmp_path / "scene")
    left, bottom, right, top = scene.grid.bounds
    leans = [view.lean(90.0, elevation) for elevation in (60.0, 70.0)]
    parts = (shapely.box(left, bottom, left + 60, top), shapely.box(left + 60, bottom, right, top))
    regions = tuple(Region(part, Direction(0.0, 60.0, lean)) for part, lean in zip(parts, leans, strict=True))
    scene = scene._replace(view=None, regions=regions)
    seen = np.array([[left + x, top - y] for x, y in ((49, 40), (57, 40), (57, 50), (49, 50))])
    terrain = scene.terrain(scene.grid.bounds)
    standing, z = view.ground_position(seen, np.full(4, 15.0), terrain, np.tile(leans[0], (4, 1)))
    assert standing[:, 0].mean() > left + 60
    roof = shapely.Polygon(np.column_stack([standing, z]))
    pixels, _ = truth.convert(np.array([roof], object), scene, "map", "absolute")
    found = shapely.get_coordinates(pixels, include_z=True)[:4]
    np.testing.assert_allclose(found[:, :2], scene.grid.to_image(seen), atol=0.01)
    np.testing.assert_allclose(found[:, 2], 15.0, atol=0.01)


def test_truth_stands_where_a_height_it_is_projected_on_puts_it(tmp_path):
    """Ground of 2,240 m in an image projected on 0: roofs stand 1.3 km from where they are seen."""
    image = rasters.write(tmp_path / "r.tif", rasters.picture(height=200, width=200))
    scene, _ = rasters.build(tmp_path, image, "2240", view=(180.0, 60.0), projection_height=0.0)
    assert scene.displaced > truth.AROUND
    seen = scene.grid.to_map(np.array([[80.0, 80.0], [120.0, 80.0], [120.0, 120.0], [80.0, 120.0]]))
    roof = shapely.Polygon(np.column_stack([seen + 2250 * np.array(scene.lean), np.full(4, 2250.0)]))
    rows = read(write_layer(tmp_path / "t.gpkg", [roof], crs=scene.grid.crs), scene)[0]
    outline = shapely.from_wkb(rows["outline_seen"].to_pylist()[0])
    np.testing.assert_allclose(shapely.bounds(outline), (80, 80, 120, 120), atol=0.01)


def test_what_is_wrong_with_a_layer_is_said(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    house = toy.roofs()[0][2]
    flat = write_layer(tmp_path / "flat.gpkg", [shapely.force_2d(house)], kind="Polygon")
    with pytest.raises(truth.NoHeights, match="no z"):
        read(flat, scene)
    away = shapely.transform(house, lambda p: p + np.array([90000.0, 0.0, 0.0]), include_z=True)
    with pytest.raises(truth.NoOverlap, match="outside the scene"):
        read(write_layer(tmp_path / "away.gpkg", [away]), scene)
    with pytest.raises(truth.NoPolygons, match="no layer of polygons"):
        read(write_layer(tmp_path / "points.gpkg", [shapely.Point(1, 1)], kind="Point"), scene)
    with pytest.raises(truth.UnreadableTruth, match="no CRS"):
        read(write_layer(tmp_path / "nowhere.gpkg", [house], crs=None), scene)
    with pytest.raises(truth.UnreadableTruth, match="cannot be read"):
        read(tmp_path / "absent.gpkg", scene)
    high = shapely.transform(house, lambda p: p + np.array([0.0, 0.0, 900.0]), include_z=True)
    with pytest.raises(truth.NoHeights, match="truth_z=absolute"):
        read(write_layer(tmp_path / "high.gpkg", [high]), scene, z="above_ground")


def test_heights_that_move_all_truth_out_of_the_scene_are_told(tmp_path):
    """Roofs of 330 m above the sea on ground of 320 m, in a raster of 76 m: read as heights above ground they leave it."""
    image = rasters.write(tmp_path / "r.tif", rasters.picture(height=200, width=200))
    scene, _ = rasters.build(tmp_path, image, "320", view=(180.0, 60.0))
    seen = scene.grid.to_map(np.array([[80.0, 80.0], [120.0, 80.0], [120.0, 120.0], [80.0, 120.0]]))
    layer = write_layer(
        tmp_path / "t.gpkg", [shapely.Polygon(np.column_stack([seen, np.full(4, 330.0)]))], crs=scene.grid.crs
    )
    with pytest.raises(truth.NoHeights, match=r"330 m above the ground .*check truth_z"):
        read(layer, scene, z="above_ground")
    assert len(read(layer, scene, z="absolute")[0]) == 1


def test_geojson_and_shapefile_are_read(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    outlines = [outline for _, _, outline in toy.roofs()]
    path = tmp_path / "t.shp"
    pyogrio.raw.write(
        path,
        geometry=shapely.to_wkb(np.array(outlines)),
        field_data=[],
        fields=[],
        geometry_type="Polygon Z",
        crs=toy.CRS,
    )
    assert len(read(path, scene)[0]) == 4
    content = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}},
        "features": [{"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(outlines[0])}],
    }
    path = tmp_path / "t.geojson"
    path.write_text(json.dumps(content))
    assert len(read(path, scene)[0]) == 1


def whole(scene):
    return Window(0, 0, scene.grid.width, scene.grid.height)


def toy_truth(tmp_path, scene, found=None):
    store.write_table(tmp_path / "truth.parquet", toy.truth_table(scene, found))
    return truth.read(tmp_path / "truth.parquet", scene)


def test_heights_seen_are_the_planes(tmp_path):
    """At every pixel shown, the point on the section's plane at the given height is seen at that very pixel."""
    scene = toy.make_scene(tmp_path / "scene")
    labels, heights = truth.visible_labels(toy_truth(tmp_path, scene), scene, whole(scene))
    assert set(np.unique(labels)) == {0, 11, 12, 13, 14}
    assert (np.isnan(heights) == (labels == 0)).all()
    k = np.array(scene.lean)
    for section, _, outline in toy.roofs():
        plane = toy.plane_through(outline)
        rows, cols = np.nonzero(labels == section)
        image = scene.grid.to_map(np.column_stack([cols, rows]) + 0.5)
        t0 = toy.GROUND.at(image)
        # The ray in steps of z: which z lies on the plane, by bisection.
        low, high = np.full(len(image), -50.0), np.full(len(image), 200.0)
        for _ in range(60):
            z = (low + high) / 2
            under = z < plane.at(image + (z - t0)[:, None] * k)
            low, high = np.where(under, z, low), np.where(under, high, z)
        expected = z - toy.GROUND.at(image + (z - t0)[:, None] * k)
        np.testing.assert_allclose(heights[rows, cols], expected, atol=2e-4)


def test_a_wall_hides_what_is_behind_it(tmp_path):
    """The satellite is south: the block's south wall is seen, and the shed north of the block is partly hidden by it."""
    scene = toy.make_scene(tmp_path / "scene")
    everything = toy_truth(tmp_path, scene)
    labels, _ = truth.visible_labels(everything, scene, whole(scene))
    alone, _ = truth.visible_labels(everything.take(everything.ids == 14), scene, whole(scene))
    assert 0 < (labels == 14).sum() < (alone == 14).sum()
    # With the satellite above, nothing is hidden and no wall is seen.
    above = toy.make_scene(tmp_path / "above", direction=None)
    labels, _ = truth.visible_labels(toy_truth(tmp_path / "above", above), above, whole(above))
    for section, _, outline in toy.roofs():
        assert (labels == section).sum() * toy.GSD**2 == pytest.approx(outline.area, rel=0.02)


def test_a_roof_behind_a_wall_alone(tmp_path):
    """A low roof just south of nothing, north of a thin high screen: hidden by the screen's wall, not by its roof."""
    scene = toy.make_scene(tmp_path / "scene", direction=(180.0, 45.0))
    screen = shapely.orient_polygons(
        shapely.Polygon([toy.at(40, 80, 40), toy.at(40, 81, 40), toy.at(80, 81, 40), toy.at(80, 80, 40)])
    )
    low = shapely.orient_polygons(
        shapely.Polygon([toy.at(45, 70, 16), toy.at(45, 78, 16), toy.at(75, 78, 16), toy.at(75, 70, 16)])
    )
    labels, _ = truth.visible_labels(toy_truth(tmp_path, scene, [(1, 1, screen), (2, 2, low)]), scene, whole(scene))
    assert (labels == 1).any()
    assert not (labels == 2).any()


def test_windows_agree_with_the_whole(tmp_path):
    scene = toy.make_scene(tmp_path / "scene")
    everything = toy_truth(tmp_path, scene)
    labels, heights = truth.visible_labels(everything, scene, whole(scene))
    for window in (Window(50, 30, 90, 70), Window(-20, -10, 100, 90), Window(250, 200, 100, 80)):
        some, some_heights = truth.visible_labels(everything, scene, window)
        r0, c0 = max(window.row, 0), max(window.col, 0)
        r1, c1 = min(window.row + window.height, 240), min(window.col + window.width, 320)
        inner = np.s_[r0 - window.row : r1 - window.row, c0 - window.col : c1 - window.col]
        np.testing.assert_array_equal(some[inner], labels[r0:r1, c0:c1])
        np.testing.assert_allclose(some_heights[inner], heights[r0:r1, c0:c1], atol=1e-4)


def test_main_writes_the_table(tmp_path):
    toy.make_scene(tmp_path / "scene")
    path = write_layer(tmp_path / "t.gpkg", [outline for _, _, outline in toy.roofs()])
    out = tmp_path / "truth.parquet"
    arguments = [
        "--scene",
        str(tmp_path / "scene/scene.json"),
        "--truth",
        str(path),
        "--frame",
        "map",
        "--out",
        str(out),
    ]
    truth.main(arguments)
    first = out.read_bytes()
    truth.main(arguments)
    assert out.read_bytes() == first
    assert store.read_table(out).num_rows == 4


def test_the_simulator_sees_the_same(tmp_path):
    """Another program's rendering of a hilly city: same sections but for rim pixels, and the same heights."""
    grid = Grid(toy.CRS, 500000.0, 5400000.0, 0.38, 300, 300)
    towards, sun = (Direction(*angles, view.lean(*angles)) for angles in ((181.1, 59.3), (155.0, 45.0)))
    picture, terrain = simulation.simulate(5, grid, towards, sun, "mixed", 3.0, 0.05)
    scene = toy.make_scene(tmp_path)._replace(grid=grid, view=towards)
    (step, _), heights = terrain.step, terrain.heights
    corner = Affine(step, 0, terrain.x0 - step / 2, 0, -step, terrain.y0 + step / 2)
    raster.write(tmp_path / "dtm.tif", heights.astype(np.float64), toy.CRS, corner)

    found = picture.sections
    standing = [shapely.orient_polygons(shapely.Polygon(s.outline_map, s.holes_map)) for s in found]
    seen = np.array([shapely.Polygon(s.outline_seen, s.holes_seen) for s in found])
    ids = np.array([s.section for s in found])
    reach = shapely.bounds(seen) + np.array([-60, -60, 60, 60])
    sections = truth.Truth(ids, np.full(len(ids), 2), seen, np.array(standing), reach)
    labels, heights = truth.visible_labels(sections, scene, whole(scene))
    roof = picture.section > 0
    same = roof & (labels == picture.section)
    assert roof.sum() > 5000
    assert same.sum() > 0.98 * roof.sum()
    np.testing.assert_allclose(heights[same], picture.height[same], atol=1e-4)


def test_feet_of_a_vertical_crs_become_metres(tmp_path):
    """EPSG:6360 is NAVD88 height in US survey feet."""
    scene = toy.make_scene(tmp_path / "scene")
    standing = np.array([outline for _, _, outline in toy.roofs()])
    feet = shapely.transform(standing, lambda p: p * [1, 1, 3937 / 1200], include_z=True)
    found = truth.to_grid(truth.Layer("t", "EPSG:32631+6360", feet, {}), scene.grid)
    np.testing.assert_allclose(coordinates(found), coordinates(standing), atol=1e-6)


def test_planes_of_outlines_without_one_are_level_at_their_mean():
    """A line in plan, and a wall that passes for a roof."""
    line = shapely.Polygon([(0, 0, 1), (4, 0, 3), (8, 0, 5)])
    wall = shapely.Polygon([(0, 0, 0), (4, 0, 0), (4, 1, 6), (0, 1, 6)])
    roof = shapely.Polygon([(0, 0, 0), (4, 0, 0), (4, 1, 4), (0, 1, 4)])
    found = truth.planes_of(np.array([line, wall, roof]))
    np.testing.assert_allclose(found[:, :3], [[0, 0, 3], [0, 0, 3], [0, 4, 2]], atol=1e-9)
