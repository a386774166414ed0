"""Steps of a block start quickly: what they do not need they do not import, and pyarrow finds no pandas."""

import subprocess
import sys

import pytest

SLOW = {"scipy", "skimage", "pandas", "geopandas", "onnx", "jsonschema", "torch", "snakemake", "pyogrio"}
MAIN = "import sys, {name}; print(*{slow!r} & sys.modules.keys())"
NO_PANDAS = """
from kibs_steps import cli
def main():
    import numpy as np, pyarrow as pa, sys
    table = pa.table({"a": np.array([1.0, np.nan]), "b": pa.array([1, None])})
    assert table.sort_by("b").filter(pa.array([True, False])).num_rows == 1
    assert "pandas" not in sys.modules
cli.run(main, pandas=False)
"""


@pytest.mark.parametrize("step", ["tiles", "sections", "single", "blend", "corners", "planes", "ground", "stitch"])
def test_a_step_imports_nothing_slow(step):
    code = MAIN.format(name=f"kibs_steps.{step}", slow=SLOW)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_step_without_pandas_works_without_it():
    done = subprocess.run([sys.executable, "-c", NO_PANDAS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
