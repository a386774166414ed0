"""Preview: `preview.png`, the result at a glance.

Left, the raster with every roof section where it is *seen*, coloured by where it faces (hue) and how steep it is (strength).
Right, the city where it *stands*: roofs over shaded terrain, coloured by height above ground and lit from the north-west,
taller ones casting a longer shadow. Both panels show the same ground at the same scale.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter

from kibs_steps import cli, picture, store
from kibs_steps import scene as scenes
from kibs_steps.grid import Grid
from kibs_steps.picture import FINER
from kibs_steps.publish import licences
from kibs_steps.scene import Scene

LONGEST = 1200  # px: longer side of a panel
UNSEEN = 0.1  # picture pixels: what is finer than this nobody sees
VALUES = ("slope", "azimuth", "plane_a", "plane_b", "height_mean")
LIGHT = np.array([-0.5, 0.5, 0.7])  # towards the lamp of the shaded map: north-west, as maps have it
COLUMNS = [
    "section_id",
    "building_id",
    "outline",
    "outline_map",
    "slope",
    "azimuth",
    "plane_a",
    "plane_b",
    "height_mean",
]
SHADOW = np.array([0.45, 0.45])  # m east and south per m of height


def by_height(heights: NDArray[np.float64]) -> tuple[NDArray[np.uint8], float]:
    """Colours of heights above ground (m), and the height at the ramp's end: a round number most roofs stay below."""
    top = picture.nice_length(max(float(np.nanquantile(heights, 0.98)), 1.0)) if len(heights) else 10.0
    top = next(
        step
        for step in (top, 1.5 * top, 2 * top, 2.5 * top)
        if not len(heights) or step >= np.nanquantile(heights, 0.9)
    )
    return picture.ramp(heights, 0.0, top), top


