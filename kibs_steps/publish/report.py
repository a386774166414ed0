"""Report: one HTML page about a scene that can be mailed: what was made, how well, of what, and what failed.

In: `run.json`, `evaluation.json` where there is truth, the scene's pictures. Out: `report.html`, pictures inside, no script.
"""

from __future__ import annotations

import argparse
import base64
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from kibs_steps import cli, store

PICTURES = {"preview.png": "Roof sections found", "evaluation.png": "Comparison with the truth"}
STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{padding:.15em 1em .15em 0;text-align:left;border-bottom:1px solid #ddd}"
    "td.n{text-align:right}img{max-width:100%}.bad{color:#a4262c}"
)


def table(title: str, rows: Mapping[str, Any]) -> str:
    """A heading and a table of two columns; nothing where there is nothing to show."""
    if not rows:
        return ""
    cells = "".join(f'<tr><td>{escape(str(k))}</td><td class="n">{escape(_text(v))}</td></tr>' for k, v in rows.items())
    return f"<h2>{escape(title)}</h2><table>{cells}</table>"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "unknown" if value is None else str(value)


def _identity(item: Mapping[str, Any]) -> tuple[str, str]:
    """An input's name and what tells its content: sha256, or a remote source's version."""
    return item["file"], item.get("sha256") or ", ".join(str(part) for part in item["version"] if part)


def page(run: Mapping[str, Any], evaluation: Mapping[str, Any] | None, pictures: Mapping[str, bytes]) -> str:
    """The page; `pictures` are PNG files by title."""
    scene, found = run["scene"], run["results"]
    grid = scene["grid"]
    name = escape(scene["name"])
    parts = [f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}</title><style>{STYLE}</style>']
    parts.append(
        f"<h1>{name}</h1><p>Made {escape(run['written'])}. Licence of the models: {escape(run['licence'] or 'none')}.</p>"
    )
    failed = {block: state["reason"] for block, state in run.get("failed_blocks", {}).items()}
    if failed:
        parts.append('<p class="bad">The city is made without the blocks that failed.</p>')
    parts.append(table("Blocks that failed", failed))
    area = grid["width"] * grid["height"] * grid["gsd"] ** 2 / 1e6
    view, regions = scene["view"], scene.get("regions")
    seen = [f"azimuth {view['azimuth']:g}°, elevation {view['elevation']:g}°"] if view else []
    seen += [f"{len(regions)} regions with views of their own"] if regions else []
    facts = {
        "grid": f"{grid['width']} x {grid['height']} px of {grid['gsd']:g} m, {area:.2f} km²",
        "view": " and ".join(seen) or "unknown",
        "roofs moved to where they stand": "yes" if scene["position_corrected"] else "no",
    }
    parts.append(table("Scene", facts))
    for title, data in pictures.items():
        parts.append(f"<h2>{escape(title)}</h2>")
        parts.append(f'<img alt="{escape(title)}" src="data:image/png;base64,{base64.b64encode(data).decode()}">')
    sections, buildings = found["sections"], found["buildings"]
    parts.append(table(f"{sections['count']} roof sections by status", sections["status"]))
    parts.append(table("Why sections are less than they could be", sections["reasons"]))
    parts.append(table(f"{buildings['count']} buildings by level of detail", buildings["lod"]))
    parts.append(table("Kinds of roof", buildings["roof_type"]))
    parts.append(table("Why buildings are less than they could be", buildings["reasons"]))
    if evaluation:
        parts.append(table("Against the truth: pixels", evaluation["pixels"]["all"]))
        parts.append(table("Against the truth: heights where found", evaluation["heights"]["found"]["all"]))
    spent = {
        step: f"{t['seconds']:.1f} s in {t['jobs']} jobs, up to {t['peak_mb']:.0f} MB"
        for step, t in run["times"].items()
    }
    parts.append(table("Time of all steps but the formats", spent))
    parts.append(table("Inputs (sha256; of remote ones what their server says)", dict(map(_identity, run["inputs"]))))
    parts.append(table("Models (sha256)", {item["file"]: item["sha256"] for item in run["models"]}))
    parts.append(table("Versions", run["versions"]))
    return "\n".join(part for part in parts if part) + "\n"


def main(argv: list[str] | None = None) -> None:
    """Write a scene's report."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.report", description=main.__doc__)
    parser.add_argument("--run", required=True, help="run.json; pictures are taken from beside it")
    parser.add_argument("--evaluation", help="evaluation.json")
    parser.add_argument("--out", required=True, help="out: report.html")
    args = parser.parse_args(argv)
    folder = Path(args.run).parent
    shown = {name: title for name, title in PICTURES.items() if args.evaluation or name != "evaluation.png"}
    pictures = {title: (folder / name).read_bytes() for name, title in shown.items() if (folder / name).is_file()}
    evaluation = store.read_json(args.evaluation) if args.evaluation else None
    with store.whole(args.out) as temporary:
        temporary.write_text(page(store.read_json(args.run), evaluation, pictures), encoding="utf-8")


if __name__ == "__main__":
    cli.run(main)
