"""Augmentation: what may be done to a training tile without making its truth untrue.

In and out: samples. Directions, radiometry and the brightness of roofs vary; geometry stays what it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from kibs_steps.learn.samples import Sample
from kibs_steps.models import runtime

AS_IT_IS = 0.5  # share of training tiles whose radiometry stays that of their source
FORGOTTEN = 0.15  # share of training tiles whose view a network is not told; and whose sun
REPAINTED = 0.3  # share of training tiles whose roofs get another brightness
LIKENED = 0.7  # share of training tiles that look like the scene a model is fine-tuned for, where there is one
PAVED = 0.25  # share of training tiles whose yards are laid with light stone
GROUND, SHADED_GROUND = 0, 4  # kinds of surface (docs/architecture.md, "Training samples")
YARD = 22.0  # px, about the side of a yard
OCTAVES = 3  # of detail, which sensors blur and sharpen
SHARPENED = 1.5  # most that detail is raised: more would be noise alone
PERCENTS = np.linspace(0.5, 99.5, 34)  # of pixel values, by which colours are compared


def dihedral(sample: Sample, k: int) -> Sample:
    """The sample mirrored (k ≥ 4: columns reversed first) and turned by k % 4 quarter turns counter-clockwise.

    Positions and the geometry's displacement vectors turn with the image.
    """
    turns = k % 4
    size = sample.rgb.shape[0]

    def image(a: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(a[:, ::-1] if k >= 4 else a, turns))

    corners = sample.corners.copy()
    vectors = sample.geometry[:4].reshape(2, 2).copy()
    if k >= 4:
        corners[:, 0] = size - corners[:, 0]
        vectors[:, 0] = -vectors[:, 0]
    for _ in range(turns):
        corners = np.stack([corners[:, 1], size - corners[:, 0]], axis=1)
        vectors = np.stack([vectors[:, 1], -vectors[:, 0]], axis=1)
    return Sample(
        *(image(a) for a in sample[:5]),
        corners,
        sample.corner_heights,
        image(sample.corners_known),
        np.concatenate([vectors.ravel(), sample.geometry[4:]]).astype(np.float32),
    )


def upright(sample: Sample, rng: np.random.Generator) -> Sample:
    """The sample as a mirrored network sees tiles (`runtime.shown`): one of its views in which roofs lean up, any of the eight
    where they do not lean."""
    turn = int(rng.integers(8))
    if not runtime.leans(sample.geometry):
        return dihedral(sample, turn)
    up = next(s for s in (dihedral(sample, k) for k in range(8)) if runtime.leans_up(*s.geometry[:2]))
    return dihedral(up, 4) if turn % 2 else up


def without_geometry(
    sample: Sample, rng: np.random.Generator, shares: tuple[float, float] = (FORGOTTEN, FORGOTTEN)
) -> Sample:
    """Forgets now the view, now the sun, each in its share of the tiles, so that a network learns to do without."""
    geometry = sample.geometry.copy()
    for share, columns in zip(shares, runtime.TOLD.values(), strict=True):
        if rng.random() < share:
            geometry[columns] = 0
    return sample._replace(geometry=geometry)


def radiometry(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another sensor, stretch and weather over the same scene, uint8 (h, w, 3)."""
    x = rgb.astype(np.float32) / 255
    rows, cols = rgb.shape[:2]
    if rng.random() < 0.4:  # coarser pixels drawn larger, as pansharpened and resampled imagery is
        factor = np.exp(rng.uniform(0.0, 1.0))
        small = cv2.resize(x, (round(cols / factor), round(rows / factor)), interpolation=cv2.INTER_AREA)
        x = cv2.resize(small, (cols, rows), interpolation=cv2.INTER_CUBIC if rng.random() < 0.5 else cv2.INTER_LINEAR)
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.0))
    if rng.random() < 0.25:  # colours coarser than brightness, as after pansharpening
        grey = x.mean(2, keepdims=True)
        x = grey + cv2.GaussianBlur(x - grey, (0, 0), rng.uniform(0.8, 2.5))
    if rng.random() < 0.25:  # sharpened by the vendor
        x = x + rng.uniform(0.2, 1.0) * (x - cv2.GaussianBlur(x, (0, 0), 1.0))
    grey = x.mean(2, keepdims=True)
    saturation = rng.uniform(0.0, 0.4) if rng.random() < 0.12 else np.exp(rng.normal(0, 0.3))
    x = grey + saturation * (x - grey)
    if rng.random() < 0.4:  # hue: mix the bands a little
        mix = np.eye(3) + rng.normal(0, 0.08, (3, 3))
        x = x @ (mix / mix.sum(1, keepdims=True)).T.astype(np.float32)
    x = x * np.exp(rng.normal(0, 0.1, 3)).astype(np.float32)
    low, high = np.percentile(x[::4, ::4], [1, 99])
    if rng.random() < 0.5 and high > low + 0.05:  # stretched to its own range, as rasters for viewing are
        x = (x - low) / (high - low) * rng.uniform(0.7, 1.05) + rng.uniform(-0.03, 0.12)
    x = np.clip(x, 0, 1) ** np.exp(rng.normal(0, 0.35))
    x = 0.5 + np.exp(rng.normal(0, 0.2)) * (x - 0.5) + rng.normal(0, 0.07)
    if rng.random() < 0.2:  # haze
        veil = rng.uniform(0.05, 0.35)
        x = (1 - veil) * x + veil * rng.uniform(0.6, 0.9, 3)
    if rng.random() < 0.6:
        x = x + grain(rng, x.shape, rng.uniform(0.003, 0.035), 1.0 if rng.random() < 0.5 else rng.uniform(1.0, 3.0))
    out = (np.clip(x, 0, 1) * 255).astype(np.uint8)
    if rng.random() < 0.25:
        coded = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 95))])[1]
        out = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(out, dtype=np.uint8)


