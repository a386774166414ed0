"""GeoPackage: `city.gpkg`, the whole result in one file that QGIS opens styled.

In: section tables, attributes of solids, filed corners of all blocks. Out: layers `buildings`, `footprints`, `roof_sections`,
`roof_sections_image`, `corners`, `blocks` with a spatial index each, and `layer_styles`. GeoPackage 1.2, which old GDAL and
QGIS read too. Rows are in order of their ids and every date is `DATE`, so the same city gives the same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from kibs_steps import cli, store
from kibs_steps import scene as scenes
from kibs_steps.grid import Grid, Tiling
from kibs_steps.publish import licences, styles

DATE = "2000-01-01T00:00:00.000Z"  # a file of results has no date of its own: it follows from its inputs
GEOMETRY = "geom"

SECTION_COLUMNS = (
    "section_id",
    "building_id",
    "status",
    "status_reason",
    "height_min",
    "height_max",
    "height_mean",
    "height_sigma",
    "slope",
    "azimuth",
    "plane_a",
    "plane_b",
    "plane_c",
    "x0",
    "y0",
    "n_corners",
    "score",
    "area",
    "split",
    "sigma_along",
    "sigma_across",
)
BUILDING_COLUMNS = (
    "building_id",
    "lod",
    "lod_reason",
    "valid",
    "position_corrected",
    "n_sections",
    "ground_z",
    "eave_z",
    "ridge_z",
    "height",
    "volume",
    "footprint_area",
    "roof_type",
    "height_sigma",
    "position_sigma",
    "faithful",
)
FOOTPRINT_COLUMNS = ("building_id", "lod", "ground_z", "height", "footprint_area")
CORNER_COLUMNS = ("section_id", "height", "sigma", "score")


Tables = Callable[[], Iterator[pa.Table]]  # a table in parts, as often as it is asked for


def rows(tables: Tables, make: Callable[[pa.Table], pa.Table]) -> pa.RecordBatchReader:
    """What `make` makes of each part of a table, as a stream: only a part is in memory."""
    made = map(make, tables())
    first = next(made)
    batches = (batch for part in chain([first], made) for batch in part.cast(first.schema).to_batches())
    return pa.RecordBatchReader.from_batches(first.schema, batches)


def layer(table: pa.Table, columns: tuple[str, ...], geometry: pa.Array | pa.ChunkedArray) -> pa.Table:
    """The columns of a layer and its geometry (WKB); rows without geometry are left out."""
    rows = table.select(list(columns)).append_column(GEOMETRY, geometry)
    return rows.filter(pc.is_valid(rows[GEOMETRY]))


def outlines(wkb: pa.ChunkedArray) -> pa.Array:
    """Plane MultiPolygons of polygons of any kind (WKB, nulls kept)."""
    shapes = shapely.force_2d(shapely.from_wkb(wkb.to_numpy()))
    single = shapely.get_type_id(shapes) == shapely.GeometryType.POLYGON
    shapes[single] = [shapely.MultiPolygon([shape]) for shape in shapes[single]]
    return pa.array(shapely.to_wkb(shapes), pa.binary(), from_pandas=True)


def footprints(solids: pa.Table) -> pa.Table:
    """Layer `footprints`: a row per polygon, so that a building whose parts do not touch has several."""
    solids = solids.filter(solids["footprint"].is_valid())  # what has one; that itself is the largest part alone
    parts, owner = shapely.get_parts(
        shapely.force_2d(shapely.from_wkb(solids["outline"].to_numpy())), return_index=True
    )
    rows = solids.select(list(FOOTPRINT_COLUMNS)).take(pa.array(owner, pa.int64()))
    own = pa.array(np.round(shapely.area(parts), 3), pa.float64())
    rows = rows.set_column(rows.column_names.index("footprint_area"), "footprint_area", own)
    return rows.append_column(GEOMETRY, pa.array(shapely.to_wkb(parts), pa.binary()))


def blocks(tiling: Tiling, grid: Grid, known: dict[str, dict[str, str]]) -> pa.Table:
    """Layer `blocks`: the part of the grid each block answers for (image map frame), its status and reason.

    `known` gives status and reason by block name; a block that is not in it is `ok`.
    """
    rows = []
    for block in tiling.blocks(grid.width, grid.height):
        left, bottom, right, top = grid.part(tiling.block_core(block, grid.width, grid.height)).bounds
        state = known.get(block.name, {})
        shape = shapely.to_wkb(shapely.box(left, bottom, right, top))
        rows.append((block.name, state.get("status", "ok"), state.get("reason", ""), shape))
    kinds = {"block": pa.string(), "status": pa.string(), "reason": pa.string(), GEOMETRY: pa.binary()}
    return pa.table([pa.array(column, kind) for column, kind in zip(zip(*rows, strict=True), kinds.values(), strict=True)],
                    names=list(kinds))  # fmt: skip


def points(corners: pa.Table) -> pa.Table:
    """Layer `corners`."""
    shapes = shapely.points(*(corners[name].to_numpy() for name in ("x", "y", "z")))
    return layer(corners, CORNER_COLUMNS, pa.array(shapely.to_wkb(shapes), pa.binary()))


def layers(sections: Tables, solids: Tables, corners: Tables) -> dict[str, tuple[str, pa.RecordBatchReader]]:
    """The layers that follow from the tables: geometry type and rows by name, after DESIGN's interface."""
    return {
        "buildings": ("MultiPolygon", rows(solids, lambda t: layer(t, BUILDING_COLUMNS, outlines(t["outline"])))),
        "footprints": ("Polygon", rows(solids, footprints)),
        "roof_sections": ("Polygon Z", rows(sections, lambda t: layer(t, SECTION_COLUMNS, t["outline_map"]))),
        "roof_sections_image": ("Polygon Z", rows(sections, lambda t: layer(t, SECTION_COLUMNS, t["outline_seen"]))),
        "corners": ("Point Z", rows(corners, points)),
    }


