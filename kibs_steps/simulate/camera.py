"""From radiance to the picture a vendor delivers: atmosphere, optics, noise, pansharpening, stretch, JPEG.

In: linear radiance on the sample grid (two samples per pixel and axis, see `scene`). Out: RGB uint8. Every scene draws its own
`Camera`, because every product looks different.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np


class Camera(NamedTuple):
    """How one product looks."""

    blur: float  # px, σ of the point spread
    haze: tuple[float, float, float]  # added radiance, share of the scene's mean
    noise: float  # share of full scale
    chroma: float  # px, blur of colour against brightness (pansharpening)
    fringe: tuple[float, float]  # px, shift of colour against brightness
    sharpen: float
    gamma: float
    dark: float  # share of pixels clipped to black
    bright: float  # share clipped to white
    top: float  # brightness of the bright end, 0–1
    balance: tuple[float, float, float]
    saturation: float
    jpeg: int  # quality, 0 none


CLEAR = Camera(  # what is ordered for mapping: little haze, sharp optics, stretched over its whole range
    blur=0.55,
    haze=(0.035, 0.06, 0.1),
    noise=0.004,
    chroma=0.8,
    fringe=(0.0, 0.0),
    sharpen=0.4,
    gamma=1.8,
    dark=0.002,
    bright=0.004,
    top=0.98,
    balance=(1.0, 1.0, 1.0),
    saturation=0.95,
    jpeg=0,
)


def camera(rng: np.random.Generator) -> Camera:
    """A camera and its processing, drawn at random."""
    blue = 0.04 + rng.gamma(1.2, 0.13)
    return Camera(
        blur=rng.uniform(0.4, 1.3) if rng.random() < 0.85 else rng.uniform(1.3, 1.8),
        haze=(0.35 * blue, 0.6 * blue, blue),
        noise=float(rng.choice([rng.uniform(0.001, 0.008), rng.uniform(0.008, 0.03)], p=[0.75, 0.25])),
        chroma=float(rng.choice([0.0, rng.uniform(0.8, 3.0)])),
        fringe=tuple(rng.normal(0, 0.5, 2)) if rng.random() < 0.4 else (0.0, 0.0),
        sharpen=float(rng.choice([0.0, rng.uniform(0.2, 1.2)])),
        gamma=rng.uniform(1.15, 2.3),
        dark=float(rng.choice([0.0005, rng.uniform(0.001, 0.03)])),
        bright=float(rng.choice([0.0005, rng.uniform(0.001, 0.03)])),
        top=rng.uniform(0.6, 1.02),
        balance=tuple(np.exp(rng.normal(0, 0.06, 3))),
        saturation=rng.uniform(0.4, 1.2),
        jpeg=int(rng.integers(55, 97)) if rng.random() < 0.5 else 0,
    )


def _gaussian(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101) if sigma > 0.05 else image


def photograph(radiance: np.ndarray, look: Camera, rng: np.random.Generator) -> np.ndarray:
    """RGB uint8 (h, w, 3) of radiance float32 (2h + 1, 2w + 1, 3) sampled at every half pixel, pixel edges included."""
    # Averaging over the pixel: samples at its edges count half.
    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    image = cv2.sepFilter2D(radiance, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    image = _gaussian(image, 2 * np.sqrt(max(look.blur**2 - 0.1, 0.0)))[1::2, 1::2]
    image = image + np.float32(image.mean()) * np.array(look.haze, np.float32)
    low, high = np.quantile(image[::3, ::3], [look.dark, 1 - look.bright])
    image = (image - 0.9 * low) / max(high - 0.9 * low, 1e-6) * look.top
    image = np.clip(image, 0, 1.3) ** (1 / look.gamma)
    image = image * np.array(look.balance, np.float32)
    grey = image.mean(axis=2, keepdims=True)
    colour = (image - grey) * look.saturation
    colour = _gaussian(colour, look.chroma)
    if any(look.fringe):
        shift = np.array([[1, 0, look.fringe[0]], [0, 1, look.fringe[1]]], np.float32)
        colour = cv2.warpAffine(colour, shift, colour.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
    grey = grey[..., 0]
    if look.sharpen:
        grey = grey + look.sharpen * (grey - _gaussian(grey, 1.2))
    image = grey[..., None] + colour
    image += look.noise * rng.standard_normal(image.shape, np.float32)
    picture = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    if look.jpeg:
        _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, look.jpeg])
        picture = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    return picture
