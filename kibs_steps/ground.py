"""Ground: where every section really stands.

A section's outline is known where it is *seen*. Each of its vertices stands where its view ray, from the terrain point seen
at that pixel toward the satellite, meets the section's plane (closed form, `view.ray_meets_plane`; PAPER, off-nadir
geometry): the corners of a sloped roof move by different amounts.

In: `planes.parquet`, DTM, view. Out: `ground.parquet`, one row per section with its outline as seen and as it stands, heights
above ground, slope and azimuth (docs/architecture.md).
"""

from __future__ import annotations

import argparse

import numpy as np
import pyarrow as pa
import shapely

from kibs_steps import cli, georeference, scene, store, view
from kibs_steps.planes import map_bounds, middle_of

LEVEL = 3.0  # deg: below this a slope has no direction
ANGLE_SIGMA = 0.3  # deg: how far the view at one place is from the mean angles of a whole image

SECTIONS = pa.schema(
    [
        ("section_id", pa.int64()),
        ("outline", pa.binary()),
        ("outline_seen", pa.binary()),
        ("outline_map", pa.binary()),
        ("status", pa.string()),
        ("status_reason", pa.string()),
        ("height_min", pa.float64()),
        ("height_max", pa.float64()),
        ("height_mean", pa.float64()),
        ("height_sigma", pa.float64()),
        ("slope", pa.float64()),
        ("azimuth", pa.float64()),
        ("plane_a", pa.float64()),
        ("plane_b", pa.float64()),
        ("plane_c", pa.float64()),
        ("x0", pa.float64()),
        ("y0", pa.float64()),
        ("n_corners", pa.int64()),
        ("score", pa.float64()),
        ("area", pa.float64()),
        ("split", pa.int64()),
        ("sigma_along", pa.float64()),
        ("sigma_across", pa.float64()),
    ]
)


def slope_azimuth(a: np.ndarray, b: np.ndarray, convergence: float) -> tuple[np.ndarray, np.ndarray]:
    """Slope (deg from horizontal) and azimuth (deg from true north of the downslope; NaN below 3°) of gradients (n,)."""
    slope = np.degrees(np.arctan(np.hypot(a, b)))
    azimuth = (np.degrees(np.arctan2(-a, -b)) + convergence) % 360.0
    return slope, np.where(slope < LEVEL, np.nan, azimuth)


def ground(planes: pa.Table, facts: scene.Scene, dtm: view.Surface) -> pa.Table:
    """Every section where it stands, after `SECTIONS`."""
    outlines = shapely.from_wkb(planes["outline"].to_numpy(zero_copy_only=False))
    base = facts.projected_on(dtm)
    column = {name: planes[name].to_numpy() for name in ("plane_a", "plane_b", "plane_c", "x0", "y0")}
    pixel, index = shapely.get_coordinates(outlines, return_index=True)
    seen = facts.grid.to_map(pixel)
    plane = view.Plane(*(column[name][index] for name in ("plane_a", "plane_b", "plane_c", "x0", "y0")))
    middles = middle_of(outlines, facts)
    lean = facts.leans(middles)
    where, z = view.ray_meets_plane(seen, plane, lean[index], base)
    height = z - dtm(where)
    flat = shapely.force_3d(outlines)
    outline_seen = shapely.set_coordinates(flat.copy(), np.column_stack([seen, height]))
    outline_map = shapely.set_coordinates(shapely.force_3d(outlines), np.column_stack([where, z]))
    n = len(outlines)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, index, height)
    np.maximum.at(high, index, height)
    centre = shapely.get_coordinates(shapely.centroid(outline_map)) if n else np.zeros((0, 2))
    middle = view.Plane(*column.values()).at(centre) - dtm(centre)
    elevation = np.array([v.elevation if v else np.nan for v in facts.views(middles)], float)
    along, across = view.position_sigma(middle, planes["height_sigma"].to_numpy(), elevation, ANGLE_SIGMA)
    slope, azimuth = slope_azimuth(column["plane_a"], column["plane_b"], georeference.convergence(facts.grid))
    values = {
        "outline_seen": shapely.to_wkb(outline_seen, output_dimension=3),
        "outline_map": shapely.to_wkb(outline_map, output_dimension=3),
        "height_min": low,
        "height_max": high,
        "height_mean": middle,
        "slope": slope,
        "azimuth": pa.array(azimuth, from_pandas=True),
        "area": shapely.area(outline_map),
        "sigma_along": pa.array(along, from_pandas=True),
        "sigma_across": pa.array(across, from_pandas=True),
    }
    return pa.table(
        [values[f.name] if f.name in values else planes[f.name] for f in SECTIONS], names=SECTIONS.names
    ).cast(SECTIONS)


def main(argv: list[str] | None = None) -> None:
    """Move the sections of one block to where they stand."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.ground", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--planes", required=True, help="planes.parquet")
    parser.add_argument("--out", required=True, help="ground.parquet")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    planes = store.read_table(args.planes)
    store.write_table(args.out, ground(planes, facts, facts.terrain(map_bounds(planes, facts))))


if __name__ == "__main__":
    cli.run(main, pandas=False)
