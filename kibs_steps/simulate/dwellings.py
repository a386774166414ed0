"""Blocks of suburbs, rows and villages, in street coordinates (s0, t0, s1, t1 in m) of a `Site`."""

from __future__ import annotations

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.houses import blob, church, hedge, house
from kibs_steps.simulate.pieces import pick
from kibs_steps.simulate.roofs import wing
from kibs_steps.simulate.site import Site


def suburb(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    narrow = rng.uniform(11, 24)
    back = (t0 + t1) / 2
    setback = rng.uniform(2.5, 8)
    roof = site.kit.draw(rng, "pitched") if rng.random() < 0.3 else None
    size = rng.uniform(0.8, 1.25)
    storeys = rng.choice([1, 1.5, 2], p=[0.45, 0.3, 0.25])
    for front, sense in ((t0, 1), (t1, -1)):
        s = s0
        while s < s1 - 9:
            w = min(narrow * rng.uniform(0.8, 1.3), s1 - s)
            depth = abs(back - front)
            near, far = sorted((front, back))
            site.paint_street(s, near, s + w, far, "lawn" if rng.random() < 0.85 else "rough", 0.15)
            a, b = min(size * rng.uniform(8, 15), w - 2.5), min(size * rng.uniform(6.5, 11), depth - setback - 3)
            if a > 5 and b > 5 and rng.random() < 0.94:
                centre = front + sense * (setback + b / 2 + rng.uniform(0, 2))
                drive = rng.uniform(2.4, 5)
                x = s + rng.uniform(0.2, max(0.3, w - drive))
                site.paint_street(
                    x,
                    min(front, centre),
                    x + drive,
                    max(front, centre),
                    pick(rng, ["pavement", "gravel", "asphalt"]),
                    0.2,
                )
                if rng.random() < 0.6:
                    edge = centre + sense * b / 2
                    u, v = s + w / 2 - a * rng.uniform(0.2, 0.5), s + w / 2 + a * rng.uniform(0.2, 0.5)
                    site.paint_street(u, min(edge, edge + 4 * sense), v, max(edge, edge + 4 * sense), "pavement", 0.2)
                turn = rng.choice([0, np.pi / 2], p=[0.75, 0.25]) + pick(rng, [0, np.pi]) + rng.normal(0, 0.02)
                place = site.place(s + w / 2, centre, turn)
                long, wide = (a, b) if abs(np.sin(turn)) < 0.5 else (b, a)
                house(site, place, max(long, 6), max(wide, 5.5), storeys * 2.7 * rng.uniform(0.9, 1.1), roof)
                if rng.random() < 0.4:
                    g = site.place(s + w - 2.0, centre + sense * rng.uniform(-2, 5), pick(rng, [0, np.pi / 2]))
                    house(
                        site,
                        g,
                        rng.uniform(4, 6.5),
                        rng.uniform(2.8, 3.8),
                        rng.uniform(2.2, 2.9),
                        roof,
                        ("flat", "flat", "gable", "shed", "hip"),
                        1.0,
                        steep=(12, 35),
                    )
                if rng.random() < 0.8 and site.inside(*site.at(s + w - 2, front), 5):
                    p = site.place(x + drive / 2, front + sense * rng.uniform(2, 5), np.pi / 2)
                    site.car(p.x, p.y, p.angle)
            yard = sorted((front + sense * (setback + b + 4), back))
            if yard[1] - yard[0] > 4:
                garden = rng.random()
                if garden < 0.12:
                    p = site.place(s + w / 2 + rng.uniform(-2, 2), np.mean(yard))
                    ring = np.array(roofs.rectangle(-4, -2, 4, 2), float) * rng.uniform(0.6, 1.1)
                    site.paint(p.put(1.25 * ring), "pavement")
                    site.paint(p.put(ring), "pool")
                elif garden < 0.45:
                    p = site.place(s + rng.uniform(2, max(w - 2, 2.1)), rng.uniform(*yard), pick(rng, [0, np.pi / 2]))
                    house(
                        site,
                        p,
                        rng.uniform(2.5, 4.5),
                        rng.uniform(2, 3.2),
                        rng.uniform(2, 2.4),
                        None,
                        ("gable", "shed", "flat"),
                        1.0,
                        steep=(15, 35),
                    )
                elif garden < 0.6:
                    site.paint(
                        site.place(s + w / 2, np.mean(yard)).put(blob(rng, rng.uniform(1.5, 4.5))),
                        "soil",
                    )
                site.trees(s, yard[0], s + w, yard[1], site.leafy * rng.uniform(0, 1.6), 7)
            hedge(site, s, near, s, far, 0.5)
            s += w
    hedge(site, s0, back, s1, back, 0.7)


def _row(site: Site, s0: float, s1: float, t: float, depth: float, sense: int, eave: float, backs: bool) -> None:
    """A row of houses on a line t, gardens towards `sense`."""
    rng = site.rng
    unit = rng.uniform(4.8, 8.5)
    count = int((s1 - s0) / unit)
    if count < 1:
        return
    mode = str(rng.choice(["one", "stepped", "mixed"], p=[0.35, 0.35, 0.3]))
    kind = pick(rng, ["gable", "gable", "gable", "gable", "flat", "shed", "skew_gable", "cross_gable"])
    pitch = float(np.tan(np.radians(rng.uniform(25, 50) if kind != "shed" else rng.uniform(5, 20))))
    roof, wall = site.kit.draw(rng, "flat" if kind == "flat" else "pitched"), site.kit.draw(rng, "wall")
    over = pick(rng, [0.0, rng.uniform(0.2, 0.5)])
    site.buildings += 1
    number = site.buildings
    lift, shift, start = 0.0, 0.0, 0
    if mode == "one" and kind not in ("cross_gable",):
        lengths = [count]
    else:
        lengths = []
        while sum(lengths) < count:
            lengths.append(min(int(rng.integers(1, 2 if mode == "mixed" else 4)), count - sum(lengths)))
    for i, n in enumerate(lengths):
        length = n * unit
        s = s0 + (start + n / 2) * unit
        start += n
        if i and mode != "one":
            lift = lift + pick(rng, [-1, 1]) * rng.uniform(0.25, 1.0) if mode == "stepped" else rng.uniform(-1.2, 1.2)
            lift = float(np.clip(lift, -1.5, 2.5))
            shift = pick(rng, [0, 0, rng.uniform(-1.2, 1.2)])
        place = site.place(s, t + shift)
        half, deep = length / 2, depth / 2
        if kind == "cross_gable":
            wings = [wing("gable", -half, -deep, half, deep, eave + lift, pitch, False)]
        else:
            ends = kind if not (mode == "one" and kind == "gable" and rng.random() < 0.3) else "hip"
            wings = [wing(ends, -half, -deep, half, deep, eave + lift, pitch, True, 0.4)]
        own_roof = site.kit.draw(rng, "flat" if kind == "flat" else "pitched") if mode == "mixed" else roof
        own_wall = site.kit.draw(rng, "wall") if mode == "mixed" else wall
        site.building(
            place,
            wings,
            own_roof,
            own_wall,
            over if mode == "one" else 0.0,
            0.4 if kind == "flat" and mode == "mixed" else 0.0,
            number=number,
        )
    for j in range(count):
        s = s0 + (j + 0.5) * unit
        near, far = t + sense * depth / 2, t + sense * (depth / 2 + 9)
        lo, hi = sorted((near, far))
        site.paint_street(
            s - unit / 2,
            lo,
            s + unit / 2,
            hi,
            pick(rng, ["lawn", "lawn", "rough", "pavement", "gravel", "soil"]),
            0.25,
        )
        if backs and rng.random() < 0.6:
            d, w = rng.uniform(2, 5), unit * rng.uniform(0.4, 0.95)
            p = site.place(s + pick(rng, [-1, 1]) * (unit - w) / 2, near + sense * d / 2)
            house(site, p, w, d, rng.uniform(2.3, 3.2), None, ("flat", "flat", "shed"), 1.0)
        if rng.random() < 0.4:
            p = site.place(s + rng.uniform(-1, 1), far - sense * 1.3)
            house(
                site,
                p,
                rng.uniform(1.8, 3),
                rng.uniform(1.6, 2.6),
                2.1,
                None,
                ("flat", "gable", "shed"),
                1.0,
                steep=(10, 30),
            )
        if rng.random() < 0.5:
            hedge(site, s + unit / 2, near, s + unit / 2, far, 0.7)
    site.trees(
        s0,
        min(t, t + sense * (depth / 2 + 9)) + depth / 2,
        s1,
        max(t, t + sense * (depth / 2 + 9)),
        site.leafy * 0.7,
        5,
    )


def rows(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    depth = rng.uniform(7.5, 12)
    eave = pick(rng, [2.8, 5.5, 6, 8.5, 9]) * rng.uniform(0.9, 1.15)
    front = rng.uniform(1.5, 6)
    backs = rng.random() < 0.6
    site.paint_street(s0, t0, s1, t1, pick(rng, ["lawn", "pavement", "rough"]))
    t = t0
    sense = 1
    while t + front + depth < t1:
        s = s0 + rng.uniform(0, 6)
        while s < s1 - 12:
            length = min(rng.uniform(18, 60), s1 - s)
            _row(
                site,
                s,
                s + length,
                t + front + depth / 2 if sense > 0 else t + 9 + depth / 2,
                depth,
                sense,
                eave,
                backs,
            )
            s += length + rng.uniform(3, 10)
        t += front + depth + 9 if sense > 0 else 9 + depth + front + pick(rng, [0, 7])
        sense = -sense if rng.random() < 0.8 else sense


def village(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, "lawn" if rng.random() < 0.6 else "rough")
    taken: list[tuple[float, float, float]] = []
    for _ in range(int((s1 - s0) * (t1 - t0) / rng.uniform(70, 240))):
        barn = rng.random() < 0.3
        a, b = (rng.uniform(12, 26), rng.uniform(8, 13)) if barn else (rng.uniform(7, 16), rng.uniform(6, 10))
        edge = rng.random() < 0.55
        s = rng.uniform(s0 + a / 2, max(s1 - a / 2, s0 + a / 2 + 0.1))
        t = rng.uniform(t0 + b / 2, max(t1 - b / 2, t0 + b / 2 + 0.1))
        if edge:
            t = t0 + b / 2 + rng.uniform(0, 3) if rng.random() < 0.5 else t1 - b / 2 - rng.uniform(0, 3)
        r = 0.46 * np.hypot(a, b)
        if any((s - x) ** 2 + (t - y) ** 2 < (r + q) ** 2 for x, y, q in taken):
            continue
        taken.append((s, t, r))
        turn = pick(rng, [0, 0, np.pi / 2]) + rng.normal(0, 0.12)
        yard = site.place(s, t, turn)
        if rng.random() < 0.6:
            site.paint(
                yard.put(np.array(roofs.rectangle(-a * 0.7, -b * 1.1, a * 0.7, b * 0.4)) + rng.normal(0, 1, (4, 2))),
                pick(rng, ["gravel", "pavement", "asphalt", "soil"]),
                0.2,
            )
        if barn and rng.random() < 0.1:
            church(site, yard)
            continue
        house(
            site,
            yard,
            a,
            b,
            rng.uniform(2.5, 7),
            None,
            ("gable",) * 6 + ("half_hip", "hip", "shed", "one_hip"),
            0.55,
            steep=(25, 55),
        )
        if rng.random() < 0.5:
            g = site.place(s + rng.uniform(-r, r) * 1.6, t + rng.uniform(-r, r) * 1.6, turn + pick(rng, [0, np.pi / 2]))
            taken.append((s, t, r + 3))
            house(
                site,
                g,
                rng.uniform(4, 9),
                rng.uniform(3, 6),
                rng.uniform(2.2, 3.5),
                None,
                ("gable", "shed", "flat"),
                1.0,
                steep=(12, 40),
            )
    site.trees(s0, t0, s1, t1, site.leafy * rng.uniform(0.2, 0.8), 8)
