"""Training tiles from their sources, and the endless mixture of them.

Sources: the simulator (exact truth), roof-graph photographs pasted into other ground (real roofs, sections and corners known,
heights not), chips with building masks (real scenes of many places, roofs known, sections not), a user's own samples. In:
`photographs`, files. Out: samples (`samples`), varied by `augmentation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from rasterio.features import rasterize

from kibs_steps.learn import augmentation
from kibs_steps.learn.samples import UNKNOWN, Sample
from kibs_steps.photographs import GRAPH_GSD, REDUCED, Chip, NoTrainingData, RoofGraph

if TYPE_CHECKING:
    from kibs_steps.simulate.citymodel import CityModel
    from kibs_steps.simulate.draped import House

GSD = 0.38  # m per px of the models trained here, if no other is asked for
VIEWS = (45.0, 90.0)  # view elevations (deg) that tiles are seen from, if no others are asked for
LOOSE = 3  # px, width of the strip about a mask's outline of which nothing is asked
NADIR = np.array([0, 0, 0, 0, 1, 0], np.float32)


def simulated(
    rng: np.random.Generator,
    size: int = 320,
    backgrounds: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
    view_elevation: tuple[float, float] = VIEWS,
    view: tuple[float, float] | None = None,
    sun: tuple[float, float] | None = None,
    cities: Sequence[CityModel] = (),
    houses: Sequence[House] = (),
    gsd: float = GSD,
    tall: bool = False,
) -> Sample:
    """A tile of the simulator at about `gsd`, seen from elevations (deg) in a range, from all sides, lit from anywhere.

    `backgrounds` are photographs (rgb, usable as ground: bool) for the simulator's ground. `view` and `sun` (azimuth, elevation
    deg) fix the directions but for a degree or two, for models of one scene. Some tiles show one of the real `cities`, some
    photographed `houses` (`simulate.draped`); with `tall` all show tall buildings.
    """
    from kibs_steps.simulate.scene import random_scene

    rendering, geometry = random_scene(
        rng,
        size=size,
        gsd=gsd * rng.uniform(0.9, 1.1),
        view_elevation=view_elevation,
        backgrounds=backgrounds,
        view=near(view, rng),
        sun=near(sun, rng),
        cities=cities,
        houses=houses,
        tall=tall,
    )
    section = rendering.section.astype(np.int32)
    return Sample(
        rendering.rgb,
        section,
        (section > 0).astype(np.uint8),
        rendering.height.astype(np.float32),
        rendering.surface,
        rendering.corners.astype(np.float32).reshape(-1, 2),
        rendering.corner_heights.astype(np.float32),
        np.ones(section.shape, np.uint8),
        np.asarray(geometry, np.float32).reshape(6),
    )


def near(
    direction: tuple[float, float] | None, rng: np.random.Generator, spread: float = 1.5
) -> tuple[float, float] | None:
    """A direction (azimuth, elevation deg) close to one given, None if none is."""
    if direction is None:
        return None
    azimuth, elevation = direction[0] + rng.normal(0, spread), direction[1] + rng.normal(0, spread)
    return azimuth % 360, float(np.clip(elevation, 5.0, 89.9))


def chip_sample(chip: Chip, rng: np.random.Generator, size: int, gsd: float = GSD) -> Sample:
    """A window of a chip, turned and scaled at random: roofs known but for their rims, sections and corners not."""
    scale = chip.gsd / gsd * rng.uniform(0.75, 1.35)
    angle = rng.uniform(0, 2 * np.pi)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if rng.random() < 0.5:
        linear = linear @ np.diag([-1.0, 1.0])
    rows, cols = chip.building.shape
    reach = 0.35 * size / scale  # keep most of the window on the chip, the rest is mirrored
    centre = [rng.uniform(min(reach, n / 2), max(n - reach, n / 2)) for n in (cols, rows)]
    affine = np.hstack([linear, (size / 2 - linear @ centre)[:, None]])
    blur = 0.4 / scale if scale < 0.8 else 0.0
    rgb = cv2.GaussianBlur(chip.rgb, (0, 0), blur) if blur else chip.rgb
    rgb = cv2.warpAffine(rgb, affine, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    mask = chip.building.astype(np.uint8) * 255
    mask = cv2.warpAffine(mask, affine, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    building = mask > 127
    # A mask is shifted by a pixel or two and cuts corners: what it says of its outline would teach blurred rims.
    loose = cv2.morphologyEx(building.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((LOOSE, LOOSE), np.uint8)) > 0
    sample = Sample.ground(rgb)
    return sample._replace(
        labels=np.where(building | loose, -1, 0).astype(np.int32),
        roof=np.where(loose, np.uint8(UNKNOWN), building.astype(np.uint8)),
        surface=np.where(building & ~loose, np.uint8(1), sample.surface),
        # A mask's outline is only as good as its annotator: no corners within 3 px of a building are learned either way.
        corners_known=(cv2.dilate(mask, np.ones((7, 7))) <= 127).astype(np.uint8),
        geometry=NADIR.copy() if rng.random() < 0.4 else sample.geometry,
    )


def without_truth(sample: Sample) -> Sample:
    """The sample as mere context: nothing of it is known."""
    nothing = np.zeros_like(sample.roof)
    return sample._replace(labels=nothing.astype(np.int32) - 1, roof=nothing + UNKNOWN, corners_known=nothing)


def with_decoys(sample: Sample, other: Sample, rng: np.random.Generator) -> Sample:
    """Patches of `other`'s ground, cut like houses, laid on `sample`'s ground: a cut-out's outline alone is no house."""
    rgb = sample.rgb.copy()
    size = rgb.shape[0]
    for _ in range(rng.integers(1, 5)):
        box = (rng.random(2) * size, rng.uniform(15, 70, 2), rng.uniform(0, 180))
        patch = cv2.fillPoly(np.zeros((size, size), np.uint8), [cv2.boxPoints(box).astype(np.int32)], 1)
        patch[(sample.roof != 0) | (other.roof != 0)] = 0
        alpha = _feathered(patch, rng.uniform(0, 3))[..., None]
        rgb = (alpha * other.rgb + (1 - alpha) * rgb).astype(np.uint8)
    return sample._replace(rgb=rgb)


