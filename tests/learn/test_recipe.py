"""From `train` in the configuration to the options of the programs."""

import json

import pytest
import toy

from kibs_steps.learn import recipe
from kibs_steps.models import contract
from kibs_steps.plan import BadConfig

SCENES = {
    "bare": {"dtm": 3},
    "half": {"raster": "t.tif", "view_azimuth": 20.0},
    "parts": {"raster": "t.tif", "regions": "r.gpkg"},
}
TOWN = {"raster": "t.tif", "dtm": 100, "truth": "t.gpkg", "view_azimuth": 181.1, "view_elevation": 59.3, "models": "x"}


def test_defaults_train_the_dense_network_once_for_three_models(tmp_path):
    found = recipe.recipe({}, tmp_path)
    assert found.name == "mine"
    assert set(found.training) == {"both"}
    assert found.network_of == {"both": "both", "sections": "both", "corners": "both"}
    assert "--family=dense" in found.training["both"]
    assert not [o for o in found.training["both"] if o.startswith(("--view", "--data"))]
    assert found.starts == {"both": []}


@pytest.mark.parametrize("settings", [{"family": "maskrcnn"}, {"networks": "separate"}])
def test_the_papers_pair_is_two_networks_and_ours_may_be(tmp_path, settings):
    found = recipe.recipe({"train": {"name": "paper", **settings}}, tmp_path)
    assert found.network_of == {"sections": "sections", "corners": "corners"}
    assert "--task=corners" in found.training["corners"]


def test_sections_may_be_trained_alone_and_corners_kept(tmp_path):
    (tmp_path / "models/free").mkdir(parents=True)
    for file in ("sections.pt", "sections.onnx"):
        (tmp_path / "models/free" / file).touch()
    train = {"networks": "sections", "init": "free"}
    with pytest.raises(BadConfig, match=r"free has no corners.onnx"):
        recipe.recipe({"train": train}, tmp_path)
    toy.corners_model(tmp_path / "models/free/corners.onnx")
    with pytest.raises(BadConfig, match=r"is for 0.38 m per px, the sections are to be for 0.25"):
        recipe.recipe({"train": {**train, "gsd": 0.25}}, tmp_path)
    found = recipe.recipe({"train": train}, tmp_path)
    assert (set(found.training), set(found.network_of)) == ({"sections"}, {"sections"})
    assert found.taken == {"corners": f"{tmp_path}/models/free/corners.onnx"}
    assert not recipe.recipe({"train": {**train, "networks": "separate", "init": None}}, tmp_path).taken
    with pytest.raises(BadConfig, match="of the set that `init` names"):
        recipe.recipe({"train": {"networks": "sections"}}, tmp_path)


def test_another_gsd_is_that_of_the_network_and_of_own_tiles(tmp_path):
    found = recipe.recipe({"scenes": {"town": TOWN}, "train": {"own": ["town"], "gsd": 0.25}}, tmp_path)
    assert "--gsd=0.25" in found.training["both"]
    assert "--gsd=0.25" in recipe.own_options(found.own["town"], "blocks", 0, 0.25)
    assert not [o for o in recipe.own_options(found.own["town"], "blocks", 0) if "gsd" in o]


def test_a_blur_is_that_of_all_networks(tmp_path):
    training = recipe.recipe({"train": {"blur": 1.0, "networks": "separate"}}, tmp_path).training
    assert all("--blur=1.0" in options for options in training.values())
    assert (
        "--blur=0" in recipe.recipe({"train": {"blur": 0}}, tmp_path).training["both"]
    )  # sharper than those of `init`
    assert not any("blur" in option for option in recipe.recipe({}, tmp_path).training["both"])


def test_joins_are_learned_for_networks_that_find_basins(tmp_path):
    assert recipe.recipe({}, tmp_path).joins == {"both": ["--scenes=120"], "sections": ["--scenes=120"], "corners": []}
    for train in ({"family": "maskrcnn", "joins": 9}, {"joins": 0}):
        assert not any(recipe.recipe({"train": train}, tmp_path).joins.values())
    (tmp_path / "a.json").touch()
    given = {"data": "kibs", "cities": [str(tmp_path / "a.json")], "joins": 5}
    shown = recipe.recipe({"train": given}, tmp_path).joins["both"]
    assert shown == ["--scenes=5", "--data=kibs", "--cities", str(tmp_path / "a.json")]
    kept = recipe.recipe({"train": {**given, "leave_out": ["inria"]}}, tmp_path).joins["both"]
    assert kept == [*shown, "--leave-out", "inria"]
    assert "--data=kibs" not in recipe.recipe({"train": {**given, "free": True}}, tmp_path).joins["both"]


