"""What a run learns from, and what its contract then says."""

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from kibs_steps import photographs, store
from kibs_steps.learn import dataset, sources
from kibs_steps.learn.samples import Sample

ROOT = Path(__file__).parents[2]


def arguments(*words):
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", default="runs/x/both")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--init")
    sources.add_arguments(parser)
    return parser.parse_args(list(words))


def own(folder, view=(120.0, 65.0), count=10, mean=5.0, sigma=1.0, gsd=dataset.GSD):
    """A folder as `learn.own` leaves it: four training tiles, one to validate on, the record."""
    for name, n in (("training", 4), ("validation", 1)):
        for i in range(n):
            sample = Sample.ground(np.full((64, 64, 3), 10 * i, np.uint8))
            sample.labels[10:30, 10:40] = 1
            sample.save(folder / name / f"r000c{i:03d}.npz")
    corners = {"count": count, "mean_height": mean, "sigma": sigma}
    record = {"gsd": gsd, "view": view and list(view), "sun": None, "corners": corners}
    store.write_json(folder / "own.json", record)
    return folder


def test_own_samples_alone(tmp_path):
    folder = own(tmp_path / "town")
    found = sources.gather(arguments("--own", str(folder), "--tiles=0", f"--out={tmp_path}/run/both"), 48)
    assert len(found.validation) == 1
    assert found.validation[0].labels.shape == (48, 48)
    assert {tuple(np.unique(found.mixture[i].labels)) for i in range(8)} <= {(0, 1), (0,)}
    assert found.mixture[3].rgb.shape == (48, 48, 3)
    about = found.about
    assert about["licence"] == sources.OWN
    assert about["view_azimuth"] == [117.0, 123.0]
    assert about["view_elevation"] == [62.0, 68.0]
    assert about["sun_azimuth"] is None
    assert about["corner_heights"] == [5.0, 1.0]


def test_own_samples_of_another_gsd_are_refused(tmp_path):
    folder = own(tmp_path / "town", gsd=0.25)
    with pytest.raises(photographs.NoTrainingData, match=r"town holds samples at 0.25 m .* --gsd=0.38"):
        sources.gather(arguments("--own", str(folder), "--tiles=0"), 48)
    assert sources.gather(arguments("--own", str(folder), "--tiles=0", "--gsd=0.25"), 48).validation


def test_who_learns_from_a_models_guesses_is_bound_by_its_licence(tmp_path):
    folder = own(tmp_path / "town")
    record = store.read_json(folder / "own.json")
    store.write_json(folder / "own.json", {**record, "licence": "CC BY-NC 4.0"})
    found = sources.gather(arguments("--own", str(folder), "--tiles=0"), 48)
    assert found.about["licence"] == f"{sources.OWN}; and CC BY-NC 4.0"
    store.write_json(folder / "own.json", {**record, "licence": sources.SIMULATED})
    assert sources.gather(arguments("--own", str(folder), "--tiles=0"), 48).about["licence"] == sources.OWN


def test_own_samples_smaller_than_a_training_tile_are_refused(tmp_path):
    folder = own(tmp_path / "town")
    with pytest.raises(photographs.NoTrainingData, match=r"is 64 px wide, a training tile 192 px.*--tile 192"):
        sources.gather(arguments("--own", str(folder), "--tiles=0"), 192)


def test_tiles_look_like_the_scene_to_fine_tune_for_and_are_told_what_is_known_of_it(tmp_path):
    shown = np.full((3, 64, 64, 3), 200, np.uint8)
    np.save(tmp_path / "far.npy", shown)
    words = ("--own", str(own(tmp_path / "town")), "--tiles=0", f"--look={tmp_path / 'far.npy'}", "--untold", "view")
    found = sources.gather(arguments(*words), 48)
    tiles = [found.mixture[i] for i in range(60)]
    bright = sum(tile.rgb.min() >= 90 for tile in tiles)  # of 0 to 30: more than half way to 200
    assert 28 <= bright <= 52
    assert not any(tile.geometry[4] for tile in tiles)
    assert found.validation[0].rgb.min() >= 90
    assert "made to look like far" in found.about["data"]
    assert found.about["untold"] == ["view"]
    plain = arguments(*words[:3], f"--out={tmp_path}/run/both")
    alike = arguments(*words, f"--out={tmp_path}/run/both")
    assert sources.signature(plain) != sources.signature(alike)


def test_a_third_of_the_tiles_keeps_its_look(tmp_path):
    """Half of them keep their radiometry, and of these the roofs of a third are repainted."""
    mixture = sources.gather(arguments("--own", str(own(tmp_path / "town")), "--tiles=0"), 48).mixture
    looks = [np.unique(mixture[i].rgb) for i in range(80)]
    kept = sum(len(look) == 1 and look[0] in (0, 10, 20, 30) for look in looks)
    assert 20 <= kept <= 44


def test_a_pool_of_other_settings_is_refused(tmp_path):
    def claimed(*words):
        args = arguments(f"--pool={tmp_path / 'pool'}", *words)
        view = sources._direction(args.view_azimuth, args.view_elevation)
        sources._claim(Path(args.pool), args, view, None)

    claimed("--view-azimuth=140", "--view-elevation=50")
    claimed("--view-azimuth=500", "--view-elevation=50")  # the same direction
    with pytest.raises(photographs.NoTrainingData, match=r"pool holds tiles of other settings .* delete it"):
        claimed("--view-azimuth=320", "--view-elevation=65")
    with pytest.raises(photographs.NoTrainingData):
        claimed("--view-azimuth=140", "--view-elevation=50", "--gsd=0.25")
    with pytest.raises(photographs.NoTrainingData):  # its tiles may show the ground of that place
        claimed("--view-azimuth=140", "--view-elevation=50", "--leave-out", "inria")


