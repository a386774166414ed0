"""The text output: one line per corner."""

import numpy as np
import pyarrow as pa
import shapely
import toy_city as toy

from kibs_steps import store
from kibs_steps.publish import points


def test_a_line_per_corner_without_the_closing_one(tmp_path):
    scene = toy.make_scene(tmp_path)
    rows = toy.buildings_table(scene).to_pylist()
    rows[3]["split"] = None
    rows[2]["split"] = 7
    store.write_table(tmp_path / "a.parquet", pa.Table.from_pylist(rows[2:]))
    store.write_table(tmp_path / "b.parquet", pa.Table.from_pylist(rows[:2]))
    out = tmp_path / "points.txt"
    points.main(["--sections", str(tmp_path / "a.parquet"), str(tmp_path / "b.parquet"), "--out", str(out)])
    lines = [line.split() for line in out.read_text().splitlines()]
    assert len(lines) == 4 + 4 + 8 + 4
    assert {len(line) for line in lines} == {4}
    expected = []
    for i, (section, _, outline) in enumerate(toy.roofs()):
        for ring in (outline.exterior, *outline.interiors):
            for x, y, z in shapely.get_coordinates(ring, include_z=True)[:-1]:
                expected.append((x, y, z, section % 3 if i < 2 else 2))
    np.testing.assert_allclose(np.array(lines, float), expected, atol=5e-4)
    assert all(len(value.split(".")[1]) == 3 for line in lines for value in line[:3])


def test_no_sections_give_an_empty_file(tmp_path):
    scene = toy.make_scene(tmp_path)
    store.write_table(tmp_path / "a.parquet", toy.buildings_table(scene).slice(0, 0))
    points.main(["--sections", str(tmp_path / "a.parquet"), "--out", str(tmp_path / "points.txt")])
    assert (tmp_path / "points.txt").read_text() == ""
