"""Plans: configuration to scenes, and signatures that change exactly where content changes."""

import json
from pathlib import Path

import geopandas
import numpy as np
import onnx
import pytest
import rasterio
import shapely
import toy
import yaml

from kibs_steps import fingerprint, plan, settings
from kibs_steps.models import contract
from kibs_steps.plan import BadConfig

SCHEMA = yaml.safe_load((Path(__file__).parents[1] / "workflow/schemas/config.schema.yaml").read_text())


@pytest.fixture
def files(tmp_path):
    """A raster and two model sets that differ in their corner model only."""
    image = toy.paint([], 120, 100)
    raster = toy.raster(tmp_path / "scene.tif", image)
    toy.models(tmp_path / "a")
    toy.models(tmp_path / "b")
    toy.corners_model(tmp_path / "b" / "corners.onnx", bias=1.0)
    return tmp_path, raster


def make(files, **settings):
    folder, raster = files
    config = {
        "scene": "s",
        "raster": str(raster),
        "dtm": 0,
        "models": str(folder / "a"),
        "block": 2,
        **toy.VIEW,
        **settings,
    }
    given = {key: value for key, value in config.items() if value is not None}
    ((name, full),) = plan.scenes(given, SCHEMA).items()
    return plan.plan(name, full, folder, folder / "results")


def changed(files, **settings):
    """Which steps get another signature than the plain plan's."""
    one, other = make(files).signature, make(files, **settings).signature
    return {step for step in one if one[step] != other[step]}


AFTER_PLANES = {"planes", "buildings", "solids_of_block", "solids", "glb", "evaluate", "run"}
AFTER_DETECTION = {"stitch", "edited", *AFTER_PLANES}


def test_blocks_cover_the_raster(files):
    found = make(files)
    assert [b.name for b in found.blocks] == ["r000c000", "r000c001", "r001c000", "r001c001"]
    assert found.tiling == (toy.TILE, toy.MARGIN, 2)


def test_another_corner_model_leaves_sections_alone(files):
    assert changed(files, models=str(files[0] / "b")) - {"model_sections"} == {
        "model_corners",
        "blend",
        "corners",
        *AFTER_DETECTION,
    }


def test_a_contract_beside_its_network_counts_as_its_content(files):
    folder, _ = files
    network = folder / "a/sections.onnx"
    model = onnx.load(network)
    terms = {p.key: p.value for p in model.metadata_props}[contract.KEY]
    del model.metadata_props[:]
    onnx.save(model, network)
    network.with_suffix(".json").write_text(terms)
    before = make(files).signature
    other = json.loads(terms)
    other["thresholds"]["min_area"] = 1000
    network.with_suffix(".json").write_text(json.dumps(other))
    after = make(files).signature
    assert {"model_sections", "sections", "stitch"} <= {step for step in before if before[step] != after[step]}


def test_supposing_takes_a_set_that_can_be_told(files):
    folder, _ = files
    common = {"data": ["toy"], "licence": "CC0-1.0"}
    for place, trained in (("", common), ("untold", {**common, "untold": ["sun"]})):
        toy.lit_sections_model(folder / "suite" / place / "sections.onnx", trained_on=trained)
        toy.corners_model(folder / "suite" / place / "corners.onnx")
    plain, supposing = (make(files, models=str(folder / "suite"), suppose=on) for on in (False, True))
    assert plain.models["sections"].path.parent.name == "untold"
    assert supposing.models["sections"].path.parent.name == "suite"
    assert supposing.supposes
    # Where nothing else is there, there is nobody to tell.
    assert not make(files, models=str(folder / "suite/untold"), suppose=True).supposes


def test_regions_tell_from_where_a_scene_is_seen(files):
    """Networks are chosen for their views, and each is held against what those were trained on."""
    folder, raster = files
    common = {"data": ["toy"], "licence": "CC0-1.0", "view_elevation": [50, 90]}
    for place, trained in (("", common), ("untold", {**common, "untold": ["view"]})):
        toy.lit_sections_model(folder / "suite" / place / "sections.onnx", trained_on=trained)
        toy.corners_model(folder / "suite" / place / "corners.onnx")
    with rasterio.open(raster) as source:
        box, crs = shapely.box(*source.bounds), source.crs

    def planned(elevation, **more):
        layer = folder / f"r{elevation}.gpkg"
        table = {"view_azimuth": [181.1, 90.0], "view_elevation": [70.0, elevation]}
        geopandas.GeoDataFrame(table, geometry=[box, box], crs=crs).to_file(layer)
        config = {
            "scene": "s",
            "raster": str(raster),
            "dtm": 0,
            "models": str(folder / "suite"),
            "regions": str(layer),
            **more,
        }
        ((name, full),) = plan.scenes(config, SCHEMA).items()
        return plan.plan(name, full, folder, folder / "results")

    assert planned(60.0).models["sections"].path.parent.name == "suite"
    assert not planned(60.0).warnings
    with pytest.raises(contract.AngleOutsideTraining, match="25"):
        planned(25.0)
    assert planned(25.0, allow_angles=True).warnings


