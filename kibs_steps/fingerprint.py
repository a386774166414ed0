"""Fingerprints: what a file's content is, so that reruns follow content and not dates.

A file's sha256 is kept in a small cache under its path, size and modification time, so a large raster is read once and
touching it costs one more reading, not a rerun.
"""

from __future__ import annotations

import glob
import hashlib
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from kibs_steps import store
from kibs_steps.errors import KibsError

GEOREFERENCES = (".tfw", ".tifw", ".jgw", ".jp2w", ".j2w", ".pgw", ".jpgw", ".pngw", ".bpw", ".wld", ".prj", ".hdr")
RASTERS = (
    ".tif",
    ".tiff",
    ".jpg",
    ".jpeg",
    ".jp2",
    ".j2k",
    ".png",
    ".bmp",
    ".asc",
    ".xyz",
    ".img",
    ".bil",
    ".bsq",
    ".bip",
    ".flt",
)


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


def of_source(path: str | Path, cache: str | Path) -> str | list[str]:
    """What stands for the content of a raster or a vector file: its sha256, and those of the files that belong to it.

    A folder (File Geodatabase) is all its files.
    """
    path = Path(path)
    own = [path] if path.is_file() else []
    files = [*own, *companions(path)]
    every = [of_file(file, cache) for file in files] + [told for file in files for told in _said_beside(file)]
    return every[0] if own and len(every) == 1 else every


def companions(path: Path) -> list[Path]:
    """The files here that hold a part of what a file shows: rasters of a VRT, tables of a shapefile, all of a folder, where a
    raster without a header lies, and edits that SQLite has not yet brought into a GeoPackage."""
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file() and file.suffix != ".lock")
    if path.suffix.lower() == ".shp":
        parts = {".dbf", ".prj", ".cpg"}
        return sorted(f for f in path.parent.glob(f"{glob.escape(path.stem)}.*") if f.suffix.lower() in parts)
    found = [path]
    for file in found:  # which grows: a VRT may name others
        parts = [*_named_in(file), *_beside(file)]
        found += dict.fromkeys(part for part in parts if part.is_file() and part not in found)
    return found[1:]


def _beside(file: Path) -> list[Path]:
    """The files that may stand beside a raster or a GeoPackage and tell more of it."""
    edits = file.with_name(f"{file.name}-wal")
    masks = file.with_name(f"{file.name}.msk")
    endings = [e for ending in GEOREFERENCES for e in (ending, ending.upper())]
    about = [file.with_suffix(ending) for ending in endings] if file.suffix.lower() in RASTERS else []
    return [masks, *about, *([edits] if edits.is_file() and edits.stat().st_size else [])]


def _said_beside(file: Path) -> list[str]:
    """A hash of what GDAL keeps of a raster in NAME.aux.xml (nodata, CRS, place), if it does; not of the statistics that viewers
    write there."""
    try:
        root = ElementTree.parse(file.with_name(f"{file.name}.aux.xml")).getroot()
    except (ElementTree.ParseError, OSError):
        return []
    for element in list(root.iter()):
        for part in [part for part in element if part.tag in ("Metadata", "Histograms")]:
            element.remove(part)
    said = [(e.tag, e.text.strip(), sorted(e.attrib.items())) for e in root.iter() if e.text and e.text.strip()]
    return [of_values(said)] if said else []


def _named_in(vrt: Path) -> list[Path]:
    """The sources that a VRT names; none of another file."""
    if vrt.suffix.lower() != ".vrt":
        return []
    try:
        elements = list(ElementTree.parse(vrt).iter())
    except (ElementTree.ParseError, OSError):
        return []  # who reads it says what is wrong
    named = [e for e in elements if e.tag in ("SourceFilename", "SourceDataset") and e.text]
    return [vrt.parent / e.text if e.get("relativeToVRT") == "1" else Path(e.text) for e in named]


def of_values(*values: Any) -> str:
    """A short hash of plain values (JSON)."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
