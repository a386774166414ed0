"""Simulated scenes with exact truth: what a satellite sees of a city on its terrain, and where every roof section is.

Samples lie at every half pixel of the grid, pixel edges included (2h + 1 by 2w + 1), so each pixel's centre is a sample: labels
and heights are taken there, colours are averaged around it. The image is terrain-corrected: pixel P shows what the ray through
the terrain point (P, T(P)) meets first. With the z-buffer's reference plane at Z0 that ray is the one at P − (T(P) − Z0)·k, and
where it meets nothing above the terrain the pixel shows the ground at P itself.

Run as a program it writes one scene: `scene.tif`, `dtm.tif`, `truth.gpkg`, `angles.json`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kibs_steps import cli, store, zbuffer
from kibs_steps import view as geometry
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid
from kibs_steps.scene import Direction, convergence
from kibs_steps.simulate import camera, citymodel, light, real
from kibs_steps.simulate.city import MIXTURES, STYLES, procedural
from kibs_steps.simulate.citymodel import CityModel
from kibs_steps.simulate.site import CLUTTER, ROOF, WALL, City, pick
from kibs_steps.terrain import Terrain, flat

STRIP = 256  # rows shaded at a time
BIAS = 0.2  # m: a face this little above another does not shade it
# What a pixel shows first: furniture of a roof counts as roof; ground the sun does not reach is a surface of its own.
GROUND, ON_ROOF, ON_WALL, OTHER, SHADED_GROUND = range(5)


# Azimuth, elevation and half angle (deg) of views that random scenes never show: models are judged there.
HELD_OUT_CONE = (250.0, 62.0, 5.0)


class SectionTruth(NamedTuple):
    """One roof section: where it is seen (px col, row, height above ground in m) and where it stands (map m, absolute z)."""

    section: int
    building: int
    outline_seen: np.ndarray
    outline_map: np.ndarray
    holes_seen: tuple[np.ndarray, ...]
    holes_map: tuple[np.ndarray, ...]
    visible: float


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


def _sample_frame(grid: Grid) -> Grid:
    """The grid of samples: one at every half pixel, pixel edges included."""
    half = grid.gsd / 2
    return Grid(grid.crs, grid.x0 - half / 2, grid.y0 + half / 2, half, 2 * grid.width + 1, 2 * grid.height + 1)


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


class _Seen(NamedTuple):
    """Per sample: shown face (−1 ground) with its position, and the section seen through roof furniture (0 none)."""

    face: np.ndarray
    points: np.ndarray
    ground: np.ndarray
    section: np.ndarray
    section_z: np.ndarray


def _see(city: City, terrain: Terrain, samples: Grid, k: tuple[float, float]) -> _Seen:
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
    return _Seen(face, points, ground, section, solid_z)


def _lit(city: City, seen: _Seen, samples: Grid, sun: tuple[float, float], facing: np.ndarray) -> np.ndarray:
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
    low, high = _extents([p.ring for p in city.paints])
    meets = (high > np.array(samples.bounds[:2]) - 1).all(1) & (low < np.array(samples.bounds[2:]) + 1).all(1)
    for i in np.flatnonzero(meets).tolist():
        paint = city.paints[i]
        ring = np.round((samples.to_image(paint.ring) - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(canvas, [ring], i, shift=4)
    return canvas


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
    samples = _sample_frame(grid)
    city = _near(city, terrain, samples, view.lean, sun.lean)
    seen = _see(city, terrain, samples, view.lean)
    sections = _truth(city, terrain, grid, view.lean, seen.section)
    shine, lit = _shine(city, seen, samples, sun, rng, sections, backgrounds)
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
    corners = _corners(sections, section)
    return Rendering(rgb, section, height, _surface(city, seen.face[at], lit[at]), sections, *corners)


def _surface(city: City, face: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Kind of surface, uint8, of the faces seen (−1 ground) and whether the sun reaches them."""
    of_kind = {ROOF: ON_ROOF, CLUTTER: ON_ROOF, WALL: ON_WALL}
    table = np.array([of_kind.get(f.kind, OTHER) for f in city.faces] + [GROUND], np.uint8)
    surface = table[face]
    surface[(face < 0) & (lit == 0)] = SHADED_GROUND
    return surface


