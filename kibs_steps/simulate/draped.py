"""Real roofs: photographed houses with hand-made roof graphs, lifted to 3D and draped with their photographs.

The roof-graph data set (Ren et al. 2021) gives each vertex a nominal height at which all faces are planar. Heights may be scaled
above the eave without bending a face, so eave and pitch are free: each house gets its own. The photograph is taken from above,
so it is draped by plan position alone. Its own shading is moderated by bringing the faces' mean brightness together.

In: roof graphs (`photographs.read_roof_graphs`) and the data set's `res_building/*.polyshape`. Out: `House`s; on a `Site`,
faces.
"""

from __future__ import annotations

import math
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kibs_steps.photographs import GRAPH_GSD, REDUCED, NoTrainingData, RoofGraph
from kibs_steps.simulate import roofs
from kibs_steps.simulate.pieces import ROOF, WALL, Face, Photograph, Place, pick
from kibs_steps.simulate.site import Site

EAVE = 75.0  # the data set's nominal height of eaves, in px of the original photograph like x and y
PLANAR = 0.01  # m: a house with corners farther off their face's plane is left out
LEAST = 0.05  # m² in plan: smaller faces are none
EVEN = 0.6  # how far the faces' brightness is brought together: 0 not at all, 1 wholly


class House(NamedTuple):
    """A photographed house: rings (n, 3) of its faces, m, x and y from its middle, z above its lowest eave; the photograph
    uint8 (h, w, 3), px per m, the middle in px (col, row); gain of each face's brightness; mean slope (m/m)."""

    name: str
    rings: list[np.ndarray]
    rgb: np.ndarray
    scale: float
    middle: np.ndarray
    gains: list[float]
    slope: float

    @property
    def size(self) -> np.ndarray:
        """Extent in x and y, m."""
        points = np.concatenate(self.rings)[:, :2]
        return points.max(0) - points.min(0)


def read_heights(source: str | Path) -> dict[str, np.ndarray]:
    """Nominal heights (n,) by house, of its roof graph's vertices in their order, from the data set's tar or folder.

    Raises `NoTrainingData` if none is there.
    """
    source = Path(source)
    if source.is_dir():
        files = {p.stem: p.read_bytes() for p in sorted((source / "res_building").glob("*.polyshape"))}
    elif source.is_file():
        with tarfile.open(source) as tar:
            members = [m for m in tar if m.isfile() and m.name.endswith(".polyshape")]
            files = {Path(m.name).stem: tar.extractfile(m).read() for m in members}
    else:
        files = {}
    if not files:
        raise NoTrainingData(f"{source} holds no res_building/*.polyshape: give the roof-graph tar or folder")
    heights = {}
    for name, content in files.items():
        # Vertices are rows of three, faces of at least four: three vertices and a kind.
        rows = [line.split(",") for line in content.decode().split("\n") if line and not line.startswith("#")]
        heights[name] = np.array([float(row[2]) for row in rows if len(row) == 3])
    return heights


def houses(graphs: Sequence[RoofGraph], heights: dict[str, np.ndarray]) -> list[House]:
    """All roof graphs that have heights and planar faces, as houses."""
    lifted = (lift(graph, heights[graph.name]) for graph in graphs if graph.name in heights)
    return [house for house in lifted if house]


def lift(graph: RoofGraph, nominal: np.ndarray) -> House | None:
    """A roof graph at its nominal heights (≥ n,); None where that gives no roof of planar, upward faces."""
    count = len(graph.vertices)
    if len(nominal) < count or not graph.faces:
        return None
    metres = GRAPH_GSD * REDUCED
    middle = (graph.vertices.min(0) + graph.vertices.max(0)) / 2
    points = np.column_stack([(graph.vertices - middle) * [metres, -metres], (nominal[:count] - EAVE) * GRAPH_GSD])
    points[:, 2] -= points[np.unique(np.concatenate(graph.faces)), 2].min()
    linear = (graph.rgb.astype(np.float32) / 255) ** 2.0
    brightness = linear.mean(2)
    rings, seen, slopes, areas = [], [], [], []
    for face in graph.faces:
        ring = points[face]
        area = roofs.area(ring[:, :2].tolist())
        if abs(area) < LEAST:  # upright gable ends: walls will stand there
            continue
        ring = ring if area > 0 else ring[::-1]
        design = np.column_stack([ring[:, :2] - ring[:, :2].mean(0), np.ones(len(ring))])
        plane = np.linalg.lstsq(design, ring[:, 2], rcond=None)[0]
        if np.abs(design @ plane - ring[:, 2]).max() > PLANAR:
            return None
        mask = cv2.fillPoly(
            np.zeros(brightness.shape, np.uint8),
            [np.round((graph.vertices[face] - 0.5) * 16).astype(np.int32)],
            1,
            shift=4,
        )
        rings.append(ring)
        seen.append(float(brightness[mask > 0].mean()) if mask.any() else 0.0)
        slopes.append(float(np.hypot(*plane[:2])))
        areas.append(abs(area))
    if not rings:
        return None
    whole = np.average(seen, weights=areas)
    slope = float(np.average(slopes, weights=areas))
    if whole <= 0 or slope < 0.02:
        return None
    gains = [float(np.clip((whole / max(s, 1e-3)) ** EVEN, 0.5, 2.0)) for s in seen]
    return House(graph.name, rings, graph.rgb, 1 / metres, middle, gains, slope)


