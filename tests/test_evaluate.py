"""Metrics against brute force on small images and cases known by hand; the whole step on a toy city."""

import csv
import json

import numpy as np
import pyarrow as pa
import pytest
import rasterio
import shapely
import toy_city as toy
from hypothesis import given, settings
from hypothesis import strategies as st

from kibs_steps import evaluate, metrics, store, sums, truth, view
from kibs_steps.metrics import Corners
from kibs_steps.publish import rasters


def label_images():
    """Two label images of one small shape, with blobs rather than noise."""

    def blobs(seed):
        rng = np.random.default_rng(seed)
        image = np.zeros((24, 30), np.int64)
        for label in range(1, rng.integers(1, 7)):
            r, c = rng.integers(0, 20, 2)
            h, w = rng.integers(2, 12, 2)
            image[r : r + h, c : c + w] = label * 7
        return image

    return st.tuples(st.integers(0, 400).map(blobs), st.integers(0, 400).map(blobs))


def section_scores(true, found, score=None):
    """Section figures of two label images; `score` by predicted id."""
    pairs = metrics.count_pairs(true, found)
    ids = np.unique(found[found > 0])
    scores = np.array([(score or {}).get(int(i), 1.0) for i in ids])
    over = metrics.overlaps(pairs, scores)
    return metrics.section_figures(over, scores, np.ones(len(over.truth), bool), np.ones(len(ids), bool))


@given(label_images())
@settings(max_examples=60, deadline=None)
def test_pixels_and_sections_against_brute_force(images):
    true, found = images
    pixels = metrics.pixel_figures(metrics.count_pairs(true, found))
    t, f = true > 0, found > 0

    def share(part, whole):
        return pytest.approx(part.sum() / whole.sum()) if whole.any() else None

    assert pixels["iou"] == share(t & f, t | f)
    assert pixels["precision"] == share(t & f, f)
    assert pixels["paper_iou"] == pixels["recall"] == share(t & f, t)

    best, quality, hits = [], 0.0, 0
    ids_t, ids_f = np.unique(true[t]), np.unique(found[f])
    for i in ids_t:
        ious = [((true == i) & (found == j)).sum() / ((true == i) | (found == j)).sum() for j in ids_f]
        best.append(max(ious, default=0.0))
        if best[-1] > 0.5:
            hits, quality = hits + 1, quality + best[-1]
    figures = section_scores(true, found)
    assert figures["mean_best_iou"] == (pytest.approx(np.mean(best)) if best else None)
    if 0.5 not in best and len(ids_t) + len(ids_f):
        pq = quality / (hits + (len(ids_f) - hits) / 2 + (len(ids_t) - hits) / 2)
        assert figures["matched"] == hits
        assert figures["pq"] == pytest.approx(pq)
        assert figures["sq"] is None or figures["pq"] == pytest.approx(figures["sq"] * figures["rq"])


def test_perfect_sections():
    image = np.zeros((20, 20), int)
    image[2:8, 2:8], image[10:18, 3:15] = 5, 9
    figures = section_scores(image, image * 3)
    assert (figures["ap50"], figures["mean_best_iou"], figures["pq"]) == (1.0, 1.0, 1.0)


def test_calling_everything_roof_pleases_the_papers_iou_alone():
    true = np.zeros((100, 100), int)
    true[:20, :70] = 1
    pixels = metrics.pixel_figures(metrics.count_pairs(true, np.ones_like(true)))
    assert pixels["paper_iou"] == 1.0
    assert pixels["iou"] == pytest.approx(0.14)


def test_a_shifted_square():
    true, found = np.zeros((40, 40), int), np.zeros((40, 40), int)
    true[10:20, 10:20], found[10:20, 13:23] = 1, 4
    figures = section_scores(true, found)
    assert figures["mean_best_iou"] == pytest.approx(70 / 130)
    assert figures["pq"] == pytest.approx(70 / 130)
    found = np.roll(found, 1, axis=1)  # IoU 60/140 < 0.5
    assert section_scores(true, found)["pq"] == 0.0


def test_average_precision_by_hand():
    """Three sections; found in order of score: right, wrong, right. Precision envelope 1 up to recall 1/3, 2/3 up to 2/3."""
    true, found = np.zeros((10, 40), int), np.zeros((10, 40), int)
    true[:, 0:5], true[:, 10:15], true[:, 20:25] = 1, 2, 3
    found[:, 0:5], found[:, 30:35], found[:, 10:15] = 1, 2, 3
    figures = section_scores(true, found, {1: 0.9, 2: 0.8, 3: 0.7})
    assert figures["ap50"] == pytest.approx((34 * 1.0 + 33 * 2 / 3) / 101)


