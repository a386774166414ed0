"""Scene: what is read from a raster (its terrain: test_dtm), and every bad input refused by name."""

import subprocess
import sys

import numpy as np
import pyproj
import pytest
import rasterio
import rasters
import shapely
from affine import Affine
from rasterio.enums import ColorInterp
from rasters import build

from kibs_steps import dtm, georeference, imagery, scene
from kibs_steps.grid import Grid

GRID = Grid("EPSG:32631", rasters.X0, rasters.Y0, 0.38, 110, 90)


class TestModelGrid:
    def test_a_raster_of_the_models_gsd_is_used_as_it_is(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), gsd=0.3805)
        assert georeference.model_grid(path, 0.38) == Grid("EPSG:32631", rasters.X0, rasters.Y0, 0.3805, 110, 90)

    @pytest.mark.parametrize("gsd", [0.1, 0.3, 0.5])
    def test_another_gsd_is_resampled_over_the_same_bounds(self, tmp_path, gsd):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), gsd=gsd)
        grid = georeference.model_grid(path, 0.38)
        left, bottom, right, top = grid.bounds
        assert (grid.crs, grid.gsd, left, top) == ("EPSG:32631", 0.38, rasters.X0, rasters.Y0)
        assert 0 <= right - (rasters.X0 + 110 * gsd) < 0.38
        assert 0 <= (rasters.Y0 - 90 * gsd) - bottom < 0.38

    @pytest.mark.parametrize(
        ("crs", "transform", "zone"),
        [
            ("EPSG:4326", Affine(5e-6, 0, 4.5, 0, -3.4e-6, 51.9), "EPSG:32631"),
            ("EPSG:4326", Affine(3.6e-6, 0, 18.42, 0, -3.4e-6, -33.9), "EPSG:32734"),
            ("EPSG:3857", Affine(0.5, 0, 500_000, 0, -0.5, 6_780_000), "EPSG:32631"),
            ("EPSG:2263", Affine(1.2, 0, 980_000, 0, -1.2, 200_000), "EPSG:32618"),
            ("EPSG:32631", Affine(0.3, 0.1, 500_000, 0.1, -0.3, 5_400_000), "EPSG:32631"),
        ],
        ids=["degrees", "southern degrees", "web mercator", "feet", "rotated"],
    )
    def test_others_are_covered_by_a_utm_grid(self, tmp_path, crs, transform, zone):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), crs, transform=transform)
        grid = georeference.model_grid(path, 0.38)
        assert (grid.crs, grid.gsd) == (zone, 0.38)
        corners = [transform * corner for corner in [(0, 0), (110, 0), (110, 90), (0, 90), (55, 0), (55, 90)]]
        x, y = pyproj.Transformer.from_crs(crs, zone, always_xy=True).transform(*np.transpose(corners))
        left, bottom, right, top = grid.bounds
        assert left <= min(x) < left + 0.76
        assert right - 0.76 < max(x) <= right
        assert bottom <= min(y) < bottom + 0.76
        assert top - 0.76 < max(y) <= top

    @pytest.mark.parametrize(
        ("crs", "x", "y", "turned"),
        [("EPSG:27572", 505_000, 2_524_000, -0.959), ("EPSG:27572", 900_000, 2_000_000, 2.770)],
    )
    def test_grids_that_count_from_paris_are_kept_and_turned_right(self, tmp_path, crs, x, y, turned):
        place = Affine(0.38, 0, x, 0, -0.38, y)
        grid = georeference.model_grid(rasters.write(tmp_path / "a.tif", rasters.picture(), crs, transform=place), 0.38)
        assert (grid.crs, grid.gsd) == (crs, 0.38)
        to_map = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
        longitude, latitude = to_map.transform(x, y, direction="INVERSE")
        east, north = to_map.transform([longitude] * 2, [latitude - 1e-4, latitude + 1e-4])
        by = np.degrees(np.arctan2(east[1] - east[0], north[1] - north[0]))  # true north, clockwise from the grid's
        assert georeference.convergence(grid) == pytest.approx(-by, abs=1e-3)
        assert georeference.convergence(grid) == pytest.approx(turned, abs=0.01)

    def test_grads_from_paris_are_not_taken_for_degrees(self, tmp_path):
        place = Affine(5e-6, 0, (1.64 - 2.337229) / 0.9, 0, -3.8e-6, 49.72 / 0.9)
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), "EPSG:4807", transform=place)
        assert georeference.model_grid(path, 0.38).crs == "EPSG:32631"

    def test_feet_are_not_taken_for_metres(self, tmp_path):
        path = rasters.write(
            tmp_path / "a.tif", rasters.picture(), "EPSG:2263", transform=Affine(1.0, 0, 980_000, 0, -1.0, 200_000)
        )
        grid = georeference.model_grid(path, 0.3048)
        assert grid.width == pytest.approx(110, abs=4)

    def test_a_national_grid_is_kept(self, tmp_path):
        path = rasters.write(
            tmp_path / "a.tif", rasters.picture(), "EPSG:7415", transform=Affine(0.38, 0, 92_000, 0, -0.38, 437_000)
        )
        assert georeference.model_grid(path, 0.38).crs == "EPSG:28992"

    def test_a_third_axis_of_the_crs_counts_nothing(self, tmp_path):
        solid = pyproj.CRS("EPSG:32631").to_3d().to_wkt()
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), solid)
        with rasterio.open(path) as source:
            assert len(pyproj.CRS.from_wkt(source.crs.to_wkt()).axis_info) == 3
        assert georeference.model_grid(path, 0.38).crs == "EPSG:32631"

    def test_too_coarse_is_refused(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), gsd=0.62)
        with pytest.raises(georeference.GsdTooCoarse, match=r"0\.62 m"):
            georeference.model_grid(path, 0.38)
        assert georeference.model_grid(path, 0.39).gsd == 0.39

    def test_web_mercator_pixels_are_measured_on_the_ground(self, tmp_path):
        """At 60° N a Web Mercator pixel of 1 m is half a metre."""
        _, y = pyproj.Transformer.from_crs(4326, 3857, always_xy=True).transform(11.0, 60.0)
        path = rasters.write(
            tmp_path / "a.tif", rasters.picture(), "EPSG:3857", transform=Affine(1.0, 0, 1_224_500, 0, -1.0, y)
        )
        grid = georeference.model_grid(path, 0.38)
        assert grid.width * grid.gsd == pytest.approx(55, abs=3)

    @pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:4326", "EPSG:3857"])
    def test_aoi_of_any_crs_clips_to_whole_pixels(self, tmp_path, crs):
        import geopandas

        path = rasters.write(tmp_path / "a.tif", rasters.picture())
        box = shapely.box(rasters.X0 + 3.8, rasters.Y0 - 0.38 * 40.5, rasters.X0 + 0.38 * 50.5, rasters.Y0 - 3.8)
        geopandas.GeoSeries([box], crs="EPSG:32631").to_crs(crs).to_file(tmp_path / "aoi.gpkg")
        grid = georeference.model_grid(path, 0.38, tmp_path / "aoi.gpkg")
        whole = GRID.to_image(np.array([[grid.x0, grid.y0]]))
        assert np.allclose(whole, np.rint(whole), atol=1e-6)
        assert np.allclose(whole, 10, atol=1.001)
        assert (grid.width, grid.height) == (pytest.approx(41, abs=1), pytest.approx(31, abs=1))

    def test_aoi_larger_than_the_raster_changes_nothing(self, tmp_path):
        import geopandas

        path = rasters.write(tmp_path / "a.tif", rasters.picture())
        around = shapely.box(*GRID.bounds).buffer(100)
        geopandas.GeoSeries([around], crs="EPSG:32631").to_file(tmp_path / "aoi.geojson")
        assert georeference.model_grid(path, 0.38, tmp_path / "aoi.geojson") == GRID

    def test_unusable_aois_are_refused(self, tmp_path):
        import geopandas

        path = rasters.write(tmp_path / "a.tif", rasters.picture())
        far = shapely.box(*GRID.bounds)
        far = shapely.affinity.translate(far, 5000, 0)
        geopandas.GeoSeries([far], crs="EPSG:32631").to_file(tmp_path / "far.gpkg")
        geopandas.GeoSeries([], crs="EPSG:32631").to_file(tmp_path / "empty.gpkg")
        geopandas.GeoSeries([far]).to_file(tmp_path / "nowhere.shp")
        for name, says in [
            ("far.gpkg", "outside the raster"),
            ("empty.gpkg", "no shape"),
            ("nowhere.shp", "no CRS"),
            ("missing.gpkg", "cannot be read"),
        ]:
            with pytest.raises(georeference.AoiUnusable, match=says):
                georeference.model_grid(path, 0.38, tmp_path / name)


