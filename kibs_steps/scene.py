"""Scene: the facts about one raster, checked once and written to `scene.json`.

In: a georeferenced raster, a terrain model (file or number), the scene's configuration. Out: `scene.json` (this module's
`Scene`) and `dtm.tif`, the terrain in the scene's CRS in metres without holes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from kibs_steps import store, terrain
from kibs_steps.grid import Grid
from kibs_steps.view import Surface


class Direction(NamedTuple):
    """A direction to the satellite or the sun: azimuth and elevation (deg), and its lean (m/m, grid axes east, north)."""

    azimuth: float
    elevation: float
    lean: tuple[float, float]


class Scene(NamedTuple):
    """What every later step needs to know; `view` and `sun` are None when unknown."""

    name: str
    raster: str
    bands: tuple[int, int, int]
    stretch: tuple[tuple[float, float], ...] | None
    grid: Grid
    view: Direction | None
    sun: Direction | None
    projection_height: float | None
    folder: Path

    @property
    def lean(self) -> tuple[float, float]:
        """Lean of the view, m per m of height; (0, 0) when the view is unknown: nothing is moved then."""
        return self.view.lean if self.view else (0.0, 0.0)

    def terrain(self, bounds: tuple[float, float, float, float], margin: float = 200.0) -> terrain.Terrain:
        """The DTM around `bounds` (left, bottom, right, top, map metres)."""
        return terrain.read(self.folder / "dtm.tif", bounds, margin)

    def projected_on(self, dtm: Surface) -> Surface:
        """The surface the image was projected on: the DTM, or the constant `projection_height`."""
        return dtm if self.projection_height is None else terrain.flat(self.projection_height)


def read(path: str | Path) -> Scene:
    """Read `scene.json`."""
    content = store.read_json(path)

    def direction(key: str) -> Direction | None:
        d = content[key]
        return d and Direction(d["azimuth"], d["elevation"], tuple(d["lean"]))

    return Scene(
        name=content["name"],
        raster=content["raster"],
        bands=tuple(content["bands"]),
        stretch=content["stretch"] and tuple(map(tuple, content["stretch"])),
        grid=Grid(**content["grid"]),
        view=direction("view"),
        sun=direction("sun"),
        projection_height=content["projection_height"],
        folder=Path(path).parent,
    )
