"""Sections of a block where the image shows no ground: tiles under cloud or burnt out."""

import numpy as np
import pytest
import shapely

from kibs_steps import sections
from kibs_steps.grid import Grid, Tiling
from kibs_steps.models import scoring

SIDE, MARGIN = 64, 8
TILING = Tiling(SIDE, MARGIN, 2)
GRID = Grid("EPSG:32631", 0.0, 0.0, 0.38, 96, 96)


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
        views.append(sections.View(tile, labels, np.array([0.9]), scoring.none(1), number))
    return rgb, np.ones(rgb.shape[:2], bool), views, core


@pytest.mark.parametrize(("share", "white", "flagged"), [(0.9, 255, 1), (0.4, 255, 0), (0.9, 230, 0)])
def test_sections_of_a_burnt_out_tile_are_void(share, white, flagged):
    rgb, valid, views, core = block(share, white)
    unclear = sections.unclear(rgb, valid, views, TILING, core, GRID)
    table = sections.pieces(views, unclear, TILING, core)
    assert len(table) == 4
    assert table["void"].to_pylist() == [bool(flagged), False, False, False]
    assert all(shapely.from_wkb(wkb).area == 100 for wkb in table["outline"].to_pylist())


def test_a_section_beside_missing_data_that_begins_at_the_tiles_seam_is_void():
    rgb, valid, views, core = block(0.0)
    views[0].labels[20:30, SIDE - MARGIN - 10 : SIDE - MARGIN] = 1  # reaches the seam to the tile at its right
    valid[MARGIN : MARGIN + 48, MARGIN + 48 :] = False  # which has no data
    table = sections.pieces(views, sections.unclear(rgb, valid, views, TILING, core, GRID), TILING, core)
    assert table["void"].to_pylist() == [True, True, False, False]


def test_a_section_at_the_rasters_edge_is_not_void():
    """Beyond the raster nothing is missing: `edge` says that a roof goes on there."""
    rgb, valid, views, core = block(0.0)
    views[0].labels[20:30, MARGIN : MARGIN + 10] = 1
    valid[:MARGIN], valid[-MARGIN:], valid[:, :MARGIN], valid[:, -MARGIN:] = (False,) * 4
    table = sections.pieces(views, sections.unclear(rgb, valid, views, TILING, core, GRID), TILING, core)
    assert not any(table["void"].to_pylist())


@pytest.mark.parametrize("side", [1, 2])
def test_a_burnt_tile_answers_for_itself_whatever_the_blocks(side):
    """A roof that reaches its seam from the next tile, which is clear."""
    tiling, found = Tiling(SIDE, MARGIN, side), {}
    whole = np.full((96 + 2 * MARGIN, 96 + 2 * MARGIN, 3), 120, np.uint8)
    whole[MARGIN : MARGIN + 48, MARGIN + 48 : MARGIN + 96] = 255
    for place in tiling.blocks(96, 96):
        core = tiling.block_core(place, 96, 96)
        rgb = whole[core.row : core.row + core.height + 2 * MARGIN, core.col : core.col + core.width + 2 * MARGIN]
        views = []
        for number, tile in enumerate(tiling.tiles(place, 96, 96)):
            labels = np.zeros((SIDE, SIDE), np.int32)
            labels[20:30, SIDE - MARGIN - 10 : SIDE - MARGIN] = number + 1
            views.append(sections.View(tile, labels, np.array([0.9]), scoring.none(1), number))
        unclear = sections.unclear(rgb, np.ones(rgb.shape[:2], bool), views, tiling, core, GRID)
        for row in sections.pieces(views, unclear, tiling, core).to_pylist():
            found[row["tile_row"], row["tile_col"]] = row["void"]
    assert found == {(0, 0): False, (0, 1): True, (1, 0): False, (1, 1): False}


@pytest.mark.parametrize("size", [(96, 96), (100, 51), (50, 49), (7, 143)])
def test_networks_see_a_mirror_image_beyond_the_raster(size):
    """Whatever the cut into blocks; numpy's symmetric padding of a tile's own part is the truth."""
    width, height = size
    grid = Grid("EPSG:32631", 0.0, 0.0, 0.38, width, height)
    picture = np.arange(height * width).reshape(height, width, 1)
    around = np.pad(picture, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), constant_values=-1)
    for blocks in (1, 2, 3):
        tiling = Tiling(SIDE, MARGIN, blocks)
        for place in tiling.blocks(width, height):
            core = tiling.block_core(place, width, height)
            part = np.s_[core.row : core.row + core.height + 2 * MARGIN, core.col : core.col + core.width + 2 * MARGIN]
            valid = np.pad(np.ones(size[::-1], bool), MARGIN)[part]
            for tile, seen, data in sections.tile_images(around[part], valid, tiling, place, grid):
                window = tiling.window(tile)
                inside = window.within(grid)
                own = picture[inside.row : inside.row + inside.height, inside.col : inside.col + inside.width]
                before = inside.row - window.row, inside.col - window.col
                after = SIDE - before[0] - inside.height, SIDE - before[1] - inside.width
                expected = np.pad(own, (*zip(before, after, strict=True), (0, 0)), mode="symmetric")
                assert (seen == expected).all()
                rows, cols = np.nonzero(data)
                assert (rows.min(), cols.min()) == before
                assert data.sum() == inside.height * inside.width


def test_a_tile_half_without_data_is_burnt_out_by_what_it_has():
    rgb, valid, views, core = block(0.4)
    valid[MARGIN : MARGIN + 48, MARGIN + 25 :] = False  # 19 of 25 columns are white
    burnt = sections.burnt_out(rgb, valid, views, TILING, core)
    assert burnt[MARGIN : MARGIN + 48, MARGIN : MARGIN + 48].all()
    assert not sections.burnt_out(*block(0.4)[:3], TILING, core).any()


def test_a_coloured_tile_is_not_burnt_out():
    """Red roofs or bare sand may saturate one band; cloud, snow and glare saturate all."""
    rgb, valid, views, core = block(0.9)
    rgb[..., 2] = 120
    assert not sections.burnt_out(rgb, valid, views, TILING, core).any()


def test_sections_end_where_the_data_ends():
    tile = next(iter(TILING.tiles(TILING.blocks(96, 96)[0], 96, 96)))
    roof = np.zeros((SIDE, SIDE), np.float32)
    roof[20:40, 20:40] = 1.0
    outputs = {"roof": roof[None], "edge": 0 * roof[None], "distance": roof[None]}
    terms = {"head": "dense", "tile": SIDE, "thresholds": {"roof": 0.5, "min_area": 10}}
    data = np.ones((SIDE, SIDE), bool)
    data[:, 30:] = False
    view = sections.view_of(tile, np.zeros((SIDE, SIDE, 3), np.uint8), outputs, terms, MARGIN, data, 7)
    assert (view.labels == 8).sum() == 20 * 10
    assert not view.labels[~data].any()
    assert view.evidence[0, scoring.EVIDENCE.index("area")] == 20 * 10
