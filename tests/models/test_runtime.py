"""Running models: symmetric views of a tile come back to where they belong."""

import numpy as np
import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper

from kibs_steps.models import contract, heads, runtime
from kibs_steps.models.runtime import Flip
from kibs_steps.view import lean

ALL = [Flip(bool(i & 4), bool(i & 1), bool(i & 2)) for i in range(8)]


@pytest.mark.parametrize("flip", ALL)
def test_there_and_back(flip):
    """A map made of the flipped image comes back as a map of the image."""
    rgb = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
    maps = {"roof": flip.image(rgb)[..., 0][None].astype(np.float32)}
    np.testing.assert_array_equal(flip.back(maps)["roof"][0], rgb[..., 0])


@pytest.mark.parametrize("name", runtime.DIRECTED)
@given(st.sampled_from(ALL), st.integers(2, 12), st.integers(2, 12), st.floats(-1, 1), st.floats(-1, 1))
def test_vectors_and_geometry_turn_with_the_image(name, flip, col, row, east, south):
    """A mark and the pixel its displacement leads to: displaced in the flipped image, it is the same pixel."""
    size, step = 15, np.round([2 * east, 2 * south])
    vector = np.zeros((1, 6), np.float32)
    vector[0, :2] = vector[0, 2:4] = step
    rgb = np.zeros((size, size, 3), np.uint8)
    rgb[row, col, 0] = 1
    rgb[int(row + step[1]), int(col + step[0]), 1] = 1
    seen, turned = flip.image(rgb), flip.geometry(vector)
    (r,), (c,) = np.nonzero(seen[..., 0])
    assert seen[int(r + turned[0, 1]), int(c + turned[0, 0]), 1] == 1
    offset = np.zeros((2, size, size), np.float32)
    offset[:, r, c] = turned[0, 2:4]
    np.testing.assert_array_equal(flip.back({name: offset})[name][:, row, col], step)


def test_flips_leave_a_symmetric_network_alone(tmp_path):
    """The toy networks treat all directions alike, so eight views give what one gives."""
    image = toy.paint(toy.houses(np.random.default_rng(2), toy.TILE, toy.TILE), toy.TILE, toy.TILE)
    geometry = runtime.geometry_vector(lean(181, 59), None, toy.GSD)
    found = []
    for flips in (1, 8):
        model = contract.load(toy.corners_model(tmp_path / f"{flips}.onnx", toy.contract("corners", flips=flips)))
        found.append(heads.decode_corners(runtime.open_network(model, geometry)(image), model.contract))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.parametrize(
    ("untold", "kept"),
    [
        ([], [1, 2, 3, 4, 1, 1]),
        (["view"], [0, 0, 3, 4, 0, 1]),
        (["sun"], [1, 2, 0, 0, 1, 0]),
        (["view", "sun"], [0] * 6),
    ],
)
def test_what_a_model_is_not_told_is_kept_from_it(tmp_path, untold, kept):
    """A network that answers with what it was told."""
    ones = np.ones((1, 6, toy.TILE, toy.TILE), np.float32)
    nodes = [
        helper.make_node("Reshape", ["geometry", "shape"], ["column"]),
        helper.make_node("Mul", ["column", "ones"], ["roof"]),
    ]
    terms = toy.contract(
        "sections", geometry_input=True, trained_on={"data": [], "licence": "CC0-1.0", "untold": untold}
    )
    constants = {"shape": np.array([1, 6, 1, 1]), "ones": ones}
    path = toy.save(
        nodes, constants, {"roof": [1, 6, toy.TILE, toy.TILE]}, tmp_path / "echo.onnx", terms, geometry=True
    )
    geometry = np.array([[1, 2, 3, 4, 1, 1]], np.float32)
    model = contract.Model(path, "", terms)
    found = runtime.open_network(model, geometry)(np.zeros((toy.TILE, toy.TILE, 3), np.uint8))["roof"][:, 0, 0]
    assert found.tolist() == kept
    assert geometry.tolist() == [[1, 2, 3, 4, 1, 1]]


def test_fewer_looks_are_the_first_of_all(tmp_path):
    """A model that answers with the column of every pixel: one look gives the ramp, all eight what is the same from all sides."""
    ramp = np.broadcast_to(np.arange(toy.TILE, dtype=np.float32), (1, 1, toy.TILE, toy.TILE))
    terms = toy.contract("sections", flips=8)
    path = toy.save(
        [helper.make_node("Identity", ["ramp"], ["roof"])],
        {"ramp": ramp},
        {"roof": [1, 1, *2 * [toy.TILE]]},
        tmp_path / "ramp.onnx",
        terms,
    )
    model, image = contract.Model(path, "", terms), np.zeros((toy.TILE, toy.TILE, 3), np.uint8)
    one, all_ = (runtime.open_network(model, np.zeros((1, 6)), looks=n)(image)["roof"][0] for n in (1, 8))
    np.testing.assert_array_equal(one, ramp[0, 0])
    np.testing.assert_allclose(all_, (toy.TILE - 1) / 2)


