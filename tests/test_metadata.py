"""Metadata: files made like the vendors', and RPCs of a sensor whose direction is known in closed form."""

import json
import re

import geopandas
import numpy as np
import pyproj
import pytest
import rasterio
import rasters
import shapely
from rasterio.rpc import RPC

from kibs_steps import metadata, plan, regions, scene
from kibs_steps.metadata import Angles, MetadataUnusable

IMD = """version = "28.4";
BEGIN_GROUP = BAND_P
\tULLon =   4.39781021;
\tabsCalFactor = 1.474e-02;
END_GROUP = BAND_P
BEGIN_GROUP = IMAGE_1
\tsatId = "WV03";
\tmeanSunAz = 155.4;
\tmeanSunEl =  45.2;
\tminSatAz = 180.1;
\tmaxSatAz = 182.0;
\tmeanSatAz = 181.1;
\tmeanSatEl = 59.3;
\tmeanOffNadirViewAngle = 27.4;
END_GROUP = IMAGE_1
END;
"""
MAXAR_XML = """<?xml version="1.0"?><isd><IMD><IMAGE><MEANSUNAZ>1.554E+02</MEANSUNAZ><MEANSUNEL>45.2</MEANSUNEL>
<MEANSATAZ>181.1</MEANSATAZ><MEANSATEL>59.3</MEANSATEL></IMAGE></IMD></isd>"""


def dimap(orientation, across, along, incidence):
    def place(name, angle):
        return f"""<Located_Geometric_Values><LOCATION_TYPE>{name}</LOCATION_TYPE>
        <Acquisition_Angles><AZIMUTH_ANGLE unit="deg">{orientation}</AZIMUTH_ANGLE>
        <VIEWING_ANGLE unit="deg">{angle - 3}</VIEWING_ANGLE>
        <INCIDENCE_ANGLE_ALONG_TRACK unit="deg">{along}</INCIDENCE_ANGLE_ALONG_TRACK>
        <INCIDENCE_ANGLE_ACROSS_TRACK unit="deg">{across}</INCIDENCE_ANGLE_ACROSS_TRACK>
        <INCIDENCE_ANGLE unit="deg">{angle}</INCIDENCE_ANGLE></Acquisition_Angles>
        <Solar_Incidences><SUN_AZIMUTH unit="deg">155.4</SUN_AZIMUTH><SUN_ELEVATION unit="deg">45.2</SUN_ELEVATION>
        </Solar_Incidences></Located_Geometric_Values>"""

    places = place("Top Center", incidence - 0.4) + place("Center", incidence) + place("Bottom Center", incidence + 0.4)
    return f"""<?xml version="1.0" encoding="UTF-8"?><Dimap_Document><Metadata_Identification>
    <METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT></Metadata_Identification>
    <Geometric_Data><Use_Area>{places}</Use_Area></Geometric_Data></Dimap_Document>"""


STAC = {
    "type": "Feature",
    "stac_version": "1.0.0",
    "properties": {"view:azimuth": 1.1, "view:incidence_angle": 30.7, "view:off_nadir": 27.4, "view:sun_azimuth": 155.4,
                   "view:sun_elevation": 45.2},
}  # fmt: skip


def written(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.IMD", IMD),
        ("a.XML", MAXAR_XML),
        ("DIM_PHR1A.XML", dimap(181.1, 0.0, 30.7, 30.7)),
        ("item.json", json.dumps(STAC)),
    ],
    ids=["IMD", "Maxar XML", "DIMAP", "STAC"],
)
def test_every_vendor_tells_the_same_view(tmp_path, name, text):
    assert metadata.read(written(tmp_path, name, text)) == Angles(181.1, 59.3, 155.4, 45.2)


def test_older_maxar_files_have_no_means(tmp_path):
    text = IMD.replace("meanS", "s").replace("minSatAz", "x").replace("maxSatAz", "y")
    assert metadata.read(written(tmp_path, "qb.IMD", text))[:2] == (181.1, 59.3)


@pytest.mark.parametrize(("across", "along", "azimuth"), [(20.0, 0.0, 90.0), (-20.0, 0.0, 270.0), (10.0, 10.0, 135.0)])
def test_dimap_azimuth_is_that_of_the_lines(tmp_path, across, along, azimuth):
    """Lines run south (180°): what is across them is east or west."""
    found = metadata.read(written(tmp_path, "d.xml", dimap(180.0, across, along, 20.0)))
    assert found.view_azimuth == pytest.approx(azimuth, abs=1e-6)
    assert found.view_elevation == 70.0


