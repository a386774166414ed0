"""Detached houses with their garages and annexes, churches, hedges: what blocks of several kinds are made of.

In: a `Site`, a `Place` or street coordinates (m). Out: nothing; they are built there.
"""

from __future__ import annotations

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.pieces import TREE, Place, pick
from kibs_steps.simulate.roofs import Wing, wing
from kibs_steps.simulate.site import Site


def _wings(
    rng: np.random.Generator, length: float, width: float, eave: float, pitch: float, kind: str, plan: str
) -> list[Wing]:
    """A house of one or more wings, centred on its main one."""
    half, deep = length / 2, width / 2
    share = rng.uniform(0.35, 0.65)
    main = wing(kind, -half, -deep, half, deep, eave, pitch, True, share)
    if plan == "rectangle" or kind in ("shed", "flat", "pyramid", "mansard", "gambrel", "skew_gable"):
        if plan == "rectangle":
            return [main]
        # A lower annexe beside the main wing.
        low = max(2.3, eave - rng.uniform(0.6, 3.0))
        w, d = rng.uniform(0.35, 0.9) * width, rng.uniform(2.5, 6.0)
        a = rng.uniform(-deep, deep - w)
        annexe = pick(rng, ["flat", "shed", "gable"])
        fall = min(pitch, 0.35 if annexe == "shed" else pitch)
        return [main, wing(annexe, half, a, half + d, a + w, low, fall, bool(rng.random() < 0.7), share)]
    w = min(rng.uniform(0.5, 1.0) * width, 0.45 * length if plan == "U" else 0.8 * length)
    out = rng.uniform(0.25, 0.9) * width
    end = "one_hip" if kind in ("hip", "one_hip") else "gable"
    lower = eave if rng.random() < 0.8 else max(2.3, eave - rng.uniform(0.4, 1.5))

    def side(x: float) -> Wing:
        return wing(end, x, -deep - out, x + w, 0.0, lower, pitch, False, share)

    if plan == "L":
        return [main, side(-half if rng.random() < 0.5 else half - w)]
    if plan == "U":
        return [main, side(-half), side(half - w)]
    x = -half + rng.uniform(0.1, 0.9) * (length - w)
    if plan == "cross":
        return [
            main,
            wing("gable", x, -deep - out, x + w, deep + out * rng.uniform(0.3, 1), lower, pitch, False, share),
        ]
    return [main, side(x)]


PLANS = ("rectangle", "L", "T", "U", "cross", "annexe")


def house(
    site: Site,
    place: Place,
    length: float,
    width: float,
    eave: float,
    roof: int | None = None,
    kinds: tuple[str, ...] = (
        "gable",
        "gable",
        "gable",
        "hip",
        "hip",
        "half_hip",
        "pyramid",
        "shed",
        "flat",
        "gambrel",
        "one_hip",
        "skew_gable",
    ),
    plain: float = 0.5,
    wall: int | None = None,
    steep: tuple[float, float] = (18, 52),
) -> None:
    """A detached house."""
    if not site.inside(place.x, place.y, length):
        return
    rng = site.rng
    kind = pick(rng, kinds)
    plan = "rectangle" if rng.random() < plain else pick(rng, PLANS)
    pitch = float(np.tan(np.radians(rng.uniform(*steep))))
    if kind in ("shed", "flat"):
        pitch = float(np.tan(np.radians(rng.uniform(4, 20))))
    if kind == "gambrel":
        pitch = min(pitch, 0.7)
    wings = _wings(rng, length, width, eave, pitch, kind, plan)
    flat = kind == "flat"
    site.building(
        place,
        wings,
        roof,
        wall,
        0.0 if flat else pick(rng, [0.0, rng.uniform(0.2, 0.9)]),
        pick(rng, [0.0, rng.uniform(0.2, 0.8)]) if flat else 0.0,
    )
    if length > 6 and rng.random() < 0.15 * site.leafy:  # a tree that hides the eave
        side = pick(rng, [-1.0, 1.0])
        off = rng.uniform(0.8, 2.5)
        along, across = (length / 2 + off, rng.uniform(-0.5, 0.5) * width)
        if rng.random() < 0.6:
            along, across = rng.uniform(-0.5, 0.5) * length, width / 2 + off
        x, y = place.put(np.array([[side * along, side * across]]))[0].tolist()
        tall = rng.uniform(4, 12)
        site.tree(x, y, tall * rng.uniform(0.25, 0.4), tall)


def church(site: Site, place: Place) -> None:
    """A steep nave and a tower."""
    rng = site.rng
    long, wide, eave = rng.uniform(14, 32), rng.uniform(8, 13), rng.uniform(6, 12)
    side = rng.uniform(4.5, 7)
    top = eave + wide * rng.uniform(0.6, 1.3)
    nave = wing(pick(rng, ["gable", "one_hip"]), -long / 2, -wide / 2, long / 2, wide / 2, eave, rng.uniform(0.8, 1.4))
    spire = pick(rng, [0.3, 1.0, 2.5, 4.0])
    tower = wing("pyramid", long / 2, -side / 2, long / 2 + side, side / 2, top, spire)
    site.building(place, [nave, tower])


def blob(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A roundish ring (n, 2) m."""
    angle = np.linspace(0, 2 * np.pi, 9, endpoint=False)
    return radius * rng.uniform(0.6, 1.2, (9, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])


def hedge(site: Site, s0: float, t0: float, s1: float, t1: float, chance: float) -> None:
    """A hedge along a street-frame line, or none."""
    rng = site.rng
    if rng.random() > chance * site.hedges:
        return
    a, b = np.array(site.at(s0, t0)), np.array(site.at(s1, t1))
    if not (site.inside(*a, 5) or site.inside(*b, 5)):
        return
    d = b - a
    place = Place(*((a + b) / 2), float(np.arctan2(d[1], d[0])))
    half = np.hypot(*d) / 2 * rng.uniform(0.6, 1)
    wide = rng.uniform(0.3, 0.9)
    site.box(place, np.array(roofs.rectangle(-half, -wide, half, wide)), rng.uniform(0.9, 2.4), "tree", TREE)
