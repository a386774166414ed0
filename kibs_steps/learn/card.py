"""Card: the page that goes with trained models, and the curves of their training.

In: ONNX models with their contracts, `done.json` of the runs they come from, and the runs' TensorBoard logs. Out: `README.md` and
`curves.png`, one panel per loss term, the validation loss first.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from kibs_steps import cli, store
from kibs_steps.models import contract as contracts

PANEL, GAP = (300, 150), 12  # px
INK, LINE, PAPER = (90, 90, 90), (46, 98, 178), (255, 255, 255)

Curve = tuple[np.ndarray, np.ndarray]  # steps, values


def curves(folder: str | Path) -> dict[str, Curve]:
    """All scalars of a TensorBoard log by name; where a resumed run wrote a step twice the later value counts."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    log.Reload()
    found = {}
    for name in sorted(log.Tags()["scalars"]):
        values = {event.step: event.value for event in log.Scalars(name)}
        steps = np.array(sorted(values))
        found[name] = (steps, np.array([values[step] for step in steps.tolist()]))
    return found


def smoothed(values: np.ndarray, over: int = 15) -> np.ndarray:
    """Running mean over the last values, fewer at the start."""
    total = np.cumsum(np.insert(values.astype(float), 0, 0.0))
    first = np.maximum(np.arange(len(values)) - over + 1, 0)
    return (total[1:] - total[first]) / (np.arange(len(values)) - first + 1)


def draw(path: str | Path, found: dict[str, Curve]) -> None:
    """The curves as panels, two in a row."""
    from PIL import Image, ImageDraw

    names = sorted(found, key=lambda name: (not name.endswith("validation/loss"), name))
    rows = max(1, -(-len(names) // 2))
    page = Image.new("RGB", (2 * PANEL[0] + 3 * GAP, rows * (PANEL[1] + GAP) + GAP), PAPER)
    pen = ImageDraw.Draw(page)
    for i, name in enumerate(names):
        steps, values = found[name]
        values = values if "validation" in name else smoothed(values)
        x, y = GAP + (i % 2) * (PANEL[0] + GAP), GAP + (i // 2) * (PANEL[1] + GAP)
        low, high = float(values.min()), float(values.max())
        pen.text((x, y), f"{name}   {values[-1]:.3g}   (to step {steps[-1]})", INK)
        top, bottom = y + 18, y + PANEL[1]
        pen.rectangle((x, top, x + PANEL[0], bottom), outline=(215, 215, 215))
        across = x + 2 + (steps - steps[0]) / max(steps[-1] - steps[0], 1) * (PANEL[0] - 4)
        down = bottom - 3 - (values - low) / max(high - low, 1e-12) * (PANEL[1] - 24)
        pen.line(list(zip(across.tolist(), down.tolist(), strict=True)), LINE, 2)
    with store.whole(path, summed=False) as temporary:
        page.save(temporary, "PNG")


def text(name: str, models: list[contracts.Model], runs: list[dict[str, Any]]) -> str:
    """The card of a set, Markdown."""
    trained = models[0].contract["trained_on"]
    lines = [
        f"# Models `{name}`",
        "",
        f"Licence: **{trained['licence']}**. Trained on: {'; '.join(trained['data'])}.",
        "",
        "| file | task | head | GSD, m | tile, px | MB |",
        "|---|---|---|---|---|---|",
    ]
    for model in models:
        c = model.contract
        size = model.path.stat().st_size / 1e6
        lines.append(f"| `{model.path.name}` | {c['task']} | {c['head']} | {c['gsd']:g} | {c['tile']} | {size:.1f} |")
    lines += ["", "| network | steps | seed | size, px | batch |", "|---|---|---|---|---|"]
    for run in runs:
        s = run["settings"]
        lines.append(f"| {s['family']}, {s['task']} | {run['steps']} | {s['seed']} | {s['size']} | {s['batch']} |")
    ranges = [
        f"{key.replace('_', ' ')} {trained[key][0]:g} to {trained[key][1]:g}°"
        for key in ("view_elevation", "view_azimuth", "sun_elevation", "sun_azimuth")
        if key in trained
    ]
    lines += ["", "Angles: " + ("; ".join(ranges) or "not known") + "."]
    if kept := {name: m.path.name for m in models for name in contracts.untold(m)}:
        network = next(iter(kept.values()))
        lines += [
            "",
            f"`{network}` is told no {' and no '.join(kept)}: it is for images of which that is not known.",
        ]
    lines.append("")
    metrics = next((m.contract["metrics"] for m in models if m.contract.get("metrics")), None)
    if metrics:
        lines += ["| test set | figures |", "|---|---|"]
        for test, figures in metrics.items():
            said = [f"{k} {v:.3f}" for k, v in figures.items() if isinstance(v, float)]
            lines.append(f"| {test} | {', '.join(said)} |")
        lines.append("")
    return "\n".join([*lines, "Curves of training: `curves.png`. Use: `models=" + name + "`.", ""])


def main(argv: list[str] | None = None) -> None:
    """Write the card and the curves of trained models."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.card", description=main.__doc__)
    parser.add_argument("--models", required=True, nargs="+", help="ONNX files of one set")
    parser.add_argument("--runs", required=True, nargs="+", help="done.json of the runs")
    parser.add_argument("--card", required=True, help="out: README.md")
    parser.add_argument("--curves", required=True, help="out: curves.png")
    args = parser.parse_args(argv)
    found: dict[str, Curve] = {}
    for path in map(Path, args.runs):
        prefix = f"{path.parent.name}: " if len(args.runs) > 1 else ""
        found |= {prefix + name: curve for name, curve in curves(path.parent / "log").items()}
    draw(args.curves, {name: curve for name, curve in found.items() if not name.endswith("rate")})
    models = [contracts.load(path) for path in args.models]
    with store.whole(args.card, summed=False) as temporary:
        temporary.write_text(
            text(Path(args.card).parent.name, models, [store.read_json(p) for p in args.runs]), encoding="utf-8"
        )


if __name__ == "__main__":
    cli.run(main)
