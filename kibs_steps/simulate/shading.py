"""Colours of what is seen: paint on the ground, photographs, textures, sun with cast shadows, sky, the lines of roof edges.

In: a city, what each sample shows, the sun. Out: linear radiance of all samples.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from kibs_steps import zbuffer
from kibs_steps.grid import Grid
from kibs_steps.scene import Direction
from kibs_steps.simulate import light
from kibs_steps.simulate.pieces import City
from kibs_steps.simulate.truth import SectionTruth

STRIP = 256  # rows shaded at a time
BIAS = 0.2  # m: a face this little above another does not shade it


class Seen(NamedTuple):
    """Per sample: shown face (−1 ground) with its position, and the section seen through roof furniture (0 none)."""

    face: np.ndarray
    points: np.ndarray
    ground: np.ndarray
    section: np.ndarray
    section_z: np.ndarray


def radiance_of(
    city: City,
    seen: Seen,
    samples: Grid,
    sun: Direction,
    rng: np.random.Generator,
    sections: list[SectionTruth],
    backgrounds: list[tuple[np.ndarray, np.ndarray]] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (rows, cols, 3) of all samples, in strips of rows to bound the memory, and where the sun shines (0, 1)."""
    # Textures in float32 need small coordinates: an origin near by.
    origin = np.array([samples.x0, samples.y0, 0.0])
    near = city._replace(faces=[f._replace(ring=f.ring - origin) for f in city.faces])
    table = light.surfaces(near.faces, city.paints, city.materials, rng)
    source = light.light(sun.lean, rng)
    toward = source.direction.astype(np.float32)
    shape = seen.face.shape
    index = np.where(seen.face >= 0, seen.face, len(city.faces) + _paint(city, samples))
    facing = (table.normal @ toward > 0) | table.leafy
    lit = _lit(city, seen, samples, sun.lean, facing[index])
    sky = light.openness((seen.points[..., 2] - seen.ground).astype(np.float32), samples.gsd)
    rims = 1 + _rims(city, sections, shape, rng) * (table.rim[index] != 0)
    photograph = _photograph(shape, backgrounds, rng) if backgrounds else None
    shine = np.empty((*shape, 3), np.float32)
    for start in range(0, shape[0], STRIP):
        rows = np.s_[start : start + STRIP]
        which = index[rows].ravel()
        points = (seen.points[rows] - origin).astype(np.float32).reshape(-1, 3)
        colour = light.albedo(which, points, table, city.materials, rng)
        _drape(city, which, points, origin, colour)
        if photograph:
            chosen = (which >= len(city.faces)) & photograph[1][rows].ravel()
            colour[chosen] = photograph[0][rows].reshape(-1, 3)[chosen]
        light_here = light.radiance(
            colour * rims[rows].reshape(-1, 1),
            np.take(table.normal, which, axis=0),
            np.take(table.leafy, which),
            lit[rows].ravel(),
            sky[rows].ravel(),
            source,
        )
        shine[rows] = light_here.reshape(-1, shape[1], 3)
    return shine, lit


def _drape(city: City, which: np.ndarray, points: np.ndarray, origin: np.ndarray, colour: np.ndarray) -> None:
    """Give samples (n,) of faces with photographs their colours, in place; `points` (n, 3) are m from `origin`."""
    if not len(city.photographs):
        return
    owner = np.array([f.photograph for f in city.faces] + [-1] * len(city.paints))[which]
    for i in np.unique(owner[owner >= 0]).tolist():
        some = np.flatnonzero(owner == i)
        picture = city.photographs[i]
        at = points[some, :2] @ picture.onto[:, :2].T + (picture.onto[:, 2] + picture.onto[:, :2] @ origin[:2]) - 0.5
        limit = np.array(picture.rgb.shape[1::-1]) - 1.001
        at = np.clip(at, 0, limit)
        col, row = at.astype(np.int32).T
        u, v = (at - np.floor(at)).T[..., None]
        p = picture.rgb.astype(np.float32)
        top, low = p[row, col] * (1 - u) + p[row, col + 1] * u, p[row + 1, col] * (1 - u) + p[row + 1, col + 1] * u
        mixed = (top * (1 - v) + low * v) / 255
        colour[some] *= 0.75 * mixed ** (2.0 * picture.gamma)


