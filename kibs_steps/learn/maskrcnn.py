"""Mask R-CNN, the paper's family: two networks, sections on the image and corners on the image blended with sections.

Sections are instances of one class; corners are squares of q × q px whose class is the height bin. Both are torchvision's
ResNet-FPN model, from scratch unless weights are given. The network works at the tile's own size: torchvision's transform would
resize a tile of 230 px to 229 when exported (it computes floor(230 · (230 · 1/230)) in float), which shifts every detection, so
here it only pads.

In: samples (`learn.samples`). Out: for training, loss terms; for use, an ONNX file of head `instances` with raw 28 × 28 masks
(docs/architecture.md, Models). Needs torchvision; `NoTorchvision` says what to install where it cannot run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from kibs_steps.errors import KibsError
from kibs_steps.learn import coco
from kibs_steps.learn.samples import Sample

TASKS = ("sections", "corners")
OUTPUTS = ("boxes", "labels", "scores", "masks")
TILE, MARGIN = 230, 10  # px (PAPER, data and tiling)
BINS = coco.paper_bins(30)  # the paper's classes go to 19 m; taller buildings need more
BLEND = {
    "inside": [0, 0, 255],
    "rim": [0, 0, 255],
    "outside": [None, None, 0],
}  # what the paper's script does (PAPER, finding 5)
SMALLEST = 12  # px: smaller sections are not asked for
MEAN, STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
LOWEST_SCORE = 0.05  # below it nothing leaves the network; the contract's threshold is applied after it


class NoTorchvision(KibsError):
    """torchvision is missing, or its compiled operators do not fit the installed torch."""


def network(task: str, backbone: str = "resnet50", proposals: int = 1000, detections: int = 100) -> nn.Module:
    """A new network of a task, without pretrained weights; input normalised images (3, h, w), as its contract says.

    `proposals` and `detections` bound what one tile may give; the paper's are the defaults.
    """
    try:
        from torchvision.models.detection import MaskRCNN
        from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
        from torchvision.models.detection.image_list import ImageList
        from torchvision.models.detection.transform import GeneralizedRCNNTransform
    except (ImportError, RuntimeError) as error:
        raise NoTorchvision(
            f"torchvision cannot be used ({error}): install the release that belongs to torch {torch.__version__} "
            "(extra `learn`), with operators for this machine"
        ) from error

    class OwnSize(GeneralizedRCNNTransform):
        """Images as they are, batched; detections as the network gives them."""

        def forward(self, images: list[torch.Tensor], targets: Any = None) -> tuple[Any, Any]:
            sizes = [(image.shape[-2], image.shape[-1]) for image in images]
            return ImageList(self.batch_images(list(images), self.size_divisible), sizes), targets

        def postprocess(self, result: Any, image_shapes: Any, original_image_sizes: Any) -> Any:
            return result

    classes = 2 if task == "sections" else len(BINS.centres) + 1
    model = MaskRCNN(
        resnet_fpn_backbone(backbone_name=backbone, weights=None, norm_layer=nn.BatchNorm2d, trainable_layers=5),
        num_classes=classes,
        rpn_post_nms_top_n_test=proposals,
        rpn_pre_nms_top_n_test=proposals,
        box_detections_per_img=detections,
        box_score_thresh=LOWEST_SCORE,
    )
    model.transform = OwnSize(TILE, TILE, [0.0] * 3, [1.0] * 3)
    for part in (model.rpn.head, model.roi_heads.box_predictor, model.roi_heads.mask_predictor):
        part.register_forward_hook(_in_full)
    return model


def _in_full(part: nn.Module, given: Any, output: Any) -> Any:
    """A part's output in float32: torchvision reckons boxes in its type, and in bfloat16 a pixel at 230 is lost in rounding."""
    if isinstance(output, torch.Tensor):
        return output.float()
    return type(output)(_in_full(part, given, value) for value in output)


