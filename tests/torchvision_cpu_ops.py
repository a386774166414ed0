"""torchvision beside a CPU-only torch, for tests on such machines only: PyPI's wheels are built for CUDA and cannot load there.

`usable()` imports torchvision; where its compiled operators cannot load, `nms` and `roi_align` (with its gradient) in plain torch
take their place, and all other operators have a signature only. On machines where they load nothing is replaced.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch.nn import functional as F

POOLED = "SymInt pooled_height, SymInt pooled_width"
BATCH = "SymInt batch_size, SymInt channels, SymInt height, SymInt width"
DEFORM = (
    "SymInt stride_h, SymInt stride_w, SymInt pad_h, SymInt pad_w, SymInt dilation_h, SymInt dilation_w, "
    "SymInt groups, SymInt offset_groups, bool use_mask"
)
SCHEMAS = [
    "_cuda_version() -> int",
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    f"roi_align(Tensor input, Tensor rois, float spatial_scale, {POOLED}, int sampling_ratio, bool aligned) -> Tensor",
    f"_roi_align_backward(Tensor grad, Tensor rois, float spatial_scale, {POOLED}, {BATCH}, int sampling_ratio, "
    "bool aligned) -> Tensor",
    f"qroi_align(Tensor input, Tensor rois, float a, int b, float c, int d, float spatial_scale, {POOLED}, "
    "int sampling_ratio, bool aligned) -> Tensor",
    f"roi_pool(Tensor input, Tensor rois, float spatial_scale, {POOLED}) -> (Tensor, Tensor)",
    f"_roi_pool_backward(Tensor grad, Tensor rois, Tensor argmax, float spatial_scale, {POOLED}, {BATCH}) -> Tensor",
    f"ps_roi_align(Tensor input, Tensor rois, float spatial_scale, {POOLED}, int sampling_ratio) -> (Tensor, Tensor)",
    f"_ps_roi_align_backward(Tensor grad, Tensor rois, Tensor channel_mapping, float spatial_scale, {POOLED}, "
    f"int sampling_ratio, {BATCH}) -> Tensor",
    f"ps_roi_pool(Tensor input, Tensor rois, float spatial_scale, {POOLED}) -> (Tensor, Tensor)",
    f"_ps_roi_pool_backward(Tensor grad, Tensor rois, Tensor channel_mapping, float spatial_scale, {POOLED}, {BATCH}) "
    "-> Tensor",
    f"deform_conv2d(Tensor input, Tensor weight, Tensor offset, Tensor mask, Tensor bias, {DEFORM}) -> Tensor",
    f"_deform_conv2d_backward(Tensor grad, Tensor input, Tensor weight, Tensor offset, Tensor mask, Tensor bias, "
    f"{DEFORM}) -> (Tensor, Tensor, Tensor, Tensor, Tensor)",
]
_library: list[torch.library.Library] = []  # kept: operators vanish with their library


def nms(dets: torch.Tensor, scores: torch.Tensor, iou_threshold: float) -> torch.Tensor:
    """Indices of the boxes (n, 4) kept, best first: each removes the later ones that overlap it more than the threshold."""
    order = scores.detach().sort(descending=True, stable=True)[1]
    boxes = dets.detach().float()[order]
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    alive = torch.ones(len(boxes), dtype=torch.bool)
    keep = []
    for i in range(len(boxes)):
        if alive[i]:
            keep.append(i)
            low, high = torch.maximum(boxes[i, :2], boxes[:, :2]), torch.minimum(boxes[i, 2:], boxes[:, 2:])
            both = (high - low).clamp(min=0).prod(dim=1)
            alive &= both <= iou_threshold * (area[i] + area - both)
    return order[torch.tensor(keep, dtype=torch.long)]


def _alike(rois: torch.Tensor, scale: float, rows: int, cols: int, ratio: int, aligned: bool) -> Iterator[tuple]:
    """Groups of boxes of one image and one number of samples per bin: image, indices, samples in rows and in columns."""
    image = rois[:, 0].long()
    if ratio > 0:
        down = across = torch.full_like(image, ratio)
    else:
        size = (rois[:, 3:5] - rois[:, 1:3]).float() * scale
        size = size if aligned else size.clamp(min=1.0)
        across = torch.ceil(size[:, 0] / cols).long().clamp(min=1)
        down = torch.ceil(size[:, 1] / rows).long().clamp(min=1)
    kinds, which = torch.unique(torch.stack([image, down, across], 1), dim=0, return_inverse=True)
    for k, (n, a, b) in enumerate(kinds.tolist()):
        yield n, torch.nonzero(which == k)[:, 0], a, b


def _samples(rois, scale, rows, cols, down, across, aligned, height, width) -> tuple[torch.Tensor, torch.Tensor]:
    """Where boxes are sampled, in grid_sample's coordinates, and which of the samples lie in the image."""
    off = 0.5 if aligned else 0.0
    x0, y0, x1, y1 = (rois[:, 1:].float() * scale - off).unbind(1)
    w, h = x1 - x0, y1 - y0
    if not aligned:
        w, h = w.clamp(min=1.0), h.clamp(min=1.0)
    y = y0[:, None] + (torch.arange(rows * down) + 0.5) * (h / (rows * down))[:, None]
    x = x0[:, None] + (torch.arange(cols * across) + 0.5) * (w / (cols * across))[:, None]
    inside = ((y >= -1) & (y <= height))[:, :, None] & ((x >= -1) & (x <= width))[:, None, :]
    y = y.clamp(0, height - 1) * (2 / max(height - 1, 1)) - 1
    x = x.clamp(0, width - 1) * (2 / max(width - 1, 1)) - 1
    shape = (len(rois), rows * down, cols * across)
    grid = torch.stack([x[:, None, :].expand(shape), y[:, :, None].expand(shape)], -1)
    return grid.reshape(1, -1, cols * across, 2), inside.reshape(1, -1, cols * across)