def _lit(city: City, seen: Seen, samples: Grid, sun: tuple[float, float], facing: np.ndarray) -> np.ndarray:
    """Whether the sun reaches each sample: 1 or 0, from a depth map in the sun's own frame."""
    base = float(seen.ground.mean())
    step = samples.gsd
    x, y, z = (seen.points[..., i].ravel() for i in range(3))
    x, y = x - (z - base) * sun[0], y - (z - base) * sun[1]
    left, top = x.min() - step, y.max() + step
    width, height = int((x.max() - left) / step) + 2, int((top - y.min()) / step) + 2
    hits = zbuffer.render_faces(city.faces, sun, Grid("", left, top, step, width, height), base)
    pixel = ((top - y) / step).astype(np.int32) * width + ((x - left) / step).astype(np.int32)
    above, blocker = np.take(hits.height, pixel), np.take(hits.face, pixel)
    shaded = (above > z + BIAS) & (blocker != seen.face.ravel())
    return np.where(shaded.reshape(facing.shape) | ~facing, 0.0, 1.0).astype(np.float32)


def _paint(city: City, samples: Grid) -> np.ndarray:
    """Index of the paint on the ground at each sample."""
    canvas = np.zeros((samples.height, samples.width), np.int32)
    low, high = extents([p.ring for p in city.paints])
    meets = (high > np.array(samples.bounds[:2]) - 1).all(1) & (low < np.array(samples.bounds[2:]) + 1).all(1)
    for i in np.flatnonzero(meets).tolist():
        paint = city.paints[i]
        ring = np.round((samples.to_image(paint.ring) - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(canvas, [ring], i, shift=4)
    return canvas


def _rims(city: City, sections: list[SectionTruth], shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Relative brightness (rows, cols) float32 of the lines of tiles and gutters along the edges of sections."""
    canvas = np.zeros(shape, np.float32)
    rim = {f.section: city.materials[f.material].rim for f in city.faces if f.section}
    strength: dict[int, float] = {}
    for s in sections:
        factor = strength.setdefault(s.building, max(0.0, rng.uniform(-0.5, 1.5)))
        if s.visible and rim[s.section] * factor:
            ring = np.round(s.outline_seen[:, :2] * 32).astype(np.int32)
            cv2.polylines(canvas, [ring], True, rim[s.section] * factor, 1, cv2.LINE_8, 4)
    return canvas


def extents(rings: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of rings (n, 2 or 3): (rings, 2 or 3) each."""
    starts = np.cumsum([0] + [len(r) for r in rings[:-1]])
    points = np.concatenate(rings)
    return np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)


def _photograph(
    shape: tuple[int, int], backgrounds: list[tuple[np.ndarray, np.ndarray]], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A photograph as albedo (rows, cols, 3) float32 of the samples, turned and scaled at random, and where it is usable."""
    picture, usable = backgrounds[int(rng.integers(len(backgrounds)))]
    turn = int(rng.integers(4))
    picture, usable = np.rot90(picture, turn), np.rot90(usable, turn)
    if rng.random() < 0.5:
        picture, usable = picture[:, ::-1], usable[:, ::-1]
    scale = rng.uniform(1.6, 2.6)
    need = np.array(shape) / scale
    row, col = (int(rng.integers(0, max(1, int(have - want)))) for have, want in zip(usable.shape, need, strict=True))
    onto = np.array([[scale, 0, -scale * col], [0, scale, -scale * row]], np.float32)
    size = (shape[1], shape[0])
    laid = cv2.warpAffine(np.ascontiguousarray(picture), onto, size, flags=cv2.INTER_LINEAR)
    mask = cv2.warpAffine(np.ascontiguousarray(usable).astype(np.uint8), onto, size, flags=cv2.INTER_NEAREST) > 0
    albedo = 0.75 * (laid.astype(np.float32) / 255) ** np.float32(rng.uniform(1.4, 2.2))
    return albedo, mask
