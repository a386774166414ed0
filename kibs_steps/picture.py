"""Pictures of a scene: the raster small enough to look at, outlines on it, and a quiet frame of legend and scale.

A **sheet** is one picture with panels side by side; everything is drawn twice as large and halved at the end, which gives
smooth lines. Pictures need Pillow alone, and the same content gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from kibs_steps import imagery, store, tiles
from kibs_steps.scene import Scene

AT_ONCE = 2048  # px: side of what is read of a raster at once
SOME = 4096  # outlines that are points at once
NARROWEST = 880  # px: a page that its legends fit on
FINER = 2  # how much larger than the result everything is drawn
INK, PAPER, QUIET = (38, 42, 46), (250, 249, 246), (122, 128, 134)
HEIGHTS = np.array(  # dark blue over green to pale yellow: even steps of lightness, safe for colour-blind eyes
    [[52, 38, 94], [54, 92, 141], [39, 127, 142], [46, 166, 127], [132, 204, 94], [240, 229, 92]], np.float64
)
DIFFERENCES = np.array([[33, 84, 156], [122, 171, 210], [244, 242, 236], [232, 153, 116], [165, 30, 45]], np.float64)


def overview(scene: Scene, longest: int) -> tuple[NDArray[np.uint8], float]:
    """The scene's raster on its grid at a smaller size: RGB (rows, cols, 3), paper colour where there is no data, and how
    many picture pixels a grid pixel has. Rasters smaller than `longest` px are enlarged up to four times.
    """
    from rasterio.enums import ColorInterp

    grid = scene.grid
    scale = min(longest / max(grid.width, grid.height), 4.0)
    size = {"width": max(1, round(grid.width * scale)), "height": max(1, round(grid.height * scale))}
    coarse = grid._replace(gsd=grid.gsd / scale, **size)
    rgb = np.empty((coarse.height, coarse.width, 3), np.uint8)
    with imagery.opened(scene.raster) as source:
        for window in coarse.windows(max(1, int(AT_ONCE * scale))):
            with tiles.on_grid(source, coarse.part(window), scene.nodata) as warped:
                values = warped.read([*scene.bands, warped.colorinterp.index(ColorInterp.alpha) + 1])
            part = imagery.stretched(values[:3], scene.stretch).transpose(1, 2, 0).copy()
            part[~((values[3] > 0) & imagery.has_data(values[:3], None))] = PAPER
            rgb[window.row : window.row + window.height, window.col : window.col + window.width] = part
    return rgb, scale


def ramp(
    values: NDArray[np.float64], low: float, high: float, colours: NDArray[np.float64] = HEIGHTS
) -> NDArray[np.uint8]:
    """Colours (n, 3) of values (n,) between `low` and `high`, clipped."""
    place = np.clip((np.asarray(values, float) - low) / (high - low), 0.0, 1.0) * (len(colours) - 1)
    left = np.minimum(place.astype(int), len(colours) - 2)
    share = (place - left)[..., None]
    return np.rint(colours[left] * (1 - share) + colours[left + 1] * share).astype(np.uint8)


def directions(slope: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (n, 3) of roofs by where they face: hue by azimuth (deg), paler the flatter (deg); white where level."""
    import colorsys

    slope = np.nan_to_num(np.asarray(slope, float))
    azimuth = np.asarray(azimuth, float)
    strength = np.where(np.isnan(azimuth), 0.0, np.clip(slope / 40.0, 0.15, 1.0))
    hue = np.nan_to_num(azimuth) / 360.0
    rgb = [
        colorsys.hsv_to_rgb(float(h), 0.75 * float(s), 1.0 - 0.12 * float(s))
        for h, s in zip(hue, strength, strict=True)
    ]
    return np.rint(np.array(rgb).reshape(-1, 3) * 255).astype(np.uint8)


def rings(outlines: NDArray[np.object_], scale: float) -> Iterator[list[list[float]]]:
    """Per outline (WKB, px) its rings, outer one first, as x, y, x, y, … in picture pixels; some outlines at a time."""
    for start in range(0, len(outlines), SOME):
        some = shapely.from_wkb(outlines[start : start + SOME])
        parts, owner = shapely.get_rings(some, return_index=True)
        points, ring = shapely.get_coordinates(parts, return_index=True)
        flat = [part.ravel().tolist() for part in np.split(points * scale, np.flatnonzero(np.diff(ring)) + 1)]
        for first, last in pairwise(np.searchsorted(owner, np.arange(len(some) + 1))):
            yield flat[first:last]


