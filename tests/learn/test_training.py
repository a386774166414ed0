"""The loop resumes where it was; losses leave unknown ground alone."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `learn` (torch)")

from kibs_steps.learn import examples, training  # noqa: E402
from kibs_steps.learn.architectures import CHANNELS, Dense  # noqa: E402
from kibs_steps.learn.samples import UNKNOWN, Sample  # noqa: E402
from kibs_steps.models.contract import ContractMismatch  # noqa: E402


class Tiles(torch.utils.data.Dataset):
    """The same house everywhere."""

    def __init__(self):
        sample = Sample.ground(np.full((64, 64, 3), 60, np.uint8))
        sample.rgb[20:40, 10:50] = 200
        sample.labels[20:40, 10:50] = 1
        sample = sample._replace(
            roof=(sample.labels > 0).astype(np.uint8),
            height=np.where(sample.labels > 0, 5.0, np.nan).astype(np.float32),
            corners=np.float32([[10, 20], [50, 20], [50, 40], [10, 40]]),
            corner_heights=np.float32([5, 5, 5, 5]),
        )
        self.sample, self.seen = sample, []

    def __getitem__(self, index):
        self.seen.append(index)
        return examples.example(self.sample, np.random.default_rng(index), blended=bool(index % 2))


SETTINGS = training.Settings(0, size=64, batch=2)


def test_a_killed_run_goes_on_where_it_was(tmp_path):
    tiles = Tiles()
    assert training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=2, workers=0) == 2
    first = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert first["step"] == 2
    model = training.network()
    assert training.train(model, tiles, SETTINGS, tmp_path, 600, steps=3, workers=0) == 3
    second = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert second["step"] == 3
    assert second["seconds"] > first["seconds"]
    assert tiles.seen == list(range(6))  # no tile twice
    assert training.train(model, tiles, SETTINGS, tmp_path, first["seconds"], workers=0) == 3  # budget used up


def test_a_seed_makes_the_same_network(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(training.sources, "gather", lambda *_: training.sources.Sources(None, [], {}))
    monkeypatch.setattr(training, "train", lambda model, *_, **__: made.append(model) or 0)
    monkeypatch.setattr(training.examples, "Examples", lambda *_: None)
    for seed in (0, 0, 1):
        training.main([f"--out={tmp_path / str(len(made))}", f"--seed={seed}", "--tiles=0"])
    first, same, other = (model.state_dict()["maps.0.weight"] for model in made)
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_a_run_of_so_many_steps_ends_at_the_lowest_rate(tmp_path):
    training.train(training.network(), Tiles(), SETTINGS, tmp_path, 6000, steps=8, workers=0)
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert state["optimiser"]["param_groups"][0]["lr"] < 0.1 * SETTINGS.rate


def test_another_run_is_not_overwritten(tmp_path):
    tiles = Tiles()
    training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=1, workers=0)
    with pytest.raises(ContractMismatch, match="another run"):
        training.train(training.network(), tiles, SETTINGS._replace(seed=1), tmp_path, 600, steps=2, workers=0)


def test_a_run_on_other_data_is_another_run(tmp_path):
    tiles = Tiles()
    training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=1, workers=0, sources="one")
    with pytest.raises(ContractMismatch, match="other data"):
        training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=2, workers=0, sources="other")
    assert training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=2, workers=0, sources="one") == 2


def logits() -> dict[str, torch.Tensor]:
    """Blank logits of a 64 px tile, by name, that ask for gradients."""
    sides = {
        "surface": (5, 32),
        "height": (len(training.CENTRES), 16),
        "slope": (2, 16),
        "roof_slope": (2, 16),
        "centre": (2, 16),
    }
    sides |= {name: (channels, 64) for name, channels in CHANNELS.items()}
    return {name: torch.zeros(1, c, side, side, requires_grad=True) for name, (c, side) in sides.items()}


def batch_of(example: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {k: torch.as_tensor(v)[None] for k, v in example.items()}


def test_unknown_ground_gives_no_gradient():
    sample = Tiles().sample
    sample.labels[:, 32:] = -1
    sample.roof[:, 32:] = UNKNOWN
    sample.corners_known[:, 32:] = 0
    sample.height[:, 32:] = np.nan
    sample = sample._replace(corners=sample.corners[::3], corner_heights=sample.corner_heights[::3])
    sample.surface[:, :32] = 0
    raw = logits()
    sum(
        training.losses(raw, batch_of(examples.example(sample, np.random.default_rng(0), False)), "both").values()
    ).backward()
    for name, value in raw.items():
        half = value.shape[-1] // 2
        assert not value.grad[..., half:].any(), name
        assert value.grad[..., :half].any() or "slope" in name, name


def test_blended_tiles_teach_corners_and_heights_only():
    raw = logits()
    sum(
        training.losses(
            raw, batch_of(examples.example(Tiles().sample, np.random.default_rng(0), True)), "both"
        ).values()
    ).backward()
    for name in ("roof", "edge", "distance"):
        assert not raw[name].grad.any(), name
    for name in ("corner", "offset", "height"):
        assert raw[name].grad.any(), name


def test_a_new_run_takes_over_the_weights_of_another(tmp_path):
    training.train(training.network(), Tiles(), SETTINGS, tmp_path, 600, steps=1, workers=0)
    model = training.network("corners")
    training.start_from(model, tmp_path / "checkpoint.pt")
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["average"]
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize("zoom", ["1.3", "-1"])
def test_a_zoom_that_cuts_cells_is_refused(zoom, tmp_path, capsys):
    with pytest.raises(SystemExit):
        training.main([f"--out={tmp_path}", f"--zoom={zoom}", "--tiles=0"])
    assert "it goes by halves" in capsys.readouterr().err


def test_a_tile_that_is_no_whole_number_of_cells_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        training.main([f"--out={tmp_path}", "--task=corners", "--size=200", "--tiles=0"])
    assert "multiple of 32" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("task", "gsd", "zoom"), [("sections", 0.38, 1.5), ("sections", 0.25, 1), ("corners", 0.38, 1)]
)
def test_a_network_for_sections_sees_the_ground_at_a_quarter_metre(task, gsd, zoom):
    assert training.usual_zoom(task, gsd) == zoom


@pytest.mark.parametrize(
    ("task", "gsd", "zoom"), [("sections", 0.38, 2), ("sections", 0.25, 1.5), ("corners", 0.38, 1)]
)
def test_weights_see_the_ground_as_before(tmp_path, task, gsd, zoom):
    before = SETTINGS._replace(task="sections", zoom=2.0, gsd=0.38)
    torch.save({"average": {}, "settings": before._asdict()}, tmp_path / "sections.pt")
    assert training.usual_zoom(task, gsd, tmp_path / "sections.pt") == zoom
    both = before._replace(task="both", zoom=1.0)  # whose features both tasks share at the image's own scale
    torch.save({"average": {}, "settings": both._asdict()}, tmp_path / "both.pt")
    assert training.usual_zoom(task, gsd, tmp_path / "both.pt") == training.usual_zoom(task, gsd)


def test_weights_see_as_blurred_as_before(tmp_path):
    before = SETTINGS._replace(task="sections", gsd=0.38, blur=1.0)
    torch.save({"average": {}, "settings": before._asdict()}, tmp_path / "sections.pt")
    assert training.usual_blur(0.38, tmp_path / "sections.pt") == 1
    assert training.usual_blur(0.25, tmp_path / "sections.pt") == pytest.approx(1.52)
    old = {key: value for key, value in before._asdict().items() if key != "blur"}
    torch.save({"average": {}, "settings": old}, tmp_path / "old.pt")
    assert training.usual_blur(0.38, tmp_path / "old.pt") == training.usual_blur(0.38) == 0


def test_a_blur_beyond_reason_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        training.main([f"--out={tmp_path}", "--blur=-1", "--tiles=0"])
    assert "--blur -1" in capsys.readouterr().err


def test_weights_that_are_no_numbers_are_refused(tmp_path):
    model = training.network()
    average = model.state_dict()
    average["bottleneck.1.running_var"][3] = float("inf")
    torch.save({"average": average}, tmp_path / "weights.pt")
    with pytest.raises(ContractMismatch, match=r"bottleneck\.1\.running_var is not finite"):
        training.start_from(training.network(), tmp_path / "weights.pt")


def test_geometry_changes_the_answer_once_learned():
    model = Dense(4, "corners").eval()
    for part in model.modulation:
        torch.nn.init.normal_(part.linear.weight)
    image = torch.randn(1, 3, 64, 64)
    with torch.no_grad():
        known = model(image, torch.tensor([[0.0, -2, 1, 1, 1, 1]]))
        unknown = model(image, torch.zeros(1, 6))
    assert not torch.allclose(known[2], unknown[2])


def test_a_run_ends_when_the_validation_loss_has_stopped_falling(tmp_path, monkeypatch):
    """Looks at every step: 3, 2, 2.5, 2.5. The best weights are those of the second, and a later call has nothing to do."""
    told = iter([3.0, 2.0, 2.5, 2.5])
    monkeypatch.setattr(training, "validated", lambda *arguments: next(told))
    tiles = Tiles()
    kept = [examples.example(tiles.sample, np.random.default_rng(0), False)]
    options = {"workers": 0, "validation": kept, "patience": 2, "look_every": 1}
    assert training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=9, **options) == 4
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert (state["best"]["loss"], state["best"]["step"], state["best"]["since"]) == (2.0, 2, 2)
    assert state["converged"] is True
    assert any(not torch.equal(value, state["average"][name]) for name, value in state["best"]["average"].items())
    assert training.train(training.network(), tiles, SETTINGS, tmp_path, 600, steps=9, **options) == 4


def test_looking_at_validation_tiles_leaves_the_network_as_it_was():
    model = training.network().train()
    batch = torch.utils.data.default_collate([examples.example(Tiles().sample, np.random.default_rng(0), False)] * 2)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    modes = [part.training for part in model.modules()]
    average = {name: value.clone() for name, value in before.items()}
    loss = training.validated(model, average, [batch], training.dense_terms)
    assert loss == pytest.approx(training.validated(model, average, [batch, batch], training.dense_terms), rel=1e-4)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert [part.training for part in model.modules()] == modes
