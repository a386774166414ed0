"""A second opinion on solids, from published CityJSON alone: written without `kibs_steps.gate` or `shells`.

In: a CityJSON city or a CityJSONSeq. For every Solid: each edge twice in opposite directions; every face within `FLAT` m of
its best
plane; positive volume (outward orientation); no face cutting or touching another but in shared vertices and edges. Faces are
triangulated with their own vertices; two triangles meet improperly where an edge of one passes through the inside of the other.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

FLAT = 0.005  # m
TOUCH = 1e-4  # m


def solids(path: str | Path) -> Iterator[tuple[str, list[list[list[int]]], np.ndarray]]:
    """(id, faces as rings of vertex numbers, vertices in metres) of every Solid of a file."""
    text = Path(path).read_text(encoding="utf-8")
    if str(path).endswith("l"):
        head, *features = [json.loads(line) for line in text.splitlines()]
        parts = [(f["CityObjects"], f["vertices"]) for f in features]
    else:
        head = json.loads(text)
        parts = [(head["CityObjects"], head["vertices"])]
    for objects, vertices in parts:
        xyz = np.array(vertices, float).reshape(-1, 3) * head["transform"]["scale"]
        for name, thing in objects.items():
            for geometry in thing.get("geometry", []):
                if geometry["type"] == "Solid":
                    yield name, geometry["boundaries"][0], xyz


def faults(faces: list[list[list[int]]], xyz: np.ndarray) -> list[str]:
    """What is wrong with a shell."""
    edges: Counter[tuple[int, int]] = Counter()
    for rings in faces:
        for ring in rings:
            edges.update(zip(ring, [*ring[1:], ring[0]], strict=True))
    wrong = [f"edge {e} used {n} times" for e, n in edges.items() if n != 1]
    wrong += [f"edge {e} has no twin" for e in edges if e[::-1] not in edges]
    pieces, owner = [], []
    for f, rings in enumerate(faces):
        points = xyz[[v for ring in rings for v in ring]]
        centre = points.mean(axis=0)
        _, _, axes = np.linalg.svd(points - centre)
        off = np.abs((points - centre) @ axes[2]).max()
        if off > FLAT:
            wrong.append(f"face {f} is {off:.4f} m off its plane")
        found = triangles(rings, xyz)
        pieces += found
        owner += [f] * len(found)
    if wrong:
        return wrong
    index = np.array(pieces)
    corner = xyz[index] - xyz[index[0, 0]]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6
    if volume <= 0:
        wrong.append(f"volume {volume:.3f} m³")
    return wrong + _cuts(index, corner, np.array(owner))


def triangles(rings: list[list[int]], xyz: np.ndarray) -> list[tuple[int, int, int]]:
    """A face as triangles of its own vertices, turned as the face is."""
    area = sum(np.cross(xyz[r], np.roll(xyz[r], -1, axis=0)).sum(axis=0) for r in rings)
    drop = int(np.abs(area).argmax())
    keep = [k for k in range(3) if k != drop]
    at = {tuple(np.round(xyz[v][keep], 6)): v for r in rings for v in r}
    flat = shapely.Polygon(xyz[rings[0]][:, keep], [xyz[h][:, keep] for h in rings[1:]])
    found = []
    for part in shapely.get_parts(shapely.constrained_delaunay_triangles(flat)):
        a, b, c = (at[tuple(np.round(p, 6))] for p in shapely.get_coordinates(part)[:3])
        turned = np.cross(xyz[b] - xyz[a], xyz[c] - xyz[a])
        found.append((a, b, c) if turned @ area > 0 else (a, c, b))
    return found


def _cuts(index: np.ndarray, corner: np.ndarray, owner: np.ndarray) -> list[str]:
    """Edges that pass through, or vertices that lie in, triangles which do not have them."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    low, high = corner.min(axis=1) - TOUCH, corner.max(axis=1) + TOUCH
    wrong = []
    for t in range(len(index)):
        others = np.flatnonzero((owner != owner[t]) & (low <= high[t]).all(axis=1) & (high >= low[t]).all(axis=1))
        ends = np.stack([corner[others], np.roll(corner[others], -1, axis=1)], axis=2).reshape(-1, 2, 3)
        names = np.stack([index[others], np.roll(index[others], -1, axis=1)], axis=2).reshape(-1, 2)
        whose = np.repeat(others, 3)
        free = ~np.isin(names, index[t]).any(axis=1)
        away = (ends - corner[t, 0]) @ normal[t]
        through = free & (away.min(axis=1) < -TOUCH) & (away.max(axis=1) > TOUCH)
        k = np.flatnonzero(through)
        share = (away[k, 0] / (away[k, 0] - away[k, 1]))[:, None]
        points = ends[k, 0] * (1 - share) + ends[k, 1] * share
        wrong += [f"face {owner[whose[e]]} cuts face {owner[t]}" for e in k[_inside(points, corner[t], normal[t])]]
        alone = np.flatnonzero(~np.isin(names[:, 0], index[t]) & (np.abs(away[:, 0]) < TOUCH))
        lying = alone[_inside(ends[alone, 0], corner[t], normal[t])]
        wrong += [f"face {owner[whose[e]]} touches face {owner[t]}" for e in lying]
    return sorted(set(wrong))


def _inside(points: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Which points in its plane are inside a triangle, by more than `TOUCH` m."""
    inside = np.ones(len(points), bool)
    for k in range(3):
        along = triangle[(k + 1) % 3] - triangle[k]
        inward = np.cross(normal, along) / np.linalg.norm(along)
        inside &= (points - triangle[k]) @ inward > TOUCH
    return inside


def report(path: str | Path) -> dict[str, Any]:
    """How many solids of a file there are, and what is wrong with which."""
    found = {}
    count = 0
    for name, faces, xyz in solids(path):
        count += 1
        if wrong := faults(faces, xyz):
            found[name] = wrong[:3]
    return {"solids": count, "faulty": found}


if __name__ == "__main__":
    import sys

    for file in sys.argv[1:]:
        print(file, json.dumps(report(file)))