class TestBadRasters:
    def test_missing(self, tmp_path):
        with pytest.raises(imagery.RasterMissing, match="does not exist"):
            georeference.model_grid(tmp_path / "no.tif", 0.38)

    def test_not_a_raster(self, tmp_path):
        (tmp_path / "a.tif").write_text("hello")
        with pytest.raises(imagery.NotARaster, match="cannot be read"):
            georeference.model_grid(tmp_path / "a.tif", 0.38)

    def test_no_crs(self, tmp_path):
        with pytest.raises(imagery.NotGeoreferenced, match="no CRS"):
            georeference.model_grid(rasters.write(tmp_path / "a.tif", rasters.picture(), None), 0.38)

    def test_no_geotransform(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), transform=Affine.identity())
        with pytest.raises(imagery.NotGeoreferenced, match="geotransform"):
            georeference.model_grid(path, 0.38)

    def test_coordinates_that_the_crs_cannot_hold(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), "EPSG:4326")
        with pytest.raises(imagery.NotGeoreferenced, match="outside the area"):
            georeference.model_grid(path, 0.38)

    def test_no_data(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", np.zeros((3, 20, 20), "uint16"))
        with pytest.raises(imagery.NoData):
            build(tmp_path, path)


class TestBands:
    def bands(self, tmp_path, count, dtype="uint16", chosen=None, **options):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(count, dtype=dtype), **options)
        with imagery.opened(path) as source:
            return imagery.colour_bands(source, chosen)

    def test_three(self, tmp_path):
        assert self.bands(tmp_path, 3) == ((1, 2, 3), "")

    def test_rgba(self, tmp_path):
        assert self.bands(tmp_path, 4, "uint8") == ((1, 2, 3), "")

    def test_colour_interpretation(self, tmp_path):
        colours = (ColorInterp.blue, ColorInterp.green, ColorInterp.red, ColorInterp.undefined)
        assert self.bands(tmp_path, 4, colours=colours) == ((3, 2, 1), "")

    @pytest.mark.parametrize(
        ("names", "bands"),
        [
            (("Deep Blue", "Blue", "Green", "Red", "Red Edge", "NIR"), (4, 3, 2)),
            (("coastal_blue", "blue", "green", "yellow", "red", "red-edge", "nir1", "nir2"), (5, 3, 2)),
        ],
    )
    def test_bands_beside_blue_are_not_blue(self, tmp_path, names, bands):
        assert self.bands(tmp_path, len(names), descriptions=names) == (bands, "")

    def test_descriptions(self, tmp_path):
        names = ("Coastal", "Blue (B2)", "Green", "Red Edge", "red-edge 2", "RED", "NIR", "x", "y")
        assert self.bands(tmp_path, 9, descriptions=names) == ((6, 3, 2), "")

    def test_worldview_eight(self, tmp_path):
        assert self.bands(tmp_path, 8) == ((5, 3, 2), "")

    def test_unknown_order_is_warned_of(self, tmp_path):
        bands, warning = self.bands(tmp_path, 4)
        assert bands == (1, 2, 3)
        assert "bands=3,2,1" in warning

    @pytest.mark.parametrize("count", [1, 2])
    def test_too_few(self, tmp_path, count):
        with pytest.raises(imagery.BandsUnusable, match="bands=1,1,1"):
            self.bands(tmp_path, count)
        assert self.bands(tmp_path, count, chosen=(1, 1, 1)) == ((1, 1, 1), "")

    @pytest.mark.parametrize("chosen", [(1, 2), (1, 2, 9), (0, 1, 2)])
    def test_impossible_choice(self, tmp_path, chosen):
        with pytest.raises(imagery.BandsUnusable, match="from 1 to 4"):
            self.bands(tmp_path, 4, chosen=chosen)

    def test_warning_reaches_file_and_user(self, tmp_path, capsys):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(4, dtype="uint16"))
        _, content = build(tmp_path, path)
        assert "bands=3,2,1" in content["warnings"][0]
        assert "bands=3,2,1" in capsys.readouterr().err