def write(
    path: str | Path,
    content: dict[str, tuple[str, pa.Table | pa.RecordBatchReader]],
    crs: str,
    metadata: dict[str, str],
) -> None:
    """Write layers (geometry type, rows with WKB in `geom`) and their styles to a GeoPackage, whole."""
    import pyogrio
    from pyogrio.raw import write_arrow

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": DATE})
    with store.whole(path) as temporary:
        temporary.unlink()
        for name, (kind, features) in content.items():
            write_arrow(
                features,
                temporary,
                layer=name,
                driver="GPKG",
                geometry_name=GEOMETRY,
                geometry_type=kind,
                crs=crs,
                dataset_metadata=metadata or None,
                dataset_options={"VERSION": "1.2"},
                layer_options={"SPATIAL_INDEX": "YES"},
            )
        names = [name for name in content if name in styles.STYLES]
        write_arrow(
            styles.table(names, GEOMETRY, DATE),
            temporary,
            layer="layer_styles",
            driver="GPKG",
            dataset_options={"VERSION": "1.2"},
            layer_options={"FID": "id"},
        )


def main(argv: list[str] | None = None) -> None:
    """Write the GeoPackage of a scene."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.geopackage", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--tile", type=int, required=True, help="tile side, px")
    parser.add_argument("--margin", type=int, required=True, help="margin on each side of a tile, px")
    parser.add_argument("--block", type=int, required=True, help="block side in tiles")
    parser.add_argument("--sections", required=True, nargs="+", help="buildings.parquet")
    parser.add_argument("--solids", required=True, nargs="+", help="solids.parquet of all blocks")
    parser.add_argument("--corners", required=True, nargs="+", help="filed_corners.parquet of all blocks")
    parser.add_argument("--blocks", help='JSON {"r000c000": {"status": …, "reason": …}}; blocks not in it are ok')
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licence goes into the metadata")
    parser.add_argument("--out", required=True, help="out: city.gpkg")
    args = parser.parse_args(argv)
    scene = scenes.read(args.scene)
    content: dict[str, tuple[str, pa.Table | pa.RecordBatchReader]] = layers(
        lambda: store.merged(args.sections, ["section_id"]),
        lambda: store.merged(args.solids, ["building_id"]),
        lambda: store.merged(args.corners, ["section_id", "x", "y", "z"]),
    )
    known = store.read_json(args.blocks) if args.blocks else {}
    content["blocks"] = ("Polygon", blocks(Tiling(args.tile, args.margin, args.block), scene.grid, known))
    line = licences.line(args.models)
    write(args.out, content, scene.grid.crs, {"LICENCE": line} if line else {})


if __name__ == "__main__":
    cli.run(main, pandas=False)
