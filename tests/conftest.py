"""Fixtures shared by all tests; `toy` is importable as a module."""

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks/solids"))  # the second opinion on solids

# The machine's speed is no property of the code, and a failure must come back when one looks for it.
settings.register_profile("kibs", deadline=None, derandomize=True)
settings.load_profile("kibs")


@pytest.fixture
def kibs_data() -> Path:
    """The folder of shared real data; the test is skipped, by name, without it."""
    folder = os.environ.get("KIBS_DATA")
    if not folder:
        pytest.skip("KIBS_DATA is not set: no real data here")
    return Path(folder)