def test_dimap_1_of_spot_5(tmp_path):
    text = """<Dimap_Document><Scene_Source><INCIDENCE_ANGLE_X/><SATELLITE_INCIDENCE_ANGLE>-12.5</SATELLITE_INCIDENCE_ANGLE>
    <SATELLITE_AZIMUTH_ANGLE>104.2</SATELLITE_AZIMUTH_ANGLE><SUN_AZIMUTH>150</SUN_AZIMUTH><SUN_ELEVATION>40</SUN_ELEVATION>
    </Scene_Source></Dimap_Document>"""
    assert metadata.read(written(tmp_path, "m.dim", text)) == Angles(104.2, 77.5, 150.0, 40.0)


def test_an_empty_tag_says_nothing(tmp_path):
    text = re.sub("<MEANSUNEL>.*?</MEANSUNEL>", "<MEANSUNEL></MEANSUNEL>", MAXAR_XML)
    assert text != MAXAR_XML
    assert metadata.read(written(tmp_path, "a.XML", text)) == Angles(181.1, 59.3, 155.4, None)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"view:incidence_angle": None}, "not at the target"),
        ({"view:incidence_angle": 59.3}, "contradicts itself"),
        ({"view:azimuth": None}, "where the satellite stood"),
    ],
)
def test_stac_items_that_mislead_are_refused(tmp_path, change, match):
    item = {**STAC, "properties": {**STAC["properties"], **change}}
    with pytest.raises(MetadataUnusable, match=match):
        metadata.read(written(tmp_path, "item.json", json.dumps(item)))


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.IMD", "no angles here", "where the satellite stood"),
        ("a.json", '{"properties": ', "damaged"),
        ("a.json", "{}", "no STAC item"),
        ("a.xml", "<a><b></a>", "damaged"),
        ("a.xml", "<Dimap_Document/>", "where the satellite stood"),
        (
            "lines.xml",
            re.sub("<INCIDENCE_ANGLE_A.*?>.*?>", "", dimap(12.0, 0.0, 30.7, 30.7)),
            "where the satellite stood",
        ),
        ("a.IMD", IMD.replace("59.3", "E"), "no number"),
        ("a_RPC.TXT", "LINE_OFF: 10\nLINE_NUM_COEFF_1: 1", "no whole RPC"),
    ],
)
def test_what_cannot_be_used_says_what_to_do(tmp_path, name, text, match):
    with pytest.raises(MetadataUnusable, match=match) as caught:
        metadata.read(written(tmp_path, name, text))
    assert "view_" in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(MetadataUnusable, match="not there"):
        metadata.read(tmp_path / "nothing.IMD")


def linear_rpc(azimuth, elevation, longitude=4.4, latitude=51.9, turned=27.0):
    """RPC of a far sensor over a place: lines and samples are turned to north, and points move with their height.

    Metres per degree come from geocentric coordinates, the lean from the closed form.
    """
    earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    here = np.array(earth.transform(longitude, latitude, 0.0))
    per_lon = np.linalg.norm(np.array(earth.transform(longitude + 1e-5, latitude, 0.0)) - here) / 1e-5
    per_lat = np.linalg.norm(np.array(earth.transform(longitude, latitude + 1e-5, 0.0)) - here) / 1e-5
    k = np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))]) / np.tan(np.radians(elevation))
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    axes = np.array([[s, -c], [c, s]])  # line, sample of (east, north)
    scale = {"lat": 0.02, "lon": 0.03, "h": 500.0, "image": 5000.0}
    east, north, up = np.array([per_lon, 0]), np.array([0, per_lat]), -k
    terms = np.zeros((2, 20))
    for axis in range(2):
        terms[axis, 1] = axes[axis] @ east * scale["lon"]
        terms[axis, 2] = axes[axis] @ north * scale["lat"]
        terms[axis, 3] = axes[axis] @ up * scale["h"]
    one = [1.0] + [0.0] * 19
    return RPC(
        height_off=0.0, height_scale=scale["h"], lat_off=latitude, lat_scale=scale["lat"], line_den_coeff=one,
        line_num_coeff=(terms[0] / scale["image"]).tolist(), line_off=6000.0, line_scale=scale["image"], long_off=longitude,
        long_scale=scale["lon"], samp_den_coeff=one, samp_num_coeff=(terms[1] / scale["image"]).tolist(), samp_off=7000.0,
        samp_scale=scale["image"], err_bias=None, err_rand=None,
    )  # fmt: skip


