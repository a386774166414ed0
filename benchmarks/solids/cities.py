"""How good the solids are when the sections are: cities with known truth, fed exactly and with the errors that models make.

    python benchmarks/solids/cities.py --work FOLDER [--cities FOLDER] [--size 600] [--only NAME ...] [--levels none low ...]

Each city is simulated (`kibs_steps.simulate.scene`; real ones from CityJSON files in `--cities`), its truth goes through
planes, ground, buildings
and solids in memory, and every published solid is held against `independent.py`. Errors are made where models make them, in
the image:
the label image of what is visible is warped by a smooth random field and traced, corners are shifted and given wrong heights.
Prints Markdown
tables; `results.json` in the folder has all figures.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import by_cgal
import independent
import numpy as np
import pyarrow as pa
import rasterio.features
import shapely
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from kibs_steps import buildings, features, ground, heightmap, planes, scene, solids, stitch, store, truth, zbuffer
from kibs_steps.faces import MM
from kibs_steps.grid import Grid, Window
from kibs_steps.shells import ROOF

CITIES = {
    "Den Haag": ["--city=DenHaag_01.json", "--view-azimuth=181.1", "--view-elevation=59.3"],
    "Delfshaven": ["--city=3-20-DELFSHAVEN.city.json", "--view-azimuth=110", "--view-elevation=66.6"],
    "Brussels": ["--city=bruxelles.city.json", "--view-azimuth=255", "--view-elevation=72"],
    "town": ["--style=town", "--seed=31"],
    "town, 15 % slope": ["--style=town", "--seed=31", "--slope=15"],
    "perimeter blocks": ["--style=perimeter", "--seed=32", "--view-azimuth=20", "--view-elevation=70"],
    "rows": ["--style=rows", "--seed=33", "--view-azimuth=140", "--view-elevation=62"],
}
LEVELS = {  # labels (px), corners (px), heights (m): σ; None: exact outlines
    "exact": None,
    "none": (0.0, 0.0, 0.0),
    "low": (0.5, 0.5, 0.3),
    "middle": (1.0, 1.0, 0.8),
    "high": (1.5, 1.5, 1.5),
}
SMOOTH = 6.0  # px, how far the errors of a label image reach
REACH = 7.5  # px, of a corner to its section
CELL = 0.1  # m, of the raster that volumes are counted on
SEEN = 0.95


class World(NamedTuple):
    """A simulated city: its facts, terrain, truth table and the truth's polygons."""

    facts: scene.Scene
    dtm: Any
    table: pa.Table
    standing: np.ndarray
    seen: np.ndarray


