"""Inputs: what a user gave, looked at before any work, by headers alone.

`check` runs each time the workflow is read, so that a run of hours does not end at a layer without heights; what needs the
data themselves (`scene`, `truth`) follows in the first jobs. docs/inputs.md lists every bad input with the message it gets.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kibs_steps import sources
from kibs_steps.errors import KibsError

if TYPE_CHECKING:
    from kibs_steps.plan import Plan


class ResultsUnwritable(KibsError):
    """The place where results go does not take them."""


class FootprintsUnusable(KibsError):
    """Footprints that cannot be read or placed."""


class FromTheFuture(KibsError):
    """A file that is dated later than now."""


def dated(plan: Plan) -> None:
    """Refuse files dated later than now (as unpacked from an archive made farther east): Snakemake refuses what is made of
    them."""
    files = [
        *sources.files(plan.raster),
        *plan.terrain_files,
        *plan.named_files,
        *(m.path for m in plan.models.values()),
    ]
    for path in map(Path, files):
        if path.exists() and max(path.stat().st_mtime, path.lstat().st_mtime) > time.time() + 1:
            raise FromTheFuture(
                f"{path} is dated later than now: give it today's date (touch {path}), its content counts alone"
            )


def check(plan: Plan, results: Path) -> list[str]:
    """Refuse what a scene cannot be made from; returns what is doubtful. Raises the named errors of docs/inputs.md."""
    import pyproj

    from kibs_steps import dtm, georeference, imagery, regions, scene

    writable(results / plan.name)
    settings = plan.settings
    dated(plan)
    if settings.get("simulate") is not None:
        return []
    grid = georeference.model_grid(plan.raster, plan.models["sections"].contract["gsd"], settings.get("aoi"))
    for name, lowest in (("view", 20.0), ("sun", 5.0)):
        scene.direction(settings.get(f"{name}_azimuth"), settings.get(f"{name}_elevation"), grid, name, lowest)
    vertical = settings.get("vertical_crs")
    georeference.check_vertical(vertical)
    lacking = georeference.missing_geoid(grid.crs, vertical)
    doubts = [
        f"PROJ lacks the geoid {lacking}: 3D Tiles take heights of {vertical} from the ellipsoid, up to 100 m off; fetch it "
        f"(pyproj sync --file {lacking}, or PROJ_NETWORK=ON)"
        if lacking
        else ""
    ]
    with imagery.opened(plan.raster) as source:
        imagery.complete(source)
        doubts.append(imagery.colour_bands(source, bands_of(settings))[1])
        footprint = imagery.outline(source, pyproj.CRS.from_user_input(grid.crs))
    doubts += dtm.check(plan.dtm, grid, footprint, vertical)
    if settings.get("dsm"):
        doubts += dtm.check(settings["dsm"], grid, footprint, vertical, "dsm")
    if settings.get("regions"):
        regions.read(settings["regions"], grid)
    if plan.truth:
        # Projected on one height, things stand as far from where they are seen as only `scene` finds out.
        check_truth(plan.truth, settings["truth_frame"], grid, placed=settings.get("projection_height") is None)
    if settings.get("footprints"):
        check_footprints(settings["footprints"])
    if settings.get("sections"):
        check_sections(settings["sections"], grid)
    return [doubt for doubt in doubts if doubt]


def bands_of(settings: dict[str, Any]) -> tuple[int, ...] | None:
    """The setting `bands`, a list or text like "5,3,2", as numbers."""
    bands = settings.get("bands")
    return None if bands is None else tuple(int(b) for b in (bands.split(",") if isinstance(bands, str) else bands))


def writable(folder: Path) -> None:
    """Refuse a folder for results that cannot be made or written to."""
    if folder.is_symlink() and not folder.exists():
        raise ResultsUnwritable(f"{folder} is a link to {folder.readlink()}, which is not there: mount it, or make it")
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise ResultsUnwritable(f"{folder} cannot be made: {there} is a file; move it away, or start in another folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ResultsUnwritable(f"{folder} cannot be written: {there} is not yours; start in a folder that is")


def check_truth(path: str, frame: str, grid: Any, placed: bool = True) -> None:
    """Look at a truth layer's header; raises what `truth` raises. `placed`: what the grid shows stands about there."""
    from kibs_steps import truth

    name, facts = truth.layer_of(path, frame)
    if facts["features"] == 0:
        raise truth.NoPolygons(f"truth {path}, layer {name}, has no polygons: draw some, or leave truth out")
    kind = facts["geometry_type"] or ""
    if "Polygon" in kind and not any(mark in kind for mark in (" Z", "3D", "2.5D")):
        raise truth.NoHeights(
            f"truth {path}, layer {name}, holds {kind}s without z: every outline must be a PolygonZ with a height at each corner"
        )
    bounds = _bounds(path, name, facts)
    if placed and _off(bounds, facts["crs"], grid, truth.AROUND):
        left, bottom, right, top = _moved(bounds, facts["crs"], grid)
        raise truth.NoOverlap(
            f"truth {path}, layer {name} ({facts['crs']}) lies at {left:.0f} {bottom:.0f} {right:.0f} {top:.0f} in {grid.crs}, "
            "outside the scene: check the layer's CRS and the raster it belongs to"
        )


