"""Off-nadir geometry: where a point stands, and where the image shows it.

All in metres: x east, y north, z up. A direction (to the satellite or the sun) is given by its azimuth, clockwise from true
north seen from the target, and its elevation above the horizon at the target. Its **lean** k = cot(elevation)·u, with u the
unit vector of the azimuth in the grid's axes, is metres of displacement per metre of height.

In a terrain-corrected image a point at P with height z is shown at P_img with
    P = P_img + (z − T(P_img))·k,                                                   (PAPER, off-nadir geometry)
T being the terrain on which the image was projected (the DTM, or one constant height Z0).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

ROUNDS = 120  # steps until places settle: a quarter of them whole ones, then halves, quarters and eighths
SETTLED = 1e-6  # m

Surface = Callable[[np.ndarray], np.ndarray]  # (n, 2) map metres -> (n,) heights in metres
Lean = tuple[float, float] | np.ndarray  # one (2,) for all points, or one for each (n, 2); m per m, grid axes


class Plane(NamedTuple):
    """z = a(x − x0) + b(y − y0) + c, metres."""

    a: float
    b: float
    c: float
    x0: float
    y0: float

    def at(self, x_y: np.ndarray) -> np.ndarray:
        """Height at map positions (n, 2)."""
        x_y = np.asarray(x_y, float)
        return self.a * (x_y[..., 0] - self.x0) + self.b * (x_y[..., 1] - self.y0) + self.c


def lean(azimuth: float, elevation: float, convergence: float = 0.0) -> tuple[float, float]:
    """Lean vector (east, north) in metres per metre of height.

    `azimuth` (deg) is clockwise from true north; `convergence` (deg) is the meridian convergence, the
    angle from true to grid north (clockwise positive), subtracted so that the vector is in grid axes.
    """
    angle = np.radians(azimuth - convergence)
    length = 1.0 / np.tan(np.radians(elevation))
    return float(length * np.sin(angle)), float(length * np.cos(angle))


def position_sigma(
    height: np.ndarray, sigma: np.ndarray, elevation: np.ndarray, angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """σ (m) of where a point stands, along the azimuth of the view and across it (PAPER, off-nadir geometry).

    `height` above ground and its `sigma` (m), `elevation` of the view (deg), `angle`: σ of both view angles (deg).
    """
    el, by = np.radians(elevation), np.radians(angle)
    along = np.hypot(sigma / np.tan(el), height * by / np.sin(el) ** 2)
    return along, np.abs(height / np.tan(el) * by)


def ground_position(
    image: np.ndarray, height: np.ndarray, terrain: Surface, k: Lean, projected_on: Surface | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Where points seen at `image` (n, 2 map metres) with `height` (n, m above the ground under them) really are.

    Iterates P_{j+1} = P_img + (h + T(P_j) − T0(P_img))·k, T0 being the surface the image was projected on (the terrain
    itself unless given); converges while |slope|·|k| < 1, and by shorter steps where the ground falls away more steeply. Returns
    positions (n, 2) and absolute heights (n,).
    """
    image = np.asarray(image, float)
    k = np.asarray(k, float)
    base = (projected_on or terrain)(image)
    height, k = np.broadcast_to(np.asarray(height, float), base.shape), np.broadcast_to(k, image.shape)

    def step(at: np.ndarray, some: np.ndarray) -> np.ndarray:
        return image[some] + (height[some] + terrain(at) - base[some])[:, None] * k[some]

    position = _settled(image + height[:, None] * k, step)
    return position, terrain(position) + height


def _settled(position: np.ndarray, step: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Where points (n, 2) come to rest by steps from place to place (m) of some of them (indices).

    Each does by itself, whatever others do; those that swing about their place are taken there by shorter and shorter steps.
    """
    position = position.copy()
    moving = np.arange(len(position))
    for number in range(ROUNDS):
        before = position[moving]
        moved = step(before, moving)
        if number >= ROUNDS // 4:
            moved = before + 0.5 ** (4 * number // ROUNDS) * (moved - before)
        position[moving] = moved
        moving = moving[np.abs(moved - before).max(axis=-1) >= SETTLED]
        if not len(moving):
            break
    return position


def image_position(ground: np.ndarray, z: np.ndarray, k: Lean, projected_on: Surface) -> np.ndarray:
    """Where the image shows points standing at `ground` (n, 2) with absolute height `z` (n,): the inverse of the above."""
    ground = np.asarray(ground, float)
    k = np.asarray(k, float)
    z, k = np.broadcast_to(np.asarray(z, float), ground.shape[:-1]), np.broadcast_to(k, ground.shape)
    return _settled(ground, lambda at, some: ground[some] - (z[some] - projected_on(at))[:, None] * k[some])


def ray_meets_plane(image: np.ndarray, plane: Plane, k: Lean, projected_on: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Where the view rays of pixels `image` (n, 2 map metres) meet a plane: positions (n, 2) and absolute heights (n,).

    On the ray P = P_img + (z − T0)·k, so z·(1 − g·k) = plane(P_img) − T0·(g·k) with g = (a, b): closed form. A plane seen
    edge-on (g·k → 1) has no meeting point; callers bound the slope.
    """
    image = np.asarray(image, float)
    k = np.asarray(k, float)
    base = projected_on(image)
    steepness = plane.a * k[..., 0] + plane.b * k[..., 1]
    z = (plane.at(image) - base * steepness) / (1.0 - steepness)
    return image + (z - base)[..., None] * k, z
