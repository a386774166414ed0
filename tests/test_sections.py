"""Sections of a block where the image shows no ground: tiles under cloud or burnt out."""

import numpy as np
import pytest
import shapely

from kibs_steps import sections
from kibs_steps.grid import Tiling

SIDE, MARGIN = 64, 8
TILING = Tiling(SIDE, MARGIN, 2)


def block(share: float, white: int = 255):
    """A block of 2 × 2 tiles, grey, one roof in each, the upper left tile white from the left for a `share` of its width."""
    (place,) = TILING.blocks(2 * (SIDE - 2 * MARGIN), 2 * (SIDE - 2 * MARGIN))
    core = TILING.block_core(place, 2 * (SIDE - 2 * MARGIN), 2 * (SIDE - 2 * MARGIN))
    rgb = np.full((core.height + 2 * MARGIN, core.width + 2 * MARGIN, 3), 120, np.uint8)
    rgb[MARGIN : MARGIN + 48, MARGIN : MARGIN + round(48 * share)] = white
    views = []
    for number, tile in enumerate(TILING.tiles(place, 96, 96)):
        labels = np.zeros((SIDE, SIDE), np.int32)
        labels[20:30, 20:30] = number + 1
        views.append(sections.View(tile, labels, np.array([0.9])))
    return rgb, np.ones(rgb.shape[:2], bool), views, core


@pytest.mark.parametrize(("share", "white", "flagged"), [(0.9, 255, 1), (0.4, 255, 0), (0.9, 230, 0)])
def test_sections_of_a_burnt_out_tile_are_void(share, white, flagged):
    rgb, valid, views, core = block(share, white)
    clear = valid & ~sections.burnt_out(rgb, valid, views, TILING, core)
    table = sections.pieces(views, clear, TILING, core)
    assert len(table) == 4
    assert table["void"].to_pylist() == [bool(flagged), False, False, False]
    assert all(shapely.from_wkb(wkb).area == 100 for wkb in table["outline"].to_pylist())
