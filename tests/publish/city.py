"""A small published city for tests of formats.

A hip house, a house with a courtyard, a house in two parts, one without a solid.
"""

from __future__ import annotations

from pathlib import Path

import houses
import numpy as np
import pyarrow as pa
import toy_city

from kibs_steps import solids, store

HOUSES = (
    houses.HIP,
    houses.COURTYARD,
    [*houses.BOX, ([(9, 0), (14, 0), (14, 4), (9, 4)], (0, 0, 4))],
    [([(0, 0), (4, 0), (4, 4), (0, 4)], (0, 0, -3.0))],
)
VOLUMES = {1: houses.VOLUME["hip"], 101: houses.VOLUME["courtyard"], 201: 60.0 + 80.0}
EAVES = 1.5  # m by which every house stands higher than its place's ground


def built(folder: Path) -> list[str]:
    """`scene.json` and one block's solids in `folder`: arguments for a publisher."""
    scene = toy_city.make_scene(folder)
    rows = []
    for k, house in enumerate(HOUSES):
        place = (toy_city.X0 + 10 + 30 * k, toy_city.Y0 - 50)
        base = float(toy_city.GROUND.at(np.array([place]))[0]) + EAVES
        ids = [100 * k + i for i in range(1, len(house) + 1)]
        rows.append(houses.building_table(house, place=place, base=base, ids=ids))
    store.write_by_block(folder / "buildings.parquet", {"r000c000": pa.concat_tables(rows)})
    arguments = ["--scene", str(scene.folder / "scene.json")]
    solids.main(
        [*arguments, "--buildings", str(folder / "buildings.parquet"), "--name", "r000c000",
         "--out", str(folder / "solids.city.jsonl"), "--attributes", str(folder / "solids.parquet"),
         "--meshes", str(folder / "meshes.parquet")]
    )  # fmt: skip
    return [*arguments, "--meshes", str(folder / "meshes.parquet")]