def test_another_view_leaves_detection_alone(files):
    """The toy models take no geometry, so angles matter from the plane fit on (and for the truth's frames)."""
    found = changed(files, view_azimuth=90.0)
    assert {"scene", "planes"} <= found
    assert not {"source", "tiles", "sections", "corners", "stitch"} & found


def test_planes_rule_and_block(files):
    assert changed(files, planes="paper") == AFTER_PLANES
    assert "scene" not in changed(files, block=3)


def test_touching_a_file_changes_nothing_and_content_does(files):
    folder, raster = files
    before = make(files).signature
    raster.touch()
    assert make(files).signature == before
    image = toy.paint(toy.houses(np.random.default_rng(0), 120, 100), 120, 100)
    toy.raster(raster, image)
    assert make(files).signature["tiles"] != before["tiles"]
    assert (folder / "results" / ".fingerprints.json").is_file()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"raster": None}, "None is not of type 'string'|raster"),
        ({"planes": "clever"}, "planes"),
        ({"rastr": "x.tif"}, "rastr"),
        ({"view_elevation": 120}, "view_elevation"),
        ({"feed": "truth"}, "feed=truth needs truth"),
        ({"scene": "a;rm -rf"}, "scene name"),
        ({"models": "nowhere"}, "no model at"),
        ({"block": 0}, "block"),
    ],
)
def test_bad_configuration(files, settings, message):
    from kibs_steps.errors import KibsError

    with pytest.raises(KibsError, match=message):
        make(files, **settings)


def test_a_simulated_scene_has_no_aoi(files):
    simulated = {"simulate": {"seed": 1}, "sun_azimuth": 150.0, "sun_elevation": 45.0, "raster": None, "dtm": None}
    with pytest.raises(BadConfig, match="leave out aoi"):
        make(files, **simulated, aoi="a.gpkg")
    for key in ("raster", "dtm", "truth"):
        with pytest.raises(BadConfig, match=f"makes its own {key}: leave out {key}, or name another scene"):
            make(files, **{**simulated, key: "a"})
    # Its truth stands on the map in absolute heights, whatever others' does.
    usual, told = (
        make(files, **simulated, **more) for more in ({}, {"truth_z": "above_ground", "projection_height": 0})
    )
    assert told.settings == usual.settings
    assert told.signature == usual.signature


def test_simulated_scene_needs_angles(files):
    config = {"scenes": {"d": {"simulate": {"seed": 1, "size": 200}, "models": str(files[0] / "a")}}}
    ((name, full),) = plan.scenes(config, SCHEMA).items()
    with pytest.raises(BadConfig, match="view_azimuth"):
        plan.plan(name, full, files[0], files[0] / "results")


def test_a_scenes_own_settings_stand_above_those_for_all_and_below_the_command_lines():
    config = {"models": "x", "block": 3, "scenes": {"a": {"models": "y"}, "b": {}}}
    found = plan.scenes(config, SCHEMA)
    assert (found["a"]["models"], found["b"]["models"], found["a"]["block"]) == ("y", "x", 3)
    found = plan.scenes(config, SCHEMA, told=["models"])
    assert (found["a"]["models"], found["b"]["models"]) == ("x", "x")


def test_a_scene_may_be_called_by_a_number():
    config = {"scenes": {2024: {"models": "y"}}}
    for wanted in ({}, {"scene": "2024"}, {"scene": 2024}):
        found = plan.scenes({**config, **wanted}, SCHEMA)
        assert {name: own["models"] for name, own in found.items()} == {"2024": "y"}
    assert list(plan.scenes({"scene": 0, "scenes": {0: {}, "b": {}}}, SCHEMA)) == ["0"]


def test_no_scene_at_all():
    with pytest.raises(BadConfig, match="no scene"):
        plan.scenes({"scenes": {}}, SCHEMA)


def test_fingerprint_survives_a_damaged_cache(tmp_path):
    file, cache = tmp_path / "f", tmp_path / "cache.json"
    file.write_bytes(b"abc")
    first = fingerprint.of_file(file, cache)
    cache.write_text("{")
    assert fingerprint.of_file(file, cache) == first


