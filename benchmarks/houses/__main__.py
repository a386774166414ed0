"""Houses of a real raster that a person counts, and which of them are found.

`python -m benchmarks.houses RESULTS/city.gpkg …`. In: the layer `roof_sections_image` of published cities, and outlines of
houses, rows and blocks drawn by hand in the raster (`rotterdam.json`, px). A house is found if sections cover at least half of
its outline and none of them reaches over another house too.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, store
from kibs_steps.errors import KibsError

COVERED = 0.5  # of a house's outline
SHARED = 0.25  # of a section's area: more of it on a second house, and it is over two


class Count(NamedTuple):
    """Share of each house (n,) that sections cover, whether it is found (n,), and the share of all sections' area on houses."""

    covered: NDArray[np.float64]
    found: NDArray[np.bool_]
    on_houses: float


def count(houses: NDArray[np.object_], sections: NDArray[np.object_]) -> Count:
    """Which `houses` (n,) are found by `sections` (m,); polygons of both in one frame."""
    on = shapely.area(shapely.intersection(houses[:, None], sections[None]))  # (n, m)
    over_two = (on > SHARED * shapely.area(sections)).sum(axis=0) > 1
    together = shapely.union_all(sections)
    covered = shapely.area(shapely.intersection(houses, together)) / shapely.area(houses)
    spoilt = (on[:, over_two] > 0).any(axis=1)
    on_houses = float(on.sum() / max(shapely.area(sections).sum(), 1e-9))
    return Count(covered, (covered >= COVERED) & ~spoilt, on_houses)


def read_sections(path: Path, size: tuple[int, int]) -> NDArray[np.object_]:
    """Sections of a published city where they are seen, in px of its raster, which is to have `size` (columns, rows).

    Raises `KibsError` where the city is of another raster.
    """
    import geopandas
    import rasterio

    with rasterio.open(store.read_json(path.with_name("scene.json"))["raster"]) as raster:
        found, crs, to_pixel = (raster.width, raster.height), raster.crs, ~raster.transform
    if found != size:
        raise KibsError(f"{path} is of a raster of {found[0]} × {found[1]} px, the houses of {size[0]} × {size[1]}")
    shapes = geopandas.read_file(path, layer="roof_sections_image").to_crs(crs).geometry.dropna().to_numpy()
    pixels = shapely.transform(shapes, lambda x_y: np.column_stack(to_pixel @ x_y.T))
    return shapely.make_valid(pixels)


def main(argv: list[str] | None = None) -> None:
    """Count the houses that are found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.houses", description=main.__doc__)
    parser.add_argument("cities", nargs="+", type=Path, help="city.gpkg, beside its scene.json")
    parser.add_argument("--houses", type=Path, default=Path(__file__).with_name("rotterdam.json"))
    args = parser.parse_args(argv)
    drawn = store.read_json(args.houses)
    houses = np.array([shapely.Polygon(ring) for ring in drawn["outlines"]])
    for path in args.cities:
        sections = read_sections(path, tuple(drawn["size"]))
        told = count(houses, sections)
        missed = ", ".join(f"{k + 1} ({told.covered[k]:.2f})" for k in np.flatnonzero(~told.found))
        print(
            f"{path}: {told.found.sum()} of {len(houses)} houses by {len(sections)} sections, {told.on_houses:.0%} of their area "
            f"on these houses; missed (covered): {missed}"
        )


if __name__ == "__main__":
    cli.run(main)
