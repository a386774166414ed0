"""How good a pair of models is on scenes it was not trained on: roofs, sections, corners and their heights.

In: ONNX models and validation samples (simulated scenes of fixed seeds, held-out roof photographs, real village scenes).
Out: a report by test set, and pictures to look at. Decoding is the product's own (`models.heads`).
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import rasterio
from scipy import ndimage
from scipy.spatial import cKDTree

from kibs_steps import cli, photographs, store
from kibs_steps.blend import blend
from kibs_steps.labels import rims
from kibs_steps.learn import calibration, dataset
from kibs_steps.learn.samples import UNKNOWN, Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import heads, runtime

SMALLEST = 12  # px: smaller true sections are neither asked for nor held against a model


Decoded = tuple[Sequence[dict[str, np.ndarray]], Sequence[Sample]]  # a model's maps of the samples of a set


class Match(NamedTuple):
    """Detections of many tiles: scores (n,), whether each matches a section not taken before; number of true sections."""

    scores: np.ndarray
    hits: np.ndarray
    truths: int


def matches(found: np.ndarray, scores: np.ndarray, truth: np.ndarray, overlap: float = 0.5) -> Match:
    """Detections (labels 1…n with scores) against true labels of one tile, best scores first.

    A detection lying mostly on unknown ground (−1) or on sections too small to ask for is left out.
    """
    area = np.bincount(np.maximum(truth, 0).ravel())
    small = np.isin(truth, np.flatnonzero(area < SMALLEST)) & (truth > 0)
    unknown = (truth < 0) | small
    asked = np.where(unknown, 0, truth)
    wanted, inverse = np.unique(asked, return_inverse=True)
    index = inverse.reshape(asked.shape)
    n = int(found.max(initial=0))
    joint = np.zeros((n + 1, len(wanted)))
    np.add.at(joint, (found.ravel(), index.ravel()), 1)
    size = joint.sum(1)
    off = np.bincount(found.ravel(), unknown.ravel(), n + 1)
    union = size[:, None] + joint.sum(0)[None] - joint
    iou = np.where(wanted[None] > 0, joint / np.maximum(union, 1), 0.0)
    taken = np.zeros(len(wanted), bool)
    judged, hits = [], []
    for label in sorted(range(1, n + 1), key=lambda i: (-scores[i - 1], i)):
        free = np.where(taken, 0.0, iou[label])
        best = int(free.argmax())
        hit = free[best] >= overlap
        if not hit and off[label] > 0.5 * size[label]:
            continue
        taken[best] |= hit
        judged.append(scores[label - 1])
        hits.append(hit)
    return Match(np.array(judged), np.array(hits, bool), int((wanted > 0).sum()))


def average_precision(results: Iterable[Match]) -> float:
    """Area under the precision–recall curve of all tiles together (precision made non-increasing)."""
    results = list(results)
    truths = sum(r.truths for r in results)
    scores = np.concatenate([r.scores for r in results])
    hits = np.concatenate([r.hits for r in results])[np.argsort(-scores, kind="stable")]
    if not truths or not hits.size:
        return 0.0
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    return float((precision * hits).sum() / truths)


def roof_iou(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """IoU of found (bool) and true (0, 1, 255 unknown) roof pixels over all tiles."""
    both = either = 0
    for found, truth in pairs:
        known, true = truth != UNKNOWN, truth == 1
        both += (found & true & known).sum()
        either += ((found | true) & known).sum()
    return float(both / max(either, 1))


def on_roofs(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Share of found sections (labels 1…n) that are more than half true roof (0, 1, 255 unknown).

    Those that lie mostly on unknown ground are not asked; of the others their known part is.
    """
    asked = on = 0
    for found, truth in pairs:
        size = np.bincount(found.ravel(), minlength=1)[1:]
        known = np.bincount(found[truth != UNKNOWN], minlength=len(size) + 1)[1:]
        roof = np.bincount(found[truth == 1], minlength=len(size) + 1)[1:]
        judged = (size > 0) & (2 * known >= size)
        asked += judged.sum()
        on += (judged & (2 * roof > known)).sum()
    return float(on / max(asked, 1))