def world(folder: Path, options: list[str], size: int, cities: Path | None) -> World:
    """Simulate a city into a folder, once, and read it back through the project's own steps."""
    options = [o if not o.startswith("--city=") else f"--city={cities / o[7:]}" for o in options]
    if not (folder / "truth.parquet").exists():
        command = [sys.executable, "-m", "kibs_steps.simulate.scene", f"--size={size}", *options, "--out", str(folder)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        angles = json.loads((folder / "angles.json").read_text())
        view = angles["view_azimuth"], angles["view_elevation"]
        (folder / "scene").mkdir(exist_ok=True)
        facts = scene.build("s", folder / "scene.tif", folder / "dtm.tif", 0.38, folder / "scene", view=view)
        found = truth.table(truth.read_layer(folder / "truth.gpkg", "map"), facts, "map", "absolute")
        store.write_table(folder / "truth.parquet", found)
    facts = scene.read(folder / "scene/scene.json")
    table = store.read_table(folder / "truth.parquet")
    seen = shapely.from_wkb(table["outline_seen"].to_numpy())
    box = shapely.bounds(seen)
    inside = (box[:, :2] > 0).all(axis=1) & (box[:, 2:] < (facts.grid.width, facts.grid.height)).all(axis=1)
    table, seen = table.filter(pa.array(inside)), seen[inside]
    standing = shapely.from_wkb(table["outline_map"].to_numpy())
    return World(facts, facts.terrain(facts.grid.bounds, 300.0), table, standing, seen)


def exact(city: World) -> tuple[pa.Table, pa.Table]:
    """Sections and corners as `feed` and `stitch` make them of the truth."""
    ids = city.table["truth_id"].to_numpy()
    xyz, owner = shapely.get_coordinates(city.seen, include_z=True, return_index=True)
    return _sections(shapely.force_2d(city.seen), ids), _corners(xyz, 0.01, ids[owner])


def disturbed(city: World, level: tuple[float, float, float], seed: int) -> tuple[pa.Table, pa.Table]:
    """Sections and corners as models would find them, with errors of that size."""
    rng = np.random.default_rng(seed)
    labels_off, corners_off, heights_off = level
    every = truth.Truth(
        city.table["truth_id"].to_numpy(),
        city.table["split"].to_numpy(),
        city.seen,
        city.standing,
        np.column_stack([shapely.bounds(city.seen)[:, :2] - 40, shapely.bounds(city.seen)[:, 2:] + 40]),
    )
    grid = city.facts.grid
    labels, _ = truth.visible_labels(every, city.facts, Window(0, 0, grid.width, grid.height))
    if labels_off:
        field = [gaussian_filter(rng.normal(size=labels.shape), SMOOTH) for _ in range(2)]
        field = [f / f.std() * labels_off for f in field]
        rows, cols = np.mgrid[: labels.shape[0], : labels.shape[1]]
        labels = map_coordinates(labels, [rows + field[0], cols + field[1]], order=0, mode="nearest")
    shapes: dict[int, shapely.Polygon] = {}
    for geometry, value in rasterio.features.shapes(labels, mask=labels > 0):
        shape = shapely.geometry.shape(geometry)
        if shape.area > shapes.get(int(value), shapely.Polygon()).area:
            shapes[int(value)] = shape
    ids = np.array(sorted(k for k, s in shapes.items() if s.area >= 12))
    outlines = stitch.simplified(shapely.normalize(np.array([shapes[k] for k in ids], object)), 1.5)
    known = np.isin(every.ids, ids)
    xyz, owner = shapely.get_coordinates(city.seen[known], include_z=True, return_index=True)
    xyz = xyz + rng.normal(size=xyz.shape) * (corners_off, corners_off, heights_off)
    return _sections(outlines, ids, owned=False), _corners(xyz, max(heights_off, 0.05), np.zeros(len(owner), np.int64))


def _sections(outlines: np.ndarray, ids: np.ndarray, owned: bool = True) -> pa.Table:
    n = len(ids)
    columns = [ids, shapely.to_wkb(outlines), np.ones(n), np.full(n, 2), np.zeros(n, bool), np.zeros(n, bool)]
    columns += [ids if owned else np.zeros(n, np.int64), [heightmap.EMPTY] * n]
    return pa.table(
        [pa.array(c, f.type) for c, f in zip(columns, stitch.SECTIONS, strict=True)], schema=stitch.SECTIONS
    )


def _corners(xyz: np.ndarray, sigma: float, owner: np.ndarray) -> pa.Table:
    rows = np.unique(np.column_stack([xyz, owner]), axis=0)
    n = len(rows)
    names = {
        "col": rows[:, 0],
        "row": rows[:, 1],
        "height": rows[:, 2],
        "sigma": np.full(n, sigma),
        "score": np.ones(n),
    }
    return pa.table({**names, "owner": rows[:, 3].astype(np.int64)})


def built(city: World, sections: pa.Table, corners: pa.Table) -> tuple[list[tuple[dict, Any, Any]], float]:
    """(attributes, sections, solid) of every building, and the time from planes to solids (s)."""
    started = time.process_time()
    facts, dtm = city.facts, city.dtm
    table, _ = planes.planes(sections, corners, facts, dtm, (6.0, 3.0), REACH, "robust")
    table = ground.ground(table, facts, dtm)
    outlines = shapely.from_wkb(table["outline_map"].to_numpy())
    flat = np.stack([table[n].to_numpy() for n in ("plane_a", "plane_b", "plane_c", "x0", "y0")], axis=1)
    building, cluster = buildings.buildings(table["section_id"].to_numpy(), outlines, flat, facts.lean)
    table = table.append_column("building_id", pa.array(building)).append_column("cluster_id", pa.array(cluster))
    found = []
    for names, some in solids.clusters_of(table):
        fit = solids.fit_of(some, np.array([facts.lean]), facts.grid.gsd)
        for name, mine, solid in solids.together(some, names, dtm, "2.0", fit):
            found.append((features.attributes(name, mine, solid), mine, solid))
    return found, time.process_time() - started


def measured(city: World, found: list[tuple[dict, Any, Any]], seconds: float) -> dict[str, Any]:
    """The figures of one city at one level."""
    faulty = 0
    for row, mine, solid in found:
        feature = features.feature(row, mine, solid, (0, 0), 0.0)
        xyz = np.array(feature["vertices"], float).reshape(-1, 3) / MM
        for thing in feature["CityObjects"].values():
            for geometry in thing.get("geometry", []):
                if geometry["type"] == "Solid":
                    shell = geometry["boundaries"][0]
                    faulty += bool(independent.faults(shell, xyz) or by_cgal.faults(shell, xyz))
    lods = Counter(row["lod"] for row, _, _ in found)
    good = [row for row, mine, _ in found if "ok" in mine.status]
    full = [r for r in good if r["lod"] == "2.0" and (r["faithful"] is None or r["faithful"] >= 0.9)]
    place, height = corner_errors(city, found)
    volume = volume_errors(city, found)
    return {
        "buildings": len(found),
        "lod": dict(lods),
        "faulty": faulty,
        "lod2": len(full) / max(len(good), 1),
        "without": lods["0"] / max(len(found), 1),
        "corner": float(np.median(place)),
        "height": float(np.median(height)),
        "volume within 2 %": float((volume < 0.02).mean()) if len(volume) else None,
        "volume": float(np.median(volume)) if len(volume) else None,
        "volumes compared": len(volume),
        "ms per building": 1000 * seconds / max(len(found), 1),
        "reasons": dict(
            Counter(row["lod_reason"].split(": ", 1)[-1][:60] for row, _, _ in found if row["lod_reason"]).most_common(
                5
            )
        ),
    }


def corner_errors(city: World, found: list[tuple[dict, Any, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """How far (m, in plan and in height) each true corner is from the nearest corner of its section's own roof faces."""
    ids = city.table["truth_id"].to_numpy()
    at = {int(k): n for n, k in enumerate(ids)}
    place, height = [], []
    for _, mine, solid in found:
        roofs: dict[int, list[tuple[int, int, int]]] = {}
        for surface in (s for shell in solid.shells for s in shell if s.kind == ROOF and solid.lod != "1.2"):
            roofs.setdefault(int(mine.ids[surface.section]), []).extend(p for ring in surface.rings for p in ring)
        for section, points in roofs.items():
            if section not in at:
                continue
            true = shapely.get_coordinates(city.standing[at[section]], include_z=True)[:-1]
            own = np.array(points, float) / MM + (*mine.origin, 0.0)
            apart, near = cKDTree(own[:, :2]).query(true[:, :2])
            place += apart.tolist()
            height += np.abs(own[near, 2] - true[:, 2]).tolist()
    return np.array(place), np.array(height)


def volume_errors(city: World, found: list[tuple[dict, Any, Any]]) -> np.ndarray:
    """Relative errors of the volumes of buildings that are at least `SEEN` visible, counted on a raster of the true roofs."""
    left, bottom, right, top = city.facts.grid.bounds
    frame = Grid(
        city.facts.grid.crs, left - 40, top + 40, CELL, int((right - left + 80) / CELL), int((top - bottom + 80) / CELL)
    )
    rings = [zbuffer.Polygon(*_rings(shape)) for shape in city.standing]
    hits = zbuffer.render_faces(rings, (0.0, 0.0), frame)
    ids = city.table["truth_id"].to_numpy()
    visible = city.table["visible"].to_numpy()
    at = {int(k): n for n, k in enumerate(ids)}
    area, moment = np.zeros(len(ids)), np.zeros(len(ids))
    shown = hits.face >= 0
    np.add.at(area, hits.face[shown], CELL**2)
    np.add.at(moment, hits.face[shown], CELL**2 * hits.height[shown])
    errors = []
    for row, mine, _ in found:
        rows = np.array([at[int(k)] for k in mine.ids if int(k) in at])
        if row["lod"] == "0" or len(rows) < len(mine.ids) or not area[rows].sum() > 4:
            continue
        seen = (visible[rows] * area[rows]).sum() / area[rows].sum()
        true = (moment[rows] - row["ground_z"] * area[rows]).sum()
        if seen >= SEEN and true > 0:
            errors.append(abs(row["volume"] / true - 1))
    return np.array(errors)


def _rings(shape: shapely.Polygon) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    exterior, *holes = (shapely.get_coordinates(r, include_z=True)[:-1] for r in (shape.exterior, *shape.interiors))
    return exterior, tuple(holes)


def table_of(rows: dict[str, dict[str, Any]], first: str) -> str:
    """Figures as a Markdown table."""
    names = (
        "buildings",
        "LOD 2.0 / 1.3 / 1.2 / 0",
        "faulty",
        "LOD2 by the criterion",
        "corners",
        "heights",
        "volume",
        "ms",
    )
    lines = [f"| {first} | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for name, r in rows.items():
        lods = " / ".join(str(r["lod"].get(k, 0)) for k in ("2.0", "1.3", "1.2", "0"))
        volume = "–"
        if r["volume"] is not None:
            near = f"{100 * r['volume within 2 %']:.0f} % of {r['volumes compared']} within 2 %"
            volume = f"{100 * r['volume']:.1f} %, {near}"
        cells = [name, r["buildings"], lods, r["faulty"], f"{100 * r['lod2']:.1f} %", f"{r['corner']:.2f} m"]
        cells += [f"{r['height']:.2f} m", volume, f"{r['ms per building']:.0f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the cities and levels asked for and print their tables."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--work", type=Path, required=True, help="folder for the simulated cities and results.json")
    parser.add_argument("--cities", type=Path, help="folder with the real cities' CityJSON files; left out without it")
    parser.add_argument("--size", type=int, default=600, help="px per side")
    parser.add_argument("--only", nargs="*", help="names of cities")
    parser.add_argument("--levels", nargs="*", default=list(LEVELS), choices=list(LEVELS))
    args = parser.parse_args()
    results: dict[str, dict[str, Any]] = {}
    for name, options in CITIES.items():
        real = any(o.startswith("--city=") for o in options)
        if (args.only and name not in args.only) or (real and not args.cities):
            continue
        city = world(args.work / name.replace(" ", "_").replace("%", "pc"), options, args.size, args.cities)
        for level in args.levels:
            fed = exact(city) if LEVELS[level] is None else disturbed(city, LEVELS[level], seed=7)
            results.setdefault(level, {})[name] = measured(city, *built(city, *fed))
        (args.work / "results.json").write_text(json.dumps(results, indent=1))
    for level, rows in results.items():
        print(f"\nErrors: {level} {LEVELS[level] or ''}\n\n{table_of(rows, 'city')}")


if __name__ == "__main__":
    main()
