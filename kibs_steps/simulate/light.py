"""Light on surfaces: textures, sun with cast shadows, sky.

In: for every sample the surface it shows (a face or a ground paint) and its position; the surfaces' axes and materials. Out:
linear radiance. All arrays are flat, one entry per sample; colours are linear RGB with albedo in 0–1.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from kibs_steps import zbuffer
from kibs_steps.simulate.pieces import ROOF, TREE, WALL, Face, Paint
from kibs_steps.simulate.surfaces import Material

SIDE = 512  # samples of the noise, 0.25 m each


class Surfaces(NamedTuple):
    """All surfaces of a scene, faces first, then paints: what shading needs, float32, one row per surface."""

    origin: np.ndarray  # (n, 3) m
    u: np.ndarray  # (n, 3) unit, along the eave
    v: np.ndarray  # (n, 3) unit, up the slope
    length: np.ndarray  # (n,) m from lowest to highest v
    normal: np.ndarray  # (n, 3)
    colour: np.ndarray  # (n, 3) albedo × tint
    material: np.ndarray  # (n,)
    shift: np.ndarray  # (n, 2) place in the noise
    upright: np.ndarray  # (n,) a wall
    leafy: np.ndarray  # (n,) a tree
    rim: np.ndarray  # (n,) strength of the lines along its edges, 0 off roof sections


class Light(NamedTuple):
    """Colours of sun and sky (linear RGB) and the direction to the sun (unit vector)."""

    direction: np.ndarray
    sun: np.ndarray
    sky: np.ndarray


@lru_cache(maxsize=1)
def noise() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean 0, deviation 1: two tileable fields (SIDE, SIDE), patches of all scales and clumps of about a metre; grain (n,)."""
    rng = np.random.default_rng(7)
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None]
    f = np.hypot(fx, fy)
    f[0, 0] = 1.0
    fields = []
    for spectrum in (f**-1.1 * (f > 1.5 / SIDE), f**-0.6 * (f > 0.02) * (f < 0.45)):
        white = np.fft.rfft2(rng.normal(size=(SIDE, SIDE)))
        field = np.fft.irfft2(white * spectrum, (SIDE, SIDE))
        fields.append((field / field.std()).astype(np.float32))
    return fields[0], fields[1], rng.standard_normal(1 << 20, np.float32)


def light(sun_lean: tuple[float, float], rng: np.random.Generator) -> Light:
    """Sun and sky for a sun of that lean: lower suns are warmer and weaker, skies are blue or overcast."""
    direction = np.array([sun_lean[0], sun_lean[1], 1.0])
    direction /= np.linalg.norm(direction)
    low = 1.0 - direction[2]
    clear = rng.beta(3.0, 1.0)
    sun = np.array([1.0, 0.97 - 0.10 * low, 0.90 - 0.28 * low]) * (0.35 + 0.65 * clear) * 1.9
    sky = np.array([0.78, 0.92, 1.18]) * clear + (1 - clear) * np.array([0.98, 1.0, 1.02])
    return Light(direction, sun, sky * rng.uniform(0.18, 0.42) * (1.0 + 1.2 * (1 - clear)))


def surfaces(faces: list[Face], paints: list[Paint], materials: list[Material], rng: np.random.Generator) -> Surfaces:
    """Axes, normals and colours of all faces and paints."""
    planes = zbuffer.planes(faces)
    n, m = len(faces), len(paints)
    normal = np.concatenate([planes.normal, np.broadcast_to([0.0, 0.0, 1.0], (m, 3))])
    u = np.cross([0.0, 0.0, 1.0], normal)
    size = np.linalg.norm(u, axis=1)
    level = size < 0.03
    u = u / np.maximum(size, 1e-9)[:, None]
    if n:
        first = np.array([f.ring[1] - f.ring[0] for f in faces])
        first[:, 2] = 0
        reach = np.linalg.norm(first, axis=1)
        usable = level[:n] & (reach > 1e-6)
        u[:n][usable] = first[usable] / reach[usable, None]
    angle = np.array([p.angle for p in paints])
    u[n:] = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(m)])
    v = np.cross(normal, u)
    origin = np.concatenate([planes.point, np.zeros((m, 3))])
    length = np.full(n + m, 1e6)
    if n:
        counts = np.array([len(f.ring) for f in faces])
        along = np.einsum(
            "ij,ij->i",
            np.concatenate([f.ring for f in faces]) - np.repeat(planes.point, counts, 0),
            np.repeat(v[:n], counts, 0),
        )
        starts = np.cumsum(counts) - counts
        low, high = np.minimum.reduceat(along, starts), np.maximum.reduceat(along, starts)
        origin[:n] += v[:n] * low[:, None]
        length[:n] = high - low
    material = np.array([f.material for f in faces] + [p.material for p in paints])
    tint = np.array([f.tint for f in faces] + [p.tint for p in paints])
    kind = np.array([f.kind for f in faces] + [-1] * m)
    colour = np.array([c.colour for c in materials])[material] * tint
    rim = np.array([c.rim for c in materials], np.float32)[material]
    single = [origin, u, v, length, normal, colour]
    return Surfaces(
        *(a.astype(np.float32) for a in single),
        material,
        rng.integers(0, SIDE, (n + m, 2)).astype(np.float32),
        kind == WALL,
        kind == TREE,
        np.where(kind == ROOF, rim, 0.0),
    )