def _shine(
    city: City,
    seen: _Seen,
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


def _extents(rings: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of rings (n, 2 or 3): (rings, 2 or 3) each."""
    starts = np.cumsum([0] + [len(r) for r in rings[:-1]])
    points = np.concatenate(rings)
    return np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)


def _near(city: City, terrain: Terrain, samples: Grid, view: tuple[float, float], sun: tuple[float, float]) -> City:
    """The city without faces that can neither be seen in the frame nor throw a shadow into it."""
    if not city.faces:
        return city
    low, high = _extents([f.ring for f in city.faces])
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


def _truth(city: City, terrain: Terrain, grid: Grid, k: tuple[float, float], seen: np.ndarray) -> list[SectionTruth]:
    counts = np.bincount(seen.ravel())
    roofs = [f for f in city.faces if f.kind == ROOF and f.section]
    if not roofs:
        return []
    rings = [ring for f in roofs for ring in (f.ring, *f.holes)]
    points = np.concatenate(rings)
    above = points[:, 2] - terrain(points[:, :2])
    at = grid.to_image(geometry.image_position(points[:, :2], points[:, 2], k, terrain))
    base = float(terrain.heights.flat[0]) if np.ptp(terrain.heights) == 0 else float(np.mean(terrain.heights))
    whole = zbuffer.pixel_counts(roofs, k, _sample_frame(grid), base)
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


def _corners(sections: list[SectionTruth], labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _direction(azimuth: float, elevation: float, convergence: float = 0.0) -> Direction:
    return Direction(azimuth, elevation, geometry.lean(azimuth, elevation, convergence))


def geometry_vector(view: Direction, sun: Direction, gsd: float) -> np.ndarray:
    """The networks' geometry input, float32 (6,): lean of view (col, row) and of shadows, px per m of height, known flags.

    A roof point at height h is shown at ground px + h·[0:2], its shadow tip falls at ground px + h·[2:4].
    """
    (kx, ky), (sx, sy) = view.lean, sun.lean
    return np.array([-kx / gsd, ky / gsd, -sx / gsd, sy / gsd, 1.0, 1.0], np.float32)


def relief(
    rng: np.random.Generator,
    bounds: tuple[float, float, float, float],
    step: float,
    amplitude: float,
    slope: float,
    base: float = 0.0,
) -> Terrain:
    """Terrain over `bounds` (left, bottom, right, top): smooth waves of `amplitude` (m) on a plane of `slope` (m/m), float32."""
    x = np.arange(bounds[0] + step / 2, bounds[2] + step / 2, step)
    y = np.arange(bounds[3] - step / 2, bounds[1] - step / 2, -step)
    angle = rng.uniform(0, 2 * np.pi)
    cx, cy = x - x.mean(), y - y.mean()
    z = base + slope * (np.cos(angle) * cx[None] + np.sin(angle) * cy[:, None])
    for _ in range(3 if amplitude else 0):
        length, turn, phase = rng.uniform(150, 500), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        wave = 2 * np.pi / length * (np.cos(turn) * cx[None] + np.sin(turn) * cy[:, None]) + phase
        z = z + amplitude / 3 * np.sin(wave)
    return Terrain(z.astype(np.float32).astype(np.float64), float(x[0]), float(y[0]), (step, step))


def _roofs_within(city: City, side: float) -> int:
    """Sections whose first corner stands in the square from (0, 0) to (side, side) m."""
    return sum(f.kind == ROOF and 0 < f.ring[0, 0] < side and 0 < f.ring[0, 1] < side for f in city.faces)


def _random_view(rng: np.random.Generator, low: float, high: float) -> tuple[float, float]:
    """Azimuth and elevation (deg) of a satellite, oblique views more often than steep ones, never within HELD_OUT_CONE."""
    while True:
        azimuth = rng.uniform(0, 360)
        elevation = min(rng.triangular(low, low + 0.3 * (high - low), high) if high > low else low, 89.9)
        held_azimuth, held_elevation, cone = HELD_OUT_CONE
        off = abs((azimuth - held_azimuth + 180) % 360 - 180)
        if high == low or np.hypot(off * np.cos(np.radians(held_elevation)), elevation - held_elevation) > cone:
            return azimuth, elevation


def random_scene(
    rng: np.random.Generator,
    size: int = 256,
    gsd: float = 0.38,
    view_elevation: tuple[float, float] = (50, 90),
    sun_elevation: tuple[float, float] = (20, 70),
    backgrounds: list[tuple[np.ndarray, np.ndarray]] | None = None,
    style: str | None = None,
    cities: Sequence[CityModel] = (),
    city_share: float = 0.3,
) -> tuple[Rendering, np.ndarray]:
    """A random tile of `size`² px with its truth, and the networks' geometry vector (float32 (6,), docs/architecture.md).

    `city_share` of the tiles show a part of one of the real `cities`, if there are any; the others are procedural, of one `style`
    or of any.
    """
    side = size * gsd
    grid = Grid("", 0.0, side, gsd, size, size)
    view = _direction(*_random_view(rng, *view_elevation))
    sun = _direction(rng.uniform(0, 360), rng.uniform(*sun_elevation))
    style = style or str(
        rng.choice([*STYLES, "mixed", "town"], p=[0.18, 0.13, 0.1, 0.11, 0.09, 0.08, 0.02, 0.05, 0.05, 0.11, 0.08])
    )
    margin = 25.0 + (15.0 if style in ("centre", "perimeter") else 0.0)
    terrain = flat(0.0)
    if rng.random() < 0.35:
        low, high = -margin - 60, side + margin + 60
        terrain = relief(rng, (low, low, high, high), 2.0, rng.uniform(0, 6), rng.uniform(0, 0.15))
    wide = side + 2 * margin
    model = pick(rng, cities) if len(cities) and rng.random() < city_share else None

    def build() -> City:
        if model:
            return real.city(rng, model, (-margin, -margin, wide - margin, wide - margin), terrain)
        return procedural(rng, wide, wide, terrain, style, (-margin, -margin))

    city = build()
    # Tiles with hardly a roof teach little: most of them are drawn again.
    while _roofs_within(city, side) < 4 and rng.random() < 0.75:
        city = build()
    picture = render(city, terrain, grid, view, sun, rng, backgrounds if rng.random() < 0.5 else None)
    return picture, geometry_vector(view, sun, gsd)


def simulate(
    seed: int,
    grid: Grid,
    view: Direction,
    sun: Direction,
    style: str = "mixed",
    amplitude: float = 0.0,
    slope: float = 0.0,
    base: float = 100.0,
    model: CityModel | None = None,
) -> tuple[Rendering, Terrain]:
    """One scene over `grid`: its rendering and its terrain (2 m posting, 250 m beyond the grid).

    `amplitude` (m) and `slope` (m/m) shape the terrain, `base` (m) is its mean height. With a `model` the scene shows that
    city where it stands, on its own terrain.
    """
    rng = np.random.default_rng(seed)
    left, bottom, right, top = grid.bounds
    around = (left - 250, bottom - 250, right + 250, top + 250)
    margin = 60.0
    if model:
        terrain = real.surveyed_terrain(model, around, 2.0)
        within = (left - margin, bottom - margin, right + margin, top + margin)
        return render(real.as_surveyed(rng, model, within, terrain), terrain, grid, view, sun, rng), terrain
    terrain = relief(rng, around, 2.0, amplitude, slope, base)
    city = procedural(
        rng, right - left + 2 * margin, top - bottom + 2 * margin, terrain, style, (left - margin, bottom - margin)
    )
    return render(city, terrain, grid, view, sun, rng), terrain


def split_of(x_y: np.ndarray, seed: int) -> int:
    """Split of a building by the 100 m square it stands in: 0 training (60 %), 1 validation, 2 testing (20 % each)."""
    square = np.floor(np.asarray(x_y) / 100.0).astype(int).tolist()
    return int(np.searchsorted([0.6, 0.8], np.random.default_rng([seed, *square]).random(), side="right"))


def _write_truth(path: Path, picture: Rendering, grid: Grid, seed: int) -> None:
    import geopandas
    import pyogrio
    import shapely

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2000-01-01T00:00:00.000Z"})
    splits: dict[int, int] = {}
    for s in picture.sections:
        splits.setdefault(s.building, split_of(s.outline_map[0, :2], seed))
    columns = {
        "section_id": [s.section for s in picture.sections],
        "building_id": [s.building for s in picture.sections],
        "visible": [s.visible for s in picture.sections],
        "split": [splits[s.building] for s in picture.sections],
    }

    def seen(ring: np.ndarray) -> np.ndarray:
        return np.column_stack([grid.to_map(ring[:, :2]), ring[:, 2]])

    layers = {
        "sections_image": [
            shapely.Polygon(seen(s.outline_seen), [seen(h) for h in s.holes_seen]) for s in picture.sections
        ],
        "sections_map": [shapely.Polygon(s.outline_map, list(s.holes_map)) for s in picture.sections],
    }
    with store.whole(path) as temporary:
        temporary.unlink()
        for name, shapes in layers.items():
            frame = geopandas.GeoDataFrame(columns, geometry=shapes, crs=grid.crs)
            pyogrio.write_dataframe(
                frame, temporary, layer=name, driver="GPKG", geometry_type="Polygon Z", append=name != "sections_image"
            )


def _write_raster(path: Path, values: np.ndarray, crs: str, x0: float, y0: float, step: float) -> None:
    import rasterio
    from affine import Affine

    bands = np.atleast_3d(values).transpose(2, 0, 1) if values.ndim == 3 else values[None]
    with (
        store.whole(path) as temporary,
        rasterio.open(
            temporary,
            "w",
            driver="GTiff",
            count=len(bands),
            height=bands.shape[1],
            width=bands.shape[2],
            dtype=bands.dtype,
            crs=crs,
            transform=Affine(step, 0, x0, 0, -step, y0),
            tiled=True,
            blockxsize=256,
            blockysize=256,
            compress="deflate",
            photometric="RGB" if len(bands) == 3 else "MINISBLACK",
        ) as target,
    ):
        target.write(bands)


def _origin(crs: str, gsd: float, size: int, model: CityModel | None) -> tuple[float, float]:
    """An upper-left corner on a multiple of the GSD (millimetres kept): near the centre of the CRS's area of use, or so that
    the middle of the city model's buildings is in the middle."""
    import pyproj

    try:
        system = pyproj.CRS(crs)
    except pyproj.exceptions.CRSError as error:
        raise UnusableScene(
            f"--crs {crs} is not a coordinate reference system: give one in metres, such as EPSG:32631"
        ) from error
    if not system.is_projected or abs(system.axis_info[0].unit_conversion_factor - 1) > 1e-9:
        raise UnusableScene(f"--crs {crs} is not projected in metres: give a UTM zone, such as EPSG:32631")
    if model:
        x, y = np.median([b.centre for b in model.buildings], axis=0) + size * gsd / 2 * np.array([-1.0, 1.0])
        return round(round(x / gsd) * gsd, 3), round(round(y / gsd) * gsd, 3)
    west, south, east, north = system.area_of_use.bounds if system.area_of_use else (2.0, 48.0, 4.0, 50.0)
    latitude = 49.2 if south < 49.2 < north else (south + north) / 2
    x, y = pyproj.Transformer.from_crs(system.geodetic_crs, system, always_xy=True).transform(
        (west + east) / 2 + 0.02, latitude
    )
    return round(round(x / gsd) * gsd, 3), round(round(y / gsd) * gsd, 3)


class UnusableScene(KibsError):
    """A scene that cannot be simulated as asked."""


def main(argv: list[str] | None = None) -> None:
    """Simulate one scene and write its raster, terrain, truth and angles."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=1200, help="pixels per side")
    parser.add_argument("--gsd", type=float, default=0.38, help="metres per pixel")
    parser.add_argument("--view-azimuth", type=float, default=181.1, help="degrees from true north, to the satellite")
    parser.add_argument("--view-elevation", type=float, default=59.3, help="degrees above the horizon")
    parser.add_argument("--sun-azimuth", type=float, default=155.0)
    parser.add_argument("--sun-elevation", type=float, default=45.0)
    parser.add_argument("--style", choices=[*STYLES, *MIXTURES], default="mixed")
    parser.add_argument("--relief", type=float, default=0.0, help="amplitude of the terrain's waves in metres")
    parser.add_argument("--slope", type=float, default=0.0, help="slope of the terrain in percent")
    parser.add_argument(
        "--city", type=Path, help="a CityJSON or CityJSONSeq file to show, where it stands, on its own ground"
    )
    parser.add_argument("--crs", default="EPSG:32631", help="a projected CRS in metres; a city file's own comes first")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    args = parser.parse_args(argv)
    if args.size < 1 or not args.gsd > 0:
        raise UnusableScene("--size and --gsd must be positive")
    for name, least in (("view", 20), ("sun", 5)):
        if not least <= getattr(args, f"{name}_elevation") <= 90:
            raise UnusableScene(f"--{name}-elevation must be between {least} and 90 degrees")
    model = citymodel.read(args.city) if args.city else None
    crs = model.crs if model and model.crs else args.crs
    grid = Grid(crs, *_origin(crs, args.gsd, args.size, model), args.gsd, args.size, args.size)
    turned = convergence(grid)
    view = _direction(args.view_azimuth, args.view_elevation, turned)
    sun = _direction(args.sun_azimuth, args.sun_elevation, turned)
    picture, terrain = simulate(args.seed, grid, view, sun, args.style, args.relief, args.slope / 100.0, model=model)
    step = terrain.step[0]
    _write_raster(args.out / "scene.tif", picture.rgb, crs, grid.x0, grid.y0, grid.gsd)
    _write_raster(
        args.out / "dtm.tif",
        terrain.heights.astype(np.float32),
        crs,
        terrain.x0 - step / 2,
        terrain.y0 + step / 2,
        step,
    )
    _write_truth(args.out / "truth.gpkg", picture, grid, args.seed)
    angles = {name: getattr(args, name) for name in ("view_azimuth", "view_elevation", "sun_azimuth", "sun_elevation")}
    store.write_json(args.out / "angles.json", angles)


if __name__ == "__main__":
    cli.run(main)
