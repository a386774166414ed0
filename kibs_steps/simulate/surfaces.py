"""What surfaces look like: materials of roofs, walls and ground in many countries.

A **material** is a mean albedo (linear, 0–1) and the strengths of a few textures that `light.albedo` lays over it, in the
surface's own axes: u along the eave, v up the slope (walls: height). A **palette** is the draw of materials for one scene.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import NamedTuple

import numpy as np


class Material(NamedTuple):
    """Albedo (r, g, b) and textures: relative strengths, periods in m (0: none)."""

    colour: tuple[float, float, float]
    mottle: float = 0.10  # patches of metres
    grain: float = 0.05  # from sample to sample
    streak: float = 0.0  # lines down the slope
    course: float = 0.0  # period of lines across the slope
    course_depth: float = 0.0
    seam: float = 0.0  # period of lines down the slope
    seam_depth: float = 0.0
    rim: float = 0.0  # lines along eaves, ridges and hips: brighter (> 0) or darker
    storey: float = 0.0  # storey height of windows
    bay: float = 0.0  # distance of windows along the wall
    glass: float = 0.3  # share of a bay that is window
    leaf: float = 0.0  # clumps of leaves, decimetres to metres


class Palette(NamedTuple):
    """Materials of one scene and what they are used for: name of a use -> indices into `materials`, drawn by
    cumulative `weights`."""

    materials: list[Material]
    uses: dict[str, list[int]]
    weights: dict[str, list[float]]

    def draw(self, rng: np.random.Generator, use: str) -> int:
        """One material for a use."""
        place = bisect_right(self.weights[use], rng.random())
        return self.uses[use][min(place, len(self.uses[use]) - 1)]


PITCHED = {
    "red_tile": (0.30, 0.115, 0.07),
    "orange_tile": (0.43, 0.19, 0.10),
    "salmon_tile": (0.46, 0.28, 0.19),
    "brown_tile": (0.16, 0.098, 0.07),
    "weathered_tile": (0.23, 0.16, 0.12),
    "dark_tile": (0.062, 0.058, 0.058),
    "slate": (0.11, 0.116, 0.13),
    "grey_tile": (0.22, 0.22, 0.225),
    "grey_shingle": (0.17, 0.165, 0.16),
    "brown_shingle": (0.20, 0.155, 0.12),
    "tan_shingle": (0.33, 0.28, 0.22),
    "thatch": (0.24, 0.19, 0.125),
    "zinc": (0.30, 0.32, 0.345),
    "galvanised": (0.48, 0.49, 0.49),
    "white_metal": (0.66, 0.66, 0.65),
    "green_metal": (0.11, 0.22, 0.16),
    "blue_metal": (0.10, 0.20, 0.40),
    "red_metal": (0.34, 0.09, 0.075),
    "rust": (0.27, 0.15, 0.09),
    "copper": (0.24, 0.38, 0.31),
    "fibre_cement": (0.31, 0.305, 0.29),
}
FLAT = {
    "bitumen": (0.12, 0.12, 0.122),
    "grey_felt": (0.24, 0.24, 0.24),
    "gravel": (0.36, 0.345, 0.31),
    "membrane": (0.68, 0.68, 0.665),
    "concrete": (0.40, 0.385, 0.355),
    "sand": (0.48, 0.40, 0.31),
    "green_roof": (0.13, 0.165, 0.07),
    "terracotta": (0.36, 0.20, 0.14),
    "tar": (0.06, 0.06, 0.062),
}
METALS = {
    "zinc",
    "galvanised",
    "white_metal",
    "green_metal",
    "blue_metal",
    "red_metal",
    "rust",
    "copper",
    "fibre_cement",
}

# Roofs seen together: name of a kind -> weight (pitched, flat).
COUNTRIES: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "north_france": (
        {"red_tile": 3, "brown_tile": 3, "slate": 4, "weathered_tile": 2, "zinc": 1, "dark_tile": 1},
        {"gravel": 2, "bitumen": 2, "grey_felt": 1, "membrane": 1},
    ),
    "paris": (
        {"zinc": 6, "slate": 3, "red_tile": 1.5, "weathered_tile": 1},
        {"zinc": 2, "gravel": 2, "grey_felt": 2, "bitumen": 1},
    ),
    "holland": (
        {"orange_tile": 4, "red_tile": 3, "dark_tile": 5, "brown_tile": 3, "grey_tile": 2, "thatch": 0.4},
        {"bitumen": 4, "gravel": 2, "grey_felt": 3, "membrane": 1, "green_roof": 0.6, "tar": 1.5},
    ),
    "germany": (
        {"red_tile": 5, "orange_tile": 2, "brown_tile": 3, "dark_tile": 3, "slate": 1.5, "grey_tile": 1, "thatch": 0.3},
        {"gravel": 3, "bitumen": 2, "green_roof": 1, "grey_felt": 1},
    ),
    "mediterranean": (
        {"salmon_tile": 4, "orange_tile": 4, "weathered_tile": 4, "fibre_cement": 0.7},
        {"terracotta": 2, "concrete": 3, "gravel": 1, "membrane": 1.5},
    ),
    "britain": (
        {"brown_tile": 4, "slate": 4, "red_tile": 2, "grey_tile": 2, "dark_tile": 2, "thatch": 0.5},
        {"grey_felt": 3, "bitumen": 2, "gravel": 1},
    ),
    "scandinavia": (
        {"dark_tile": 4, "red_tile": 3, "red_metal": 1.5, "grey_tile": 2, "galvanised": 1, "green_metal": 0.7},
        {"tar": 3, "bitumen": 2, "green_roof": 0.7},
    ),
    "america": (
        {
            "grey_shingle": 5,
            "brown_shingle": 4,
            "tan_shingle": 3,
            "dark_tile": 2,
            "salmon_tile": 0.7,
            "white_metal": 0.5,
        },
        {"membrane": 4, "gravel": 2, "grey_felt": 2, "tar": 1},
    ),
    "oceania": (
        {
            "galvanised": 3,
            "grey_tile": 3,
            "red_metal": 1.5,
            "green_metal": 1.5,
            "brown_tile": 2,
            "dark_tile": 2,
            "blue_metal": 0.5,
            "orange_tile": 1,
        },
        {"membrane": 2, "galvanised": 2, "grey_felt": 1},
    ),
    "desert": ({"salmon_tile": 1, "sand": 4, "rust": 1, "galvanised": 1}, {"sand": 6, "concrete": 4, "membrane": 1.5}),
    "east_asia": (
        {"grey_tile": 3, "blue_metal": 2.5, "dark_tile": 2, "red_tile": 2, "green_metal": 0.7, "galvanised": 1},
        {"concrete": 4, "grey_felt": 2, "membrane": 1, "gravel": 1, "terracotta": 0.5},
    ),
    "works": (
        {
            "galvanised": 4,
            "white_metal": 4,
            "zinc": 3,
            "fibre_cement": 3,
            "blue_metal": 1,
            "green_metal": 1,
            "rust": 1,
            "red_metal": 0.5,
        },
        {"membrane": 4, "gravel": 3, "bitumen": 2, "grey_felt": 3, "tar": 1},
    ),
}
WALLS = {
    "white": (0.62, 0.60, 0.56),
    "cream": (0.55, 0.48, 0.36),
    "ochre": (0.45, 0.34, 0.20),
    "brick": (0.24, 0.12, 0.085),
    "yellow_brick": (0.40, 0.31, 0.20),
    "brown": (0.20, 0.15, 0.11),
    "grey": (0.36, 0.355, 0.345),
    "stone": (0.42, 0.38, 0.31),
    "dark": (0.11, 0.105, 0.10),
    "rose": (0.48, 0.32, 0.27),
    "wood": (0.22, 0.15, 0.09),
    "timber_red": (0.25, 0.07, 0.05),
}


def _jitter(rng: np.random.Generator, colour: tuple[float, float, float], amount: float) -> tuple[float, float, float]:
    bright = np.exp(rng.normal(0, amount))
    return tuple(float(np.clip(c * bright * np.exp(rng.normal(0, amount * 0.25)), 0.015, 0.9)) for c in colour)


def _roof(rng: np.random.Generator, name: str, age: float) -> Material:
    colour = _jitter(rng, PITCHED.get(name) or FLAT[name], 0.16)
    if name in METALS:
        return Material(
            colour,
            mottle=rng.uniform(0.02, 0.14) * age,
            grain=0.015,
            streak=rng.uniform(0.02, 0.2) * age,
            seam=rng.choice([0.0, rng.uniform(0.4, 1.1)]),
            seam_depth=rng.uniform(0.04, 0.3),
            rim=rng.uniform(-0.2, 0.3),
        )
    if name == "thatch":
        return Material(colour, 0.2 * age, 0.06, streak=rng.uniform(0.1, 0.3), rim=rng.uniform(-0.4, 0.1), leaf=0.1)
    if name in FLAT:
        return Material(
            colour,
            mottle=rng.uniform(0.06, 0.3) * age,
            grain=rng.uniform(0.01, 0.07),
            seam=rng.choice([0.0, 0.0, rng.uniform(0.9, 2.2), rng.uniform(4, 8)]),
            seam_depth=rng.uniform(0.03, 0.16),
            leaf=0.25 if name == "green_roof" else 0.0,
        )
    return Material(
        colour,
        mottle=rng.uniform(0.05, 0.28) * age,
        grain=rng.uniform(0.02, 0.09),
        streak=rng.uniform(0.02, 0.22) * age,
        course=rng.uniform(0.25, 0.42),
        course_depth=rng.uniform(0.0, 0.16),
        rim=rng.uniform(-0.35, 0.4),
    )


def _wall(rng: np.random.Generator, name: str) -> Material:
    return Material(
        _jitter(rng, WALLS[name], 0.12),
        mottle=rng.uniform(0.03, 0.12),
        grain=0.03,
        storey=rng.uniform(2.6, 3.8),
        bay=rng.uniform(1.8, 4.2),
        glass=float(rng.choice([rng.uniform(0.12, 0.35), rng.uniform(0.3, 0.7)])),
    )


def palette(rng: np.random.Generator, country: str | None = None) -> Palette:
    """Materials for one scene; `country` is a key of `COUNTRIES`, drawn if None."""
    country = country or str(rng.choice([c for c in COUNTRIES if c != "works"]))
    age = rng.uniform(0.4, 1.3)
    materials: list[Material] = []
    uses: dict[str, list[int]] = {}
    weights: dict[str, list[float]] = {}

    def add(use: str, new: list[Material], share: list[float] | None = None) -> None:
        uses[use] = list(range(len(materials), len(materials) + len(new)))
        w = np.array(share or [1.0] * len(new), float)
        weights[use] = (np.cumsum(w) / w.sum()).tolist()
        materials.extend(new)

    for use, (pitched, flat) in (("", COUNTRIES[country]), ("works_", COUNTRIES["works"])):
        for kind, table in (("pitched", pitched), ("flat", flat)):
            names = list(table)
            share = np.array([table[n] for n in names]) * rng.gamma(0.7, 1.0, len(names))
            drawn = rng.choice(
                len(names), size=min(5, len(names)), replace=False, p=(share + 1e-6) / (share + 1e-6).sum()
            )
            add(
                use + kind,
                [_roof(rng, names[i], age) for i in drawn for _ in range(2)],
                [share[i] + 1e-6 for i in drawn for _ in range(2)],
            )
    names = list(rng.choice(list(WALLS), size=4, replace=False))
    add("wall", [_wall(rng, n) for n in names], list(rng.gamma(1.0, 1.0, 4) + 0.05))
    grey = _jitter(rng, (0.40, 0.40, 0.39), 0.3)
    add(
        "works_wall",
        [
            Material(_jitter(rng, c, 0.2), 0.06, 0.02, seam=0.9, seam_depth=0.06)
            for c in (grey, (0.6, 0.6, 0.58), (0.3, 0.2, 0.15))
        ],
    )
    dry = rng.beta(0.8, 1.6)
    lush, sere = np.array((0.062, 0.098, 0.045)), np.array((0.24, 0.205, 0.135))
    green = lambda t: tuple((lush * (1 - t) + sere * t).tolist())  # noqa: E731
    add(
        "lawn",
        [
            Material(
                _jitter(rng, green(np.clip(dry + d, 0, 1)), 0.12),
                rng.uniform(0.1, 0.3),
                0.08,
                leaf=rng.uniform(0.05, 0.25),
            )
            for d in (-0.2, 0, 0, 0.2)
        ],
    )
    add(
        "rough",
        [
            Material(_jitter(rng, green(np.clip(dry + d, 0, 1)), 0.2), 0.35, 0.12, leaf=rng.uniform(0.15, 0.45))
            for d in (0.0, 0.3)
        ],
    )
    add(
        "soil",
        [
            Material(_jitter(rng, c, 0.2), 0.25, 0.08)
            for c in ((0.27, 0.20, 0.14), (0.36, 0.29, 0.21), (0.18, 0.135, 0.10))
        ],
    )
    tar = rng.uniform(0.07, 0.25)
    add(
        "asphalt",
        [
            Material(_jitter(rng, (tar, tar, tar * 1.02), 0.1), rng.uniform(0.08, 0.25), 0.04, streak=0.08)
            for _ in range(2)
        ],
    )
    pave = [(0.40, 0.385, 0.36), (0.33, 0.30, 0.27), (0.30, 0.18, 0.14), (0.46, 0.43, 0.38)]
    add(
        "pavement",
        [Material(_jitter(rng, c, 0.15), 0.15, 0.06, course=0.6, course_depth=0.05) for c in pave],
        list(rng.gamma(0.6, 1, 4) + 0.05),
    )
    add("gravel", [Material(_jitter(rng, c, 0.15), 0.2, 0.08) for c in ((0.42, 0.40, 0.36), (0.36, 0.31, 0.25))])
    add(
        "tank",
        [
            Material(_jitter(rng, c, 0.12), rng.uniform(0.02, 0.15), 0.02, streak=rng.uniform(0, 0.15))
            for c in ((0.72, 0.72, 0.70), (0.5, 0.5, 0.49), (0.34, 0.17, 0.09), (0.3, 0.36, 0.33))
        ],
        [5, 3, 1, 1],
    )
    add("greenhouse", [Material((0.62, 0.66, 0.66), 0.12, 0.05, course=rng.uniform(1.6, 4.0), course_depth=0.25)])
    add(
        "hull",
        [
            Material(_jitter(rng, c, 0.2), 0.06, 0.03)
            for c in ((0.07, 0.03, 0.025), (0.04, 0.06, 0.1), (0.3, 0.3, 0.29))
        ],
    )
    add(
        "deck",
        [
            Material(_jitter(rng, c, 0.2), 0.15, 0.05)
            for c in ((0.30, 0.10, 0.06), (0.10, 0.2, 0.13), (0.3, 0.3, 0.3), (0.5, 0.42, 0.2))
        ],
    )
    add("photograph", [Material((1.0, 1.0, 1.0), 0.0, 0.02)])
    add("marking", [Material((0.6, 0.6, 0.58), 0.2, 0.08)])
    add(
        "water",
        [
            Material(_jitter(rng, c, 0.3), 0.1, 0.02)
            for c in ((0.03, 0.05, 0.05), (0.06, 0.08, 0.055), (0.02, 0.035, 0.05))
        ],
    )
    add("pool", [Material(_jitter(rng, (0.13, 0.42, 0.50), 0.15), 0.05, 0.03)])
    add("track", [Material(_jitter(rng, (0.33, 0.12, 0.08), 0.12), 0.06, 0.02)])
    add(
        "court",
        [
            Material(_jitter(rng, c, 0.15), 0.08, 0.03)
            for c in ((0.08, 0.18, 0.12), (0.34, 0.16, 0.10), (0.10, 0.17, 0.30))
        ],
    )
    rows = lambda: {"course": float(rng.choice([0.0, rng.uniform(0.7, 4)])), "course_depth": rng.uniform(0.05, 0.4)}  # noqa: E731
    add(
        "field",
        [
            Material(
                _jitter(rng, c, 0.2), rng.uniform(0.05, 0.25), 0.05, streak=rng.uniform(0, 0.15), leaf=0.1, **rows()
            )
            for c in (
                (0.06, 0.12, 0.04),
                (0.13, 0.16, 0.06),
                (0.30, 0.25, 0.14),
                (0.22, 0.155, 0.11),
                (0.42, 0.36, 0.2),
                (0.08, 0.09, 0.05),
            )
        ],
    )
    add("rail", [Material(_jitter(rng, (0.22, 0.19, 0.165), 0.15), 0.1, 0.06, course=1.5, course_depth=0.3)])
    autumn = rng.random() < 0.12
    leaves = [(0.035, 0.065, 0.022), (0.05, 0.085, 0.03), (0.027, 0.048, 0.022), (0.075, 0.095, 0.035)]
    if autumn:
        leaves += [(0.20, 0.12, 0.04), (0.22, 0.07, 0.03), (0.13, 0.10, 0.07)]
    thick = rng.uniform(0.25, 0.8)
    add("tree", [Material(_jitter(rng, c, 0.2), 0.2, 0.15, leaf=thick) for c in leaves])
    add("bare", [Material(_jitter(rng, (0.085, 0.075, 0.06), 0.15), 0.2, 0.25, leaf=0.5)])
    cars = [
        (0.55, 0.55, 0.55),
        (0.36, 0.4, 0.41),
        (0.05, 0.05, 0.055),
        (0.18, 0.18, 0.19),
        (0.30, 0.04, 0.035),
        (0.05, 0.09, 0.25),
        (0.45, 0.4, 0.3),
        (0.04, 0.14, 0.09),
    ]
    add("car", [Material(c, 0.02, 0.02) for c in cars], [3.5, 4, 4.5, 4.5, 1.3, 1.3, 0.6, 0.4])
    add("glass", [Material((0.04, 0.05, 0.06), 0.05, 0.02)])
    add(
        "solar",
        [
            Material((0.025, 0.032, 0.06), 0.05, 0.02, course=1.0, course_depth=0.5, seam=1.0, seam_depth=0.4),
            Material((0.018, 0.02, 0.026), 0.03, 0.02, course=1.65, course_depth=0.3),
        ],
    )
    add("skylight", [Material((0.10, 0.13, 0.17), 0.1, 0.05), Material((0.5, 0.53, 0.55), 0.05, 0.02)])
    add(
        "metal",
        [
            Material((0.5, 0.5, 0.5), 0.08, 0.03),
            Material((0.3, 0.31, 0.32), 0.08, 0.03),
            Material((0.65, 0.65, 0.63), 0.05, 0.03),
        ],
    )
    add(
        "chimney",
        [
            Material(_jitter(rng, c, 0.15), 0.05, 0.05)
            for c in ((0.26, 0.13, 0.09), (0.35, 0.34, 0.32), (0.12, 0.11, 0.1))
        ],
    )
    add(
        "box",
        [
            Material(_jitter(rng, c, 0.15), 0.08, 0.03, seam=0.5, seam_depth=0.1)
            for c in ((0.32, 0.08, 0.05), (0.06, 0.14, 0.30), (0.1, 0.2, 0.1), (0.5, 0.5, 0.48), (0.36, 0.2, 0.08))
        ],
    )
    return Palette(materials, uses, weights)