def shaded(colours: NDArray[np.uint8], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (n, 3) of planes with gradients a, b (m/m) in the lamp's light; a level plane keeps its own."""
    normal = np.stack([-a, -b, np.ones_like(a)], axis=-1) / np.sqrt(1 + a**2 + b**2)[..., None]
    light = LIGHT / np.linalg.norm(LIGHT)
    strength = np.clip(normal @ light, 0, None) / light[2]
    return np.clip(colours * (0.45 + 0.55 * strength)[..., None], 0, 255).astype(np.uint8)


def terrain_shade(scene: Scene, grid: Grid, size: tuple[int, int], scale: float) -> NDArray[np.uint8]:
    """The terrain of a grid as a pale relief, (rows, cols, 3) of `size` (width, height) picture pixels."""
    step = 4
    cols, rows = np.meshgrid(np.arange(0, size[0] + step, step), np.arange(0, size[1] + step, step))
    place = grid.to_map(np.stack([cols, rows], axis=-1).reshape(-1, 2) / scale)
    metres = step * grid.gsd / scale
    heights = scene.terrain(grid.bounds, step=metres)(place).reshape(cols.shape)
    down, along = np.gradient(heights, metres)
    base = np.full((*heights.shape, 3), (232, 231, 225), np.uint8)
    relief = Image.fromarray(shaded(base, 2 * along, -2 * down))
    return np.asarray(relief.resize(size, Image.Resampling.BICUBIC))


def standing_panel(
    scene: Scene, grid: Grid, outlines: NDArray[np.object_], planes: NDArray[np.float64], heights: NDArray[np.float64],
    scale: float,
) -> tuple[Image.Image, float]:  # fmt: skip
    """The map view of a grid: roofs over relief; `outlines` (WKB, px of the grid) where they stand, `planes` (n, 2) their
    gradients, `heights` (n,) m above ground."""
    size = max(round(grid.width * scale), 1), max(round(grid.height * scale), 1)
    large = (size[0] * FINER, size[1] * FINER)
    page = Image.fromarray(terrain_shade(scene, grid, size, scale)).resize(large, Image.Resampling.BICUBIC)
    colours, top = by_height(heights)
    lit = shaded(colours, planes[:, 0], planes[:, 1])
    shadow = Image.new("L", large)
    pen = ImageDraw.Draw(shadow)
    for shell, *_ in picture.rings(_shadows(outlines, heights, grid.gsd), scale * FINER):
        pen.polygon(shell, fill=110)
    shadow = shadow.filter(ImageFilter.GaussianBlur(1.2 * FINER))
    page.paste((40, 44, 60), (0, 0), shadow)
    pen = ImageDraw.Draw(page)
    # From low to high, so that what stands above is drawn last.
    upwards = np.argsort(heights, kind="stable")
    for (shell, *holes), colour in zip(picture.rings(outlines[upwards], scale * FINER), lit[upwards], strict=True):
        ink = tuple(colour.tolist())
        if holes:
            picture.fill_around(page, shell, holes, ink)
            pen = ImageDraw.Draw(page)
        else:
            pen.polygon(shell, fill=ink)
        for ring in (shell, *holes):
            pen.line(ring, fill=tuple(int(c * 0.55) for c in ink), width=FINER)
    return page.resize(size, Image.Resampling.BOX), top


def _shadows(outlines: NDArray[np.object_], heights: NDArray[np.float64], gsd: float) -> NDArray[np.object_]:
    """What outlines (WKB, px) at heights (m) shade of level ground, without the notches (WKB, px); some at a time."""
    found = [np.zeros(0, object)]
    for start in range(0, len(outlines), picture.SOME):
        some = slice(start, start + picture.SOME)
        away = SHADOW * np.maximum(heights[some], 0.0)[:, None] / gsd
        found.append(shapely.to_wkb(_swept(shapely.from_wkb(outlines[some]), away)))
    return np.concatenate(found)


def _swept(outlines: NDArray[np.object_], away: NDArray[np.float64]) -> NDArray[np.object_]:
    """The areas that outlines cover on their way along vectors (n, 2), made convex."""
    shells = shapely.get_exterior_ring(outlines)
    owner = shapely.get_coordinates(shells, return_index=True)[1]
    ends = shapely.set_coordinates(shells.copy(), shapely.get_coordinates(shells) + away[owner])
    return shapely.convex_hull(shapely.multilinestrings(np.column_stack([shells, ends])))


def compass(page: Image.Image, centre: tuple[int, int], radius: int) -> None:
    """The key of directions: a disc with the colour of a roof of 35° facing each way, north up."""
    side = 4 * radius
    y, x = np.mgrid[:side, :side] - side / 2 + 0.5
    azimuth = np.degrees(np.arctan2(x, -y)) % 360
    distance = np.hypot(x, y) / (side / 2)
    colours = picture.directions((40 * distance).ravel(), azimuth.ravel()).reshape(side, side, 3)
    disc = Image.fromarray(colours).resize((2 * radius, 2 * radius), Image.Resampling.BOX)
    mask = Image.fromarray(np.where(distance <= 1, 255, 0).astype(np.uint8)).resize(disc.size, Image.Resampling.BOX)
    page.paste(disc, (centre[0] - radius, centre[1] - radius), mask)
    pen = ImageDraw.Draw(page)
    for name, (dx, dy) in {"N": (0, -1), "E": (1, 0), "S": (0, 1), "W": (-1, 0)}.items():
        place = (centre[0] + dx * (radius + 8), centre[1] + dy * (radius + 8))
        pen.text(place, name, font=picture.font(11), fill=picture.QUIET, anchor="mm")


class Shown(NamedTuple):
    """What the picture shows of the sections, in order of ids: outlines as seen and as they stand (WKB, px), no finer than it
    can show, their areas (px), buildings, and numbers by name."""

    seen: NDArray[np.object_]
    standing: NDArray[np.object_]
    area: NDArray[np.float64]
    building: NDArray[np.int64]
    value: dict[str, NDArray[np.float64]]


def shown(tables: Iterable[pa.Table], scale: float, grid: Grid) -> Shown:
    """Reads sections (`buildings.parquet`), some at a time; `grid` has them where they stand, `scale` is picture pixels per
    pixel.

    Outlines are kept as WKB: of a large city, geometries would be most of the memory.
    """
    kept: dict[str, list[NDArray]] = defaultdict(list)
    for some in tables:
        seen = shapely.force_2d(shapely.from_wkb(some["outline"].to_numpy()))
        standing = shapely.force_2d(shapely.from_wkb(some["outline_map"].to_numpy()))
        kept["area"].append(shapely.area(seen))
        kept["seen"].append(shapely.to_wkb(shapely.simplify(seen, UNSEEN / scale)))
        kept["standing"].append(
            shapely.to_wkb(shapely.simplify(shapely.transform(standing, grid.to_image), UNSEEN / scale))
        )
        kept["building"].append(some["building_id"].to_numpy())
        for name in VALUES:
            kept[name].append(some[name].to_numpy().astype(float))
    found = {name: np.concatenate(parts) for name, parts in kept.items()}
    numbers = {name: found[name] for name in VALUES}
    return Shown(found["seen"], found["standing"], found["area"], found["building"], numbers)


def preview(scene: Scene, tables: Iterable[pa.Table]) -> Image.Image:
    """The whole picture of a scene's sections (`buildings.parquet`, in order of ids)."""
    rgb, scale = picture.overview(scene, LONGEST)
    grid = scene.standing
    seen, standing, area, building, value = shown(tables, scale, grid)
    facing = picture.directions(value["slope"], value["azimuth"])
    typical = np.sqrt(np.median(area)) * scale if len(seen) else 10.0
    width = float(np.clip(typical / 18, 0.5, 1.6))  # thin lines over many small roofs
    left = picture.paint(rgb, seen, facing, scale, cover=0.42, width=width)
    gradients = np.column_stack([value["plane_a"], value["plane_b"]])
    right, top = standing_panel(scene, grid, standing, gradients, value["height_mean"], scale)

    note = f"{len(seen):,} roof sections" + (f", {len(np.unique(building)):,} buildings" if len(seen) else "")
    known = scene.view or scene.regions
    titles = [
        "as seen from the satellite",
        "where they stand" if known else "where they are seen (the view is unknown)",
    ]
    page = picture.sheet([left, right], titles, scene.name, note, foot=76)
    pen = ImageDraw.Draw(page)
    foot = page.height - 38
    picture.scale_bar(pen, (16, foot + 6), scale / scene.grid.gsd, 180)
    compass(page, (300, foot), 21)
    pen.text((340, foot), "facing; paler is flatter", font=picture.font(15), fill=picture.INK, anchor="lm")
    picture.colour_bar(pen, (560, foot), ("0", f"{top:g} m above ground"), picture.HEIGHTS)
    return page


def main(argv: list[str] | None = None) -> None:
    """Draw the preview of a scene."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.preview", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--sections", required=True, nargs="+", help="buildings.parquet")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences are told")
    parser.add_argument("--out", required=True, help="out: preview.png")
    args = parser.parse_args(argv)
    page = preview(scenes.read(args.scene), store.merged(args.sections, ["section_id"], COLUMNS))
    picture.write(args.out, page, licences.line(args.models))


if __name__ == "__main__":
    cli.run(main, pandas=False)
