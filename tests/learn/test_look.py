"""Windows of a raster that nobody annotated."""

import numpy as np
import pytest
import rasterio
from affine import Affine

from kibs_steps.learn import look


def raster(path, rgb, nodata=None):
    rows, cols = rgb.shape[:2]
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=3,
        height=rows,
        width=cols,
        dtype="uint8",
        crs="EPSG:32631",
        transform=Affine(0.38, 0, 500000.14, 0, -0.38, 5600000.02),
        nodata=nodata,
        photometric="RGB",
    ) as target:
        target.write(rgb.transpose(2, 0, 1))
    return path


def test_windows_are_parts_of_the_raster_that_hold_data(tmp_path):
    rgb = np.random.default_rng(0).integers(1, 256, (300, 700, 3), dtype=np.uint8)
    rgb[:, :350] = 0
    raster(tmp_path / "town.tif", rgb, nodata=0)
    look.main([f"--raster={tmp_path / 'town.tif'}", f"--out={tmp_path / 'town.npy'}"])
    found = np.load(tmp_path / "town.npy")
    assert found.shape[1:] == (256, 256, 3)
    assert 2 <= len(found) <= look.MOST
    assert ((found > 0).all(axis=3).mean(axis=(1, 2)) >= look.FILLED - 0.02).all()
    # On the same grid pixels come as they are: every window is one of the raster's.
    places = {rgb[i, j].tobytes(): (i, j) for i in range(300) for j in range(350, 700)}
    row, col = places[found[0][128, 200].tobytes()]
    assert np.abs(found[0][:, 100:].astype(int) - rgb[row - 128 : row + 128, col - 100 : col + 56]).mean() < 1
    again = tmp_path / "again.npy"
    look.main([f"--raster={tmp_path / 'town.tif'}", f"--out={again}"])
    assert again.read_bytes() == (tmp_path / "town.npy").read_bytes()


def test_water_is_no_look(tmp_path):
    rgb = np.random.default_rng(0).integers(1, 256, (256, 900, 3), dtype=np.uint8)
    rgb[:, 500:] = (10, 30, 40)
    raster(tmp_path / "coast.tif", rgb)
    look.main([f"--raster={tmp_path / 'coast.tif'}", f"--out={tmp_path / 'coast.npy'}"])
    found = np.load(tmp_path / "coast.npy")
    assert 10 < len(found) < look.MOST
    assert (found.std(axis=(1, 2)) > 15).all()


def test_a_small_raster_is_one_window_and_an_empty_one_is_refused(tmp_path):
    raster(tmp_path / "small.tif", np.full((90, 120, 3), 80, np.uint8))
    look.main([f"--raster={tmp_path / 'small.tif'}", f"--out={tmp_path / 'small.npy'}"])
    assert np.load(tmp_path / "small.npy").shape[1:] == (90, 90, 3)
    torn = np.full((90, 120, 3), 80, np.uint8)
    torn[:, 40:70] = 0
    raster(tmp_path / "torn.tif", torn, nodata=0)
    with pytest.raises(look.NothingToSee, match="set `aoi`"):
        look.main([f"--raster={tmp_path / 'torn.tif'}", f"--out={tmp_path / 'torn.npy'}"])
    assert not (tmp_path / "torn.npy").exists()
