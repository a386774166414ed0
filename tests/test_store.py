"""Store: files are whole or absent, the same bytes every time, and damage is told by name."""

import numpy as np
import pyarrow as pa
import pytest

from kibs_steps import store, sums


def write_half(path):
    with store.whole(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError("killed")


class TestWhole:
    def test_a_failed_write_leaves_nothing(self, tmp_path):
        with pytest.raises(RuntimeError, match="killed"):
            write_half(tmp_path / "new/a.txt")
        assert list((tmp_path / "new").iterdir()) == []

    def test_a_failed_write_keeps_the_old_file(self, tmp_path):
        (tmp_path / "a.txt").write_text("old")
        with pytest.raises(RuntimeError, match="killed"):
            write_half(tmp_path / "a.txt")
        assert (tmp_path / "a.txt").read_text() == "old"

    def test_the_final_name_appears_at_the_end(self, tmp_path):
        with store.whole(tmp_path / "a.city.json") as temporary:
            temporary.write_text("x")
            assert not (tmp_path / "a.city.json").exists()
            assert temporary.name.endswith("a.city.json")
            assert temporary.parent == tmp_path
        assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["a.city.json"]
        assert (tmp_path / "a.city.json").stat().st_mode & 0o777 == 0o644


class TestJson:
    def test_there_and_back_in_order(self, tmp_path):
        content = {"b": [1, 2.5, None], "a": "Straße"}
        store.write_json(tmp_path / "a.json", content)
        assert store.read_json(tmp_path / "a.json") == content
        assert (tmp_path / "a.json").read_text(encoding="utf-8").index('"b"') < 5

    def test_nan_is_no_json(self, tmp_path):
        with pytest.raises(ValueError, match="JSON"):
            store.write_json(tmp_path / "a.json", {"a": float("nan")})
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("content", [b"", b'{"a": 1', b"\xff\xfe\x00"])
    def test_damage(self, tmp_path, content):
        store.write_json(tmp_path / "a.json", {"a": 1})
        (tmp_path / "a.json").write_bytes(content)
        with pytest.raises(store.DamagedFile, match="is deleted now"):
            store.read_json(tmp_path / "a.json")
        assert not (tmp_path / "a.json").exists()

    def test_what_no_step_wrote_is_never_deleted(self, tmp_path):
        (tmp_path / "mine.json").write_text('{"a": 1')
        with pytest.raises(store.DamagedFile, match="correct it"):
            store.read_json(tmp_path / "mine.json")
        assert (tmp_path / "mine.json").exists()

    def test_files_for_people_have_no_sums(self, tmp_path):
        store.write_json(tmp_path / "mine.json", {"a": 1}, summed=False)
        (tmp_path / "mine.json").write_text('{"a": 2}')
        assert store.read_json(tmp_path / "mine.json") == {"a": 2}


class TestTables:
    TABLE = pa.table({"id": [1, 2, 3], "outline": [b"a", None, b"c"], "score": [0.5, 0.25, 1.0]})

    def test_there_and_back_with_the_same_bytes(self, tmp_path):
        for name in ("a.parquet", "b.parquet"):
            store.write_table(tmp_path / name, self.TABLE)
        assert store.read_table(tmp_path / "a.parquet").equals(self.TABLE)
        assert store.read_table(tmp_path / "a.parquet", ["score"]).column_names == ["score"]
        assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()

    def test_one_blocks_rows(self, tmp_path):
        tables = {"r000c000": self.TABLE, "r000c001": self.TABLE.slice(0, 0), "r001c000": self.TABLE.slice(1)}
        store.write_by_block(tmp_path / "a.parquet", tables)
        for name, table in tables.items():
            assert store.read_table(tmp_path / "a.parquet", block=name).to_pylist() == table.to_pylist()

    @pytest.mark.parametrize("kept", [0, 10, 300])
    def test_damage(self, tmp_path, kept):
        store.write_table(tmp_path / "a.parquet", self.TABLE)
        (tmp_path / "a.parquet").write_bytes((tmp_path / "a.parquet").read_bytes()[:kept])
        with pytest.raises(store.DamagedFile, match="is deleted now"):
            store.read_table(tmp_path / "a.parquet")

    def test_a_missing_file_is_not_damage(self, tmp_path):
        with pytest.raises(sums.MissingFile, match="is gone"):
            store.read_table(tmp_path / "a.parquet")


class TestArrays:
    ARRAYS = {"labels": np.arange(5000, dtype=np.uint32).reshape(50, 100), "none": np.zeros((0, 2))}  # noqa: RUF012

    def test_there_and_back_with_the_same_bytes(self, tmp_path):
        for name in ("a.npz", "b.npz"):
            store.write_arrays(tmp_path / name, self.ARRAYS)
        back = store.read_arrays(tmp_path / "a.npz")
        assert all((back[key] == value).all() and back[key].dtype == value.dtype for key, value in self.ARRAYS.items())
        assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()

    @pytest.mark.parametrize("kept", [0, 3, 500])
    def test_truncation(self, tmp_path, kept):
        store.write_arrays(tmp_path / "a.npz", self.ARRAYS)
        (tmp_path / "a.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:kept])
        with pytest.raises(store.DamagedFile, match="is deleted now"):
            store.read_arrays(tmp_path / "a.npz")

    def test_flipped_bytes(self, tmp_path):
        store.write_arrays(tmp_path / "a.npz", self.ARRAYS)
        content = bytearray((tmp_path / "a.npz").read_bytes())
        content[200:260] = bytes(60)
        (tmp_path / "a.npz").write_bytes(content)
        with pytest.raises(store.DamagedFile, match="is deleted now"):
            store.read_arrays(tmp_path / "a.npz")


@pytest.mark.parametrize("cuts", [[], [3], [10, 11, 40], list(range(1, 60, 7))])
def test_merged_tables_are_one_sorted_table(tmp_path, cuts):
    """Whatever the cut into files and row groups, rows come in order, all of them, in parts."""
    rng = np.random.default_rng(len(cuts))
    ids = np.arange(60) + rng.integers(-6, 7, 60)  # out of order by less than a file
    table = pa.table({"id": ids, "x": rng.normal(size=60)})
    paths = []
    for k, part in enumerate(np.split(np.arange(60), cuts)):
        paths.append(tmp_path / f"{k}.parquet")
        store.write_by_block(
            paths[-1], {"a": table.take(part[::2]), "none": table.slice(0, 0), "b": table.take(part[1::2])}
        )
    parts = list(store.merged(paths[::-1], ["id", "x"], ["id", "x"]))
    assert pa.concat_tables(parts).equals(table.sort_by([("id", "ascending"), ("x", "ascending")]))
    assert len(cuts) < 3 or len(parts) > 2


def test_merging_nothing_gives_the_columns(tmp_path):
    store.write_table(tmp_path / "a.parquet", pa.table({"id": pa.array([], pa.int64())}))
    (part,) = store.merged([tmp_path / "a.parquet"], ["id"])
    assert part.column_names == ["id"]
    assert len(part) == 0
