"""Sums: what is read is what was written, under the name it was written for.

Beside every file a step writes lies `.sums/NAME` with its size and a CRC-32 of every 64 KiB. A reader checks just the chunks
it reads, so a window of a large file costs a window. The sums lie in the file's folder and not in the file: content that was
swapped with another block's, whole and sound in itself, is noticed too.
"""

from __future__ import annotations

import contextlib
import io
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from kibs_steps.errors import AGAIN, KibsError

CHUNK = 1 << 16
FOLDER = ".sums"


class DamagedFile(KibsError):
    """An intermediate file that is not what was written."""


class MissingFile(KibsError):
    """An intermediate file that is gone."""


class Sums(NamedTuple):
    """Size (bytes) of a file and the CRC-32 of each of its chunks."""

    size: int
    chunks: list[int]


def place(path: str | Path) -> Path:
    """Where the sums of a file lie."""
    path = Path(path)
    return path.parent / FOLDER / path.name


def of_file(path: str | Path) -> Sums:
    """The sums of a file as it is now."""
    chunks, size = [], 0
    with open(path, "rb") as source:
        while chunk := source.read(CHUNK):
            chunks.append(zlib.crc32(chunk))
            size += len(chunk)
    return Sums(size, chunks)


def write(path: str | Path, sums: Sums) -> None:
    """Write the sums of the file that is, or is about to be, at `path`."""
    target = place(path)
    target.parent.mkdir(exist_ok=True)
    temporary = target.with_name(f".tmp-{os.getpid()}-{target.name}")
    try:
        temporary.write_text(f"{sums.size}\n" + "".join(f"{c:08x}" for c in sums.chunks) + "\n", encoding="ascii")
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def recorded(path: str | Path) -> Sums | None:
    """The sums written with a file; None if there are none. Raises `DamagedFile` if they are no sums."""
    try:
        size, text = place(path).read_text(encoding="ascii").split("\n")[:2]
        return Sums(int(size), [int(text[i : i + 8], 16) for i in range(0, len(text), 8)])
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise DamagedFile(f"the checksums of {path} are damaged") from error


def problem(path: str | Path) -> str | None:
    """What is wrong with a file, judged by its sums; None if nothing is, or there are none."""
    try:
        wanted = recorded(path)
    except DamagedFile as error:
        return str(error)
    if wanted is None:
        return None
    size = Path(path).stat().st_size
    if size != wanted.size:
        return f"it has {size} bytes of {wanted.size}"
    found = of_file(path)
    wrong = [i for i, (a, b) in enumerate(zip(found.chunks, wanted.chunks, strict=False)) if a != b]
    if wrong or len(found.chunks) != len(wanted.chunks):
        return f"its checksum is wrong at byte {wrong[0] * CHUNK if wrong else 0}"
    return None


def discard(path: str | Path) -> None:
    """Delete a file and its sums: Snakemake makes again what is not there."""
    Path(path).unlink(missing_ok=True)
    place(path).unlink(missing_ok=True)


def damaged(path: str | Path, what: object) -> DamagedFile:
    """The error for a damaged file; one that a step wrote is deleted, so that the next run makes it again."""
    if not place(path).exists():
        return DamagedFile(f"{path} is damaged ({what}): correct it, or delete it if a run makes it")
    discard(path)
    return DamagedFile(f"{path} is damaged ({what}): it is deleted now, {AGAIN} and it is made again")


def check(path: str | Path) -> None:
    """Compare a whole file with its sums. Raises `MissingFile`, and `DamagedFile` (the file is deleted then)."""
    try:
        wrong = problem(path)
    except FileNotFoundError as error:
        raise gone(path) from error
    if wrong:
        raise damaged(path, wrong)


def gone(path: str | Path) -> MissingFile:
    """The error for a file that another step has found damaged and deleted, or that somebody has deleted."""
    return MissingFile(f"{path} is gone: {AGAIN} and it is made again")


class Checked(io.RawIOBase):
    """A file open for reading that compares every chunk it reads with its sum; `wrong` says what it found amiss."""

    def __init__(self, path: str | Path):
        self.source = open(path, "rb")  # noqa: SIM115 (closed by `close`)
        self.wrong: str | None = None
        self.path, self.sums = path, None
        self.position, self.number, self.chunk = 0, -1, b""
        self.size = os.fstat(self.source.fileno()).st_size

    def begin(self) -> None:
        """Read the sums and compare the size."""
        try:
            self.sums = recorded(self.path)
        except DamagedFile as error:
            self._refuse(str(error))
        if self.sums and self.size != self.sums.size:
            self._refuse(f"it has {self.size} bytes of {self.sums.size}")

    def _refuse(self, what: str) -> None:
        self.wrong = what
        raise DamagedFile(what)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self.position = offset + (0, self.position, self.size)[whence]
        return self.position

    def tell(self) -> int:
        return self.position

    def readinto(self, buffer) -> int:
        number, start = divmod(self.position, CHUNK)
        if number != self.number:
            self.source.seek(number * CHUNK)
            self.chunk, self.number = self.source.read(CHUNK), number
            known = self.sums.chunks if self.sums else []
            if self.chunk and self.sums and (number >= len(known) or zlib.crc32(self.chunk) != known[number]):
                self._refuse(f"its checksum is wrong at byte {number * CHUNK}")
        part = self.chunk[start : start + len(buffer)]
        buffer[: len(part)] = part
        self.position += len(part)
        return len(part)

    def close(self) -> None:
        self.source.close()
        super().close()


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator[BinaryIO]:
    """A step's file, open for reading, every chunk checked as it is read.

    Raises `MissingFile` if it is gone, and `DamagedFile` (the file is deleted then) where it is not what was written, also
    when a library between the caller and the file has swallowed that.
    """
    try:
        raw = Checked(path)
    except FileNotFoundError as error:
        raise gone(path) from error
    try:
        with io.BufferedReader(raw, CHUNK) as file:
            raw.begin()
            yield file
    except Exception:
        if not raw.wrong:
            raise
        raise damaged(path, raw.wrong) from None
    if raw.wrong:
        raise damaged(path, raw.wrong)
