"""Tiles: what a block sees is the raster itself, wherever the cuts are and whatever the file looks like."""

import subprocess
import sys

import numpy as np
import pytest
import rasterio
import rasterio.shutil
import rasters
from affine import Affine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kibs_steps import scene, tiles
from kibs_steps.grid import Tiling, Window

TILING = Tiling(32, 4, 2)


def build(tmp_path, raster, gsd=0.38, **options):
    return scene.build("toy", raster, "0", gsd, tmp_path / "out", **options)


def stitched(made, tiling):
    """The whole grid put together from the blocks' cores: rgb, valid."""
    grid = made.grid
    rgb, valid = np.zeros((grid.height, grid.width, 3), "uint8"), np.zeros((grid.height, grid.width), bool)
    for block in tiling.blocks(grid.width, grid.height):
        core = tiling.block_core(block, grid.width, grid.height)
        colours, data = tiles.read_block(made, tiling, block)
        p = tiling.margin
        assert colours.shape == (core.height + 2 * p, core.width + 2 * p, 3)
        place = (slice(core.row, core.row + core.height), slice(core.col, core.col + core.width))
        rgb[place], valid[place] = (a[p : p + core.height, p : p + core.width] for a in (colours, data))
    return rgb, valid


def whole(made):
    return tiles.read_window(made, Window(0, 0, made.grid.width, made.grid.height))


class TestSameGrid:
    @pytest.mark.parametrize(
        ("suffix", "profile"),
        [
            ("tif", {"tiled": True, "blockxsize": 32, "blockysize": 32, "compress": "deflate"}),
            ("tif", {"blockysize": 1}),
            ("tif", {"interleave": "pixel", "compress": "lzw"}),
            ("tif", {"driver": "COG"}),
            ("jp2", {"driver": "JP2OpenJPEG", "reversible": "YES", "quality": 100}),
            ("img", {"driver": "HFA"}),
        ],
        ids=["tiled", "striped", "interleaved", "cog", "jpeg2000", "imagine"],
    )
    def test_pixels_are_the_files_own(self, tmp_path, suffix, profile):
        values = rasters.picture()
        made = build(tmp_path, rasters.write(tmp_path / f"a.{suffix}", values, **profile))
        for rgb, valid in (whole(made), stitched(made, TILING)):
            assert (rgb == values.transpose(1, 2, 0)).all()
            assert valid.all()

    def test_a_vrt(self, tmp_path):
        values = rasters.picture()
        rasters.write(tmp_path / "a.tif", values)
        with rasterio.open(tmp_path / "a.tif") as source:
            rasterio.shutil.copy(source, tmp_path / "a.vrt", driver="VRT")
        assert (whole(build(tmp_path, tmp_path / "a.vrt"))[0] == values.transpose(1, 2, 0)).all()

    def test_edges_are_repeated_and_marked(self, tmp_path):
        values = rasters.picture(height=40, width=50)
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", values))
        tiling = Tiling(64, 8, 4)
        rgb, valid = tiles.read_block(made, tiling, tiling.block_of("r000c000"))
        assert (rgb == np.pad(values.transpose(1, 2, 0), ((8, 8), (8, 8), (0, 0)), "edge")).all()
        assert valid[8:-8, 8:-8].all()
        assert valid.sum() == 40 * 50

    def test_chosen_bands(self, tmp_path):
        values = rasters.picture(8, dtype="uint16")
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", values))
        other = build(tmp_path / "b", rasters.write(tmp_path / "b.tif", values[[4, 2, 1]]))
        assert made.bands == (5, 3, 2)
        assert (whole(made)[0] == whole(other)[0]).all()

    @pytest.mark.parametrize("dtype", ["uint16", "int16", "float32", "uint32"])
    def test_more_than_8_bits_are_stretched_alike_everywhere(self, tmp_path, dtype):
        values = rasters.picture(dtype=dtype)
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", values))
        rgb, valid = stitched(made, TILING)
        assert valid.all()
        assert (rgb == whole(made)[0]).all()
        assert (rgb.min(), rgb.max()) == (1, 255)
        order = np.argsort(values[0], axis=None)
        assert (np.diff(rgb[..., 0].ravel()[order].astype(int)) >= 0).all()

    def test_an_aoi_shows_the_same_pixels(self, tmp_path):
        import geopandas
        import shapely

        values = rasters.picture(dtype="uint16")
        path = rasters.write(tmp_path / "a.tif", values)
        box = shapely.box(rasters.X0 + 7.6, rasters.Y0 - 22.8, rasters.X0 + 30.4, rasters.Y0 - 3.8)
        geopandas.GeoSeries([box], crs="EPSG:32631").to_file(tmp_path / "aoi.gpkg")
        made = build(tmp_path, path, aoi=tmp_path / "aoi.gpkg")
        assert (made.grid.width, made.grid.height) == (60, 50)
        assert (whole(made)[0] == whole(build(tmp_path / "b", path))[0][10:60, 20:80]).all()


