"""How every step's command line ends: a user's error is one readable message and exit code 1, never a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable

from kibs_steps.errors import KibsError


def run(main: Callable[[], None]) -> None:
    """Call `main`; a `KibsError` is printed to stderr as it is and ends the process with code 1."""
    try:
        main()
    except KibsError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