class TestRadiometry:
    def test_uint8_is_left_alone(self, tmp_path):
        made, content = build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture()))
        assert made.stretch is None
        assert (content["dtype"], content["nodata"], content["coverage"]) == ("uint8", None, 1.0)

    def test_the_stretch_ignores_missing_pixels(self, tmp_path):
        values = rasters.picture(dtype="uint16")
        whole, _ = build(tmp_path, rasters.write(tmp_path / "a.tif", values))
        values = np.concatenate([values, np.zeros_like(values)], axis=1)
        half, content = build(tmp_path, rasters.write(tmp_path / "b.tif", values))
        assert half.stretch == whole.stretch
        assert (half.nodata, content["coverage"]) == (0.0, 0.5)

    def test_float_nan_is_missing(self, tmp_path):
        values = rasters.picture(dtype="float32")
        values[:, :45] = np.nan
        made, content = build(tmp_path, rasters.write(tmp_path / "a.tif", values))
        assert np.isnan(made.nodata)
        assert content["coverage"] == 0.5
        assert all(low < high for low, high, _ in made.stretch)

    def test_declared_nodata_alpha_and_mask(self, tmp_path):
        values = rasters.picture()
        values[:, :, :11] = 7
        declared, content = build(tmp_path, rasters.write(tmp_path / "a.tif", values, nodata=7))
        assert (declared.nodata, content["coverage"]) == (7.0, 0.9)
        alpha = np.full((1, 90, 110), 255, "uint8")
        alpha[:, :, :11] = 0
        rgba = rasters.write(tmp_path / "b.tif", np.concatenate([values, alpha]))
        made, content = build(tmp_path, rgba)
        assert (made.nodata, content["coverage"]) == (None, 0.9)
        masked = rasters.write(tmp_path / "c.tif", values)
        with rasterio.open(masked, "r+") as target:
            target.write_mask(alpha[0])
        assert build(tmp_path, masked)[1]["coverage"] == 0.9

    def test_alpha_counts_beside_a_nodata_value(self, tmp_path):
        alpha = np.full((1, 90, 110), 255, "uint8")
        alpha[:, :, :11] = 0
        values = np.concatenate([rasters.picture(), alpha])
        for gsd in (0.38, 0.3):  # read as it is, and warped
            _, content = build(tmp_path, rasters.write(tmp_path / f"{gsd}.tif", values, gsd=gsd, nodata=0))
            assert content["coverage"] == 0.9

    def test_infinite_nodata(self, tmp_path):
        values = rasters.picture(dtype="float32")
        values[:, :, :11] = -np.inf
        _, content = build(tmp_path, rasters.write(tmp_path / "a.tif", values, nodata=float("-inf")))
        assert content["coverage"] == 0.9

    def test_black_is_data_but_doubted(self, tmp_path):
        values = rasters.picture()
        values[:, :30] = 0
        _, content = build(tmp_path, rasters.write(tmp_path / "a.tif", values))
        assert content["coverage"] == 1.0
        assert "33 %" in content["warnings"][0]

    def test_a_large_raster_is_sampled(self, tmp_path):
        """Of 9 million pixels, 4 million tell the same; data in one corner only is found all the same."""
        values = np.random.default_rng(0).integers(100, 2000, (1, 3000, 3000)).astype("uint16")
        values[:, :1500] = 0
        path = rasters.write(tmp_path / "a.tif", values)
        made, content = build(tmp_path, path, bands=(1, 1, 1))
        assert content["coverage"] == pytest.approx(0.5, abs=0.01)
        assert made.stretch[0][:2] == pytest.approx((119, 1981), abs=3)
        values[:] = 0
        values[:, 70:90, 70:90] = 500
        made, content = build(tmp_path, rasters.write(tmp_path / "b.tif", values), bands=(1, 1, 1))
        assert 0 < content["coverage"] < 1e-3

    def test_a_constant_band_does_not_divide_by_zero(self, tmp_path):
        made, _ = build(tmp_path, rasters.write(tmp_path / "a.tif", np.full((3, 9, 9), 500, "uint16")))
        assert (imagery.stretched(np.full((3, 9, 9), 500, "uint16"), made.stretch) == 1).all()

    def test_the_stretch_is_monotone_and_the_same_for_integers_and_floats(self):
        values = np.tile(np.arange(0, 2048, dtype="uint16"), (3, 1, 1))
        stretch = ((10.0, 600.0, 0.6),) * 3
        out = imagery.stretched(values, stretch)
        assert (out == imagery.stretched(values.astype("float32"), stretch)).all()
        assert (np.diff(out[0, 0].astype(int)) >= 0).all()
        assert (out.min(), out.max()) == (1, 255)

    @pytest.mark.parametrize("number", [1, 2, 3])
    def test_16_bit_worldview_looks_like_its_8_bit_twin(self, kibs_data, number):
        """Independent truth: the twins were stretched for viewing by other hands."""
        with imagery.opened(kibs_data / f"rotterdam/rgbn_16bit_{number}.tif") as source:
            bands, warning = imagery.colour_bands(source)
            values, valid = imagery.sample(source, bands, imagery.nodata_of(source))
        with rasterio.open(kibs_data / f"rotterdam/rgb_pansharp{number}.tif") as source:
            twin = source.read()
        assert (bands, warning) == ((1, 2, 3), "")
        difference = imagery.stretched(values, imagery.stretch_of(values, valid))[:, valid] - twin[:, valid].astype(int)
        assert np.sqrt(np.mean(np.square(difference))) < 1.0