def village(folder: str | Path, size: int, gsd: float = dataset.GSD) -> list[Sample]:
    """The real village scenes at `gsd`, mirrored at the border to (size, size); the rim beyond is unknown.

    Connected areas of one slope orientation are sections; roof without an orientation has unknown sections.
    """
    samples = []
    for path in sorted(Path(folder).glob("*_labels.png")):
        image = next(p for p in Path(folder).glob(path.name.replace("_labels.png", "_rgb.*")))
        rgb = _photograph(image)
        marked = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        orientation, roof = (marked, marked > 0) if marked.ndim == 2 else (marked[..., 1], marked[..., 2] > 0)
        side = round(rgb.shape[0] * 0.1 / gsd)
        small = cv2.resize(rgb, (side, side), interpolation=cv2.INTER_AREA)
        slope = cv2.resize(orientation, (side, side), interpolation=cv2.INTER_NEAREST)
        roof = cv2.resize(roof.astype(np.uint8), (side, side), interpolation=cv2.INTER_NEAREST)
        labels = -roof.astype(np.int32)
        for value in np.unique(slope[slope > 0]):
            part, _ = ndimage.label(slope == value)
            labels[part > 0] = part[part > 0] + max(labels.max(), 0)
        before = (size - side) // 2
        around = (before, size - side - before)
        mirrored = np.pad(small, (around, around, (0, 0)), mode="symmetric")
        sample = Sample.ground(mirrored)
        samples.append(
            sample._replace(
                labels=np.pad(labels, around, constant_values=-1),
                roof=np.pad((labels != 0).astype(np.uint8), around, constant_values=UNKNOWN),
                geometry=dataset.NADIR.copy(),
                corners_known=np.zeros((size, size), np.uint8),
            )
        )
    return samples


def _photograph(path: Path) -> np.ndarray:
    """The first three bands of a PNG or TIFF, (h, w, 3)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            return np.ascontiguousarray(file.read([1, 2, 3]).transpose(1, 2, 0))


def simulated(count: int, size: int, view_elevation: tuple[float, float], gsd: float = dataset.GSD) -> list[Sample]:
    """Simulated scenes of seeds no training uses, seen from the elevations (deg) given."""
    return [
        dataset.simulated(np.random.default_rng([424242, i]), size, view_elevation=view_elevation, gsd=gsd)
        for i in range(count)
    ]


def photographed(data: Path, source: Path, count: int, size: int, gsd: float = dataset.GSD) -> list[Sample]:
    """Held-out roof photographs pasted into chips; unlike in training, the radiometry is left as it is.

    They alone are judged, with the sure ground about them: what a chip shows is context, its mask too coarse to judge rims by.
    """
    graphs = [graph for graph in photographs.read_roof_graphs(source) if photographs.held_out(graph)]
    chips = photographs.read_chips(data / "chips")
    samples = []
    for i in range(count):
        rng = np.random.default_rng([434343, i])
        ground = dataset.without_truth(dataset.chip_sample(chips[rng.integers(len(chips))], rng, size, gsd))
        samples.append(dataset.pasted_houses(ground, graphs, rng, gsd=gsd))
    return samples


def raw_sections(model: contracts.Model, samples: Sequence[Sample]) -> list[dict[str, np.ndarray]]:
    """A sections model's maps of every sample."""
    return [runtime.open_network(model, sample.geometry[None], threads=1)(sample.rgb) for sample in samples]


