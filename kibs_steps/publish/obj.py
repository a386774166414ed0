"""OBJ: `city.obj`, the city as plain text: an object per building, a group per kind of surface.

In: the blocks' meshes. Out: Wavefront OBJ in metres, x east, y north, z up, from the origin named in its head, and `city.mtl`,
the colours of its three materials.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

import numpy as np

from kibs_steps import cli, store
from kibs_steps import scene as scenes
from kibs_steps.mesh import COLOURS, KINDS, Mesh, by_kind, meshes
from kibs_steps.publish import licences
from kibs_steps.publish.glb import origin_of


def write(out: TextIO, found: Iterable[Mesh], origin: np.ndarray, crs: str, materials: str, licence: str = "") -> None:
    """Write buildings; `origin` (3,) map m."""
    out.write(f"# origin {origin[0]:.0f} {origin[1]:.0f} {origin[2]:.0f} in {crs.splitlines()[0]}, metres, z up\n")
    if licence:
        out.write(f"# licence {licence}\n")
    out.write(f"mtllib {materials}\n")
    used = 0
    for mesh in found:
        points, faces, kind = by_kind(mesh)
        out.write(f"o building-{mesh.building}\n")
        out.write(_lines("v %.3f %.3f %.3f\n", points - origin))
        for k, name in enumerate(KINDS):
            mine = faces[kind[faces[:, 0]] == k]
            if len(mine):
                out.write(f"g {name}\nusemtl {name}\n")
                out.write(_lines("f %d %d %d\n", mine + used + 1))
        used += len(points)


def _lines(form: str, rows: np.ndarray) -> str:
    """A line for each row of numbers."""
    return form * len(rows) % tuple(rows.ravel().tolist())


def materials() -> str:
    """The colours of the kinds of surface as MTL."""
    lines = (
        f"newmtl {name}\nKd {r / 255:.3f} {g / 255:.3f} {b / 255:.3f}\n"
        for name, (r, g, b) in zip(KINDS, COLOURS, strict=True)
    )
    return "".join(lines)


def main(argv: list[str] | None = None) -> None:
    """Write the city as Wavefront OBJ."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.obj", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--meshes", nargs="+", required=True, help="meshes.parquet of every block")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences are told")
    parser.add_argument("--out", required=True, help="out: city.obj")
    parser.add_argument("--materials", required=True, help="out: city.mtl, beside it")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    with store.whole(args.materials) as temporary:
        temporary.write_text(materials(), encoding="utf-8")
    with store.whole(args.out) as temporary, temporary.open("w", encoding="utf-8") as out:
        materials_name, licence = Path(args.materials).name, licences.line(args.models)
        write(out, meshes(args.meshes), origin_of(scene), scene.grid.crs, materials_name, licence)


if __name__ == "__main__":
    cli.run(main, pandas=False)