class TestDirections:
    @pytest.mark.parametrize(
        ("crs", "x", "y"),
        [("EPSG:32631", 730_000, 5_750_000), ("EPSG:28992", 92_000, 437_000), ("EPSG:32734", 260_000, 6_245_000)],
    )
    @pytest.mark.parametrize("azimuth", [0.0, 90.0, 181.1])
    def test_azimuths_are_from_true_north(self, crs, x, y, azimuth):
        """A step along the true azimuth on the ellipsoid, projected, points along the lean."""
        grid = Grid(crs, x, y, 0.4, 10, 10)
        made = scene.direction(azimuth, 59.3, grid)
        to_degrees = pyproj.Transformer.from_crs(crs, 4326, always_xy=True)
        longitude, latitude = to_degrees.transform(x + 2, y - 2)
        moved = pyproj.Geod(ellps="WGS84").fwd(longitude, latitude, azimuth, 10.0)[:2]
        step = np.subtract(to_degrees.transform(*moved, direction="INVERSE"), (x + 2, y - 2))
        assert np.allclose(step / np.hypot(*step), np.array(made.lean) / np.hypot(*made.lean), atol=2e-4)
        assert np.hypot(*made.lean) == pytest.approx(1 / np.tan(np.radians(59.3)))

    def test_unknown_and_nadir(self):
        assert scene.direction(None, None, GRID) is None
        assert scene.direction(30.0, 90.0, GRID).lean == (0.0, 0.0)
        assert scene.direction(-178.9, 60.0, GRID).azimuth == pytest.approx(181.1)

    @pytest.mark.parametrize(
        ("angles", "says"),
        [
            ((10.0, None), "view_elevation"),
            ((None, 60.0), "view_azimuth"),
            ((10.0, 20.0), r"\(20, 90\]"),
            ((10.0, 91.0), r"\(20, 90\]"),
            ((10.0, float("nan")), r"\(20, 90\]"),
            ((400.0, 60.0), "no azimuth"),
            ((float("nan"), 60.0), "no azimuth"),
        ],
    )
    def test_impossible_angles_are_refused(self, angles, says):
        with pytest.raises(scene.AnglesUnusable, match=says):
            scene.direction(*angles, GRID)

    def test_a_low_winter_sun_is_possible(self):
        assert scene.direction(170.0, 12.0, GRID, "sun", lowest=5.0) is not None
        with pytest.raises(scene.AnglesUnusable, match="sun_elevation"):
            scene.direction(170.0, 3.0, GRID, "sun", lowest=5.0)


