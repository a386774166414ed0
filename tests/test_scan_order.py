"""The paper's reconciliation against scikit-image's own flood fill, pixel by pixel in scan order."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from skimage.segmentation import flood_fill

from kibs_steps import scan_order, sections, stitch
from kibs_steps.grid import Tile, Tiling, Window
from kibs_steps.models import scoring

TILING = Tiling(24, 2, 2)
CORE = TILING.stride


def tiles(side: str) -> list[Tile]:
    """Two tiles, the second east or south of the first."""
    at = [(0, 0), (0, 1)] if side == "east" else [(0, 0), (1, 0)]
    return [Tile(r, c, Window(c * CORE, r * CORE, CORE, CORE)) for r, c in at]


def literal(views: list[sections.View], splits: list[int], side: str) -> np.ndarray:
    """The paper's way: codes of both cores laid together, then flood fills from every pixel in scan order."""
    cores = [
        np.where(sections.core_of(scan_order.apart(v.labels), v.tile, TILING.margin) > 0, scan_order.CODES[s], 0)
        for v, s in zip(views, splits, strict=True)
    ]
    mosaic = np.concatenate(cores, axis=1 if side == "east" else 0)
    done = np.zeros(mosaic.shape, bool)
    for row, col in np.ndindex(mosaic.shape):
        if mosaic[row, col] and not done[row, col]:
            before = flood_fill(mosaic, (row, col), -1, tolerance=70) == -1
            mosaic[before] = mosaic[row, col]
            done |= before
    return mosaic


@given(st.sampled_from(["east", "south"]), st.lists(st.integers(0, 2), min_size=2, max_size=2), st.integers(0, 10**6))
def test_touching_pieces_are_what_a_flood_fill_joins(side, splits, seed):
    """Rectangles seen by both tiles, each a little differently; codes of all pixels are as the paper's own loop leaves them."""
    rng = np.random.default_rng(seed)
    world = np.zeros((2 * CORE + 8, 2 * CORE + 8), np.int32)
    for label in range(1, 7):
        row, col = rng.integers(0, 2 * CORE, 2)
        world[row : row + rng.integers(3, 14), col : col + rng.integers(3, 14)] = label
    views, used = [], 0
    for tile in tiles(side):
        window = TILING.window(tile)
        jitter = rng.integers(0, 3, 2)
        part = world[window.row + 2 + jitter[0] :, window.col + 2 + jitter[1] :][:24, :24]
        labels, n = connected(part)
        shown = np.where(labels > 0, labels + used, 0).astype(np.int32)
        views.append(sections.View(tile, shown, np.ones(n), scoring.none(n), used))
        used += n
    links = sections.inner_links(views, TILING.margin, "touch")
    pieces = {}
    for view, split in zip(views, splits, strict=True):
        inside = sections.core_of(scan_order.apart(view.labels), view.tile, TILING.margin)
        for label, outline in sections.pixel_outlines(inside, view.tile.core).items():
            pieces[label] = (shapely.from_wkb(outline), split)
    names = sorted(pieces)
    place = {label: i for i, label in enumerate(names)}
    group = stitch.groups(len(names), np.array([(place[a], place[b]) for a, b in links.tolist()], int).reshape(-1, 2))
    outlines = np.array([pieces[label][0] for label in names], object)
    split = np.array([pieces[label][1] for label in names], int)
    found = scan_order.first_come(outlines, group, split) if names else split
    expected = literal(views, splits, side)
    for outline, code in zip(outlines, found, strict=True):
        col, row = np.floor(shapely.get_coordinates(shapely.point_on_surface(outline))[0]).astype(int)
        assert expected[row, col] == scan_order.CODES[code]


def connected(labels: np.ndarray) -> tuple[np.ndarray, int]:
    """Labels whose pixel-separated parts are sections of their own, as a flood fill would have them."""
    from scipy import ndimage

    kept = scan_order.apart(labels)
    return ndimage.label(kept, np.ones((3, 3)))


def test_sections_are_pixel_separated():
    labels = np.zeros((9, 12), np.int32)
    labels[1:5, 1:6], labels[1:5, 6:11], labels[5:8, 1:11] = 1, 2, 3
    kept = scan_order.apart(labels)
    for row, col in zip(*np.nonzero(kept), strict=True):
        around = kept[row - 1 : row + 2, col - 1 : col + 2]
        assert set(around[around > 0]) == {kept[row, col]}
    assert (kept[2, 1:5] == 1).all()
    assert kept[2, 0] == 0
    assert kept[1, 1] == 1  # the outer rim stays


@pytest.mark.parametrize("side", ["east", "south"])
def test_pieces_that_only_come_near_are_not_joined(side):
    strip = np.zeros((20, 4), np.int32)
    strip[3:8, :2] = 1
    other = np.zeros((20, 4), np.int32)
    other[9:12, 2:] = 5
    corner = np.zeros((20, 4), np.int32)
    corner[8:12, 2:] = 5
    turned = [a if side == "east" else a.T for a in (strip, other, corner)]
    assert not len(scan_order.touching(turned[0], turned[1], side))
    assert scan_order.touching(turned[0], turned[2], side).tolist() == [[1, 5]]
