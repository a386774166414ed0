"""The ONNX file gives what the network gives, and carries a valid contract."""

import re

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="export needs the extra `learn` (torch)")

from kibs_steps.learn import export, sources, training  # noqa: E402
from kibs_steps.learn.architectures import OUTPUTS  # noqa: E402
from kibs_steps.models import contract as contracts  # noqa: E402
from kibs_steps.models import heads, joining, runtime, scoring  # noqa: E402


@pytest.mark.parametrize(
    ("task", "zoom", "blur"),
    [("sections", 1.0, 0), ("sections", 1.5, 0), ("sections", 1.5, 1.0), ("corners", 1.0, 0), ("both", 1.0, 0)],
)
def test_onnx_equals_torch(task, zoom, blur, tmp_path):
    torch.manual_seed(0)
    model = training.network(task, zoom=zoom, blur=blur)
    contract = export.contract_of(task, (5.0, 2.0), seed=0, commit="abc") | {
        "upright": False,
        "flips": 1,
    }  # the graph itself
    contract["tile"], contract["margin"] = 64, 8
    export.export(model, tmp_path / "model.onnx", contract)
    loaded = contracts.load(tmp_path / "model.onnx", task)
    assert loaded.contract == contract
    assert loaded.path.stat().st_size < 2.4 * sum(p.numel() for p in model.parameters())  # bytes: half precision
    rgb = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    geometry = np.float32([[0.5, -1, 1, 2, 1, 1]])
    outputs = runtime.open_network(loaded, geometry)(rgb)
    with torch.no_grad():
        image = torch.from_numpy(contracts.normalise(rgb, contract))
        expected = model.eval()(image, torch.from_numpy(geometry))
    for name, value in zip(OUTPUTS[task], expected, strict=True):
        np.testing.assert_allclose(outputs[name], value[0].numpy(), atol=1e-3, err_msg=name)
    if task == "sections":
        assert heads.decode_sections(outputs, contract, rgb).labels.shape == (64, 64)
    else:
        np.testing.assert_allclose(outputs["height"].sum(0), 1, atol=1e-4)
        assert (np.abs(outputs["offset"]) <= 0.5).all()
        heads.decode_corners(outputs, contract)


@pytest.mark.parametrize(("gsd", "tile", "margin"), [(0.38, 512, 32), (0.25, 768, 48), (0.5, 384, 32)])
def test_tiles_of_any_gsd_show_as_much_ground(gsd, tile, margin):
    contract = export.contract_of("sections", gsd=gsd)
    assert (contract["gsd"], contract["tile"], contract["margin"]) == (gsd, tile, margin)
    assert contract["thresholds"]["min_area"] * gsd**2 == pytest.approx(12 * 0.38**2, rel=0.01)
    assert contract["tile"] * training.usual_zoom("sections", gsd) % 32 == 0


@pytest.mark.parametrize(("gsd", "zoom"), [(0.38, 1.5), (0.25, 1.0), (0.5, 2.0)])
def test_a_network_sees_the_ground_at_another_gsd_as_large_as_in_training(gsd, zoom):
    settings = training.Settings(0, task="sections", zoom=1.5)
    assert export.zoom_at(gsd, settings) == zoom


def test_one_run_makes_models_for_two_gsds(tmp_path):
    settings = training.Settings(0, task="sections", zoom=1.5)
    average = training.network("sections", zoom=1.5).state_dict()
    state = {"average": average, "settings": settings._asdict(), "step": 3, "seconds": 9.0}
    torch.save(state, tmp_path / "checkpoint.pt")
    options = [f"--checkpoint={tmp_path}/checkpoint.pt", "--task=sections", "--gsd=0.25"]
    export.main([*options, f"--out={tmp_path}/sections.onnx"])
    contract = contracts.load(tmp_path / "sections.onnx", "sections").contract
    assert contract["trained_on"]["view_elevation"] == [45, 90]
    export.main([*options, "--view-elevation", "85", "90", f"--out={tmp_path}/nadir.onnx"])
    assert contracts.load(tmp_path / "nadir.onnx", "sections").contract["trained_on"]["view_elevation"] == [85, 90]
    assert (contract["gsd"], contract["tile"], contract["margin"]) == (0.25, 768, 48)
    with pytest.raises(SystemExit):
        export.main([*options, "--task=corners", f"--out={tmp_path}/corners.onnx"])
    torch.save({"average": average, "settings": settings._asdict()}, tmp_path / "checkpoint.pt")
    with pytest.raises(SystemExit):  # weights alone, as `--weights` writes them
        export.main([*options, f"--out={tmp_path}/sections.onnx"])


def test_thresholds_and_score_of_the_model_a_run_started_from_hold_on(tmp_path):
    score, join = (
        {"mean": [0.0] * n, "spread": [1.0] * n, "layers": [{"weights": [[1.0]] * n, "bias": [0.0]}]}
        for n in (len(scoring.TRAITS), len(joining.TRAITS))
    )
    join["least"] = 0.5
    like = export.contract_of("sections", thresholds={"roof": 0.66, "min_area": 20}, score=score, join=join)
    export.export(training.network("sections"), tmp_path / "like.onnx", like)
    state = {"average": training.network("sections").state_dict(), "step": 1, "seconds": 1.0}
    for gsd, min_area in ((0.38, 20), (0.5, 6.9)):
        settings = training.Settings(0, task="sections", gsd=gsd)._asdict()
        torch.save({**state, "settings": settings}, tmp_path / "checkpoint.pt")
        options = [f"--checkpoint={tmp_path}/checkpoint.pt", "--task=sections", f"--out={tmp_path}/new.onnx"]
        export.main([*options, f"--like={tmp_path}/like.onnx"])
        contract = contracts.load(tmp_path / "new.onnx", "sections").contract
        assert contract["thresholds"] == {"roof": 0.66, "prominence": 0.2, "min_area": min_area, "sure": 0.6}
        assert contract["score"] == score
        assert contract["join"] == join


@pytest.mark.parametrize(
    ("about", "before", "licence"),
    [
        (
            {"licence": sources.OWN, "data": ["own"], "init": "sections.pt"},
            sources.NON_COMMERCIAL,
            "CC BY-NC .*; and as the owner",
        ),
        ({"licence": sources.OWN, "data": ["own"], "init": "sections.pt"}, sources.SIMULATED, "^as the owner"),
        ({"licence": sources.SIMULATED, "data": [], "init": "a.pt"}, sources.NON_COMMERCIAL, "^CC BY-NC [^;]*$"),
        (
            {"licence": sources.OWN, "data": [], "init": "a.pt"},
            None,
            r"as the owner .*; and as the weights .*\(a.pt\) allow",
        ),
        ({"licence": sources.OWN, "data": [], "init": training.IMAGENET}, None, "^as the owner[^;]*$"),
    ],
)
def test_the_licence_of_the_weights_a_run_started_from_is_kept(about, before, licence):
    told = before and {"licence": before, "data": ["roofs of others"]}
    found = export.inherited(about, told)
    assert re.search(licence, found["licence"])
    assert ("before that: roofs of others" in found["data"]) == (before is not None)


def test_weights_too_large_for_half_precision_are_kept():
    average = {"small": torch.tensor([0.5, 3.0]), "wide": torch.tensor([1.0, 80_000.0]), "steps": torch.tensor(7)}
    kept = export.halved(average)
    assert kept["small"].dtype == torch.float16
    assert all(torch.equal(kept[name].to(value.dtype), value) for name, value in average.items())
