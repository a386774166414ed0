"""How every step's command line ends: a user's error is one readable message and exit code 1, never a traceback alone."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from typing import Any

from kibs_steps.errors import AGAIN, KibsError


def run(main: Callable[[], None], pandas: bool = True) -> None:
    """Call `main`; whatever it raises ends the process with code 1 and a last line on stderr that says what to do.

    A mistake of ours shows its traceback above that line. `pandas` False: the step uses none, and shall not wait half a second
    for pyarrow to import it.
    """
    if not pandas:
        sys.meta_path.insert(0, _NoPandas)
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:  # who reads along has seen enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except Exception as error:
        text = told(error)
        if text is None:
            traceback.print_exc()
            text = f"{type(error).__name__} ({error}): a mistake in KIBS; please report it with the lines above"
        print(f"error: {text}", file=sys.stderr)
        raise SystemExit(1) from None


def or_exit(function: Callable, *arguments: Any) -> Any:
    """What a function returns; where it raises a user's error, the process ends with one line that says what to do."""
    try:
        return function(*arguments)
    except Exception as error:
        text = told(error)
        if text is None:
            raise
        raise SystemExit(f"error: {text}") from None


def told(error: Exception) -> str | None:
    """What to say of an error that is not ours; None if it is."""
    if isinstance(error, KibsError):
        return str(error)
    if isinstance(error, MemoryError):
        return "there is not enough memory: give the job more, or make it smaller (block=4)"
    if isinstance(error, PermissionError):
        return f"{error.filename} may not be read or written by this user: change its permissions, then {AGAIN}"
    return None


class _NoPandas:
    """An importer that has no pandas: pyarrow looks for it, to know a Series when it is given one, and does without."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("this step uses no pandas", name=name)
