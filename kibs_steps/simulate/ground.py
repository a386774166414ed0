"""Ground between buildings that are already there: plots, pavements, streets, open places, and what stands on them.

In: a `Site` whose occupied ground is marked, and a raster like `Site.taken` with the number of the building on each cell (0
none). Paints and faces go to the site.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from kibs_steps.simulate import roofs
from kibs_steps.simulate.blocks import FILL
from kibs_steps.simulate.outdoors import street
from kibs_steps.simulate.pieces import TREE, Place, pick
from kibs_steps.simulate.site import CELL, Site

EDGE = 60  # cells of the raster beyond the site's area, each side


def between(site: Site, plots: np.ndarray, first: Callable[[], None] | None = None) -> None:
    """Paint and furnish all ground of a site whose buildings stand; `first` draws what lies below all that."""
    rng = site.rng
    distance, nearest = distance_transform_edt(plots == 0, CELL, return_indices=True)
    owner = plots[tuple(nearest)] if plots.any() else plots
    a = site.area
    whole = np.array(roofs.rectangle(a[0] - 40, a[1] - 40, a[2] + 40, a[3] + 40))
    site.paint(whole, pick(rng, ["lawn", "rough", "pavement", "asphalt", "soil", "gravel"]))
    # Loose towns have gardens, dense ones courtyards and streets.
    dense = (plots > 0).mean() > 0.22
    garden = rng.uniform(1.0, 4.0) if rng.random() < (0.7 if dense else 0.15) else rng.uniform(4.0, 11.0)
    walk, road = garden + rng.uniform(0.8, 3.5), garden + rng.uniform(5.0, 14.0)
    streets = first is None and rng.random() < 0.6
    if first:
        first()
    elif rng.random() < 0.7:
        reach = float(np.hypot(a[2] - a[0], a[3] - a[1])) / 2
        for s in np.arange(-reach, reach, 90.0):
            for t in np.arange(-reach, reach, 70.0):
                if site.inside(*site.at(s + 45.0, t + 35.0), 50.0):
                    FILL["park"](site, s, t, s + 90.0, t + 70.0)
    if streets:
        # Streets are what is neither near a building nor in an open place.
        _fill(site, distance < road, site.road, 0.05)
        _fill(site, distance < walk, pick(rng, ["pavement", "pavement", "lawn", "gravel"]), 0.06)
        _cars(site, distance, owner, walk, road)
    elif not first:
        _grid(site, rng.uniform(35, 90), rng.uniform(4, 12))
    _plots(site, distance, owner, garden)
    _green(site, distance, garden, road if streets else garden)


def _position(site: Site, cell: np.ndarray) -> np.ndarray:
    """Map metres (n, 2) of raster positions (n, 2: col, row), real numbers, the corner of a cell at whole ones."""
    return (np.asarray(cell, float) - EDGE) * CELL + [site.area[0], site.area[1]]


def _rings(mask: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Outlines (n, 2: col, row) of a mask with whether they are holes, outer ones before the holes in them."""
    found, tree = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    rings = []
    for ring, (_, _, _, parent) in zip(found, tree[0] if tree is not None else (), strict=True):
        smooth = cv2.approxPolyDP(ring, 0.8, True)[:, 0] + 0.5
        if len(smooth) >= 3 and cv2.contourArea(ring) > 8:
            rings.append((smooth, parent >= 0))
    return sorted(rings, key=lambda r: r[1])


def _fill(site: Site, mask: np.ndarray, use: str | int, tint: float) -> None:
    """Paint the cells of a mask; its holes get open places: lawn, parking, water now and then."""
    rng = site.rng
    material = site.kit.draw(rng, use) if isinstance(use, str) else use
    shade = site.tint(tint)
    for ring, hole in _rings(mask):
        if hole:
            site.paint(_position(site, ring), pick(rng, ["lawn", "lawn", "rough", "pavement", "gravel", "soil"]), 0.1)
        else:
            site.paint(_position(site, ring), material, tint)
            site.paints[-1] = site.paints[-1]._replace(tint=shade)


