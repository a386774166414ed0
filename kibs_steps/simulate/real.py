"""Scenes of real cities: the buildings of a `CityModel` where they stand, on ground painted between them.

The files hold roofs and walls only. What lies between is drawn at random but follows the buildings: each has a plot around it,
beyond the plots lie pavements, beyond them streets, and open places where nothing is near; or the grid of streets of the
procedural cities runs under them, turned as most walls are. Trees, cars, hedges and what stands on roofs come from `Site`.

In: a random generator, a city model, an area in map metres, a terrain. Out: a `City`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from kibs_steps.simulate import furniture, ground, roofs
from kibs_steps.simulate.city import lay_out
from kibs_steps.simulate.citymodel import Building, CityModel, Polygon
from kibs_steps.simulate.pieces import ROOF, WALL, City, Face, Place, pick
from kibs_steps.simulate.site import Site
from kibs_steps.simulate.surfaces import palette
from kibs_steps.terrain import Terrain

LEAST = 0.8  # m²: smaller roof surfaces are shown but are no sections
STOREY = 1.8  # m: eaves stay this far above the ground uphill
FOOT = 0.05  # m: what is lower than that above a building's base is its foot
SPARSE = 0.1  # share of ground built on below which procedural houses stand between
SPACING = 60.0  # m: neighbours within such squares tend to have the same roofs
GROWN = 0.5  # of a real city's tiles: their houses have more storeys than the file says, as a city's centre has
STOREYS = 5  # at most, added to all houses alike, one more or less to each
STOREY_HEIGHT = 3.1  # m
LOWEST_HOUSE = 5.0  # m: what is lower is a shed or a garage


class Window(NamedTuple):
    """How a city is laid out: its point `centre` comes to `onto` (m), turned by `turn` (rad); `keep`: at its own heights."""

    centre: tuple[float, float]
    onto: tuple[float, float]
    turn: float
    keep: bool = False

    def __call__(self, x_y: np.ndarray) -> np.ndarray:
        """Positions (n, 2) of the model in map metres."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        return (x_y - self.centre) @ np.array([[c, s], [-s, c]]) + self.onto


def city(
    rng: np.random.Generator,
    model: CityModel,
    area: tuple[float, float, float, float],
    terrain: Terrain,
    share_grown: float = GROWN,
) -> City:
    """A part of a real city, cut out around one of its buildings and turned at random, over `area` (left, bottom, right, top).

    Its buildings stand on `terrain`, each as high as it is, or (`share_grown` of such parts) all of them higher by some storeys.
    """
    centres = np.array([b.centre for b in model.buildings])
    hosts = centres[rng.integers(len(centres), size=3)]
    # Files end in scattered houses: of three places the densest.
    crowd = [(np.abs(centres - host) < (area[2] - area[0]) / 2).all(1).sum() for host in hosts]
    centre = hosts[int(np.argmax(crowd))] + rng.normal(0, 12, 2)
    middle = ((area[0] + area[2]) / 2, (area[1] + area[3]) / 2)
    window = Window(tuple(centre.tolist()), middle, rng.uniform(0, 2 * np.pi))
    storeys = int(rng.integers(1, STOREYS + 1)) if rng.random() < share_grown else 0
    return _laid(rng, model, area, terrain, window, storeys)


def grown(building: Building, storeys: int) -> Building:
    """A house with more storeys under the same roofs; sheds and garages stay as they are."""
    if max(float(face.ring[:, 2].max()) for face in building.roofs) - building.base < LOWEST_HOUSE:
        return building

    def lifted(face: Polygon) -> Polygon:
        def up(ring: np.ndarray) -> np.ndarray:
            rise = np.where(ring[:, 2] > building.base + FOOT, storeys * STOREY_HEIGHT, 0.0)
            return ring + rise[:, None] * [0.0, 0.0, 1.0]

        return face._replace(ring=up(face.ring), holes=tuple(up(hole) for hole in face.holes))

    return building._replace(roofs=[lifted(f) for f in building.roofs], walls=[lifted(f) for f in building.walls])


def as_surveyed(
    rng: np.random.Generator, model: CityModel, area: tuple[float, float, float, float], terrain: Terrain
) -> City:
    """The part of a real city within `area`, every corner where the file has it."""
    return _laid(rng, model, area, terrain, Window((0.0, 0.0), (0.0, 0.0), 0.0, True))