def test_data_and_weights_make_a_run(tmp_path):
    def signature(*words):
        return sources.signature(arguments("--tiles=5", f"--out={tmp_path / 'run'}", *words))

    (tmp_path / "w.pt").write_bytes(b"weights")
    town = own(tmp_path / "town")
    plain = signature()
    assert plain == signature("--shares=simulated=1")  # how often, not what
    kinds = [plain, signature("--free"), signature(f"--init={tmp_path / 'w.pt'}"), signature("--own", str(town))]
    city = tmp_path / "a.city.json"
    for text in ("one", "other"):  # by what they hold, not by their names
        city.write_text(text)
        kinds.append(signature("--cities", str(city)))
    assert len(set(kinds)) == len(kinds)
    own(tmp_path / "town", count=11)
    changed = signature("--own", str(town))
    (town / "corrected.json").write_text("{}")
    assert len({*kinds, changed, signature("--own", str(town))}) == len(kinds) + 2


def test_the_licence_names_the_owners_of_city_models():
    args = arguments("--cities", "a.city.json")
    assert sources.about(args, True, False, False, None, None)["licence"] == sources.CITIES
    both = sources.about(args, True, True, False, None, None)["licence"]
    assert both == f"{sources.NON_COMMERCIAL}; and {sources.CITIES}"


def test_corner_heights_of_several_data_sets_are_pooled(tmp_path):
    one = own(tmp_path / "a", count=30, mean=4.0, sigma=1.0)
    other = own(tmp_path / "b", view=None, count=10, mean=8.0, sigma=2.0)
    about = sources.gather(arguments("--own", str(one), str(other), "--tiles=0"), 48).about
    values = np.concatenate([np.tile([3.0, 5.0], 15), np.tile([6.0, 10.0], 5)])
    assert about["corner_heights"] == pytest.approx([values.mean(), values.std()])
    assert about["view_elevation"] is None  # one of them does not tell its view


@pytest.mark.parametrize(
    ("shown", "azimuth", "elevation"),
    [
        ([(10.0, 60.0)], [7.0, 13.0], [57.0, 63.0]),
        ([(1.0, 89.0)], [358.0, 4.0], [86.0, 90.0]),
        ([(350.0, 60.0), (20.0, 70.0)], [347.0, 23.0], [57.0, 73.0]),
    ],
)
def test_ranges_span_what_was_shown(shown, azimuth, elevation):
    told = sources.told("view", shown)
    assert told["view_azimuth"] == pytest.approx(azimuth)
    assert told["view_elevation"] == pytest.approx(elevation)


def test_photographs_make_a_model_non_commercial():
    plain = arguments("--tiles=10")
    assert sources.about(plain, True, False, False, None, None)["licence"] == sources.SIMULATED
    assert sources.about(plain, True, True, True, None, None)["licence"] == sources.NON_COMMERCIAL
    assert "view_azimuth" not in sources.about(plain, True, False, False, None, None)
    tuned = sources.about(plain, True, False, False, (181.0, 59.0), None)
    assert tuned["view_elevation"] == [56.0, 62.0]


def test_nothing_to_learn_from_is_said(tmp_path):
    with pytest.raises(photographs.NoTrainingData, match="no training samples"):
        sources.gather(arguments("--own", str(tmp_path), "--tiles=0"), 48)
    with pytest.raises(photographs.NoTrainingData, match="nothing to learn from"):
        sources.gather(arguments("--tiles=0", f"--out={tmp_path}/run/both"), 48)
    with pytest.raises(argparse.ArgumentTypeError, match="no source"):
        sources.shares("simulatd=1")


def chips_in(folder, *places):
    """A data folder with one chip of each place and no roof photographs."""
    for place in places:
        for part in ("images", "gt"):
            (folder / "chips" / place / part).mkdir(parents=True)
            cv2.imwrite(str(folder / "chips" / place / part / "a.png"), np.full((64, 64, 3), 90, np.uint8))
    return folder


def test_free_sources_are_those_anyone_may_use(tmp_path):
    data = chips_in(tmp_path / "data", "inria", "spacenet", "nzlnd")
    options = ("--tiles=0", f"--data={data}", f"--out={tmp_path}/run/both")
    found = sources.gather(arguments("--free", *options), 48)
    assert [chip.name for chip in found.mixture.chips] == ["spacenet/a"]
    assert not found.mixture.graphs
    assert found.about["licence"] == sources.SHARE_ALIKE
    assert found.about["data"] == ["chips with building masks of SpaceNet-2"]
    with pytest.raises(photographs.NoTrainingData, match=r"there is nothing, the shares are simulated 0.62"):
        sources.gather(arguments("--free", *options, "--leave-out", "spacenet"), 48)
    with pytest.raises(photographs.NoTrainingData, match=r"there is chips, the shares are .* chips 0,"):
        sources.gather(arguments("--free", *options, "--shares=chips=0"), 48)
    with pytest.raises(SystemExit):  # a place that is none would be learned from, and is to be tested
        arguments("--leave-out", "inrja")
    schema = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
    places = schema["properties"]["train"]["properties"]["leave_out"]["items"]["enum"]
    assert places == list(photographs.CHIPS)
    with pytest.raises(photographs.NoTrainingData, match="roofgraph"):
        sources.gather(arguments(*options), 48)