def _grid(site: Site, spacing: float, width: float) -> None:
    """Straight streets along the grain of the place."""
    rng = site.rng
    a = site.area
    reach = float(np.hypot(a[2] - a[0], a[3] - a[1])) / 2 + 20
    for across in (False, True):
        at = -reach + rng.uniform(0, spacing)
        while at < reach:
            w = width * rng.uniform(0.7, 1.3)
            street(site, *((at, -reach, at + w, reach) if across else (-reach, at, reach, at + w)))
            at += w + spacing * rng.uniform(0.7, 1.8)


def _plots(site: Site, distance: np.ndarray, owner: np.ndarray, garden: float) -> None:
    """A plot around each building up to its neighbours', with paths, hedges, a shed now and then."""
    rng = site.rng
    green = rng.random()
    hedged = site.hedges
    for number in np.unique(owner[(distance < garden) & (owner > 0)]).tolist():
        mask = (owner == number) & (distance < garden * rng.uniform(0.6, 1.0))
        use = pick(
            rng, ["lawn", "lawn", "rough", "soil"] if rng.random() < green else ["pavement", "gravel", "asphalt"]
        )
        for ring, hole in _rings(mask):
            if hole:
                continue
            outline = _position(site, ring)
            site.paint(outline, use, 0.15)
            if garden < 3:
                continue
            for p, q in zip(outline, np.roll(outline, -1, axis=0), strict=True):
                d = q - p
                long = float(np.hypot(*d))
                if long > 3 and rng.random() < 0.4 * hedged:
                    wide = rng.uniform(0.3, 0.8)
                    middle = Place(*((p + q) / 2), float(np.arctan2(d[1], d[0])))
                    rect = np.array(roofs.rectangle(-long / 2, -wide, long / 2, wide))
                    site.box(middle, rect, rng.uniform(0.8, 2.2), "tree", TREE)
            for _ in range(rng.poisson(0.8)):
                spot = outline[rng.integers(len(outline))] + rng.normal(0, 2.5, 2)
                if not site.built(*spot):
                    size = rng.uniform(1.0, 3.0, 2)
                    patch = Place(*spot, site.turn).put(np.array(roofs.rectangle(-1, -1, 1, 1)) * size)
                    site.paint(patch, pick(rng, ["pavement", "soil", "gravel", "lawn", "pool", "rough"]), 0.15)


def _green(site: Site, distance: np.ndarray, garden: float, road: float) -> None:
    """Trees in plots and open places, few on streets."""
    rng = site.rng
    a = site.area
    count = rng.poisson((a[2] - a[0]) * (a[3] - a[1]) / 100 * site.leafy * rng.uniform(0.2, 0.9))
    for x, y in np.column_stack([rng.uniform(a[0], a[2], count), rng.uniform(a[1], a[3], count)]).tolist():
        off = distance[int((y - a[1]) / CELL) + EDGE, int((x - a[0]) / CELL) + EDGE]
        chance = 0.8 if off > road else 0.12 if off > garden else 0.6
        tall = rng.uniform(3, 9) if off < garden else rng.uniform(5, 15)
        if off > 0.8 and rng.random() < chance:
            wide = tall * rng.uniform(0.25, 0.45)
            site.tree(x, y, min(wide, off + 1.5), tall, use="bare" if rng.random() < site.bare else "tree")


def _cars(site: Site, distance: np.ndarray, owner: np.ndarray, walk: float, road: float) -> None:
    """Cars along the kerbs and on the carriageway, in the direction of the street."""
    rng = site.rng
    slope = np.stack(np.gradient(cv2.GaussianBlur(distance, (0, 0), 2.0)), -1)
    kerb = np.argwhere((np.abs(distance - walk - 1.2) < CELL / 2) & (owner > 0))
    free = np.argwhere((distance > walk + 3) & (distance < road))
    for cells, share in ((kerb, site.parked / 14), (free, 0.0005)):
        for row, col in cells[rng.random(len(cells)) < share].tolist():
            down, right = slope[row, col]
            x, y = _position(site, np.array([col + 0.5, row + 0.5]))
            site.car(float(x), float(y), float(np.arctan2(right, -down)) + pick(rng, [0.0, np.pi]))