def test_what_a_file_stands_for_counts_as_its_content(tmp_path):
    cache = tmp_path / "cache.json"
    part, other = tmp_path / "part.tif", tmp_path / "deep/other.tif"
    other.parent.mkdir()
    part.write_bytes(b"a")
    other.write_bytes(b"b")
    whole, inner = tmp_path / "whole.vrt", other.with_suffix(".vrt")
    source = '<VRTDataset><SourceFilename relativeToVRT="1">{}</SourceFilename></VRTDataset>'
    inner.write_text(source.format("other.tif"))
    whole.write_text(source.format("part.tif"))
    assert fingerprint.companions(whole) == [part]
    whole.write_text(
        f'<V><SourceFilename relativeToVRT="1">part.tif</SourceFilename><SourceDataset relativeToVRT="0">{inner}</SourceDataset>'
        "<SourceFilename>/vsicurl/https://nowhere/x.tif</SourceFilename></V>"
    )
    assert fingerprint.companions(whole) == [part, inner, other]
    first = fingerprint.of_source(whole, cache)
    other.write_bytes(b"c")
    assert fingerprint.of_source(whole, cache) != first
    whole.write_text(source.format("whole.vrt"))  # which GDAL refuses: it names itself
    assert fingerprint.companions(whole) == []
    whole.write_text("no xml")
    assert fingerprint.companions(whole) == []
    for end in ("shp", "dbf", "prj", "sbn"):
        (tmp_path / f"roofs[1].{end}").write_bytes(end.encode())
    shape = tmp_path / "roofs[1].shp"
    before = fingerprint.of_source(shape, cache)
    (tmp_path / "roofs[1].sbn").write_bytes(b"an index")
    assert fingerprint.of_source(shape, cache) == before
    (tmp_path / "roofs[1].dbf").write_bytes(b"other angles")
    assert fingerprint.of_source(shape, cache) != before
    assert fingerprint.of_source(part, cache) == fingerprint.of_file(part, cache)
    assert fingerprint.of_source(other.parent, cache) == [fingerprint.of_file(f, cache) for f in (other, inner)]


def test_what_stands_beside_a_file_counts_as_its_content(tmp_path):
    """Where a raster without a header lies, and edits that SQLite still keeps beside a GeoPackage."""
    cache = tmp_path / "cache.json"
    for name, beside in (("d.asc", "d.prj"), ("p.tif", "p.tfw"), ("t.gpkg", "t.gpkg-wal")):
        file, more = tmp_path / name, tmp_path / beside
        file.write_bytes(b"a")
        alone = fingerprint.of_source(file, cache)
        more.write_bytes(b"b")
        before = fingerprint.of_source(file, cache)
        more.write_bytes(b"other")
        assert len({str(alone), str(before), str(fingerprint.of_source(file, cache))}) == 3, name
    band = "<PAMRasterBand band='1'>{}<Metadata><MDI key='STATISTICS_MEAN'>{}</MDI></Metadata></PAMRasterBand>"
    aux = f"<PAMDataset>{band}</PAMDataset>"
    found = []
    for said in (("", 1), ("", 2), ("<NoDataValue>0</NoDataValue>", 2), ("<NoDataValue>1</NoDataValue>", 3)):
        (tmp_path / "p.tif.aux.xml").write_text(aux.format(*said))
        found.append(str(fingerprint.of_source(tmp_path / "p.tif", cache)))
    assert found[0] == found[1]  # a viewer's statistics
    assert len(set(found)) == 3
    (tmp_path / "t.gpkg-wal").write_bytes(b"")
    assert fingerprint.of_source(tmp_path / "t.gpkg", cache) == fingerprint.of_file(tmp_path / "t.gpkg", cache)


def test_edited_sections_and_a_surface_model_start_where_they_are_used(files):
    folder, _ = files
    for name in ("edit.gpkg", "dsm.tif"):
        (folder / name).write_bytes(name.encode())
    table = {"view_azimuth": [170.0], "view_elevation": [60.0]}
    geopandas.GeoDataFrame(table, geometry=[shapely.box(0, 0, 1, 1)], crs="EPSG:4326").to_file(folder / "regions.gpkg")
    assert changed(files, sections=str(folder / "edit.gpkg")) == {"edited", *AFTER_PLANES}
    assert changed(files, dsm=str(folder / "dsm.tif")) == {"surface", *AFTER_DETECTION}
    assert {"scene", "planes"} <= changed(files, regions=str(folder / "regions.gpkg"))
    assert not {"tiles", "sections"} & changed(files, regions=str(folder / "regions.gpkg"))
    assert changed(files, drape=True) == {"glb", "run"}
    assert changed(files, suppose=True) == {"run"}  # networks that take no directions are told none


