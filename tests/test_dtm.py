"""Terrain of a scene: any file or number becomes heights on the scene's CRS in metres; what cannot be is refused by name."""

import numpy as np
import pyproj
import pytest
import rasterio
import rasters
from affine import Affine
from rasters import build

from kibs_steps import dtm


class TestDtm:
    """The scene is 41.8 × 34.2 m at (X0, Y0); a plane z = 100 + 0.1·(x − X0) − 0.2·(y − Y0) is its ground."""

    LEFT, TOP = rasters.X0 - 301.0, rasters.Y0 + 299.0

    def plane(self, x, y):
        return 100 + 0.1 * (np.asarray(x) - rasters.X0) - 0.2 * (np.asarray(y) - rasters.Y0)

    def heights(self, step=2.0, cols=340, rows=330):
        x = self.LEFT + (np.arange(cols) + 0.5) * step
        y = self.TOP - (np.arange(rows) + 0.5) * step
        return self.plane(x[None], y[:, None]).astype("float32")

    def scene(self, tmp_path, ground, **options):
        return build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture()), str(ground), **options)

    def check(self, made, tolerance):
        left, bottom, right, top = made.grid.bounds
        points = np.random.default_rng(0).uniform((left, bottom), (right, top), (500, 2))
        ground = made.terrain(made.grid.bounds)
        assert np.abs(ground(points) - self.plane(*points.T)).max() < tolerance
        return ground

    def test_a_number(self, tmp_path):
        made, content = self.scene(tmp_path, "31.5")
        assert (made.terrain(made.grid.bounds)(made.grid.to_map([[0, 0], [110, 90], [-500, 40]])) == 31.5).all()
        assert content["dtm"] == {"source": 31.5, "step": None, "filled": 0.0}
        with rasterio.open(tmp_path / "out/dtm.tif") as written:
            assert written.bounds.left <= rasters.X0 - 250
            assert written.bounds.bottom <= made.grid.bounds[1] - 250

    def test_own_pixels_are_kept_in_the_same_crs(self, tmp_path):
        heights = self.heights() + np.random.default_rng(1).normal(size=(330, 340)).astype("float32")
        path = rasters.dtm(tmp_path / "dtm.tif", heights, self.LEFT, self.TOP)
        made, content = self.scene(tmp_path, path)
        with rasterio.open(tmp_path / "out/dtm.tif") as written, rasterio.open(path) as given:
            window = given.window(*written.bounds).round_offsets().round_lengths()
            assert (written.read(1) == given.read(1, window=window)).all()
            assert written.dtypes == ("float32",)
            assert written.bounds.left <= made.grid.bounds[0] - 250 < written.bounds.left + 2
            assert written.bounds.top - 2 < made.grid.bounds[3] + 250 <= written.bounds.top
        assert content["dtm"]["filled"] == 0

    @pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2154", "EPSG:32632"])
    def test_other_crs_are_warped(self, tmp_path, crs):
        there = pyproj.Transformer.from_crs(32631, crs, always_xy=True)
        centre = there.transform(rasters.X0 + 20, rasters.Y0 - 17)
        step_x, step_y = (4e-5, 2.6e-5) if crs == "EPSG:4326" else (3.0, 3.0)
        x = centre[0] + (np.arange(300) - 150 + 0.5) * step_x
        y = centre[1] - (np.arange(300) - 150 + 0.5) * step_y
        own_x, own_y = there.transform(*np.meshgrid(x, y), direction="INVERSE")
        transform = Affine(step_x, 0, x[0] - step_x / 2, 0, -step_y, y[0] + step_y / 2)
        heights = self.plane(own_x, own_y).astype("float32")[None]
        made, content = self.scene(tmp_path, rasters.write(tmp_path / "dtm.tif", heights, crs, transform=transform))
        self.check(made, 0.02)
        assert content["dtm"]["step"][0] == pytest.approx(3.0, rel=0.05)

    def test_longitudes_from_0_to_360_degrees(self, tmp_path):
        heights = np.random.default_rng(2).normal(100, 5, (1, 60, 60)).astype("float32")
        image = rasters.write(
            tmp_path / "a.tif", rasters.picture(), "EPSG:32719", transform=Affine(0.38, 0, 4e5, 0, -0.38, 6.3e6)
        )
        west, north = pyproj.Transformer.from_crs(32719, 4326, always_xy=True).transform(4e5, 6.3e6)
        made = {}
        for name, left in (("usual", west - 0.02), ("beyond", west - 0.02 + 360)):
            ground = rasters.dtm(tmp_path / f"{name}.tif", heights[0], left, north + 0.02, 7e-4, "EPSG:4326")
            scene, content = build(tmp_path / name, image, str(ground))
            made[name] = scene.terrain(scene.grid.bounds)(scene.grid.to_map([[0, 0], [50, 40], [110, 90]]))
            assert content["dtm"]["filled"] == 0
        assert made["beyond"] == pytest.approx(made["usual"], abs=1e-3)

    @pytest.mark.parametrize("unit", ["ft", "US survey foot", "foot"])
    def test_feet_by_band_unit(self, tmp_path, unit):
        path = rasters.dtm(tmp_path / "dtm.tif", self.heights() / np.float32(0.3048), self.LEFT, self.TOP)
        with rasterio.open(path, "r+") as target:
            target.units = (unit,)
        made, _ = self.scene(tmp_path, path)
        self.check(made, 0.01)

    def test_feet_by_vertical_crs(self, tmp_path):
        """EPSG:6360 is NAVD88 height in US survey feet."""
        feet = self.heights() / np.float32(1200 / 3937)
        path = rasters.dtm(tmp_path / "dtm.tif", feet, self.LEFT, self.TOP, crs="EPSG:32631+6360")
        made, _ = self.scene(tmp_path, path)
        self.check(made, 0.01)

    def test_decimetres_by_scale(self, tmp_path):
        path = rasters.dtm(tmp_path / "dtm.tif", np.rint(self.heights() * 10).astype("int16"), self.LEFT, self.TOP)
        with rasterio.open(path, "r+") as target:
            target.scales = (0.1,)
        made, _ = self.scene(tmp_path, path)
        self.check(made, 0.06)

    def test_an_unknown_unit_is_refused(self, tmp_path):
        path = rasters.dtm(tmp_path / "dtm.tif", self.heights(), self.LEFT, self.TOP)
        with rasterio.open(path, "r+") as target:
            target.units = ("fathom",)
        with pytest.raises(dtm.DtmAbsurd, match="fathom"):
            self.scene(tmp_path, path)

    def test_holes_are_filled_and_told(self, tmp_path, capsys):
        heights = self.heights()
        heights[152:158, 154:164] = -9999
        path = rasters.dtm(tmp_path / "dtm.tif", heights, self.LEFT, self.TOP, nodata=-9999)
        made, content = self.scene(tmp_path, path)
        self.check(made, 0.7)
        assert content["dtm"]["filled"] == pytest.approx(6 * 10 * 4 / (41.8 * 34.2), rel=0.2)
        assert "filled from its neighbours" in capsys.readouterr().err

    def test_large_holes_leave_none_behind(self, tmp_path):
        """Holes wider than what strips can fill on their own, in a DTM taller than a strip."""
        cols, rows = 2700, 2600
        heights = np.fromfunction(lambda i, j: 50 + 0.01 * j, (rows, cols)).astype("float32")
        heights[1000:1400, 1000:1400] = np.nan
        path = rasters.dtm(tmp_path / "dtm.tif", heights, rasters.X0 - 300, rasters.Y0 + 300, step=0.25)
        made, _ = self.scene(tmp_path, path)
        with rasterio.open(tmp_path / "out/dtm.tif") as written:
            assert written.height > dtm.STRIP
            filled = written.read(1)
        assert np.isfinite(filled).all()
        assert 50 < filled.min() < filled.max() < 78
        assert made.terrain(made.grid.bounds)(made.grid.to_map([[55, 45]])) == pytest.approx(63, abs=2)

    def test_a_partial_dtm_is_refused_with_its_share(self, tmp_path):
        left = rasters.X0 + 41.8 * 0.25
        path = rasters.dtm(tmp_path / "dtm.tif", self.heights(), left, self.TOP)
        with pytest.raises(dtm.DtmPartial, match=r"(19|20|21)\.\d\d % of the scene"):
            self.scene(tmp_path, path)

    def test_a_dtm_elsewhere_is_refused(self, tmp_path):
        path = rasters.dtm(tmp_path / "dtm.tif", self.heights(), rasters.X0 + 9000, self.TOP)
        with pytest.raises(dtm.DtmPartial, match="100"):
            self.scene(tmp_path, path)

    def test_a_dtm_of_nothing_is_refused(self, tmp_path):
        path = rasters.dtm(
            tmp_path / "dtm.tif", np.full((330, 340), -9999.0, "float32"), self.LEFT, self.TOP, nodata=-9999
        )
        with pytest.raises(dtm.DtmPartial, match="100"):
            self.scene(tmp_path, path)

    def test_a_dtm_of_just_the_raster_will_do(self, tmp_path):
        """The terrain goes on beyond it, as far as a view ray may look."""
        path = rasters.dtm(tmp_path / "dtm.tif", np.full((18, 21), 12.0, "float32"), rasters.X0, rasters.Y0)
        made, content = self.scene(tmp_path, path)
        assert (made.terrain(made.grid.bounds)(made.grid.to_map([[-400, -400], [50, 50]])) == 12).all()
        assert content["warnings"] == []

    def test_a_turned_raster_needs_no_dtm_beside_it(self, tmp_path):
        """A DTM with the raster's own footprint in degrees leaves the corners of the UTM grid empty, not the scene."""
        transform = Affine(5e-6, 0, 4.5, 0, -3.4e-6, 51.9)
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), "EPSG:4326", transform=transform)
        heights = np.full((1, 45, 55), 5.0, "float32")
        ground = rasters.write(tmp_path / "dtm.tif", heights, "EPSG:4326", transform=transform * Affine.scale(2.0))
        made, content = build(tmp_path, path, ground)
        assert content["dtm"]["filled"] < 0.1
        assert made.terrain(made.grid.bounds)(made.grid.to_map([[0, 0], [60, 60]])) == pytest.approx(5)

    def test_undeclared_nodata_is_refused(self, tmp_path):
        heights = self.heights()
        heights[155, 155] = -32768
        path = rasters.dtm(tmp_path / "dtm.tif", heights, self.LEFT, self.TOP)
        with pytest.raises(dtm.DtmAbsurd, match=r"a_nodata -32768"):
            self.scene(tmp_path, path)

    @pytest.mark.parametrize("number", ["12000", "nan", "-inf"])
    def test_absurd_numbers_are_refused(self, tmp_path, number):
        with pytest.raises(dtm.DtmAbsurd):
            self.scene(tmp_path, number)

    def test_missing_or_unplaced_dtms_are_refused(self, tmp_path):
        with pytest.raises(dtm.DtmMissing, match="does not exist"):
            self.scene(tmp_path, tmp_path / "no.tif")
        with pytest.raises(dtm.DtmMissing, match="no CRS"):
            self.scene(tmp_path, rasters.dtm(tmp_path / "dtm.tif", self.heights(), self.LEFT, self.TOP, crs=None))

    def test_lidar_terrain_of_washington(self, tmp_path, kibs_data):
        """Real terrain, nodata included; the raster has its CRS, so its pixels are kept."""
        path = kibs_data / "terrain_dc/dtm.tif"
        with rasterio.open(path) as source:
            heights, bounds, nodata = source.read(1), source.bounds, source.nodata
        x0, y0 = bounds.left + 150, bounds.top - 150
        raster = rasters.write(
            tmp_path / "a.tif", rasters.picture(), "EPSG:26918", transform=Affine(0.5, 0, x0, 0, -0.5, y0)
        )
        made, _ = build(tmp_path, raster, path, gsd=0.5)
        inside = heights[75:97, 75:102]
        at = made.terrain(made.grid.bounds)(made.grid.to_map([[2.0, 2.0], [54.0, 46.0]]))
        assert np.allclose(at, [inside[0, 0], inside[11, 13]], atol=1e-4)
        assert (heights == nodata).any() or np.isfinite(heights).all()
        with rasterio.open(tmp_path / "out/dtm.tif") as written:
            assert np.isfinite(written.read(1)).all()
            assert written.read(1).min() > -50

    def test_heights_by_scale_and_offset(self, tmp_path):
        """Decimetres counted from 1000 m below the datum."""
        values = np.rint((self.heights() + 1000) * 10).astype("int16")
        path = rasters.dtm(tmp_path / "dtm.tif", values, self.LEFT, self.TOP)
        with rasterio.open(path, "r+") as target:
            target.scales, target.offsets = (0.1,), (-1000.0,)
        self.check(self.scene(tmp_path, path)[0], 0.06)