def stand(site: Site, place: Place, house: House) -> int:
    """Build a house at a place, at an eave height and pitch of its own. Returns its number, 0 where it cannot stand."""
    rng = site.rng
    pitch = math.tan(math.radians(rng.uniform(14, 40)))
    eave = rng.uniform(2.3, 3.2) if rng.random() < 0.7 else rng.uniform(4.5, 6.5)
    size = rng.uniform(0.9, 1.12)
    mirrored = rng.random() < 0.5
    flip = np.array([-1.0 if mirrored else 1.0, 1.0])
    rings = [
        np.column_stack([r[:, :2] * size * flip, eave + r[:, 2] * size * pitch / house.slope])[:: -1 if mirrored else 1]
        for r in house.rings
    ]
    outlines = [r[:, :2] for r in rings]
    if not site.inside(place.x, place.y, float(house.size.max()) / 2) or not site.free(place, outlines):
        return 0
    site.occupy(place, outlines)
    low, high = site.ground_under(place, np.concatenate(outlines))
    clear = high - low + 1.8 - eave
    if not site.level and clear > 0:
        rings = [r + np.array([0.0, 0.0, clear]) for r in rings]
    place = place._replace(base=low)
    # Map position -> own frame -> px of the photograph: both linear.
    c, s = math.cos(place.angle), math.sin(place.angle)
    own = np.array([[c, s], [-s, c]])
    onto = np.diag([house.scale, -house.scale] * flip / size) @ own
    offset = house.middle - onto @ [place.x, place.y]
    gamma = rng.uniform(0.9, 1.15)
    site.photographs.append(Photograph(house.rgb, np.column_stack([onto, offset]), gamma))
    site.buildings += 1
    number = site.buildings
    plain, wall = site.kit.uses["photograph"][0], site.kit.draw(rng, "wall")
    common, paint = site.tint(0.1), site.tint(0.08)
    for ring, gain in zip(rings, house.gains, strict=True):
        site.sections += 1
        tint = (common[0] * gain, common[1] * gain, common[2] * gain)
        photo = len(site.photographs) - 1
        site.faces.append(Face(place.put(ring), (), ROOF, site.sections, number, plain, tint, photo))
    for quad in roofs.walls(rings, rng.uniform(0.25, 0.6)):
        site.faces.append(Face(place.put(quad), (), WALL, 0, number, wall, paint))
    return number


def fill(site: Site, stock: Sequence[House], s0: float, t0: float, s1: float, t1: float) -> None:
    """Fill a block (street coordinates, m) with photographed houses on plots along its two long streets."""
    rng = site.rng
    back = (t0 + t1) / 2
    setback = rng.uniform(1.5, 6.0)
    for front, sense in ((t0, 1), (t1, -1)):
        deep = abs(back - front)
        s = s0
        while s < s1 - 10:
            house = next((h for h in (pick(rng, stock) for _ in range(4)) if h.size.max() < deep + 3), None)
            if house is None:
                return
            turn = pick(rng, [0.0, np.pi / 2, np.pi, -np.pi / 2]) + rng.normal(0, 0.04)
            across, down = house.size if abs(math.cos(turn)) > 0.5 else house.size[::-1]
            w = across + rng.uniform(2.0, 8.0)
            near, far = sorted((front, back))
            site.paint_street(
                s, near, s + w, far, "lawn" if rng.random() < 0.8 else pick(rng, ["rough", "gravel"]), 0.15
            )
            centre = front + sense * (setback + down / 2)
            drive = rng.uniform(2.6, 5.0)
            x = s + rng.uniform(0.2, max(w - drive, 0.3))
            use = pick(rng, ["pavement", "gravel", "asphalt"])
            site.paint_street(x, min(front, centre), x + drive, max(front, centre), use, 0.2)
            if rng.random() < 0.94:
                stand(site, site.place(s + w / 2, centre, turn), house)
            if rng.random() < 0.7:
                spot = site.place(x + drive / 2, front + sense * rng.uniform(2, 5), np.pi / 2)
                site.car(spot.x, spot.y, spot.angle)
            yard = sorted((centre + sense * down / 2, back))
            if yard[1] - yard[0] > 3:
                site.trees(s, yard[0], s + w, yard[1], site.leafy * rng.uniform(0.2, 1.5), 7)
            site.trees(s, near, s + w, far, site.leafy * 0.25, 5)
            s += w
