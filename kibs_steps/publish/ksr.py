"""KSR: `ksr/points.ply`, oriented points for Kinetic Shape Reconstruction and its kin.

The paper meshes with KSR (CGAL), which needs points with normals; fed roofs alone it gives nothing closed. In: the blocks'
meshes, the terrain. Out: a binary PLY, map frame, absolute z, with `x y z nx ny nz label`: points of roofs (1) and walls (2)
with their outward normals every `STEP` m, and of the terrain (0), facing up, every `APART` m within `AROUND` m of buildings but
not under them. Points lie on fixed lattices, of each face or of the map, so the same city gives the same points. They are
written building by building and square by square, so memory does not grow with them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, store, view
from kibs_steps import scene as scenes
from kibs_steps.mesh import KINDS, Mesh, area_vectors, meshes, polygons
from kibs_steps.publish import licences

STEP = 1.0  # m
APART = 2.0  # m
AROUND = 8.0  # m
SIDE = 256  # m, of the squares that the terrain is worked on in
HEAD = 1024  # bytes
ROW = np.dtype([(n, "<f8") for n in ("x", "y", "z")] + [(n, "<f4") for n in ("nx", "ny", "nz")] + [("label", "u1")])

TerrainOf = Callable[[tuple[float, float, float, float]], view.Surface]  # bounds (map m) to the surface there


def of_building(mesh: Mesh, step: float = STEP) -> NDArray[np.void]:
    """The points of a building's roofs and walls: a square lattice of `step` m in the plane of each face, from its lower left."""
    owner = np.repeat(np.repeat(np.arange(len(mesh.count)), mesh.count), mesh.lengths)
    points = mesh.vertices[mesh.corners]
    origin = points[np.searchsorted(owner, np.arange(len(mesh.count)))]
    local = points - origin[owner]
    normal = area_vectors(points, mesh.lengths, mesh.count)
    size = np.linalg.norm(normal, axis=1)
    wanted = np.flatnonzero((mesh.kind != KINDS.index("GroundSurface")) & (size > 1e-9))
    normal = normal / np.maximum(size, 1e-9)[:, None]
    level = np.column_stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))])
    length = np.linalg.norm(level, axis=1, keepdims=True)
    across = np.where(length > 1e-6, level / np.maximum(length, 1e-6), [1.0, 0.0, 0.0])
    up = np.cross(normal, across)
    flat = np.column_stack([(local * across[owner]).sum(axis=1), (local * up[owner]).sum(axis=1)])
    shapes = shapely.make_valid(polygons(flat, mesh.lengths, mesh.count))
    low, high = np.split(shapely.bounds(shapes[wanted]), 2, axis=1)
    cols, lines = np.maximum(np.ceil((high - low) / step - 0.5), 0).astype(np.int64).T
    of = np.repeat(np.arange(len(wanted)), cols * lines)
    number = np.arange(len(of)) - np.repeat(np.cumsum(cols * lines) - cols * lines, cols * lines)
    line, col = np.divmod(number, np.maximum(cols, 1)[of])
    place = low[of] + (np.column_stack([col, line]) + 0.5) * step
    inside = shapely.contains_xy(shapes[wanted[of]], *place.T)
    f, (u, v) = wanted[of[inside]], place[inside].T
    return _rows(origin[f] + u[:, None] * across[f] + v[:, None] * up[f], normal[f], mesh.kind[f] + 1)


def base_of(mesh: Mesh) -> shapely.Geometry:
    """Where a building's walls stand (map m)."""
    grounds = [rings for kind, rings in zip(mesh.kind, mesh.rings, strict=True) if KINDS[kind] == "GroundSurface"]
    return shapely.union_all(
        [shapely.make_valid(shapely.Polygon(r[0][:, :2], [h[:, :2] for h in r[1:]])) for r in grounds]
    )


def of_ground(bases: list[shapely.Geometry], terrain_of: TerrainOf) -> Iterator[NDArray[np.void]]:
    """The points of the terrain round buildings whose walls stand on `bases` (map m), square by square."""
    if not bases:
        return
    every, tree, box = np.array(bases), shapely.STRtree(bases), shapely.total_bounds(bases)
    low, high = (np.floor(edge / SIDE).astype(int) for edge in (box[:2] - AROUND, box[2:] + AROUND))
    steps = np.arange(0, SIDE, APART) + APART / 2
    for row in range(low[1], high[1] + 1):
        for col in range(low[0], high[0] + 1):
            square = (col * SIDE, row * SIDE, (col + 1) * SIDE, (row + 1) * SIDE)
            near = every[np.sort(tree.query(shapely.box(*square), "dwithin", AROUND))]
            if not len(near):
                continue
            x, y = (v.ravel() for v in np.meshgrid(square[0] + steps, square[1] + steps))
            covered = shapely.union_all(near)
            around = shapely.union_all(shapely.buffer(near, AROUND, quad_segs=4))
            wanted = shapely.contains_xy(around, x, y) & ~shapely.contains_xy(covered, x, y)
            at = np.column_stack([x, y])[wanted]
            yield _rows(np.column_stack([at, terrain_of(square)(at)]), np.array([[0.0, 0.0, 1.0]]), 0)


def _rows(points: NDArray[np.float64], normal: NDArray[np.float64], label: NDArray[np.int8] | int) -> NDArray[np.void]:
    """Points (n, 3) with normals (n, 3) or (1, 3)."""
    found = np.zeros(len(points), ROW)
    for k, name in enumerate("xyz"):
        found[name] = points[:, k]
        found[f"n{name}"] = normal[:, k]
    found["label"] = label
    return found


def write(path: Path, found: Iterable[Mesh], terrain_of: TerrainOf, crs: str, licence: str = "") -> int:
    """Write the points of all buildings and the ground round them; returns how many."""
    count, bases = 0, []
    with path.open("wb") as out:
        out.write(b" " * HEAD)
        for mesh in found:
            bases.append(base_of(mesh))
            count += _append(out, of_building(mesh))
        for points in of_ground(bases, terrain_of):
            count += _append(out, points)
        out.seek(0)
        out.write(head(count, crs, licence))
    return count


def _append(out: BinaryIO, points: NDArray[np.void]) -> int:
    out.write(points.tobytes())
    return len(points)


def head(count: int, crs: str, licence: str = "") -> bytes:
    """The header of a PLY with so many points, `HEAD` bytes long."""
    kinds = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kinds[ROW[name].str]} {name}" for name in ROW.names]
    told = f"comment {crs.splitlines()[0][:120]}, metres; label 0 ground, 1 roof, 2 wall"
    lines += [told, *([f"comment licence {licence}"] if licence else [])]
    text = "\n".join(lines).encode("ascii", "replace")[: HEAD - len(b"\nend_header\n")]
    return text.ljust(HEAD - len(b"\nend_header\n")) + b"\nend_header\n"


def main(argv: list[str] | None = None) -> None:
    """Write oriented points of roofs, walls and ground."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.ksr", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--meshes", nargs="+", required=True, help="meshes.parquet of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences are told")
    parser.add_argument("--out", required=True, help="out: ksr/points.ply")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    with store.whole(args.out) as temporary:
        write(temporary, meshes(args.meshes), scene.terrain, scene.grid.crs, licences.line(args.models))


if __name__ == "__main__":
    cli.run(main, pandas=False)