def judge_sections(
    found: Sequence[heads.Sections],
    samples: Sequence[Sample],
) -> dict[str, float]:
    """Roof IoU of all sections together, AP at overlaps 0.5 and 0.75, share on roofs, true and found sections."""
    results = [matches(f.labels, f.scores, s.labels) for f, s in zip(found, samples, strict=True)]
    strict = [matches(f.labels, f.scores, s.labels, 0.75) for f, s in zip(found, samples, strict=True)]
    return {
        "roof_iou": roof_iou((f.labels > 0, s.roof) for f, s in zip(found, samples, strict=True)),
        "ap50": average_precision(results),
        "ap75": average_precision(strict),
        "on_roofs": on_roofs((f.labels, s.roof) for f, s in zip(found, samples, strict=True)),
        "truths": sum(r.truths for r in results),
        "found": sum(len(r.scores) for r in results),
    }


def best_decoding(sets: Sequence[Decoded], contract: dict[str, Any]) -> tuple[dict[str, float], dict[str, Any] | None]:
    """Thresholds `roof` and `prominence` by trying a grid, and the `score` that fits them (`learn.calibration`).

    Every pair is judged by the sum of roof IoU and AP at overlap 0.5 (by mean roof probability), the mean over the sets of
    (maps, samples): a small set counts as much as a large one.
    """

    def decoding(roof: float, prominence: float) -> dict[str, Any]:
        thresholds = {**contract["thresholds"], "roof": roof, "prominence": prominence}
        return {**{k: v for k, v in contract.items() if k != "score"}, "thresholds": thresholds}

    def judged(roof: float, prominence: float) -> float:
        total, terms = 0.0, decoding(roof, prominence)
        for one in sets:
            shown = list(zip(*one, strict=True))
            found = [heads.decode_sections(maps, terms, sample.rgb) for maps, sample in shown]
            results = [matches(f.labels, f.scores, s.labels) for f, (_, s) in zip(found, shown, strict=True)]
            total += average_precision(results) + roof_iou((m["roof"][0] > roof, s.roof) for m, s in shown)
        return total

    rises = (contract["thresholds"]["prominence"],) if "join" in contract else (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    grid = [(roof, rise) for roof in (0.35, 0.45, 0.55, 0.65) for rise in rises]
    roof, prominence = max(grid, key=lambda pair: judged(*pair))
    every = (pair for one in sets for pair in zip(*one, strict=True))
    return {"roof": roof, "prominence": prominence}, calibration.score(every, decoding(roof, prominence))


def judge_corners(
    model: contracts.Model,
    samples: Sequence[Sample],
    sections: Sequence[np.ndarray],
    reach: float = 3.0,
) -> dict[str, float]:
    """Corners on images blended with `sections`, on plain ones for a model of both tasks.

    Share of true corners found within `reach` px and the reverse, error of position (px), of height (m; bias, mean absolute)
    and how many σ the heights are off (root mean square).
    """
    near = far = asked = given = 0
    offs, heights, sigmas = [], [], []
    for sample, labels in zip(samples, sections, strict=True):
        image = blend(sample.rgb, labels, **model.contract["blend"]) if "blend" in model.contract else sample.rgb
        found = heads.decode_corners(runtime.open_network(model, sample.geometry[None])(image), model.contract)
        points = np.stack([found.col, found.row], axis=1)
        asked += len(sample.corners)
        given += len(points)
        if not len(points) or not len(sample.corners):
            continue
        distance, which = cKDTree(points).query(sample.corners)
        hit = distance <= reach
        near += hit.sum()
        far += (cKDTree(sample.corners).query(points)[0] <= reach).sum()
        offs.append(distance[hit])
        known = hit & np.isfinite(sample.corner_heights)
        heights.append(found.height[which[known]] - sample.corner_heights[known])
        sigmas.append(found.sigma[which[known]])
    error = np.concatenate(heights) if heights else np.zeros(0)
    report = {"recall": near / max(asked, 1), "precision": far / max(given, 1)}
    if near:
        report["position"] = float(np.concatenate(offs).mean())
    if error.size:
        report["height_bias"] = float(error.mean())
        report["height_mae"] = float(np.abs(error).mean())
        report["height_in_sigma"] = float(np.sqrt(np.mean((error / np.concatenate(sigmas)) ** 2)))
    return {k: float(v) for k, v in report.items()}


def picture(
    sample: Sample, raw: dict[str, np.ndarray], found: heads.Sections, corners: np.ndarray | None = None
) -> np.ndarray:
    """Side by side, uint8 RGB: image; truth; roof probability (red), edge (green), distance (blue); what was found."""
    truth, outcome = sample.rgb.copy(), sample.rgb.copy()
    truth[rims(sample.labels)] = (255, 0, 0)
    truth[sample.labels < 0] //= 2
    outcome[rims(found.labels)] = (255, 0, 0)
    for col, row in corners if corners is not None else ():
        cv2.circle(outcome, (int(col), int(row)), 1, (0, 255, 0), -1)
    maps = np.stack([raw["roof"][0], raw["edge"][0], raw["distance"][0]], axis=2)
    return np.hstack([sample.rgb, truth, (maps * 255).astype(np.uint8), outcome])


def main(argv: list[str] | None = None) -> None:
    """Judge a pair of models on the validation sets."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.validation", description=main.__doc__)
    parser.add_argument("--sections", required=True, help="ONNX file")
    parser.add_argument("--corners", help="ONNX file")
    parser.add_argument("--data", required=True, help="data folder with village/, chips/, roofgraph/")
    parser.add_argument("--roofgraph", help="tar or extracted folder, if not DATA/roofgraph/roofgraph.tar")
    parser.add_argument("--elevation", type=float, default=59.3, help="of the view in the oblique test set, deg")
    parser.add_argument("--count", type=int, default=12, help="simulated and pasted scenes each")
    parser.add_argument("--out", required=True, help="report, JSON")
    parser.add_argument("--pictures", help="folder for one picture per test set")
    parser.add_argument("--choose", action="store_true", help="first choose thresholds and fit the score on these sets")
    args = parser.parse_args(argv)
    model = contracts.load(args.sections, "sections")
    corner_model = contracts.load(args.corners, "corners") if args.corners else None
    data, size, gsd = Path(args.data), model.contract["tile"], model.contract["gsd"]
    sets = {
        "village": village(data / "village", size, gsd),
        "photographed": photographed(
            data, Path(args.roofgraph or data / "roofgraph" / "roofgraph.tar"), args.count, size, gsd
        ),
        "simulated": simulated(args.count, size, (50.0, 90.0), gsd),
        "simulated_oblique": simulated(args.count, size, (args.elevation, args.elevation), gsd),
    }
    raw_maps = {name: raw_sections(model, samples) for name, samples in sets.items()}
    report: dict[str, Any] = {}
    if args.choose:
        chosen = [(raw_maps[name], sets[name]) for name in ("village", "simulated", "simulated_oblique")]
        report["thresholds"], report["score"] = best_decoding(chosen, model.contract)
        model.contract["thresholds"].update(report["thresholds"])
        model.contract["score"] = report["score"]
        print(report["thresholds"], report["score"])
    for name, samples in sets.items():
        raw = raw_maps[name]
        found = [
            heads.alone(heads.decode_sections(maps, model.contract, sample.rgb), maps, model.contract)
            for maps, sample in zip(raw, samples, strict=True)
        ]
        report[name] = judge_sections(found, samples)
        if corner_model and name.startswith("simulated"):
            report[name]["corners"] = judge_corners(corner_model, samples, [f.labels for f in found])
            report[name]["corners_true_sections"] = judge_corners(corner_model, samples, [s.labels for s in samples])
        if args.pictures:
            sheet = np.vstack([picture(s, r, f) for s, r, f in list(zip(samples, raw, found, strict=True))[:6]])
            with store.whole(Path(args.pictures) / f"{name}.png", summed=False) as temporary:
                cv2.imwrite(str(temporary), sheet[..., ::-1])
        print(name, {k: round(v, 3) if isinstance(v, float) else v for k, v in report[name].items()}, flush=True)
    store.write_json(args.out, report, summed=False)


if __name__ == "__main__":
    cli.run(main)
