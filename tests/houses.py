"""Houses in closed form, for tests of buildings and solids: rings and planes of their sections, and known volumes.

A section is (ring of (x, y), (a, b, c)) with z = a·x + b·y + c, metres above flat ground at 0.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import features, gate, solids, terrain
from kibs_steps.ground import SECTIONS

FLAT = terrain.flat(0.0)
Section = tuple[list[tuple[float, float]], tuple[float, float, float]]

BOX: list[Section] = [([(0, 0), (5, 0), (5, 4), (0, 4)], (0, 0, 3))]
SHED: list[Section] = [([(0, 0), (6, 0), (6, 5), (0, 5)], (0, 0.4, 3))]
GABLE: list[Section] = [
    ([(0, 0), (10, 0), (10, 4), (0, 4)], (0, 0.75, 3)),
    ([(0, 4), (10, 4), (10, 8), (0, 8)], (0, -0.75, 9)),
]
HIP: list[Section] = [
    ([(0, 0), (14, 0), (9.5, 4.5), (4.5, 4.5)], (0, 0.75, 6)),
    ([(14, 0), (14, 9), (9.5, 4.5)], (-0.75, 0, 16.5)),
    ([(14, 9), (0, 9), (4.5, 4.5), (9.5, 4.5)], (0, -0.75, 12.75)),
    ([(0, 9), (0, 0), (4.5, 4.5)], (0.75, 0, 6)),
]
PYRAMID: list[Section] = [
    ([(0, 0), (8, 0), (4, 4)], (0, 0.5, 4)),
    ([(8, 0), (8, 8), (4, 4)], (-0.5, 0, 8)),
    ([(8, 8), (0, 8), (4, 4)], (0, -0.5, 8)),
    ([(0, 8), (0, 0), (4, 4)], (0.5, 0, 4)),
]
L_HOUSE: list[Section] = [  # two gables of one ridge height, with a hip and a valley where they meet
    ([(0, 0), (12, 0), (9, 3), (0, 3)], (0, 1, 3)),
    ([(12, 0), (12, 12), (9, 12), (9, 3)], (-1, 0, 15)),
    ([(9, 3), (9, 12), (6, 12), (6, 6)], (1, 0, -3)),
    ([(9, 3), (6, 6), (0, 6), (0, 3)], (0, -1, 9)),
]
COURTYARD: list[Section] = [
    ([(0, 0), (20, 0), (15, 5), (5, 5)], (0, 0.5, 4)),
    ([(20, 0), (20, 20), (15, 15), (15, 5)], (-0.5, 0, 14)),
    ([(20, 20), (0, 20), (5, 15), (15, 15)], (0, -0.5, 14)),
    ([(0, 20), (0, 0), (5, 5), (5, 15)], (0.5, 0, 4)),
]
WITH_WING: list[Section] = [
    *HIP,
    ([(14, 1), (22, 1), (22, 4.5), (14, 4.5)], (0, 0.6, 3.4)),
    ([(14, 4.5), (22, 4.5), (22, 8), (14, 8)], (0, -0.6, 8.8)),
    ([(2, -4), (7, -4), (7, 0), (2, 0)], (0, 0, 3.2)),
]
CHEQUERED: list[Section] = [  # high and low alternate round one point
    ([(0, 0), (5, 0), (5, 5), (0, 5)], (0, 0, 6)),
    ([(5, 0), (10, 0), (10, 5), (5, 5)], (0, 0, 4)),
    ([(0, 5), (5, 5), (5, 10), (0, 10)], (0, 0, 4)),
    ([(5, 5), (10, 5), (10, 10), (5, 10)], (0, 0, 6)),
]

VOLUME = {
    "box": 60.0,
    "shed": 6 * 5 * 4.0,
    "gable": 10 * 8 * 4.5,
    "hip": 14 * 9 * 6 + 5 * 9 * 3.375 / 2 + 9 * 9 * 3.375 / 3,
    "pyramid": 8 * 8 * (4 + 2 / 3),
    "l_house": 6 * 3 * 12 + 6 * 3 * 6 + (12 + 12 - 6) * 9.0,
    "courtyard": 300 * 4 + 1000 / 3,
}
HOUSES = {
    "box": BOX,
    "shed": SHED,
    "gable": GABLE,
    "hip": HIP,
    "pyramid": PYRAMID,
    "l_house": L_HOUSE,
    "courtyard": COURTYARD,
    "with_wing": WITH_WING,
    "chequered": CHEQUERED,
}


def turned(house: list[Section], degrees: float, shift: tuple[float, float] = (0.0, 0.0)) -> list[Section]:
    """The house turned about the origin, then moved."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.array([[c, -s], [s, c]])
    result = []
    for ring, (a, b, z) in house:
        slope = matrix @ (a, b)
        moved = np.asarray(ring, float) @ matrix.T + shift
        result.append(([tuple(p) for p in moved], (*slope, z - slope @ shift)))
    return result


