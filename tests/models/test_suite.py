"""Which set of a suite a scene gets: angles first, then GSD, then the more special one."""

from pathlib import Path

import pytest
import toy

from kibs_steps.models import contract, suite

SHIPPED = Path(__file__).parents[2] / "models"
PAIR = ("sections", "corners")


def trained(**ranges) -> dict:
    return {"data": ["toy"], "licence": "CC0-1.0", **ranges}


def add(folder, name, gsd=0.38, **ranges):
    """A pair in the folder, told apart by its ending."""
    for task, make in (("sections", toy.sections_model), ("corners", toy.corners_model)):
        make(folder / f"{task}{name}.onnx", toy.contract(task, gsd=gsd, trained_on=trained(**ranges)))


def chosen(folder, gsd, view=None, sun=None):
    direction = view and {"azimuth": view[0], "elevation": view[1]}
    lit = sun and {"azimuth": sun[0], "elevation": sun[1]}
    one = suite.choose(suite.sets(folder, PAIR), gsd, direction, lit)
    return one["sections"].path


@pytest.mark.parametrize(
    ("gsd", "expected"),
    [(0.20, "25"), (0.25, "25"), (0.2501, "25"), (0.30, "38"), (0.38, "38"), (0.5, "50"), (0.7, "50"), (None, "25")],
)
def test_the_nearest_gsd_not_finer_than_the_raster(tmp_path, gsd, expected):
    for size in (0.25, 0.38, 0.50):
        add(tmp_path, f"-{size * 100:.0f}", gsd=size)
    assert chosen(tmp_path, gsd).stem == f"sections-{expected}"


@pytest.mark.parametrize("name", ["free", "research"])
@pytest.mark.parametrize(("gsd", "expected"), [(0.1, 0.25), (0.25, 0.25), (0.3, 0.38), (0.38, 0.38), (0.5, 0.38)])
def test_the_shipped_models_are_for_two_gsds(name, gsd, expected):
    shipped = suite.sets(SHIPPED / name, PAIR)
    for view in (None, {"azimuth": 181.1, "elevation": 59.3}, {"azimuth": 0.0, "elevation": 90.0}):
        one = suite.choose(shipped, gsd, view, None)
        assert {model.contract["gsd"] for model in one.values()} == {expected}


@pytest.mark.parametrize(
    ("elevation", "folder"),
    [(59.3, "research"), (80.0, "research"), (86.0, "nadir"), (90.0, "nadir"), (None, "unknown-view")],
)
def test_views_from_above_and_unknown_ones_get_sets_of_their_own(elevation, folder):
    view = None if elevation is None else {"azimuth": 30.0, "elevation": elevation}
    for sun in (None, {"azimuth": 155.0, "elevation": 45.0}):
        one = suite.choose(suite.sets(SHIPPED / "research", PAIR), 0.38, view, sun)
        assert one["sections"].path.parent.name == folder


def test_the_shipped_sets_say_what_may_be_done_with_them():
    root, files = SHIPPED, sorted(SHIPPED.rglob("*.onnx"))
    licences = {path: contract.load(path).contract["trained_on"]["licence"] for path in files}
    assert {path.relative_to(root).parts[0] for path in files} == {"free", "research"}
    for path, licence in licences.items():
        assert licence.startswith("CC BY-SA 4.0" if "free" in path.relative_to(root).parts else "CC BY-NC 4.0")
    assert sum(path.stat().st_size for path in files) <= 120e6


def test_the_set_that_covers_the_view_wins_over_a_better_gsd(tmp_path):
    add(tmp_path / "steep", "", gsd=0.38, view_elevation=[70, 90])
    add(tmp_path / "oblique", "", gsd=0.5, view_elevation=[50, 65])
    assert chosen(tmp_path, 0.38, (180, 80)).parent.name == "steep"
    assert chosen(tmp_path, 0.38, (180, 60)).parent.name == "oblique"
    assert chosen(tmp_path, 0.38, (180, 68.5)).parent.name == "steep"  # nearest, where none covers
    assert chosen(tmp_path, 0.38).parent.name == "steep"  # unknown angles: the GSD decides


def test_azimuths_wrap_and_the_sun_counts(tmp_path):
    add(tmp_path, "-a", view_azimuth=[350, 20], view_elevation=[50, 90])
    add(tmp_path, "-b", view_azimuth=[160, 200], view_elevation=[50, 90], sun_elevation=[50, 70])
    add(tmp_path, "-c", view_azimuth=[160, 200], view_elevation=[50, 90], sun_elevation=[20, 40])
    assert chosen(tmp_path, 0.38, (5, 60)).stem == "sections-a"
    assert chosen(tmp_path, 0.38, (181, 60), (150, 60)).stem == "sections-b"
    assert chosen(tmp_path, 0.38, (181, 60), (150, 30)).stem == "sections-c"


def test_the_more_special_of_two_that_cover(tmp_path):
    add(tmp_path, "-all", view_elevation=[45, 90], view_azimuth=[0, 360])
    add(tmp_path, "-one", view_elevation=[55, 63], view_azimuth=[171, 191])
    assert chosen(tmp_path, 0.38, (181.1, 59.3)).stem == "sections-one"
    assert chosen(tmp_path, 0.38, (90, 59.3)).stem == "sections-all"
    assert chosen(tmp_path, 0.38).stem == "sections-all"  # seen from nobody knows where


def test_a_scene_gets_the_set_for_what_is_known_of_it(tmp_path):
    add(tmp_path, "-told")
    add(tmp_path, "-sun", untold=["view"])
    add(tmp_path, "-none", untold=["view", "sun"])
    assert chosen(tmp_path, 0.38).stem == "sections-none"
    assert chosen(tmp_path, 0.38, None, (150, 40)).stem == "sections-sun"
    assert chosen(tmp_path, 0.38, (181, 60), (150, 40)).stem == "sections-told"
    assert chosen(tmp_path, 0.38, (181, 60)).stem == "sections-told"
    add(tmp_path, "-fine", gsd=0.25)
    assert chosen(tmp_path, 0.25).stem == "sections-fine"  # the GSD comes first


def test_a_single_set_and_none(tmp_path):
    with pytest.raises(contract.NotAModel, match="no model at"):
        suite.sets(tmp_path / "nowhere", PAIR)
    toy.sections_model(tmp_path / "sections.onnx")
    with pytest.raises(contract.NotAModel, match=r"corners\.onnx"):
        suite.sets(tmp_path, PAIR)
    toy.both_model(tmp_path / "both.onnx")
    with pytest.raises(contract.NotAModel, match="method=single"):
        suite.sets(tmp_path, PAIR)
    (only,) = suite.sets(tmp_path, ("both",))
    assert only["both"].contract["task"] == "both"


def test_a_set_that_disagrees_with_itself_is_refused(tmp_path):
    add(tmp_path, "")
    toy.corners_model(tmp_path / "corners.onnx", toy.contract("corners", gsd=0.5))
    with pytest.raises(contract.ContractMismatch, match="disagree"):
        suite.sets(tmp_path, PAIR)


def test_who_asks_for_one_model_where_a_pair_is_is_told(tmp_path):
    toy.models(tmp_path)
    with pytest.raises(contract.NotAModel, match="method=two_stage"):
        suite.sets(tmp_path, ("both",))
