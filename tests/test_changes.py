"""Changes between two results: what was done to the buildings is what is reported."""

import json

import geopandas
import pyogrio
import pytest
import shapely

from kibs_steps import changes

CRS = "EPSG:32631"


def result(folder, buildings):
    """A `city.gpkg` of (id, x, y, side, height)."""
    folder.mkdir(parents=True, exist_ok=True)
    frame = geopandas.GeoDataFrame(
        {
            "building_id": [b[0] for b in buildings],
            "lod": ["2.0"] * len(buildings),
            "height": [float(b[4]) if b[4] is not None else None for b in buildings],
            "height_sigma": [0.2] * len(buildings),
            "position_sigma": [0.2] * len(buildings),
            "volume": [1.0] * len(buildings),
        },
        geometry=[shapely.MultiPolygon([shapely.box(x, y, x + s, y + s)]) for _, x, y, s, _ in buildings],
        crs=CRS,
    )
    frame.to_file(folder / "city.gpkg", layer="buildings")
    return folder


OLD = [(1, 0, 0, 10, 6), (2, 20, 0, 10, 6), (3, 40, 0, 10, 6), (4, 60, 0, 10, 6), (5, 80, 0, 10, 6), (6, 100, 0, 4, 3)]
NEW = [(11, 0, 0, 10, 6.4), (12, 20, 0, 10, 9), (13, 40, 0, 10, 4), (14, 62.5, 0, 10, 6), (15, 81, 2, 10, 12), (17, 150, 50, 8,
5),
       (16, 105, 0, 4, 3)]  # fmt: skip
EXPECTED = {(1, 11): "same", (2, 12): "higher", (3, 13): "lower", (4, 14): "moved", (5, 15): "moved, higher", (6, 16): "moved",
            (None, 17): "new"}  # fmt: skip


def test_every_kind_of_change(tmp_path, capsys):
    old, new = result(tmp_path / "old", OLD), result(tmp_path / "new", NEW)
    changes.main([str(old), str(new), "--out", str(tmp_path / "report")])
    content = json.loads((tmp_path / "report/changes.json").read_text())
    found = {(r["building_old"], r["building_new"]): r["change"] for r in content["buildings"]}
    assert found == EXPECTED
    assert content["changes"] == {"new": 1, "gone": 0, "moved": 3, "higher": 2, "lower": 1, "same": 1}
    layer = pyogrio.read_dataframe(tmp_path / "report/changes.gpkg")
    assert len(layer) == len(EXPECTED)
    assert layer.crs == CRS
    text = (tmp_path / "report/changes.txt").read_text()
    assert text == capsys.readouterr().out
    assert "6 buildings" in text
    assert "building 5 -> 15: moved, higher" in text


def test_a_building_that_moved_past_its_sheds(tmp_path):
    """However many unchanged ones stand nearer to where it was."""
    sheds = [(10 + k, 13.5, 2.0 * k - 4, 1.5, 3) for k in range(6)]
    before = result(tmp_path / "old", [(1, 0, 0, 6, 6), *sheds])
    after = result(tmp_path / "new", [(2, 7, 0, 6, 6), *sheds])
    changed = changes.changes(*(changes.read(folder)[0] for folder in (before, after)))
    assert [(r["change"], r["building_old"], r["building_new"]) for r in changed if r["change"] != "same"] == [
        ("moved", 1, 2)
    ]


def test_a_building_grouped_otherwise_has_not_moved(tmp_path):
    """Four houses taken for one before: the middle of a quarter is another, though nothing moved."""
    quarters = [(k + 1, x, y, 10, 6) for k, (x, y) in enumerate([(0, 0), (10, 0), (0, 10), (10, 10)])]
    before, after = result(tmp_path / "old", [(1, 0, 0, 20, 6)]), result(tmp_path / "new", quarters)
    changed = changes.changes(*(changes.read(folder)[0] for folder in (before, after)))
    assert sorted(r["change"] for r in changed) == ["new", "new", "new", "same"]


@pytest.mark.parametrize(
    ("part", "change"), [((0, 0, 16), "same"), ((4, 2, 16), "same"), ((8, 8, 16), "moved"), ((3, 0, 20), "moved")]
)
def test_a_building_that_lost_a_part_has_not_moved(tmp_path, part, change):
    """Nor has one that gained it; but one as large, or that reaches beyond where it was, has."""
    whole, less = result(tmp_path / "a", [(1, 0, 0, 20, 6)]), result(tmp_path / "b", [(2, *part, 6)])
    for folders in ((whole, less), (less, whole)):
        (row,) = changes.changes(*(changes.read(folder)[0] for folder in folders))
        assert row["change"] == change


def test_the_other_way_round(tmp_path):
    old, new = result(tmp_path / "old", OLD), result(tmp_path / "new", NEW)
    rows = changes.changes(changes.read(new)[0], changes.read(old)[0])
    turned = {"higher": "lower", "lower": "higher", "new": "gone"}
    found = {(r["building_new"], r["building_old"]): r["change"] for r in rows}
    assert found == {k: ", ".join(turned.get(c, c) for c in v.split(", ")) for k, v in EXPECTED.items()}


def test_nothing_changed_in_a_result_and_itself(tmp_path):
    old = result(tmp_path / "old", OLD)
    rows = changes.changes(changes.read(old)[0], changes.read(old / "city.gpkg")[0])
    assert {r["change"] for r in rows} == {"same"}
    assert len(rows) == len(OLD)


def test_uncertain_heights_do_not_count(tmp_path):
    rows, _ = changes.read(result(tmp_path / "a", [(1, 0, 0, 10, 6)]))
    other = [{**rows[0], "height": 8.0, "height_sigma": 2.0}]
    assert changes.changes(rows, other)[0]["change"] == "same"
    assert changes.changes(rows, [{**rows[0], "height": 8.0}])[0]["change"] == "higher"


def test_a_building_without_height_is_compared_by_place(tmp_path):
    rows, _ = changes.read(result(tmp_path / "a", [(1, 0, 0, 10, None), (2, 30, 0, 10, 4)]))
    assert [r["change"] for r in changes.changes(rows, rows)] == ["same", "same"]


def test_empty_results(tmp_path):
    rows, _ = changes.read(result(tmp_path / "a", OLD[:2]))
    assert [r["change"] for r in changes.changes([], rows)] == ["new", "new"]
    assert [r["change"] for r in changes.changes(rows, [])] == ["gone", "gone"]


def test_what_is_no_result_is_refused(tmp_path):
    with pytest.raises(changes.ResultsUnusable, match="give a folder of results"):
        changes.main([str(tmp_path), str(tmp_path)])