def roi_align(input, rois, spatial_scale, pooled_height, pooled_width, sampling_ratio, aligned):
    """Means of bilinear samples in the bins of boxes (k, 5: image, x0, y0, x1, y1): (k, channels, rows, cols)."""
    _, channels, height, width = input.shape
    out = input.new_zeros(len(rois), channels, pooled_height, pooled_width)
    for n, k, down, across in _alike(rois, spatial_scale, pooled_height, pooled_width, sampling_ratio, aligned):
        grid, inside = _samples(
            rois[k], spatial_scale, pooled_height, pooled_width, down, across, aligned, height, width
        )
        values = F.grid_sample(input[n : n + 1].float(), grid, padding_mode="border", align_corners=True)[0] * inside
        values = F.avg_pool2d(values, (down, across)).reshape(channels, len(k), pooled_height, pooled_width)
        out[k] = values.transpose(0, 1).to(out.dtype)
    return out


def roi_align_backward(
    grad, rois, spatial_scale, pooled_height, pooled_width, batch_size, channels, height, width, sampling_ratio, aligned
):
    """The gradient of `roi_align` at its input."""
    result = grad.new_zeros(batch_size, channels, height, width)
    for n, k, down, across in _alike(rois, spatial_scale, pooled_height, pooled_width, sampling_ratio, aligned):
        grid, inside = _samples(
            rois[k], spatial_scale, pooled_height, pooled_width, down, across, aligned, height, width
        )
        part = grad[k].transpose(0, 1).reshape(channels, len(k) * pooled_height, pooled_width).float()
        part = (part / (down * across)).repeat_interleave(down, 1).repeat_interleave(across, 2) * inside
        blank = part.new_zeros(1, channels, height, width)
        result[n : n + 1] += torch.ops.aten.grid_sampler_2d_backward(
            part[None].contiguous(), blank, grid, 0, 1, True, [True, False]
        )[0].to(result.dtype)
    return result


def _define() -> None:
    library = torch.library.Library("torchvision", "DEF")
    for schema in SCHEMAS:
        library.define(schema)
    library.impl("nms", nms, "CPU")
    library.impl("roi_align", roi_align, "CPU")
    library.impl("_roi_align_backward", roi_align_backward, "CPU")
    library.impl("_cuda_version", lambda: -1, "CompositeExplicitAutograd")
    _library.append(library)


def usable() -> bool:
    """Import torchvision, with stand-ins where its own operators cannot load; False where it is not installed."""
    load = torch.ops.load_library

    def load_or_define(path: str) -> None:
        try:
            load(path)
        except OSError:
            if "torchvision" not in str(path) or not str(path).endswith(("_C.so", "_C_stable.so")):
                raise
            _define()

    torch.ops.load_library = load_or_define
    try:
        import torchvision  # noqa: F401
    except ModuleNotFoundError:
        return False
    finally:
        torch.ops.load_library = load
    return True
