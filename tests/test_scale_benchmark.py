"""The scale benchmark measures what it says: known laws, known processes, cities without repetition."""

import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks/scale"))
import patchwork
import rivals
import watch


def test_flood_fill_finds_the_areas_that_labelling_finds():
    roofs = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(80, 90)), 3) > 0.02
    assert rivals.flooded(roofs) == ndimage.label(roofs)[1]


def test_sections_are_flooded_one_by_one_though_they_touch():
    """A quilt of 6 × 6 px sections, without a gap: 16 areas once they are a pixel apart, none smaller than 5 × 5."""
    quilt = np.kron(np.arange(1, 17).reshape(4, 4), np.ones((6, 6), int))
    roofs = rivals.apart(quilt)
    assert rivals.flooded(roofs) == 16
    assert np.bincount(quilt[roofs])[1:].min() == 25
    assert not rivals.apart(np.zeros((4, 4), int)).any()


def test_some_areas_alone_are_flooded():
    quilt = np.kron(np.arange(1, 17).reshape(4, 4), np.ones((6, 6), int))
    roofs = rivals.apart(quilt)
    assert (
        len(rivals.fills(roofs, np.flatnonzero(roofs)[[0, 1, 400 - 1]])) == 2
    )  # the second pixel lies in the first's area
    found = rivals.growth(lambda side: quilt[:side, :side], [12, 18, 24], most=2)
    assert found["mpx"] == pytest.approx([144e-6, 324e-6, 576e-6])
    assert len(found["seconds"]) == 3


def test_a_power_law_is_found():
    sizes = [0.1, 0.4, 1.6]
    assert rivals.law(sizes, [3 * s**1.9 for s in sizes]) == pytest.approx((1.9, 3.0))


def test_passes_of_a_model():
    assert rivals.passes({}) == 1
    assert rivals.passes({"flips": 8}) == 8
    assert rivals.passes({"flips": 8, "upright": True}) == 1
    assert rivals.passes({"flips": 8, "upright": True, "mirrored": True}) == 2


def test_no_patch_shows_the_scene_of_a_neighbour():
    numbers = patchwork.chosen(12, 15, 6, np.random.default_rng(1))
    for down, right in ((0, 1), (1, 0), (1, 1)):
        assert (numbers[: 12 - down, : 15 - right] != numbers[down:, right:]).all()
    assert (numbers[1:, :-1] != numbers[:-1, 1:]).all()
    assert set(numbers.ravel()) == set(range(6))


def test_a_raster_is_put_together_whole_and_the_same_again(tmp_path, monkeypatch):
    monkeypatch.setattr(patchwork, "PATCH", 64)
    scenes = []
    for k in range(6):
        scenes.append(tmp_path / f"scene{k}")
        scenes[-1].mkdir()
        image = np.random.default_rng(k).integers(40, 200, (3, 90, 90), np.uint8)
        with rasterio.open(
            scenes[-1] / "scene.tif", "w", driver="GTiff", count=3, width=90, height=90, dtype="uint8"
        ) as out:
            out.write(image)
    for name in ("a.tif", "b.tif"):
        patchwork.raster(tmp_path / name, 300, 200, scenes)
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    with rasterio.open(tmp_path / "a.tif") as source:
        values = source.read()
    assert values.shape == (3, 200, 300)
    assert values.min() > 0
    patches = [values[:, r : r + 64, c : c + 64].tobytes() for r in (0, 64, 128) for c in (0, 64, 128, 192)]
    assert len(set(patches)) == len(patches)


def test_a_process_is_watched(tmp_path):
    """Its step, its peak memory, its disk; `timeit` stands for a step."""
    work = "x = bytearray(150_000_000); open('big', 'wb').write(x[:20_000_000]); import time; time.sleep(0.6)"
    found = watch.watched([sys.executable, "-m", "timeit", "-n", "1", "-r", "1", work], tmp_path, tmp_path / "log")
    assert found["code"] == 0
    assert 150 < found["steps"]["timeit"]["peak_mb"] < 400
    assert found["steps"]["timeit"]["jobs"] == 1
    assert found["disk"] >= 20_000_000
    assert found["wall"] > 0.6
