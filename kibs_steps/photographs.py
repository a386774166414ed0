"""Photographs of real roofs that training and the simulator draw on, read from a data folder.

In: the Roof-graph data set (Ren et al. 2021), houses with hand-made roof graphs; chips with building masks of many places. Out:
`RoofGraph`s and `Chip`s in memory.
"""

from __future__ import annotations

import tarfile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kibs_steps.errors import KibsError

GRAPH_GSD = 0.06  # m per px, about, of the roof-graph photographs
REDUCED = 3  # they are kept in memory this many times smaller
# Folders of chips with the GSD (m) their houses suggest; the WHU city chips are of many resolutions.
CHIPS = {"inria": 0.3, "spacenet": 0.3, "whu_east_asia": 0.3, "nzlnd": 0.4, "whu_sample": 0.6}
FREE = {"spacenet"}  # of them those under a free licence (CC BY-SA 4.0)


class NoTrainingData(KibsError):
    """A data folder lacks what training needs."""


class RoofGraph(NamedTuple):
    """One photographed house: rgb uint8 (h, w, 3) at `scale` of the original, vertices (n, 2) px of it (col, row), faces."""

    name: str
    rgb: np.ndarray
    vertices: np.ndarray
    faces: list[np.ndarray]


class Chip(NamedTuple):
    """rgb uint8 (h, w, 3), building mask bool (h, w), m per px."""

    name: str
    rgb: np.ndarray
    building: np.ndarray
    gsd: float


def read_roof_graphs(source: str | Path) -> list[RoofGraph]:
    """Roof graphs of the Roof-graph data set (Ren et al. 2021) from its tar file or the folder it was extracted to.

    Photographs are made REDUCED times smaller. Raises `NoTrainingData` if none is there.
    """
    files = _files(Path(source), ("dt_roof_image/", "res_roof_graph/"))
    graphs = []
    for path in sorted(p for p in files if p.startswith("dt_roof_image/")):
        name = Path(path).stem
        faces, vertices = (files.get(f"res_roof_graph/{name}.{end}") for end in ("faces", "verts"))
        if faces is None or vertices is None:
            continue
        rgb = cv2.imdecode(np.frombuffer(files[path], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        rows, cols = rgb.shape[0] // REDUCED, rgb.shape[1] // REDUCED
        small = cv2.resize(rgb[: rows * REDUCED, : cols * REDUCED], (cols, rows), interpolation=cv2.INTER_AREA)
        points = np.array([line.split(",") for line in vertices.decode().split()], float).reshape(-1, 2) / REDUCED
        rings = [np.array(line.split(",")[:-1], int) for line in faces.decode().split()]
        graphs.append(RoofGraph(name, small, points, [ring for ring in rings if len(ring) >= 3]))
    if not graphs:
        raise NoTrainingData(
            f"{source} holds no roof graphs: give the folder or tar with dt_roof_image/, res_roof_graph/"
        )
    return graphs


def _files(source: Path, wanted: tuple[str, ...]) -> dict[str, bytes]:
    """Content by path of the wanted folders' files, of a tar or a folder."""
    if source.is_dir():
        return {f"{d}{p.name}": p.read_bytes() for d in wanted for p in sorted((source / d).glob("*"))}
    if not source.is_file():
        raise NoTrainingData(f"{source} is not there: name the data folder with roofgraph/roofgraph.tar")
    with tarfile.open(source) as tar:
        members = ((m.name.removeprefix("./"), m) for m in tar if m.isfile())
        return {name: tar.extractfile(m).read() for name, m in members if name.startswith(wanted)}


def held_out(graph: RoofGraph, share: float = 0.15) -> bool:
    """Whether a photograph is kept for validation: by its map sheet, so that neighbours stay together."""
    sheet = graph.name.rsplit("_", 1)[0]
    return (sum(ord(c) * 31**i for i, c in enumerate(sheet)) * 2654435761) % 2**32 < share * 2**32


def read_chips(folder: str | Path) -> list[Chip]:
    """Chips that come with a building mask, of the folders in CHIPS. Raises `NoTrainingData` if there are none."""
    chips = []
    for place, gsd in CHIPS.items():
        root = Path(folder) / place
        pairs = [(root / "images" / p.name, p) for p in sorted((root / "gt").glob("*.png"))]
        pairs += [(p.with_name(p.name.replace("_gt", "")), p) for p in sorted(root.glob("*_gt.png"))]
        for image, mask in pairs:
            rgb = cv2.imread(str(image), cv2.IMREAD_COLOR)[..., ::-1]
            chips.append(Chip(f"{place}/{image.stem}", rgb, cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) > 127, gsd))
    if not chips:
        raise NoTrainingData(f"no chips with building masks below {folder}")
    return chips