def test_thresholds_are_those_of_the_model_for_sections(tmp_path):
    given = {"train": {"thresholds": {"likely": 0.15, "surer": 0.7}}}
    export = recipe.recipe(given, tmp_path).export
    assert export["sections"] == export["both"] == ['--thresholds={"likely": 0.15, "surer": 0.7}']
    assert export["corners"] == []
    assert recipe.recipe({}, tmp_path).export == {"both": [], "sections": [], "corners": []}


def test_a_prominence_that_is_asked_for_is_that_of_joins_too(tmp_path):
    given = {"train": {"thresholds": {"prominence": 0.3}, "joins": 7}}
    assert recipe.recipe(given, tmp_path).joins["sections"] == ["--scenes=7", "--prominence=0.3"]


def test_free_sources_are_asked_for(tmp_path):
    assert "--free" in recipe.recipe({"train": {"data": "kibs", "free": True}}, tmp_path).training["both"]
    assert "--free" not in recipe.recipe({"train": {"data": "kibs"}}, tmp_path).training["both"]


def test_own_data_of_a_scene_and_of_its_own(tmp_path):
    outlines = {"name": "roofs", "raster": "r.tif", "dtm": "d.tif", "buildings": "b.gpkg", "bands": [5, 3, 2]}
    config = {
        "scenes": {"town": TOWN},
        "truth_frame": "image",
        "train": {"own": ["town", outlines], "split": "shuffle"},
    }
    found = recipe.recipe(config, tmp_path)
    assert list(found.own) == ["town", "roofs"]
    options = recipe.own_options(found.own["town"], "shuffle", 3)
    assert {"--raster=t.tif", "--dtm=100", "--truth=t.gpkg", "--truth-frame=image", "--view-azimuth=181.1"} <= set(
        options
    )
    assert {"--split=shuffle", "--seed=3"} <= set(options)
    assert not [o for o in options if "models" in o]
    options = recipe.own_options(found.own["roofs"], "blocks", 0)
    assert "--bands=5,3,2" in options
    assert not [o for o in options if o.startswith("--truth")]


def test_fine_tuning_takes_the_scenes_angles_and_the_sets_weights(tmp_path):
    folder = tmp_path / "models/free"
    folder.mkdir(parents=True)
    (folder / "weights.pt").touch()
    config = {
        "scenes": {"town": TOWN},
        "train": {"scene": "town", "init": "free", "shares": {"simulated": 0.5, "own": 0.5}},
    }
    options = recipe.recipe(config, tmp_path).training["both"]
    assert {"--view-azimuth=181.1", "--view-elevation=59.3"} <= set(options)
    assert recipe.recipe(config, tmp_path).starts == {"both": [str(folder / "weights.pt")]}
    assert options[options.index("--untold") + 1] == "sun"
    assert recipe.recipe(config, tmp_path).look == {"town": {"raster": "t.tif"}}
    assert "--shares=simulated=0.5,own=0.5" in options
    assert recipe.recipe(config, tmp_path).like == {"both": [], "sections": [], "corners": []}
    (folder / "sections.onnx").touch()
    assert recipe.recipe(config, tmp_path).like["sections"] == [str(folder / "sections.onnx")]
    (folder / "both.pt").touch()
    assert recipe.weights("free", "both", tmp_path) == folder / "both.pt"
    assert recipe.weights(str(folder / "weights.pt"), "both", tmp_path) == folder / "weights.pt"


def test_fine_tuning_for_an_image_of_unknown_view_shows_all_and_tells_none(tmp_path):
    config = {"scenes": {"town": {"raster": "t.tif", "bands": [5, 3, 2]}}, "train": {"scene": "town", "gsd": 0.25}}
    found = recipe.recipe(config, tmp_path)
    for options in (found.training["both"], found.joins["sections"]):
        assert options[options.index("--untold") :][1:3] == ["view", "sun"]
        assert not [o for o in options if o.startswith(("--view", "--sun"))]
    assert set(recipe.look_options(found.look["town"], 3, 0.25)) == {
        "--raster=t.tif",
        "--bands=5,3,2",
        "--gsd=0.25",
        "--seed=3",
    }
    assert not recipe.recipe({}, tmp_path).look


