"""Blocks of towns: perimeters, lots of very different heights, courtyards of the desert, estates of slabs and towers.

All in street coordinates (s0, t0, s1, t1 in m) of a `Site`.
"""

from __future__ import annotations

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.houses import house
from kibs_steps.simulate.outdoors import parking
from kibs_steps.simulate.pieces import Place, pick
from kibs_steps.simulate.roofs import Wing, wing
from kibs_steps.simulate.site import Site


def _tall(
    site: Site, place: Place, a: float, b: float, eave: float, roof: int | None, wall: int | None, number: int | None
) -> None:
    """One town house or block unit; x along the street."""
    rng = site.rng
    kind = str(
        rng.choice(["gable", "flat", "mansard", "shed", "hip", "skew_gable"], p=[0.38, 0.24, 0.14, 0.06, 0.08, 0.1])
    )
    pitch = float(np.tan(np.radians(rng.uniform(20, 45))))
    if kind == "mansard":
        pitch = float(np.tan(np.radians(rng.uniform(45, 68))))
        w = wing(
            "mansard",
            -a / 2,
            -b / 2,
            a / 2,
            b / 2,
            eave,
            pitch,
            True,
            min(0.9, rng.uniform(2.2, 3.6) / (pitch * b / 2)),
        )
        # Party walls on the short sides: no slope there.
        w = Wing(w.footprint, (w.planes[0], w.planes[1], w.planes[4])) if rng.random() < 0.8 else w
    else:
        pitch = 0.12 if kind == "shed" else pitch
        w = wing(kind, -a / 2, -b / 2, a / 2, b / 2, eave, pitch, True, rng.uniform(0.3, 0.6))
    site.building(place, [w], roof, wall, 0.0, rng.uniform(0.3, 1.1) if kind == "flat" else 0.0, number=number)


