"""What fills the blocks of a city: houses on plots, rows, block perimeters, towers, halls, farms, parks, streets.

Every filler takes a `Site` and a rectangle in street coordinates (s0, t0, s1, t1 in m) and builds there.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.roofs import Wing, wing
from kibs_steps.simulate.site import CLUTTER, ROOF, TREE, Face, Place, Site, pick


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


def _suburb(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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
                        site.place(s + w / 2, np.mean(yard)).put(_blob(rng, rng.uniform(1.5, 4.5))),
                        "soil",
                    )
                site.trees(s, yard[0], s + w, yard[1], site.leafy * rng.uniform(0, 1.6), 7)
            _hedge(site, s, near, s, far, 0.5)
            s += w
    _hedge(site, s0, back, s1, back, 0.7)


def _blob(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A roundish ring (n, 2) m."""
    angle = np.linspace(0, 2 * np.pi, 9, endpoint=False)
    return radius * rng.uniform(0.6, 1.2, (9, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])


def _hedge(site: Site, s0: float, t0: float, s1: float, t1: float, chance: float) -> None:
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
            _hedge(site, s + unit / 2, near, s + unit / 2, far, 0.7)
    site.trees(
        s0,
        min(t, t + sense * (depth / 2 + 9)) + depth / 2,
        s1,
        max(t, t + sense * (depth / 2 + 9)),
        site.leafy * 0.7,
        5,
    )


