"""How every step's command line ends: a user's error is one readable message and exit code 1, never a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable

from kibs_steps.errors import KibsError


def run(main: Callable[[], None], pandas: bool = True) -> None:
    """Call `main`; a `KibsError` is printed to stderr as it is and ends the process with code 1.

    `pandas` False: the step uses none, and shall not wait half a second for pyarrow to import it.
    """
    if not pandas:
        sys.meta_path.insert(0, _NoPandas)
    try:
        main()
    except KibsError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None


class _NoPandas:
    """An importer that has no pandas: pyarrow looks for it, to know a Series when it is given one, and does without."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("this step uses no pandas", name=name)