def test_a_set_that_was_trained_here_is_trained_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for file in ("models/mine/sections.onnx", "runs/mine/sections/done.json"):
        (tmp_path / file).parent.mkdir(parents=True)
        (tmp_path / file).touch()
    train = {"name": "again", "init": "mine", "networks": "separate"}
    with pytest.raises(BadConfig, match="corners"):
        recipe.recipe({"train": train}, tmp_path)
    (tmp_path / "runs/mine/corners").mkdir()
    (tmp_path / "runs/mine/corners/done.json").touch()
    found = recipe.recipe({"train": train}, tmp_path)
    assert found.starts["corners"] == ["runs/mine/corners/checkpoint.pt"]
    assert found.like["sections"] == [f"{tmp_path}/models/mine/sections.onnx"]


def test_a_scene_nobody_annotated_is_guessed_by_a_model(tmp_path):
    folder = tmp_path / "models/mine"
    folder.mkdir(parents=True)
    train = {"name": "again", "own": [{"scene": "town", "guess": "mine"}]}
    with pytest.raises(BadConfig, match=r"guess: mine is no file, and there is no .*sections.onnx"):
        recipe.recipe({"scenes": {"town": TOWN}, "train": train}, tmp_path)
    (folder / "sections.onnx").touch()
    found = recipe.recipe({"scenes": {"town": TOWN}, "train": train}, tmp_path)
    assert f"--guess={folder / 'sections.onnx'}" in recipe.own_options(found.own["town"], "blocks", 0)
    assert not [o for o in recipe.own_options(found.own["town"], "blocks", 0) if o.startswith("--truth")]
    assert found.files("town") == [str(folder / "sections.onnx")]


def test_own_data_of_a_scene_may_be_given_in_part(tmp_path):
    train = {
        "own": [{"scene": "town", "annotated": "a.gpkg"}, {"scene": "town", "name": "outlines", "buildings": "b.gpkg"}]
    }
    found = recipe.recipe({"scenes": {"town": TOWN}, "train": train}, tmp_path).own
    assert found["town"]["annotated"] == "a.gpkg"
    assert (found["town"]["truth"], found["town"]["view_azimuth"]) == ("t.gpkg", 181.1)
    assert (found["outlines"]["raster"], found["outlines"]["buildings"]) == ("t.tif", "b.gpkg")
    assert "truth" not in found["outlines"]


def test_angles_may_come_from_metadata(tmp_path):
    item = tmp_path / "item.json"
    item.write_text(json.dumps({"type": "Feature", "properties": {"view:azimuth": 20.0, "view:incidence_angle": 20.0}}))
    told = {"raster": "t.tif", "dtm": 100, "truth": "t.gpkg", "metadata": str(item)}
    config = {
        "scenes": {"town": told},
        "train": {"own": ["town", {**told, "name": "other"}], "scene": "town", "tiles": 5},
    }
    found = recipe.recipe(config, tmp_path)
    for name in ("town", "other"):
        assert found.own[name]["view_azimuth"] == pytest.approx(200.0)
        assert found.own[name]["view_elevation"] == pytest.approx(70.0)
        assert "metadata" not in found.own[name]
    assert "--view-azimuth=200.0" in found.training["both"]
    config["scenes"]["town"]["view_azimuth"] = 10.0  # what is set itself comes first
    assert recipe.recipe(config, tmp_path).own["town"]["view_azimuth"] == 10.0


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ({"own": [{"raster": "a.tif", "dtm": 1, "truth": "t.gpkg", "regions": "r.gpkg"}]}, "has regions"),
        ({"own": ["nowhere"]}, "no scene 'nowhere'"),
        ({"own": [{"raster": "a.tif", "dtm": 1}]}, "truth .* buildings .* guess"),
        ({"own": [{"raster": "a.tif", "truth": "t.gpkg"}]}, "has no dtm"),
        (
            {"own": [{"raster": "a.tif", "dtm": 1, "guess": __file__, "annotated": "a.gpkg"}]},
            "guesses nothing is: leave one out",
        ),
        ({"scene": "bare"}, "no raster to look like"),
        ({"scene": "half"}, "view_azimuth and view_elevation, or neither"),
        ({"scene": "parts"}, "name a scene of one view"),
        ({"init": "nothing"}, r"nothing is no file"),
        ({"tiles": 0}, "nothing to learn from"),
        ({"blur": 1.0, "family": "maskrcnn"}, "see the image as it is"),
        ({"cities": ["none.json"]}, "none.json is not there"),
        ({"name": "a", "init": "a"}, "set a cannot be made from itself"),
        ({"name": "a", "init": "models/a"}, "set a cannot be made from itself"),
    ],
)
def test_what_cannot_be_trained_is_said(tmp_path, train, message):
    with pytest.raises(BadConfig, match=message):
        recipe.recipe({"scenes": SCENES, "train": train}, tmp_path)