def test_maps_of_any_stride_are_brought_to_pixels():
    ramp = np.broadcast_to(np.arange(16.0, dtype=np.float32), (2, 16, 16))
    full = runtime.at_pixels("slope", ramp, 32)
    assert full.shape == (2, 32, 32)
    np.testing.assert_allclose(full[0, 7, 2:-2], (np.arange(2, 30) + 0.5) / 2 - 0.5)
    assert runtime.at_pixels("corner", ramp[:1], 32).shape == (1, 16, 16)
    with pytest.raises(contract.ContractMismatch, match="output roof is 16 x 16 for a tile of 40 px"):
        runtime.at_pixels("roof", ramp[:1], 40)


class TestProviders:
    def test_one_that_is_not_there_is_told_with_its_package(self, tmp_path):
        """No build of onnxruntime has both: what is asked for is refused, never replaced in silence."""
        import onnxruntime as ort

        model = contract.load(toy.sections_model(tmp_path / "sections.onnx"))
        missing = next(p for p, (name, _, _) in runtime.PROVIDERS.items() if name not in ort.get_available_providers())
        with pytest.raises(runtime.ProviderMissing, match=runtime.PROVIDERS[missing][1]):
            runtime.open_network(model, np.zeros((1, 6), np.float32), missing)

    @pytest.mark.parametrize("provider", list(runtime.PROVIDERS))
    def test_all_that_are_there_agree_with_the_processor(self, tmp_path, provider):
        """Within the tolerance that docs/scaling.md states."""
        import onnxruntime as ort

        if runtime.PROVIDERS[provider][0] not in ort.get_available_providers():
            pytest.skip(f"this onnxruntime has no provider {provider}")
        model = contract.load(toy.sections_model(tmp_path / "sections.onnx"))
        image = toy.paint(toy.houses(np.random.default_rng(2), toy.TILE, toy.TILE), toy.TILE, toy.TILE)
        expected = runtime.open_network(model, np.zeros((1, 6), np.float32))(image)
        for name, value in runtime.open_network(model, np.zeros((1, 6), np.float32), provider, 2)(image).items():
            np.testing.assert_allclose(value, expected[name], atol=1e-3)


class TestRecord:
    def test_a_model_that_changed_is_refused(self, tmp_path):
        path = toy.sections_model(tmp_path / "sections.onnx")
        contract.main([str(path), "--task", "sections", "--out", str(tmp_path / "sections.json")])
        assert runtime.from_record(tmp_path / "sections.json", "sections") == contract.load(path)
        with pytest.raises(contract.ContractMismatch, match="used here for corners"):
            runtime.from_record(tmp_path / "sections.json", "corners")
        path.write_bytes(path.read_bytes() + b"\0")
        with pytest.raises(contract.ContractMismatch, match="changed"):
            runtime.from_record(tmp_path / "sections.json", "sections")


def test_upright_is_the_one_symmetry_in_which_roofs_lean_up():
    """Every lean has a view in which it points up and not right, less left than up; a zero one leaves the tile as it is."""
    rng = np.random.default_rng(0)
    for vector in rng.normal(size=(50, 2)):
        geometry = np.float32([[*vector, 0, 0, 1, 0]])
        col, row = runtime.upright(geometry).geometry(geometry)[0, :2]
        assert row <= 0 <= -col <= -row
        assert np.hypot(col, row) == pytest.approx(np.hypot(*vector), rel=1e-6)
    assert runtime.upright(np.zeros((1, 6), np.float32)) == runtime.FLIPS[0]


def test_the_views_in_which_a_tile_is_seen():
    """Leaning roofs: up, and mirrored if the model was trained so; from above: as many as the model's `flips`."""
    geometry = runtime.geometry_vector(lean(250, 62), lean(155, 45), 0.38)
    (up,) = runtime.shown({"upright": True, "flips": 8}, geometry)
    both = runtime.shown({"upright": True, "flips": 8, "mirrored": True}, geometry)
    assert both[0] == up
    (col, row), (other, same) = (flip.geometry(geometry)[0, :2] for flip in both)
    assert (other, same) == (-col, row)
    assert row < 0
    for steep in (runtime.geometry_vector(lean(250, 86), None, 0.38), runtime.geometry_vector(None, None, 0.38)):
        for terms in ({"upright": True, "flips": 8, "mirrored": True}, {"flips": 8}):
            assert sorted(runtime.shown(terms, steep)) == sorted(runtime.FLIPS)
        assert runtime.shown({"upright": True}, steep) == [runtime.upright(steep)]
