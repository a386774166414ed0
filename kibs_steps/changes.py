"""Changes: what differs between two results of one place: another model, another date.

In: two results (folders with `city.gpkg`, or GeoPackages). Buildings of the two are taken for one where their outlines overlap
most, in turn; what is
left, where one of much the same size stands close by. Out: `changes.gpkg` (a polygon per building of either), `changes.json`,
`changes.txt`.
A building is `new`, `gone`, or has `moved` or become `higher` or `lower` by more than its own uncertainty explains.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree

from kibs_steps import cli, store
from kibs_steps.errors import KibsError

OVERLAP = 0.3  # of the smaller of two outlines, from which on they may be one building
NEAR = 8.0  # m, how far a building that nothing overlaps is looked for
ALIKE = 0.6  # ratio of areas of such a pair
WHOLE = 0.95  # ratio of areas below which one outline may be a part of the other,
WITHIN = 0.9  # if as much of it lies within
MOVED = 1.5  # m
HEIGHT = 1.0  # m
SIGMAS = 3.0
KINDS = ("new", "gone", "moved", "higher", "lower", "same")
COLUMNS = ("building_id", "lod", "height", "height_sigma", "position_sigma", "volume")


class ResultsUnusable(KibsError):
    """Results that cannot be compared."""


def pairs_of(old: np.ndarray, new: np.ndarray) -> list[tuple[int, int]]:
    """Which outlines of `old` (n,) and `new` (m,) are one building: (old, new), each at most once, by `old`."""
    found: list[tuple[int, int]] = []
    left, right = set(range(len(old))), set(range(len(new)))
    if not left or not right:
        return found
    j, i = shapely.STRtree(old).query(new, predicate="intersects")[::1]
    shared = shapely.area(shapely.intersection(old[i], new[j]))
    smaller = np.minimum(shapely.area(old[i]), shapely.area(new[j]))
    order = np.lexsort((j, i, -shared))
    candidates = [(int(i[k]), int(j[k])) for k in order if shared[k] >= OVERLAP * smaller[k] and shared[k] > 0]
    middle = [shapely.get_coordinates(shapely.centroid(g)) for g in (old, new)]
    near = cKDTree(middle[0]).query_ball_point(middle[1], NEAR)
    close = [
        (round(float(np.hypot(*(middle[0][o] - middle[1][n]))), 6), o, n) for n in range(len(new)) for o in near[n]
    ]
    for _, o, n in sorted(close):
        size = sorted((old[o].area, new[n].area))
        if size[0] >= ALIKE * size[1]:
            candidates.append((o, n))
    for o, n in candidates:
        if o in left and n in right:
            found.append((o, n))
            left.discard(o)
            right.discard(n)
    return sorted(found)


def compared(before: dict[str, Any], after: dict[str, Any], offset: float) -> str:
    """What became of a building: kinds after `KINDS`, comma between two; `offset` (m) of its outline's middle."""

    def sigma(name: str) -> float:
        return float(np.hypot(*(row.get(name) or 0.0 for row in (before, after))))

    kinds = []
    if offset > max(MOVED, SIGMAS * sigma("position_sigma")):
        kinds.append("moved")
    rise = _difference(before["height"], after["height"])
    if rise is not None and abs(rise) > max(HEIGHT, SIGMAS * sigma("height_sigma")):
        kinds.append("higher" if rise > 0 else "lower")
    return ", ".join(kinds) or "same"


def _difference(before: float | None, after: float | None) -> float | None:
    if before is None or after is None or not np.isfinite([before, after]).all():
        return None
    return float(after - before)