def _rows(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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


def _village(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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
            _church(site, yard)
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


def _perimeter(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    deep = rng.uniform(9, 14)
    eave = rng.uniform(8, 20)
    vary = rng.uniform(0.3, 3)
    site.paint_street(s0, t0, s1, t1, pick(rng, ["pavement", "gravel", "asphalt", "lawn"]))
    site.buildings += 1
    number = site.buildings
    if min(s1 - s0, t1 - t0) < 2.4 * deep:
        return _centre(site, s0, t0, s1, t1)
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


def _centre(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Town blocks: recursive lots, flat roofs of very different heights."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["pavement", "asphalt", "lawn"]))
    top = rng.uniform(8, 34)
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
            _parking(site, a, b, c, d)
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


def _parking(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, "asphalt", 0.15)
    mark, full = site.kit.uses["marking"][0], rng.uniform(0.1, 0.9)
    lines = rng.random() < 0.7
    t = t0 + 1
    while t + 5 < t1:
        for s in np.arange(s0 + 1, s1 - 2.5, 2.6):
            p = site.place(s + 1.3, t + 2.5, np.pi / 2)
            if not site.inside(p.x, p.y, 3):
                continue
            if lines:
                site.paint(p.put(np.array(roofs.rectangle(-2.5, -1.36, 2.5, -1.22))), mark, 0.05)
            if rng.random() < full:
                site.car(p.x, p.y, p.angle + pick(rng, [0, np.pi]))
        t += pick(rng, [5.2, 11.0])


def _industry(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["asphalt", "pavement", "gravel", "rough"]))

    def fill(a: float, b: float, c: float, d: float) -> None:
        w, h = c - a, d - b
        if max(w, h) > 75 or (max(w, h) > 38 and rng.random() < 0.7):
            cut = rng.uniform(0.35, 0.65)
            if w > h:
                fill(a, b, a + cut * w, d)
                fill(a + cut * w, b, c, d)
            else:
                fill(a, b, c, b + cut * h)
                fill(a, b + cut * h, c, d)
            return
        margin = rng.uniform(1.5, 7)
        w, h = w - 2 * margin, h - 2 * margin
        what = rng.random()
        place = site.place((a + c) / 2, (b + d) / 2)
        if w < 7 or h < 7 or what < 0.14:
            if rng.random() < 0.5:
                _parking(site, a, b, c, d)
            else:
                _yard(site, a, b, c, d)
            return
        if what < 0.22:
            r = min(w, h) / rng.uniform(2.2, 5)
            for s in np.arange(a + margin + r, c - margin - r, 2.3 * r):
                for t in np.arange(b + margin + r, d - margin - r, 2.3 * r):
                    p = site.place(s, t)
                    site.tank(p, r, r * rng.uniform(0.6, 2.0))
            return
        if h > w:
            place, w, h = place._replace(angle=place.angle + np.pi / 2), h, w
        eave = rng.uniform(4, 13)
        x0, y0, x1, y1 = -w / 2, -h / 2, w / 2, h / 2
        roof, kind = None, rng.random()
        low = float(np.tan(np.radians(rng.uniform(4, 16))))
        if kind < 0.35:
            wings, parapet = [wing("flat", x0, y0, x1, y1, eave, 0)], pick(rng, [0.0, rng.uniform(0.2, 0.9)])
        elif kind < 0.65:
            wings, parapet = [wing("gable", x0, y0, x1, y1, eave, low)], 0.0
        elif kind < 0.82:  # bays side by side
            n = int(max(2, h // rng.uniform(9, 20)))
            ys = np.linspace(y0, y1, n + 1)
            wings, parapet = (
                [wing("gable", x0, p, x1, q, eave, 2 * low) for p, q in pairwise(ys)],
                0.0,
            )
        elif kind < 0.93:  # sawtooth: each shed ends in a step
            n = int(max(2, w // rng.uniform(5, 10)))
            xs = np.linspace(x0, x1, n + 1)
            wings, parapet = (
                [wing("shed", p, y0, q, y1, eave, 0.45, False) for p, q in pairwise(xs)],
                0.0,
            )
        else:
            wings, parapet = [wing("shed", x0, y0, x1, y1, eave, 0.6 * low)], 0.0
        roof = site.kit.draw(rng, "works_flat" if kind < 0.35 else "works_pitched")
        if rng.random() < 0.4:  # an office in front
            q = rng.uniform(5, 9)
            wings = [*wings, wing("flat", x1, y0, x1 + q, y0 + h * rng.uniform(0.2, 0.8), rng.uniform(3, 8), 0)]
        number = site.building(place, wings, roof, None, 0.0, parapet, "works_")
        if number and rng.random() < 0.35 and len(wings) <= 2:
            _rooflights(site, number)

    fill(s0, t0, s1, t1)


def _rooflights(site: Site, number: int) -> None:
    """Strips of light along the slopes of a hall."""
    rng = site.rng
    gap, wide = rng.uniform(4, 9), rng.uniform(0.7, 1.6)
    for face in [f for f in site.faces if f.building == number and f.kind == ROOF]:
        axes = roofs.frame_of(face.ring)
        width, depth = axes.ring.max(0)
        for u in np.arange(gap / 2, width - wide, gap):
            if axes.holds(u, depth * 0.15, u + wide, depth * 0.85):
                slab = roofs.slab(axes, u, depth * 0.15, u + wide, depth * 0.85, 0.08)
                site.faces.append(Face(slab, (), CLUTTER, 0, number, site.kit.uses["skylight"][1], (1, 1, 1)))


def _yard(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Containers, lorries, heaps: decoys with shadows."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["gravel", "asphalt", "soil", "pavement"]))
    angle = pick(rng, [0, np.pi / 2])
    for _ in range(int((s1 - s0) * (t1 - t0) * rng.uniform(0, 0.02))):
        p = site.place(rng.uniform(s0 + 3, s1 - 3), rng.uniform(t0 + 3, t1 - 3), angle + rng.normal(0, 0.03))
        if site.inside(p.x, p.y, 3):
            long = pick(rng, [3.0, 6.1])
            site.box(p, np.array(roofs.rectangle(-long, -1.2, long, 1.2)), pick(rng, [2.6, 2.6, 5.2]), "box")


def _farm(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, "field", 0.15)
    s, t = rng.uniform(s0, s1), rng.uniform(t0, t1)
    site.paint_street(s, t0, s1, t1, "field", 0.15)
    if rng.random() < 0.5:
        site.paint_street(s0, t, s, t1, "field", 0.15)
    if rng.random() < 0.7:
        a, b = min(s1 - s0, rng.uniform(35, 70)), min(t1 - t0, rng.uniform(30, 60))
        x, y = rng.uniform(s0, s1 - a), rng.uniform(t0, t1 - b)
        site.paint_street(x, y, x + a, y + b, pick(rng, ["gravel", "rough", "soil", "pavement"]))
        _village(site, x, y, x + a, y + b) if rng.random() < 0.5 else _barns(site, x, y, x + a, y + b)
    site.trees(s0, t - 2, s1, t + 2, 3 * site.leafy * rng.random(), 9)


def _barns(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    rng = site.rng
    for t in np.arange(t0 + 8, t1 - 8, rng.uniform(16, 26)):
        a, b = rng.uniform(0.4, 0.9) * (s1 - s0), rng.uniform(8, 15)
        place = site.place(s0 + a / 2, t, rng.normal(0, 0.03))
        kind = pick(rng, ["gable", "gable", "gable", "shed", "gambrel", "skew_gable"])
        pitch = float(np.tan(np.radians(rng.uniform(10, 35))))
        site.building(
            place,
            [
                wing(
                    kind,
                    -a / 2,
                    -b / 2,
                    a / 2,
                    b / 2,
                    rng.uniform(3, 6.5),
                    0.15 if kind == "shed" else pitch,
                    True,
                    0.5,
                )
            ],
            None,
            None,
            0.3,
            0,
            "works_",
        )
        if rng.random() < 0.4:
            site.tank(site.place(s0 + a + 5, t), rng.uniform(1.5, 4), rng.uniform(4, 12))


def _desert(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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


def _estate(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Slabs and towers of flats, schools: large flat roofs with wings, far apart, on lawns."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["lawn", "lawn", "rough", "pavement"]))
    if rng.random() < 0.6:
        _parking(site, s0, t0, s1, t0 + rng.uniform(7, 17))
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


def _church(site: Site, place: Place) -> None:
    """A steep nave and a tower."""
    rng = site.rng
    long, wide, eave = rng.uniform(14, 32), rng.uniform(8, 13), rng.uniform(6, 12)
    side = rng.uniform(4.5, 7)
    top = eave + wide * rng.uniform(0.6, 1.3)
    nave = wing(pick(rng, ["gable", "one_hip"]), -long / 2, -wide / 2, long / 2, wide / 2, eave, rng.uniform(0.8, 1.4))
    spire = pick(rng, [0.3, 1.0, 2.5, 4.0])
    tower = wing("pyramid", long / 2, -side / 2, long / 2 + side, side / 2, top, spire)
    site.building(place, [nave, tower])


def add_decoys(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Painted ground that looks like a roof but has no height and throws no shadow."""
    rng = site.rng
    for _ in range(rng.poisson(0.8)):
        s, t = rng.uniform(s0, s1), rng.uniform(t0, t1)
        place = site.place(s, t, rng.uniform(0, 3))
        a, b = rng.uniform(3, 12, 2)
        material = site.kit.draw(rng, pick(rng, ["pitched", "flat", "works_flat", "court", "pavement", "box"]))
        if site.built(place.x, place.y):
            continue
        site.paint(place.put(np.array(roofs.rectangle(-a, -b, a, 0.0))), material, 0.1, place.angle)
        site.paint(place.put(np.array(roofs.rectangle(-a, 0.0, a, b))), material, 0.25, place.angle)


def _park(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """No buildings: park, water, sport, wood, rails."""
    rng = site.rng
    what = pick(rng, ["park", "wood", "water", "sport", "rails", "square"])
    site.paint_street(s0, t0, s1, t1, {"rails": "soil", "square": "pavement"}.get(what, "lawn"))
    cs, ct = (s0 + s1) / 2, (t0 + t1) / 2
    place = site.place(cs, ct)
    w, h = (s1 - s0) / 2, (t1 - t0) / 2
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    oval = np.column_stack([np.cos(angle), np.sin(angle)])
    blob = oval * [w, h] * (0.6 + 0.25 * np.sin(angle * rng.integers(2, 5) + rng.uniform(0, 6)))[:, None]
    if what == "water":
        site.paint(place.put(1.08 * blob), "rough")
        site.paint(place.put(blob), "water")
        for _ in range(int(rng.integers(0, 6))):
            p = site.place(cs + rng.uniform(-0.3, 0.3) * w, ct + rng.uniform(-0.3, 0.3) * h, rng.uniform(0, 3))
            site.box(p, np.array([[-4, -1], [3, -1.2], [5, 0], [3, 1.2], [-4, 1]]) * rng.uniform(0.5, 1.5), 1.2, "car")
    elif what == "sport":
        if rng.random() < 0.5:
            stadium = oval * [0.9 * w, 0.8 * h]
            site.paint(place.put(stadium), "track")
            site.paint(place.put(0.78 * stadium), "lawn")
        else:
            for i in range(4):
                p = site.place(s0 + w * (0.3 + 0.45 * i), ct)
                site.paint(p.put(np.array(roofs.rectangle(-7.5, -16, 7.5, 16))), "court")
                site.paint(p.put(np.array(roofs.rectangle(-5.5, -12, 5.5, 12))), "court")
                site.paint(p.put(np.array(roofs.rectangle(-5.5, -0.1, 5.5, 0.1))), "marking")
    elif what == "rails":
        for t in np.arange(t0 + 3, t1 - 3, rng.uniform(4, 6)):
            site.paint_street(s0 - 6, t - 1.3, s1 + 6, t + 1.3, "rail")
            if rng.random() < 0.25:
                a = rng.uniform(s0, s1)
                p = site.place(a, t)
                site.box(p, np.array(roofs.rectangle(-13, -1.4, 13, 1.4)), 3.8, "box")
    elif what == "square":
        for _ in range(int(rng.integers(2, 9))):
            p = site.place(rng.uniform(s0, s1), rng.uniform(t0, t1), pick(rng, [0, np.pi / 4]))
            site.paint(
                p.put(np.array(roofs.rectangle(-1, -1, 1, 1)) * rng.uniform(2, 9, 2)),
                pick(rng, ["pavement", "lawn", "court", "gravel"]),
                0.2,
            )
    else:
        if rng.random() < 0.6:
            a, b = np.sort(rng.uniform(s0, s1, 2)).tolist()
            site.paint_street(a, t0, b + 3, t1, "rough", 0.2)
        p = np.cumsum(np.column_stack([np.full(12, 2 * w / 11), rng.normal(0, 4, 12)]), 0) - [w, 0]
        site.paint(place.put(np.concatenate([p, p[::-1] + np.array([0, 2.2])])), "gravel")
    site.trees(s0, t0, s1, t1, {"wood": 3.0, "park": 1.2}.get(what, 0.25) * rng.uniform(0.4, 1.4), 11)


def street(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """A street between two ends (one of the differences is its width): carriageway, pavements, marks, cars, trees."""
    rng = site.rng
    along_s = (s1 - s0) > (t1 - t0)
    wide = (t1 - t0) if along_s else (s1 - s0)
    walk = min(rng.uniform(0.8, 3.0), wide * 0.25)
    site.paint_street(s0, t0, s1, t1, "pavement" if rng.random() < 0.8 else "lawn")

    def strip(a: float, b: float, start: float, end: float, use: str | int) -> None:
        if along_s:
            site.paint_street(start, t0 + a, end, t0 + b, use, 0.03)
        else:
            site.paint_street(s0 + a, start, s0 + b, end, use, 0.03)

    start, end = (s0, s1) if along_s else (t0, t1)
    strip(walk, wide - walk, start, end, site.road)
    mark = site.kit.uses["marking"][0]
    if wide > 6.5 and rng.random() < 0.6:
        for a in np.arange(start, end, 6.0):
            strip(wide / 2 - 0.09, wide / 2 + 0.09, a, a + 3, mark)
    parked, moving = site.parked, rng.uniform(0, 0.08)
    trees = rng.random() < 0.35 * min(site.leafy, 1.5)
    for a in np.arange(start + 3, end - 3, 6.0):
        for side, chance in (
            (walk + 1.0, parked),
            (wide - walk - 1.0, parked),
            (wide * 0.35, moving),
            (wide * 0.65, moving),
        ):
            if rng.random() < chance and wide > 5:
                p = site.place(a, t0 + side) if along_s else site.place(s0 + side, a, np.pi / 2)
                if site.inside(p.x, p.y, 4):
                    site.car(p.x, p.y, p.angle + pick(rng, [0, np.pi]))
    if trees:
        for a in np.arange(start + 4, end - 4, rng.uniform(7, 13)):
            for side in (walk * 0.6, wide - walk * 0.6):
                p = site.place(a, t0 + side) if along_s else site.place(s0 + side, a)
                if rng.random() < 0.8:
                    r = rng.uniform(1.3, 3.5)
                    site.tree(p.x, p.y, r, 2.4 * r + rng.uniform(0, 2))


FILL: dict[str, Callable[[Site, float, float, float, float], None]] = {
    "suburb": _suburb, "rows": _rows, "village": _village, "perimeter": _perimeter, "centre": _centre,
    "industry": _industry, "farm": _farm, "desert": _desert, "park": _park, "estate": _estate,
}  # fmt: skip
