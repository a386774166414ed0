"""How steps write and read their files: whole or not at all, and the same bytes every time.

A file appears under its final name only when it is complete (written under a temporary name beside it, then renamed),
so a killed job never leaves half a file that looks like a result. Its checksums are written with it, and compared by every
reader (`sums`).
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kibs_steps import sums
from kibs_steps.errors import AGAIN, KibsError
from kibs_steps.sums import DamagedFile  # noqa: F401 (raised by the readers here)

FULL = 1 << 16  # bytes free on a disk that is as good as full

if TYPE_CHECKING:
    import pyarrow as pa


class DiskFull(KibsError):
    """There is no room for a result."""


@contextlib.contextmanager
def whole(path: str | Path, summed: bool = True) -> Iterator[Path]:
    """Yield a temporary path with `path`'s suffixes beside it; rename it to `path` when the block ends without error.

    `summed`: with checksums (`sums`), as files of a scene are; not what people edit, move and replace themselves. Raises
    `DiskFull` where the disk has no room for it, also when the library that wrote it did not notice.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=".tmp-", suffix="-" + path.name, dir=path.parent)
    except OSError as error:
        raise _told(error, path) from error
    os.close(handle)
    temporary = Path(name)
    temporary.chmod(0o644)
    try:
        yield temporary
        if shutil.disk_usage(path.parent).free < FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if summed:
            sums.write(path, sums.of_file(temporary))
        else:
            sums.place(path).unlink(missing_ok=True)
        os.replace(temporary, path)
    except Exception as error:
        raise _told(error, path) from error
    finally:
        temporary.unlink(missing_ok=True)


def _told(error: Exception, path: Path) -> Exception:
    """The error as it is, or `DiskFull` where that is behind it."""
    number = getattr(error, "errno", None)
    folder = next(f for f in (path.parent, *path.parents) if f.is_dir())
    if number in (errno.ENOSPC, errno.EDQUOT) or shutil.disk_usage(folder).free < FULL:
        return DiskFull(f"no space left for {path}: free some of the disk, then {AGAIN}")
    return error


def write_json(path: str | Path, content: Any, summed: bool = True) -> None:
    """Write JSON with two-space indent, keys in the order given; `summed` as in `whole`."""
    with whole(path, summed) as temporary:
        temporary.write_text(
            json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8"
        )


def read_json(path: str | Path) -> Any:
    """Read a JSON file; a file that is not JSON raises `DamagedFile`."""
    with sums.opened(path) as source:
        try:
            return json.load(source)
        except ValueError as error:
            raise sums.damaged(path, error) from error


def write_table(path: str | Path, table: pa.Table) -> None:
    """Write an Arrow table as Parquet (zstd)."""
    import pyarrow.parquet as pq

    with whole(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


@contextlib.contextmanager
def by_block(path: str | Path, schema: pa.Schema) -> Iterator[Callable[[str, pa.Table], None]]:
    """Yield a function that appends one block's table to a Parquet file, with a column `block`.

    Every block has row groups of its own, so a reader of one block skips the others and a writer holds one at a time.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with whole(path) as temporary:
        named = schema.append(pa.field("block", pa.string()))
        with pq.ParquetWriter(temporary, named, compression="zstd") as target:

            def append(name: str, table: pa.Table) -> None:
                target.write_table(table.append_column("block", pa.array([name] * len(table), pa.string())))

            yield append


def write_by_block(path: str | Path, tables: dict[str, pa.Table]) -> None:
    """Write one table per block to one Parquet file (`by_block`)."""
    with by_block(path, next(iter(tables.values())).schema) as append:
        for name, table in tables.items():
            append(name, table)


def read_table(path: str | Path, columns: list[str] | None = None, block: str | None = None) -> pa.Table:
    """Read a Parquet table, or one block's rows of it (without the column `block`); damage raises `DamagedFile`.

    By `ParquetFile`: `pyarrow.parquet.read_table` imports pyarrow's data sets, and with them pandas. Without threads: blocks run
    beside each other anyway, and a short step that ends while its pool still starts is aborted.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with sums.opened(path) as file:
        try:
            with pq.ParquetFile(file) as source:
                if block is None:
                    return source.read(columns, use_threads=False)
                key = source.schema_arrow.names.index("block")
                facts = [source.metadata.row_group(i) for i in range(source.num_row_groups)]
                mine = [i for i, g in enumerate(facts) if g.num_rows and g.column(key).statistics.min == block]
                table = (
                    source.read_row_groups(mine, columns, use_threads=False)
                    if mine
                    else source.schema_arrow.empty_table()
                )
                kept = [name for name in columns or table.column_names if name != "block"]
                return table.select(kept)
        except (pa.ArrowInvalid, OSError) as error:
            raise sums.damaged(path, error) from error


def merged(paths: list[str] | list[Path], order: list[str], columns: list[str] | None = None) -> Iterator[pa.Table]:
    """The rows of many tables in ascending `order`, some at a time; at least one table, which may be empty.

    Row groups are read in order of their smallest first key, and rows leave once no later group can come before them: when
    ids run along the raster, as sections' do, about a row of blocks is in memory. Raises `DamagedFile`.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    groups = []
    held = None
    for path in paths:
        with sums.opened(path) as file:
            try:
                facts = pq.read_metadata(file)
            except (pa.ArrowInvalid, OSError) as error:
                raise sums.damaged(path, error) from error
        schema = facts.schema.to_arrow_schema()
        if held is None:
            held = schema.empty_table().select(columns or schema.names)
        key = schema.names.index(order[0])
        some = ((facts.row_group(i), i) for i in range(facts.num_row_groups))
        groups += [(g.column(key).statistics.min, str(path), i) for g, i in some if g.num_rows]
    groups.sort()
    by = [(name, "ascending") for name in order]
    if not groups:
        yield held
    for k, (_, path, i) in enumerate(groups):
        with sums.opened(path) as file:
            try:
                rows = pq.ParquetFile(file).read_row_group(i, columns, use_threads=False)
            except (pa.ArrowInvalid, OSError) as error:
                raise sums.damaged(path, error) from error
        held = pa.concat_tables([held, rows], promote_options="permissive")
        if k + 1 < len(groups):
            leaves = pc.less(held[order[0]], groups[k + 1][0])
            ready, held = held.filter(leaves), held.filter(pc.invert(leaves))
        else:
            ready = held
        if len(ready):
            yield ready.sort_by(by)


def write_arrays(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    """Write named arrays as a compressed npz."""
    with whole(path) as temporary, temporary.open("wb") as target:
        np.savez_compressed(target, **arrays)


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Read named arrays; a damaged file raises `DamagedFile`."""
    with sums.opened(path) as file:
        try:
            with np.load(file, allow_pickle=False) as source:
                return {name: source[name] for name in source.files}
        except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise sums.damaged(path, error) from error
