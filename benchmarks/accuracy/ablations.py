"""Why the networks are as they are: short runs that differ in one thing each, judged on the same scenes.

`python -m benchmarks.accuracy.ablations --data $KIBS_DATA --pool POOL --minutes 10 --out ablations.json`. All runs start at the
encoder's ImageNet weights and see the same tiles for the same time. A killed benchmark goes on where it was. Out: a JSON file and
a Markdown table beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kibs_steps import cli, store
from kibs_steps.learn import export, training, validation
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts
from kibs_steps.models import heads


class Ablation(NamedTuple):
    """A run: its name, options of `learn.training`, what it is judged as, and whether it is told view and sun."""

    name: str
    options: tuple[str, ...]
    judged: tuple[str, ...]
    told: bool = True


SECTIONS, CORNERS = ("--task=sections",), ("--task=corners", "--shares=chips=0")
RUNS = (
    Ablation("sections", SECTIONS, ("sections",)),
    Ablation("sections, image not enlarged", (*SECTIONS, "--zoom=1"), ("sections",)),
    Ablation("sections, half the resolution (maps at stride 2)", (*SECTIONS, "--zoom=0.5"), ("sections",)),
    Ablation("sections, no roof photographs pasted", (*SECTIONS, "--shares=pasted=0"), ("sections",)),
    Ablation("sections, view and sun not told", (*SECTIONS, "--forget=1"), ("sections",), told=False),
    Ablation("corners", CORNERS, ("corners",)),
    Ablation("corners, view and sun not told", (*CORNERS, "--forget=1"), ("corners",), told=False),
    Ablation("one network for both", (), ("sections", "corners", "both")),
)
TITLES = {
    "roof_iou": "roof IoU",
    "ap50": "AP50",
    "recall": "corners found",
    "precision": "corners right",
    "height_mae": "height MAE, m",
}
AS = {"sections": "sections", "corners": "corners, true sections painted in", "both": "corners, plain image"}


def train(run: Ablation, folder: Path, common: Sequence[str]) -> dict[str, contracts.Model]:
    """Train (or go on), export as each of the models it is judged as."""
    place = folder / run.name.replace(" ", "_").replace(",", "")
    training.main([*common, *run.options, f"--out={place}"])
    models = {}
    for task in run.judged:
        export.main([f"--checkpoint={place / 'checkpoint.pt'}", f"--task={task}", f"--out={place / task}.onnx"])
        models[task] = contracts.load(place / f"{task}.onnx", task)
    return models


def judge(run: Ablation, models: dict[str, contracts.Model], sets: dict[str, list[Sample]]) -> list[dict[str, Any]]:
    """Rows of figures by set: sections with the decoding that suits the network best, corners where sections are true ones."""
    if not run.told:
        sets = {n: [s._replace(geometry=np.zeros(6, np.float32)) for s in samples] for n, samples in sets.items()}
    rows = []
    if "sections" in models:
        model = models["sections"]
        raw = {name: validation.raw_sections(model, samples) for name, samples in sets.items()}
        shown = [(raw[name], sets[name]) for name in sets if name != "photographed"]
        thresholds, score = validation.best_decoding(shown, model.contract)
        chosen = {**model.contract, "thresholds": {**model.contract["thresholds"], **thresholds}, "score": score}
        for name, samples in sets.items():
            found = [
                heads.alone(heads.decode_sections(maps, chosen, sample.rgb), maps, chosen)
                for maps, sample in zip(raw[name], samples, strict=True)
            ]
            figures = validation.judge_sections(found, samples)
            rows.append({"run": run.name, "as": AS["sections"], "set": name, **figures})
    for task in ("corners", "both"):
        if task in models:
            for name in (n for n in sets if n.startswith("simulated")):
                figures = validation.judge_corners(models[task], sets[name], [s.labels for s in sets[name]])
                rows.append({"run": run.name, "as": AS[task], "set": name, **figures})
    return rows


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table: a line for each run, what it is judged as, and set."""
    lines = [
        "| run | steps | as | set | " + " | ".join(TITLES.values()) + " |",
        "|---|---|---|---|" + "---|" * len(TITLES),
    ]
    for row in rows:
        cells = [f"{row[key]:.3f}" if key in row else "–" for key in TITLES]
        lines.append(f"| {row['run']} | {row['steps']} | {row['as']} | {row['set']} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def main(argv: list[str] | None = None) -> None:
    """Train and judge all ablations."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.ablations", description=main.__doc__)
    parser.add_argument("--data", required=True, type=Path, help="data folder with village/, chips/, roofgraph/")
    parser.add_argument("--pool", required=True, help="folder of simulated tiles")
    parser.add_argument("--tiles", type=int, default=0, help="tiles to render into the pool first")
    parser.add_argument("--minutes", type=float, default=10, help="budget of each run")
    parser.add_argument("--count", type=int, default=6, help="simulated and pasted scenes each")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--work", type=Path, default=Path("runs/ablations"), help="folder for what is kept between runs"
    )
    parser.add_argument("--out", required=True, type=Path, help="out: JSON file; a Markdown file lies beside it")
    args = parser.parse_args(argv)
    size = export.TILE
    sets = {
        "village": validation.village(args.data / "village", size),
        "photographed": validation.photographed(args.data, args.data / "roofgraph" / "roofgraph.tar", args.count, size),
        "simulated": validation.simulated(args.count, size, (50.0, 90.0)),
        "simulated_oblique": validation.simulated(args.count, size, (59.3, 59.3)),
    }
    common = [f"--{key}={getattr(args, key)}" for key in ("data", "pool", "tiles", "minutes", "threads")]
    rows: list[dict[str, Any]] = []
    for run in RUNS:
        models = train(run, args.work, common)
        steps = next(iter(models.values())).contract["trained_on"]["tiles_seen"] // 8
        rows += [{**row, "steps": steps} for row in judge(run, models, sets)]
        store.write_json(args.out, rows, summed=False)
        with store.whole(args.out.with_suffix(".md"), summed=False) as temporary:
            temporary.write_text(markdown(rows), encoding="utf-8")
    print(markdown(rows))


if __name__ == "__main__":
    cli.run(main)
