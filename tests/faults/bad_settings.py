"""Bad angles, layers, settings, models and places for results, one case each: how it is made, and the message it must get.

What is not bad about a case comes from `good_inputs`. `…` in a message stands for anything (numbers of bytes, a
library's own words).
"""

from __future__ import annotations

import os

import geopandas
import onnx
import shapely
import toy
from cases import case
from good_inputs import BOX, CRS, roof, vector


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