def blurred(
    house: list[Section],
    rng: np.random.Generator,
    height: float,
    outline: float,
    lean: tuple[float, float] = (0.0, 0.0),
) -> list[Section]:
    """The house as detected: planes off by `height` (m) and 5 % of it in slope, every vertex of every section by `outline` (m).

    With a `lean`, each vertex is also moved by its height's error, as outlines seen in an image are.
    """
    result = []
    for ring, plane in house:
        xy = np.asarray(ring, float)
        a, b, c = plane
        off = rng.normal(0, [0.05 * height, 0.05 * height, height])
        centre = xy.mean(axis=0)
        found = (a + off[0], b + off[1], c + off[2] - off[0] * centre[0] - off[1] * centre[1])
        wrong = xy @ (np.array(found) - plane)[:2] + (found[2] - c)
        moved = xy + rng.normal(0, outline, xy.shape) + wrong[:, None] * np.array(lean)
        result.append(([tuple(p) for p in moved], found))
    return result


def ground_table(
    sections: list[Section],
    place: tuple[float, float] = (500_000.0, 5_400_000.0),
    base: float = 0.0,
    ids: list[int] | None = None,
    status: list[str] | None = None,
    sigma: float = 0.1,
) -> pa.Table:
    """Rows of `ground.parquet` for sections standing at `place` (map m) on ground at `base` (m)."""
    n = len(sections)
    rows: dict[str, list] = {name: [] for name in SECTIONS.names}
    for k, (ring, (a, b, c)) in enumerate(sections):
        xy = np.asarray(ring, float).reshape(-1, 2)
        z = xy @ (a, b) + c + base
        outline = shapely.Polygon(np.column_stack([xy + place, z])) if len(xy) >= 3 else shapely.Polygon()
        wkb = shapely.to_wkb(outline, output_dimension=3)
        found = {
            "section_id": (ids or range(1, n + 1))[k],
            "outline": shapely.to_wkb(shapely.transform(outline, lambda p: (p - place) / 0.38)),
            "outline_seen": wkb,
            "outline_map": wkb,
            "status": (status or ["ok"] * n)[k],
            "status_reason": "",
            "height_min": float(z.min() - base) if len(z) else 0.0,
            "height_max": float(z.max() - base) if len(z) else 0.0,
            "height_mean": float(z.mean() - base) if len(z) else 0.0,
            "height_sigma": sigma,
            "slope": float(np.degrees(np.arctan(np.hypot(a, b)))),
            "azimuth": None,
            "plane_a": float(a),
            "plane_b": float(b),
            "plane_c": float(c + base),
            "x0": place[0],
            "y0": place[1],
            "n_corners": len(ring),
            "score": 1.0,
            "area": float(outline.area),
            "split": 2,
            "sigma_along": 0.1,
            "sigma_across": 0.02,
        }
        for name, value in found.items():
            rows[name].append(value)
    return pa.table([pa.array(rows[f.name], f.type) for f in SECTIONS], schema=SECTIONS)


def building_table(sections: list[Section], **how: object) -> pa.Table:
    """`ground_table` with all sections one building."""
    table = ground_table(sections, **how)
    smallest = min(table["section_id"].to_pylist())
    one = pa.array([smallest] * len(table), pa.int64())
    return table.append_column("building_id", one).append_column("cluster_id", one)


def built(house, dtm=FLAT, **how):
    """The one building of a house's table: sections, solid, attributes."""
    ((building, sections),) = solids.clusters_of(building_table(house, **how))
    solid = solids.build(sections, dtm)
    return sections, solid, features.attributes(int(building[0]), sections, solid)


def shells_are_valid(solid):
    """Whether every shell of a solid passes the gate."""
    return all(gate.check([s.rings for s in shell]) == [] for shell in solid.shells)