def example(sample: Sample, task: str, labels: np.ndarray) -> dict[str, Any]:
    """Image uint8 (3, h, w) and its instances: boxes (n, 4) px, labels (n,), masks (n, h, w) uint8.

    `labels` are the sections the corners' image is blended with. Mask R-CNN cannot leave ground out of its losses, so what
    is unknown is painted over in the image's mean colour: there is neither roof nor anything else to learn from.
    """
    from kibs_steps.blend import blend

    rgb = sample.rgb
    unknown = sample.labels < 0 if task == "sections" else sample.corners_known == 0
    if unknown.any():
        rgb = np.where(unknown[..., None], sample.rgb.mean(axis=(0, 1)).astype(np.uint8), rgb)
    size = sample.labels.shape
    if task == "sections":
        ids, area = np.unique(sample.labels[sample.labels > 0], return_counts=True)
        masks = sample.labels[None] == ids[area >= SMALLEST][:, None, None]
        kinds = np.ones(len(masks), np.int64)
        boxes = np.array([_box(mask) for mask in masks], np.float32).reshape(-1, 4)
    else:
        rgb = blend(rgb, labels, **BLEND)
        known = np.isfinite(sample.corner_heights)
        boxes = coco.squares(sample.corners[known], size)
        kinds = BINS.of(sample.corner_heights[known]) + 1
        masks = np.zeros((len(boxes), *size), bool)
        for mask, (x0, y0, x1, y1) in zip(masks, boxes.tolist(), strict=True):
            mask[y0:y1, x0:x1] = True
        boxes = boxes.astype(np.float32)
    return {
        "image": rgb.transpose(2, 0, 1).copy(),
        "boxes": boxes,
        "labels": kinds.astype(np.int64),
        "masks": masks.astype(np.uint8),
    }


def _box(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return cols[0], rows[0], cols[-1] + 1, rows[-1] + 1


def normalised(images: torch.Tensor) -> torch.Tensor:
    """uint8 (…, 3, h, w) to network input, as `contract_terms` says."""
    mean, std = (torch.tensor(values, device=images.device)[:, None, None] for values in (MEAN, STD))
    return (images.float() - mean) / std


def collated(examples: list[dict[str, Any]]) -> dict[str, Any]:
    """Examples as one batch: instances stay lists, for every tile has its own number of them."""
    return {
        "image": torch.from_numpy(np.stack([e["image"] for e in examples])),
        "targets": [{k: torch.from_numpy(e[k]) for k in ("boxes", "labels", "masks")} for e in examples],
    }


def loss_terms(model: nn.Module, batch: dict[str, Any]) -> dict[str, torch.Tensor]:
    """torchvision's loss terms of a batch: classifier, box_reg, mask, objectness, rpn_box_reg."""
    images = list(normalised(batch["image"]))
    return {name.removeprefix("loss_"): value for name, value in model(images, batch["targets"]).items()}


class OneTile(nn.Module):
    """The exported graph: image (1, 3, s, s) to boxes (n, 4), labels (n,), scores (n,), masks (n, 28, 28)."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.model = model

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        (found,) = self.model([image[0]])
        return found["boxes"], found["labels"], found["scores"], found["masks"][:, 0]


def contract_terms(task: str, heights: tuple[float, float]) -> dict[str, Any]:
    """What a contract says of this family: head, grid, input, thresholds, blend, height bins.

    `heights` are mean and standard deviation (m) of the training set's corners. The paper's score thresholds are 0.999 and
    0.05; a network trained for less time is less sure of its sections.
    """
    terms: dict[str, Any] = {
        "head": "instances",
        "tile": TILE,
        "margin": MARGIN,
        "input": {"channels": "RGB", "scale": 1.0, "mean": list(MEAN), "std": list(STD)},
        "thresholds": {"score": 0.5, "mask": 0.5, "min_area": SMALLEST},
    }
    if task == "corners":
        terms["blend"] = BLEND
        terms["thresholds"] = {"score": LOWEST_SCORE, "corner_nms": 4.0, "corner_radius": coco.SQUARE / 2}
        terms["heights"] = {
            "edges": list(BINS.edges),
            "centres": list(BINS.centres),
            "fallback": round(heights[0], 2),
            "fallback_sigma": round(heights[1], 2),
        }
    return terms


def to_onnx(model: nn.Module, path: str, tile: int) -> None:
    """Trace a network into an ONNX file (opset 17). The legacy exporter: the newer one fails in torchvision's batched nms."""
    torch.onnx.export(
        OneTile(model.eval()),
        (torch.zeros(1, 3, tile, tile),),
        path,
        input_names=["image"],
        output_names=list(OUTPUTS),
        opset_version=17,
        dynamo=False,
        dynamic_axes={name: {0: "n"} for name in OUTPUTS},
    )
