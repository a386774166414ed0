"""Supposed directions: a painted doubt's least is found, what is known is kept, little roof is no sureness."""

import numpy as np
import pytest
import shapely

from kibs_steps import supposed, view
from kibs_steps.grid import Grid, Tiling
from kibs_steps.scene import Direction, Region, Scene


def apart(one: Direction, other: Direction) -> float:
    """Between two leans, m per m."""
    return float(np.hypot(*np.subtract(one.lean, other.lean)))


def looking_for(view: Direction, sun: Direction, roof: float = 0.2) -> supposed.Look:
    """A network that doubts more the further it is told from the true view and sun."""

    def look(seen: Direction | None, lit: Direction | None) -> supposed.Doubt:
        off = (1.0 if seen is None else apart(seen, view)) + (2.0 if lit is None else apart(lit, sun))
        return supposed.Doubt(0.1 + 0.1 * off, roof)

    return look


@pytest.mark.parametrize(("azimuth", "sun_azimuth"), [(45.0, 180.0), (270.0, 135.0)])
def test_the_directions_of_least_doubt_are_found(azimuth, sun_azimuth):
    true_view = Direction(azimuth, 50.0, supposed.geometry.lean(azimuth, 50.0))
    true_sun = Direction(sun_azimuth, 30.0, supposed.geometry.lean(sun_azimuth, 30.0))
    assert supposed.directions(looking_for(true_view, true_sun), None, None) == (true_view, true_sun)


def test_nadir_is_a_view():
    sun = Direction(180.0, 45.0, supposed.geometry.lean(180.0, 45.0))
    assert supposed.directions(looking_for(supposed.NADIR, sun), None, None).view == supposed.NADIR


def test_what_is_known_is_kept():
    view = Direction(12.0, 66.0, supposed.geometry.lean(12.0, 66.0))
    sun = Direction(170.0, 41.0, supposed.geometry.lean(170.0, 41.0))
    assert supposed.directions(looking_for(view, sun), view, None).view == view
    assert supposed.directions(looking_for(view, sun), None, sun).sun == sun
    assert supposed.directions(looking_for(view, sun), view, sun) == (view, sun)


def test_who_sees_little_is_not_sure_of_the_view():
    """With half of the entropy but a quarter of the roof a view is the worse one."""
    seeing = supposed.doubt(np.repeat([0.9, 0.1], [40, 60]), np.full(100, 0.05))
    blind = supposed.doubt(np.repeat([0.9, 0.02], [10, 90]), np.full(100, 0.02))
    assert blind.entropy < seeing.entropy
    assert blind.by_roof > seeing.by_roof
    assert seeing.roof == 0.4


def test_doubt_is_entropy():
    found = supposed.doubt(np.full(9, 0.5), np.full(9, 0.5))
    assert found.entropy == pytest.approx(2 * np.log(2))
    assert supposed.doubt(np.ones(9), np.zeros(9)).entropy < 0.01


def test_tiles_looked_over_are_spread_over_the_raster():
    tiling = Tiling(96, 8, 2)
    grid = Grid("EPSG:32631", 0.0, 0.0, 0.4, 800, 800)
    tiles = supposed.looked_over(tiling, grid)
    assert len(tiles) == supposed.LOOKED_OVER
    assert len({(t.row, t.col) for t in tiles}) == len(tiles)
    few = supposed.looked_over(tiling, Grid("EPSG:32631", 0.0, 0.0, 0.4, 100, 60))
    assert [(t.row, t.col) for t in few] == [(0, 0), (0, 1)]


def test_networks_are_told_the_view_of_the_region_a_tile_lies_in(tmp_path):
    """Blocks are larger than regions may be."""
    grid = Grid("EPSG:32631", 500_000.0, 5_400_000.0, 0.38, 1792, 1792)
    left, bottom, right, top = grid.bounds
    border = left + 500 * grid.gsd
    parts = (shapely.box(left, bottom, border, top), shapely.box(border, bottom, right, top))
    directions = [Direction(a, 60.0, view.lean(a, 60.0)) for a in (90.0, 270.0)]
    regions = tuple(Region(part, seen) for part, seen in zip(parts, directions, strict=True))
    facts = Scene("a", "a.tif", (1, 2, 3), None, grid, None, None, None, tmp_path, regions=regions)
    telling = supposed.telling(facts, None)
    for side in (1, 4):
        tiling = Tiling(512, 32, side)
        for block in tiling.blocks(grid.width, grid.height):
            for tile in tiling.tiles(block, grid.width, grid.height):
                told = telling(tile.core)
                mine = directions[tile.core.col + tile.core.width / 2 > 500]
                assert told[0, 0] == pytest.approx(-mine.lean[0] / grid.gsd)
                assert told[0, 4] == 1