class TestScene:
    def test_contract(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture())
        with rasterio.open(path, "r+") as target:
            target.update_tags(TIFFTAG_DATETIME="2020:07:01 10:11:12", TIFFTAG_COPYRIGHT="CC0")
        made, content = build(
            tmp_path,
            path,
            view=(181.1, 59.3),
            sun=(150.0, 50.0),
            projection_height=40.0,
            vertical_crs="EPSG:5773",
        )
        assert made.grid == GRID == Grid(**content["grid"])
        assert made == scene.read(tmp_path / "out/scene.json")
        assert made.view.lean == pytest.approx((0.0, -0.594), abs=0.02)
        assert made.lean == made.view.lean
        assert made.projected_on(None)(np.zeros((1, 2))) == 40.0
        assert content["source"] == {"width": 110, "height": 90, "crs": "EPSG:32631", "gsd": 0.38}
        assert (content["date"], content["licence"]) == ("2020:07:01 10:11:12", "CC0")
        assert content["vertical_crs"] == "EPSG:5773"

    def test_unknown_angles(self, tmp_path):
        made, content = build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture()))
        assert (content["view"], content["sun"], made.lean) == (None, None, (0.0, 0.0))

    def test_same_bytes(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(dtype="uint16"))
        heights = np.random.default_rng(0).normal(50, 1, (330, 340)).astype("float32")
        ground = rasters.dtm(tmp_path / "dtm.tif", heights, rasters.X0 - 301.0, rasters.Y0 + 299.0)
        for out in ("one", "two"):
            scene.build("toy", path, str(ground), 0.3, tmp_path / out, view=(10, 60))
        for name in ("scene.json", "dtm.tif"):
            assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()

    def test_terrain_reaches_to_where_things_stand(self, tmp_path):
        """Projected on sea level, 800 m below the ground, everything stands 480 m from where it is seen."""
        x0, y0, step, n = rasters.X0 - 1500.0, rasters.Y0 + 1500.0, 5.0, 600
        row, col = np.mgrid[:n, :n]

        def height(x_y):
            return 800.0 + 0.08 * (x_y[..., 1] - rasters.Y0)

        centres = np.stack([x0 + (col + 0.5) * step, y0 - (row + 0.5) * step], axis=-1)
        ground = rasters.dtm(tmp_path / "t.tif", height(centres).astype("float32"), x0, y0, step)
        path = rasters.write(tmp_path / "a.tif", rasters.picture())
        made, content = build(tmp_path, path, str(ground), view=(0.0, 60.0), projection_height=0.0)
        seen = np.array([rasters.X0 + 20.0, rasters.Y0 - 15.0])
        stands = seen
        for _ in range(100):
            stands = seen + height(stands) * np.array(made.lean)
        assert np.hypot(*(stands - seen)) > 450
        assert made.displaced >= np.hypot(*(stands - seen))
        assert made.terrain(made.grid.bounds)(stands[None])[0] == pytest.approx(height(stands), abs=0.01)
        assert content["dtm"]["filled"] == 0.0
        short = rasters.dtm(
            tmp_path / "s.tif", np.full((90, 90), 800, "float32"), rasters.X0 - 200, rasters.Y0 + 200, step
        )
        with pytest.raises(dtm.DtmPartial, match="uncovered"):
            build(tmp_path, path, str(short), view=(0.0, 60.0), projection_height=0.0)
        assert build(tmp_path, path, str(short), view=(0.0, 60.0))[0].displaced == 0.0

    @pytest.mark.parametrize("crs", ["EPSG:4326", "hello", "EPSG:999999"])
    def test_a_vertical_crs_must_be_vertical(self, tmp_path, crs):
        with pytest.raises(georeference.VerticalCrsUnusable):
            build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture()), vertical_crs=crs)

    def test_a_coarser_raster_is_warned_of(self, tmp_path):
        _, content = build(tmp_path, rasters.write(tmp_path / "a.tif", rasters.picture(), gsd=0.5))
        assert "enlarged" in content["warnings"][0]

    def test_an_aoi_in_a_turned_rasters_corner_is_refused(self, tmp_path):
        import geopandas

        turned = Affine(0.27, 0.27, rasters.X0, 0.27, -0.27, rasters.Y0)
        path = rasters.write(tmp_path / "a.tif", rasters.picture(), transform=turned)
        left, bottom, _, _ = georeference.model_grid(path, 0.38).bounds
        corner = shapely.box(left, bottom, left + 3, bottom + 3)
        geopandas.GeoSeries([corner], crs="EPSG:32631").to_file(tmp_path / "aoi.gpkg")
        with pytest.raises(georeference.AoiUnusable, match="beside"):
            build(tmp_path, path, aoi=tmp_path / "aoi.gpkg")

    def test_command_line(self, tmp_path):
        path = rasters.write(tmp_path / "a.tif", rasters.picture(4, dtype="uint16"))
        out = tmp_path / "results/toy/scene.json"
        command = f"-m kibs_steps.scene --name toy --raster {path} --dtm -3.5 --gsd 0.38 --out {out} --bands 3,2,1"
        run = subprocess.run([sys.executable, *command.split(), "--view-azimuth", "10"], capture_output=True, text=True)
        assert run.returncode == 1
        assert run.stderr.startswith("error: view_azimuth is given without view_elevation")
        angles = ["--view-azimuth", "10", "--view-elevation", "60"]
        run = subprocess.run([sys.executable, *command.split(), *angles], capture_output=True, text=True)
        assert (run.returncode, run.stderr) == (0, "")
        assert scene.read(out).bands == (3, 2, 1)
        assert (out.parent / "dtm.tif").exists()