def test_angles_come_from_metadata(files):
    folder, _ = files
    (folder / "a.IMD").write_text("meanSatAz = 181.1;\nmeanSatEl = 59.3;\nmeanSunAz = 155;\nmeanSunEl = 45;\n")
    config = {k: v for k, v in toy.VIEW.items() if not k.startswith(("view", "sun"))}
    ((_, full),) = plan.scenes({"scene": "s", "raster": str(files[1]), "dtm": 0, "models": str(folder / "a"),
                                "metadata": str(folder / "a.IMD"), **config}, SCHEMA).items()  # fmt: skip
    assert plan.plan("s", full, folder, folder / "results").settings["view_azimuth"] == 181.1


def test_metadata_stands_where_it_is_given(files):
    """Told on the command line it stands above a scene's own angles, a scene's own above those for all."""
    folder, _ = files
    (folder / "a.IMD").write_text("meanSatAz = 280;\nmeanSatEl = 70;\n", encoding="utf-8-sig")
    own = {"metadata": str(folder / "a.IMD")}
    for config, told, azimuth in (
        ({**own, "scenes": {"s": {"view_azimuth": 10.0}}}, (), 10.0),
        ({**own, "scenes": {"s": {"view_azimuth": 10.0}}}, ("metadata",), 280.0),
        ({"view_azimuth": 10.0, "scenes": {"s": own}}, (), 280.0),
    ):
        assert plan.scenes(config, SCHEMA, told)["s"]["view_azimuth"] == azimuth
    (folder / "lit.IMD").write_text("meanSatAz = 20;\nmeanSatEl = 70;\nmeanSunAz = 150;\nmeanSunEl = 45;\n")
    found = plan.scenes({"metadata": str(folder / "lit.IMD"), "scenes": {"s": own}}, SCHEMA)["s"]
    assert (found["view_azimuth"], found.get("sun_azimuth")) == (280.0, None)  # nothing of another image's file


def test_a_simulated_city_reruns_with_its_file(files):
    folder, _ = files
    city = folder / "c.city.json"
    scene = {"simulate": {"seed": 1, "size": 200, "city": str(city)}, "models": str(folder / "a")}
    scene = {**scene, **toy.VIEW, "sun_azimuth": 155, "sun_elevation": 45}

    def sources():
        ((name, full),) = plan.scenes({"scenes": {"d": scene}}, SCHEMA).items()
        return plan.plan(name, full, folder, folder / "results").signature["source"]

    with pytest.raises(BadConfig, match="is not there"):
        sources()
    city.write_text("{}")
    first = sources()
    city.write_text("{ }")
    assert sources() != first


@pytest.mark.parametrize("settings", [{"provider": "openvino"}, {"threads": 2}, {"looks": 1}])
def test_other_hardware_and_fewer_looks_rerun_the_models_and_nothing_before(files, settings):
    """Sums in another order differ in their last bits: blocks of both are never mixed."""
    assert changed(files, **settings) == {"sections", "blend", "corners", "single", *AFTER_DETECTION}


def test_a_set_is_found_by_name_where_the_workflow_lies_and_where_it_runs(tmp_path, monkeypatch):
    base, here = tmp_path / "kibs", tmp_path / "here"
    for folder in (base / "models/research", here / "models/mine"):
        folder.mkdir(parents=True)
    monkeypatch.chdir(here)
    assert plan.folder_of("research", base) == base / "models/research"
    assert plan.folder_of("mine", base).resolve() == here / "models/mine"
    assert plan.folder_of("elsewhere/set", base) == Path("elsewhere/set")


def test_switches_may_be_written_as_in_yaml(files):
    """Snakemake leaves `drape=true` on a command line text."""
    assert make(files, drape="true", allow_angles="FALSE").settings["drape"] is True
    assert make(files, allow_angles="FALSE").settings["allow_angles"] is False
    with pytest.raises(BadConfig, match="drape: 'yes' is no boolean"):
        make(files, drape="yes")


@pytest.mark.parametrize(("said", "read"), [("2024_01", 202401), ("007", 7), ("2e3", 2000.0)])
def test_names_that_snakemake_takes_for_numbers_are_refused(said, read):
    words = ["--cores", "1", "--config", f"scene={said}"]
    with pytest.raises(BadConfig, match=f"scene={said}: Snakemake reads it as the number"):
        settings.check_name({"scene": read}, words)
    settings.check_name({"scene": 7}, ["--config", "scene=7"])
    settings.check_name({"scene": 7}, [])  # of a file
    settings.check_name({"scene": said}, words)