def surveyed_terrain(model: CityModel, bounds: tuple[float, float, float, float], step: float) -> Terrain:
    """The city's ground over `bounds` (left, bottom, right, top): its terrain points, or else the feet of its buildings,
    smoothed over some 40 m; heights in float32."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    x = np.arange(bounds[0] + step / 2, bounds[2] + step / 2, step)
    y = np.arange(bounds[3] - step / 2, bounds[1] - step / 2, -step)
    points = model.terrain
    if points is None:
        points = np.array([[*b.centre, b.base] for b in model.buildings])
    where = np.stack(np.meshgrid(x, y), -1)
    z = NearestNDInterpolator(points[:, :2], points[:, 2])(where)
    if model.terrain is not None:
        inner = LinearNDInterpolator(points[:, :2], points[:, 2])(where)
        z = np.where(np.isnan(inner), z, inner)
    else:
        z = cv2.GaussianBlur(z, (0, 0), 40.0 / step, borderType=cv2.BORDER_REPLICATE)
    return Terrain(z.astype(np.float32).astype(np.float64), float(x[0]), float(y[0]), (step, step))


def _laid(
    rng: np.random.Generator,
    model: CityModel,
    area: tuple[float, float, float, float],
    terrain: Terrain,
    window: Window,
    storeys: int = 0,
) -> City:
    kit = palette(rng)
    site = Site(rng, terrain, kit, area, 0.0)
    at = window(np.array([b.centre for b in model.buildings]))
    reach = np.array([b.reach for b in model.buildings])
    near = ((at + reach[:, None] > area[:2]) & (at - reach[:, None] < area[2:])).all(1)
    chosen = [(model.buildings[i], tuple(at[i].tolist())) for i in np.flatnonzero(near)]
    site.turn = _grain([b for b, _ in chosen]) + window.turn
    alike = rng.beta(1, 1)
    shared: dict[tuple[int, ...], tuple[int, int, int]] = {}
    plots = np.zeros(site.taken.shape, np.int32)
    for building, position in chosen:
        materials = (kit.draw(rng, "pitched"), kit.draw(rng, "flat"), kit.draw(rng, "wall"))
        square = tuple(int(c // SPACING) for c in building.centre)
        if rng.random() < alike:
            materials = shared.setdefault(square, materials)
        if storeys:
            building = grown(building, storeys + int(rng.integers(-1, 2)))
        _stand(site, building, Place(*position, window.turn), window.keep, materials, plots)
    if not window.keep and (plots > 0).mean() < SPARSE:
        ground.between(site, plots, lambda: lay_out(site, pick(rng, ("suburb", "rows", "village", "town"))))
    else:
        ground.between(site, plots)
    return City(site.faces, site.paints, kit.materials)


def _grain(buildings: list[Building]) -> float:
    """The direction (rad) that most walls follow, modulo a right angle."""
    total = 0j
    for building in buildings:
        for wall in building.walls:
            d = wall.ring[1] - wall.ring[0] if len(wall.ring) else np.zeros(3)
            total += np.hypot(d[0], d[1]) * np.exp(4j * np.arctan2(d[1], d[0]))
    return float(np.angle(total)) / 4


def _stand(
    site: Site,
    building: Building,
    place: Place,
    keep: bool,
    materials: tuple[int, int, int],
    plots: np.ndarray,
) -> None:
    """Put a building on the site: faces, furniture on its convex sections, its number on the raster of plots."""
    origin = np.array([*building.centre, building.base])
    outlines = [face.ring[:, :2] - origin[:2] for face in building.roofs]
    low, high = site.ground_under(place, np.concatenate(outlines))
    lowest = min(float(face.ring[:, 2].min()) for face in building.roofs) - building.base
    clear = 0.0 if keep or site.level else max(0.0, high - low + STOREY - max(lowest, STOREY))
    place = place._replace(base=building.base if keep else low + clear)
    # The walls' feet reach the ground, wherever the roof is lifted to.
    foot = min(0.0, low - place.base)
    site.buildings += 1
    number = site.buildings
    pitched, even, wall = materials
    common, paint = site.tint(0.05), site.tint(0.08)
    for face, outline in zip(building.roofs, outlines, strict=True):
        ring, holes = face.ring - origin, tuple(h - origin for h in face.holes)
        axes = roofs.frame_of(ring)
        own = site.tint(0.03)
        tint = (common[0] * own[0], common[1] * own[1], common[2] * own[2])
        material = even if axes.rise < 0.1 else pitched
        section = 0
        if roofs.area(outline.tolist()) - sum(abs(roofs.area(h[:, :2].tolist())) for h in holes) >= LEAST:
            site.sections += 1
            section = site.sections
        site.faces.append(
            Face(place.put(ring), tuple(place.put(h) for h in holes), ROOF, section, number, material, tint)
        )
        if section and not holes and _convex(axes.ring):
            furniture.furnish(site, place, ring, number, material, tint, wall, paint)
        found = site.cells(place, outline)
        if found:
            site.taken[found[0]] |= found[1]
            plots[found[0]][found[1] > 0] = number
    for face in building.walls:
        ring, *holes = (r - origin for r in (face.ring, *face.holes))
        ring[ring[:, 2] < FOOT, 2] += foot
        site.faces.append(Face(place.put(ring), tuple(place.put(h) for h in holes), WALL, 0, number, wall, paint))


def _convex(ring: np.ndarray) -> bool:
    edge = np.roll(ring, -1, axis=0) - ring
    after = np.roll(edge, -1, axis=0)
    return bool((edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] > -1e-6).all())
