"""The model grid, its tiles and its blocks.

A **grid** is the north-up raster of square pixels (side = GSD, metres) on which the models work. Image coordinates are
(col, row) in pixels, real numbers, the upper-left corner of the upper-left pixel being (0, 0); a pixel's centre is at +0.5.

A **tile** is s×s px with a margin of p px on each side; its *core*, the s − 2p px inside, is the part it answers for. Cores
cover the grid without gap or overlap, so a tile's window may stick out of the grid. A **block** is `block`×`block` tiles and
the unit of a job.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from affine import Affine


class Window(NamedTuple):
    """A rectangle of pixels; may stick out of the grid."""

    col: int
    row: int
    width: int
    height: int

    def grown(self, margin: int) -> Window:
        """The window with `margin` px more on all four sides."""
        return Window(self.col - margin, self.row - margin, self.width + 2 * margin, self.height + 2 * margin)

    def within(self, grid: Grid) -> Window:
        """The part of the window that lies in a grid."""
        col, row = max(self.col, 0), max(self.row, 0)
        right, bottom = min(self.col + self.width, grid.width), min(self.row + self.height, grid.height)
        return Window(col, row, right - col, bottom - row)


class Grid(NamedTuple):
    """The model grid: CRS (projected, metres), upper-left corner (m), GSD (m/px), size (px)."""

    crs: str
    x0: float
    y0: float
    gsd: float
    width: int
    height: int

    @property
    def transform(self) -> Affine:
        """Affine transform from (col, row) to map metres."""
        return Affine(self.gsd, 0.0, self.x0, 0.0, -self.gsd, self.y0)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top) in map metres."""
        return (self.x0, self.y0 - self.height * self.gsd, self.x0 + self.width * self.gsd, self.y0)

    def part(self, window: Window) -> Grid:
        """The grid of a window: same pixels, its own corner and size."""
        left, top = self.to_map(np.array([window.col, window.row]))
        return self._replace(x0=float(left), y0=float(top), width=window.width, height=window.height)

    def windows(self, side: int) -> Iterator[Window]:
        """Windows of at most `side` px that cover the grid, row by row."""
        for row in range(0, self.height, side):
            for col in range(0, self.width, side):
                yield Window(col, row, min(side, self.width - col), min(side, self.height - row))

    def to_map(self, col_row: np.ndarray) -> np.ndarray:
        """Map metres (n, 2) of image coordinates (n, 2)."""
        col_row = np.asarray(col_row, float)
        return np.stack([self.x0 + col_row[..., 0] * self.gsd, self.y0 - col_row[..., 1] * self.gsd], axis=-1)

    def to_image(self, x_y: np.ndarray) -> np.ndarray:
        """Image coordinates (n, 2) of map metres (n, 2)."""
        x_y = np.asarray(x_y, float)
        return np.stack([(x_y[..., 0] - self.x0) / self.gsd, (self.y0 - x_y[..., 1]) / self.gsd], axis=-1)


class Tile(NamedTuple):
    """One tile: its place in the grid of tiles and its core (px, clipped to the grid)."""

    row: int
    col: int
    core: Window


class Block(NamedTuple):
    """A square of tiles, the unit of a job; `name` is its folder."""

    name: str
    row: int
    col: int


def block_name(row: int, col: int) -> str:
    """The name of a block by its place."""
    return f"r{row:03d}c{col:03d}"


def neighbours(name: str) -> list[str]:
    """The names of the up to eight blocks about one; some may lie beyond the grid's far sides."""
    row, col = map(int, name[1:].split("c"))
    places = [(r, c) for r in range(row - 1, row + 2) for c in range(col - 1, col + 2)]
    return [block_name(r, c) for r, c in places if (r, c) != (row, col) and r >= 0 and c >= 0]


class Tiling(NamedTuple):
    """How a grid is cut: tile side s and margin p (px), block side in tiles."""

    tile: int
    margin: int
    block: int

    @property
    def stride(self) -> int:
        """Side of a tile's core in px."""
        return self.tile - 2 * self.margin

    def shape(self, width: int, height: int) -> tuple[int, int]:
        """Rows and columns of tiles that cover a grid of that size."""
        return -(-height // self.stride), -(-width // self.stride)

    def blocks(self, width: int, height: int) -> list[Block]:
        """All blocks, row by row."""
        rows, cols = self.shape(width, height)
        return [
            Block(block_name(i, j), i, j) for i in range(-(-rows // self.block)) for j in range(-(-cols // self.block))
        ]

    def block_of(self, name: str) -> Block:
        """The block with that name, as `blocks` names it."""
        row, col = name[1:].split("c")
        return Block(name, int(row), int(col))

    def block_core(self, block: Block, width: int, height: int) -> Window:
        """The block's part of the grid (px)."""
        side = self.block * self.stride
        col, row = block.col * side, block.row * side
        return Window(col, row, min(side, width - col), min(side, height - row))

    def tiles(self, block: Block, width: int, height: int) -> list[Tile]:
        """The block's tiles, row by row."""
        rows, cols = self.shape(width, height)
        s = self.stride
        return [
            Tile(i, j, Window(j * s, i * s, min(s, width - j * s), min(s, height - i * s)))
            for i in range(block.row * self.block, min((block.row + 1) * self.block, rows))
            for j in range(block.col * self.block, min((block.col + 1) * self.block, cols))
        ]

    def window(self, tile: Tile) -> Window:
        """The tile's full window: s×s px, margins included; sticks out at the grid's edges."""
        return Window(tile.col * self.stride - self.margin, tile.row * self.stride - self.margin, self.tile, self.tile)
