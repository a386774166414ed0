"""What a parallel view sees of planar faces: a z-buffer.

Rays of one view are parallel, so on a horizontal reference plane at height `base` a point (x, y, z) is seen at
(x, y) − (z − base)·k, with k the lean of the view (`view.lean`). That map is affine: a planar polygon stays a planar polygon and
the height at which a ray meets its plane is affine in the pixel. A pixel shows the face whose hit is highest: the first one
met on the way from the satellite. The same rasteriser with the sun's lean gives the shadow map.

In: rings in map metres with absolute z, a lean, a frame (`grid.Grid`: where the pixels lie on the reference plane). Out: per
pixel centre the face and its height. Coverage is by pixel centres, so faces that share an edge never overlap nor leave gaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kibs_steps.grid import Grid

FRAGMENTS = 1 << 21  # hits worked on at a time: bounds the memory
STEP = 1e-4  # m: heights closer than this are a tie, won by the later face


class Polygon(NamedTuple):
    """A planar polygon in space: exterior ring and holes, each (n, 3) map metres with absolute z, not closed."""

    ring: np.ndarray
    holes: tuple[np.ndarray, ...] = ()


class Hits(NamedTuple):
    """What each pixel centre of a frame shows: `height` (rows, cols) in m, −inf where nothing is; `face` index or −1."""

    height: np.ndarray
    face: np.ndarray


class Planes(NamedTuple):
    """Planes of faces: unit normals (n, 3) pointing up (or sideways), and a point (n, 3) on each."""

    normal: np.ndarray
    point: np.ndarray


def _edges(faces: Sequence[Polygon]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All edges of all rings: start (e, 3), end (e, 3), face index (e,)."""
    rings = [(i, ring) for i, face in enumerate(faces) for ring in (face.ring, *face.holes)]
    counts = np.array([len(ring) for _, ring in rings])
    start = np.concatenate([ring for _, ring in rings]).astype(float)
    following = np.arange(len(start)) + 1
    last = np.cumsum(counts) - 1
    following[last] = last - counts + 1
    return start, start[following], np.repeat([i for i, _ in rings], counts)


def planes(faces: Sequence[Polygon]) -> Planes:
    """Planes of faces by Newell's rule; normals follow the ring's sense (up if counter-clockwise seen from above)."""
    if not len(faces):
        return Planes(np.zeros((0, 3)), np.zeros((0, 3)))
    counts = np.array([len(face.ring) for face in faces])
    offsets = np.cumsum(counts) - counts
    points = np.concatenate([face.ring for face in faces]).astype(float)
    centre = np.add.reduceat(points, offsets) / counts[:, None]
    local = points - np.repeat(centre, counts, axis=0)
    following = np.arange(len(points)) + 1
    following[offsets + counts - 1] = offsets
    normal = np.add.reduceat(np.cross(local, local[following]), offsets)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return Planes(normal / np.where(length > 0, length, 1.0), centre)


def heights_on(planes: Planes, face: np.ndarray, x_y: np.ndarray, k: tuple[float, float], base: float) -> np.ndarray:
    """Where the view rays through `x_y` (n, 2) on the reference plane meet the planes of faces `face` (n,): heights (n,) m.

    On a ray X = (x, y, base) + t·(k, 1), so t = n·(point − (x, y, base)) / n·(k, 1): closed form, walls included.
    """
    along = planes.normal @ np.array([*k, 1.0])
    along = np.where(np.abs(along) < 1e-9, np.nan, along)
    slope = -planes.normal[:, :2] / along[:, None]
    at_zero = base + np.einsum("ij,ij->i", planes.normal, planes.point - [0.0, 0.0, base]) / along
    return at_zero[face] + slope[face, 0] * x_y[..., 0] + slope[face, 1] * x_y[..., 1]