def perimeter(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    deep = rng.uniform(9, 14)
    eave = rng.uniform(8, 20)
    vary = rng.uniform(0.3, 3)
    site.paint_street(s0, t0, s1, t1, pick(rng, ["pavement", "gravel", "asphalt", "lawn"]))
    site.buildings += 1
    number = site.buildings
    if min(s1 - s0, t1 - t0) < 2.4 * deep:
        return centre(site, s0, t0, s1, t1)
    sides = [
        (s0, s1, t0 + deep / 2, 0.0, False),
        (s0, s1, t1 - deep / 2, np.pi, False),
        (t0 + deep, t1 - deep, s0 + deep / 2, -np.pi / 2, True),
        (t0 + deep, t1 - deep, s1 - deep / 2, np.pi / 2, True),
    ]
    for start, end, line, turn, upright in sides:
        if rng.random() < 0.08:
            continue
        at = start
        while at < end - 1:
            w = rng.uniform(8, 24)
            w = end - at if end - at - w < 7 else w
            mid = at + w / 2
            place = site.place(line, mid, turn) if upright else site.place(mid, line, turn)
            if rng.random() > 0.04:
                _tall(
                    site,
                    place,
                    w,
                    deep + pick(rng, [0, 0, rng.uniform(-1.5, 0)]),
                    eave + rng.uniform(-vary, vary),
                    None,
                    None,
                    number,
                )
                if rng.random() < 0.35:  # a wing into the courtyard
                    d = rng.uniform(4, 9)
                    out = (deep + d) / 2
                    p = place._replace(x=place.x - np.sin(place.angle) * out, y=place.y + np.cos(place.angle) * out)
                    house(
                        site,
                        p,
                        w * rng.uniform(0.3, 0.7),
                        d,
                        eave * rng.uniform(0.3, 0.8),
                        None,
                        ("flat", "shed", "gable"),
                        1.0,
                    )
            at += w
    c = [s0 + deep, t0 + deep, s1 - deep, t1 - deep]
    if c[2] - c[0] > 8 and c[3] - c[1] > 8:
        for _ in range(int(rng.integers(0, 5))):
            a, b = rng.uniform(0, 1, 2)
            s, t = c[0] + a * (c[2] - c[0]), c[1] + b * (c[3] - c[1])
            site.paint_street(s - 5, t - 4, s + 5, t + 4, pick(rng, ["lawn", "pavement", "rough", "gravel"]), 0.2)
        for _ in range(int(rng.integers(0, 4))):
            s, t = rng.uniform(c[0] + 4, c[2] - 4), rng.uniform(c[1] + 4, c[3] - 4)
            house(
                site,
                site.place(s, t, pick(rng, [0, np.pi / 2])),
                rng.uniform(5, 12),
                rng.uniform(3, 7),
                rng.uniform(2.5, 5),
                None,
                ("flat", "flat", "gable", "shed"),
                0.8,
            )
        site.trees(*c, site.leafy * 0.7, 9)


def centre(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Town blocks: recursive lots, flat roofs of very different heights."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["pavement", "asphalt", "lawn"]))
    top = rng.uniform(8, 34) if rng.random() < 0.85 else rng.uniform(34, 58)
    lot = rng.uniform(14, 38)

    def fill(a: float, b: float, c: float, d: float) -> None:
        w, h = c - a, d - b
        if max(w, h) > lot * 1.5 and max(w, h) > 12:
            cut = rng.uniform(0.35, 0.65)
            if w > h:
                fill(a, b, a + cut * w, d)
                fill(a + cut * w, b, c, d)
            else:
                fill(a, b, c, b + cut * h)
                fill(a, b + cut * h, c, d)
            return
        gap = pick(rng, [0.0, 0.0, rng.uniform(1, 7)])
        w, h = w - gap, h - gap
        if w < 5 or h < 5:
            return
        if rng.random() < 0.1:
            parking(site, a, b, c, d)
            return
        place = site.place((a + c) / 2, (b + d) / 2, pick(rng, [0, np.pi]))
        eave = max(3.0, top * rng.uniform(0.3, 1.1))
        if rng.random() < 0.72:
            plan = [wing("flat", -w / 2, -h / 2, w / 2, h / 2, eave, 0)]
            if rng.random() < 0.2:
                plan = [Wing(_odd(rng, w, h), plan[0].planes)]
            elif rng.random() < 0.35 and w > 12:  # a tower and a lower part
                cut = rng.uniform(-0.2, 0.2) * w
                plan = [
                    wing("flat", -w / 2, -h / 2, cut, h / 2, eave, 0),
                    wing(
                        "flat",
                        cut,
                        -h / 2,
                        w / 2,
                        h / 2 * pick(rng, [1.0, rng.uniform(0.2, 0.9)]),
                        max(3, eave * rng.uniform(0.3, 0.8)),
                        0,
                    ),
                ]
            site.building(
                place,
                plan,
                None if len(plan) == 1 else site.kit.draw(rng, "flat"),
                None,
                0.0,
                pick(rng, [0.0, rng.uniform(0.3, 1.2)]),
            )
        elif w > h:
            _tall(site, place, w, h, eave, None, None, None)
        else:
            _tall(site, place._replace(angle=place.angle + np.pi / 2), h, w, eave, None, None, None)

    fill(s0, t0, s1, t1)


def _odd(rng: np.random.Generator, w: float, h: float) -> list[tuple[float, float]]:
    """A convex plan within w×h that is no rectangle: cut corners, a slanted side, or round."""
    if rng.random() < 0.25:
        angle = np.linspace(0, 2 * np.pi, int(rng.integers(6, 20)), endpoint=False)
        return [(w / 2 * float(np.cos(a)), h / 2 * float(np.sin(a))) for a in angle]
    ring = roofs.rectangle(-w / 2, -h / 2, w / 2, h / 2)
    for _ in range(int(rng.integers(1, 3))):
        a = rng.uniform(0, 2 * np.pi)
        reach = abs(np.cos(a)) * w / 2 + abs(np.sin(a)) * h / 2
        ring = roofs.clip(ring, -float(np.cos(a)), -float(np.sin(a)), float(reach - rng.uniform(0.1, 0.35) * min(w, h)))
    return ring


def desert(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Walled courtyards and flat roofs, wall to wall."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, "soil")
    lot = rng.uniform(12, 24)
    for s in np.arange(s0, s1 - lot / 2, lot):
        for t in np.arange(t0, t1 - lot / 2, lot):
            a, b = min(lot, s1 - s) * rng.uniform(0.45, 1), min(lot, t1 - t) * rng.uniform(0.45, 1)
            if a < 4 or b < 4 or rng.random() < 0.08:
                continue
            eave = rng.uniform(2.8, 4) * rng.choice([1, 2, 3], p=[0.4, 0.4, 0.2])
            place = site.place(s + a / 2, t + b / 2)
            wings = [wing("flat", -a / 2, -b / 2, a / 2, b / 2, eave, 0)]
            if rng.random() < 0.5:
                c = rng.uniform(-0.2, 0.3) * a
                wings = [
                    wing("flat", -a / 2, -b / 2, c, b / 2, eave, 0),
                    wing("flat", c, -b / 2, a / 2, b * rng.uniform(-0.1, 0.5), eave * rng.uniform(0.5, 0.95), 0),
                ]
            site.building(place, wings, site.kit.draw(rng, "flat"), None, 0.0, rng.uniform(0.3, 1.3))
    site.trees(s0, t0, s1, t1, site.leafy * 0.3, 6)


def estate(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Slabs and towers of flats, schools: large flat roofs with wings, far apart, on lawns."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["lawn", "lawn", "rough", "pavement"]))
    if rng.random() < 0.6:
        parking(site, s0, t0, s1, t0 + rng.uniform(7, 17))
    slab = rng.random() < 0.6
    deep, storeys = rng.uniform(9.5, 15), int(rng.integers(2, 12))
    roof, wall = site.kit.draw(rng, "flat"), site.kit.draw(rng, "wall")
    parapet = pick(rng, [0.0, rng.uniform(0.2, 0.8)])
    turn = pick(rng, [0.0, 0.0, np.pi / 2, rng.uniform(-0.5, 0.5)])
    for _ in range(int((s1 - s0) * (t1 - t0) / rng.uniform(450, 1300)) + 1):
        a = deep * (rng.uniform(2.5, 6) if slab else rng.uniform(1, 1.8))
        eave = 2.9 * max(1, storeys + int(rng.integers(-1, 2)))
        place = site.place(rng.uniform(s0, s1), rng.uniform(t0, t1), turn + pick(rng, [0, 0, np.pi / 2]))
        wings = [wing("flat", -a / 2, -deep / 2, a / 2, deep / 2, eave, 0)]
        extra = rng.random()
        lower = pick(rng, [eave, eave * rng.uniform(0.3, 0.9)])
        if extra < 0.35:
            x = rng.uniform(-a / 2, a / 2 - 0.6 * deep)
            wings.append(
                wing("flat", x, deep / 2, x + rng.uniform(0.4, 0.9) * deep, deep * rng.uniform(0.9, 2.5), lower, 0)
            )
        elif extra < 0.5:  # offset halves
            shift = rng.uniform(0.2, 0.7) * deep
            half = wing("flat", 0, shift - deep / 2, a / 2, shift + deep / 2, lower, 0)
            wings = [wing("flat", -a / 2, -deep / 2, 0, deep / 2, eave, 0), half]
        elif extra < 0.6:
            pitch = float(np.tan(np.radians(rng.uniform(12, 35))))
            wings = [wing(pick(rng, ["hip", "gable"]), -a / 2, -deep / 2, a / 2, deep / 2, eave, pitch)]
        flat = extra >= 0.6 or extra < 0.5
        site.building(place, wings, roof if flat else None, wall, 0.0, parapet if flat else 0.0)
    site.trees(s0, t0, s1, t1, site.leafy * 0.4, 10)
