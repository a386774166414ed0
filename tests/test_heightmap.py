"""Sums of a height map against closed-form planes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import heightmap

SIDE, STRIDE = 64, 4
COL, ROW = 12_000.0, 20_000.0  # of the tile in a large image


def plane_map(a: float, b: float, c: float) -> np.ndarray:
    """Cells of z = a·x + b·y + c, x and y px from the tile's corner."""
    at = (np.arange(SIDE // STRIDE) + 0.5) * STRIDE
    return a * at[None, :] + b * at[:, None] + c


def labels() -> np.ndarray:
    """An L and a bar."""
    image = np.zeros((SIDE, SIDE), np.int64)
    image[8:40, 8:20] = image[28:40, 8:48] = 3
    image[48:60, 10:60] = 7
    return image


@given(a=st.floats(-1, 1), b=st.floats(-1, 1), c=st.floats(0, 30))
def test_points_lie_on_the_plane_of_the_cells(a, b, c):
    mean = plane_map(a, b, c)
    found, sums = heightmap.sums_by_label(labels(), mean, np.full_like(mean, 0.5), COL, ROW)
    assert found.tolist() == [3, 7]
    for row in sums:
        col, line, height, sigma = heightmap.points(row).T
        assert height == pytest.approx(a * (col - COL) + b * (line - ROW) + c, abs=1e-4)
        assert (sigma > 0).all()


def test_points_weigh_what_the_cells_weigh():
    """Number, middle and spread of the cells come back from the four points."""
    mean = plane_map(0.1, 0.2, 5.0)
    image = labels()
    (row,) = heightmap.sums_by_label(np.where(image == 3, 3, 0), mean, np.ones_like(mean), 0.0, 0.0)[1]
    i, j = np.nonzero(heightmap.cells_of(image, STRIDE) == 3)
    cells = np.column_stack([j + 0.5, i + 0.5]) * STRIDE
    four = heightmap.points(row)[:, :2]
    assert row[0] == len(cells)
    assert four.mean(0) == pytest.approx(cells.mean(0))
    assert np.cov(four.T, bias=True) == pytest.approx(np.cov(cells.T, bias=True))


def test_sums_of_two_tiles_are_those_of_one():
    mean = plane_map(0.1, -0.3, 9.0) + np.random.default_rng(1).normal(0, 1, (SIDE // STRIDE,) * 2)
    sigma = np.ones_like(mean)
    left, right = labels(), labels()
    left[:, 32:] = right[:, :32] = 0
    whole = dict(zip(*heightmap.sums_by_label(labels(), mean, sigma, COL, ROW), strict=True))
    parts = [dict(zip(*heightmap.sums_by_label(part, mean, sigma, COL, ROW), strict=True)) for part in (left, right)]
    for label, sums in whole.items():
        assert sum(part[label] for part in parts) == pytest.approx(sums, rel=1e-12)


def test_one_cell_is_level_and_none_is_nothing():
    image = np.zeros((SIDE, SIDE), np.int64)
    image[8:12, 8:12] = 1
    (row,) = heightmap.sums_by_label(image, plane_map(0.5, 0.0, 3.0), np.full((16, 16), 2.0), 0.0, 0.0)[1]
    four = heightmap.points(row)
    assert four[:, 2] == pytest.approx(0.5 * 10 + 3.0)
    assert four[:, :2] == pytest.approx(10.0)
    assert len(heightmap.points(np.array(heightmap.EMPTY))) == 0


def test_table_and_back():
    sums = np.arange(3.0 * len(heightmap.SUMS)).reshape(3, -1)
    table = heightmap.table(np.array([4, 5, 9]), sums)
    assert (heightmap.column(table["sums"]) == sums).all()
    assert (heightmap.column(table.slice(1, 1)["sums"]) == sums[1:2]).all()


def test_points_are_as_sure_together_as_the_cells():
    """Only LOCAL of a cell's σ is its own: n cells tell as much as four points of LOCAL·σ·√(4/n) each."""
    (row,) = heightmap.sums_by_label(np.where(labels() == 3, 3, 0), plane_map(0, 0, 5.0), np.full((16, 16), 2.0), 0, 0)[
        1
    ]
    sigma = heightmap.points(row)[:, 3]
    assert (sigma**-2).sum() == pytest.approx(row[0] * (heightmap.LOCAL * 2.0) ** -2)