def _spans(
    start: np.ndarray, end: np.ndarray, face: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Runs of pixel centres inside each face: face, row, first column, past-the-end column.

    `start`, `end` (e, 2) are edges in pixels. Every row's centre line is cut by the edges (half-open, so a shared vertex
    counts once); between the first and second, third and fourth … cut is inside.
    """
    down = (start[:, 1] > end[:, 1])[:, None]  # an edge is cut alike from both its sides
    start, end = np.where(down, end, start), np.where(down, start, end)
    low, high = start[:, 1], end[:, 1]
    first = np.clip(np.ceil(low - 0.5), 0, height).astype(np.int64)
    count = np.clip(np.ceil(high - 0.5), 0, height).astype(np.int64) - first
    edge = np.repeat(np.arange(len(start)), count)
    row = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count - first, count)
    rise = end[edge, 1] - start[edge, 1]
    share = (row + 0.5 - start[edge, 1]) / rise
    x = start[edge, 0] + share * (end[edge, 0] - start[edge, 0])
    col = np.clip(np.ceil(x - 0.5), 0, width).astype(np.int64)
    line = (face[edge] * height + row) * (width + 1) + col
    line.sort()
    line, col = np.divmod(line, width + 1)
    owner, row = np.divmod(line, height)
    keep = col[1::2] > col[::2]
    return owner[::2][keep], row[::2][keep], col[::2][keep], col[1::2][keep]


def pixel_counts(faces: Sequence[Polygon], k: tuple[float, float], frame: Grid, base: float = 0.0) -> np.ndarray:
    """Pixel centres that each face would cover if nothing stood before it: (n,), also those outside the frame."""
    if not len(faces):
        return np.zeros(0, np.int64)
    start, end, owner = _edges(faces)
    seen_start, seen_end = (frame.to_image(p[:, :2] - (p[:, 2:] - base) * np.asarray(k, float)) for p in (start, end))
    low = np.floor(np.minimum(seen_start.min(0), seen_end.min(0)))
    width, height = (np.ceil(np.maximum(seen_start.max(0), seen_end.max(0)) - low) + 1).astype(int).tolist()
    face, _, first, past = _spans(seen_start - low, seen_end - low, owner, width, height)
    return np.bincount(face, past - first, minlength=len(faces)).astype(np.int64)


def render_faces(faces: Sequence[Polygon], k: tuple[float, float], frame: Grid, base: float = 0.0) -> Hits:
    """Render planar faces as seen with lean `k` (m/m) on the reference plane at height `base` (m).

    `faces` is any sequence of things with `ring` (n, 3) and `holes`, in map metres with absolute z. A face seen edge-on
    shows nothing. In the frame of a terrain-corrected image on flat ground, `base` is the ground's height.
    """
    best = np.full(frame.width * frame.height, -1, np.int64)
    if not len(faces):
        return Hits(
            np.full((frame.height, frame.width), -np.inf), best.reshape(frame.height, frame.width).astype(np.int32)
        )
    lean = np.asarray(k, float)
    start, end, owner = _edges(faces)
    lowest = float(start[:, 2].min()) - 1.0
    plane = planes(faces)
    seen_start, seen_end = (frame.to_image(p[:, :2] - (p[:, 2:] - base) * lean) for p in (start, end))
    origin = frame.to_map(np.array([0.5, 0.5]))
    at_origin = heights_on(plane, np.arange(len(faces)), np.broadcast_to(origin, (len(faces), 2)), k, base)
    along = plane.normal @ np.array([*k, 1.0])
    usable = np.abs(along) > 1e-6
    slope = -plane.normal[:, :2] / np.where(usable, along, 1.0)[:, None] * np.array([frame.gsd, -frame.gsd])
    edges = usable[owner]
    spans = _spans(seen_start[edges], seen_end[edges], owner[edges], frame.width, frame.height)
    total = np.cumsum(spans[3] - spans[2])
    cuts = np.searchsorted(total, np.arange(FRAGMENTS, total[-1] if len(total) else 0, FRAGMENTS))
    bits = len(faces).bit_length()
    for face, row, first, past in zip(*(np.split(s, cuts) for s in spans), strict=True):
        length = past - first
        run = np.repeat(np.arange(len(face)), length)
        col = np.arange(len(run)) - np.repeat(np.cumsum(length) - length - first, length)
        at_row = at_origin[face] + slope[face, 1] * row
        z = at_row[run] + slope[face, 0][run] * col
        # Height first, face second in one integer: the maximum is the visible face.
        key = (np.maximum((z - lowest) / STEP, 0.0).astype(np.int64) << bits) | face[run]
        np.maximum.at(best, (row * frame.width)[run] + col, key)
    shown = best >= 0
    face = np.where(shown, best & ((1 << bits) - 1), -1)
    row, col = np.divmod(np.arange(len(best)), frame.width)
    z = np.where(shown, at_origin[face] + slope[face, 0] * col + slope[face, 1] * row, -np.inf)
    shape = (frame.height, frame.width)
    return Hits(z.reshape(shape), face.reshape(shape).astype(np.int32))
