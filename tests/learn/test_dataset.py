"""Tiles: readers on tiny data sets, and transforms that must keep image and truth together."""

import io
import os
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from kibs_steps import photographs
from kibs_steps.learn import augmentation, dataset
from kibs_steps.learn.samples import UNKNOWN, Sample
from kibs_steps.models import runtime


@pytest.fixture
def marked() -> Sample:
    """Ground with one house, a white dot at its only corner, and the same dot's displacement at 1 m as geometry."""
    size = 32
    sample = Sample.ground(np.zeros((size, size, 3), np.uint8))
    sample.rgb[5, 20] = 255
    sample.labels[5:9, 20:26] = 1
    sample.rgb[5 + 3, 20 - 7] = 128  # the corner moved by the view's vector
    return sample._replace(
        corners=np.float32([[20.5, 5.5]]),
        corner_heights=np.float32([4.0]),
        geometry=np.float32([-7, 3, 1, 2, 1, 1]),
    )


@pytest.mark.parametrize("k", range(8))
def test_dihedral_moves_corners_labels_and_vectors_with_the_image(marked, k):
    turned = augmentation.dihedral(marked, k)
    col, row = np.floor(turned.corners[0]).astype(int)
    assert (turned.rgb[row, col] == 255).all()
    assert turned.labels[row, col] == 1
    col, row = np.floor(turned.corners[0] + turned.geometry[:2]).astype(int)
    assert (turned.rgb[row, col] == 128).all()
    assert (turned.labels == 1).sum() == (marked.labels == 1).sum()
    assert turned.geometry[4:].tolist() == [1, 1]


def test_tiles_are_trained_as_networks_see_them(marked):
    """Both views with roofs leaning up, and all eight from above: those in which `runtime.shown` shows a tile."""
    terms = {"upright": True, "mirrored": True, "flips": 8}
    rng = np.random.default_rng(0)
    for vector in ((-7, 3), (0.1, -0.05), (0, 0)):
        sample = marked._replace(geometry=np.float32([*vector, 1, 2, 1, 1]))
        shown = {
            flip.geometry(sample.geometry[None])[0, :4].tobytes()
            for flip in runtime.shown(terms, sample.geometry[None])
        }
        tiles = [augmentation.upright(sample, rng) for _ in range(80)]
        assert {tile.geometry[:4].tobytes() for tile in tiles} == shown
        for tile in tiles:
            col, row = np.floor(tile.corners[0]).astype(int)
            assert (tile.rgb[row, col] == 255).all()


def test_window_keeps_only_its_corners(marked):
    part = marked.window(2, 12, 16)
    assert part.rgb.shape == (16, 16, 3)
    np.testing.assert_allclose(part.corners, [[8.5, 3.5]])
    assert (part.rgb[3, 8] == 255).all()
    assert len(marked.window(16, 0, 16).corners) == 0


def test_forgotten_geometry_is_zero_and_flagged(marked):
    forgotten = augmentation.without_geometry(marked, np.random.default_rng(0), shares=(1.0, 1.0))
    assert not forgotten.geometry.any()
    assert marked.geometry.any()


def _roof_graph_files() -> dict[str, bytes]:
    image = np.full((120, 90, 3), 90, np.uint8)
    image[30:90, 30:60] = (0, 0, 200)  # BGR: a red roof
    return {
        "dt_roof_image/AA_001_0001.jpg": cv2.imencode(".jpg", image)[1].tobytes(),
        "res_roof_graph/AA_001_0001.verts": b"30,30\n60,30\n60,90\n30,90\n30,60\n60,60\n",
        "res_roof_graph/AA_001_0001.faces": b"0,1,5,4,0\n4,5,2,3,4\n",
        "dt_roof_image/AA_001_0002.jpg": b"not read: it has no graph",
    }


@pytest.fixture(params=["folder", "tar"])
def roof_graphs(request, tmp_path):
    if request.param == "folder":
        for name, content in _roof_graph_files().items():
            path = tmp_path / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
        return tmp_path
    with tarfile.open(tmp_path / "roofgraph.tar", "w") as tar:
        for name, content in _roof_graph_files().items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return tmp_path / "roofgraph.tar"


