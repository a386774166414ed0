"""A city being built: its faces, ground paints and materials, and what may stand there.

Streets form a grid (coordinates s, t in m) that is bent and turned as a whole, so plots stay simple
while streets curve. A raster of occupied ground keeps buildings from standing in each other.

In: a random generator, a terrain, a palette, an area in map metres. Out: lists of `Face` and `Paint`.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from kibs_steps.simulate import furniture, roofs
from kibs_steps.simulate.pieces import CAR, OBJECT, ROOF, TREE, WALL, Face, Paint, Photograph, Place, crowns, pick
from kibs_steps.simulate.roofs import Wing
from kibs_steps.simulate.surfaces import Palette
from kibs_steps.terrain import Terrain

CELL = 0.5  # m: of the raster of occupied ground


class Site:
    """A city being built: everything added goes through here, so that numbers and materials stay consistent."""

    def __init__(
        self,
        rng: np.random.Generator,
        terrain: Terrain,
        kit: Palette,
        area: tuple[float, float, float, float],
        bend: float,
    ):
        self.rng, self.terrain, self.kit, self.area = rng, terrain, kit, area
        self.faces: list[Face] = []
        self.paints: list[Paint] = []
        self.photographs: list[Photograph] = []
        self.sections = 0
        self.buildings = 0
        self.level = bool(np.ptp(terrain.heights) == 0)
        self.ground = float(terrain.heights.flat[0])
        self.turn = rng.uniform(0, 2 * np.pi)
        self.middle = ((area[0] + area[2]) / 2, (area[1] + area[3]) / 2)
        self.bend = tuple((bend * rng.uniform(4, 14, 2)).tolist())
        self.wave = tuple((2 * np.pi / rng.uniform(120, 400, 2)).tolist())
        self.phase = tuple(rng.uniform(0, 2 * np.pi, 2).tolist())
        cells = (int((area[3] - area[1]) / CELL) + 120, int((area[2] - area[0]) / CELL) + 120)
        self.taken = np.zeros(cells, np.uint8)
        # The manners of a place.
        self.furnished = rng.beta(1, 1.5)  # how much stands on roofs
        self.solar = pick(rng, [0.0, rng.uniform(0, 0.25)])
        self.leafy = pick(rng, [0.2, 0.7, 1.3, 2.2, 3.5])  # trees per 100 m² of garden
        self.hedges = rng.random()
        self.bare = pick(rng, [0.0, 0.0, 0.0, 0.0, 0.05, 0.6])  # share of trees without leaves
        self.parked = 0.75 * rng.beta(0.8, 1.4)
        self.road = kit.draw(rng, "asphalt" if rng.random() < 0.9 else "pavement")

    def at(self, s: float, t: float) -> tuple[float, float]:
        """Map metres of street coordinates."""
        a = s + self.bend[0] * math.sin(t * self.wave[0] + self.phase[0])
        b = t + self.bend[1] * math.sin(s * self.wave[1] + self.phase[1])
        c, r = math.cos(self.turn), math.sin(self.turn)
        return self.middle[0] + c * a - r * b, self.middle[1] + r * a + c * b

    def place(self, s: float, t: float, angle: float = 0.0) -> Place:
        """The frame of something at (s, t), turned by `angle` (rad) against the street."""
        x, y = self.at(s, t)
        ahead = self.at(s + 1.0, t)
        return Place(x, y, math.atan2(ahead[1] - y, ahead[0] - x) + angle)

    def inside(self, x: float, y: float, margin: float = 0.0) -> bool:
        """Whether a map position is in the area grown by `margin`."""
        a = self.area
        return a[0] - margin < x < a[2] + margin and a[1] - margin < y < a[3] + margin

    def grounded(self, place: Place, ring: np.ndarray) -> Place:
        """The place with its base at the lowest terrain under a footprint (n, ≥ 2, own frame)."""
        return place._replace(base=self.ground_under(place, ring)[0])

    def ground_under(self, place: Place, ring: np.ndarray) -> tuple[float, float]:
        """Lowest and highest terrain under a footprint."""
        if self.level:
            return self.ground, self.ground
        x_y = place.put(np.asarray(ring, float)[:, :2])
        x_y = np.concatenate([x_y, (x_y + np.roll(x_y, -1, axis=0)) / 2, x_y.mean(0, keepdims=True)])
        z = self.terrain(x_y)
        return float(z.min()), float(z.max())

    def tint(self, amount: float = 0.05) -> tuple[float, float, float]:
        """A random brightness with a little colour."""
        bright, r, g, b = self.rng.standard_normal(4).tolist()
        return tuple(math.exp(amount * (bright + 0.3 * c)) for c in (r, g, b))

    def paint(self, ring: np.ndarray, use: str | int, tint: float = 0.08, angle: float | None = None) -> None:
        """Paint a polygon (n, 2 map metres)."""
        material = self.kit.draw(self.rng, use) if isinstance(use, str) else use
        self.paints.append(Paint(ring, material, self.tint(tint), self.turn if angle is None else angle))

    def paint_street(self, s0: float, t0: float, s1: float, t1: float, use: str | int, tint: float = 0.08) -> None:
        """Paint a rectangle in street coordinates, bent with the streets."""
        half = math.hypot(s1 - s0, t1 - t0) / 2
        if not self.inside(*self.at((s0 + s1) / 2, (t0 + t1) / 2), half):
            return
        n = int(2 * half / 12) + 1 if any(self.bend) else 1
        shares = [i / n for i in range(n)]
        ring = [(s0 + (s1 - s0) * i, t0) for i in shares] + [(s1, t0 + (t1 - t0) * i) for i in shares]
        ring += [(s1 + (s0 - s1) * i, t1) for i in shares] + [(s0, t1 + (t0 - t1) * i) for i in shares]
        self.paint(np.array([self.at(s, t) for s, t in ring]), use, tint)

    def cells(self, place: Place, ring: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray] | None:
        """The part of the raster under a ring, and the ring's mask in it; None outside."""
        x_y = (place.put(ring) - [self.area[0], self.area[1]]) / CELL + 60
        col, row = np.maximum(x_y.min(0).astype(int), 0).tolist()
        right, bottom = (x_y.max(0).astype(int) + 2).tolist()
        window = (slice(row, bottom), slice(col, right))
        shape = self.taken[window].shape
        if not all(shape):
            return None
        points = np.round((x_y - [col, row] - 0.5) * 16).astype(np.int32)
        return window, cv2.fillPoly(np.zeros(shape, np.uint8), [points], 1, shift=4)

    def free(self, place: Place, rings: list[np.ndarray]) -> bool:
        """Whether no building stands within rings (n, 2, own frame), a hand's breadth of touching apart."""
        for ring in rings:
            middle = ring.mean(0)
            size = np.ptp(ring, axis=0)
            found = self.cells(place, middle + (ring - middle) * np.maximum(1 - 1.4 / size, 0.2))
            if found and (self.taken[found[0]] & found[1]).any():
                return False
        return True

    def occupy(self, place: Place, rings: list[np.ndarray]) -> None:
        """Mark the ground under rings (n, 2, own frame) as built on."""
        for ring in rings:
            found = self.cells(place, ring)
            if found:
                self.taken[found[0]] |= found[1]

    def built(self, x: float, y: float) -> bool:
        """Whether a building stands at a map position."""
        row, col = int((y - self.area[1]) / CELL) + 60, int((x - self.area[0]) / CELL) + 60
        return 0 <= row < self.taken.shape[0] and 0 <= col < self.taken.shape[1] and bool(self.taken[row, col])

    # Buildings.

    def building(
        self,
        place: Place,
        wings: list[Wing],
        roof: int | None = None,
        wall: int | None = None,
        overhang: float = 0.0,
        parapet: float = 0.0,
        use: str = "",
        number: int | None = None,
        furnish: bool = True,
        tints: float = 0.05,
    ) -> int:
        """A building with its roof sections, walls and what stands on the roof. Returns its number; 0, and nothing is built,
        outside the area or where another building stands."""
        rng = self.rng
        footprints = [np.array(w.footprint) for w in wings]
        reach = max(float(np.abs(f).max()) for f in footprints)
        if not self.inside(place.x, place.y, reach) or not self.free(place, footprints):
            return 0
        self.occupy(place, footprints)
        rings = roofs.sections(wings)
        low, high = self.ground_under(place, np.concatenate(rings))
        place = place._replace(base=low)
        # On a slope the eaves stay clear of the ground uphill.
        clear = high - low + 1.8 - min(float(ring[:, 2].min()) for ring in rings)
        if not self.level and clear > 0:
            rings = [ring + np.array([0.0, 0.0, clear]) for ring in rings]
        if number is None:
            self.buildings += 1
            number = self.buildings
        flat = len(rings) == 1 and np.ptp(rings[0][:, 2]) < 1e-6
        if roof is None:
            roof = self.kit.draw(rng, use + ("flat" if flat and rng.random() < 0.9 else "pitched"))
        wall = self.kit.draw(rng, use + "wall") if wall is None else wall
        common = self.tint(tints)
        paint = self.tint(0.08)
        for ring in rings:
            self.sections += 1
            own = self.tint(0.03)
            tint = (common[0] * own[0], common[1] * own[1], common[2] * own[2])
            hole = (
                furniture.penthouse(self, place, ring, roof, wall, number, self.sections) if parapet and furnish else ()
            )
            self.faces.append(
                Face(place.put(ring), hole, ROOF, self.sections if not hole else self.sections - 1, number, roof, tint)
            )
            if parapet:
                furniture.parapet(self, place, ring, parapet, number, wall, paint)
            if furnish:
                furniture.furnish(self, place, ring, number, roof, tint, wall, paint)
        for quad in roofs.walls(rings, overhang):
            self.faces.append(Face(place.put(quad), (), WALL, 0, number, wall, paint))
        return number

    # What stands on the ground.

    def box(
        self,
        place: Place,
        ring: np.ndarray,
        height: float,
        use: str,
        kind: int = OBJECT,
        low: float = 0.0,
        tint: float = 0.1,
    ) -> None:
        """An upright prism on the ground that is no building; none where a building stands."""
        if self.built(place.x, place.y):
            return
        material = self.kit.draw(self.rng, use)
        place = self.grounded(place, ring)
        top, sides = roofs.prism(np.asarray(ring, float), low, height)
        shade = self.tint(tint)
        self.faces += [Face(place.put(r), (), kind, 0, 0, material, shade) for r in (top, *sides)]

    def tank(self, place: Place, radius: float, height: float) -> None:
        """A round tank or silo, domed, conical, flat or with a sunken floating roof: looks like a roof, is none."""
        rng = self.rng
        if self.built(place.x, place.y):
            return
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        place = self.grounded(place, ring)
        material, shade = self.kit.draw(rng, "tank"), self.tint(0.1)
        top, sides = roofs.prism(ring, 0.0, height)
        kind = rng.random()
        if kind < 0.25:
            lids = roofs.dome(top, radius * rng.uniform(0.2, 0.8))
        elif kind < 0.45:
            lids = roofs.dome(top, radius * rng.uniform(0.08, 0.3), rings=1)
        elif kind < 0.75:
            lids = [top - np.array([0.0, 0.0, min(0.6 * height, rng.uniform(0.5, 3.0))])]
        else:
            lids = [top]
        self.faces += [Face(place.put(r), (), OBJECT, 0, 0, material, shade) for r in (*lids, *sides)]
        if kind >= 0.45 and radius > 4:  # a smaller ring on top, as floating roofs and vents have
            inner = lids[0] * [0.35, 0.35, 1.0] + np.array([0.0, 0.0, 0.15])
            self.faces.append(Face(place.put(inner), (), OBJECT, 0, 0, self.kit.draw(rng, "metal"), shade))

    def car(self, x: float, y: float, angle: float) -> None:
        """A car or van: body, cabin."""
        rng = self.rng
        if not self.inside(x, y, 4.0) or self.built(x, y):
            return
        material, glass = self.kit.draw(rng, "car"), self.kit.uses["glass"][0]
        place = Place(x, y, angle)
        van = rng.random() < 0.12
        half, wide = (2.7, 1.0) if van else (rng.uniform(1.9, 2.4), rng.uniform(0.82, 0.95))
        place = self.grounded(place, np.array([[0.0, 0.0]]))
        body = np.array(roofs.rectangle(-half, -wide, half, wide), float)
        top, sides = roofs.prism(body, 0.0, 2.1 if van else 0.85)
        shade = self.tint(0.12)
        self.faces += [Face(place.put(r), (), CAR, 0, 0, material, shade) for r in (top, *sides)]
        if not van:
            cabin = np.array(roofs.rectangle(-0.62 * half, -0.86 * wide, 0.35 * half, 0.86 * wide), float)
            self.faces.append(Face(place.put(np.column_stack([cabin, np.full(4, 0.95)])), (), CAR, 0, 0, glass))
            cap = np.array(roofs.rectangle(-0.42 * half, -0.78 * wide, 0.12 * half, 0.78 * wide), float)
            self.faces.append(Face(place.put(np.column_stack([cap, np.full(4, 1.4)])), (), CAR, 0, 0, material, shade))

    def tree(self, x: float, y: float, radius: float, height: float, use: str = "tree", conifer: bool = False) -> None:
        """A crown of tilted leafy discs, clumpy and self-shadowing."""
        rng = self.rng
        if not self.inside(x, y, 10.0) or self.built(x, y):
            return
        z0 = self.ground if self.level else float(self.terrain(np.array([[x, y]]))[0])
        material = self.kit.draw(rng, use)
        discs = pick(rng, crowns(0 if conifer else min(4 + int(2 * radius), 13)))
        # A conifer's crown reaches nearly down to the ground, others' are round.
        deep = 0.8 * height if conifer else min(0.45 * height, radius)
        turn = rng.uniform(0, 2 * np.pi)
        c, r = radius * math.cos(turn), radius * math.sin(turn)
        discs = discs @ np.array([[c, r, 0], [-r, c, 0], [0, 0, deep]]) + [x, y, z0 + height - deep]
        bright = np.exp(rng.normal(0, 0.16, len(discs))) * np.exp(rng.normal(0, 0.12))
        self.faces += [
            Face(d, (), TREE, 0, 0, material, (b, b, b)) for d, b in zip(discs, bright.tolist(), strict=True)
        ]

    def trees(self, s0: float, t0: float, s1: float, t1: float, density: float, tall: float = 9.0) -> None:
        """Trees in a street rectangle: `density` per 100 m²; now and then clumped."""
        rng = self.rng
        n = rng.poisson(max(0.0, (s1 - s0) * (t1 - t0)) * density / 100)
        at = np.column_stack([rng.uniform(s0, s1, n), rng.uniform(t0, t1, n)])
        for (s, t), h in zip(at.tolist(), (tall * np.exp(rng.normal(0, 0.4, n))).tolist(), strict=True):
            x, y = self.at(s, t)
            conifer = rng.random() < 0.15
            r = h * rng.uniform(0.13, 0.22) if conifer else h * rng.uniform(0.28, 0.5)
            self.tree(x, y, min(r, 7.0), h, conifer=conifer, use="bare" if rng.random() < self.bare else "tree")
