"""What simulated cities are made of: planar faces, ground paints, draped photographs; and where a building's own frame stands.

A **section** is one planar part of a roof, numbered from 1; what lies on a section (dormer, chimney, solar panel) is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np

from kibs_steps.simulate.surfaces import Material

ROOF, WALL, TREE, CAR, CLUTTER, OBJECT = range(6)  # kinds of faces; CLUTTER stands on a roof, OBJECT on the ground

Option = TypeVar("Option")


def pick(rng: np.random.Generator, options: Sequence[Option]) -> Option:
    """One of several options, all equally likely."""
    return options[int(rng.random() * len(options))]


class Face(NamedTuple):
    """A planar polygon: ring (n, 3) and holes, map metres, absolute z, counter-clockwise seen from outside."""

    ring: np.ndarray
    holes: tuple[np.ndarray, ...] = ()
    kind: int = OBJECT
    section: int = 0
    building: int = 0
    material: int = 0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    photograph: int = -1  # index into the city's photographs, −1 none


class Photograph(NamedTuple):
    """A photograph taken from above, uint8 (h, w, 3), draped over faces: `onto` (2, 3) gives px (col, row) of map metres;
    `gamma` is how its values are stretched."""

    rgb: np.ndarray
    onto: np.ndarray
    gamma: float = 1.0


class Paint(NamedTuple):
    """A polygon (n, 2) map metres of one material on the ground; `angle` (rad) of its texture's u axis."""

    ring: np.ndarray
    material: int
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    angle: float = 0.0


class City(NamedTuple):
    """Faces, ground paints and the materials both index; the photographs faces index."""

    faces: list[Face]
    paints: list[Paint]
    materials: list[Material]
    photographs: Sequence[Photograph] = ()


class Place(NamedTuple):
    """Where a building's own frame stands: position (m), angle of its x axis (rad), base (m absolute)."""

    x: float
    y: float
    angle: float
    base: float = 0.0

    def put(self, ring: np.ndarray) -> np.ndarray:
        """A ring (n, 2 or 3) of the building's frame in map metres."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        if ring.shape[1] == 2:
            return ring @ np.array([[c, s], [-s, c]]) + (self.x, self.y)
        return ring @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (self.x, self.y, self.base)


@lru_cache(maxsize=16)
def crowns(count: int) -> list[np.ndarray]:
    """A dozen crowns of `count` tilted leafy discs (count, 8, 3), radius 1, from −1 to 1 high; 0: conifers."""
    rng = np.random.default_rng(count)
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    made = []
    for _ in range(12):
        if count:
            direction = rng.normal(size=(count, 3))
            direction[:, 2] = np.abs(direction[:, 2]) - 0.2
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            direction[0] = (0, 0, -0.3)  # a wide one below closes the crown
            centre = direction * [0.62, 0.62, 0.8]
            size = rng.uniform(0.38, 0.62, count)
            size[0] = 0.85
            normal = direction * [0.8, 0.8, 1.0] + [0, 0, 0.55]
        else:
            share = np.array([0.0, 0.3, 0.58, 0.85])
            centre = np.column_stack([0 * share, 0 * share, share])
            size = 1 - 0.85 * share
            normal = rng.normal(0, 0.15, (4, 3)) + np.array([0, 0, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        side = np.cross(normal, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        other = np.cross(normal, side)
        reach = size[:, None, None] * rng.uniform(0.75, 1.15, (len(size), 8, 1))
        spokes = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None]
        made.append(centre[:, None] + reach * spokes)
    return made
