"""A policy learned from tiles whose law is known joins as the law says; a model gets it and decodes by it."""

import numpy as np
import pytest
import toy

from kibs_steps import photographs
from kibs_steps.learn import joins
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import heads, joining, perceptron, scoring

THRESHOLDS = {"roof": 0.5, "min_area": 6}


def tile(seed):
    """Rows of houses cut into summits at random; only some cuts have an edge, and those alone part sections: maps, sample."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((96, 96), np.int32)
    roof, edge, distance = np.zeros((3, 96, 96))
    for top in range(4, 90, 18):
        col, label = 4, int(labels.max()) + 1
        while col < 84:
            width = int(rng.integers(6, 12))
            part = np.s_[top : top + 12, col : col + width]
            labels[part], roof[part], distance[part] = label, 1, 0.8
            cut = np.s_[top : top + 12, col + width - 1 : col + width + 1]
            distance[part] += 0.2 * rng.random()
            distance[cut] = 0.5
            if rng.random() < 0.5:
                edge[cut], label = 0.4, label + 1
            col += width
        distance[:, col:][top : top + 12] = edge[:, col:][top : top + 12] = 0
    maps = {"roof": roof[None], "edge": (edge * roof)[None], "distance": (distance * roof)[None]}
    sample = Sample.ground(rng.integers(0, 256, (96, 96, 3), dtype=np.uint8))
    return maps, sample._replace(labels=labels, roof=roof.astype(np.uint8))


def test_a_law_is_learned():
    lessons = [joins.lesson(*tile(seed), THRESHOLDS) for seed in range(12)]
    join = joins.policy(lessons, rounds=1, steps=600)
    contracts.validate(toy.contract("sections", join=join), "learned")
    terms = {"head": "dense", "thresholds": THRESHOLDS, "join": join}
    right = asked = 0
    for seed in range(100, 104):
        maps, sample = tile(seed)
        found = heads.decode_sections(maps, terms, sample.rgb).labels
        for label in range(1, sample.labels.max() + 1):
            own = sample.labels == label
            best = np.bincount(found[own]).argmax()
            right += best > 0 and (own & (found == best)).sum() / (own | (found == best)).sum() > 0.8
            asked += 1
    assert asked > 60
    assert right / asked > 0.9
    again = joins.policy(lessons, rounds=1, steps=600)
    assert again == join


def test_ground_and_unknown_neighbours_teach_nothing():
    maps, sample = tile(0)
    basins = joins.lesson(maps, sample, THRESHOLDS)
    assert len(joins.met([basins], None).one) > 20
    for value in (0, -1):
        other = sample._replace(labels=np.full_like(sample.labels, value))
        assert not len(joins.met([joins.lesson(maps, other, THRESHOLDS)], None).one)
    with pytest.raises(joins.NothingToJoin, match="no two basins"):
        joins.policy([])


def test_small_basins_weigh_less():
    basins = np.zeros((40, 40), int)
    basins[:30, :20], basins[:30, 20:], basins[30:34, :4] = 1, 2, 3
    flat = np.zeros((1, *basins.shape))
    graph = joining.graph(basins, np.zeros((40, 40, 3), np.uint8), {"roof": flat, "edge": flat}, flat[0])
    shares = np.array([[0, 0, 600.0], [0, 0, 600.0], [0, 0, 16.0]])
    pairs = joins.met([joins.Lesson(graph, shares)], None)
    np.testing.assert_allclose(pairs.weight, [20.0, 4.0])
    assert pairs.one.all()


def test_a_model_that_finds_nothing_stays_as_it_is(tmp_path, capsys):
    terms = toy.contract("sections", thresholds={"roof": 1.1, "prominence": 0.2, "min_area": 6})
    path = toy.save(*toy.section_parts(), tmp_path / "sections.onnx", terms)
    before = path.read_bytes()
    joins.main([f"--model={path}", "--scenes=1"])
    assert path.read_bytes() == before
    assert "stays as it is: no two basins" in capsys.readouterr().out


def red_roofs(contract, number, stock):
    """A scene that the toy model can see: three roofs, each of two colours, of which one is one section and two are two."""
    rng = np.random.default_rng(number)
    rgb = np.full((64, 64, 3), 60, np.uint8)
    labels = np.zeros((64, 64), np.int32)
    for row in (4, 24, 44):
        for k, col in enumerate((6, 26)):
            part = np.s_[row : row + 14, col : col + 20]
            rgb[part] = (200, 10 + 40 * k + rng.integers(20), 0)
            labels[part] = 2 * row + (k if row > 4 else 0)
    sample = Sample.ground(rgb)
    return sample._replace(labels=labels, roof=(labels > 0).astype(np.uint8))


def test_a_model_learns_to_join(tmp_path, monkeypatch):
    monkeypatch.setattr(joins, "scene", red_roofs)
    path = tmp_path / "set" / "sections.onnx"
    toy.models(tmp_path / "set")
    before = contracts.load(path, "sections")
    joins.main([f"--model={path}", "--scenes=4", "--steps=100"])
    after = contracts.load(path, "sections")
    lower = {**before.contract, "thresholds": {**before.contract["thresholds"], "prominence": joins.PROMINENCE}}
    assert {k: v for k, v in after.contract.items() if k not in ("join", "score")} == lower
    assert perceptron.leads(after.contract["join"], len(joining.TRAITS))
    assert perceptron.leads(after.contract["score"], len(scoring.TRAITS))
    assert after.sha256 != before.sha256


def test_of_four_scenes_one_shows_photographs():
    graph = photographs.RoofGraph(
        "a_1", np.full((60, 60, 3), 200, np.uint8), np.array([[10.0, 10], [50, 10], [50, 50], [10, 50]]), [np.arange(4)]
    )
    chip = photographs.Chip("inria/a", np.full((200, 200, 3), 90, np.uint8), np.zeros((200, 200), bool), 0.3)
    terms = toy.contract("sections", tile=128)
    stock = joins.Stock(graphs=[graph] * 5, chips=[chip])
    shown = [joins.scene(terms, number, stock) for number in range(8)]
    assert [(sample.labels < 0).any() for sample in shown] == [False, False, False, True] * 2
    assert (shown[3].labels > 0).any()
    again = joins.scene(terms, 3, stock)
    np.testing.assert_array_equal(again.rgb, shown[3].rgb)
    assert not any((joins.scene(terms, number).labels < 0).any() for number in range(4))


def test_scenes_are_seen_as_the_model_is_told():
    terms = toy.contract("sections", tile=64)
    terms["trained_on"] |= {"view_azimuth": [350.0, 10.0], "view_elevation": [60.0, 66.0]}
    leans = np.array([joins.scene(terms, number).geometry[:2] for number in range(6)])
    known = leans[leans.any(axis=1)]
    assert len(known) >= 3
    elevation = np.degrees(np.arctan2(1 / toy.GSD, np.hypot(*known.T)))
    np.testing.assert_allclose(elevation, 63, atol=9)  # the GSD varies a little too
    # Roofs seen from the north lean to the south, which is down.
    assert (known[:, 1] > 2 * np.abs(known[:, 0])).all()


def test_a_model_for_views_from_above_is_shown_no_others():
    terms = toy.contract("sections", tile=64)
    terms["trained_on"] |= {"view_azimuth": [0.0, 360.0], "view_elevation": [85.0, 90.0]}
    leans = np.array([joins.scene(terms, number).geometry[:2] for number in range(6)])
    assert leans.any()
    assert np.hypot(*leans.T).max() * toy.GSD < 1.2 * np.tan(np.radians(5))  # the GSD varies a little too
