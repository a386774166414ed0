"""Bad inputs, one case each: how it is made, and the message it must get. docs/inputs.md is written from this table.

What is not bad about a case comes from `good_inputs`.

`…` in a message stands for anything (numbers of bytes, a library's own words). Run `python tests/faults/cases.py` from the
project's folder to write the page's tables anew.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import geopandas
import numpy as np
import onnx
import rasterio
import rasters
import shapely
import toy
from affine import Affine
from good_inputs import BOX, CRS, ground, picture, roof, vector

PAGE = Path(__file__).parents[2] / "docs/inputs.md"


class Case(NamedTuple):
    """A row of the page: its part, what the user gave, the error's name and message, and a function that makes the files in
    a folder and returns the settings (beside a good raster, terrain and models).
    """

    part: str
    given: str
    error: str
    message: str
    make: Callable[[Path], dict]


CASES: list[Case] = []


def case(part: str, given: str, error: str, message: str) -> Callable:
    """Add a function to the table."""

    def add(make: Callable[[Path], dict]) -> Callable[[Path], dict]:
        CASES.append(Case(part, given, error, message, make))
        return make

    return add


@case("raster", "a file that is not there", "RasterMissing", "raster nowhere.tif does not exist: check the path")
def _(folder):
    return {"raster": "nowhere.tif"}


@case("raster", "a file dated later than now", "FromTheFuture",
      "a.tif is dated later than now: give it today's date (touch a.tif), its content counts alone")  # fmt: skip
def _(folder):
    os.utime(folder / "a.tif", (time.time() + 3600,) * 2)
    return {}


@case("raster", "a file that is no raster", "NotARaster",
      "text.tif cannot be read as a raster (…): give a GeoTIFF or another GDAL format")  # fmt: skip
def _(folder):
    (folder / "text.tif").write_text("hello")
    return {"raster": str(folder / "text.tif")}


@case("raster", "a TIFF with a broken header", "NotARaster",
      "b.tif cannot be read as a raster (…): give a GeoTIFF or another GDAL format")  # fmt: skip
def _(folder):
    given = picture(folder, "b.tif")
    with open(given["raster"], "r+b") as file:
        file.seek(4)
        file.write(b"\xff\xff\xff\x7f")
    return given


@case("raster", "a TIFF that is cut off", "RasterDamaged",
      "b.tif is cut off: it has … bytes, its pixels go on to byte … or further: copy or download it again")  # fmt: skip
def _(folder):
    given = picture(folder, "b.tif")
    os.truncate(given["raster"], os.path.getsize(given["raster"]) - 5000)
    return given


@case("raster", "a TIFF with a damaged block", "RasterDamaged",
      "b.tif cannot be read at full size (…): the file is damaged; copy it again")  # fmt: skip
def _(folder):
    noise = np.random.default_rng(0).integers(1, 255, (3, 90, 110)).astype("uint8")
    given = picture(folder, "b.tif", values=noise, compress="deflate", interleave="pixel")
    with rasterio.open(given["raster"]) as source:
        start = int(source.get_tag_item("BLOCK_OFFSET_0_1", "TIFF", bidx=1))
    with open(given["raster"], "r+b") as file:
        file.seek(start)
        file.write(b"\0" * 200)
    return given


@case("raster", "no CRS", "NotGeoreferenced",
      "b.tif has no CRS: assign the right one (gdal_edit.py -a_srs, -a_ullr); an image with only RPCs or ground control points "
      "must be orthorectified on a terrain model first (gdalwarp -rpc or -tps)")  # fmt: skip
def _(folder):
    return picture(folder, "b.tif", crs=None)


@case("raster", "a CRS but no place in it", "NotGeoreferenced", "b.tif has no geotransform: …")
def _(folder):
    return picture(folder, "b.tif", transform=Affine.identity())


@case("raster", "coordinates its CRS cannot have", "NotGeoreferenced",
      "b.tif lies outside the area of its CRS (WGS 84): assign the right one")  # fmt: skip
def _(folder):
    return picture(folder, "b.tif", crs="EPSG:4326")


@case("raster", "pixels far coarser than the models'", "GsdTooCoarse",
      "b.tif has pixels of 0.70 m, the models need 0.38 m and bear at most 0.61 m: give a finer raster (pansharpened, if this is "
      "the multispectral one) or models trained for this GSD (models=)")  # fmt: skip
def _(folder):
    return picture(folder, "b.tif", gsd=0.7)


@case("raster", "one band", "BandsUnusable",
      "b.tif has 1 band(s), the models need red, green and blue: give bands=1,1,1 to use one band for all three")  # fmt: skip
def _(folder):
    return picture(folder, "b.tif", values=rasters.picture(1))


@case("raster", "two bands", "BandsUnusable", "b.tif has 2 band(s), the models need red, green and blue: …")
def _(folder):
    return picture(folder, "b.tif", values=rasters.picture(2))


@case("raster", "`bands` that the raster does not have", "BandsUnusable",
      "bands=5,3,2: give three numbers from 1 to 3, as in bands=1,2,3")  # fmt: skip
def _(folder):
    return {"bands": "5,3,2"}


@case("raster", "nodata everywhere", "NoData", "b.tif holds no data: every pixel is nodata or masked")
def _(folder):
    return picture(folder, "b.tif", values=np.zeros((3, 40, 40), "uint16"))


@case("raster", "black everywhere", "NoData",
      "b.tif is black everywhere: give the image itself, not a mask or an empty copy")  # fmt: skip
def _(folder):
    return picture(folder, "b.tif", values=np.zeros((3, 40, 40), "uint8"))


@case("terrain", "a file that is not there", "DtmMissing",
      "dtm: raster nowhere.tif does not exist: check the path; or give one height in metres, as in dtm=120")  # fmt: skip
def _(folder):
    return {"dtm": "nowhere.tif"}


@case("terrain", "no CRS", "DtmMissing", "dtm: t.tif has no CRS: …; or give one height in metres, as in dtm=120")
def _(folder):
    return {"dtm": str(ground(folder / "t.tif", crs=None))}


@case("terrain", "smaller than the scene", "DtmPartial",
      "dtm t.tif leaves … % of the scene uncovered: give a terrain model that covers the raster (better 250 m more on all "
      "sides), clip the scene to it (aoi), or give one height in metres")  # fmt: skip
def _(folder):
    return {"dtm": str(rasters.dtm(folder / "t.tif", np.full((20, 8), 5, "float32"), rasters.X0, rasters.Y0))}


@case("terrain", "without a value anywhere", "DtmPartial", "dtm t.tif leaves 100.00 % of the scene uncovered: …")
def _(folder):
    return {"dtm": str(ground(folder / "t.tif", np.full((330, 340), -9999, "float32"), nodata=-9999))}


@case("terrain", "missing values that are not declared", "DtmAbsurd",
      "dtm t.tif holds heights like -32768 m: if that marks missing data, declare it (gdal_edit.py -a_nodata -32768); if heights "
      "are not in metres, convert them")  # fmt: skip
def _(folder):
    heights = np.full((330, 340), 50, "float32")
    heights[160, 160] = -32768
    return {"dtm": str(ground(folder / "t.tif", heights))}


@case("terrain", "a number that is no height", "DtmAbsurd",
      "dtm=12000: the ground cannot be 12000 m high; give metres above the scene's vertical datum")  # fmt: skip
def _(folder):
    return {"dtm": 12000}


@case("terrain", "heights in a unit nobody knows", "DtmAbsurd",
      "t.tif gives heights in 'fathom': convert them to metres, or correct the band's unit")  # fmt: skip
def _(folder):
    path = ground(folder / "t.tif")
    with rasterio.open(path, "r+") as target:
        target.units = ("fathom",)
    return {"dtm": str(path)}


@case("terrain", "another vertical datum than `vertical_crs`", "DtmDatum",
      "dtm t.tif has EGM96 height, vertical_crs=EPSG:5709 is NAP height: convert the terrain model (gdalwarp -t_srs with a "
      "compound CRS), or give the vertical_crs it has")  # fmt: skip
def _(folder):
    return {"dtm": str(ground(folder / "t.tif", crs="EPSG:32631+5773")), "vertical_crs": "EPSG:5709"}


@case("terrain", "`vertical_crs` that is none", "VerticalCrsUnusable",
      "vertical_crs=EPSG:4326 is no vertical CRS: give one as in EPSG:5773 (EGM96 height)")  # fmt: skip
def _(folder):
    return {"vertical_crs": "EPSG:4326"}


@case("terrain", "`vertical_crs` that is a compound", "VerticalCrsUnusable",
      "vertical_crs=EPSG:7415 is a compound CRS: give its vertical part, EPSG:5709 (NAP height)")  # fmt: skip
def _(folder):
    return {"vertical_crs": "EPSG:7415"}


@case("terrain", "`vertical_crs` in feet", "VerticalCrsUnusable",
      "vertical_crs=EPSG:6360 counts in US survey foot, published heights are in metres: give the CRS of the same datum in "
      "metres (the terrain model may be in feet)")  # fmt: skip
def _(folder):
    return {"vertical_crs": "EPSG:6360"}


@case("terrain", "a surface model that is not there", "DtmMissing",
      "dsm: raster nowhere.tif does not exist: check the path")  # fmt: skip
def _(folder):
    return {"dsm": "nowhere.tif"}


@case("terrain", "a surface model smaller than the scene", "DtmPartial",
      "dsm t.tif leaves … % of the scene uncovered: …")  # fmt: skip
def _(folder):
    return {"dsm": str(rasters.dtm(folder / "t.tif", np.full((20, 8), 5, "float32"), rasters.X0, rasters.Y0))}


@case("angles", "one of the two", "AnglesUnusable",
      "view_azimuth is given without view_elevation: give both, or neither if it is unknown")  # fmt: skip
def _(folder):
    return {"view_elevation": None}


@case("angles", "an elevation that is none", "BadConfig",
      "view_elevation: 95 is greater than the maximum of 90 (deg above the horizon at the target)")  # fmt: skip
def _(folder):
    return {"view_elevation": 95}


@case("angles", "the sensor's off-nadir angle for an elevation", "AnglesUnusable",
      "view_elevation=15 is outside (20, 90]: give degrees above the horizon at the target (90 minus the incidence angle; not "
      "the sensor's off-nadir angle)")  # fmt: skip
def _(folder):
    return {"view_elevation": 15, "allow_angles": True}


@case("angles", "far from what the model was trained on", "AngleOutsideTraining",
      "models/sections.onnx: view elevation 35° is 15.0° outside what it was trained on (50-90°): choose another model, or set "
      "`allow_angles: true`")  # fmt: skip
def _(folder):
    return {"view_elevation": 35}


@case("truth", "a file that is not there", "UnreadableTruth",
      "truth nowhere.gpkg cannot be read as a vector file: …")  # fmt: skip
def _(folder):
    return {"truth": "nowhere.gpkg"}


@case("truth", "polygons without z", "NoHeights",
      "truth t.gpkg, layer t, holds Polygons without z: every outline must be a PolygonZ with a height at each "
      "corner")  # fmt: skip
def _(folder):
    return {"truth": str(vector(folder / "t.gpkg", [shapely.box(*BOX)]))}


@case("truth", "no polygons", "NoPolygons", "truth t.gpkg has no layer of polygons (its layers: t)")
def _(folder):
    return {"truth": str(vector(folder / "t.gpkg", [shapely.Point(*BOX[:2])]))}


@case("truth", "no CRS", "UnreadableTruth",
      "truth t.gpkg, layer t, states no CRS: set it, for instance with ogr2ogr -a_srs")  # fmt: skip
def _(folder):
    return {"truth": str(vector(folder / "t.gpkg", [roof()], None))}


@case("truth", "roofs somewhere else", "NoOverlap",
      "truth t.gpkg, layer t (EPSG:32631) lies at … in EPSG:32631, outside the scene: check the layer's CRS and the raster it "
      "belongs to")  # fmt: skip
def _(folder):
    return {"truth": str(vector(folder / "t.gpkg", [shapely.affinity.translate(roof(), 90_000)]))}


@case("truth", "heights that are not meant so", "NoHeights",
      "truth layer t: with z read as 'absolute' the roofs are … m above the ground in the median; …")  # fmt: skip
def _(folder):
    return {"truth": str(vector(folder / "t.gpkg", [roof(900.0)]))}


@case(
    "other layers",
    "an area of interest beside the raster",
    "AoiUnusable",
    "aoi t.gpkg lies outside the raster: …: check its CRS",
)
def _(folder):
    return {"aoi": str(vector(folder / "t.gpkg", [shapely.affinity.translate(shapely.box(*BOX), 5000)]))}


@case("other layers", "an area of interest that cannot be read", "AoiUnusable",
      "aoi nowhere.gpkg cannot be read as vector data (…): give a GeoPackage, GeoJSON or the like")  # fmt: skip
def _(folder):
    return {"aoi": "nowhere.gpkg"}


@case("other layers", "footprints that cannot be read", "FootprintsUnusable",
      "footprints nowhere.gpkg cannot be read (…): give a GeoPackage or GeoJSON")  # fmt: skip
def _(folder):
    return {"footprints": "nowhere.gpkg"}


@case("other layers", "footprints without a CRS", "FootprintsUnusable", "footprints t.gpkg says no CRS: assign one")
def _(folder):
    return {"footprints": str(vector(folder / "t.gpkg", [shapely.box(*BOX)], None))}


@case("other layers", "sections that cannot be read", "SectionsUnusable",
      "sections nowhere.gpkg cannot be read (…): give the edited city.gpkg or a GeoPackage")  # fmt: skip
def _(folder):
    return {"sections": "nowhere.gpkg"}


@case("other layers", "regions that cannot be read", "RegionsUnusable",
      "regions nowhere.gpkg cannot be read as vector data (…): give a GeoPackage or GeoJSON")  # fmt: skip
def _(folder):
    return {"regions": "nowhere.gpkg"}


@case("other layers", "regions without angles", "RegionsUnusable",
      "regions t.gpkg lacks the column view_azimuth and view_elevation: each polygon needs both, in degrees")  # fmt: skip
def _(folder):
    return {"regions": str(vector(folder / "t.gpkg", [shapely.box(*BOX)]))}


@case("other layers", "corrected sections that lie elsewhere", "SectionsUnusable",
      "sections t.gpkg lie outside the raster, which is in …: check the layer's CRS, and that it belongs to the "
      "raster")  # fmt: skip
def _(folder):
    far = shapely.box(*(v + 90_000 for v in BOX))
    return {"sections": str(vector(folder / "t.gpkg", [far]))}


@case("other layers", "regions whose angles are no numbers", "RegionsUnusable",
      "regions t.geojson: an angle is no number (…): give degrees, as in 181.1")  # fmt: skip
def _(folder):
    path = folder / "t.geojson"
    frame = geopandas.GeoDataFrame(
        {"view_azimuth": ["181,1"], "view_elevation": [60.0]}, geometry=[shapely.box(*BOX)], crs=CRS
    )
    frame.to_file(path)
    return {"regions": str(path)}


@case("settings", "a key mistyped", "BadConfig",
      "veiw_azimuth is no setting: did you mean view_azimuth? (docs/running.md lists all keys)")  # fmt: skip
def _(folder):
    return {"veiw_azimuth": 181.1}


@case("settings", "a key nobody knows", "BadConfig", "colour is no setting (docs/running.md lists all keys)")
def _(folder):
    return {"colour": "red"}


@case("settings", "a key mistyped one level down", "BadConfig",
      "train.shares.simulted is no setting: did you mean simulated? (docs/models.md lists them)")  # fmt: skip
def _(folder):
    return {"train": {"shares": {"simulted": 1}}}


@case("settings", "a key of own data mistyped", "BadConfig",
      "train.own.0.anotated is no setting: did you mean annotated? (docs/models.md lists them)")  # fmt: skip
def _(folder):
    return {"train": {"own": [{"raster": "a.tif", "dtm": 1, "truth": "t.gpkg", "anotated": "a.gpkg"}]}}


@case("settings", "a word mistyped", "BadConfig",
      "planes: 'rubust' is none of robust, paper: did you mean robust? (docs/running.md lists all keys)")  # fmt: skip
def _(folder):
    return {"planes": "rubust"}


@case("settings", "a wrong type", "BadConfig", "block: 'eight' is no integer (tiles per side of a job)")
def _(folder):
    return {"block": "eight"}


@case("settings", "no raster", "BadConfig", "scene s: which raster? Give raster=FILE (or `simulate:`)")
def _(folder):
    return {"raster": None}


@case("settings", "no terrain", "BadConfig",
      "scene s: which terrain? Give dtm=FILE, or dtm=NUMBER for flat ground at that height (m)")  # fmt: skip
def _(folder):
    return {"dtm": None}


@case("settings", "a scene named like a command", "BadConfig",
      "scene name 'a;rm -rf': use letters, digits, '.', '_' and '-' only, it names a folder")  # fmt: skip
def _(folder):
    return {"scene": "a;rm -rf"}


@case("settings", "braces in a file's name", "BadConfig",
      "raster a{rgb}.tif: Snakemake takes what stands in braces for a pattern: give it another name, or a link")  # fmt: skip
def _(folder):
    return {"raster": "a{rgb}.tif"}


@case("models", "no model there", "NotAModel",
      "no model at nowhere: give `models=` a folder with sections.onnx and corners.onnx")  # fmt: skip
def _(folder):
    return {"models": "nowhere"}


@case("models", "a file that is no ONNX model", "NotAModel", "models/sections.onnx is not an ONNX model (…)")
def _(folder):
    (folder / "models/sections.onnx").write_bytes(b"not a model")
    return {}


@case("models", "a model without a contract", "NoContract",
      "models/sections.onnx carries no contract: store it in metadata_props['kibs'] or beside the model as sections.json "
      "(docs/architecture.md, Models)")  # fmt: skip
def _(folder):
    model = onnx.load(folder / "models/sections.onnx")
    del model.metadata_props[:]
    onnx.save(model, folder / "models/sections.onnx")
    return {}


@case("models", "a contract that breaks the schema", "ContractMismatch",
      "models/sections.onnx: gsd: … Export the model again, or correct its contract")  # fmt: skip
def _(folder):
    toy.sections_model(folder / "models/sections.onnx", toy.contract("sections", gsd="fine"))
    return {}


@case("models", "the models the wrong way round", "ContractMismatch",
      "models/sections.onnx is a model of corners, used here for sections: swap the files?")  # fmt: skip
def _(folder):
    toy.corners_model(folder / "models/sections.onnx")
    return {}


@case("models", "two models that disagree", "ContractMismatch",
      "the models disagree on margin (sections.onnx: 10, corners.onnx: 8): take two that were made together")  # fmt: skip
def _(folder):
    toy.sections_model(folder / "models/sections.onnx", toy.contract("sections", margin=10))
    return {}


@case("models", "weights in a file outside the model", "ExternalData",
      "models/sections.onnx keeps weights outside itself, in ../secret.bin: save it as one file (onnx.save_model of the loaded "
      "model with save_as_external_data=False), so that its checksum stands for all of it")  # fmt: skip
def _(folder):
    model = onnx.load(folder / "models/sections.onnx")
    tensor = model.graph.initializer[0]
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../secret.bin")
    (folder / "models/sections.onnx").write_bytes(model.SerializeToString())
    return {}


@case("models", "a gigantic model", "ModelTooLarge",
      "models/sections.onnx has 3.0 GiB, an ONNX file at most 2: give a smaller model")  # fmt: skip
def _(folder):
    os.truncate(folder / "models/sections.onnx", 3 * 2**30)
    return {}


@case("results", "a link to a disk that is not there", "ResultsUnwritable",
      "results is a link to nowhere, which is not there: mount it, or make it")  # fmt: skip
def _(folder):
    (folder / "results").symlink_to("nowhere")
    return {}


@case("results", "a file where the results go", "ResultsUnwritable",
      "results cannot be made: results is a file; move it away, or start in another folder")  # fmt: skip
def _(folder):
    (folder / "results").write_text("")
    return {}


def pattern(message: str) -> re.Pattern:
    """What a message with `…` matches."""
    return re.compile(".*".join(map(re.escape, message.split("…"))), re.S)


def tables() -> str:
    """The page's tables of refusals."""
    lines = []
    for part in dict.fromkeys(c.part for c in CASES):
        lines += [f"### {part.capitalize()}", "| given | error | message |", "|---|---|---|"]
        lines += [
            f"| {c.given} | `{c.error}` | {c.message.replace('|', chr(92) + '|')} |" for c in CASES if c.part == part
        ]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    before, _, rest = PAGE.read_text().partition("<!-- refused -->\n")
    after = rest.partition("<!-- end -->")[2]
    PAGE.write_text(before + "<!-- refused -->\n" + tables() + "<!-- end -->" + after)
