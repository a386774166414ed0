"""The loop resumes where it was; losses leave unknown ground alone."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `learn` (torch)")

from kibs_steps.learn import dataset, training  # noqa: E402
from kibs_steps.learn.architectures import Dense  # noqa: E402
from kibs_steps.models.contract import ContractMismatch  # noqa: E402


class Tiles(torch.utils.data.Dataset):
    """The same house everywhere."""

    def __init__(self, task: str):
        sample = dataset.empty(np.full((64, 64, 3), 60, np.uint8))
        sample.rgb[20:40, 10:50] = 200
        sample.labels[20:40, 10:50] = 1
        sample = sample._replace(
            roof=(sample.labels > 0).astype(np.uint8),
            height=np.where(sample.labels > 0, 5.0, np.nan).astype(np.float32),
            corners=np.float32([[10, 20], [50, 20], [50, 40], [10, 40]]),
            corner_heights=np.float32([5, 5, 5, 5]),
        )
        self.task, self.sample, self.seen = task, sample, []

    def __getitem__(self, index):
        self.seen.append(index)
        if self.task == "sections":
            return training.section_example(self.sample)
        return training.corner_example(self.sample, np.random.default_rng(index))


def settings(task: str) -> training.Settings:
    return training.Settings(task, 0, size=64, batch=2)


@pytest.mark.parametrize("task", ["sections", "corners"])
def test_a_killed_run_goes_on_where_it_was(task, tmp_path):
    tiles = Tiles(task)
    assert training.train(training.network(task), tiles, settings(task), tmp_path, 600, steps=2, workers=0) == 2
    first = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert first["step"] == 2
    model = training.network(task)
    assert training.train(model, tiles, settings(task), tmp_path, 600, steps=3, workers=0) == 3
    second = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert second["step"] == 3
    assert second["seconds"] > first["seconds"]
    assert tiles.seen == list(range(6))  # no tile twice
    assert training.train(model, tiles, settings(task), tmp_path, first["seconds"], workers=0) == 3  # budget used up


def test_another_run_is_not_overwritten(tmp_path):
    tiles = Tiles("sections")
    training.train(training.network("sections"), tiles, settings("sections"), tmp_path, 600, steps=1, workers=0)
    other = settings("sections")._replace(seed=1)
    with pytest.raises(ContractMismatch, match="another run"):
        training.train(training.network("sections"), tiles, other, tmp_path, 600, steps=2, workers=0)


def test_unknown_ground_gives_no_gradient():
    sample = Tiles("sections").sample
    sample.labels[:, 32:] = -1
    sample.roof[:, 32:] = dataset.UNKNOWN
    example = training.section_example(sample)
    batch = {k: torch.as_tensor(v)[None] for k, v in example.items()}
    raw = {name: torch.zeros(1, 1, 64, 64, requires_grad=True) for name in ("roof", "edge", "distance")}
    sum(training.section_losses(raw, batch).values()).backward()
    for name, value in raw.items():
        assert not value.grad[..., 32:].any(), name
        assert value.grad[..., :32].any(), name


def test_a_new_run_takes_over_the_weights_of_another(tmp_path):
    training.train(training.network("sections"), Tiles("sections"), settings("sections"), tmp_path, 600, 1, 1, 0)
    model = training.network("corners")
    taken = training.start_from(model, tmp_path / "checkpoint.pt")
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["average"]
    assert taken == len([k for k in state if not k.startswith("maps.")])
    assert torch.equal(model.state_dict()["encoder._conv_stem.weight"], state["encoder._conv_stem.weight"])


def test_geometry_changes_the_answer_once_learned():
    model = Dense("corners", bins=4).eval()
    for part in model.modulation:
        torch.nn.init.normal_(part.linear.weight)
    image = torch.randn(1, 3, 64, 64)
    with torch.no_grad():
        known = model(image, torch.tensor([[0.0, -2, 1, 1, 1, 1]]))
        unknown = model(image, torch.zeros(1, 6))
    assert not torch.allclose(known[2], unknown[2])