def test_a_set_that_was_not_trained_here_is_not_written_over(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "models/free").mkdir(parents=True)
    toy.corners_model(tmp_path / "models/free/corners.onnx")
    config = {"train": {"name": "free"}}
    with pytest.raises(BadConfig, match="free holds a model set that was not trained here"):
        recipe.of_run(config, tmp_path, (), ["train"])
    assert recipe.of_run(config, tmp_path, (), ["results/a/city.gpkg"]).name == "free"  # who trains nothing may have it
    (tmp_path / "here/runs/free").mkdir(parents=True)
    assert recipe.of_run(config, tmp_path, (), ["train"]).name == "free"


def test_models_of_another_family_are_no_start(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "models/pair"
    folder.mkdir(parents=True)
    toy.models(folder)
    head = contract.load(folder / "corners.onnx").contract["head"]
    same, other = ("dense", "maskrcnn") if head == "dense" else ("maskrcnn", "dense")
    for task in ("sections", "corners"):
        (folder / f"{task}.pt").touch()
    train = {"name": "mine", "init": "pair", "networks": "separate"}
    assert recipe.of_run({"train": {**train, "family": same}}, tmp_path, (), ["train"]).like
    with pytest.raises(BadConfig, match=f"is of family {same}, what is trained of {other}"):
        recipe.of_run({"train": {**train, "family": other}}, tmp_path, (), ["train"])


def test_an_items_own_metadata_stands_above_its_scenes_angles(tmp_path):
    item = tmp_path / "other.IMD"
    item.write_text("meanSatAz = 10;\nmeanSatEl = 80;\n")
    own = {"scene": "town", "name": "other", "raster": "other.tif", "truth": "o.gpkg", "metadata": str(item)}
    found = recipe.recipe({"scenes": {"town": TOWN}, "train": {"own": [own]}}, tmp_path).own["other"]
    assert (found["view_azimuth"], found["view_elevation"], found["dtm"]) == (10.0, 80.0, 100)


def test_the_command_line_stands_above_a_scenes_own_keys(tmp_path):
    config = {"scenes": {"town": TOWN}, "view_elevation": 50.0, "train": {"scene": "town", "own": ["town"]}}
    for told, elevation in (((), 59.3), (("view_elevation",), 50.0)):
        found = recipe.recipe(config, tmp_path, told)
        assert found.own["town"]["view_elevation"] == elevation
        assert f"--view-elevation={elevation}" in found.training["both"]
    elsewhere = {**config, "scene": "other"}  # what is told of that is not meant for this one
    assert recipe.recipe(elsewhere, tmp_path, ("view_elevation",)).own["town"]["view_elevation"] == 59.3


def test_regions_for_all_scenes_are_refused_too(tmp_path):
    with pytest.raises(BadConfig, match="has regions"):
        recipe.recipe({"regions": "r.gpkg", "scenes": {"town": TOWN}, "train": {"own": ["town"]}}, tmp_path)


def test_walls_lift_sections_where_the_view_is_told(tmp_path):
    scenes = {"town": TOWN, "unseen": {"raster": "t.tif", "dtm": 3}, "dark": {**TOWN, "truth": None}}
    (tmp_path / "c.json").touch()
    train = {"networks": "separate", "lifts": 30, "cities": [str(tmp_path / "c.json")]}
    found = recipe.recipe({"train": train}, tmp_path)
    assert found.lifts == {"sections": [], "corners": ["--tiles=30", "--cities", str(tmp_path / "c.json")]}
    assert recipe.recipe({"scenes": scenes, "train": {"scene": "dark"}}, tmp_path).lifts["corners"] == [
        "--tiles=300",
        "--untold",
        "sun",
    ]
    for nothing in ({"lifts": 0}, {"family": "maskrcnn"}, {"scene": "unseen"}):
        assert not any(recipe.recipe({"scenes": scenes, "train": {**train, **nothing}}, tmp_path).lifts.values())