def rpb(rpc):
    """The RPC as Maxar's `.RPB`."""
    values = {"lineOffset": rpc.line_off, "sampOffset": rpc.samp_off, "latOffset": rpc.lat_off, "longOffset": rpc.long_off,
              "heightOffset": rpc.height_off, "lineScale": rpc.line_scale, "sampScale": rpc.samp_scale,
              "latScale": rpc.lat_scale, "longScale": rpc.long_scale, "heightScale": rpc.height_scale}  # fmt: skip
    lines = [f"\t{key} = {value};" for key, value in values.items()]
    for key in ("line_num", "line_den", "samp_num", "samp_den"):
        name = key.replace("_n", "N").replace("_d", "D") + "Coef"
        lines.append(f"\t{name} = (\n" + ",\n".join(f"\t\t\t{v:+.12E}" for v in getattr(rpc, f"{key}_coeff")) + ");")
    return 'satId = "WV03";\nBEGIN_GROUP = IMAGE\n\terrBias = 3.9;\n' + "\n".join(lines) + "\nEND_GROUP = IMAGE\nEND;\n"


def rpc_text(rpc):
    """The RPC as `_RPC.TXT`."""
    units = {"line": "pixels", "samp": "pixels", "lat": "degrees", "long": "degrees", "height": "meters"}
    lines = [
        f"{k.upper()}_{w.upper()}: {getattr(rpc, f'{k}_{w}'):+.9f} {u}"
        for w in ("off", "scale")
        for k, u in units.items()
    ]
    for key in ("line_num", "line_den", "samp_num", "samp_den"):
        lines += [f"{key.upper()}_COEFF_{k + 1}: {v:+.15E}" for k, v in enumerate(getattr(rpc, f"{key}_coeff"))]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("azimuth", "elevation"), [(181.1, 59.3), (20.0, 75.0), (281.0, 50.0)])
def test_rpc_gives_the_direction_it_was_made_of(tmp_path, azimuth, elevation):
    rpc = linear_rpc(azimuth, elevation)
    raster = tmp_path / "basic1b.tif"
    with rasterio.open(raster, "w", driver="GTiff", width=8, height=8, count=1, dtype="uint16", rpcs=rpc) as target:
        target.write(np.zeros((1, 8, 8), np.uint16))
    files = [raster, written(tmp_path, "a.RPB", rpb(rpc)), written(tmp_path, "a_RPC.TXT", rpc_text(rpc))]
    for file in files:
        found = metadata.read(file)
        assert found[:2] == pytest.approx((azimuth, elevation), abs=0.02)
        assert found[2:] == (None, None)


def test_an_rpc_that_sends_all_places_to_one_is_refused(tmp_path):
    rpc = linear_rpc(181.1, 59.3)
    rpc.line_num_coeff = [0.0] * 20
    with pytest.raises(MetadataUnusable, match="nowhere"):
        metadata.read(written(tmp_path, "a.RPB", rpb(rpc)))


def test_a_raster_without_rpc(tmp_path):
    raster = rasters.write(tmp_path / "ortho.tif", rasters.picture())
    with pytest.raises(MetadataUnusable, match="without RPC"):
        metadata.read(raster)


def test_what_is_configured_comes_before_the_metadata(tmp_path):
    file = written(tmp_path, "a.IMD", IMD)
    assert plan.angles_of({"metadata": str(file)}) == {
        "view_azimuth": 181.1, "view_elevation": 59.3, "sun_azimuth": 155.4, "sun_elevation": 45.2,
    }  # fmt: skip
    assert plan.angles_of({}) == {}


def test_regions_have_a_view_of_their_own(tmp_path):
    raster = rasters.write(tmp_path / "mosaic.tif", rasters.picture(height=100, width=100), gsd=0.5)
    west = shapely.box(rasters.X0, rasters.Y0 - 50, rasters.X0 + 25, rasters.Y0)
    frame = geopandas.GeoDataFrame(
        {"view_azimuth": [90.0], "view_elevation": [80.0]}, geometry=[west], crs="EPSG:32631"
    ).to_crs("EPSG:4326")
    frame.to_file(tmp_path / "regions.geojson")
    facts = scene.build("m", raster, 0.0, 0.5, tmp_path, view=(180.0, 70.0), regions=tmp_path / "regions.geojson")
    seen = np.array([[rasters.X0 + 10, rasters.Y0 - 25], [rasters.X0 + 40, rasters.Y0 - 25]])
    lean = facts.leans(seen)
    assert np.hypot(*lean.T) == pytest.approx(1 / np.tan(np.radians([80.0, 70.0])))
    assert [v.azimuth for v in facts.views(seen)] == [90.0, 180.0]
    assert facts == scene.read(tmp_path / "scene.json")


