"""What a satellite sees of a city on its terrain, and where every roof section is: a picture with exact truth.

Samples lie at every half pixel of the grid, pixel edges included (2h + 1 by 2w + 1), so each pixel's centre is a sample: labels
and heights are taken there, colours are averaged around it. The image is terrain-corrected: pixel P shows what the ray through
the terrain point (P, T(P)) meets first. With the z-buffer's reference plane at Z0 that ray is the one at P − (T(P) − Z0)·k, and
where it meets nothing above the terrain the pixel shows the ground at P itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kibs_steps import zbuffer
from kibs_steps.grid import Grid
from kibs_steps.scene import Direction
from kibs_steps.simulate import camera, shading
from kibs_steps.simulate.pieces import CLUTTER, ROOF, WALL, City
from kibs_steps.simulate.shading import Seen
from kibs_steps.simulate.truth import SectionTruth, sample_frame, section_truths, visible_corners
from kibs_steps.terrain import Terrain

# What a pixel shows first: furniture of a roof counts as roof; ground the sun does not reach is a surface of its own.
GROUND, ON_ROOF, ON_WALL, OTHER, SHADED_GROUND = range(5)


class Rendering(NamedTuple):
    """A picture and its truth (see `render`)."""

    rgb: np.ndarray
    section: np.ndarray
    height: np.ndarray
    surface: np.ndarray
    sections: list[SectionTruth]
    corners: np.ndarray
    corner_heights: np.ndarray
    corner_sections: np.ndarray


def _reference_frame(samples: Grid, drop: np.ndarray, k: tuple[float, float]) -> Grid:
    """The samples' frame grown (by whole samples) to hold all positions P − drop·k on the reference plane."""
    reach = float(np.abs(drop).max())
    if reach == 0:
        return samples
    across, down = (int(np.ceil(reach * abs(lean) / samples.gsd)) + 1 for lean in k)
    return Grid(
        samples.crs,
        samples.x0 - across * samples.gsd,
        samples.y0 + down * samples.gsd,
        samples.gsd,
        samples.width + 2 * across,
        samples.height + 2 * down,
    )


def _see(city: City, terrain: Terrain, samples: Grid, k: tuple[float, float]) -> Seen:
    faces = city.faces
    x_y = np.empty((samples.height, samples.width, 2))
    x_y[..., 0] = samples.x0 + (np.arange(samples.width) + 0.5) * samples.gsd
    x_y[..., 1] = samples.y0 - (np.arange(samples.height)[:, None] + 0.5) * samples.gsd
    level = np.ptp(terrain.heights) == 0
    base = float(terrain.heights.flat[0]) if level else float(np.mean(terrain.heights))
    ground = np.full(x_y.shape[:2], base) if level else terrain(x_y)
    through = x_y - (ground - base)[..., None] * np.array(k)
    frame = _reference_frame(samples, ground - base, k)
    planes = zbuffer.planes(faces)

    def look(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits = zbuffer.render_faces([faces[i] for i in chosen], k, frame, base)
        face = hits.face
        if not level:
            at = np.floor(frame.to_image(through)).astype(int)
            face = face[at[..., 1], at[..., 0]]
        found = face >= 0
        index = np.where(found, chosen[face] if len(chosen) else -1, -1)
        z = hits.height
        if not level:
            z = np.full(face.shape, -np.inf)
            z[found] = zbuffer.heights_on(planes, index[found], through[found], k, base)
        buried = z <= ground
        index[buried], z[buried] = -1, -np.inf
        return index, z

    kind = np.array([f.kind for f in faces], int)
    solid, solid_z = look(np.flatnonzero(kind != CLUTTER))
    loose, loose_z = look(np.flatnonzero(kind == CLUTTER))
    front = loose_z > solid_z
    face, z = np.where(front, loose, solid), np.where(front, loose_z, solid_z)
    own = np.array([f.section for f in faces] + [0])
    section = own[solid]
    z = np.where(face < 0, ground, z)
    # From the ground nothing moves: a pixel that shows no face shows its own place.
    rise = np.where(face < 0, 0.0, z - ground)
    points = np.stack([x_y[..., 0] + rise * k[0], x_y[..., 1] + rise * k[1], z], -1)
    return Seen(face, points, ground, section, solid_z)


def render(
    city: City,
    terrain: Terrain,
    grid: Grid,
    view: Direction,
    sun: Direction,
    rng: np.random.Generator,
    backgrounds: list[tuple[np.ndarray, np.ndarray]] | None = None,
    look: camera.Camera | None = None,
) -> Rendering:
    """Render a city on its terrain.

    Returns `rgb` uint8 (h, w, 3); `section` int32 (h, w), the visible section or 0; `height` float32 (h, w), m above ground at
    the true position, NaN off sections; `surface` uint8 (h, w), the kind of what is seen (GROUND …); `sections`, the truth of
    all sections whose image meets the grid; `corners` float32 (n, 2) px col, row of section corners that can be seen, with
    `corner_heights` (n,) m above ground and `corner_sections` (n,). `backgrounds`: photographs of ground, uint8 (h, w, 3),
    each with a mask of its usable pixels, bool (h, w); drawn over parts of the painted ground. `look`: the camera, drawn if
    None.
    """
    samples = sample_frame(grid)
    city = _near(city, terrain, samples, view.lean, sun.lean)
    seen = _see(city, terrain, samples, view.lean)
    sections = section_truths(city, terrain, grid, view.lean, seen.section)
    shine, lit = shading.radiance_of(city, seen, samples, sun, rng, sections, backgrounds)
    rgb = camera.photograph(shine, look or camera.camera(rng), rng)

    at = np.s_[1::2, 1::2]
    section = seen.section[at].astype(np.int32)
    z = seen.section_z[at]
    height = np.full(section.shape, np.nan, np.float32)
    on = section > 0
    if on.any():
        rows, cols = np.nonzero(on)
        seen_at = grid.to_map(np.stack([cols + 0.5, rows + 0.5], -1))
        true_at = seen_at + (z[on] - terrain(seen_at))[:, None] * np.array(view.lean)
        height[on] = z[on] - terrain(true_at)
    corners = visible_corners(sections, section)
    return Rendering(rgb, section, height, _surface(city, seen.face[at], lit[at]), sections, *corners)


def _surface(city: City, face: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Kind of surface, uint8, of the faces seen (−1 ground) and whether the sun reaches them."""
    of_kind = {ROOF: ON_ROOF, CLUTTER: ON_ROOF, WALL: ON_WALL}
    table = np.array([of_kind.get(f.kind, OTHER) for f in city.faces] + [GROUND], np.uint8)
    surface = table[face]
    surface[(face < 0) & (lit == 0)] = SHADED_GROUND
    return surface


def _near(city: City, terrain: Terrain, samples: Grid, view: tuple[float, float], sun: tuple[float, float]) -> City:
    """The city without faces that can neither be seen in the frame nor throw a shadow into it."""
    if not city.faces:
        return city
    low, high = shading.extents([f.ring for f in city.faces])
    floor, roof = terrain.heights.min(), terrain.heights.max()
    top = np.maximum(high[:, 2] - floor, 0)
    reach = top * (np.hypot(*view) + np.hypot(*sun)) + (roof - floor) * np.hypot(*view) + 2
    left, bottom, right, upper = samples.bounds
    near = (
        (high[:, 0] + reach > left)
        & (low[:, 0] - reach < right)
        & (high[:, 1] + reach > bottom)
        & (low[:, 1] - reach < upper)
    )
    return city._replace(faces=[city.faces[i] for i in np.flatnonzero(near)])
