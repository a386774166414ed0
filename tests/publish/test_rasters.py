"""Label and height rasters against closed forms."""

import numpy as np
import pyarrow as pa
import pytest
import rasterio
import rasterio.features
import shapely
import toy_city as toy
from affine import Affine

from kibs_steps import store
from kibs_steps.grid import Window
from kibs_steps.publish import rasters


def publish(folder, scene, found=None, **options):
    """Write both rasters of the toy city; return labels, heights."""
    store.write_table(folder / "buildings.parquet", toy.buildings_table(scene, found))
    paths = folder / "labels.tif", folder / "heights.tif"
    arguments = ["--scene", scene.folder / "scene.json", "--sections", folder / "buildings.parquet"]
    arguments += ["--labels", paths[0], "--heights", paths[1]]
    rasters.main([str(a) for a in arguments])
    return tuple(rasterio.open(path).read(1) for path in paths)


def test_labels_are_the_rasterised_outlines(tmp_path):
    scene = toy.make_scene(tmp_path)
    apart = [roof for roof in toy.roofs() if roof[0] != 14]
    labels, heights = publish(tmp_path, scene, apart)
    shapes = [(shapely.force_2d(toy.seen_outline(scene, outline)), section) for section, _, outline in apart]
    expected = rasterio.features.rasterize(shapes, labels.shape, transform=Affine.identity(), dtype=np.uint32)
    # Two rasterisers may differ where an edge runs through a pixel's very centre.
    assert (labels != expected).sum() <= 3
    assert (np.isnan(heights) == (labels == 0)).all()


@pytest.mark.parametrize("projection_height", [None, 5.0])
def test_heights_are_the_plane_over_the_slope(tmp_path, projection_height):
    """A pixel's point P = P_img + (z − T0)·k lies on the plane, and its height is z − DTM(P)."""
    scene = toy.make_scene(tmp_path, projection_height=projection_height)
    labels, heights = publish(tmp_path, scene)
    k = np.array(scene.lean)
    g = toy.GROUND
    for section, _, outline in toy.roofs():
        plane = toy.plane_through(outline)
        rows, cols = np.nonzero(labels == section)
        assert len(rows)
        image = scene.grid.to_map(np.column_stack([cols, rows]) + 0.5)
        t0 = g.at(image) if projection_height is None else np.full(len(image), projection_height)
        # h = z − ground(P) with both planes linear along the ray: solve for z directly.
        z = (plane.at(image) - t0 * (plane.a * k[0] + plane.b * k[1])) / (1 - (plane.a * k[0] + plane.b * k[1]))
        expected = z - g.at(image + (z - t0)[:, None] * k)
        np.testing.assert_allclose(heights[rows, cols], expected, atol=2e-4)


def test_the_nearer_section_wins(tmp_path):
    """The block's roof leans over the shed: shared pixels show the block."""
    scene = toy.make_scene(tmp_path)
    labels, _ = publish(tmp_path, scene)
    overlap = shapely.intersection(*(toy.seen_outline(scene, toy.roofs()[i][2]) for i in (2, 3)))
    inside = rasterio.features.rasterize([shapely.force_2d(overlap)], labels.shape, dtype=np.uint8) == 1
    assert inside.sum() > 100
    assert (labels[inside] == 13).mean() > 0.99


def test_windows_do_not_matter(tmp_path):
    scene = toy.make_scene(tmp_path)
    labels, heights = publish(tmp_path, scene)
    sections = rasters.read([str(tmp_path / "buildings.parquet")])
    for window in scene.grid.windows(97):
        some, some_heights = rasters.shown(sections, scene, window)
        place = np.s_[window.row : window.row + window.height, window.col : window.col + window.width]
        np.testing.assert_array_equal(some, labels[place])
        np.testing.assert_allclose(some_heights, heights[place], atol=1e-4)


def test_files_are_cogs_on_the_grid_with_the_same_bytes(tmp_path):
    scene = toy.make_scene(tmp_path, size=(1200, 700))
    publish(tmp_path, scene)
    first = [(tmp_path / name).read_bytes() for name in ("labels.tif", "heights.tif")]
    publish(tmp_path, scene)
    assert first == [(tmp_path / name).read_bytes() for name in ("labels.tif", "heights.tif")]
    for name, dtype in (("labels.tif", "uint32"), ("heights.tif", "float32")):
        with rasterio.open(tmp_path / name) as file:
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert file.dtypes == (dtype,)
            assert file.overviews(1)
            assert file.crs.to_epsg() == 32631
            assert file.transform.almost_equals(scene.grid.transform)
    assert not list(tmp_path.glob(".tmp*"))


def test_no_sections_give_empty_rasters(tmp_path):
    scene = toy.make_scene(tmp_path)
    store.write_table(tmp_path / "some.parquet", toy.buildings_table(scene))
    empty = store.read_table(tmp_path / "some.parquet").slice(0, 0)
    store.write_table(tmp_path / "none.parquet", empty)
    sections = rasters.read([str(tmp_path / "none.parquet")])
    labels, heights = rasters.shown(sections, scene, Window(0, 0, 64, 64))
    assert not labels.any()
    assert np.isnan(heights).all()


def test_a_section_without_plane_is_left_out(tmp_path):
    scene = toy.make_scene(tmp_path)
    rows = toy.buildings_table(scene).to_pylist()
    rows[0]["plane_a"] = None
    store.write_table(tmp_path / "b.parquet", pa.Table.from_pylist(rows))
    assert rasters.read([str(tmp_path / "b.parquet")]).ids.tolist() == [12, 13, 14]


def test_overviews_show_heights_that_are_there(tmp_path):
    """Not means of a roof and the ground beside it, or of two roofs."""
    scene = toy.make_scene(tmp_path, size=(1200, 700))
    _, heights = publish(tmp_path, scene)
    with rasterio.open(tmp_path / "heights.tif", overview_level=0) as file:
        small = file.read(1)
    assert small.shape == (350, 600)
    blocks = heights.reshape(350, 2, 600, 2)
    same = (blocks == small[:, None, :, None]) | (np.isnan(blocks) & np.isnan(small)[:, None, :, None])
    assert same.any(axis=(1, 3)).all()


def test_what_the_files_say_of_themselves(tmp_path):
    scene = toy.make_scene(tmp_path)
    publish(tmp_path, scene)
    with rasterio.open(tmp_path / "labels.tif") as labels, rasterio.open(tmp_path / "heights.tif") as heights:
        assert labels.nodata == 0
        assert np.isnan(heights.nodata)
        assert heights.tags()["UNIT"] == "m above ground"


def test_ids_that_do_not_fit_are_refused(tmp_path):
    rows = toy.buildings_table(toy.make_scene(tmp_path)).to_pylist()
    rows[0]["section_id"] = 2**32
    store.write_table(tmp_path / "b.parquet", pa.Table.from_pylist(rows))
    with pytest.raises(rasters.IdsTooLarge, match="4294967296"):
        rasters.read([str(tmp_path / "b.parquet")])
