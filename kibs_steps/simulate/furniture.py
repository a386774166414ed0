"""What stands on roofs: dormers, skylights, solar panels, chimneys, parapets, penthouses, machines.

In: a `Site` and a section (ring in its building's own frame). Out: nothing; faces go to the site.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.pieces import CLUTTER, ROOF, WALL, Face, Place, pick

if TYPE_CHECKING:
    from kibs_steps.simulate.site import Site


def penthouse(
    site: Site, place: Place, ring: np.ndarray, roof: int, wall: int, number: int, host: int
) -> tuple[np.ndarray, ...]:
    """Sometimes a storey set back on a flat roof: a section of its own, and a hole in the one below."""
    rng = site.rng
    axes = roofs.frame_of(ring)
    size = axes.ring.max(0)
    if axes.rise > 0.01 or len(ring) != 4 or size.min() < 9 or rng.random() > 0.3:
        return ()
    u0, v0 = size * rng.uniform(0.12, 0.4, 2)
    u1, v1 = size - size * rng.uniform(0.12, 0.4, 2)
    if not axes.holds(u0, v0, u1, v1) or (u1 - u0) * (v1 - v0) < 12:
        return ()
    foot = roofs.slab(axes, u0, v0, u1, v1, 0.0)
    top, sides = roofs.prism(foot[:, :2], ring[0, 2], ring[0, 2] + rng.uniform(2.2, 3.6))
    site.sections += 1
    site.faces.append(Face(place.put(top), (), ROOF, site.sections, number, roof, site.tint(0.1)))
    site.faces += [Face(place.put(side), (), WALL, 0, number, wall, site.tint(0.03)) for side in sides]
    return (place.put(foot),)


def _on(site: Site, place: Place, rings: list[np.ndarray], number: int, material: int, tint: float = 0.06) -> None:
    shade = site.tint(tint)
    site.faces += [Face(place.put(ring), (), CLUTTER, 0, number, material, shade) for ring in rings]


def parapet(
    site: Site,
    place: Place,
    ring: np.ndarray,
    height: float,
    number: int,
    wall: int,
    tint: tuple[float, float, float],
) -> None:
    after = np.roll(ring, -1, axis=0)
    edge = (after - ring)[:, :2]
    inward = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    before = np.roll(inward, 1, axis=0)
    shift = 0.28 * (inward + before) / np.maximum(1 + (inward * before).sum(1), 0.2)[:, None]
    inner = ring.copy()
    inner[:, :2] += shift
    top, low_outer = ring + np.array([0, 0, height]), ring
    top_inner = inner + np.array([0, 0, height])
    cap = site.kit.draw(site.rng, "wall") if site.rng.random() < 0.4 else wall
    for i in range(len(ring)):
        j = (i + 1) % len(ring)
        quads = [[top[i], top[j], top_inner[j], top_inner[i]], [low_outer[i], low_outer[j], top[j], top[i]]]
        quads.append([inner[j], inner[i], top_inner[i], top_inner[j]])
        site.faces += [Face(place.put(np.array(q)), (), CLUTTER, 0, number, cap, tint) for q in quads]


def furnish(
    site: Site,
    place: Place,
    ring: np.ndarray,
    number: int,
    roof: int,
    tint: tuple[float, float, float],
    wall: int,
    paint: tuple[float, float, float],
) -> None:
    """Dormers, skylights, solar panels and chimneys on slopes; boxes, panels and lights on flat roofs."""
    rng = site.rng
    axes = roofs.frame_of(ring)
    width, depth = axes.ring.max(0)
    if width * depth < 14 or axes.rise > 1.6:
        return
    much = site.furnished
    draw = site.kit.draw
    if axes.rise > 0.12:
        if rng.random() < 0.1:
            _lines(site, place, axes, number)
        if rng.random() < 0.1:
            _patch(site, place, axes, number, draw(rng, "pitched") if rng.random() < 0.3 else roof)
        if rng.random() < site.solar and width > 3:
            w, d = min(width * rng.uniform(0.3, 0.9), 12), depth * rng.uniform(0.35, 0.8)
            u, v = rng.uniform(0, width - w), rng.uniform(0.2, 0.8) * (depth - d)
            if axes.holds(u, v, u + w, v + d):
                _on(site, place, [roofs.slab(axes, u, v, u + w, v + d, 0.1)], number, draw(rng, "solar"))
                return
        if axes.rise > 0.45 and width > 4 and rng.random() < 0.45 * much:
            gable, w, h = rng.random() < 0.5, rng.uniform(1.2, 2.6), rng.uniform(0.9, 1.6)
            count = int(rng.integers(1, max(2, int(width / 3.5))))
            if rng.random() < 0.2:  # one wide dormer
                gable, w, count = False, rng.uniform(2.6, max(2.7, min(0.7 * width, 9.0))), 1
            v = rng.uniform(0.1, 0.35) * depth
            for i in range(count):
                made = roofs.dormer(axes, width * (i + 0.5) / count, v, w, h, gable)
                if made:
                    site.faces += [Face(place.put(r), (), CLUTTER, 0, number, roof, tint) for r in made[0]]
                    site.faces += [Face(place.put(r), (), CLUTTER, 0, number, wall, paint) for r in made[1]]
        elif rng.random() < 0.6 * much:
            count, level = int(rng.integers(1, 4)), rng.uniform(0.2, 0.7)
            aligned, w = rng.random() < 0.4, rng.uniform(0.6, 1.2)
            for i in range(int(width / 4) if aligned else count):
                u, v = rng.uniform(0.1, 0.85) * width, rng.uniform(0.2, 0.7) * depth
                if aligned:
                    u, v = (i + 0.5) * 4.0, level * depth
                else:
                    w = rng.uniform(0.6, 1.2)
                if axes.holds(u, v, u + w, v + 1.3 * w):
                    _on(
                        site,
                        place,
                        [roofs.slab(axes, u, v, u + w, v + 1.3 * w, 0.05)],
                        number,
                        draw(rng, "skylight"),
                    )
        if rng.random() < 0.5 * much + 0.2:
            u, v, w = rng.uniform(0.1, 0.85) * width, rng.uniform(0.55, 0.9) * depth, rng.uniform(0.5, 1.0)
            if axes.holds(u, v, u + w, v + 0.6):
                foot = roofs.slab(axes, u, v, u + w, v + 0.6, 0.0)
                top, sides = roofs.prism(
                    foot[:, :2], float(foot[:, 2].min()), float(foot[:, 2].max()) + rng.uniform(0.4, 1.4)
                )
                _on(site, place, [top, *sides], number, draw(rng, "chimney"))
        return
    _flat(site, place, axes, number)
    count = rng.poisson(min(width * depth / 90, 14) * 1.2 * much)
    for _ in range(count):
        w, d = rng.uniform(0.7, 3.2, 2)
        u, v = rng.uniform(0.5, max(width - w, 0.6)), rng.uniform(0.5, max(depth - d, 0.6))
        if not axes.holds(u, v, u + w, v + d):
            continue
        foot = roofs.slab(axes, u, v, u + w, v + d, 0.0)
        if rng.random() < 0.3:
            _on(site, place, [roofs.slab(axes, u, v, u + w, v + d, 0.15)], number, draw(rng, "skylight"))
        else:
            top, sides = roofs.prism(
                foot[:, :2], float(foot[:, 2].min()) - 0.2, float(foot[:, 2].max()) + rng.uniform(0.4, 2.4)
            )
            _on(site, place, [top, *sides], number, draw(rng, "metal"), 0.2)
    if rng.random() < 0.6 * site.solar and axes.rise < 0.1:
        gap = rng.uniform(1.6, 2.6)
        for v in np.arange(1.0, depth - 1.5, gap)[:25]:
            u0, u1 = width * 0.1, width * rng.uniform(0.7, 0.92)
            if axes.holds(u0, v, u1, v + gap * 0.6):
                quad = roofs.slab(axes, u0, v, u1, v + gap * 0.6, 0.1)
                quad[2:, 2] += 0.35
                _on(site, place, [quad], number, site.kit.uses["solar"][0])


def _lines(site: Site, place: Place, axes: roofs.Frame, number: int) -> None:
    """Snow guards or a walkway: a line along the eave."""
    rng = site.rng
    width = axes.ring[:, 0].max()
    v, wide = rng.uniform(0.3, 1.2), rng.uniform(0.12, 0.3)
    u0, u1 = 0.06 * width, 0.94 * width
    if axes.holds(u0, v, u1, v + wide):
        _on(site, place, [roofs.slab(axes, u0, v, u1, v + wide, 0.12)], number, site.kit.draw(rng, "metal"))


def _patch(site: Site, place: Place, axes: roofs.Frame, number: int, material: int) -> None:
    """A part of a roof that was mended or has weathered otherwise."""
    rng = site.rng
    width, depth = axes.ring.max(0)
    w, d = width * rng.uniform(0.1, 0.5), depth * rng.uniform(0.2, 0.9)
    u, v = rng.uniform(0, width - w), rng.uniform(0, depth - d)
    if axes.holds(u, v, u + w, v + d):
        _on(site, place, [roofs.slab(axes, u, v, u + w, v + d, 0.03)], number, material, 0.2)


def _flat(site: Site, place: Place, axes: roofs.Frame, number: int) -> None:
    """On flat roofs: terraces and beds of another material, ducts, rows of rooflights, a plant room."""
    rng = site.rng
    width, depth = axes.ring.max(0)
    draw = site.kit.draw
    large = width * depth > 150
    if rng.random() < 0.15:
        _patch(site, place, axes, number, draw(rng, pick(rng, ["flat", "flat", "lawn", "pavement"])))
    if large and rng.random() < 0.25:
        gap, side = rng.uniform(3.5, 8.0), rng.uniform(0.8, 1.6)
        long = side * pick(rng, [1.0, 1.0, 3.0])
        light = draw(rng, "skylight")
        spots = [
            (u, v) for u in np.arange(2.0, width - 2 - long, gap + long) for v in np.arange(2.0, depth - 2 - side, gap)
        ]
        for u, v in spots[:40]:
            if axes.holds(u, v, u + long, v + side):
                _on(site, place, [roofs.slab(axes, u, v, u + long, v + side, 0.3)], number, light, 0.02)
    if large and rng.random() < 0.5 * site.furnished:
        for _ in range(int(rng.integers(1, 4))):
            long, wide = rng.uniform(0.2, 0.7) * max(width, depth), rng.uniform(0.4, 0.9)
            w, d = (long, wide) if rng.random() < 0.5 else (wide, long)
            _box(site, place, axes, number, w, d, rng.uniform(0.3, 0.8))
    if large and rng.random() < 0.35:
        _box(site, place, axes, number, *rng.uniform(3.0, 7.0, 2), rng.uniform(1.8, 3.2))


def _box(site: Site, place: Place, axes: roofs.Frame, number: int, w: float, d: float, height: float) -> None:
    rng = site.rng
    width, depth = axes.ring.max(0)
    if w > width - 1.5 or d > depth - 1.5:
        return
    u, v = rng.uniform(0.7, width - w - 0.7), rng.uniform(0.7, depth - d - 0.7)
    if axes.holds(u, v, u + w, v + d):
        foot = roofs.slab(axes, u, v, u + w, v + d, 0.0)
        top, sides = roofs.prism(foot[:, :2], float(foot[:, 2].min()), float(foot[:, 2].max()) + height)
        _on(site, place, [top, *sides], number, site.kit.draw(rng, "metal"), 0.2)
