"""KSR: `ksr/points.ply`, oriented points for Kinetic Shape Reconstruction and its kin.

The paper meshes with KSR (CGAL), which needs points with normals; fed roofs alone it gives nothing closed. In: the blocks'
solids, the
terrain. Out: a binary PLY, map frame, absolute z, with `x y z nx ny nz label`: points of roofs (1) and walls (2) with their
outward
normals every `STEP` m, and of the terrain (0), facing up, every `APART` m within `AROUND` m of buildings but not under them.
Points lie on fixed lattices of each face, so the same city gives the same points.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, store, view
from kibs_steps import scene as scenes
from kibs_steps.publish.mesh import Mesh, meshes

STEP = 0.5  # m
APART = 1.0  # m
AROUND = 8.0  # m
ROW = np.dtype([(n, "<f8") for n in ("x", "y", "z")] + [(n, "<f4") for n in ("nx", "ny", "nz")] + [("label", "u1")])


def of_face(rings: list[NDArray[np.float64]], step: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (n, 3) on a planar face, a square lattice of `step` m within its own plane, and its outward normal (3,)."""
    ring = rings[0] - rings[0][0]
    normal = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    size = np.linalg.norm(normal)
    if size < 1e-9:
        return np.zeros((0, 3)), np.array([0.0, 0.0, 1.0])
    normal = normal / size
    level = np.cross([0.0, 0.0, 1.0], normal)
    across = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-6 else np.array([1.0, 0.0, 0.0])
    axes = np.stack([across, np.cross(normal, across)])
    origin = rings[0][0]
    flat = shapely.make_valid(shapely.Polygon((rings[0] - origin) @ axes.T, [(r - origin) @ axes.T for r in rings[1:]]))
    x0, y0, x1, y1 = flat.bounds
    u, v = np.meshgrid(np.arange(x0 + step / 2, x1, step), np.arange(y0 + step / 2, y1, step))
    lattice = np.column_stack([u.ravel(), v.ravel()])
    lattice = lattice[shapely.contains_xy(flat, *lattice.T)]
    return origin + lattice @ axes, normal


def of_building(mesh: Mesh) -> NDArray[np.void]:
    """The points of a building's roofs and walls."""
    rows = []
    for kind, rings in zip(mesh.kind, mesh.rings, strict=True):
        if kind < 2:
            points, normal = of_face(rings, STEP)
            rows.append(_rows(points, normal, int(kind) + 1))
    return np.concatenate(rows) if rows else np.zeros(0, ROW)


def of_ground(bases: list[shapely.Geometry], terrain: view.Surface) -> NDArray[np.void]:
    """The points of the terrain round buildings whose walls stand on `bases` (map m)."""
    if not bases:
        return np.zeros(0, ROW)
    covered = shapely.union_all(bases)
    around = shapely.buffer(covered, AROUND, quad_segs=2)
    rows = []
    for part in shapely.get_parts(around):
        x0, y0, x1, y1 = np.floor(part.bounds)
        x, y = np.meshgrid(np.arange(x0, x1 + 1, APART) + APART / 2, np.arange(y0, y1 + 1, APART) + APART / 2)
        place = np.column_stack([x.ravel(), y.ravel()])
        place = place[shapely.contains_xy(part, *place.T)]
        place = place[~shapely.contains_xy(covered, *place.T)]
        rows.append(_rows(np.column_stack([place, terrain(place)]), np.array([0.0, 0.0, 1.0]), 0))
    return np.concatenate(rows)


def _rows(points: NDArray[np.float64], normal: NDArray[np.float64], label: int) -> NDArray[np.void]:
    found = np.zeros(len(points), ROW)
    for k, name in enumerate("xyz"):
        found[name] = points[:, k]
        found[f"n{name}"] = normal[k]
    found["label"] = label
    return found


def base_of(mesh: Mesh) -> shapely.Geometry:
    """Where a building's walls stand (map m)."""
    grounds = [rings for kind, rings in zip(mesh.kind, mesh.rings, strict=True) if kind == 2]
    return shapely.union_all(
        [shapely.make_valid(shapely.Polygon(r[0][:, :2], [h[:, :2] for h in r[1:]])) for r in grounds]
    )


def write(path: Path, found: Iterable[Mesh], terrain: view.Surface, crs: str) -> int:
    """Write the points of all buildings and the ground round them; returns how many."""
    parts, bases = [], []
    for mesh in found:
        parts.append(of_building(mesh))
        bases.append(base_of(mesh))
    points = np.concatenate([*parts, of_ground(bases, terrain)])
    kinds = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {crs.splitlines()[0]}, metres; label 0 ground, 1 roof, 2 wall",
    ]
    head += [f"element vertex {len(points)}"]
    head += [f"property {kinds[ROW[name].str]} {name}" for name in ROW.names]
    path.write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + points.tobytes())
    return len(points)


def main(argv: list[str] | None = None) -> None:
    """Write oriented points of roofs, walls and ground."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.ksr", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--solids", nargs="+", required=True, help="solids.city.jsonl of every block")
    parser.add_argument("--out", required=True, help="out: ksr/points.ply")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    with store.whole(args.out) as temporary:
        write(temporary, meshes(args.solids), scene.terrain(scene.grid.bounds), scene.grid.crs)


if __name__ == "__main__":
    cli.run(main)
