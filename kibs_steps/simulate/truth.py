"""Truth of a simulated picture: where its roof sections are seen and stand, and which of their corners can be seen.

In: a city's faces, the terrain, the view, the labels of what is seen. Out: a `SectionTruth` per section, corners.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from kibs_steps import view as geometry
from kibs_steps import zbuffer
from kibs_steps.grid import Grid
from kibs_steps.simulate.pieces import ROOF, City
from kibs_steps.terrain import Terrain


class SectionTruth(NamedTuple):
    """One roof section: where it is seen (px col, row, height above ground in m) and where it stands (map m, absolute z)."""

    section: int
    building: int
    outline_seen: np.ndarray
    outline_map: np.ndarray
    holes_seen: tuple[np.ndarray, ...]
    holes_map: tuple[np.ndarray, ...]
    visible: float


def sample_frame(grid: Grid) -> Grid:
    """The grid of samples: one at every half pixel, pixel edges included."""
    half = grid.gsd / 2
    return Grid(grid.crs, grid.x0 - half / 2, grid.y0 + half / 2, half, 2 * grid.width + 1, 2 * grid.height + 1)


def section_truths(
    city: City, terrain: Terrain, grid: Grid, k: tuple[float, float], seen: np.ndarray
) -> list[SectionTruth]:
    counts = np.bincount(seen.ravel())
    roofs = [f for f in city.faces if f.kind == ROOF and f.section]
    if not roofs:
        return []
    rings = [ring for f in roofs for ring in (f.ring, *f.holes)]
    points = np.concatenate(rings)
    above = points[:, 2] - terrain(points[:, :2])
    placed = geometry.image_position(points[:, :2], points[:, 2], k, terrain)
    at = grid.to_image(placed)
    # Counted where the image shows them: on a slope it is squeezed or stretched.
    flat = np.split(np.column_stack([placed, points[:, 2]]), np.cumsum([len(r) for r in rings])[:-1])
    first = np.cumsum([0, *(1 + len(f.holes) for f in roofs)]).tolist()
    drawn = [zbuffer.Polygon(flat[a], tuple(flat[a + 1 : b])) for a, b in pairwise(first)]
    whole = zbuffer.pixel_counts(drawn, (0.0, 0.0), sample_frame(grid))
    shown = np.split(np.column_stack([at, above]), np.cumsum([len(r) for r in rings])[:-1])
    out, i = [], 0
    for face, size in zip(roofs, whole, strict=True):
        outline, holes = shown[i], tuple(shown[i + 1 : i + 1 + len(face.holes)])
        i += 1 + len(face.holes)
        low, high = outline[:, :2].min(0), outline[:, :2].max(0)
        if (high < 0).any() or low[0] > grid.width or low[1] > grid.height:
            continue
        count = counts[face.section] if face.section < len(counts) else 0
        visible = float(np.clip(count / max(size, 1), 0, 1))
        out.append(SectionTruth(face.section, face.building, outline, face.ring, holes, face.holes, visible))
    return out


def visible_corners(sections: list[SectionTruth], labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct corners with a pixel of their section within one pixel: px, heights, section."""
    rings = [(s.section, s.building, ring) for s in sections for ring in (s.outline_seen, *s.holes_seen)]
    if not rings:
        return np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32)
    points = np.concatenate([r for _, _, r in rings])
    section = np.repeat([s for s, _, _ in rings], [len(r) for _, _, r in rings])
    building = np.repeat([b for _, b, _ in rings], [len(r) for _, _, r in rings])
    height, width = labels.shape
    inside = (points[:, 0] >= 0) & (points[:, 0] < width) & (points[:, 1] >= 0) & (points[:, 1] < height)
    points, section, building = points[inside], section[inside], building[inside]
    padded = np.pad(labels, 1)
    col, row = np.floor(points[:, 0]).astype(int) + 1, np.floor(points[:, 1]).astype(int) + 1
    seen = np.zeros(len(points), bool)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            seen |= padded[row + i, col + j] == section
    points, section, building = points[seen], section[seen], building[seen]
    # One corner of several sections (a ridge end, an eave corner) counts once: same building, 5 cm.
    key = np.column_stack([building, np.round(points[:, :2] * 4).astype(int), np.round(points[:, 2] * 20).astype(int)])
    _, first = np.unique(key, axis=0, return_index=True)
    first.sort()
    return points[first, :2].astype(np.float32), points[first, 2].astype(np.float32), section[first].astype(np.int32)