class TestMissingData:
    def missing(self, values, dtype, tmp_path, how):
        """A raster whose left 40 columns are missing, told in one of four ways."""
        if how == "alpha":
            alpha = np.full((1, *values.shape[1:]), 255, dtype)
            alpha[:, :, :40] = 0
            return rasters.write(tmp_path / "a.tif", np.concatenate([values, alpha]))
        if how == "mask":
            path = rasters.write(tmp_path / "a.tif", values)
            keep = np.full(values.shape[1:], 255, "uint8")
            keep[:, :40] = 0
            with rasterio.open(path, "r+") as target:
                target.write_mask(keep)
            return path
        values[:, :, :40] = np.nan if how == "nan" else 9 if how == "nodata" else 0
        return rasters.write(tmp_path / "a.tif", values, nodata=9 if how == "nodata" else None)

    @pytest.mark.parametrize(
        ("dtype", "how"),
        [
            ("uint8", "alpha"),
            ("uint8", "mask"),
            ("uint8", "nodata"),
            ("uint16", "nodata"),
            ("uint16", "zeros"),
            ("float32", "nan"),
        ],
    )
    @pytest.mark.parametrize("gsd", [0.38, 0.3], ids=["own grid", "resampled"])
    def test_alpha_is_zero_and_colour_goes_on(self, tmp_path, dtype, how, gsd):
        values = rasters.picture(dtype=dtype)
        made = build(tmp_path, self.missing(values, dtype, tmp_path, how), gsd)
        rgb, valid = whole(made)
        first = 40 * 0.38 / gsd
        cols = np.arange(made.grid.width)
        inner = slice(2, -2)
        assert not valid[:, cols < first - 1.5].any()
        assert valid[inner, (cols > first + 1) & (cols < 108)].all()
        near = int(np.ceil(first)) - 3
        assert np.abs(rgb[inner, near - 20 : near].astype(int) - rgb[inner, near + 4][:, None]).max() < 60
        assert not rgb[:, : int(first) - tiles.FILL - 2].any()
        assert (stitched(made, TILING)[1] == valid).all()
        assert (stitched(made, TILING)[0] == rgb).all()

    @pytest.mark.parametrize("gsd", [0.38, 0.3], ids=["own grid", "resampled"])
    def test_nan_is_missing_beside_a_nodata_value_too(self, tmp_path, gsd):
        values = rasters.picture(dtype="float32")
        values[:, :, :10], values[:, :, 10:40] = 9, np.nan
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", values, nodata=9), gsd)
        rgb, valid = whole(made)
        first, cols = 40 * 0.38 / gsd, np.arange(made.grid.width)
        assert not valid[:, cols < first - 1.5].any()
        assert valid[2:-2, (cols > first + 3) & (cols < 108)].all()  # warped, NaN spreads as far as the kernel
        assert (rgb[2:-2, cols > first - 3] > 0).all()

    def test_one_black_band_is_not_missing(self, tmp_path):
        values = rasters.picture()
        values[0, :, :40] = 0
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", values, nodata=0))
        assert whole(made)[1].all()

    def test_specks_with_the_nodata_value_are_data(self, tmp_path):
        """Deep shadow clipped to 0 is no hole in the image; its colour is that beside it."""
        values = rasters.picture(dtype="uint16")
        values[:, 20:24, 30:90] = 0
        values[:, 50:60, 30:60] = 0
        rgb, valid = whole(build(tmp_path, rasters.write(tmp_path / "a.tif", values, nodata=0)))
        assert valid[:50].all()
        assert not valid[50:60, 30:60].any()
        assert (~valid).sum() == 300
        assert (rgb > 0).all()

    def test_shadows_of_rotterdam_are_data(self, tmp_path, kibs_data):
        made = build(tmp_path, kibs_data / "rotterdam/rgbn_16bit_1.tif", 0.5)
        rgb, valid = whole(made)
        assert (rgb.shape, valid.all()) == ((600, 600, 3), True)
        half = build(tmp_path, kibs_data / "rotterdam/rgbn_16bit_3.tif", 0.5)
        assert whole(half)[1].mean() == pytest.approx(0.607, abs=0.003)

    @settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 4), st.sampled_from([0.38, 0.29]))
    def test_cuts_change_no_pixel(self, tmp_path, seed, margin, block, gsd):
        """Blobs of missing data anywhere, any tiling: the same pixels and the same mask."""
        random = np.random.default_rng(seed)
        values = rasters.picture(dtype="uint16")
        for _ in range(6):
            row, col, height, width = random.integers((0, 0, 1, 1), (90, 110, 50, 50))
            values[:, row : row + height, col : col + width] = 0
        values[:, :5, :5] = 1000
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", values), gsd)
        rgb, valid = whole(made)
        cut, data = stitched(made, Tiling(24 + 2 * margin, margin, block))
        assert (cut == rgb).all()
        assert (data == valid).all()