def test_regions_without_angles_are_refused(tmp_path):
    raster = rasters.write(tmp_path / "mosaic.tif", rasters.picture(), gsd=0.5)
    frame = geopandas.GeoDataFrame(geometry=[shapely.box(0, 0, 1, 1)], crs="EPSG:32631")
    frame.to_file(tmp_path / "bare.gpkg")
    with pytest.raises(regions.RegionsUnusable, match="lacks the column view_azimuth and view_elevation"):
        scene.build("m", raster, 0.0, 0.5, tmp_path, regions=tmp_path / "bare.gpkg")


def test_of_several_images_the_first_counts(tmp_path):
    more = (
        "BEGIN_GROUP = IMAGE_2\n\tmeanSunAz = 1.0;\n\tmeanSatAz = 10.0;\n\tmeanSatEl = 70.0;\nEND_GROUP = IMAGE_2\nEND;"
    )
    text = IMD.replace("END;", more)
    assert metadata.read(written(tmp_path, "a.IMD", text)) == Angles(181.1, 59.3, 155.4, 45.2)
    twice = MAXAR_XML.replace("</isd>", "<IMD><MEANSATAZ>10.0</MEANSATAZ><MEANSATEL>70</MEANSATEL></IMD></isd>")
    assert metadata.read(written(tmp_path, "a.XML", twice)) == Angles(181.1, 59.3, 155.4, 45.2)


@pytest.mark.parametrize("text", [json.dumps(STAC), MAXAR_XML, IMD], ids=["STAC", "XML", "IMD"])
def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path, text):
    (tmp_path / "a.txt").write_text(text, encoding="utf-8-sig")
    assert metadata.read(tmp_path / "a.txt")[:2] == (181.1, 59.3)


def test_rpc_polynomials_are_those_of_gdal():
    """All 20 terms of all four polynomials, against GDAL's own transformer; the two count pixels from other corners."""
    from rasterio.transform import RPCTransformer

    random = np.random.default_rng(4)
    terms = random.uniform(-0.05, 0.05, (4, 20))
    terms[[0, 2], 1:3] += [[0.2, -1.0], [1.0, 0.2]]
    terms[[1, 3], 0] = 1.0
    made = linear_rpc(180.0, 60.0)
    names = ("line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff")
    for name, values in zip(names, terms, strict=True):
        setattr(made, name, values.tolist())
    offset = np.array([made.line_off, made.samp_off, made.lat_off, made.long_off, made.height_off])
    scale = np.array([made.line_scale, made.samp_scale, made.lat_scale, made.long_scale, made.height_scale])
    rpc = metadata.Rpc(offset, scale, terms)
    there = np.column_stack(
        [
            made.long_off + random.uniform(-0.9, 0.9, 20) * made.long_scale,
            made.lat_off + random.uniform(-0.9, 0.9, 20) * made.lat_scale,
            random.uniform(-400, 400, 20),
        ]
    )
    with RPCTransformer(made) as gdal:
        expected = np.column_stack(gdal.rowcol(*there.T, op=np.asarray)).astype(float)
    found = np.array([rpc.image(*place) for place in there])
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-3)


@pytest.mark.parametrize("incidence", [12.0, 59.3])
def test_incidence_must_go_with_off_nadir_from_both_sides(tmp_path, incidence):
    item = {**STAC, "properties": {**STAC["properties"], "view:incidence_angle": incidence}}
    with pytest.raises(MetadataUnusable, match="contradicts itself"):
        metadata.read(written(tmp_path, "item.json", json.dumps(item)))


def layer(tmp_path, azimuths, shapes, crs="EPSG:32631"):
    frame = geopandas.GeoDataFrame({"view_azimuth": azimuths, "view_elevation": 60.0}, geometry=shapes, crs=crs)
    frame.to_file(tmp_path / "regions.gpkg")
    return tmp_path / "regions.gpkg"


def test_views_of_regions_are_told_once_each_and_within_a_circle(tmp_path):
    path = layer(tmp_path, [-90.0, 181.0, -90.0], [shapely.box(i, 0, i + 1, 1) for i in range(3)])
    assert regions.views(path) == [{"azimuth": 270.0, "elevation": 60.0}, {"azimuth": 181.0, "elevation": 60.0}]


@pytest.mark.parametrize(
    ("azimuth", "shape", "crs", "match"),
    [
        (float("nan"), shapely.box(0, 0, 1, 1), "EPSG:32631", "has no view_azimuth"),
        (10.0, shapely.Point(0, 0), "EPSG:32631", "no polygon"),
        (10.0, shapely.box(0, 0, 1, 1), None, "no CRS"),
    ],
)
def test_regions_that_cannot_be_used_say_why(tmp_path, azimuth, shape, crs, match):
    with pytest.raises(regions.RegionsUnusable, match=match):
        regions.views(layer(tmp_path, [azimuth], [shape], crs))
