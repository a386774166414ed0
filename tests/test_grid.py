"""Grid: coordinates go there and back; tiles and blocks cover the grid once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps.grid import Grid, Tiling, Window

GRID = Grid("EPSG:32631", 500_000.0, 5_400_000.0, 0.38, 1000, 800)
SIDES = st.integers(1, 120)
TILINGS = st.integers(0, 20).flatmap(
    lambda p: st.builds(Tiling, st.integers(2 * p + 1, 2 * p + 60), st.just(p), st.integers(1, 9))
)


class TestGrid:
    def test_origin_and_axes(self):
        assert GRID.to_map(np.array([[0, 0], [1000, 0], [0, 800]])).tolist() == [
            [500_000, 5_400_000],
            [500_380, 5_400_000],
            [500_000, 5_399_696],
        ]
        assert GRID.bounds == (500_000, 5_399_696, 500_380, 5_400_000)

    def test_agrees_with_the_transform(self):
        points = np.random.default_rng(0).uniform(-100, 1100, (50, 2))
        expected = [GRID.transform * tuple(point) for point in points]
        assert np.allclose(GRID.to_map(points), expected, atol=1e-9)

    @given(st.floats(-1e4, 1e5), st.floats(-1e4, 1e5))
    def test_there_and_back(self, col, row):
        assert np.allclose(GRID.to_image(GRID.to_map(np.array([[col, row]]))), [[col, row]], atol=1e-6)

    def test_any_leading_shape(self):
        assert GRID.to_map(np.zeros((0, 2))).shape == (0, 2)
        assert GRID.to_image(np.zeros((4, 5, 2))).shape == (4, 5, 2)


class TestTiling:
    @given(TILINGS, SIDES, SIDES)
    def test_cores_cover_the_grid_once(self, tiling, width, height):
        counted = np.zeros((height, width), int)
        for block in tiling.blocks(width, height):
            for tile in tiling.tiles(block, width, height):
                c = tile.core
                assert c.width > 0
                assert c.height > 0
                counted[c.row : c.row + c.height, c.col : c.col + c.width] += 1
        assert (counted == 1).all()

    @given(TILINGS, SIDES, SIDES)
    def test_blocks_hold_just_their_tiles(self, tiling, width, height):
        for block in tiling.blocks(width, height):
            core = tiling.block_core(block, width, height)
            cores = [tile.core for tile in tiling.tiles(block, width, height)]
            assert sum(c.width * c.height for c in cores) == core.width * core.height
            assert all(core.col <= c.col and c.col + c.width <= core.col + core.width for c in cores)
            assert all(core.row <= c.row and c.row + c.height <= core.row + core.height for c in cores)
            assert tiling.block_of(block.name) == block

    @given(TILINGS, SIDES, SIDES)
    def test_a_window_is_its_core_grown_to_a_full_tile(self, tiling, width, height):
        for block in tiling.blocks(width, height):
            for tile in tiling.tiles(block, width, height):
                full = tiling.window(tile)
                assert (full.width, full.height) == (tiling.tile, tiling.tile)
                assert (full.col, full.row) == (tile.core.col - tiling.margin, tile.core.row - tiling.margin)

    def test_the_papers_raster_has_2016_tiles(self):
        """8687 × 9890 px with s = 230, p = 10: stride 210."""
        rows, cols = Tiling(230, 10, 8).shape(8687, 9890)
        assert rows * cols == 48 * 42 == 2016

    def test_window_grown(self):
        assert Window(5, 6, 10, 20).grown(3) == Window(2, 3, 16, 26)

    def test_names_of_large_grids(self):
        tiling = Tiling(10, 0, 1)
        names = [block.name for block in tiling.blocks(30, 12_000)]
        assert names[-1] == "r1199c002"
        assert len(set(names)) == 3600
        assert tiling.block_of("r1199c002").row == 1199


@pytest.mark.parametrize("block", [1, 2, 5])
def test_block_size_only_regroups_tiles(block):
    def windows(side):
        tiling = Tiling(64, 8, side)
        return sorted(tiling.window(t) for b in tiling.blocks(1000, 800) for t in tiling.tiles(b, 1000, 800))

    assert windows(block) == windows(8)