def paint(
    rgb: NDArray[np.uint8],
    outlines: NDArray[np.object_],
    colours: NDArray[np.uint8],
    scale: float,
    cover: float = 0.45,
    width: float = 1.5,
) -> Image.Image:
    """An image with outlines (WKB, px, `scale` picture pixels each) filled by `cover` (0–1) of their colour and drawn around."""
    size = (rgb.shape[1] * FINER, rgb.shape[0] * FINER)
    base = Image.fromarray(rgb).resize(size, Image.Resampling.BICUBIC)
    picture = base
    if cover:
        fill = base.copy()
        draw = ImageDraw.Draw(fill)
        for (shell, *holes), ink in zip(rings(outlines, scale * FINER), colours, strict=True):
            if holes:
                fill_around(fill, shell, holes, tuple(ink.tolist()))
            else:
                draw.polygon(shell, fill=tuple(ink.tolist()))
        picture = Image.blend(base, fill, cover)
    draw = ImageDraw.Draw(picture)
    for parts, ink in zip(rings(outlines, scale * FINER), colours, strict=True):
        for ring in parts:
            draw.line(ring, fill=tuple(ink.tolist()), width=max(1, round(width * FINER)))
    return picture.resize((rgb.shape[1], rgb.shape[0]), Image.Resampling.BOX)


def fill_around(
    picture: Image.Image, shell: list[float], holes: list[list[float]], colour: tuple[int, int, int]
) -> None:
    """Fill a ring but for its holes."""
    points = np.array(shell).reshape(-1, 2)
    low = np.floor(points.min(axis=0)).astype(int)
    size = np.ceil(points.max(axis=0)).astype(int) + 1 - low
    mask = Image.new("L", tuple(size.tolist()))
    draw = ImageDraw.Draw(mask)
    for ring, value in ((shell, 255), *((hole, 0) for hole in holes)):
        draw.polygon((np.array(ring).reshape(-1, 2) - low).ravel().tolist(), fill=value)
    picture.paste(colour, tuple(low.tolist()), mask)


def font(size: int) -> ImageFont.FreeTypeFont:
    """The typeface of all pictures."""
    return ImageFont.load_default(size)


def nice_length(longest: float) -> float:
    """The largest of 1, 2, 5 × 10ⁿ not above `longest`."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest * (1 + 1e-9)))


def scale_bar(draw: ImageDraw.ImageDraw, place: tuple[float, float], metre: float, longest: float) -> None:
    """A bar of a round length, at most `longest` picture pixels, `metre` picture pixels to the metre; `place` is its left."""
    length = nice_length(longest / metre)
    x, y = place
    end = x + length * metre
    draw.line([(x, y - 5), (x, y), (end, y), (end, y - 5)], fill=INK, width=2)
    draw.text((end + 8, y), f"{length:g} m", font=font(15), fill=INK, anchor="lm")


def sheet(panels: list[Image.Image], titles: list[str], head: str, note: str, foot: int = 64) -> Image.Image:
    """Panels side by side (or one above the other if wide) under titles, with a foot for a legend; `note` at its right."""
    gap, top, caption = 16, 44, 26
    beside = panels[0].width <= 1.6 * panels[0].height
    place, x, y = [], gap, top
    for panel in panels:
        place.append((x, y))
        x, y = (x + panel.width + gap, y) if beside else (x, y + panel.height + caption + gap)
    width = max(NARROWEST, *(px + panel.width + gap for (px, _), panel in zip(place, panels, strict=True)))
    height = max(py + panel.height for (_, py), panel in zip(place, panels, strict=True)) + caption + foot
    picture = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(picture)
    draw.text((gap, 10), head, font=font(21), fill=INK)
    draw.text((width - gap, 16), note, font=font(14), fill=QUIET, anchor="ra")
    for (px, py), panel, title in zip(place, panels, titles, strict=True):
        picture.paste(panel, (px, py))
        draw.text((px, py + panel.height + 5), title, font=font(15), fill=QUIET)
    return picture


def swatches(
    draw: ImageDraw.ImageDraw, place: tuple[float, float], entries: list[tuple[tuple[int, int, int], str]]
) -> None:
    """Colours with their meaning, in a row."""
    x, y = place
    for colour, text in entries:
        draw.rectangle([x, y - 7, x + 14, y + 7], fill=colour, outline=QUIET)
        draw.text((x + 21, y), text, font=font(15), fill=INK, anchor="lm")
        x += 21 + draw.textlength(text, font=font(15)) + 20


def colour_bar(
    draw: ImageDraw.ImageDraw,
    place: tuple[float, float],
    ends: tuple[str, str],
    colours: NDArray[np.float64],
    width: int = 150,
) -> None:
    """A ramp with the texts of its two ends."""
    x, y = place
    draw.text((x, y), ends[0], font=font(15), fill=INK, anchor="lm")
    x += draw.textlength(ends[0], font=font(15)) + 8
    for i, colour in enumerate(ramp(np.arange(width), 0, width - 1, colours).tolist()):
        draw.line([(x + i, y - 7), (x + i, y + 7)], fill=tuple(colour))
    draw.text((x + width + 8, y), ends[1], font=font(15), fill=INK, anchor="lm")


def write(path: str | Path, picture: Image.Image, licence: str = "") -> None:
    """Write a PNG, whole; it says under which licence."""
    told = PngInfo()
    if licence:
        told.add_itxt("Copyright", licence)
    with store.whole(path) as temporary:
        picture.save(temporary, format="PNG", optimize=False, compress_level=6, pnginfo=told)
