"""Walls: how high a whole section stands, by the walls and shadows seen beside it.

The height map of a 3D model tells how heights differ within a section better than how high all of it stands: most of its error
is one number per section. So every section is lifted by a row of **offsets**. From a pixel of its rim that faces the satellite
at height h, its base is shown at P − v·(h + offset), and from one that throws a shadow the tip at P + (s − v)·(h + offset), v
and s being the leans of view and sun in the image. What is seen at these places and on the way there (walls, ground, shade,
other roofs and how high those are), on average over the rim, and what the height map says of such a lift, are the **traits** of
an offset; the contract's `walls`, a small network of convolutions along the offsets, tells from them how likely each is.
Neighbouring sections err alike, so half of a section's lift is that of it and its neighbours together.

In: sections as labels, the outputs `surface` and `height` of a dense 3D model. Out: metres to lift each section, and how many
looks tell so: a tile that does not see the foot of a section's walls has little to say of it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kibs_steps import heightmap

OFFSETS = np.arange(-12.0, 12.25, 0.5)  # m
STEP = 0.5  # m between them, and between looks along a ray
HIGHEST = 48.0  # m: how far down a wall, or along a shadow, is looked
KINDS = 5  # of surface: ground, roof, wall, other, shaded ground
GROUND, ROOF, WALL, OTHER, SHADE = range(KINDS)
SEEN = KINDS + 4  # traits of a direction: kinds, the section itself, roofs' heights, a wall's end on ground, on a roof
TRAITS = 2 * SEEN + 4
WHOLE = 9  # traits of a section
OUTWARD = 1.5  # px: what lies so far from a rim's pixel, to the nearest of its neighbours, is beyond the rim
LEAST = 24  # px of a section that is looked at
LEANING = 0.25  # px per metre: what leans less shows no wall
GUESS = 0.01  # looks that a px of a section counts for, as the height map alone tells something
NEAR = 2  # px: sections no farther apart are neighbours
SURE = (0.02, 0.98)  # probabilities of a wall, so that no look is the last word
MOST = 16384  # looks of a kind at a time; OpenCV takes rows up to 32,767


class Traits(NamedTuple):
    """Of sections (n) `labels`: `along` (n, TRAITS, offsets) and `whole` (n, WHOLE), their areas (px), and `height` (s, s), that
    of their planes (m; 0 elsewhere)."""

    labels: NDArray[np.int64]
    along: NDArray[np.float32]
    whole: NDArray[np.float32]
    area: NDArray[np.int64]
    height: NDArray[np.float32]


def traits(
    labels: NDArray, surface: NDArray, distribution: NDArray, heights: dict[str, Any], geometry: NDArray
) -> Traits:
    """Traits of the sections of a tile: `labels` (s, s), 0 none, `surface` (KINDS, s/k, s/k) probabilities, `distribution`
    (B, s/l, s/l) over the bins of `heights` (the contract's), `geometry` (6,) as networks are told it."""
    labels, side = labels.astype(np.int64), len(labels)
    area = np.bincount(labels.ravel())
    centres = np.asarray(heights["centres"], float)
    mean = np.tensordot(centres, distribution, (0, 0))
    spread = np.sqrt(np.maximum(np.tensordot(centres**2, distribution, (0, 0)) - mean**2, 0.0))
    found, sums = heightmap.sums_by_label(labels, mean, spread, 0.0, 0.0)
    known = area[found] >= LEAST
    found, sums = found[known], sums[known]
    if not len(found):
        none = np.zeros((0, TRAITS, len(OFFSETS)), np.float32), np.zeros((0, WHOLE), np.float32)
        return Traits(found, *none, found, np.zeros(labels.shape, np.float32))
    number = np.full(len(area), -1)
    number[found] = np.arange(len(found))
    of = number[labels]
    planes = np.array([heightmap.plane(row) for row in sums])
    row, col = np.mgrid[:side, :side] + 0.5
    a, b, c = np.moveaxis(planes[of], -1, 0)
    height = np.where(of >= 0, a * col + b * row + c, 0.0).astype(np.float32)
    tile = _Tile(labels, of, height, np.ascontiguousarray(surface, np.float32), len(found))
    view, sun = geometry[:2].astype(float), geometry[2:4].astype(float)
    told_view, told_sun = geometry[4] > 0, geometry[4] > 0 and geometry[5] > 0
    base, facing = _along(tile, -view, told_view, np.array([0.0, 0.0, 1.0, 0.0, 0.0]))
    tip, shading = _along(tile, sun - view, told_sun, np.array([0.0, 0.5, 0.5, 0.0, 1.0]))
    own = _own(labels, number, planes, distribution, np.asarray(heights["edges"], float))
    middle = np.bincount(of[of >= 0], height[of >= 0], len(found)) / np.bincount(of[of >= 0], minlength=len(found))
    offsets = np.broadcast_to(OFFSETS, (len(found), len(OFFSETS)))
    along = [base, tip, own, offsets[:, None] / 10, (middle[:, None] + offsets)[:, None] / 20]
    size = np.sqrt(area[found])
    ones = np.ones(len(found))
    whole = [
        np.log(area[found]) / 5 - 1, facing / size, shading / size, middle / 10 - 1,
        np.log(sums[:, heightmap.SIGMA] / np.maximum(sums[:, heightmap.NUMBER], 1e-9) + 0.1),
        ones * told_view * np.hypot(*view) / 2, ones * told_sun * np.hypot(*(sun - view)) / 2, ones * told_view,
        ones * (geometry[5] > 0),
    ]  # fmt: skip
    found_along = np.concatenate(along, axis=1, dtype=np.float32)
    return Traits(found, found_along, np.stack(whole, axis=1).astype(np.float32), area[found], height)


class _Tile(NamedTuple):
    """A tile's sections: labels, their numbers (−1 none), heights (m) of those, what is seen, how many there are."""

    labels: NDArray
    of: NDArray
    height: NDArray
    surface: NDArray
    count: int


def _along(tile: _Tile, away: NDArray, told: bool, stays: NDArray) -> tuple[NDArray, NDArray]:
    """Traits (n, SEEN, offsets) of what is seen `away` (px per metre of height) from rims that face there, and how many pixels
    these rims have; `stays` tells what a ray that goes on is taken to see, kind by kind."""
    found, count = np.zeros((tile.count, SEEN, len(OFFSETS)), np.float32), np.zeros(tile.count)
    length = float(np.hypot(*away))
    side = len(tile.labels)
    if not told or length < LEANING:
        return found, count
    out = np.rint(np.clip(away / length * OUTWARD, -1, 1)).astype(int)  # one of eight neighbours
    beyond = np.pad(tile.labels, 2, constant_values=-1)[2 + out[1] : side + 2 + out[1], 2 + out[0] : side + 2 + out[0]]
    row, col = np.nonzero((tile.of >= 0) & (beyond != tile.labels) & (beyond >= 0))
    if not len(row):
        return found, count
    order = np.argsort(tile.of[row, col], kind="stable")
    for first in range(0, len(order), MOST):
        part = order[first : first + MOST]
        _look(tile, col[part], row[part], away, stays, found)
    count = np.bincount(tile.of[row, col], minlength=tile.count).astype(float)
    return found / np.maximum(count, 1)[:, None, None], count


def _look(tile: _Tile, col: NDArray, row: NDArray, away: NDArray, stays: NDArray, found: NDArray) -> None:
    """Add to `found` (n, SEEN, offsets) what is seen from pixels (m,) of rims, section by section."""
    side, stride = len(tile.labels), len(tile.labels) / tile.surface.shape[1]
    mine, height = tile.of[row, col], tile.height[row, col]
    changes = np.flatnonzero(np.diff(mine, prepend=-1))

    def seen(metres: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Kinds of surface, roofs' heights, whether a place so far away (m) is in the tile, and in the section itself."""
        x, y = (
            (px[:, None] + 0.5 + lean * metres).astype(np.float32) for px, lean in zip((col, row), away, strict=True)
        )
        inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
        kinds = _read(tile.surface, x / np.float32(stride), y / np.float32(stride))
        roofs = _read(tile.height[None], x, y)[0]
        own = tile.of[np.clip(y.astype(int), 0, side - 1), np.clip(x.astype(int), 0, side - 1)] == mine[:, None]
        return kinds, roofs, inside, own

    metres = height[:, None] + OFFSETS
    kinds, roofs, inside, own = seen(metres)
    there = inside & (metres > 0)
    for k, values in enumerate((*kinds, own, roofs / 10)):
        found[mine[changes], k] += np.add.reduceat(values * there, changes, axis=0)
    ray = np.broadcast_to(np.arange(STEP / 2, HIGHEST, STEP), (len(row), int(HIGHEST / STEP)))
    kinds, roofs, inside, own = seen(ray)
    on = np.clip(np.tensordot(stays, kinds, (0, 0)), *SURE)
    on = np.where(inside & ~own & (ray * np.hypot(*away) > OUTWARD), on, 1.0)  # the rim itself is roof
    ends = 1 - on
    ends[:, 1:] *= np.cumprod(on[:, :-1], axis=1)
    for k, (share, foot) in enumerate(((ends * (1 - kinds[ROOF]), 0.0), (ends * kinds[ROOF], roofs))):
        at = np.rint((ray + foot - height[:, None] - OFFSETS[0]) / STEP).astype(int)
        good = (at >= 0) & (at < len(OFFSETS))
        flat = (mine[:, None] * len(OFFSETS) + at)[good]
        found[:, KINDS + 2 + k] += np.bincount(flat, share[good], tile.count * len(OFFSETS)).reshape(tile.count, -1)


def _read(images: NDArray, x: NDArray, y: NDArray) -> NDArray:
    """Bilinear values (k, …) of images (k, h, w) at places (pixels, corners at whole numbers); 0 beyond them."""
    half = np.float32(0.5)
    read = (
        cv2.remap(image, x - half, y - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        for image in images
    )
    return np.stack(list(read))


def _own(labels: NDArray, number: NDArray, planes: NDArray, distribution: NDArray, edges: NDArray) -> NDArray:
    """What the height map says of each offset (n, 2, offsets): mean density (1/m) over a section's cells, and of its log;
    `planes` (n, 3) of the sections."""
    bins, *shape = distribution.shape
    stride = len(labels) // shape[0]
    label = heightmap.cells_of(labels, stride)[: shape[0], : shape[1]]
    row, col = np.nonzero(number[label] >= 0)
    mine = number[label[row, col]]
    a, b, c = planes[mine].T
    metres = ((a * (col + 0.5) + b * (row + 0.5)) * stride + c)[:, None] + OFFSETS
    at = np.clip(np.searchsorted(edges, metres, side="right") - 1, 0, bins - 1)
    density = np.take_along_axis((distribution[:, row, col] / np.diff(edges)[:, None]).T, at, axis=1)
    density = np.where((metres >= 0) & (metres <= edges[-1]), density, 0.0)
    found = np.zeros((len(planes), 2, len(OFFSETS)))
    np.add.at(found[:, 0], mine, density)
    np.add.at(found[:, 1], mine, np.log(density + 1e-3) / 5)
    return found / np.maximum(np.bincount(mine, minlength=len(planes)), 1)[:, None, None]


def likely(seen: Traits, terms: dict[str, Any]) -> NDArray[np.float64]:
    """How likely each offset is (n, offsets): convolutions over five offsets with ReLU between, the first told the section's
    own traits, each but the first and the last added to what it sees; then their share."""
    first, *inner, last = terms["layers"]
    x = np.maximum(
        _convolved(seen.along, first)
        + (seen.whole @ np.asarray(terms["whole"], np.float32) + np.float32(terms["bias"]))[:, None],
        0,
    )
    for layer in inner:
        x = np.maximum(x + _convolved(x.transpose(0, 2, 1), layer), 0)
    score = _convolved(x.transpose(0, 2, 1), last)[..., 0].astype(float)
    risen = np.exp(score - score.max(axis=1, keepdims=True))
    return risen / risen.sum(axis=1, keepdims=True)


def _convolved(x: NDArray, layer: dict[str, Any]) -> NDArray:
    """(n, offsets, out) of x (n, in, offsets), zero beyond the ends; `weights` (5·in, out), offset after offset."""
    padded = np.pad(x, ((0, 0), (0, 0), (2, 2)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=2)  # n, in, offsets, 5
    flat = windows.transpose(0, 2, 3, 1).reshape(len(x), x.shape[2], -1)
    return flat @ np.asarray(layer["weights"], np.float32) + np.asarray(layer["bias"], np.float32)


def leads(terms: dict[str, Any]) -> bool:
    """Whether terms lead from these traits to one number, each layer taking what the one before gives."""
    wide = len(terms["bias"])
    rows = [5 * TRAITS, *[5 * wide] * (len(terms["layers"]) - 1)]
    widths = [*[wide] * (len(terms["layers"]) - 1), 1]

    def shaped(matrix: list[list[float]], rows: int, width: int) -> bool:
        return len(matrix) == rows and all(len(row) == width for row in matrix)

    return shaped(terms["whole"], WHOLE, wide) and all(
        shaped(layer["weights"], row, width) and len(layer["bias"]) == width
        for layer, row, width in zip(terms["layers"], rows, widths, strict=True)
    )


def lifts(labels: NDArray, seen: Traits, terms: dict[str, Any]) -> NDArray[np.float64]:
    """Metres to lift each label (0 … labels.max()) of a tile; 0 where nothing was looked at."""
    found = np.zeros(int(labels.max(initial=0)) + 1)
    if not len(seen.labels):
        return found
    found[seen.labels] = medians(likely(seen, terms))
    area = np.zeros(len(found))
    area[seen.labels] = seen.area
    pairs = neighbours(labels)
    pairs = pairs[(area[pairs] > 0).all(axis=1)]
    total, weight = area * found, area.copy()
    for one, other in (pairs.T, pairs.T[::-1]):
        np.add.at(total, one, area[other] * found[other])
        np.add.at(weight, one, area[other])
    return (found + total / np.maximum(weight, 1)) / 2


def looks(labels: NDArray, seen: Traits) -> NDArray[np.float64]:
    """How much of what lifts each label (0 … labels.max()) of a tile is seen: px of its rim whose wall ends in the tile, and
    `GUESS` for each of its own; 0 where nothing was looked at."""
    found = np.zeros(int(labels.max(initial=0)) + 1)
    facing = seen.whole[:, 1] * np.sqrt(seen.area)
    ends = seen.along[:, KINDS + 2 : SEEN].sum(axis=(1, 2))
    found[seen.labels] = facing * ends + GUESS * seen.area
    return found


def medians(shares: NDArray) -> NDArray[np.float64]:
    """The offset (n,) at which half of the shares (n, offsets) is reached, each spread over its step."""
    below = np.cumsum(shares, axis=1)
    at = np.argmax(below >= 0.5 * below[:, -1:], axis=1)[:, None]
    own = np.take_along_axis(shares, at, axis=1)[:, 0]
    before = np.take_along_axis(below, at, axis=1)[:, 0] - own
    return OFFSETS[at[:, 0]] - STEP / 2 + STEP * (0.5 * below[:, -1] - before) / np.maximum(own, 1e-12)


def neighbours(labels: NDArray) -> NDArray[np.int64]:
    """Pairs (m, 2) of labels that lie at most `NEAR` px apart along rows or columns, each once."""
    found = [np.zeros((0, 2), np.int64)]
    for apart in range(1, NEAR + 1):
        for one, other in ((labels[apart:], labels[:-apart]), (labels[:, apart:], labels[:, :-apart])):
            both = (one > 0) & (other > 0) & (one != other)
            found.append(np.sort(np.stack([one[both], other[both]], axis=1).astype(np.int64), axis=1))
    return np.unique(np.concatenate(found), axis=0)
