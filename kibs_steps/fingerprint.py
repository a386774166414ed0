"""Fingerprints: what a file's content is, so that reruns follow content and not dates.

A file's sha256 is kept in a small cache under its path, size and modification time, so a large raster is read once and
touching it costs one more reading, not a rerun.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from kibs_steps import store
from kibs_steps.errors import KibsError


def of_file(path: str | Path, cache: str | Path) -> str:
    """sha256 of a file's content; `cache` is a JSON file that may be missing or damaged."""
    path, cache = Path(path), Path(cache)
    facts = path.stat()
    key = f"{path.resolve()} {facts.st_size} {facts.st_mtime_ns}"
    try:
        known = store.read_json(cache)
    except (OSError, KibsError):
        known = {}
    if key not in known:
        digest = hashlib.sha256()
        with path.open("rb") as source:
            while chunk := source.read(1 << 22):
                digest.update(chunk)
        known = {k: v for k, v in known.items() if not k.startswith(f"{path.resolve()} ")}
        known[key] = digest.hexdigest()
        store.write_json(cache, known)
    return known[key]


def of_values(*values: Any) -> str:
    """A short hash of plain values (JSON)."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