def grain(rng: np.random.Generator, shape: tuple[int, int, int], sigma: float, size: float) -> np.ndarray:
    """Noise (h, w, 3) of standard deviation `sigma`, in grains of `size` px: a sensor's noise on pixels `size` times as coarse as
    the image's, drawn larger. Of such blotches a network must not make edges."""
    if size == 1:
        return rng.normal(0, sigma, shape)
    small = rng.normal(0, 1, (math.ceil(shape[0] / size), math.ceil(shape[1] / size), shape[2]))
    large = cv2.resize(small, shape[1::-1], interpolation=cv2.INTER_CUBIC)
    return sigma / large.std() * large


def likened(rgb: np.ndarray, shown: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The tile (h, w, 3) uint8 as the sensor that took the image `shown` might show it: as sharp, and coloured alike.

    Detail is weighed octave by octave against the next coarser one, as what is seen differs; colours go over from half to
    wholly, band by band, by the order of their values.
    """
    own, other = octaves(rgb), octaves(shown)
    for i in range(OCTAVES):
        had, wanted = (float(bands[i].std()) / max(float(bands[OCTAVES].std()), 1e-3) for bands in (own, other))
        own[i] *= min(wanted / max(had, 1e-3), SHARPENED)
    image = sum(own[1:], own[0])
    share = rng.uniform(0.5, 1.0)
    for band in range(3):
        values = image[..., band]
        had, wanted = (np.percentile(x[::2, ::2, band], PERCENTS) for x in (image, shown))
        image[..., band] = (1 - share) * values + share * np.interp(values, had, wanted)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def in_the_look(sample: Sample, shown: Sequence[np.ndarray], rng: np.random.Generator) -> Sample | None:
    """The sample as one of the windows `shown` (n, s, s, 3) would show it, in the share LIKENED of samples; else None."""
    if not len(shown) or rng.random() >= LIKENED:
        return None
    return sample._replace(rgb=likened(sample.rgb, shown[rng.integers(len(shown))], rng))


def octaves(rgb: np.ndarray) -> list[np.ndarray]:
    """An image (h, w, 3) as OCTAVES + 1 bands of detail, finest first, and what is left of it; their sum is the image."""
    bands, image = [], rgb.astype(np.float32)
    for i in range(OCTAVES + 1):
        smooth = cv2.GaussianBlur(image, (0, 0), 0.7 * 2**i)
        bands.append(image - smooth)
        image = smooth
    return [*bands, image]


def repainted(sample: Sample, rng: np.random.Generator) -> Sample:
    """The same roofs, building by building of other brightness and colour: black slate, weathered tiles.

    Faces keep their shading to each other. Most get darker: dark roofs beside bright yards are what satellites show and
    photographs of well-lit suburbs do not.
    """
    count, buildings = cv2.connectedComponents((sample.labels > 0).astype(np.uint8), connectivity=4)
    street = rng.uniform(-1.3, 0.4)  # log of the gain: neighbours are alike
    gains = np.exp(street + rng.normal(0, 0.25, (count, 1)) + rng.normal(0, 0.06, (count, 3)))
    greyed = np.clip(rng.uniform(-0.5, 0.9) + rng.normal(0, 0.15, count), 0, 1)
    gains[0], greyed[0] = 1.0, 0.0
    rim = rng.uniform(0.5, 1.5)  # px: as the rims of the picture are mixed
    gain = cv2.GaussianBlur(gains[buildings].astype(np.float32), (0, 0), rim)
    share = cv2.GaussianBlur(greyed[buildings].astype(np.float32), (0, 0), rim)[..., None]
    rgb = sample.rgb.astype(np.float32)
    rgb = gain * (rgb + share * (rgb.mean(axis=2, keepdims=True) - rgb))
    return sample._replace(rgb=np.clip(np.rint(rgb), 0, 255).astype(np.uint8))


def paved(sample: Sample, rng: np.random.Generator) -> Sample:
    """The same roofs among yards of light, grey stone, yard by yard, as behind rows of houses; its texture and shadows stay.

    Bright yards beside dark roofs have straight rims and pass for roofs. Only what is known to be ground is paved.
    """
    roofs = sample.labels > 0
    ground = np.isin(sample.surface, (GROUND, SHADED_GROUND)) & (sample.labels == 0)
    lit = sample.surface[ground] == GROUND
    if not roofs.any() or not lit.any():
        return sample
    rows, cols = roofs.shape
    seeds = np.ones((rows, cols), np.uint8)
    seeds[tuple(rng.integers(0, (rows, cols), (int(rows * cols / YARD**2) + 1, 2)).T)] = 0
    _, yards = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L1, 3, labelType=cv2.DIST_LABEL_CCOMP)
    count = int(yards.max()) + 1
    near = cv2.distanceTransform((~roofs).astype(np.uint8), cv2.DIST_L2, 3) < rng.uniform(10, 40)
    share = np.where(rng.random(count) < rng.uniform(0.3, 0.9), rng.uniform(0.6, 1.0, count), 0.0)
    share = cv2.GaussianBlur((share[yards] * (ground & near)).astype(np.float32), (0, 0), rng.uniform(0.5, 1.2))
    rgb = sample.rgb.astype(np.float32)
    grey = rgb.mean(axis=2)
    bright = rng.uniform(90, 200) * np.exp(rng.normal(0, 0.2, (count, 1)) + rng.normal(0, 0.03, (count, 3)))
    stone = (grey / max(float(grey[ground][lit].mean()), 1.0))[..., None] * bright[yards].astype(np.float32)
    rgb += share[..., None] * (stone - rgb)
    return sample._replace(rgb=np.clip(np.rint(rgb), 0, 255).astype(np.uint8))
