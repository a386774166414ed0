"""The model contract: what fits is read, what does not is refused with the place and the remedy."""

import json

import numpy as np
import pytest
import toy

from kibs_steps.models import contract, runtime
from kibs_steps.models.contract import AngleOutsideTraining, ContractMismatch, NoContract, NotAModel


def test_round_trip(tmp_path):
    path = toy.sections_model(tmp_path / "sections.onnx")
    model = contract.load(path, "sections")
    assert model.contract == toy.contract("sections")
    assert len(model.sha256) == 64


def test_sidecar(tmp_path):
    path = toy.sections_model(tmp_path / "m.onnx", terms={})
    import onnx

    proto = onnx.load(path)
    del proto.metadata_props[:]
    onnx.save(proto, path)
    with pytest.raises(NoContract, match=r"m\.json"):
        contract.load(path)
    path.with_suffix(".json").write_text(json.dumps(toy.contract("sections")))
    assert contract.load(path).contract["gsd"] == toy.GSD


def test_not_a_model(tmp_path):
    with pytest.raises(NotAModel, match="no model at"):
        contract.load(tmp_path / "none.onnx")
    (tmp_path / "x.onnx").write_bytes(b"GIF89a" + bytes(range(200)))
    with pytest.raises(NotAModel, match="not an ONNX model"):
        contract.load(tmp_path / "x.onnx")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gsd": -1}, "gsd"),
        ({"task": "walls"}, "task"),
        ({"margin": 32}, "leaves nothing"),
        ({"surprise": 1}, "surprise"),
        ({"contract": 2}, "contract"),
        ({"input": {"channels": "RGB"}}, "input"),
        ({"thresholds": {"min_area": 8}}, "thresholds: roof"),
    ],
)
def test_bad_contracts(tmp_path, change, message):
    path = toy.sections_model(tmp_path / "sections.onnx", toy.contract("sections", **change))
    with pytest.raises(ContractMismatch, match=message):
        contract.load(path)


def test_corner_models_must_say_blend_and_heights(tmp_path):
    for missing in ("blend", "heights"):
        terms = toy.contract("corners")
        del terms[missing]
        with pytest.raises(ContractMismatch, match=missing):
            contract.load(toy.corners_model(tmp_path / "corners.onnx", terms))


def test_wrong_task_and_disagreeing_models(tmp_path):
    path = toy.sections_model(tmp_path / "sections.onnx")
    with pytest.raises(ContractMismatch, match="swap the files"):
        contract.load(path, "corners")
    other = toy.corners_model(tmp_path / "corners.onnx", toy.contract("corners", margin=4))
    with pytest.raises(ContractMismatch, match="disagree on margin"):
        contract.agree([contract.load(path), contract.load(other)])


@pytest.mark.parametrize(
    ("value", "allowed", "circular", "off"),
    [
        (60, [50, 90], False, 0),
        (46, [50, 90], False, 4),
        (355, [350, 10], True, 0),
        (12, [350, 10], True, 2),
        (5, [0, 360], True, 0),
    ],
)
def test_distance_to_a_range_of_angles(value, allowed, circular, off):
    assert contract.beyond(value, allowed, circular) == off


def test_angles_outside_training(tmp_path):
    model = contract.load(toy.sections_model(tmp_path / "s.onnx"))
    angles = lambda e: {"azimuth": 180.0, "elevation": e}  # noqa: E731
    assert contract.check_angles(model, angles(60.0), None) == []
    assert "4.0° outside" in contract.check_angles(model, angles(46.0), None)[0]
    with pytest.raises(AngleOutsideTraining, match="allow_angles"):
        contract.check_angles(model, angles(40.0), None)
    assert contract.check_angles(model, angles(40.0), None, allow=True)
    assert "unknown" in contract.check_angles(model, None, None)[0]


def test_normalisation_and_channel_order():
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[..., 0] = 255
    terms = {"input": {"channels": "BGR", "scale": 1 / 255, "mean": [0.5] * 3, "std": [0.25] * 3}}
    x = contract.normalise(rgb, terms)
    assert x.shape == (1, 3, 2, 2)
    assert x[0, :, 0, 0].tolist() == [-2.0, -2.0, 2.0]


def test_geometry_vector_points_where_roofs_are_seen():
    """A satellite in the south sees roofs displaced to the north (up, −row); a sun in the east casts shadows west (−col)."""
    from kibs_steps.view import lean

    vector = runtime.geometry_vector(lean(180.0, 45.0), lean(90.0, 45.0), 0.5)
    np.testing.assert_allclose(vector, [[0, -2, -2, 0, 1, 1]], atol=1e-6)
    assert not runtime.geometry_vector(None, None, 0.5).any()


def test_how_far_below_a_range_of_azimuths():
    assert contract.beyond(345, [350, 10], circular=True) == 5
    assert contract.beyond(95, [100, 200], circular=True) == 5


def test_sun_and_azimuths_count_as_the_view_does(tmp_path):
    ranges = {"view_azimuth": [350, 20], "sun_elevation": [30, 60]}
    terms = toy.contract("sections", trained_on={"data": ["toy"], "licence": "CC0-1.0", **ranges})
    model = contract.load(toy.sections_model(tmp_path / "s.onnx", terms))

    def told(azimuth, sun):
        return contract.check_angles(model, {"azimuth": azimuth, "elevation": 60.0}, {"azimuth": 1.0, "elevation": sun})

    assert told(5.0, 45.0) == told(355.0, 45.0) == told(5.0, 28.0) == []
    assert "sun elevation 26° is 4.0° outside" in told(5.0, 26.0)[0]
    with pytest.raises(AngleOutsideTraining, match="sun elevation 20°"):
        told(5.0, 20.0)
    with pytest.raises(AngleOutsideTraining, match="view azimuth 30°"):
        told(30.0, 45.0)


@pytest.mark.parametrize(("elevation", "warned", "refused"), [(47.1, 0, 0), (46.9, 1, 0), (45.1, 1, 0), (44.9, 1, 1)])
def test_three_degrees_are_warned_of_and_five_refused(tmp_path, elevation, warned, refused):
    model = contract.load(toy.sections_model(tmp_path / "s.onnx"))  # trained on 50 to 90°
    seen = {"azimuth": 180.0, "elevation": elevation}
    assert len(contract.check_angles(model, seen, None, allow=True)) == warned
    if refused:
        with pytest.raises(AngleOutsideTraining):
            contract.check_angles(model, seen, None)
    else:
        assert len(contract.check_angles(model, seen, None)) == warned


def test_means_are_in_the_order_of_the_networks_channels():
    rgb = np.full((1, 1, 3), (10, 20, 30), np.uint8)
    terms = {"input": {"channels": "BGR", "scale": 1.0, "mean": [1.0, 2.0, 3.0], "std": [1.0, 2.0, 4.0]}}
    assert contract.normalise(rgb, terms)[0, :, 0, 0].tolist() == [29.0, 9.0, 1.75]


def test_height_bins_have_an_edge_more_than_centres(tmp_path):
    terms = toy.contract("corners", heights={"edges": [0, 1, 2], "centres": [0.5], "fallback": 6.0})
    with pytest.raises(ContractMismatch, match="one edge more"):
        contract.load(toy.corners_model(tmp_path / "corners.onnx", terms))