def test_merged_windows_are_the_whole():
    rng = np.random.default_rng(1)
    true, found = rng.integers(0, 5, (60, 50)), rng.integers(0, 9, (60, 50))
    parts = [metrics.count_pairs(true[r : r + 16, c : c + 16], found[r : r + 16, c : c + 16]) for r in range(0, 60, 16)
             for c in range(0, 50, 16)]  # fmt: skip
    for one, other in zip(metrics.merge_pairs(parts), metrics.count_pairs(true, found), strict=True):
        np.testing.assert_array_equal(one, other)


@given(st.integers(0, 10_000), st.floats(0.01, 8.0), st.floats(-5.0, 5.0))
@settings(max_examples=40, deadline=None)
def test_height_errors_against_numpy(seed, spread, bias):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 3000))
    true = rng.uniform(0, 30, n)
    found = true + rng.normal(bias, spread, n)
    group = rng.integers(0, 4, n)
    figures = metrics.height_figures(metrics.tally(group, found, true, 6.1, 4).of(np.s_[:]))
    error = found - true
    assert figures["pixels"] == n
    assert figures["mae"] == pytest.approx(np.abs(error).mean())
    assert figures["rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert figures["bias"] == pytest.approx(error.mean())
    assert figures["mse"] >= figures["mae"] ** 2 * (1 - 1e-9)
    rounded = np.rint(error * 100) / 100
    assert figures["le90"] == pytest.approx(np.quantile(np.abs(rounded), 0.9, method="inverted_cdf"), abs=1e-9)
    median = np.quantile(rounded, 0.5, method="inverted_cdf")
    nmad = 1.4826 * np.quantile(np.abs(rounded - median), 0.5, method="inverted_cdf")
    assert figures["nmad"] == pytest.approx(nmad, abs=1e-9)
    tall = true > 1
    if tall.any():
        mape = 100 * (np.abs(error[tall]) / true[tall]).mean()
        assert figures["mape"] == pytest.approx(mape)
        assert figures["paper_accuracy"] == pytest.approx(100 - mape)
    assert figures["baseline_mae"] == pytest.approx(np.abs(6.1 - true).mean())
    one = metrics.height_figures(metrics.tally(group, found, true, 6.1, 4).of(np.array([2])))
    assert one["pixels"] == (group == 2).sum()


def test_impossible_figures_are_refused():
    errors = metrics.tally(np.zeros(3, int), np.array([1.0, 2, 3]), np.zeros(3) + 2, 6.1, 1)
    with pytest.raises(metrics.ImpossibleFigures):
        metrics.height_figures(errors._replace(square=errors.square * 0.5))


def test_plane_errors_by_hand():
    """One plane 5° too steep, one turned by 90° across north, one level: its azimuth is not asked."""
    steep = [np.tan(np.radians(angle)) for angle in (30, 35, 20)]
    true = np.array([[steep[0], 0], [steep[2], 0], [0, 0]])
    found = np.array([[steep[1], 0], [0, steep[2]], [0, 0]])
    figures = metrics.plane_figures(true, found)
    assert figures["slope_mae"] == pytest.approx(5 / 3)
    assert figures["azimuth_sections"] == 2
    assert figures["azimuth_mae"] == pytest.approx(45)
    turned = np.degrees(np.arccos(np.cos(np.radians(20)) ** 2))
    assert figures["normal_mae"] == pytest.approx((5 + turned) / 3)


def test_azimuths_across_north():
    g = [-np.array([np.sin(np.radians(a)), np.cos(np.radians(a))]) for a in (359, 2)]
    assert metrics.plane_figures(np.array([g[0]]), np.array([g[1]]))["azimuth_mae"] == pytest.approx(3)


def corners(points, heights, seen=True):
    return Corners(np.array(points, float), np.array(heights, float), np.broadcast_to(seen, len(heights)))


def test_corners_each_once():
    true = corners([[10, 10], [20, 10], [30, 10], [50, 50]], [5, 5, 8, 8])
    found = corners([[10, 11], [10.5, 10], [20, 12.5], [30, 10]], [4, 6, 5, 8.5])
    figures = metrics.corner_figures(true, found)
    assert figures["matched"] == 2
    assert (figures["precision"], figures["recall"]) == (0.5, 0.5)
    assert figures["position_mae_px"] == pytest.approx(0.25)
    assert figures["height_mae"] == pytest.approx(0.75)


def test_hidden_corners_neither_count_nor_harm():
    true = corners([[10, 10], [20, 10], [30, 10]], [5, 5, 5], [True, False, False])
    figures = metrics.corner_figures(true, corners([[10, 10], [20, 10], [40, 10]], [5, 5, 5]))
    assert (figures["truth"], figures["predicted"], figures["matched"]) == (1, 2, 1)


def test_shared_corners_are_one():
    shared = metrics.merge_corners(
        corners([[1, 1], [1.2, 1], [1, 1], [9, 9]], [5, 5, 9, 5], [False, True, False, False])
    )
    assert len(shared.height) == 3
    assert shared.seen.sum() == 1


def test_a_corner_filed_to_two_sections_is_one(tmp_path):
    """Each section is lifted by itself, so that a corner may stand at two heights."""
    rows = {"col": [1.5, 1.5, 7.0], "row": [2.0, 2.0, 2.0], "height": [5.0, 6.0, 3.0]}
    store.write_table(tmp_path / "filed.parquet", pa.table(rows))
    found = evaluate.read_corners([tmp_path / "filed.parquet"])
    assert found.place.tolist() == [[1.5, 2.0], [7.0, 2.0]]
    assert found.height.tolist() == [5.5, 3.0]


def run(folder, scene, found=None, true=None, **extra):
    """Publish the found roofs, evaluate against the true ones; return the figures."""
    store.write_table(folder / "buildings.parquet", toy.buildings_table(scene, found))
    store.write_table(folder / "truth.parquet", toy.truth_table(scene, true))
    files = {"labels": folder / "labels.tif", "heights": folder / "heights.tif"}
    common = ["--scene", scene.folder / "scene.json", "--sections", folder / "buildings.parquet"]
    common += ["--labels", files["labels"], "--heights", files["heights"]]
    rasters.main([str(a) for a in common])
    more = [
        "--truth",
        folder / "truth.parquet",
        "--out",
        folder / "evaluation.json",
        "--table",
        folder / "evaluation.csv",
    ]
    more += ["--picture", folder / "evaluation.png"]
    for name, value in extra.items():
        more += [f"--{name}", value]
    evaluate.main([str(a) for a in common + more])
    return json.loads((folder / "evaluation.json").read_text())


def filed_corners(folder, scene, shift=0.0):
    """A corner table with the truth's vertices, shifted by `shift` px."""
    import pyarrow as pa

    points = np.concatenate(
        [shapely.get_coordinates(toy.seen_outline(scene, o), include_z=True) for *_, o in toy.roofs()]
    )
    store.write_table(
        folder / "corners.parquet", pa.table({"col": points[:, 0] + shift, "row": points[:, 1], "height": points[:, 2]})
    )
    return folder / "corners.parquet"


def test_a_perfect_run(tmp_path, capsys):
    """Truth given back scores 1 wherever nothing is hidden; the shed's hidden part is nobody's miss."""
    scene = toy.make_scene(tmp_path)
    figures = run(tmp_path, scene, corners=filed_corners(tmp_path, scene))
    assert figures["pixels"]["all"]["recall"] > 0.99
    assert figures["sections"]["all"]["ap50"] == 1.0
    assert figures["sections"]["all"]["pq"] > 0.9
    assert figures["heights"]["found"]["all"]["mae"] < 0.01
    assert figures["planes"]["all"]["slope_mae"] < 1e-6
    assert figures["planes"]["all"]["azimuth_mae"] < 1e-6
    assert figures["corners"]["recall"] == 1.0
    by_split = [figures["heights"]["found"][name]["pixels"] for name in evaluate.SPLITS]
    assert sum(by_split) == figures["heights"]["found"]["all"]["pixels"]
    by_bin = [figures["heights"]["all_truth"][name]["pixels"] for name in evaluate.bin_names()]
    assert sum(by_bin) == figures["heights"]["all_truth"]["all"]["pixels"]
    assert figures["paper"]["mourmelon"]["mse"] == [1.99, 2.51, 2.35]
    assert "IoU" in capsys.readouterr().out
    table = list(csv.DictReader((tmp_path / "evaluation.csv").open()))
    assert [row["group"] for row in table][:4] == ["all", *evaluate.SPLITS]
    assert float(table[0]["pixels_iou"]) == figures["pixels"]["all"]["iou"]


def test_a_roof_too_high_and_a_roof_missed(tmp_path):
    """The block found 2 m too high, the gable's south side missed: errors on found pixels, and all misses counted as 0."""
    scene = toy.make_scene(tmp_path, direction=None)
    up = [(i, b, shapely.transform(o, lambda p: p + np.array([0, 0, 2.0]), include_z=True)) if i == 13 else (i, b, o)
          for i, b, o in toy.roofs() if i != 12]  # fmt: skip
    figures = run(tmp_path, scene, found=up)
    everything = truth.read(tmp_path / "truth.parquet", scene)
    labels, heights = truth.visible_labels(everything, scene, rasters_window(scene))
    found = figures["heights"]["found"]["all"]
    n = {i: (labels == i).sum() for i in (11, 12, 13, 14)}
    assert found["pixels"] == n[11] + n[13] + n[14]
    assert found["bias"] == pytest.approx(2 * n[13] / found["pixels"], abs=1e-4)
    misses = heights[labels == 12].astype(float)
    everything = figures["heights"]["all_truth"]["all"]
    assert everything["mae"] == pytest.approx((2 * n[13] + misses.sum()) / sum(n.values()), abs=1e-4)
    assert figures["sections"]["all"]["matched"] == 3
    assert figures["pixels"]["all"]["false_negative"] == n[12]


def rasters_window(scene):
    from kibs_steps.grid import Window

    return Window(0, 0, scene.grid.width, scene.grid.height)


def test_same_bytes_twice_and_windows_do_not_matter(tmp_path, monkeypatch):
    scene = toy.make_scene(tmp_path)
    run(tmp_path, scene)
    names = ("evaluation.json", "evaluation.csv", "evaluation.png")
    first = [(tmp_path / name).read_bytes() for name in names]
    monkeypatch.setattr(evaluate, "SIDE", 101)
    figures = run(tmp_path, scene)
    whole = json.loads(first[0])
    assert figures["pixels"] == whole["pixels"]
    assert figures["sections"] == whole["sections"]
    assert figures["heights"]["found"]["all"]["mae"] == pytest.approx(whole["heights"]["found"]["all"]["mae"])
    monkeypatch.undo()
    run(tmp_path, scene)
    assert first == [(tmp_path / name).read_bytes() for name in names]


def test_nothing_found(tmp_path):
    import pyarrow as pa

    scene = toy.make_scene(tmp_path)
    run(tmp_path, scene)
    empty = store.read_table(tmp_path / "buildings.parquet").slice(0, 0)
    store.write_table(tmp_path / "buildings.parquet", pa.table(empty))
    for name, fill in (("labels.tif", 0), ("heights.tif", np.nan)):
        with rasterio.open(tmp_path / name) as file:
            profile, shape = file.profile, file.shape
        profile.update(driver="GTiff")
        with rasterio.open(tmp_path / name, "w", **profile) as file:
            file.write(np.full(shape, fill, profile["dtype"]), 1)
        sums.place(tmp_path / name).unlink()
    arguments = ["--scene", scene.folder / "scene.json", "--sections", tmp_path / "buildings.parquet"]
    arguments += ["--labels", tmp_path / "labels.tif", "--heights", tmp_path / "heights.tif"]
    arguments += ["--truth", tmp_path / "truth.parquet", "--out", tmp_path / "evaluation.json"]
    evaluate.main([str(a) for a in arguments])
    figures = json.loads((tmp_path / "evaluation.json").read_text())
    assert figures["pixels"]["all"]["iou"] == 0.0
    assert figures["sections"]["all"]["ap50"] == 0.0
    assert figures["heights"]["found"]["all"] == {"pixels": 0}
    assert figures["heights"]["all_truth"]["all"]["mae"] == pytest.approx(
        figures["heights"]["all_truth"]["all"]["mean_height"]
    )


def test_rasters_of_another_scene_are_refused(tmp_path):
    scene = toy.make_scene(tmp_path)
    run(tmp_path, scene)
    other = toy.make_scene(tmp_path / "other", size=(100, 90))
    sections = truth.read(tmp_path / "truth.parquet", other)
    with pytest.raises(evaluate.RastersDisagree, match="100×90"):
        evaluate.read_through(other, sections, str(tmp_path / "labels.tif"), str(tmp_path / "heights.tif"), 6.1, 100)


def test_slope_errors_do_not_depend_on_the_view(tmp_path):
    """A section whose plane is right in the map frame has no slope error, though its seen outline is sheared."""
    for name, direction in (("north", (10.0, 55.0)), ("south", (190.0, 55.0))):
        scene = toy.make_scene(tmp_path / name, direction=direction)
        figures = run(tmp_path / name, scene, found=toy.roofs()[:2], true=toy.roofs()[:2])
        assert figures["planes"]["all"]["sections"] == 2
        assert figures["planes"]["all"]["normal_mae"] < 1e-4
        assert abs(scene.lean[1]) == pytest.approx(abs(view.lean(*direction)[1]))


def test_relative_figures_by_hand():
    """2 and 4 m found as 3 and 4; the baseline answers 6 everywhere."""
    zero = np.zeros(2, int)
    figures = metrics.height_figures(metrics.tally(zero, np.array([3.0, 4.0]), np.array([2.0, 4.0]), 6.0, 1))
    assert (figures["mae"], figures["baseline_mae"], figures["mean_height"]) == (0.5, 3.0, 3.0)
    assert figures["mae_to_baseline"] == pytest.approx(0.5 / 3)
    assert (figures["mape"], figures["paper_difference"]) == (pytest.approx(25), pytest.approx(0.25 * 3))


def test_errors_beyond_a_hundred_metres_stay_in_their_group():
    errors = metrics.tally(np.array([0, 1]), np.array([160.0, 5.0]), np.array([5.0, 5.0]), 6.1, 2)
    assert errors.histogram.sum(axis=1).tolist() == [1, 1]
    figures = metrics.height_figures(errors.of(np.array([0])))
    assert (figures["mae"], figures["le90"]) == (155.0, 100.0)


def test_biases_have_the_sign_of_found_less_true_and_medians_are_no_means():
    steep = np.tan(np.radians([[30.0], [20.0], [20.0]])) * [1.0, 0.0]
    found = np.tan(np.radians([[33.0], [20.0], [20.0]])) * [1.0, 0.0]
    figures = metrics.plane_figures(steep, found)
    assert figures["slope_bias"] == pytest.approx(1.0)
    assert (figures["normal_median"], figures["azimuth_median"]) == pytest.approx((0.0, 0.0), abs=1e-5)
    high = metrics.corner_figures(corners([[10, 10], [20, 10]], [5, 5]), corners([[10, 10], [20, 10]], [6, 5]))
    assert high["height_bias"] == pytest.approx(0.5)


def test_of_two_halves_of_a_section_the_better_score_is_the_match():
    true, found = np.zeros((10, 10), int), np.zeros((10, 10), int)
    true[:], found[:, :5], found[:, 5:] = 1, 5, 6
    assert section_scores(true, found, {5: 0.3, 6: 0.9})["ap50"] == 1.0
    assert section_scores(true, found, {5: 0.9, 6: 0.3})["ap50"] == 1.0


def test_what_is_found_counts_in_the_split_of_the_truth_it_overlaps():
    """Predictions know no split; what overlaps nothing is testing's."""
    square = np.array([shapely.Polygon([(0, 0, 5), (4, 0, 5), (4, 4, 5), (0, 4, 5)])] * 3)
    sections = truth.Truth(np.array([1, 2, 9]), np.array([0, 1, 0]), square, square, np.zeros((3, 4)))
    ok = np.array(["ok"] * 3, object)
    predicted = metrics.Predicted(np.array([5, 6, 7]), np.ones(3), np.full(3, 2), np.zeros((3, 2)), ok)
    pairs = metrics.Pairs(np.array([1, 2, 0]), np.array([5, 6, 7]), np.array([10, 20, 30]))
    nothing = metrics.no_errors(len(evaluate.SPLITS) * len(evaluate.HEIGHT_EDGES))
    reading = evaluate.Reading(pairs, nothing, nothing, corners(np.zeros((0, 2)), []), None, None, None)
    figures = evaluate.evaluation(reading, sections, predicted, None, 6.1)
    counted = [tuple(figures["sections"][s][k] for k in ("truth", "predicted", "matched")) for s in evaluate.SPLITS]
    assert counted == [(1, 1, 1), (1, 1, 1), (0, 1, 0)]
    assert [figures["pixels"][s]["true_positive"] for s in evaluate.SPLITS] == [10, 20, 0]
    assert [figures["pixels"][s]["false_positive"] for s in evaluate.SPLITS] == [0, 0, 30]
    assert figures["sections"]["all"]["hidden"] == 1  # the truth section 9 shows nowhere


def test_heights_are_counted_in_their_own_bin(tmp_path):
    scene = toy.make_scene(tmp_path, direction=None)
    figures = run(tmp_path, scene)["heights"]["all_truth"]
    _, heights = truth.visible_labels(truth.read(tmp_path / "truth.parquet", scene), scene, rasters_window(scene))
    expected = np.histogram(heights[np.isfinite(heights)], [*evaluate.HEIGHT_EDGES, np.inf])[0]
    assert np.count_nonzero(expected) > 3
    assert [figures[name]["pixels"] for name in evaluate.bin_names()] == expected.tolist()
