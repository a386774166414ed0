"""Blocks of industry and farms: halls, tanks, yards, barns, fields, in street coordinates (s0, t0, s1, t1 in m) of a `Site`."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from kibs_steps.simulate import roofs
from kibs_steps.simulate.dwellings import village
from kibs_steps.simulate.outdoors import parking
from kibs_steps.simulate.pieces import CLUTTER, OBJECT, ROOF, Face, Place, pick
from kibs_steps.simulate.roofs import wing
from kibs_steps.simulate.site import Site


def industry(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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
                parking(site, a, b, c, d)
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


def farm(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
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
        what = rng.random()
        if what < 0.15:
            _greenhouses(site, x, y, x + a, y + b)
        else:
            village(site, x, y, x + a, y + b) if what < 0.55 else _barns(site, x, y, x + a, y + b)
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


def _greenhouses(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """Glass bays side by side: no sections."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["gravel", "soil", "pavement"]))
    glass, bay = site.kit.draw(rng, "greenhouse"), rng.uniform(3.0, 8.0)
    low, rise = rng.uniform(2.2, 4.5), bay * rng.uniform(0.1, 0.25)
    for t in np.arange(t0 + 2, t1 - 2 - bay, bay):
        half, deep = (s1 - s0) / 2 - 3, bay / 2
        place = site.place((s0 + s1) / 2, t + deep)
        ring = np.array(roofs.rectangle(-half, -deep, half, deep))
        if half < 2 or not site.inside(place.x, place.y, half) or not site.free(place, [ring]):
            continue
        site.occupy(place, [ring])
        place = site.grounded(place, ring)
        faces = roofs.sections([wing("gable", -half, -deep, half, deep, low, rise / deep)])
        shade = site.tint(0.06)
        site.faces += [Face(place.put(f), (), OBJECT, 0, 0, glass, shade) for f in (*faces, *roofs.walls(faces))]


def harbour(site: Site, s0: float, t0: float, s1: float, t1: float) -> None:
    """A quay and water: ships, containers, cranes, sheds, tanks."""
    rng = site.rng
    site.paint_street(s0, t0, s1, t1, pick(rng, ["pavement", "asphalt", "gravel"]))
    edge = t0 + (t1 - t0) * rng.uniform(0.3, 0.65)
    site.paint_street(s0, edge, s1, t1, "water", 0.1)
    site.paint_street(s0, edge - 1, s1, edge, "pavement", 0.2)
    s = s0 + rng.uniform(0, 20)
    while s < s1 - 10:
        half, wide = rng.uniform(6, 38), rng.uniform(2.2, 8)
        if rng.random() < 0.75 and edge + 2 * wide + 3 < t1:
            _ship(site, site.place(s + half, edge + wide + rng.uniform(0.5, 3), pick(rng, [0, np.pi])), half, wide)
        s += 2 * half + rng.uniform(3, 25)
    for _ in range(int(rng.integers(0, 4))):
        _ship(
            site,
            site.place(rng.uniform(s0, s1), rng.uniform(edge + 8, max(edge + 9, t1)), rng.uniform(0, 6)),
            rng.uniform(3, 9),
            1.8,
        )
    for a in np.arange(s0 + 3, s1 - 15, 30.0):
        if rng.random() < 0.4:
            _yard(site, a, max(t0, edge - 16), a + 26, edge - 2)
    if rng.random() < 0.4:
        mast = site.place(rng.uniform(s0, s1), edge - 4, rng.uniform(0, 6))
        for length, wide, low, high in ((2.0, 2.0, 0.0, 22.0), (18.0, 0.6, 20.0, 21.2)):
            site.box(mast, np.array(roofs.rectangle(-2.0, -wide, length, wide)), high, "car", low=low)
    if edge - t0 > 28:
        industry(site, s0, t0, s1, edge - 17)


def _ship(site: Site, place: Place, half: float, wide: float) -> None:
    """A hull with a deck, hatches and a bridge."""
    rng = site.rng
    bow = min(half * 0.35, 3 * wide)
    hull = np.array([[-half, -0.8 * wide], [half - bow, -wide], [half, 0], [half - bow, wide], [-half, 0.8 * wide]])
    side = rng.uniform(1.0, 1.5 + 0.35 * wide)
    site.box(place, hull, side, "hull")
    site.box(place, 0.93 * hull, side + 0.15, "deck", low=side)
    for _ in range(int(rng.integers(1, 4 + half // 6))):
        x, y = rng.uniform(-0.8, 0.6) * half, rng.uniform(-0.4, 0.4) * wide
        a, b = rng.uniform(0.03, 0.2) * half + 0.5, rng.uniform(0.15, 0.6) * wide
        use = pick(rng, ["box", "box", "metal", "deck", "car"])
        site.box(
            place, np.array(roofs.rectangle(x - a, y - b, x + a, y + b)), side + rng.uniform(0.4, 3), use, low=side
        )
    bridge = np.array(roofs.rectangle(-0.9 * half, -0.7 * wide, -0.9 * half + max(2.0, 0.2 * half), 0.7 * wide))
    site.box(place, bridge, side + rng.uniform(2, 9) * min(1.0, half / 20), "metal", low=side)
