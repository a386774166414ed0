"""Truth: roof sections drawn by hand or taken from a city model, brought into both frames, and which of them are seen.

In: any vector layer of polygons with heights, in any CRS; drawn where roofs are *seen* in the raster (`--frame image`) or
where they *stand* (`--frame map`), heights absolute or above the ground. Out: `truth.parquet` (docs/architecture.md).
Height above ground is z − DTM at the ground-corrected position (PAPER, data and tiling), never at the displaced pixel.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray

from kibs_steps import cli, store, view, zbuffer
from kibs_steps import scene as scenes
from kibs_steps.errors import KibsError
from kibs_steps.grid import Grid, Window
from kibs_steps.planes import middle_of
from kibs_steps.scene import Scene
from kibs_steps.view import Plane, Surface

FRAMES = ("image", "map")
VERTICAL = ("absolute", "above_ground")
LAYERS = {"image": ("sections_image", "roof_sections_image"), "map": ("sections_map", "roof_sections")}
PLAUSIBLE = (-20.0, 400.0)  # m above ground; a layer whose median height is outside was read with the wrong `--z`
AROUND = 1000.0  # m; what stands farther from where the raster shows ground never shows in it
CELL = 1024.0  # m; terrain is read cell by cell, so memory does not grow with the scene
STEEPEST = 5.0  # m per m (79°); a steeper "roof" is painted flat: its plane says nothing about a pixel


class UnreadableTruth(KibsError):
    """A truth file that is no vector file, or whose CRS is not stated."""


class NoPolygons(KibsError):
    """A truth layer without polygons."""


class NoHeights(KibsError):
    """Truth polygons without z, or whose heights cannot be meant as the options say."""


class NoOverlap(KibsError):
    """Truth that lies nowhere in the scene."""


class Layer(NamedTuple):
    """Polygons of one vector layer: single parts with z, and the columns this project knows, in the file's order."""

    name: str
    crs: str
    polygons: NDArray[np.object_]
    columns: dict[str, NDArray]


class Truth(NamedTuple):
    """Truth sections of a scene: ids, split, outlines seen (px, z above ground) and standing (map m, z absolute).

    `reach` (n, 4) is what a section and the walls below it can cover in the image: min col, min row, max col, max row.
    """

    ids: NDArray[np.int64]
    split: NDArray[np.int64]
    seen: NDArray[np.object_]
    standing: NDArray[np.object_]
    reach: NDArray[np.float64]

    def take(self, rows: NDArray) -> Truth:
        """Some of the sections, by index or mask."""
        return Truth(*(column[rows] for column in self))

    def near(self, window: Window) -> Truth:
        """The sections that may be seen, or hide something, in a window (px)."""
        r = self.reach
        right, bottom = window.col + window.width, window.row + window.height
        return self.take((r[:, 0] < right) & (r[:, 2] > window.col) & (r[:, 1] < bottom) & (r[:, 3] > window.row))


def read_layer(path: str | Path, frame: str, called: str = "truth") -> Layer:
    """The polygons of a vector file's layer (`layer_of`). Multipolygons are exploded, holes kept, outlines that cross
    themselves repaired, with a warning. `called`: the setting that names the file, for messages.
    """
    import pyogrio

    name, meta = layer_of(path, frame, called)
    meta, _, wkb, fields = pyogrio.raw.read(path, layer=name)

    parts, source = _sound(shapely.from_wkb(wkb), f"{called} {path}, layer {name}")
    if not len(parts):
        raise NoPolygons(f"{called} {path}, layer {name}, has no polygons")
    named = dict(zip(meta["fields"], fields, strict=True))
    wanted = ("section_id", "truth_id", "building_id", "building", "split", "visible")
    columns = {key: named[key][source] for key in wanted if key in named}
    return Layer(name, meta["crs"], parts, columns)


