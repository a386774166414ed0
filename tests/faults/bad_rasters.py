"""Bad rasters and terrain models, one case each: how it is made, and the message it must get.

What is not bad about a case comes from `good_inputs`. `…` in a message stands for anything (numbers of bytes, a
library's own words).
"""

from __future__ import annotations

import os
import time

import numpy as np
import rasterio
import rasters
from affine import Affine
from cases import case
from good_inputs import ground, picture


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


@case("terrain", "`vertical_crs` of depths", "VerticalCrsUnusable",
      "vertical_crs=EPSG:5715 counts depths (MSL depth), published heights are counted upwards: give the CRS of heights of the "
      "same datum")  # fmt: skip
def _(folder):
    return {"vertical_crs": "EPSG:5715"}


@case("terrain", "a surface model that is not there", "DtmMissing",
      "dsm: raster nowhere.tif does not exist: check the path")  # fmt: skip
def _(folder):
    return {"dsm": "nowhere.tif"}


@case("terrain", "a surface model smaller than the scene", "DtmPartial",
      "dsm t.tif leaves … % of the scene uncovered: …")  # fmt: skip
def _(folder):
    return {"dsm": str(rasters.dtm(folder / "t.tif", np.full((20, 8), 5, "float32"), rasters.X0, rasters.Y0))}
