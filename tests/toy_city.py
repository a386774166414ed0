"""A toy scene made by hand: sloping ground, a gable house, a tall block with a courtyard, a shed behind it.

Everything is given in the map frame in closed form; what the image shows follows from `kibs_steps.view`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import rasterio
import shapely
from affine import Affine

from kibs_steps import scene as scenes
from kibs_steps import store, view
from kibs_steps.scene import Scene

CRS = "EPSG:32631"
X0, Y0, GSD, WIDTH, HEIGHT = 590000.0, 5750000.0, 0.5, 320, 240
GROUND = view.Plane(0.05, -0.03, 12.0, X0, Y0)  # the terrain: a plane, so bilinear reading is exact


def make_scene(
    folder: Path,
    direction: tuple[float, float] | None = (181.1, 59.3),
    projection_height: float | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Scene:
    """Write `scene.json`, `dtm.tif` and a plain raster of `size` (px); return the scene."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height = size
    raster = folder / "raster.tif"
    rows, cols = np.mgrid[:height, :width]
    rgb = np.stack([90 + cols % 40, 110 + rows % 40, 80 + (rows + cols) % 30]).astype(np.uint8)
    transform = Affine(GSD, 0, X0, 0, -GSD, Y0)
    shape = {"driver": "GTiff", "count": 3, "height": height, "width": width, "crs": CRS}
    with rasterio.open(raster, "w", dtype="uint8", transform=transform, **shape) as target:
        target.write(rgb)

    step, around = 5.0, 300.0
    n_cols, n_rows = (int((side * GSD + 2 * around) / step) for side in size)
    x = X0 - around + (np.arange(n_cols) + 0.5) * step
    y = Y0 + around - (np.arange(n_rows) + 0.5) * step
    heights = GROUND.at(np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    transform = Affine(step, 0, X0 - around, 0, -step, Y0 + around)
    shape = {"driver": "GTiff", "count": 1, "height": n_rows, "width": n_cols, "crs": CRS}
    with rasterio.open(folder / "dtm.tif", "w", dtype="float32", transform=transform, **shape) as target:
        target.write(heights, 1)

    angles = direction and {
        "azimuth": direction[0],
        "elevation": direction[1],
        "lean": list(view.lean(*direction)),
    }
    store.write_json(
        folder / "scene.json",
        {
            "name": "toy",
            "raster": str(raster),
            "bands": [1, 2, 3],
            "stretch": None,
            "grid": {"crs": CRS, "x0": X0, "y0": Y0, "gsd": GSD, "width": width, "height": height},
            "view": angles,
            "sun": None,
            "projection_height": projection_height,
            "nodata": None,
            "convergence": 0.0,
        },
    )
    return scenes.read(folder / "scene.json")


def at(col: float, row: float, z: float) -> tuple[float, float, float]:
    """A point of the map frame, from metres east and south of the scene's corner."""
    return (X0 + col, Y0 - row, z)


def roofs() -> list[tuple[int, int, shapely.Polygon]]:
    """(section, building, outline in the map frame with absolute z) of the toy city."""
    eave, ridge = 20.0, 25.0
    gable_north = shapely.Polygon([at(30, 30, eave), at(30, 35, ridge), at(50, 35, ridge), at(50, 30, eave)])
    gable_south = shapely.Polygon([at(30, 35, ridge), at(30, 40, eave), at(50, 40, eave), at(50, 35, ridge)])
    ring = [at(80, 60, 40), at(80, 90, 40), at(110, 90, 40), at(110, 60, 40)]
    court = [at(90, 70, 40), at(100, 70, 40), at(100, 80, 40), at(90, 80, 40)]
    block = shapely.Polygon(ring, [court])
    shed = shapely.Polygon([at(85, 42, 20), at(85, 52, 22), at(105, 52, 22), at(105, 42, 20)])
    found = [(11, 11, gable_north), (12, 11, gable_south), (13, 13, block), (14, 14, shed)]
    return [(section, building, shapely.orient_polygons(outline)) for section, building, outline in found]


def seen_outline(scene: Scene, outline: shapely.Polygon) -> shapely.Polygon:
    """A standing outline as the image shows it: px, z = height above the ground."""
    ground = scene.projected_on(GROUND.at)

    def moved(points: np.ndarray) -> np.ndarray:
        image = view.image_position(points[:, :2], points[:, 2], scene.lean, ground)
        return np.column_stack([scene.grid.to_image(image), points[:, 2] - GROUND.at(points[:, :2])])

    return shapely.transform(outline, moved, include_z=True)


def plane_through(outline: shapely.Polygon) -> view.Plane:
    """The plane of a planar outline."""
    points = shapely.get_coordinates(outline, include_z=True)
    x0, y0, c = points[0]
    a, b = np.linalg.lstsq(points[:, :2] - (x0, y0), points[:, 2] - c, rcond=None)[0]
    return view.Plane(float(a), float(b), float(c), float(x0), float(y0))


def buildings_table(scene: Scene, found: list[tuple[int, int, shapely.Polygon]] | None = None) -> pa.Table:
    """`buildings.parquet` of roofs, as a perfect run would write it."""
    found = roofs() if found is None else found
    rows = []
    for section, building, outline in found:
        seen = seen_outline(scene, outline)
        heights = shapely.get_coordinates(seen, include_z=True)[:, 2]
        map_seen = shapely.transform(
            seen, lambda p: np.column_stack([scene.grid.to_map(p[:, :2]), p[:, 2]]), include_z=True
        )
        plane = plane_through(outline)
        slope = float(np.degrees(np.arctan(np.hypot(plane.a, plane.b))))
        rows.append(
            {
                "section_id": section,
                "outline": shapely.to_wkb(shapely.force_2d(seen)),
                "outline_seen": shapely.to_wkb(map_seen),
                "outline_map": shapely.to_wkb(outline),
                "status": "ok",
                "status_reason": "",
                "height_min": heights.min(),
                "height_max": heights.max(),
                "height_mean": heights.mean(),
                "height_sigma": 0.5,
                "slope": slope,
                "azimuth": None if slope < 3 else float(np.degrees(np.arctan2(-plane.a, -plane.b)) % 360),
                "plane_a": plane.a,
                "plane_b": plane.b,
                "plane_c": plane.c,
                "x0": plane.x0,
                "y0": plane.y0,
                "n_corners": 4,
                "score": 0.9,
                "area": outline.area,
                "split": section % 3,
                "sigma_along": 0.3,
                "sigma_across": 0.05,
                "building_id": building,
            }
        )
    return pa.Table.from_pylist(rows)


def truth_table(scene: Scene, found: list[tuple[int, int, shapely.Polygon]] | None = None) -> pa.Table:
    """`truth.parquet` of roofs."""
    found = roofs() if found is None else found
    return pa.table(
        {
            "truth_id": pa.array([section for section, _, _ in found], pa.int64()),
            "building": pa.array([building for _, building, _ in found], pa.int64()),
            "outline_seen": pa.array([shapely.to_wkb(seen_outline(scene, o)) for _, _, o in found], pa.binary()),
            "outline_map": pa.array([shapely.to_wkb(o) for _, _, o in found], pa.binary()),
            "split": pa.array([section % 3 for section, _, _ in found], pa.int64()),
            "visible": pa.array([None] * len(found), pa.float64()),
        }
    )