def pasted_houses(
    ground: Sample,
    graphs: Sequence[RoofGraph],
    rng: np.random.Generator,
    count: tuple[int, int] = (5, 13),
    gsd: float = GSD,
) -> Sample:
    """Photographed houses pasted into a tile: sections and corners known, heights not.

    Each comes with some of its own surroundings, softly at random, so that the seam tells nothing. A ring round the annotated
    roof is ground for certain; the rest of the pasted surroundings is unknown.
    """
    size = ground.rgb.shape[0]
    rgb = ground.rgb.copy()
    labels, roof, known = ground.labels.copy(), ground.roof.copy(), ground.corners_known.copy()
    surface = ground.surface.copy()
    taken = np.zeros((size, size), np.uint8)
    corners: list[np.ndarray] = []
    label = max(int(labels.max()), 0)
    for _ in range(rng.integers(count[0], count[1] + 1)):
        graph = graphs[rng.integers(len(graphs))]
        affine = _house_affine(graph, rng, size, gsd)
        vertices = graph.vertices @ affine[:, :2].T + affine[:, 2]
        # By pixel centres: OpenCV would draw rims too, and every face half a pixel too wide.
        rings = (vertices[np.append(face, face[0])].tolist() for face in graph.faces)
        faces = [({"type": "Polygon", "coordinates": [ring]}, i) for i, ring in enumerate(rings, start=1)]
        own = rasterize(faces, (size, size), dtype=np.int32)
        house = (own > 0).astype(np.uint8)
        if not house.any() or (taken & cv2.dilate(house, np.ones((5, 5), np.uint8))).any():
            continue
        ring = cv2.dilate(house, np.ones((9, 9), np.uint8))
        reach = int(rng.integers(4, 16))
        near = cv2.dilate(house, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2))
        inside = cv2.warpAffine(
            np.ones(graph.rgb.shape[:2], np.uint8), _centred(affine), (size, size), flags=cv2.INTER_NEAREST
        )
        alpha = _feathered(near & inside & (1 - taken), rng.uniform(0.3, 4))
        alpha = np.maximum(alpha, house)
        alpha[(taken > 0) | (inside == 0)] = 0
        picture = cv2.warpAffine(cv2.GaussianBlur(graph.rgb, (0, 0), 0.6), _centred(affine), (size, size))
        gain = np.exp(rng.normal(0, 0.12) + rng.normal(0, 0.06, 3))
        picture = np.clip(picture * gain, 0, 255)
        rgb = (alpha[..., None] * picture + (1 - alpha[..., None]) * rgb).astype(np.uint8)
        changed = alpha > 0.15
        labels[changed], roof[changed], known[changed], surface[changed] = -1, UNKNOWN, 0, UNKNOWN
        # The ring counts as ground only where the photograph is really shown: elsewhere the old ground keeps its truth.
        sure = (ring > 0) & changed
        labels[sure], roof[sure], known[sure] = 0, 0, 1
        seen = (house > 0) & (inside > 0)
        labels[seen], roof[seen], known[seen], surface[seen] = own[seen] + label, 1, 1, 1
        label = max(int(labels.max()), label)
        taken |= ring & inside
        corners.append(vertices[np.unique(np.concatenate(graph.faces))])
    points = np.concatenate(corners).astype(np.float32) if corners else np.zeros((0, 2), np.float32)
    points = points[(points >= 0).all(1) & (points < size).all(1)]
    return ground._replace(
        rgb=rgb,
        labels=labels,
        roof=roof,
        surface=surface,
        corners=np.concatenate([ground.corners, points]),
        corner_heights=np.concatenate([ground.corner_heights, np.full(len(points), np.nan, np.float32)]),
        corners_known=known,
    )


