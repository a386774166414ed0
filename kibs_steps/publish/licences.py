"""Licences: under which terms a scene's results may be used, as its models say.

In: `models/*.json` as `models.contract` writes them. Out: one line, shown at the start and written into the outputs.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from kibs_steps import store


def line(models: Iterable[str | Path]) -> str:
    """`sections.onnx: licence; corners.onnx: licence`, each file once; empty without models."""
    found = {}
    for path in models:
        content = store.read_json(path)
        found[Path(content["file"]).name] = content["contract"]["trained_on"]["licence"]
    return "; ".join(f"{name}: {licence}" for name, licence in found.items())
