"""Mask R-CNN: targets against hand-made truth, training that learns, and an ONNX file that gives what torch gives."""

import numpy as np
import onnxruntime
import pytest

torch = pytest.importorskip("torch", reason="Mask R-CNN needs the extra `learn` (torch)")
pytest.importorskip("pycocotools", reason="Mask R-CNN needs the extra `learn` (pycocotools)")

import torchvision_cpu_ops  # noqa: E402

if not torchvision_cpu_ops.usable():
    pytest.skip("Mask R-CNN needs the extra `learn` (torchvision)", allow_module_level=True)

from kibs_steps.blend import blend  # noqa: E402
from kibs_steps.learn import export, maskrcnn, training  # noqa: E402
from kibs_steps.learn.samples import Sample  # noqa: E402
from kibs_steps.models import contract as contracts  # noqa: E402
from kibs_steps.models import heads, runtime  # noqa: E402

SIZE = 96


def sample() -> Sample:
    """A gable roof whose corners are known, a speck too small to ask for, and unknown ground."""
    made = Sample.ground(np.random.default_rng(0).integers(40, 90, (SIZE, SIZE, 3), dtype=np.uint8))
    made.labels[20:40, 10:50], made.labels[40:60, 10:50], made.labels[80:82, 80:84] = 1, 2, 3
    made.labels[70:, :20] = -1
    made.corners_known[70:, :20] = 0
    made.rgb[made.labels > 0] = (200, 90, 70)
    made.roof[made.labels > 0] = 1
    return made._replace(
        corners=np.float32([[10, 20], [50, 20], [10, 40], [50, 40], [10, 60], [50, 60]]),
        corner_heights=np.float32([3, 3, 6.2, 6.2, np.nan, 45]),
    )


def test_sections_are_instances_of_one_class():
    found = maskrcnn.example(sample(), "sections", sample().labels)
    assert found["boxes"].tolist() == [[10, 20, 50, 40], [10, 40, 50, 60]]
    assert found["labels"].tolist() == [1, 1]
    np.testing.assert_array_equal(found["masks"][0], sample().labels == 1)
    assert len(np.unique(found["image"][:, 70:, :20].reshape(3, -1), axis=1).T) == 1  # unknown ground shows nothing


def test_corners_are_squares_with_their_height_as_class_on_the_papers_blend():
    one = sample()
    found = maskrcnn.example(one, "corners", np.maximum(one.labels, 0))
    assert found["labels"].tolist() == [3, 3, 6, 6, 30]  # classes from 1 m, the last for all that is higher
    assert found["boxes"][0].tolist() == [3, 13, 18, 28]
    assert (found["masks"].sum(axis=(1, 2)) == 225).all()
    image = found["image"].transpose(1, 2, 0)
    assert (image[one.labels > 0] == (0, 0, 255)).all()
    ground = (one.labels == 0) & (one.corners_known > 0)
    np.testing.assert_array_equal(image[ground][:, :2], one.rgb[ground][:, :2])
    assert not image[ground][:, 2].any()


@pytest.mark.parametrize("task", maskrcnn.TASKS)
def test_boxes_of_detections_that_equal_the_truth_decode_to_it(task):
    """Heads and targets speak of the same pixels: true boxes and masks, decoded, are the truth."""
    one = sample()
    found = maskrcnn.example(one, task, np.maximum(one.labels, 0))
    outputs = {"boxes": found["boxes"], "labels": found["labels"], "scores": np.linspace(0.9, 0.8, len(found["boxes"]))}
    outputs["masks"] = np.ones((len(found["boxes"]), 28, 28), np.float32)
    terms = maskrcnn.contract_terms(task, (5.0, 2.0)) | {"tile": SIZE}
    if task == "sections":
        labels = heads.decode_sections(outputs, terms, one.rgb).labels
        np.testing.assert_array_equal(labels > 0, one.labels * (one.labels < 3) > 0)
        return
    corners = heads.decode_corners(outputs, terms)
    places = sorted(zip(corners.col.tolist(), corners.row.tolist(), corners.height.tolist(), strict=True))
    known = [(10, 20, 3), (10, 40, 6), (50, 20, 3), (50, 40, 6), (50, 60, 30)]
    np.testing.assert_allclose(places, known, atol=0.51)


def small(task: str, seed: int = 0) -> torch.nn.Module:
    """A network of the family that is quick: a lighter backbone, few proposals."""
    torch.manual_seed(seed)
    model = maskrcnn.network(task, backbone="resnet18", proposals=40, detections=12)
    model.rpn._pre_nms_top_n["training"], model.rpn._post_nms_top_n["training"] = 100, 40
    model.roi_heads.fg_bg_sampler.batch_size_per_image = 32
    return model


