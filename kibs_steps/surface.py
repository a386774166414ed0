"""Surface: heights of roof sections from a surface model (DSM) of the user's, in the place of the 3D model (the paper's
baseline).

A DSM tells where things *stand*, an outline where they are *seen*: a point of a section belongs to where its view ray, from
the satellite
down, first meets the DSM. In: sections, `surface.tif` (the DSM in the scene's CRS, by `dtm.write`), terrain, view. Out: points
inside each
section as if they were its corners, for `planes` to fit; a section owns its points.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, dtm, heightmap, imagery, scene, view
from kibs_steps.corners import CORNERS
from kibs_steps.planes import map_bounds, middle_of
from kibs_steps.terrain import Terrain

STEP = 0.25  # m of height between two looks along a ray
POINTS = 48  # about as many per section
INSIDE = 1.0  # px from the rim, where a surface model mixes roof and ground
SIGMA = 0.3  # m, of one height in an ordinary DSM
MARGIN = 200.0  # m of surface around what is looked at


def first_met(seen: np.ndarray, lean: np.ndarray, base: np.ndarray, surface: Terrain) -> np.ndarray:
    """Heights (n,) at which the view rays of image points `seen` (n, 2 map m) come down to a surface.

    `lean` (n, 2); `base` (n,) height of what the image was projected on, there. Looks every `STEP` m, then halves the last step.
    """
    high, low = float(surface.heights.max()), float(surface.heights.min())
    above, below = np.full(len(seen), high + STEP), np.full(len(seen), low)
    open_ = np.ones(len(seen), bool)
    for z in np.arange(high, low - STEP, -STEP):
        at = seen[open_] + (z - base[open_])[:, None] * lean[open_]
        met = np.flatnonzero(open_)[surface(at) >= z]
        below[met], above[met] = z, z + STEP
        open_[met] = False
        if not open_.any():
            break
    for _ in range(7):
        z = (above + below) / 2
        met = surface(seen + (z - base)[:, None] * lean) >= z
        below, above = np.where(met, z, below), np.where(met, above, z)
    return (above + below) / 2


def points_in(outline: shapely.Geometry) -> np.ndarray:
    """About `POINTS` points (n, 2 px) inside an outline, off its rim where it is wide enough: a lattice, and the corners."""
    inner = shapely.buffer(outline, -INSIDE)
    inner = outline if inner.is_empty else inner
    step = max(np.sqrt(inner.area / POINTS), 0.5)
    x0, y0, x1, y1 = inner.bounds
    x, y = np.meshgrid(np.arange(x0 + step / 2, x1, step), np.arange(y0 + step / 2, y1, step))
    found = np.column_stack([x.ravel(), y.ravel()])
    corners = shapely.get_coordinates(shapely.simplify(inner, 0.5))[: POINTS // 2]
    return np.unique(np.concatenate([found[shapely.contains_xy(inner, *found.T)], corners]), axis=0)


def measured(
    sections: pa.Table, facts: scene.Scene, surface: Terrain, terrain: view.Surface
) -> tuple[pa.Table, pa.Table]:
    """Sections that own their points and have no heights but theirs, and the points as a table after `corners.CORNERS`."""
    outlines = shapely.from_wkb(sections["outline"].to_numpy(zero_copy_only=False))
    ids = sections["section_id"].to_numpy()
    every = [points_in(outline) for outline in outlines]
    pixel = np.concatenate([np.zeros((0, 2)), *every])
    owner = np.repeat(np.arange(len(every)), [len(p) for p in every])
    seen = facts.grid.to_map(pixel)
    lean = facts.leans(middle_of(outlines, facts))[owner]
    base = facts.projected_on(terrain)(seen)
    z = first_met(seen, lean, base, surface)
    height = z - terrain(seen + (z - base)[:, None] * lean)
    n = len(pixel)
    none = np.zeros(n, np.int64)
    columns = [none, none, pixel[:, 0], pixel[:, 1], height, np.full(n, SIGMA), np.ones(n), ids[owner]]
    sums = pa.array([heightmap.EMPTY] * len(ids), heightmap.HEIGHTS.field("sums").type)
    for name, column in (("owner", pa.array(ids, pa.int64())), ("sums", sums)):
        sections = sections.set_column(sections.column_names.index(name), name, column)
    return sections, pa.table(columns, schema=CORNERS)


def under(sections: pa.Table, facts: scene.Scene, path: str | Path, terrain: view.Surface) -> tuple[pa.Table, pa.Table]:
    """`measured` with the part of `surface.tif` around the sections."""
    from kibs_steps.terrain import read

    return measured(sections, facts, read(path, map_bounds(sections, facts), MARGIN + facts.displaced), terrain)


def main(argv: list[str] | None = None) -> None:
    """Bring a surface model into the scene's CRS, in metres and without holes."""
    import pyproj

    parser = argparse.ArgumentParser(prog="python -m kibs_steps.surface", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--dsm", required=True, help="surface model: terrain with buildings, absolute heights")
    parser.add_argument("--out", required=True, help="out: surface.tif")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    with imagery.opened(facts.raster) as source:
        footprint = imagery.outline(source, pyproj.CRS.from_user_input(facts.grid.crs))
    moves = dtm.STAYS
    if facts.displaced:  # where the ground stands: the surface is needed there
        leans = [seen_from.lean for seen_from in (facts.view, *(region.view for region in facts.regions)) if seen_from]
        moves = scene.moves_on(facts.folder / "dtm.tif", facts.projection_height, leans)
    dtm.write(args.dsm, facts.grid, footprint, args.out, "dsm", moves)


if __name__ == "__main__":
    cli.run(main)
