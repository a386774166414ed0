"""What lies between buildings: parks, water, sport, rails, car parks, streets, painted decoys.

All in street coordinates (s0, t0, s1, t1 in m) of a `Site`.
"""

from __future__ import annotations

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.pieces import Paint, Place, pick
from kibs_steps.simulate.site import Site


def parking(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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


def park(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """No buildings: park, water, sport, wood, rails."""
    rng = site.rng
    what = pick(
        rng,
        [
            "park",
            "park",
            "wood",
            "water",
            "sport",
            "pitch",
            "rails",
            "square",
            "roundabout",
            "orchard",
            "lawn",
            "parking",
        ],
    )
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
    elif what == "pitch":
        _pitch(site, s0, t0, s1, t1)
    elif what == "roundabout":
        _roundabout(site, s0, t0, s1, t1)
    elif what == "orchard":
        gap, tall = rng.uniform(3.5, 8.0), rng.uniform(2.5, 7.0)
        for s in np.arange(s0 + 2, s1 - 2, gap):
            for t in np.arange(t0 + 2, t1 - 2, gap * rng.uniform(0.6, 1.1)):
                x, y = site.at(s, t)
                site.tree(x, y, tall * 0.35, tall * rng.uniform(0.8, 1.2))
    elif what == "lawn":
        site.paint_street(s0, t0, s1, t1, pick(rng, ["lawn", "rough", "field", "soil"]), 0.2)
    elif what == "parking":
        parking(site, s0, t0, s1, t1)
        for _ in range(int(rng.integers(1, 6))):  # planted islands
            a, b = rng.uniform(s0, s1), rng.uniform(t0, t1)
            site.paint_street(a, b, a + rng.uniform(3, 15), b + rng.uniform(1.5, 3), pick(rng, ["lawn", "pavement"]))
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
    site.trees(
        s0,
        t0,
        s1,
        t1,
        {"wood": 3.0, "park": 1.2, "pitch": 0.05, "lawn": 0.08, "orchard": 0.0}.get(what, 0.25) * rng.uniform(0.4, 1.4),
        11,
    )


def _pitch(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """A sports ground: mown stripes, white lines, perhaps a bright or red surface around."""
    rng = site.rng
    place = site.place((s0 + s1) / 2, (t0 + t1) / 2, pick(rng, [0.0, np.pi / 2]))
    long, wide = rng.uniform(18, 50), rng.uniform(14, 32)
    if rng.random() < 0.4:
        site.paint(
            place.put(np.array(roofs.rectangle(-long - 5, -wide - 5, long + 5, wide + 5))),
            pick(rng, ["track", "gravel"]),
        )
    turf, stripes = pick(rng, ["lawn", "lawn", "court"]), int(rng.integers(4, 14))
    material, mark = site.kit.draw(rng, turf), site.kit.uses["marking"][0]
    edges = np.linspace(-long, long, stripes + 1)
    deep = rng.uniform(0.0, 0.12)
    for i in range(stripes):
        site.paint(place.put(np.array(roofs.rectangle(edges[i], -wide, edges[i + 1], wide))), material, 0.02)
        bright = 1 + (deep if i % 2 else -deep)
        site.paints[-1] = site.paints[-1]._replace(tint=(bright, bright, bright))
    thin = 0.12
    for a, b, c, d in (
        (-long, -wide, long, -wide + thin), (-long, wide - thin, long, wide), (-thin, -wide, thin, wide),
        (-long, -wide, -long + thin, wide), (long - thin, -wide, long, wide),
    ):  # fmt: skip
        site.paint(place.put(np.array(roofs.rectangle(a, b, c, d))), mark, 0.05)


def _roundabout(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """A roundabout with its arms, cycle path and islands, on lawn."""
    rng = site.rng
    cs, ct = (s0 + s1) / 2, (t0 + t1) / 2
    place = site.place(cs, ct)
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    oval = np.column_stack([np.cos(angle), np.sin(angle)])
    outer, width = rng.uniform(10, 18), rng.uniform(5.5, 8)
    path = pick(rng, ["track", "pavement", "asphalt"])
    arm = width / 2 + rng.uniform(0, 2)
    site.paint(place.put((outer + rng.uniform(3, 6)) * oval), path, 0.1)
    site.paint(place.put((outer + rng.uniform(0.5, 2)) * oval), pick(rng, ["lawn", "pavement"]), 0.1)
    for wide, use in ((arm + 3, path), (arm, site.road)):
        site.paint_street(s0 - 8, ct - wide, s1 + 8, ct + wide, use, 0.05)
        site.paint_street(cs - wide, t0 - 8, cs + wide, t1 + 8, use, 0.05)
    site.paint(place.put(outer * oval), site.road, 0.05)
    site.paint(place.put((outer - width) * oval), "pavement", 0.1)
    site.paint(place.put((outer - width - rng.uniform(0.5, 2)) * oval), pick(rng, ["lawn", "rough", "gravel"]), 0.1)
    for turn in range(4):
        island = site.place(cs, ct, turn * np.pi / 2)
        site.paint(island.put(np.array([[outer, -0.3], [outer + 9, -0.2], [outer + 9, 0.2], [outer, 1.6]])), "pavement")
    _islands(site, outer, place, np.arcsin(min((arm + 1) / outer, 0.7)))
    for _ in range(int(rng.integers(0, 8))):
        a = rng.uniform(0, 2 * np.pi)
        r = outer - width / 2
        spot = site.place(cs + r * np.cos(a), ct + r * np.sin(a), a + np.pi / 2)
        site.car(spot.x, spot.y, spot.angle)


def _islands(site: Site, outer: float, place: Place, half: float) -> None:
    """Paved or planted islands about a roundabout of radius `outer` (m): what parts the lanes of its arms, and crescents between
    arms, which are `half` (rad) wide to either side. They have straight and round kerbs, as roofs have, and no height."""
    rng = site.rng.spawn(1)[0]  # its own: the city beside is the same with and without them
    material = site.kit.draw(rng, pick(rng, ["pavement", "pavement", "track", "gravel", "lawn"]))
    beside, deep = rng.uniform(0.3, 1.5), rng.uniform(1.0, 4.0)
    for turn in range(4):
        at = place._replace(angle=place.angle + turn * np.pi / 2)
        bright = np.exp(rng.normal(0, 0.2))
        wide, long, tip = rng.uniform(0.3, 3.0), rng.uniform(5, 22), rng.uniform(0.1, 0.8)
        near, far = outer + rng.uniform(0, 2), outer + long
        pieces = [(0.0, 1.0)]
        if rng.random() < 0.5:  # where people cross
            middle, path = rng.uniform(0.35, 0.65), min(rng.uniform(0.6, 1.5) / (far - near), 0.2)
            pieces = [(0.0, middle - path), (middle + path, 1.0)]
        rings = []
        for ends in pieces:
            x, y = near + np.array(ends) * (far - near), wide * (1 - (1 - tip) * np.array(ends))
            rings.append(np.array([[x[0], -y[0]], [x[1], -y[1]], [x[1], y[1]], [x[0], y[0]]]))
        if rng.random() < 0.6:
            along = np.linspace(half + rng.uniform(0, 0.2), np.pi / 2 - half - rng.uniform(0, 0.2), 9)
            rim = outer + beside + deep * np.sin(np.linspace(0, np.pi, 9)) ** 0.5
            towards = np.column_stack([np.cos(along), np.sin(along)])
            rings.append(np.concatenate([(outer + beside) * towards, (rim[:, None] * towards)[-2:0:-1]]))
        site.paints += [Paint(at.put(ring), material, (bright, bright, bright), at.angle) for ring in rings]


def street(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """A street between two ends (one of the differences is its width): carriageway, pavements, marks, cars, trees."""
    rng = site.rng
    along_s = (s1 - s0) > (t1 - t0)
    wide = (t1 - t0) if along_s else (s1 - s0)
    # Only the part that is on the site.
    start, end = (s0, s1) if along_s else (t0, t1)
    marks = np.arange(start, end + 12, 12.0)
    middle = (t0 + t1) / 2 if along_s else (s0 + s1) / 2
    there = [
        a for a in marks.tolist() if site.inside(*(site.at(a, middle) if along_s else site.at(middle, a)), 20 + wide)
    ]
    if not there:
        return
    start, end = max(start, there[0] - 12), min(end, there[-1] + 12)
    s0, t0, s1, t1 = (start, t0, end, t1) if along_s else (s0, start, s1, end)
    walk = min(rng.uniform(0.8, 3.0), wide * 0.25)
    site.paint_street(s0, t0, s1, t1, "pavement" if rng.random() < 0.8 else "lawn")

    def strip(a: float, b: float, start: float, end: float, use: str | int) -> None:
        if along_s:
            site.paint_street(start, t0 + a, end, t0 + b, use, 0.03)
        else:
            site.paint_street(s0 + a, start, s0 + b, end, use, 0.03)

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