def test_roof_graphs_are_read_from_folder_and_tar(roof_graphs):
    (graph,) = photographs.read_roof_graphs(roof_graphs)
    assert graph.rgb.shape == (120 // photographs.REDUCED, 90 // photographs.REDUCED, 3)
    assert graph.rgb[20, 15, 0] > 150  # red comes first
    np.testing.assert_allclose(graph.vertices[2] * photographs.REDUCED, (60, 90))
    assert [face.tolist() for face in graph.faces] == [[0, 1, 5, 4], [4, 5, 2, 3]]


def test_missing_data_is_named(tmp_path):
    with pytest.raises(photographs.NoTrainingData, match="roofgraph"):
        photographs.read_roof_graphs(tmp_path / "roofgraph.tar")
    with pytest.raises(photographs.NoTrainingData, match="chips"):
        photographs.read_chips(tmp_path)


def test_pasted_houses_lie_under_their_labels(tmp_path):
    for name, content in _roof_graph_files().items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    graphs = photographs.read_roof_graphs(tmp_path)
    ground = Sample.ground(np.full((128, 128, 3), 30, np.uint8))
    sample = dataset.pasted_houses(ground, graphs, np.random.default_rng(3))
    inside = cv2.erode((sample.labels > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert inside.sum() > 20
    red = sample.rgb[..., 0].astype(int) - sample.rgb[..., 2]
    assert (red[inside] > 60).mean() > 0.95
    assert (red[(sample.labels == 0) & (sample.roof == 0)] < 60).mean() > 0.95
    assert (sample.roof[sample.labels > 0] == 1).all()
    assert np.isnan(sample.corner_heights).all()
    assert (sample.labels[sample.roof == UNKNOWN] == -1).all()


def test_chip_samples_know_roofs_and_not_sections():
    building = np.zeros((200, 200), bool)
    building[40:160, 40:160] = True
    chip = photographs.Chip("x", np.where(building[..., None], 200, 20).astype(np.uint8).repeat(3, 2), building, 0.3)
    sample = dataset.chip_sample(chip, np.random.default_rng(0), 96)
    assert set(np.unique(sample.labels)) == {-1, 0}
    known = sample.roof != UNKNOWN
    agree = (sample.rgb[..., 0] > 110) == (sample.roof == 1)
    assert agree[known].all()
    assert (sample.labels[~known] == -1).all()
    assert 0.02 < (~known).mean() < 0.2


def test_a_finer_gsd_shows_a_house_larger():
    building = np.zeros((200, 200), bool)
    building[80:120, 80:120] = True
    chip = photographs.Chip("x", np.where(building[..., None], 200, 20).astype(np.uint8).repeat(3, 2), building, 0.3)
    coarse, fine = (dataset.chip_sample(chip, np.random.default_rng(5), 256, gsd) for gsd in (0.4, 0.2))
    bright = [(sample.rgb[..., 0] > 110).sum() for sample in (coarse, fine)]
    assert bright[1] / bright[0] == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize(("size", "least", "most"), [(1.0, -0.02, 0.02), (2.0, 0.6, 0.8), (3.0, 0.8, 0.95)])
def test_grain_is_as_coarse_as_asked(size, least, most):
    """Its standard deviation is the one asked for; neighbours within a grain are alike, those of white noise are not."""
    noise = augmentation.grain(np.random.default_rng(0), (192, 160, 3), 0.02, size)
    assert noise.shape == (192, 160, 3)
    assert noise.std() == pytest.approx(0.02, rel=0.01)
    for a, b in ((noise[:, :-1], noise[:, 1:]), (noise[:-1], noise[1:])):
        assert least < np.corrcoef(a.ravel(), b.ravel())[0, 1] < most


def test_radiometry_keeps_shape_and_is_the_same_for_a_seed():
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    for seed in range(20):
        one = augmentation.radiometry(rgb, np.random.default_rng(seed))
        assert one.shape == rgb.shape
        assert one.dtype == np.uint8
        np.testing.assert_array_equal(one, augmentation.radiometry(rgb, np.random.default_rng(seed)))


def test_a_tile_made_to_look_like_its_own_soft_tinted_twin_becomes_it():
    """Texture with detail at all scales; the twin is blurred by a known kernel and has other colours in the same order."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(128, 128, 3))
    texture = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (0.6, 1.2, 2.5, 5.0, 10.0))
    sharp = np.clip(120 + 22 * texture, 0, 255).astype(np.uint8)
    soft = cv2.GaussianBlur(sharp, (0, 0), 1.5).astype(float)
    twin = np.clip(255 * (soft / 255) ** 1.6 * [1.0, 0.8, 0.6], 0, 255).astype(np.uint8)

    def far(image):
        return np.abs(image.astype(float) - twin).mean()

    likened = [augmentation.likened(sharp, twin, np.random.default_rng(seed)) for seed in range(8)]
    assert min(map(far, likened)) < 0.25 * far(sharp)
    assert max(map(far, likened)) < 0.7 * far(sharp)  # at least half way
    detail = [cv2.Laplacian(image.astype(np.float32), cv2.CV_32F).std() for image in (sharp, twin, *likened)]
    assert detail[0] > 3 * detail[1]
    assert max(detail[2:]) < 0.5 * detail[0]


def test_a_tile_of_one_colour_can_be_made_to_look_like_anything():
    plain, other = np.full((32, 32, 3), 90, np.uint8), np.full((48, 48, 3), 200, np.uint8)
    for rgb, shown in ((plain, other), (plain, np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8))):
        found = augmentation.likened(rgb, shown, np.random.default_rng(1))
        assert found.shape == rgb.shape
        assert np.ptp(found) <= 130
    np.testing.assert_allclose(sum(augmentation.octaves(plain)), plain, atol=1e-3)


def test_repainted_roofs_keep_their_shading_and_the_ground_its_look():
    rgb = np.full((64, 64, 3), 100, np.uint8)
    labels = np.zeros((64, 64), np.int32)
    for label, cols, grey in ((1, np.s_[10:24], 120), (2, np.s_[24:38], 60), (3, np.s_[46:60], 60)):
        rgb[20:40, cols], labels[20:40, cols] = grey, label
    rgb[50:60, 10:24], labels[50:60, 10:24] = 80, -1  # a roof without sections: its outline is not known well enough
    sample = Sample.ground(rgb)._replace(labels=labels, roof=(labels != 0).astype(np.uint8))
    ratios = []
    for seed in range(20):
        painted = augmentation.repainted(sample, np.random.default_rng(seed))
        sunny, shady, other = (painted.rgb[30, col].astype(float) for col in (16, 31, 53))
        np.testing.assert_allclose(sunny, 2 * shady, atol=2)
        ratios.append(other.mean() / shady.mean())
        far = cv2.dilate((labels > 0).astype(np.uint8), np.ones((15, 15), np.uint8)) == 0
        np.testing.assert_array_equal(painted.rgb[far], rgb[far])
        np.testing.assert_array_equal(painted.labels, labels)
    assert min(ratios) < 0.8 < 1.25 < max(ratios)  # each building has its own
    darkest = min(augmentation.repainted(sample, np.random.default_rng(seed)).rgb[30, 16].mean() for seed in range(20))
    assert darkest < 50


def test_yards_are_paved_and_nothing_else_is(monkeypatch):
    monkeypatch.setattr(augmentation, "YARD", 200.0)  # one yard
    rgb = np.full((64, 64, 3), 60, np.uint8)
    labels, surface = np.zeros((2, 64, 64), np.int32)
    labels[20:40, 10:24] = surface[20:40, 10:24] = 1
    surface[40:44, 10:24] = 2  # a wall
    surface[:, 50:] = UNKNOWN
    surface[20:40, 24:30], rgb[20:40, 24:30] = 4, 20  # the house's shadow
    sample = Sample.ground(rgb)._replace(
        labels=labels, roof=(labels != 0).astype(np.uint8), surface=surface.astype(np.uint8)
    )
    ground = np.isin(surface, (0, 4)) & (labels == 0)
    other = cv2.dilate(ground.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0  # but for rims, mixed as pixels are
    brighter = []
    for seed in range(20):
        paved = augmentation.paved(sample, np.random.default_rng(seed))
        np.testing.assert_array_equal(paved.rgb[other], rgb[other])
        np.testing.assert_array_equal(paved.labels, labels)
        beside, shaded = paved.rgb[30, 33].astype(float), paved.rgb[30, 27].astype(float)
        assert beside.mean() > 1.5 * shaded.mean()  # shadows stay
        brighter.append(beside.mean())
    assert max(brighter) > 120
    assert min(brighter) <= 60
    bare = Sample.ground(rgb)
    np.testing.assert_array_equal(augmentation.paved(bare, np.random.default_rng(0)).rgb, rgb)


def test_kept_samples_come_back(marked, tmp_path):
    marked.save(tmp_path / "a.npz")
    back = Sample.load(tmp_path / "a.npz")
    for one, other in zip(marked, back, strict=True):
        np.testing.assert_array_equal(one, other)


data = pytest.mark.skipif("KIBS_DATA" not in os.environ, reason="needs real data: set KIBS_DATA")


@data
def test_real_chips_have_masks_of_their_size():
    chips = photographs.read_chips(Path(os.environ["KIBS_DATA"]) / "chips")
    assert len(chips) > 20
    for chip in chips:
        assert chip.rgb.shape == (*chip.building.shape, 3)
        assert 0 < chip.building.mean() < 0.8
