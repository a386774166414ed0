"""The table of bad inputs: what a case is, and how one is added (`bad_rasters`, `bad_settings`)."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple


class Case(NamedTuple):
    """A row of the page: its part, what the user gave, the error's name and message, and a function that makes the files in
    a folder and returns the settings (beside a good raster, terrain and models).
    """

    part: str
    given: str
    error: str
    message: str
    make: Callable[[Path], dict]


CASES: list[Case] = []


def case(part: str, given: str, error: str, message: str) -> Callable:
    """Add a function to the table."""

    def add(make: Callable[[Path], dict]) -> Callable[[Path], dict]:
        CASES.append(Case(part, given, error, message, make))
        return make

    return add


def pattern(message: str) -> re.Pattern:
    """What a message with `…` matches."""
    return re.compile(".*".join(map(re.escape, message.split("…"))), re.S)
