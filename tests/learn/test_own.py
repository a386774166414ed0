"""A user's raster and annotation to samples, against the renderer's own labels; splits that do not leak."""

import json

import geopandas
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
import toy
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import truth, view
from kibs_steps.georeference import convergence
from kibs_steps.grid import Grid, Window
from kibs_steps.learn import own
from kibs_steps.learn.samples import UNKNOWN, Sample, contents
from kibs_steps.scene import Direction
from kibs_steps.simulate import scene as simulation

SIZE, TILE = 300, 120
ANGLES = ["--view-azimuth=181.1", "--view-elevation=59.3", "--sun-azimuth=155", "--sun-elevation=45"]


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A simulated raster on a slope with its annotation, and what the renderer says of every pixel."""
    folder = tmp_path_factory.mktemp("city")
    size = ["--seed=5", f"--size={SIZE}", "--gsd=0.38", "--style=suburb", "--slope=10"]
    simulation.main([*size, *ANGLES, "--out", str(folder)])
    with rasterio.open(folder / "scene.tif") as source:
        t = source.transform
        grid = Grid("EPSG:32631", t.c, t.f, t.a, source.width, source.height)
    turned = convergence(grid)
    directions = [Direction(a, e, view.lean(a, e, turned)) for a, e in ((181.1, 59.3), (155.0, 45.0))]
    rendering, _ = simulation.simulate(5, grid, *directions, "suburb", 0.0, 0.1)
    return folder, rendering


def prepare(city, out, *options):
    folder, _ = city
    own.main(
        [f"--raster={folder}/scene.tif", f"--dtm={folder}/dtm.tif", *ANGLES, f"--tile={TILE}", f"--out={out}", *options]
    )
    samples = {p.stem: (p.parent.name, Sample.load(p)) for p in sorted(out.glob("*/r*.npz"))}
    return samples, json.loads((out / "own.json").read_text())


def window_of(name):
    at = {p.row * 10 + p.col: p.window for p in own.places(SIZE, SIZE, TILE)}
    return at[int(name[1:4]) * 10 + int(name[5:8])]


@pytest.mark.parametrize("frame", ["map", "image"])
def test_samples_are_what_the_renderer_shows(city, tmp_path, frame):
    """Labels, heights at the ground-corrected place and corners of every tile, from either frame of the annotation."""
    folder, rendering = city
    z = [] if frame == "map" else ["--truth-z=above_ground"]
    options = ["--split=shuffle", "--seed=3", f"--truth={folder}/truth.gpkg", f"--truth-frame={frame}", *z]
    samples, record = prepare(city, tmp_path / "own", *options)
    assert len(samples) == 9
    assert record["split"]["tiles"] == {"training": 5, "validation": 2, "testing": 2, "left_out": 0}
    roofs, both_roofs, ground, both_ground, off, gaps = 0, 0, 0, 0, [], []
    for name, (_, sample) in samples.items():
        window = window_of(name)
        part = np.s_[window.row : window.row + TILE, window.col : window.col + TILE]
        np.testing.assert_array_equal(sample.rgb, rendering.rgb[part])
        true = rendering.section[part]
        both = (true > 0) & (sample.labels > 0)
        roofs, both_roofs = roofs + (true > 0).sum(), both_roofs + both.sum()
        ground, both_ground = ground + (true == 0).sum(), both_ground + ((true == 0) & (sample.labels == 0)).sum()
        for label in np.unique(sample.labels[sample.labels > 0]):
            inside = true[(sample.labels == label) & (true > 0)]  # no annotation knows what trees hide
            assert inside.size < 30 or np.bincount(inside).max() > 0.8 * inside.size
        off.append(np.abs(sample.height - rendering.height[part])[both])
        inner = rendering.corners - [window.col, window.row]
        expected = inner[((inner > 4) & (inner < TILE - 4)).all(axis=1)]
        if len(expected):
            gaps.append(np.linalg.norm(expected[:, None] - sample.corners[None], axis=2).min(axis=1))
    assert roofs > 2000
    assert both_roofs > 0.97 * roofs
    assert both_ground > 0.97 * ground
    assert np.median(np.concatenate(off)) < 0.03
    assert (np.concatenate(gaps) < 0.8).mean() > 0.9
    again, other = prepare(city, tmp_path / "again", *options)
    assert other == record
    assert {k: v[0] for k, v in again.items()} == {k: v[0] for k, v in samples.items()}


def test_whatever_samples_follow_from_is_recorded(city, tmp_path):
    """By it a training run knows that it would learn from other samples."""
    folder, _ = city
    bounds = pyogrio.read_info(folder / "truth.gpkg", layer="sections_image", force_total_bounds=True)["total_bounds"]
    records = [prepare(city, tmp_path / "own", "--truth", str(folder / "truth.gpkg"))[1]]
    for part in (0.5, 1.0):
        place = shapely.box(bounds[0], bounds[1], bounds[0] + part * (bounds[2] - bounds[0]), bounds[3])
        frame = geopandas.GeoDataFrame(geometry=[place], crs="EPSG:32631")
        frame.to_file(tmp_path / "annotated.gpkg")
        options = ["--truth", str(folder / "truth.gpkg"), "--annotated", str(tmp_path / "annotated.gpkg")]
        records.append(prepare(city, tmp_path / "own", *options)[1])
    records.append(prepare(city, tmp_path / "own", *options, "--bands=3,2,1")[1])
    assert len({json.dumps(record) for record in records}) == 4


def part_of(folder, path, shape):
    """An area of the simulated raster, px, as a layer."""
    with rasterio.open(folder / "scene.tif") as source:
        placed = shapely.transform(shape, lambda xy: np.column_stack(source.transform * tuple(xy.T)))
        geopandas.GeoDataFrame(geometry=[placed], crs=source.crs).to_file(path)
    return f"--annotated={path}"


def test_tiles_of_which_nothing_is_known_are_of_no_set(city, tmp_path):
    """On them a network has no loss, and training would end as soon as it looked at them."""
    folder, _ = city
    drawn = part_of(folder, tmp_path / "part.gpkg", shapely.box(0, 0, SIZE, 100))
    for split in ("shuffle", "blocks"):
        options = [f"--truth={folder}/truth.gpkg", drawn, f"--split={split}", "--square=1", "--buffer=0"]
        samples, record = prepare(city, tmp_path / split, *options)
        assert set(samples) <= {"r000c000", "r000c001", "r000c002"}
        assert sum(record["split"]["tiles"].values()) == 3
        assert record["split"]["tiles"]["training"] > 0
        assert all((sample.roof != UNKNOWN).any() for _, sample in samples.values())


def test_of_a_roof_cut_by_what_is_known_neither_rim_nor_middle_are_taught(city, tmp_path):
    folder, rendering = city
    (row, col) = np.argwhere(rendering.section > 0)[len(np.argwhere(rendering.section > 0)) // 2].tolist()
    section = rendering.section[row, col]
    drawn = part_of(folder, tmp_path / "half.gpkg", shapely.box(0, 0, col + 0.5, SIZE))
    samples, _ = prepare(city, tmp_path / "own", f"--truth={folder}/truth.gpkg", drawn, "--split=shuffle")
    cut = 0
    for name, (_, sample) in samples.items():
        window = window_of(name)
        true = rendering.section[window.row : window.row + TILE, window.col : window.col + TILE]
        mine = (true == section) & (sample.roof != UNKNOWN)
        cut += int((mine & (sample.roof == 1)).sum())
        assert (sample.labels[mine & (sample.roof == 1)] <= 0).all()
        assert np.isfinite(sample.height[mine & (sample.roof == 1)]).all()
        known = (sample.labels > 0) & (true > 0)
        assert (sample.roof[known] == 1).all()
    assert cut > 0


@pytest.mark.parametrize("what", ["buildings", "annotated"])
def test_outlines_that_lie_elsewhere_are_refused(city, tmp_path, what):
    folder, _ = city
    part_of(folder, tmp_path / "far.gpkg", shapely.box(9e4, 0, 9e4 + 50, 50))
    options = [f"--{what}={tmp_path / 'far.gpkg'}"] + ([f"--truth={folder}/truth.gpkg"] if what == "annotated" else [])
    with pytest.raises(truth.NoOverlap, match=r"far.gpkg: no polygon lies in .*scene.tif: check"):
        prepare(city, tmp_path / "own", *options)


def test_samples_corrected_by_hand_are_learned_from_and_not_made_anew(city, tmp_path):
    pytest.importorskip("pycocotools", reason="COCO needs the extra `learn` (pycocotools)")
    from kibs_steps.learn import coco

    folder, _ = city
    options = [f"--truth={folder}/truth.gpkg", "--split=shuffle"]
    prepare(city, tmp_path / "own", *options)
    before = contents(tmp_path / "own")
    prepare(city, tmp_path / "own", *options)
    assert contents(tmp_path / "own") == before  # whenever they were written
    words = ["--samples", str(tmp_path / "own/training"), "--coco", str(tmp_path / "coco")]
    coco.main(words)
    sections = json.loads((tmp_path / "coco/sections.json").read_text())
    sections["annotations"] = sections["annotations"][1:]
    (tmp_path / "coco/sections.json").write_text(json.dumps(sections))
    coco.main([*words, "--to", "samples"])
    assert json.loads((tmp_path / "own/corrected.json").read_text()) == contents(tmp_path / "own") != before
    with pytest.raises(own.NothingToLearn, match="corrected by hand"):
        prepare(city, tmp_path / "own", *options)


def test_another_split_leaves_no_tile_of_the_one_before(city, tmp_path):
    folder, _ = city
    for options in (["--split=shuffle"], ["--split=shuffle", "--seed=7"]):
        prepare(city, tmp_path / "own", *options, f"--truth={folder}/truth.gpkg")
        tiles = [path.name for path in (tmp_path / "own").glob("*/r*.npz")]
        assert len(tiles) == len(set(tiles)) == 9


def test_the_truth_comes_back_with_its_split(city, tmp_path):
    folder, _ = city
    prepare(city, tmp_path / "own", "--split=shuffle", f"--truth={folder}/truth.gpkg")
    written = pyogrio.read_dataframe(tmp_path / "own/truth.gpkg")
    original = pyogrio.read_dataframe(folder / "truth.gpkg", layer="sections_map")
    assert set(written["section_id"]) <= set(original["section_id"])
    assert set(written["split"]) == {0, 1, 2}
    assert shapely.has_z(written.geometry.to_numpy()).all()


def test_what_a_model_is_sure_of_stands_in_for_an_annotation(tmp_path):
    """Red is roof to the toy model, less red is doubt; the rest of the raster is ground, a strip of it without data."""
    image = np.full((90, 130, 3), (90, 110, 80), np.uint8)
    image[20:40, 30:60] = (200, 60, 60)
    image[60:75, 80:110] = (150, 60, 60)
    image[:, 125:] = 0
    raster = toy.raster(tmp_path / "town.tif", image)
    with rasterio.open(raster, "r+") as target:
        target.nodata = 0
    model = toy.sections_model(tmp_path / "sections.onnx")
    words = [f"--raster={raster}", "--dtm=0", f"--guess={model}", f"--out={tmp_path / 'own'}"]
    own.main([*words, "--tile=60"])
    record = json.loads((tmp_path / "own/own.json").read_text())
    assert record["licence"] == "CC0-1.0"
    assert record["split"]["tiles"] == {"training": 6, "validation": 0, "testing": 0, "left_out": 0}
    for place in own.places(130, 90, 60):
        sample = Sample.load(tmp_path / f"own/training/r{place.row:03d}c{place.col:03d}.npz")
        left, top = place.window.col, place.window.row
        red = image[top : top + 60, left : left + 60, 0]
        np.testing.assert_array_equal(sample.roof, np.select([red == 200, red == 90], [1, 0], UNKNOWN))
        np.testing.assert_array_equal(sample.labels, np.where(red == 90, 0, -1))
        np.testing.assert_array_equal(sample.rgb[red == 200], image[top : top + 60, left : left + 60][red == 200])
        assert not sample.corners_known.any()
        assert not np.isfinite(sample.height).any()
    with rasterio.open(raster, "r+") as target:
        target.transform = target.transform @ target.transform.scale(1.001)  # taken as it is, as everywhere
    own.main([*words, "--tile=60"])
    for tile, message in ((80, "looks at 64 px"), (500, "a training tile 500 px")):
        with pytest.raises(own.NothingToLearn, match=message):
            own.main([*words, f"--tile={tile}"])
    with pytest.raises(own.NothingToLearn, match=r"is for 0.38 m per px, the tiles are to be of 0.76"):
        own.main([*words, "--tile=40", "--gsd=0.76"])
    toy.raster(tmp_path / "field.tif", np.full((90, 130, 3), (90, 110, 80), np.uint8))
    with pytest.raises(own.NothingToLearn, match=r"sections.onnx is sure of no roof in .*field.tif"):
        own.main([f"--raster={tmp_path / 'field.tif'}", *words[1:3], f"--out={tmp_path / 'none'}", "--tile=60"])
    assert len(own.drawn_places(own.places(900, 900, 60), 1, most=20)) == 20


def test_buildings_without_sections(city, tmp_path):
    """Roof where an outline is drawn and nowhere else; no sections, no corners, nothing beyond what was annotated."""
    folder, rendering = city
    drawn = pyogrio.read_dataframe(folder / "truth.gpkg", layer="sections_image")
    outline = shapely.force_2d(shapely.union_all(drawn.geometry.to_numpy()))
    for name, shape in (("buildings", outline), ("annotated", shapely.box(*shapely.bounds(outline)))):
        pyogrio.raw.write(
            tmp_path / f"{name}.gpkg",
            geometry=shapely.to_wkb(np.array([shape])),
            field_data=[],
            fields=[],
            geometry_type=shape.geom_type,
            crs=drawn.crs.to_string(),
        )
    samples, record = prepare(
        city,
        tmp_path / "own",
        f"--buildings={tmp_path}/buildings.gpkg",
        f"--annotated={tmp_path}/annotated.gpkg",
        "--split=shuffle",
    )
    assert record["corners"]["mean_height"] is None
    for name, (_, sample) in samples.items():
        window = window_of(name)
        true = rendering.section[window.row : window.row + TILE, window.col : window.col + TILE] > 0
        known = sample.roof != UNKNOWN
        assert ((sample.roof == 1) >= true)[known].mean() > 0.99
        assert (sample.labels[sample.roof == 1] == -1).all()
        assert (sample.labels[sample.roof == 0] == 0).all()
        assert not sample.corners_known[sample.roof == 1].any()
        assert not len(sample.corners)


@given(st.integers(5, 400), st.integers(0, 1000))
def test_the_shuffle_has_exact_shares(count, seed):
    code = own.shuffled(count, seed)
    for value, share in enumerate(own.SHARES):
        assert abs((code == value).sum() - share * count) <= 1
    np.testing.assert_array_equal(code, own.shuffled(count, seed))
    assert count < 20 or (code != own.shuffled(count, seed + 1)).any()


@given(
    st.integers(100, 900),
    st.integers(100, 900),
    st.integers(20, 100),
    st.integers(1, 4),
    st.integers(0, 90),
    st.integers(0, 99),
)
def test_blocks_keep_their_distance(width, height, side, block, buffer, seed):
    """No training pixel within the buffer of another set's, none shared between sets, and what is left is most of it."""
    found = own.places(width, height, side)
    covered = np.zeros((height, width), int)
    for place in found:
        w = place.window
        assert w.col >= 0
        assert w.col + side <= width
        covered[w.row : w.row + side, w.col : w.col + side] += 1
    assert covered.min() >= 1
    code = own.in_blocks(found, seed, block, buffer)
    boxes = np.array([shapely.box(*own._bounds(p.window)) for p in found])
    for one in range(3):
        for other in range(one + 1, 3):
            a, b = boxes[code == one], boxes[code == other]
            if len(a) and len(b):
                wide = shapely.buffer(a, buffer, cap_style="square", join_style="mitre") if buffer else a
                tree = shapely.STRtree(b)
                for shape in wide:
                    assert not (shapely.area(shapely.intersection(b[tree.query(shape)], shape)) > 1e-9).any()
    codes = own.shuffled(len({(p.row // block, p.col // block) for p in found}), seed)
    assert ((code == 2) | (code == own.LEFT_OUT)).sum() >= (2 in codes)


def test_points_get_the_split_of_their_tile():
    found = own.places(100, 50, 50)
    code = np.array([0, 1])
    points = np.array([[10.0, 10], [60, 10], [49.9, 49.9], [50, 0]])
    assert own.codes_of(points, found, code).tolist() == [0, 1, 0, 1]
    assert own.codes_of(np.array([[10.0, 10], [200, 0]]), found, np.array([own.LEFT_OUT, 1])).tolist() == [2, 2]


def test_a_raster_smaller_than_a_tile_is_refused():
    with pytest.raises(own.NothingToLearn, match="40×90"):
        own.places(40, 90, 50)


def test_pixels_of_outlines_by_their_centres():
    outlines = np.array([shapely.box(10.4, 20.6, 13.4, 22.4)])
    inside = own.drawn(outlines, Window(8, 18, 10, 8))
    assert sorted(zip(*np.nonzero(inside), strict=True)) == [(3, 2), (3, 3), (3, 4)]