def differences(model: torch.nn.Module, path, tile: int) -> dict[str, float]:
    """Largest difference of every output, torch against onnxruntime, on a picture the export has not seen."""
    rgb = np.random.default_rng(1).integers(0, 256, (tile, tile, 3), dtype=np.uint8)
    image = maskrcnn.normalised(torch.from_numpy(rgb.transpose(2, 0, 1).copy()))[None]
    with torch.no_grad():
        expected = maskrcnn.OneTile(model.eval())(image)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(list(maskrcnn.OUTPUTS), {"image": image.numpy()})
    assert len(expected[0]) >= 3, "nothing detected, nothing compared"
    for name, one, other in zip(maskrcnn.OUTPUTS, expected, found, strict=True):
        assert one.shape == other.shape, name
    return {
        name: float(np.abs(one.numpy() - other).max())
        for name, one, other in zip(maskrcnn.OUTPUTS, expected, found, strict=True)
    }


def test_onnx_equals_torch_at_the_papers_tile_size(tmp_path):
    """230 px: where torchvision's own resizing would make 229 of it."""
    model = small("sections")
    contract = export.contract_of("sections", family="maskrcnn", seed=0)
    export.export(model, tmp_path / "model.onnx", contract)
    off = differences(model, tmp_path / "model.onnx", maskrcnn.TILE)
    assert off["boxes"] < 0.02
    assert off["scores"] < 1e-3
    assert off["masks"] < 5e-3
    assert off["labels"] == 0
    loaded = contracts.load(tmp_path / "model.onnx", "sections")
    rgb = np.random.default_rng(1).integers(0, 256, (maskrcnn.TILE, maskrcnn.TILE, 3), dtype=np.uint8)
    outputs = runtime.open_network(loaded, np.zeros((1, 6), np.float32))(rgb)
    with torch.no_grad():
        image = torch.from_numpy(contracts.normalise(rgb, contract))
        expected = maskrcnn.OneTile(model)(image)
    np.testing.assert_allclose(outputs["boxes"], expected[0].numpy(), atol=0.02)
    assert heads.decode_sections(outputs, contract, rgb).labels.shape == (maskrcnn.TILE, maskrcnn.TILE)


def test_a_wrong_size_export_would_be_noticed(tmp_path):
    """torchvision's own transform in the exported graph alone: the trap this family avoids, and the comparison sees it."""
    from torchvision.models.detection.transform import GeneralizedRCNNTransform

    model = small("sections")
    own = model.transform

    class Resizing(GeneralizedRCNNTransform):
        def postprocess(self, result, image_shapes, original_image_sizes):
            return result

    model.transform = Resizing(maskrcnn.TILE, maskrcnn.TILE, [0.0] * 3, [1.0] * 3)
    maskrcnn.to_onnx(model, str(tmp_path / "trap.onnx"), maskrcnn.TILE)
    model.transform = own
    try:
        off = differences(model, tmp_path / "trap.onnx", maskrcnn.TILE)
    except AssertionError:
        return
    assert off["boxes"] > 0.1 or off["scores"] > 0.01


@pytest.mark.parametrize("task", maskrcnn.TASKS)
def test_training_lowers_the_loss_and_goes_on_after_a_kill(task, tmp_path):
    one = sample()
    examples = [maskrcnn.example(one, task, np.maximum(one.labels, 0))] * 2

    class Same(torch.utils.data.Dataset):
        def __getitem__(self, index):
            return examples[0]

    def loss(model: torch.nn.Module) -> float:
        torch.manual_seed(1)  # of the proposals that are drawn
        return sum(maskrcnn.loss_terms(model.train(), maskrcnn.collated(examples)).values()).item()

    model = small(task)
    before = loss(model)
    settings = training.Settings(0, size=SIZE, batch=1, rate=1e-4, family="maskrcnn", task=task)
    budget = 1e7  # s: never used up, so that the rate follows the steps alone
    assert training.train(model, Same(), settings, tmp_path, budget, steps=2, workers=0) == 2
    assert training.train(small(task, 5), Same(), settings, tmp_path, budget, steps=10, workers=0) == 10
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    model.load_state_dict(state["model"])
    assert loss(model) < before
    with pytest.raises(contracts.ContractMismatch, match="another run"):
        training.train(model, Same(), settings._replace(task="both"), tmp_path, budget, steps=11, workers=0)


def test_blend_is_the_contracts():
    one = sample()
    terms = maskrcnn.contract_terms("corners", (5.0, 2.0))
    image = maskrcnn.example(one._replace(corners_known=np.ones_like(one.corners_known)), "corners", one.labels * 0)
    np.testing.assert_array_equal(image["image"].transpose(1, 2, 0), blend(one.rgb, one.labels * 0, **terms["blend"]))
