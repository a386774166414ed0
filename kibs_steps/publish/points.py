"""Points: `points.txt`, the paper's text output, one `x y z id` per corner of a section.

In: section tables. Out: a line per vertex of every section's outline as it stands (map frame, m, z absolute); the closing
vertex of a ring is not repeated. The id says to which split the section belongs: 0 training, 1 validation, 2 testing or none.
"""

from __future__ import annotations

import argparse

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, store


def points(sections: pa.Table) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners (n, 3) in metres and their split (n,), section by section in order of `section_id`, ring by ring."""
    sections = sections.sort_by("section_id")
    split = pc.fill_null(sections["split"], 2).to_numpy()
    split = np.where(np.isin(split, (0, 1)), split, 2)
    rings, owner = shapely.get_rings(shapely.from_wkb(sections["outline_map"].to_numpy()), return_index=True)
    corners, ring = shapely.get_coordinates(rings, include_z=True, return_index=True)
    closing = np.append(ring[1:] != ring[:-1], True)[: len(ring)]
    return corners[~closing], split[owner[ring[~closing]]]


def main(argv: list[str] | None = None) -> None:
    """Write the corners of all sections as text."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.points", description=main.__doc__)
    parser.add_argument("--sections", required=True, nargs="+", help="buildings.parquet")
    parser.add_argument("--out", required=True, help="out: points.txt")
    args = parser.parse_args(argv)
    columns = ["section_id", "outline_map", "split"]
    with store.whole(args.out) as temporary, temporary.open("w", encoding="ascii") as out:
        for some in store.merged(args.sections, ["section_id"], columns):
            for (x, y, z), split in zip(*(column.tolist() for column in points(some)), strict=True):
                out.write(f"{x:.3f} {y:.3f} {z:.3f} {split}\n")


if __name__ == "__main__":
    cli.run(main, pandas=False)
