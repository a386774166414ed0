"""Lifts learned: the contract's network is the one that was trained; what walls say is learned; a model gets its `walls`."""

import numpy as np
import onnx
import pytest

from kibs_steps import view

torch = pytest.importorskip("torch", reason="learning needs the extra `learn` (torch)")

from kibs_steps.learn import augmentation, dataset, examples, export, lifting, training  # noqa: E402
from kibs_steps.models import contract as contracts  # noqa: E402
from kibs_steps.models import walls  # noqa: E402


def test_the_contracts_network_is_the_one_that_was_trained():
    torch.manual_seed(3)
    network = lifting.Network()
    random = np.random.default_rng(0)
    along = random.normal(size=(5, walls.TRAITS, len(walls.OFFSETS))).astype(np.float32)
    whole = random.normal(size=(5, walls.WHOLE)).astype(np.float32)
    with torch.no_grad():
        expected = torch.softmax(network(torch.from_numpy(along), torch.from_numpy(whole)), dim=1).numpy()
    terms = network.terms()
    assert walls.leads(terms)
    none = np.zeros(5, np.int64)
    found = walls.likely(walls.Traits(none, along, whole, none, np.zeros((1, 1), np.float32)), terms)
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_where_walls_end_is_learned():
    random = np.random.default_rng(1)
    n = 3000
    lift = random.uniform(-8, 8, n)
    along = random.normal(0, 0.1, (n, walls.TRAITS, len(walls.OFFSETS)))
    at = np.rint((lift - walls.OFFSETS[0]) / walls.STEP).astype(int)
    along[np.arange(n), walls.KINDS + 2, at] += 1
    lesson = lifting.Lesson(along, np.zeros((n, walls.WHOLE)), lift, np.ones(n))
    terms = lifting.learned(lesson, rounds=8)
    none = np.zeros(n, np.int64)
    seen = walls.Traits(none, along, np.zeros((n, walls.WHOLE)), none, np.zeros((1, 1), np.float32))
    assert np.abs(walls.medians(walls.likely(seen, terms)) - lift).mean() < 0.6


@pytest.fixture
def untrained(tmp_path):
    """A model for corners with tiles of 128 px that has learned nothing."""
    torch.manual_seed(0)
    terms = export.contract_of("corners", (6.0, 4.0)) | {"tile": 128, "margin": 16}
    export.export(training.network("corners"), tmp_path / "corners.onnx", terms)
    return tmp_path / "corners.onnx"


def test_a_model_gets_its_walls(untrained, monkeypatch, capsys):
    monkeypatch.setattr(lifting, "FEW", 10)
    lifting.main([f"--model={untrained}", "--tiles=3"])  # the second is seen from above
    assert "lifts learned on 2 tiles" in capsys.readouterr().out
    found = contracts.load(untrained, "corners").contract
    assert walls.leads(found["walls"])
    with pytest.raises(contracts.ContractMismatch, match="walls: its layers do not lead"):
        contracts.validate({**found, "walls": {**found["walls"], "bias": [0.0]}}, "it")
    proto = onnx.load(untrained)
    del proto.graph.output[[output.name for output in proto.graph.output].index("surface")]
    onnx.save(proto, untrained)
    with pytest.raises(contracts.ContractMismatch, match="need its output `surface`"):
        contracts.load(untrained, "corners")


def test_tiles_that_teach_nothing_leave_a_model_as_it_is(untrained, tmp_path, capsys):
    (tmp_path / "pool").mkdir()
    lifting.main([f"--model={untrained}", f"--pool={tmp_path / 'pool'}"])
    assert "stays as it is: 0 tiles with 0 sections" in capsys.readouterr().out
    assert "walls" not in contracts.load(untrained, "corners").contract


def test_a_pool_gives_the_tiles_in_which_roofs_are_known_to_lean(tmp_path):
    random = np.random.default_rng(0)
    for number in range(4):
        sample = dataset.simulated(random, 64, view=(100.0, 60.0 if number < 3 else 90.0))
        if number == 0:
            sample = augmentation.without_geometry(sample, random, (1.0, 0.0))
        sample.save(tmp_path / f"{number}.npz")
    found = list(lifting.tiles(str(tmp_path), 3, {}, ()))
    assert len(found) == 2
    assert all(np.hypot(*sample.geometry[:2]) > 1 for sample in found)


def test_without_a_pool_tiles_are_seen_as_the_contract_says():
    contract = {"tile": 64, "gsd": 0.38, "trained_on": {"view_azimuth": [98.0, 102.0], "view_elevation": [58.0, 62.0]}}
    for sample in lifting.tiles(None, 2, contract, ()):  # some degrees about it
        east, north = view.lean(100.0, 60.0)
        assert sample.geometry[:2] == pytest.approx([-east / 0.38, north / 0.38], abs=0.15)


def test_a_lesson_tells_how_much_higher_a_section_stands_than_the_height_map_says(monkeypatch):
    sample = dataset.simulated(np.random.default_rng(4), 96, view=(100.0, 60.0))
    monkeypatch.setattr(examples, "supposed", lambda sample, rng: np.maximum(sample.labels, 0).astype(np.int32))
    edges = np.arange(0.0, 31.0)
    heights = {"edges": edges.tolist(), "centres": (edges[:-1] + 0.5).tolist()}
    kept = {where: [None] * 3 for where in ("inside", "rim", "outside")}
    model = contracts.Model(None, "", {"tile": 128, "heights": heights, "blend": kept})

    def session(geometry):
        surface, height = np.zeros((5, 64, 64), np.float32), np.zeros((30, 32, 32), np.float32)
        surface[walls.GROUND], height[4] = 1, 1  # ground all over, 4.5 m all over
        return lambda rgb: {"surface": surface, "height": height} if len(rgb) == 128 else None

    seen, true = lifting.lessons(sample, model, session, np.random.default_rng(0), unlit=0.0)
    expected = [
        np.nanmedian(sample.height[sample.labels == label]) - 4.5
        for label in np.unique(sample.labels[sample.labels > 0])
        if (sample.labels == label).sum() >= walls.LEAST
    ]
    assert len(expected) > 2
    assert true.lift == pytest.approx(expected, abs=1e-3)
    assert seen.lift.tolist() == true.lift.tolist()
    assert not seen.along[:, walls.WALL].any()
    assert true.along[:, walls.WALL].any()