def albedo(
    index: np.ndarray, points: np.ndarray, table: Surfaces, materials: list[Material], rng: np.random.Generator
) -> np.ndarray:
    """Albedo (n, 3) float32 of samples of surfaces `index` (n,) at `points` (n, 3) float32 m."""
    patches, clumps, white = noise()
    x, y, z = points.T

    def along(axis: np.ndarray) -> np.ndarray:
        start = np.einsum("ij,ij->i", table.origin, axis)
        parts = (np.take(np.ascontiguousarray(axis[:, i]), index) for i in range(3))
        return sum(p * q for p, q in zip(parts, (x, y, z), strict=True)) - np.take(start, index)

    u, v = along(table.u), along(table.v)
    kind = np.take(table.material, index)
    shift = np.take(table.shift, index, axis=0)
    columns = {name: np.array([getattr(m, name) for m in materials], np.float32) for name in Material._fields[1:]}

    def of(name: str) -> np.ndarray:
        return np.take(columns[name], kind)

    def look(field: np.ndarray, a: np.ndarray, b: np.ndarray, shift: np.ndarray) -> np.ndarray:
        col, row = (a + shift[:, 0]).astype(np.int32) & (SIDE - 1), (b + shift[:, 1]).astype(np.int32) & (SIDE - 1)
        return np.take(field.ravel(), row * SIDE + col)

    change = of("mottle") * look(patches, 4 * u, 4 * v, shift)
    start = int(rng.integers(len(white)))
    change += of("grain") * np.take(white, np.arange(start, start + len(u)), mode="wrap")
    change += of("leaf") * look(clumps, 2.5 * u, 2.5 * v, shift)
    some = np.flatnonzero(of("streak") > 0)
    if len(some):
        change[some] += of("streak")[some] * look(patches, 5 * u[some], 0.35 * v[some], shift[some])
    for period, depth, place in (("course", "course_depth", v), ("seam", "seam_depth", u)):
        some = np.flatnonzero(of(period) > 0)
        phase = place[some] / of(period)[some]
        change[some] -= of(depth)[some] * ((phase - np.floor(phase)) < 0.3)
    colour = np.take(table.colour, index, axis=0) * np.clip(1 + change, 0.15, 2.5)[:, None]
    some = np.flatnonzero(np.take(table.upright, index) & (of("storey") > 0))
    if len(some):
        storey, bay, glass = (columns[c][kind[some]] for c in ("storey", "bay", "glass"))
        # Windows from the top down, so that no storey is cut at the eave.
        down = (table.length[index[some]] - v[some]) / storey
        across = u[some] / bay
        fu, fv = across - np.floor(across), down - np.floor(down)
        window = (np.abs(fu - 0.5) < glass / 2) & (fv > 0.22) & (fv < 0.72) & (v[some] > 0.8)
        pane = (np.floor(across) * 7.13 + np.floor(down) * 3.71 + kind[some] + table.shift[index[some], 0]) % 1.0
        colour[some[window]] = np.array([0.05, 0.06, 0.075], np.float32) * (0.5 + 3.0 * pane[window, None] ** 3)
    return colour


def openness(height: np.ndarray, step: float) -> np.ndarray:
    """Share of the sky that samples see, 0.4–1, from what stands around: `height` (rows, cols) m above ground, `step` m/px."""
    small = cv2.resize(height.astype(np.float32), None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
    around = np.zeros_like(small)
    for reach in (2.5, 8.0):
        around += 0.5 * cv2.GaussianBlur(small, (0, 0), max(reach / (8 * step), 0.5), borderType=cv2.BORDER_REPLICATE)
    around = cv2.resize(around, height.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return 1.0 / (1.0 + 0.09 * np.clip(around - height, 0, 15)).astype(np.float32)


def radiance(
    colour: np.ndarray, normal: np.ndarray, leafy: np.ndarray, lit: np.ndarray, sky: np.ndarray, source: Light
) -> np.ndarray:
    """Radiance (n, 3) leaving samples: sun where `lit` (n,) 0–1, sky by its share `sky` (n,), a little light from the ground."""
    facing = normal @ source.direction.astype(np.float32)
    # Leaves let light through and face all ways: softer.
    facing = np.where(leafy, 0.35 + 0.65 * facing, facing)
    direct = (np.clip(facing, 0, None) * lit)[:, None] * source.sun.astype(np.float32)
    up = (0.5 + 0.5 * normal[:, 2]) * sky
    diffuse = up[:, None] * source.sky.astype(np.float32)
    bounce = ((0.5 - 0.5 * normal[:, 2]) * 0.16)[:, None] * source.sun.astype(np.float32)
    return colour * (direct + diffuse + bounce)