CASES = [
    ("EPSG:32631", Affine(0.3, 0, 500_000, 0, -0.3, 5_400_000)),
    ("EPSG:32631", Affine(0.12, 0, 500_000, 0, -0.12, 5_400_000)),
    ("EPSG:32631", Affine(0.5, 0, 500_000, 0, -0.5, 5_400_000)),
    ("EPSG:32631", Affine(0.3, 0, 500_000, 0, 0.3, 5_400_000)),
    ("EPSG:32631", Affine(0.3, 0.1, 500_000, 0.1, -0.3, 5_400_000)),
    ("EPSG:4326", Affine(5e-6, 0, 4.5, 0, -3.4e-6, 51.9)),
    ("EPSG:4326", Affine(5e-6, 0, 289.3, 0, -3.6e-6, -33.4)),
    ("EPSG:4326", Affine(5e-6, 0, 179.9996, 0, -4.5e-6, -17.0)),
    ("EPSG:3857", Affine(0.5, 0, 500_000, 0, -0.5, 6_780_000)),
    ("EPSG:2263", Affine(1.2, 0, 980_000, 0, -1.2, 200_000)),
]
IDS = ["0.3 m", "0.12 m", "0.5 m", "south up", "rotated", "degrees", "0 to 360", "180", "web mercator", "feet"]


class TestResampled:
    @pytest.mark.parametrize(("crs", "transform"), CASES, ids=IDS)
    def test_colours_lie_where_they_lie_in_the_raster(self, tmp_path, crs, transform):
        """Each grid pixel against a smooth picture evaluated at its own position, found with pyproj: no half-pixel shift."""
        import pyproj

        height, width = 150, 200
        row, col = np.mgrid[:height, :width] + 0.5

        def truth(col, row):
            return 128 + 60 * np.stack([np.sin(col / 17), np.cos(row / 13), np.sin((col + row) / 23)])

        path = rasters.write(tmp_path / "a.tif", np.rint(truth(col, row)).astype("uint8"), crs, transform=transform)
        made = build(tmp_path, path)
        rgb, valid = whole(made)
        assert valid.mean() > 0.4
        rows, cols = np.nonzero(valid)
        x, y = made.grid.to_map(np.column_stack([cols + 0.5, rows + 0.5])).T
        x, y = pyproj.Transformer.from_crs(made.grid.crs, crs, always_xy=True).transform(x, y)
        if crs == "EPSG:4326":
            x += 360 * np.rint((transform.c - x) / 360)
        c, r = ~transform * (x, y)
        inner = (c > 4) & (c < width - 4) & (r > 4) & (r < height - 4)
        assert valid.sum() * made.grid.gsd**2 > 0.9 * self.ground_area(transform, crs, made, height, width)
        difference = rgb[rows, cols].T - truth(c, r)
        assert np.abs(difference[:, inner]).max() < 2.0
        assert np.abs(difference[:, inner].mean()) < 0.1

    def ground_area(self, transform, crs, made, height, width):
        import pyproj
        import shapely

        corners = [transform * c for c in [(0, 0), (width, 0), (width, height), (0, height)]]
        placed = pyproj.Transformer.from_crs(crs, made.grid.crs, always_xy=True).transform(*np.transpose(corners))
        return shapely.Polygon(np.transpose(placed)).area

    @pytest.mark.parametrize(("crs", "transform"), CASES, ids=IDS)
    def test_cuts_change_no_pixel(self, tmp_path, crs, transform):
        random = np.random.default_rng(3)
        noise = random.integers(1, 255, (3, 120, 150)).astype("uint8")
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", noise, crs, transform=transform))
        rgb, valid = whole(made)
        for tiling in (Tiling(64, 4, 2), Tiling(80, 17, 1)):
            cut, data = stitched(made, tiling)
            assert (cut == rgb).all()
            assert (data == valid).all()

    def test_shrinking_averages_instead_of_picking(self, tmp_path):
        """White noise at 0.1 m keeps its mean and loses its spread at 0.38 m."""
        random = np.random.default_rng(3)
        noise = random.integers(1, 255, (3, 400, 400)).astype("uint8")
        for gsd, spread in ((0.1, 0.4), (0.25, 0.8)):
            made = build(tmp_path, rasters.write(tmp_path / "a.tif", noise, gsd=gsd))
            rgb, _ = whole(made)
            assert rgb.mean() == pytest.approx(noise.mean(), abs=1)
            assert rgb.std() < spread * noise.std()


