"""Procedural cities: a grid of bent streets whose blocks are filled by style.

In: a random generator, an area (map metres), a terrain, a style. Out: a `City`: planar faces in map metres with absolute z,
ground paints (drawn in order, later over earlier) and materials.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from kibs_steps.simulate import blocks, draped, roofs
from kibs_steps.simulate.draped import House
from kibs_steps.simulate.outdoors import add_decoys, street
from kibs_steps.simulate.pieces import City, pick
from kibs_steps.simulate.site import Site
from kibs_steps.simulate.surfaces import palette
from kibs_steps.terrain import Terrain

STYLES = ("suburb", "rows", "village", "perimeter", "centre", "industry", "farm", "desert", "estate", "harbour")
BLOCKS = {  # block length and depth, road width: least and most (m)
    "suburb": (80, 170, 46, 78, 5, 9),
    "rows": (70, 150, 38, 80, 5, 10),
    "village": (50, 130, 40, 90, 3.5, 7),
    "perimeter": (55, 130, 45, 90, 8, 18),
    "centre": (50, 110, 45, 90, 8, 20),
    "industry": (70, 180, 60, 130, 7, 14),
    "farm": (90, 220, 80, 200, 3, 5),
    "desert": (50, 110, 30, 60, 4, 10),
    "estate": (90, 200, 70, 130, 6, 12),
    "harbour": (80, 200, 70, 150, 6, 12),
    "mixed": (60, 130, 50, 90, 5, 14),
    "town": (70, 150, 45, 85, 5, 10),
}
MIXTURES = {  # shares of the styles; a town is detached houses and rows, some old core, some works
    "mixed": (0.2, 0.17, 0.12, 0.15, 0.1, 0.1, 0.04, 0.05, 0.06, 0.01),
    "town": (0.46, 0.26, 0.14, 0.0, 0.0, 0.1, 0.04, 0.0, 0.0, 0.0),
}
DETACHED = ("suburb", "rows", "village", "farm")  # where photographed houses may stand
NATIVE = {  # where a style is at home; elsewhere now and then
    "rows": ("holland", "britain", "north_france", "germany"),
    "town": ("north_france", "germany"),
    "village": ("north_france", "germany", "mediterranean", "scandinavia"),
    "perimeter": ("paris", "germany", "mediterranean", "north_france", "scandinavia", "holland"),
    "desert": ("desert", "desert", "mediterranean"),
}


def procedural(
    rng: np.random.Generator,
    width: float,
    height: float,
    terrain: Terrain,
    style: str,
    origin: tuple[float, float] = (0.0, 0.0),
    houses: Sequence[House] = (),
) -> City:
    """A city of one of `STYLES` or `MIXTURES` over `width`×`height` m whose lower-left corner is `origin` (map metres).

    With photographed `houses` most blocks of detached houses are made of them.
    """
    area = (origin[0], origin[1], origin[0] + width, origin[1] + height)
    native = NATIVE.get(style)
    country = pick(rng, native) if native and rng.random() < 0.75 else None
    kit = palette(rng, country)
    curved = rng.random() < {"suburb": 0.6, "village": 0.8, "farm": 0.5}.get(style, 0.25)
    site = Site(rng, terrain, kit, area, float(curved))
    whole = np.array(roofs.rectangle(area[0] - 50, area[1] - 50, area[2] + 50, area[3] + 50))
    site.paint(whole, pick(rng, ["lawn", "rough", "soil", "pavement"]))
    lay_out(site, style, houses)
    return City(site.faces, site.paints, kit.materials, site.photographs)


def lay_out(site: Site, style: str, houses: Sequence[House] = ()) -> None:
    """Streets over a site's whole area and what fills the blocks between them, where nothing stands yet."""
    rng = site.rng
    width, height = site.area[2] - site.area[0], site.area[3] - site.area[1]
    reach = np.hypot(width, height) / 2 + 30
    long0, long1, deep0, deep1, road0, road1 = BLOCKS[style]

    def cuts(low: float, high: float) -> list[tuple[float, float]]:
        at, out = -reach - rng.uniform(0, high), []
        while at < reach:
            length, road = rng.uniform(low, high), rng.uniform(road0, road1)
            out.append((at, at + length))
            at += length + road
        return out

    ss, ts = cuts(long0, long1), cuts(deep0, deep1)
    for (_, a), (b, _) in pairwise(ss):
        street(site, a, ts[0][0], b, ts[-1][1])
    for (_, a), (b, _) in pairwise(ts):
        street(site, ss[0][0], a, ss[-1][1], b)
    decoys = pick(rng, [0.0, 0.5])
    green = 0.12 if style != "farm" else 0.02
    for s0, s1 in ss:
        for t0, t1 in ts:
            corners = np.array([site.at(s, t) for s in (s0, (s0 + s1) / 2, s1) for t in (t0, t1)])
            if (corners.max(0) + 10 < site.area[:2]).any() or (corners.min(0) - 10 > site.area[2:]).any():
                continue
            name = style
            if style in MIXTURES:
                name = str(rng.choice(STYLES, p=MIXTURES[style]))
            elif rng.random() < 0.1:
                name = pick(rng, STYLES)
            if rng.random() < green:
                blocks.FILL["park"](site, s0, t0, s1, t1)
            elif houses and name in DETACHED and rng.random() < 0.85:
                draped.fill(site, houses, s0, t0, s1, t1)
            else:
                blocks.FILL[name](site, s0, t0, s1, t1)
            if rng.random() < decoys:
                add_decoys(site, s0, t0, s1, t1)