def _sound(shapes: NDArray[np.object_], called: str) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Single valid polygons with an area, and the row each comes from."""
    # Parts first: two sections of one row may share an edge, which no valid multipolygon may.
    parts, source = shapely.get_parts(shapes, return_index=True)
    crossed = ~shapely.is_valid(parts)
    if crossed.any():
        rows = ", ".join(map(str, np.unique(source[crossed])[:5] + 1))
        print(f"warning: {called}: {crossed.sum()} outlines cross themselves (rows {rows}): repaired", file=sys.stderr)
        parts = parts.copy()
        parts[crossed] = shapely.make_valid(parts[crossed], method="structure", keep_collapsed=False)
    deeper, inner = shapely.get_parts(parts, return_index=True)
    keep = (shapely.get_type_id(deeper) == shapely.GeometryType.POLYGON) & (shapely.area(deeper) > 0)
    return deeper[keep], source[inner][keep]


def layer_of(path: str | Path, frame: str, called: str = "truth") -> tuple[str, dict]:
    """The layer of a vector file that is read, and pyogrio's facts about it: `sections_image` or `sections_map` by frame if
    there is one (or the layers of this project's own `city.gpkg`), else the first layer of polygons.
    """
    import pyogrio

    try:
        layers = dict(pyogrio.list_layers(path))
    except (pyogrio.errors.DataSourceError, FileNotFoundError) as error:
        raise UnreadableTruth(f"{called} {path} cannot be read as a vector file: {error}") from error
    known = [name for name in LAYERS[frame] if name in layers]
    drawn = [name for name, kind in layers.items() if kind and ("Polygon" in kind or kind == "Unknown")]
    if not (known or drawn):
        raise NoPolygons(f"{called} {path} has no layer of polygons (its layers: {', '.join(layers) or 'none'})")
    name = (known or drawn)[0]
    facts = pyogrio.read_info(path, layer=name)
    if not facts["crs"]:
        raise UnreadableTruth(f"{called} {path}, layer {name}, states no CRS: set it, for instance with ogr2ogr -a_srs")
    return name, facts


def to_grid(layer: Layer, grid: Grid) -> NDArray[np.object_]:
    """A layer's polygons in the grid's CRS, oriented (shells counter-clockwise), heights in metres."""
    from pyproj import CRS, Transformer

    source = CRS.from_user_input(layer.crs)
    up = source.axis_info[2].unit_conversion_factor if len(source.axis_info) > 2 else 1.0
    move = Transformer.from_crs(source.to_2d(), grid.crs, always_xy=True)

    def moved(points: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = move.transform(points[:, 0], points[:, 1])
        return np.column_stack([x, y, points[:, 2] * up])

    return shapely.orient_polygons(shapely.transform(layer.polygons, moved, include_z=True))


def both_frames(
    points: NDArray[np.float64],
    frame: str,
    vertical: str,
    terrain: Surface,
    lean: tuple[float, float],
    projected_on: Surface,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices (n, 3) given in one frame, in both.

    Returns (image map frame x, y with height above ground; map frame x, y with absolute z), each (n, 3) in metres.
    The height above ground is taken over the DTM where the vertex stands.
    """
    place, z = points[:, :2], points[:, 2]
    if frame == "map":
        standing = place
        z = z if vertical == "absolute" else z + terrain(place)
        seen = view.image_position(place, z, lean, projected_on)
    elif vertical == "above_ground":
        seen = place
        standing, z = view.ground_position(place, z, terrain, lean, projected_on)
    else:
        seen = place
        standing = place + (z - projected_on(place))[:, None] * np.asarray(lean)
    height = z - terrain(standing)
    return np.column_stack([seen, height]), np.column_stack([standing, z])


def convert(
    polygons: NDArray[np.object_], scene: Scene, frame: str, vertical: str
) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
    """Polygons in the grid's CRS -> outlines seen (px, z above ground) and standing (map metres, z absolute)."""
    seen, standing = np.empty_like(polygons), np.empty_like(polygons)
    for rows in _cells(polygons):
        terrain = scene.terrain(tuple(shapely.total_bounds(polygons[rows])), margin=500.0)
        points, owner = shapely.get_coordinates(polygons[rows], include_z=True, return_index=True)
        middle = shapely.get_coordinates(shapely.centroid(polygons[rows]))
        if frame == "map":
            z = np.bincount(owner, points[:, 2]) / np.bincount(owner)
            z = z if vertical == "absolute" else z + terrain(middle)
            lean = scene.leans_of(np.column_stack([middle, z]), terrain)[owner]
        else:
            lean = scene.leans(middle)[owner]
        image, ground = both_frames(points, frame, vertical, terrain, lean, scene.projected_on(terrain))
        pixels = np.column_stack([scene.grid.to_image(image[:, :2]), image[:, 2]])
        seen[rows] = shapely.set_coordinates(polygons[rows].copy(), pixels)
        standing[rows] = shapely.set_coordinates(polygons[rows].copy(), ground)
    return seen, standing


def _cells(polygons: NDArray[np.object_]) -> Iterator[NDArray[np.int64]]:
    """Indices of the polygons, grouped by the cell of `CELL` metres their lower left corner is in."""
    cell = np.floor(shapely.bounds(polygons)[:, :2] / CELL)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def table(layer: Layer, scene: Scene, frame: str, vertical: str) -> pa.Table:
    """`truth.parquet` of a layer: the sections whose seen outline touches the grid.

    Raises `NoHeights` where z is missing or cannot be meant as `vertical` and `frame` say, `NoOverlap` where nothing lies in the
    scene.
    """
    if not shapely.has_z(layer.polygons).all():
        flat = int((~shapely.has_z(layer.polygons)).sum())
        raise NoHeights(
            f"truth layer {layer.name}: {flat} of {len(layer.polygons)} polygons have no z; "
            "every outline must be a PolygonZ with a height at each corner"
        )
    grid = scene.grid
    polygons = to_grid(layer, grid)
    rows = np.flatnonzero(_meets(shapely.bounds(polygons), grid.bounds, AROUND + scene.displaced))
    seen, standing = convert(polygons[rows], scene, frame, vertical) if rows.size else (polygons[:0], polygons[:0])
    if rows.size:
        _plausible(shapely.get_coordinates(seen, include_z=True)[:, 2], layer.name, vertical)
    shown = _meets(shapely.bounds(seen), (0.0, 0.0, grid.width, grid.height), 0.0)
    if not shown.any() and _meets(shapely.bounds(polygons), grid.bounds, 0.0).any():
        height = float(np.median(shapely.get_coordinates(seen, include_z=True)[:, 2]))
        raise NoHeights(
            f"truth layer {layer.name} lies in the scene, but moved by its heights, {height:.0f} m above the ground in the "
            f"median with z read as '{vertical}' and outlines as where roofs are in the '{frame}', none of it is seen there: "
            "check truth_z and truth_frame"
        )
    if not shown.any():
        extent, scene_extent = (
            ", ".join(f"{v:.0f}" for v in bounds) for bounds in (shapely.total_bounds(polygons), grid.bounds)
        )
        raise NoOverlap(
            f"truth layer {layer.name} ({layer.crs}) lies at {extent} in {grid.crs}, outside the scene at {scene_extent}: "
            "check the layer's CRS and the raster it belongs to"
        )
    rows, seen, standing = rows[shown], seen[shown], standing[shown]

    own = layer.columns.get("section_id", layer.columns.get("truth_id"))
    numbered = np.arange(1, len(polygons) + 1)
    ids = _numbers(own).astype(np.int64) if own is not None and _are_labels(own) else numbered
    building = layer.columns.get("building_id", layer.columns.get("building"))
    split, visible = layer.columns.get("split"), layer.columns.get("visible")

    def taken(column: NDArray | None, kind: pa.DataType, missing: int | None = None) -> pa.Array:
        values = None if column is None else _numbers(column)
        if values is None:  # a column of that name that means something else, such as OpenStreetMap's building=yes
            return pa.array([missing] * len(rows), kind)
        known = [missing if np.isnan(v) else v for v in values[rows].tolist()]
        return pa.array(known, pa.float64()).cast(kind, safe=False)

    return pa.table(
        {
            "truth_id": pa.array(ids[rows], pa.int64()),
            "building": taken(building, pa.int64()),
            "outline_seen": pa.array(shapely.to_wkb(seen), pa.binary()),
            "outline_map": pa.array(shapely.to_wkb(standing), pa.binary()),
            "split": _splits(taken(split, pa.int64(), missing=2)),
            "visible": taken(visible, pa.float64()),
        }
    )


def _numbers(column: NDArray) -> NDArray[np.float64] | None:
    """A layer's column as numbers, NaN where there is none; None where it holds something else."""
    try:
        return np.asarray(column, float)
    except (TypeError, ValueError):
        return None


def _splits(codes: pa.Array) -> pa.Array:
    """Codes 0 (training) and 1 (validation) as they are, any other as 2 (testing, or none)."""
    values = codes.to_numpy()
    return pa.array(np.where(np.isin(values, (0, 1)), values, 2), pa.int64())


def _are_labels(column: NDArray) -> bool:
    """Whether a file's own section ids can be labels of pixels: whole, positive, one per section, below 2³¹."""
    ids = _numbers(column)
    if ids is None:
        return False
    fits = np.isfinite(ids).all() and (ids == np.floor(ids)).all() and ids.min() > 0 and ids.max() < 2**31
    return bool(fits) and len(np.unique(ids)) == len(ids)


def _meets(boxes: NDArray[np.float64], bounds: tuple[float, ...], margin: float) -> NDArray[np.bool_]:
    """Which boxes (n, 4) meet `bounds`, each as left, bottom, right, top, when these are grown by a margin."""
    left, bottom, right, top = bounds
    meets = (boxes[:, 0] < right + margin) & (boxes[:, 2] > left - margin)
    return meets & (boxes[:, 1] < top + margin) & (boxes[:, 3] > bottom - margin)


def _plausible(heights: NDArray[np.float64], layer: str, vertical: str) -> None:
    """Raise `NoHeights` for corner heights above ground (m) that no city has."""
    median = float(np.median(heights))
    if PLAUSIBLE[0] < median < PLAUSIBLE[1] and np.isfinite(heights).all() and heights.any():
        return
    other = VERTICAL[1 - VERTICAL.index(vertical)]
    raise NoHeights(
        f"truth layer {layer}: with z read as '{vertical}' the roofs are {median:.0f} m above the ground in the median; "
        f"if z is meant as '{other}', say so (truth_z={other}), else give the outlines real heights in metres"
    )


def read(path: str | Path, scene: Scene) -> Truth:
    """Read `truth.parquet`."""
    rows = store.read_table(path, ["truth_id", "outline_seen", "outline_map", "split"])
    seen = shapely.from_wkb(rows["outline_seen"].to_numpy())
    standing = shapely.from_wkb(rows["outline_map"].to_numpy())
    box = shapely.bounds(seen)
    # A wall's foot is seen (height · lean) away from its eave, here for the section's highest corner.
    tall = np.maximum.reduceat(*_per_polygon(seen)) if len(seen) else np.zeros(0)
    lean = scene.leans(middle_of(seen, scene))
    foot = np.maximum(tall, 0.0)[:, None] * lean * [1.0, -1.0] / scene.grid.gsd
    low = np.minimum(box[:, :2], box[:, :2] + foot)
    high = np.maximum(box[:, 2:], box[:, 2:] + foot)
    slack = 2.0  # px, for terrain that changes between a roof and its foot
    reach = np.hstack([low - slack, high + slack])
    return Truth(rows["truth_id"].to_numpy(), rows["split"].to_numpy(), seen, standing, reach)


def _per_polygon(polygons: NDArray[np.object_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All z values, and where each polygon's begin."""
    points, owner = shapely.get_coordinates(polygons, include_z=True, return_index=True)
    return points[:, 2], np.searchsorted(owner, np.arange(len(polygons)))


def planes_of(outlines: NDArray[np.object_]) -> NDArray[np.float64]:
    """Least-squares planes (n, 5: a, b, c, x0, y0) through the outer vertices of outlines (PolygonZ, map metres).

    Flat at their mean where the vertices lie on a line in plan, or the plane would be steeper than any roof.
    """
    points, owner = shapely.get_coordinates(shapely.get_exterior_ring(outlines), include_z=True, return_index=True)
    last = np.append(owner[1:] != owner[:-1], True)[: len(owner)]
    points, owner = points[~last], owner[~last]

    def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(owner, values, len(outlines))

    size = total(np.ones(len(owner)))
    x0, y0, c = (total(points[:, i]) / size for i in range(3))
    x, y, z = (points - np.column_stack([x0, y0, c])[owner]).T
    xx, xy, yy, xz, yz = total(x * x), total(x * y), total(y * y), total(x * z), total(y * z)
    determinant = xx * yy - xy**2
    thin = determinant <= 1e-9 * (xx + yy) ** 2
    safe = np.where(thin, 1.0, determinant)
    a, b = (yy * xz - xy * yz) / safe, (xx * yz - xy * xz) / safe
    level = thin | (np.hypot(a, b) > STEEPEST)
    return np.column_stack([np.where(level, 0.0, a), np.where(level, 0.0, b), c, x0, y0])


def visible_labels(truth: Truth, scene: Scene, window: Window) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Which truth section each pixel of a window shows, and how high above the ground it is there.

    Along a pixel's view ray the highest surface is the one seen; surfaces are the roof sections and the walls below their
    edges, so a wall hides what is behind it. Returns labels (height, width): `truth_id`, 0 where no roof is seen; and
    heights in m above ground, NaN there.
    """
    labels = np.zeros((window.height, window.width), np.int32)
    heights = np.full(labels.shape, np.nan, np.float32)
    near = truth.near(window)
    if not len(near.ids):
        return labels, heights
    frame = scene.grid.part(window)
    terrain = scene.terrain(frame.bounds, margin=500.0)
    projected_on = scene.projected_on(terrain)

    lean = scene.leans(middle_of(near.seen, scene))
    walls, wall_of = _walls(near.standing, lean, terrain)
    rings, owner = shapely.get_rings(near.standing, return_index=True)
    points, ring = shapely.get_coordinates(rings, include_z=True, return_index=True)
    # Sheared so that one parallel view over height 0 shows every point where the image does.
    points = np.vstack([walls.reshape(-1, 3), points])
    own = lean[np.concatenate([np.repeat(wall_of, 4), owner[ring]])]
    seen = view.image_position(points[:, :2], points[:, 2], own, projected_on)
    lifted = np.column_stack([seen + points[:, 2:] * scene.lean, points[:, 2]])
    faces = [zbuffer.Polygon(quad) for quad in lifted[: 4 * len(walls)].reshape(-1, 4, 3)]
    parts = [part[:-1] for part in np.split(lifted[4 * len(walls) :], np.flatnonzero(np.diff(ring)) + 1)]
    first = np.searchsorted(owner, np.arange(len(near.ids) + 1))
    faces += [zbuffer.Polygon(parts[start], tuple(parts[start + 1 : end])) for start, end in pairwise(first)]
    face = zbuffer.render_faces(faces, scene.lean, frame).face

    rows, cols = np.nonzero(face >= len(walls))
    section = face[rows, cols] - len(walls)
    labels[rows, cols] = near.ids[section]
    image = frame.to_map(np.column_stack([cols, rows]) + 0.5)
    standing, z = view.ray_meets_plane(image, Plane(*planes_of(near.standing)[section].T), lean[section], projected_on)
    heights[rows, cols] = z - terrain(standing)
    return labels, heights


def _walls(
    outlines: NDArray[np.object_], lean: NDArray[np.float64], terrain: Surface
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Walls (n, 4, 3) from the edges of roofs (PolygonZ, map metres, shells counter-clockwise) to the terrain, where they
    face the satellite, which sees each roof with its `lean` (m, 2); and the roof (n,) of each.

    Walls below ridges are made too: no ray reaches them but through a roof, which is higher. Walls that face away never
    show, for the same reason.
    """
    rings, owner = shapely.get_rings(outlines, return_index=True)
    points, ring = shapely.get_coordinates(rings, include_z=True, return_index=True)
    first = np.flatnonzero(ring[:-1] == ring[1:])
    start, end = points[first], points[first + 1]
    roof = owner[ring[first]]
    along = end[:, :2] - start[:, :2]
    foot_start, foot_end = (np.column_stack([p[:, :2], terrain(p[:, :2])]) for p in (start, end))
    faces = along[:, 1] * lean[roof, 0] - along[:, 0] * lean[roof, 1] > 1e-9
    stands = (start[:, 2] > foot_start[:, 2]) & (end[:, 2] > foot_end[:, 2])
    shown = faces & stands
    return np.stack([start, end, foot_end, foot_start], axis=1)[shown], roof[shown]


def main(argv: list[str] | None = None) -> None:
    """Bring a truth layer into both frames: `truth.parquet`."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.truth", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--truth", required=True, help="vector file of PolygonZ roof sections, any CRS")
    parser.add_argument("--frame", choices=FRAMES, default="image", help="where roofs are drawn: seen or standing")
    parser.add_argument("--z", choices=VERTICAL, default="absolute", help="what the heights are")
    parser.add_argument("--out", required=True, help="truth.parquet")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    store.write_table(args.out, table(read_layer(args.truth, args.frame), scene, args.frame, args.z))


if __name__ == "__main__":
    cli.run(main)