def _house_affine(graph: RoofGraph, rng: np.random.Generator, size: int, gsd: float) -> np.ndarray:
    """Tile px of the reduced photograph's px, (2, 3): the house anywhere in the tile, turned, scaled, perhaps mirrored."""
    scale = REDUCED * GRAPH_GSD / gsd * rng.uniform(0.85, 1.3)
    angle = rng.uniform(0, 2 * np.pi)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if rng.random() < 0.5:
        linear = linear @ np.diag([-1.0, 1.0])
    place = rng.uniform(0, size, 2) - linear @ graph.vertices.mean(0)
    return np.hstack([linear, place[:, None]])


def _centred(affine: np.ndarray) -> np.ndarray:
    """The same map between pixel indices (centres at whole numbers) as OpenCV counts them."""
    return np.hstack([affine[:, :2], (affine[:, 2] + affine[:, :2] @ [0.5, 0.5] - 0.5)[:, None]])


def _feathered(mask: np.ndarray, softness: float) -> np.ndarray:
    """A mask's blending weight, float32 0–1, falling off inside it over about `softness` px."""
    inner = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
    return np.clip(inner / (2 * softness + 1e-3), 0, 1).astype(np.float32)


class Mixture:
    """Endless tiles for one task, the i-th always drawn with the same random numbers.

    `shares` are the probabilities of (simulated, pasted houses, chips, own). Simulated tiles come from `pool`, a folder of
    kept samples that another process may still be filling; while it is empty, the other sources stand in. `own` are files of
    kept samples (`learn.own`), as those at `gsd`. The shares `forget` come without view, and without sun. Tiles come `upright`,
    or turned at random; some have their roofs repainted, some their yards paved, some their radiometry changed; most look like
    `shown`, windows (n, s, s, 3) uint8 of one scene, where there are any.
    """

    def __init__(
        self,
        pool: Path,
        graphs: Sequence[RoofGraph],
        chips: Sequence[Chip],
        shares: Sequence[float],
        size: int,
        seed: int,
        own: Sequence[Path] = (),
        upright: bool = True,
        gsd: float = GSD,
        forget: tuple[float, float] = (augmentation.FORGOTTEN, augmentation.FORGOTTEN),
        shown: Sequence[np.ndarray] = (),
    ):
        self.own, self.upright, self.gsd, self.forget, self.shown = list(own), upright, gsd, forget, shown
        self.pool, self.graphs, self.chips = pool, graphs, chips
        self.shares, self.size, self.seed = shares, size, seed
        self._kept: list[Path] = []
        self._listed_at = -1

    def __getitem__(self, index: int) -> Sample:
        rng = np.random.default_rng([self.seed, index])
        if self._listed_at < 0 or index - self._listed_at > 500:
            self._kept = sorted(self.pool.glob("[!.]*.npz"))
            self._listed_at = index
        shares = np.zeros(4)
        shares[: len(self.shares)] = self.shares
        shares *= [bool(self._kept), bool(self.graphs) and bool(self.chips), bool(self.chips), bool(self.own)]
        if not shares.any():
            raise NoTrainingData(f"nothing to learn from: {self.pool} is empty and no other source has a share")
        source = rng.choice(4, p=shares / shares.sum())
        if source in (0, 3):
            files = self._kept if source == 0 else self.own
            sample = Sample.load(files[rng.integers(len(files))])
            row, col = rng.integers(0, [n - self.size + 1 for n in sample.labels.shape])
            sample = sample.window(row, col, self.size)
        else:
            sample = chip_sample(self.chips[rng.integers(len(self.chips))], rng, self.size, self.gsd)
            if rng.random() < 0.5:
                other = chip_sample(self.chips[rng.integers(len(self.chips))], rng, self.size, self.gsd)
                sample = with_decoys(sample, other, rng)
            if source == 1:
                sample = pasted_houses(sample, self.graphs, rng, gsd=self.gsd)
        if rng.random() < augmentation.REPAINTED:
            sample = augmentation.repainted(sample, rng)
        if rng.random() < augmentation.PAVED:
            sample = augmentation.paved(sample, rng)
        sample = augmentation.without_geometry(sample, rng, self.forget)
        sample = (
            augmentation.upright(sample, rng) if self.upright else augmentation.dihedral(sample, int(rng.integers(8)))
        )
        if (alike := augmentation.in_the_look(sample, self.shown, rng)) is not None:
            return alike
        if rng.random() >= augmentation.AS_IT_IS:
            sample = sample._replace(rgb=augmentation.radiometry(sample.rgb, rng))
        return sample
