"""The sweep reads where geometry says; corrections are neutral at the start; every part learns."""

import numpy as np
import pytest
from scipy import ndimage

torch = pytest.importorskip("torch", reason="networks need the extra `learn` (torch)")

from kibs_steps.learn import training  # noqa: E402
from kibs_steps.learn.architectures import OUTPUTS, SWEPT, Sweep, blurred, softmax  # noqa: E402


@pytest.mark.parametrize(("stride", "block"), [(4, 1), (2, 2)])
def test_sweep_finds_base_and_shadow_of_a_pole(stride, block):
    """A pole's top at height h, its base and its shadow's tip, each marked in a channel, meet at the top in the step of h."""
    height = 8.0
    view, sun = np.array([-1.0, -2.0]), np.array([2.0, 0.5])  # px per metre
    base = np.array([66.0, 70.0])
    top, tip = base + height * view, base + height * sun
    features = torch.zeros(1, 2, 32 * block, 32 * block)
    for channel, (col, row) in enumerate((base, tip)):
        # Bilinear weights of a point mark, so that reading there gives their sum of squares, the largest anywhere near.
        x, y = col / stride - 0.5, row / stride - 0.5
        for i in (int(y), int(y) + 1):
            for j in (int(x), int(x) + 1):
                features[0, channel, i, j] = (1 - abs(x - j)) * (1 - abs(y - i))
    geometry = torch.tensor([[*view, *sun, 1.0, 1.0]], dtype=torch.float32)
    read = Sweep(stride, block)(features, geometry).reshape(2, 2, len(SWEPT), 32, 32)
    col, row = (top / (stride * block) - 0.5).round().astype(int)
    assert read[0, 0, :, row, col].argmax() == SWEPT.index(8)
    assert read[1, 1, :, row, col].argmax() == SWEPT.index(8)


def test_a_zoomed_network_is_the_same_network_on_a_larger_image():
    torch.manual_seed(0)
    plain = training.network("sections").eval()
    zoomed = training.network("sections", zoom=1.5).eval()
    zoomed.load_state_dict(plain.state_dict())
    small, geometry = torch.rand(1, 3, 64, 64), torch.tensor([[0.2, -1.4, 0.6, 0.3, 1.0, 1.0]])
    large = torch.nn.functional.interpolate(small, size=(96, 96), mode="bilinear")
    with torch.no_grad():
        expected = plain.logits(large, geometry * torch.tensor([[1.5, 1.5, 1.5, 1.5, 1.0, 1.0]]))
        raw = zoomed.logits(small, geometry)
    assert raw["roof"].shape == (1, 1, 64, 64)
    assert raw["surface"].shape[2:] == (32, 32)
    for name, side, unit in (
        *((name, 64, 1.0) for name in ("roof", "edge", "distance")),
        ("slope", 16, 1.5),  # m per px: pixels of the small image are larger
        ("centre", 16, 1 / 1.5),  # px
    ):
        smaller = unit * torch.nn.functional.interpolate(expected[name], size=(side, side), mode="bilinear")
        assert torch.allclose(raw[name], smaller, atol=1e-5)


def test_a_network_with_a_blur_is_the_same_network_on_a_blurred_image():
    torch.manual_seed(0)
    plain = training.network("sections").eval()
    seeing = training.network("sections", blur=1.3).eval()
    seeing.load_state_dict(plain.state_dict())
    image, geometry = torch.rand(2, 3, 64, 64), torch.zeros(2, 6)
    through = ndimage.gaussian_filter(image.numpy(), 1.3, mode="mirror", radius=4, axes=(2, 3))
    assert np.abs(blurred(image, 1.3).numpy() - through).max() < 1e-6
    with torch.no_grad():
        expected = plain.logits(torch.from_numpy(through), geometry)
        raw = seeing.logits(image, geometry)
    assert all(torch.allclose(raw[name], expected[name], atol=1e-5) for name in expected)


@pytest.mark.parametrize("task", ["sections", "corners"])
def test_a_network_of_one_task_gives_its_maps_of_a_network_of_both(task):
    torch.manual_seed(0)
    both, one = training.network("both").eval(), training.network(task).eval()
    one.load_state_dict(both.state_dict())
    image, geometry = torch.rand(1, 3, 64, 64), torch.tensor([[0.2, -1.4, 0.6, 0.3, 1.0, 1.0]])
    with torch.no_grad():
        expected = dict(zip(OUTPUTS["both"], both(image, geometry), strict=True))
        found = dict(zip(OUTPUTS[task], one(image, geometry), strict=True))
    for name, value in found.items():
        assert name not in expected or torch.allclose(value, expected[name], atol=1e-6), name
        assert value.std() > 0, name


def test_softmax_is_torch_s_even_far_from_zero():
    maps = 200 * torch.randn(2, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(softmax(maps), torch.softmax(maps, dim=1), atol=1e-6)


def test_all_of_the_encoder_learns():
    model = training.network().train()
    before = {k: v.clone() for k, v in model.encoder.named_parameters()}
    optimiser = torch.optim.AdamW(model.parameters(), lr=0.1)
    raw = model.logits(torch.randn(1, 3, 64, 64), torch.zeros(1, 6))
    sum(v.square().mean() for v in raw.values()).backward()
    optimiser.step()
    unchanged = [k for k, v in model.encoder.named_parameters() if torch.equal(v, before[k])]
    assert not unchanged
