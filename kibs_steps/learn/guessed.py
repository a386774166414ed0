"""Guessed: training samples of a raster that nobody annotated, from what a model is sure of there.

A model that has seen the look of a scene (`learn.look`) finds most of its roofs; taught by what it is sure of itself, the next
one finds those it doubted (self-training; Yarowsky 1995, for images Zou et al. 2018). In: a scene, a dense model for sections.
Out: samples of which roof and ground are known where the model is sure, sections, corners and heights nowhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kibs_steps import tiles
from kibs_steps.grid import Window
from kibs_steps.learn.samples import UNKNOWN, Sample
from kibs_steps.models import runtime
from kibs_steps.scene import Scene
from kibs_steps.simulate import rendering

ROOF, GROUND = 0.65, 0.1  # roof probability from which on, and up to which, a model is believed

Glance = Callable[[Window], tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]]


def sample(glance: Glance, window: Window, geometry: NDArray[np.float32]) -> Sample:
    """One tile with the roofs a model is sure of; what it doubts, and what holds no data, is unknown."""
    rgb, valid, likely = glance(window)
    roof = np.full(likely.shape, UNKNOWN, np.uint8)
    roof[likely >= ROOF], roof[likely <= GROUND] = 1, 0
    roof[~valid] = UNKNOWN
    return Sample.ground(rgb)._replace(
        labels=np.where(roof == 0, 0, -1).astype(np.int32),
        roof=roof,
        surface=np.where(roof == 1, rendering.ON_ROOF, UNKNOWN).astype(np.uint8),
        corners_known=np.zeros(roof.shape, np.uint8),
        geometry=geometry,
    )


def glancing(scene: Scene, network: runtime.Network, tile: int) -> Glance:
    """What a network that looks at tiles of `tile` px sees of windows no larger: image (h, w, 3), where it holds data, and roof
    probability (h, w)."""

    def glance(window: Window) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]:
        row, col = (tile - window.height) // 2, (tile - window.width) // 2
        rgb, valid = tiles.read_window(scene, Window(window.col - col, window.row - row, tile, tile))
        part = (slice(row, row + window.height), slice(col, col + window.width))
        return np.ascontiguousarray(rgb[part]), valid[part], network(rgb)["roof"][0][part]

    return glance
