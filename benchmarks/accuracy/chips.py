"""Sets B, village and C: single tiles of real photographs, judged section by section and pixel by pixel.

B: roof photographs of map sheets no training shows, pasted on other ground, at about 0.38 m; sections and corners are known.
Village: real scenes of many houses; sections known. C: real chips with building masks, a place at a time; roofs known. In:
models, samples. Out: figures per set, and what a tile costs.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks.accuracy.methods import Method
from kibs_steps import metrics, photographs
from kibs_steps.blend import blend
from kibs_steps.learn import dataset, validation
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import heads, runtime

SIDE = 224  # px: within every model's tile, so that all see the same ground
VILLAGE = 256  # px: holds its scenes of 51.2 m at GSDs down to 0.2 m
FAR = 100_000  # px between tiles laid side by side for the corner figures


class Found(NamedTuple):
    """What a method finds in one tile: labels (s, s), scores, corners (n, 2 px)."""

    labels: np.ndarray
    scores: np.ndarray
    corners: np.ndarray


def sets(data: Path, count: int, per_place: int, gsd: float) -> dict[str, list[Sample]]:
    """The samples of every set at the models' GSD, always the same ones."""
    photographed = validation.photographed(data, data / "roofgraph" / "roofgraph.tar", count, SIDE, gsd)
    found = {
        # As it is known: they were taken from above.
        "B photographs": [sample._replace(geometry=dataset.NADIR.copy()) for sample in photographed],
        "village": validation.village(data / "village", VILLAGE, gsd),
    }
    places: dict[str, list[photographs.Chip]] = {}
    for chip in photographs.read_chips(data / "chips"):
        places.setdefault(chip.name.split("/")[0], []).append(chip)
    for place, chips in places.items():
        windows = [sample for chip in chips for sample in cut(chip, gsd)]
        step = max(1, len(windows) // per_place)
        found[f"C {place}"] = windows[::step][:per_place]
    return {name: [middle(sample) for sample in samples] for name, samples in found.items()}


def cut(chip: photographs.Chip, gsd: float) -> list[Sample]:
    """Windows of a chip at `gsd`, side by side: roofs known, nothing else."""
    scale = chip.gsd / gsd
    size = tuple(max(SIDE, round(n * scale)) for n in chip.building.shape[::-1])
    rgb = cv2.resize(chip.rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    building = cv2.resize(chip.building.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    samples = []
    for row in range(0, size[1] - SIDE + 1, SIDE):
        for col in range(0, size[0] - SIDE + 1, SIDE):
            part = np.s_[row : row + SIDE, col : col + SIDE]
            roof = np.ascontiguousarray(building[part])
            samples.append(
                Sample.ground(np.ascontiguousarray(rgb[part]))._replace(
                    labels=-roof.astype(np.int32), roof=roof, corners_known=np.zeros_like(roof)
                )
            )
    return samples


def middle(sample: Sample) -> Sample:
    """The middle SIDE px of a sample."""
    before = (sample.labels.shape[0] - SIDE) // 2
    return sample.window(before, before, SIDE)


class Runner:
    """A method's networks, open for one geometry at a time; counts the seconds they take."""

    def __init__(self, method: Method):
        self.method, self.seconds, self.tiles = method, 0.0, 0
        self._open: dict[bytes, list[tuple[contracts.Model, runtime.Network]]] = {}

    def networks(self, geometry: np.ndarray) -> list[tuple[contracts.Model, runtime.Network]]:
        """The models for sections and corners (one, twice, if it does both) that a geometry (6,) gets, and their networks."""
        key = geometry.tobytes()
        if key not in self._open:
            models = self.method.models(seen_from(geometry, self.method.contract["gsd"]))
            networks = {m.sha256: runtime.open_network(m, geometry[None], threads=1) for m in models}
            self._open = {key: [(model, networks[model.sha256]) for model in models]}
        return self._open[key]

    def __call__(self, sample: Sample) -> Found:
        """Sections and corners of one sample, its rim mirrored up to the model's tile."""
        (first, find_sections), (second, find_corners) = self.networks(sample.geometry)
        tile = first.contract["tile"]
        before = (tile - SIDE) // 2
        rest = tile - SIDE - before
        rgb = np.pad(sample.rgb, ((before, rest), (before, rest), (0, 0)), mode="symmetric")
        start = time.process_time()  # of one thread: what else runs on the machine does not count
        sections = outputs = find_sections(rgb)
        found = heads.decode_sections(sections, first.contract, rgb)
        if second is not first:
            outputs = find_corners(blend(rgb, found.labels, **second.contract["blend"]))
        corners = heads.decode_corners(outputs, second.contract)
        self.seconds += time.process_time() - start
        self.tiles += 1
        place = np.column_stack([corners.col, corners.row]) - before
        judged = heads.alone(found, sections, first.contract)
        labels = judged.labels[before : before + SIDE, before : before + SIDE]
        return Found(labels, judged.scores, place[((place >= 0) & (place < SIDE)).all(axis=1)])


def seen_from(geometry: np.ndarray, gsd: float) -> dict[str, float] | None:
    """Azimuth and elevation (deg) of the view that a geometry vector (6,) tells, at `gsd` (m/px); None where it tells none."""
    if not geometry[4]:
        return None
    col, row = geometry[:2].astype(float) * gsd
    return {
        "azimuth": float(np.degrees(np.arctan2(-col, row)) % 360),
        "elevation": float(np.degrees(np.arctan2(1.0, np.hypot(col, row)))),
    }


def figures(samples: Sequence[Sample], found: Sequence[Found]) -> dict[str, Any]:
    """Pixel IoU and, where sections or corners are known, their figures; all tiles together."""
    pairs = [(f.labels > 0, s.roof) for f, s in zip(found, samples, strict=True)]
    result: dict[str, Any] = {"tiles": len(samples), "iou": validation.roof_iou(pairs)}
    if any((sample.labels > 0).any() for sample in samples):
        result |= section_figures(samples, found)
    if any(len(sample.corners) for sample in samples):
        result |= corner_figures(samples, found)
    return result


def section_figures(samples: Sequence[Sample], found: Sequence[Found]) -> dict[str, Any]:
    """AP50, mean best IoU, PQ. What lies mostly on unknown ground or on sections too small to ask for is left out."""
    tallies, scores, true_ids, found_ids = [], [], 0, 0
    for sample, one in zip(samples, found, strict=True):
        truth = np.maximum(sample.labels, 0)
        area = np.bincount(truth.ravel())
        unknown = (sample.labels < 0) | ((truth > 0) & (area[truth] < validation.SMALLEST))
        size = np.bincount(one.labels.ravel(), minlength=len(one.scores) + 1)
        off = np.bincount(one.labels.ravel(), unknown.ravel(), len(one.scores) + 1) > 0.5 * np.maximum(size, 1)
        labels = np.where(unknown | off[one.labels], 0, one.labels)
        truth = np.where(unknown, 0, truth)
        tally = metrics.count_pairs(
            np.where(truth > 0, truth + true_ids, 0), np.where(labels > 0, labels + found_ids, 0)
        )
        tallies.append(tally)
        scores.append(one.scores)
        true_ids += int(truth.max(initial=0))
        found_ids += len(one.scores)
    pairs = metrics.merge_pairs(tallies)
    ids = np.unique(pairs.predicted[pairs.predicted > 0])
    score = np.concatenate(scores)[ids - 1].astype(float)
    over = metrics.overlaps(pairs, score)
    all_figures = metrics.section_figures(
        over, score, np.ones(len(over.truth), bool), np.ones(len(over.predicted), bool)
    )
    return {key: all_figures[key] for key in ("truth", "predicted", "ap50", "mean_best_iou", "pq")}


def corner_figures(samples: Sequence[Sample], found: Sequence[Found]) -> dict[str, Any]:
    """Precision and recall of corners at 2 px where corners are known."""
    true, guessed = [], []
    for i, (sample, one) in enumerate(zip(samples, found, strict=True)):
        col, row = np.floor(one.corners).astype(int).T
        known = sample.corners_known[row, col] > 0
        beside = np.array([i * FAR, 0.0])
        true.append(sample.corners + beside)
        guessed.append(one.corners[known] + beside)
    sides = [np.concatenate(places).reshape(-1, 2) for places in (true, guessed)]
    corners = [metrics.Corners(side, np.zeros(len(side)), np.ones(len(side), bool)) for side in sides]
    judged = metrics.corner_figures(*corners)
    return {"corner_precision": judged["precision"], "corner_recall": judged["recall"]}