class TestCommandLine:
    def test_writes_what_read_block_reads(self, tmp_path):
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture(dtype="uint16")))
        place = f"-m kibs_steps.tiles --scene {tmp_path}/out/scene.json --tile 32 --margin 4 --block 2"
        for out in ("one.tif", "two.tif"):
            command = f"{place} --name r001c002 --out {tmp_path / out}"
            subprocess.run([sys.executable, *command.split()], check=True)
        assert (tmp_path / "one.tif").read_bytes() == (tmp_path / "two.tif").read_bytes()
        block = TILING.block_of("r001c002")
        rgb, valid = tiles.read_block(made, TILING, block)
        with rasterio.open(tmp_path / "one.tif") as written:
            assert (written.read([1, 2, 3]) == rgb.transpose(2, 0, 1)).all()
            assert (written.read(4) == np.where(valid, 255, 0)).all()
            assert written.colorinterp[3] == rasterio.enums.ColorInterp.alpha
            assert written.crs == made.grid.crs
            assert tuple(written.transform)[:6] == pytest.approx(
                (0.38, 0, made.grid.x0 + 92 * 0.38, 0, -0.38, made.grid.y0 - 44 * 0.38)
            )

    def test_a_block_the_scene_does_not_have(self, tmp_path):
        made = build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture()))
        with pytest.raises(tiles.NoSuchBlock, match="r000c000 to r001c002"):
            tiles.read_block(made, TILING, TILING.block_of("r002c000"))


@pytest.mark.parametrize(
    ("dtype", "alpha", "nodata"),
    [("float32", 1, None), ("float32", 0.5, None), ("float32", 255, -9999), ("uint16", 1, 0), ("uint8", 255, None)],
)
def test_any_alpha_above_nothing_is_data_when_resampled_too(tmp_path, dtype, alpha, nodata):
    """A sixteenth of the raster is transparent; whatever number the others hold, they are data."""
    values = np.random.default_rng(0).uniform(0.1, 0.9, (4, 160, 160)) * (1 if dtype == "float32" else 200)
    values = values.astype(dtype)
    values[3] = alpha
    values[3, 40:80, 40:80] = 0
    names = ("red", "green", "blue", "alpha")
    told = {
        "colours": [rasterio.enums.ColorInterp[name] for name in names],
        **({} if nodata is None else {"nodata": nodata}),
    }
    path = rasters.write(tmp_path / "a.tif", values, gsd=0.4, **told)
    facts, _ = rasters.build(tmp_path, path, "10", gsd=0.5)
    _, valid = tiles.read_window(facts, Window(0, 0, facts.grid.width, facts.grid.height))
    assert valid.mean() == pytest.approx(15 / 16, abs=0.01)