def _bounds(path: str, layer: str | None, facts: dict[str, Any]) -> tuple[float, ...]:
    """Left, bottom, right, top of a layer in its own CRS: as its header says, else of its shapes."""
    import pyogrio

    bounds = facts.get("total_bounds")
    if bounds is not None and all(map(_finite, bounds)):
        return tuple(bounds)
    boxes = pyogrio.read_bounds(path, layer=layer)[1]
    return (*boxes[:2].min(axis=1), *boxes[2:].max(axis=1))


def _moved(bounds: tuple[float, ...], crs: str, grid: Any) -> tuple[float, ...]:
    """Bounds of a CRS in the grid's."""
    import pyproj

    move = pyproj.Transformer.from_crs(pyproj.CRS.from_user_input(crs).to_2d(), grid.crs, always_xy=True)
    return move.transform_bounds(*bounds)


def _off(bounds: tuple[float, ...], crs: str, grid: Any, around: float) -> bool:
    """Whether all within these bounds lies more than `around` (m) outside the grid."""
    left, bottom, right, top = _moved(bounds, crs, grid)
    beside = left > grid.bounds[2] + around or right < grid.bounds[0] - around
    return beside or bottom > grid.bounds[3] + around or top < grid.bounds[1] - around


def _finite(value: float) -> bool:
    return value == value and abs(value) != float("inf")


def check_sections(path: str, grid: Any) -> None:
    """Look at the header of a layer of edited sections; raises what `edited` raises."""
    import pyogrio

    from kibs_steps import edited

    try:
        layer = edited.layer_of(path)
        facts = pyogrio.read_info(path, layer=layer)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise edited.SectionsUnusable(edited.UNREADABLE.format(path=path, error=error)) from error
    if facts["features"] == 0:
        raise edited.SectionsUnusable(edited.EMPTY_LAYER.format(path=path))
    if facts["crs"] and _off(_bounds(path, layer, facts), facts["crs"], grid, 0.0):
        raise edited.SectionsUnusable(edited.ELSEWHERE.format(path=path, crs=grid.crs.splitlines()[0]))


def check_footprints(path: str) -> None:
    """Look at a footprint layer's header."""
    import pyogrio

    try:
        facts = pyogrio.read_info(path)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise FootprintsUnusable(f"footprints {path} cannot be read ({error}): give a GeoPackage or GeoJSON") from error
    if facts["crs"] is None:
        raise FootprintsUnusable(f"footprints {path} says no CRS: assign one")
    if facts["features"] == 0:
        raise FootprintsUnusable(f"footprints {path} holds no polygons: give a layer of building outlines")