def changes(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row per building of either: `change`, ids, heights, `height_change`, `offset` (m), `geometry` (of the newer)."""
    shapes = [np.array([row["geometry"] for row in rows], object) for rows in (old, new)]
    together = pairs_of(*shapes)
    rows = []
    for o, n in together:
        a, b = (shapely.get_coordinates(shapely.centroid(s[k]))[0] for s, k in zip(shapes, (o, n), strict=True))
        offset = float(np.hypot(*(b - a)))
        moved = 0.0 if is_part(shapes[0][o], shapes[1][n]) else offset
        rows.append(_row(compared(old[o], new[n], moved), old[o], new[n], offset))
    rows += [_row("gone", old[o], None, None) for o in sorted(set(range(len(old))) - {o for o, _ in together})]
    rows += [_row("new", None, new[n], None) for n in sorted(set(range(len(new))) - {n for _, n in together})]
    return rows


def is_part(one: shapely.Geometry, other: shapely.Geometry) -> bool:
    """Whether one of two outlines is the other less some of it: its middle is elsewhere, though nothing moved."""
    small, large = sorted((one, other), key=lambda shape: shape.area)
    lost = small.area < WHOLE * large.area and small.intersection(large).area >= WITHIN * small.area
    return lost or small.area < ALIKE * large.area


def _row(
    change: str, before: dict[str, Any] | None, after: dict[str, Any] | None, offset: float | None
) -> dict[str, Any]:
    first, second = before or {}, after or {}
    rise = _difference(first.get("height"), second.get("height"))
    return {
        "change": change,
        "building_old": first.get("building_id"),
        "building_new": second.get("building_id"),
        "height_old": first.get("height"),
        "height_new": second.get("height"),
        "height_change": None if rise is None else round(rise, 3),
        "offset": None if offset is None else round(offset, 3),
        "lod_old": first.get("lod"),
        "lod_new": second.get("lod"),
        "geometry": second.get("geometry") or first.get("geometry"),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts by kind and the middle changes."""
    kinds = Counter(kind for row in rows for kind in row["change"].split(", "))
    rises = [row["height_change"] for row in rows if row["height_change"] is not None]
    offsets = [row["offset"] for row in rows if row["offset"] is not None]
    return {
        "buildings_old": sum(row["building_old"] is not None for row in rows),
        "buildings_new": sum(row["building_new"] is not None for row in rows),
        "changes": {kind: kinds.get(kind, 0) for kind in KINDS},
        "median_height_change": round(float(np.median(rises)), 3) if rises else None,
        "median_offset": round(float(np.median(offsets)), 3) if offsets else None,
    }


def text(found: dict[str, Any], rows: list[dict[str, Any]], names: tuple[str, str]) -> str:
    """The report in words."""
    told = ", ".join(f"{n} {kind}" for kind, n in found["changes"].items() if n)
    lines = [
        f"{names[0]}: {found['buildings_old']} buildings; {names[1]}: {found['buildings_new']} buildings.",
        f"{told or 'nothing'}.",
    ]
    risen = sorted(
        (r for r in rows if r["change"] not in ("same", "new", "gone") and r["height_change"] is not None),
        key=lambda r: -abs(r["height_change"]),
    )
    for row in risen[:10]:
        lines.append(
            f"building {row['building_old']} -> {row['building_new']}: {row['change']}, "
            f"{row['height_old']:.1f} -> {row['height_new']:.1f} m high, {row['offset']:.1f} m apart"
        )
    return "\n".join(lines) + "\n"


def read(path: Path) -> tuple[list[dict[str, Any]], str]:
    """The buildings of a result, by id, and their CRS. Raises `ResultsUnusable`."""
    import geopandas
    import pyogrio

    file = path / "city.gpkg" if path.is_dir() else path
    try:
        frame = geopandas.read_file(file, layer="buildings")
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise ResultsUnusable(f"{file} holds no layer buildings ({error}): give a folder of results/") from error
    rows = []
    for record, shape in zip(frame.drop(columns="geometry").to_dict("records"), frame.geometry, strict=True):
        if shape is not None and shape.area > 0:
            kept = {name: _plain(record.get(name)) for name in COLUMNS}
            rows.append({**kept, "geometry": shapely.make_valid(shapely.force_2d(shape))})
    return sorted(rows, key=lambda row: row["building_id"]), str(frame.crs)


def _plain(value: Any) -> Any:
    return None if value is None or value != value else value  # NaN is not itself


def main(argv: list[str] | None = None) -> None:
    """Compare two results of one place."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.changes", description=main.__doc__)
    parser.add_argument("old", type=Path, help="results/SCENE, or its city.gpkg")
    parser.add_argument("new", type=Path, help="the newer one")
    parser.add_argument("--out", type=Path, default=Path("changes"), help="out: folder for changes.gpkg, .json, .txt")
    args = parser.parse_args(argv)
    (old, crs), (new, other) = read(args.old), read(args.new)
    if crs != other:
        raise ResultsUnusable(f"{args.old} is in {crs}, {args.new} in {other}: build both in one CRS")
    rows = changes(old, new)
    found = summary(rows)
    report = text(found, rows, (args.old.name, args.new.name))
    plain = [{k: v for k, v in row.items() if k != "geometry"} for row in rows]
    store.write_json(args.out / "changes.json", {**found, "buildings": plain}, summed=False)
    with store.whole(args.out / "changes.txt", summed=False) as temporary:
        temporary.write_text(report, encoding="utf-8")
    _write_layer(args.out / "changes.gpkg", rows, crs)
    print(report, end="")


def _write_layer(path: Path, rows: list[dict[str, Any]], crs: str) -> None:
    import geopandas

    def areas(shape: shapely.Geometry) -> shapely.MultiPolygon:
        return shapely.MultiPolygon(
            [p for p in shapely.get_parts(shapely.get_parts(shape)) if p.geom_type == "Polygon"]
        )

    shapes = [areas(row["geometry"]) for row in rows]
    names = [k for k in (rows[0] if rows else {"change": ""}) if k != "geometry"]
    frame = geopandas.GeoDataFrame({k: [row[k] for row in rows] for k in names}, geometry=shapes, crs=crs)
    for name in ("building_old", "building_new"):
        if name in frame:
            frame[name] = frame[name].astype("Int64")
    with store.whole(path, summed=False) as temporary:
        temporary.unlink()
        frame.to_file(temporary, layer="changes", driver="GPKG")


if __name__ == "__main__":
    cli.run(main)
