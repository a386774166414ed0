"""Truth in, truth out: sections fed with exact corners come back where they stand, on flat ground and on slopes."""

import numpy as np
import pyarrow as pa
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from kibs_steps import ground, heightmap, planes, scene, view
from kibs_steps.grid import Grid
from kibs_steps.terrain import Terrain

GRID = Grid("EPSG:32631", 500_000.0, 5_400_000.0, 0.38, 400, 400)


def sloping(east, north):
    """A terrain plane, gradients per metre, 120 m at the scene's corner."""
    step, n = 4.0, 200
    x0, y0 = GRID.x0 - 300.0, GRID.y0 + 300.0
    col, row = np.meshgrid(np.arange(n), np.arange(n))
    return Terrain(120.0 + east * (col * step - 300.0) + north * (300.0 - row * step), x0, y0, (step, step))


def facts_at(azimuth, elevation, height=None):
    direction = scene.Direction(azimuth, elevation, view.lean(azimuth, elevation))
    return scene.Scene("s", "r.tif", (1, 2, 3), None, GRID, direction, None, height, None)


def house(dtm, angle, eave, rise):
    """A gable house on its lowest ground: two PolygonZ in the map frame, exact planes."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([GRID.x0 + 76.0, GRID.y0 - 76.0])
    base = float(dtm(centre[None])[0])
    sections = []
    for sign in (1, -1):
        local = np.array([[-6, 0], [6, 0], [6, 4 * sign], [-6, 4 * sign]], float)
        z = base + np.array([eave + rise, eave + rise, eave, eave])
        sections.append(np.column_stack([local @ turn.T + centre, z]))
    return sections


def fed(rings, facts, dtm):
    """Stitched tables as `feed` and `stitch` would make them of exact truth."""
    base = facts.projected_on(dtm)
    outlines, rows = [], []
    for owner, ring in enumerate(rings, start=1):
        pixel = GRID.to_image(view.image_position(ring[:, :2], ring[:, 2], facts.lean, base))
        outlines.append(shapely.Polygon(pixel))
        height = ring[:, 2] - dtm(ring[:, :2])
        rows += [(c, r, h, 0.01, 1.0, owner) for (c, r), h in zip(pixel, height, strict=True)]
    n = len(rings)
    sections = pa.table(
        {
            "section_id": np.arange(1, n + 1),
            "outline": shapely.to_wkb(np.array(outlines)),
            "score": np.ones(n),
            "split": np.full(n, 2),
            "edge": np.zeros(n, bool),
            "void": np.zeros(n, bool),
            "owner": np.arange(1, n + 1),
            "sums": pa.array([heightmap.EMPTY] * n, heightmap.HEIGHTS.field("sums").type),
        }
    )
    columns = dict(
        zip(("col", "row", "height", "sigma", "score", "owner"), map(np.array, zip(*rows, strict=True)), strict=True)
    )
    return sections, pa.table(columns)


@given(
    azimuth=st.floats(0, 360),
    elevation=st.floats(45, 90),
    angle=st.floats(0, 3.2),
    eave=st.floats(2.5, 20),
    rise=st.floats(0.0, 4.0),
    slope=st.sampled_from([(0.0, 0.0), (0.15, 0.0), (0.0, -0.15), (0.1, 0.1)]),
    height=st.sampled_from([None, 0.0, 150.0]),
)
def test_truth_in_truth_out(azimuth, elevation, angle, eave, rise, slope, height):
    """Vertices within 0.05 m of where they stand, 0.1 px of where they are seen; planes and heights exact to 0.05 m."""
    dtm, facts = sloping(*slope), facts_at(azimuth, elevation, height)
    rings = house(dtm, angle, eave, rise)
    table, _ = planes.planes(*fed(rings, facts, dtm), facts, dtm, (6.0, 3.0), 7.5, "robust")
    result = ground.ground(table, facts, dtm)
    for i, ring in enumerate(rings):
        outline = shapely.from_wkb(result["outline_map"][i].as_py())
        found = shapely.get_coordinates(outline, include_z=True)[:-1]
        np.testing.assert_allclose(found, ring, atol=0.05)
        seen = shapely.get_coordinates(shapely.from_wkb(result["outline_seen"][i].as_py()), include_z=True)[:-1]
        expected = view.image_position(ring[:, :2], ring[:, 2], facts.lean, facts.projected_on(dtm))
        np.testing.assert_allclose(seen[:, :2], expected, atol=0.1 * GRID.gsd)
        np.testing.assert_allclose(seen[:, 2], ring[:, 2] - dtm(ring[:, :2]), atol=0.05)
        assert result["slope"][i].as_py() == pytest.approx(np.degrees(np.arctan(rise / 4)), abs=0.5)
        assert result["area"][i].as_py() == pytest.approx(48.0, abs=0.5)


def test_a_section_stands_as_much_higher_as_its_walls_say():
    """Corners and height map 2 m too low, its pieces lifted by 1 m in a look and by 2.25 in four: it stands where it stands."""
    dtm, facts = sloping(0.1, 0.0), facts_at(200.0, 60.0)
    ring = house(dtm, 0.3, 9.0, 0.0)[0]
    ring[:, 2] = dtm(ring[:, :2]) + 9.0
    sections, corners = fed([ring], facts, dtm)
    (col, row), n = np.mean([corners["col"], corners["row"]], axis=1), 50.0
    squares = (col**2 + 25, col * row, row**2 + 25)
    cells = n * np.array([1, col, row, 7.0, *squares, 7 * col, 7 * row, 0.5])
    sums = [[*cells, 1 * 1.0 + 4 * 2.25, 5.0]]
    sections = sections.set_column(7, "sums", pa.array(sums, heightmap.HEIGHTS.field("sums").type))
    low = pa.array(corners["height"].to_numpy() - 2.0)
    corners = corners.set_column(corners.column_names.index("height"), "height", low)
    table, filed = planes.planes(sections, corners, facts, dtm, (6.0, 3.0), 7.5, "robust")
    np.testing.assert_allclose(filed["height"].to_numpy(), 9.0, atol=1e-9)
    found = shapely.get_coordinates(
        shapely.from_wkb(ground.ground(table, facts, dtm)["outline_map"][0].as_py()), include_z=True
    )
    np.testing.assert_allclose(found[:-1], ring, atol=0.05)


def test_unknown_view_moves_nothing():
    """Without angles outlines stay where they are seen."""
    dtm = sloping(0.0, 0.0)
    facts = facts_at(181.0, 60.0)._replace(view=None)
    rings = house(dtm, 0.3, 5.0, 2.0)
    table, _ = planes.planes(*fed(rings, facts, dtm), facts, dtm, (6.0, 3.0), 7.5, "robust")
    result = ground.ground(table, facts, dtm)
    found = shapely.get_coordinates(shapely.from_wkb(result["outline_map"][0].as_py()))[:-1]
    np.testing.assert_allclose(found, rings[0][:, :2], atol=1e-6)


def test_fitting_in_the_image_would_shear_the_roof():
    """The reason for the map frame (PAPER): a 40° slope facing the satellite at 59.3° looks 29° steep, away 59°."""
    k = 1 / np.tan(np.radians(59.3))
    rise = np.tan(np.radians(40.0))
    assert np.degrees(np.arctan(rise / (1 + rise * k))) == pytest.approx(29.2, abs=0.5)
    assert np.degrees(np.arctan(rise / (1 - rise * k))) == pytest.approx(59.1, abs=0.5)


@given(st.floats(0, 359.9), st.floats(4, 60), st.floats(-3, 3))
def test_azimuth_is_the_downslope_from_true_north(azimuth, slope, convergence):
    steep = np.tan(np.radians(slope))
    grid_azimuth = np.radians(azimuth - convergence)
    a, b = -steep * np.sin(grid_azimuth), -steep * np.cos(grid_azimuth)
    found_slope, found = ground.slope_azimuth(np.array([a]), np.array([b]), convergence)
    assert found_slope[0] == pytest.approx(slope)
    assert (found[0] - azimuth + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)


def test_level_sections_have_no_azimuth():
    assert np.isnan(ground.slope_azimuth(np.array([0.03]), np.array([0.03]), 0.0)[1][0])


def regions_of(*views):
    """Regions side by side from west to east, each with a view (azimuth, elevation)."""
    edges = np.linspace(GRID.bounds[0], GRID.bounds[2], len(views) + 1)
    boxes = [shapely.box(edges[k], GRID.bounds[1], edges[k + 1], GRID.bounds[3]) for k in range(len(views))]
    return tuple(scene.Region(box, scene.Direction(*v, view.lean(*v))) for box, v in zip(boxes, views, strict=True))


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.15, -0.05)])
def test_a_region_moves_its_sections_by_its_own_view(slope):
    """A mosaic whose middle was seen from the west: the house there comes back as if all had been."""
    dtm, own = sloping(*slope), facts_at(270.0, 65.0)
    rings = house(dtm, 0.4, 6.0, 2.0)
    tables = fed(rings, own, dtm)
    mosaic = facts_at(180.0, 75.0)._replace(regions=regions_of((90.0, 80.0), (270.0, 65.0), (0.0, 60.0)))
    results = []
    for facts in (own, mosaic):
        table, filed = planes.planes(*tables, facts, dtm, (6.0, 3.0), 7.5, "robust")
        results.append((ground.ground(table, facts, dtm), filed))
    assert results[0][0].equals(results[1][0])
    assert results[0][1].equals(results[1][1])
    found = shapely.get_coordinates(shapely.from_wkb(results[1][0]["outline_map"][0].as_py()), include_z=True)[:-1]
    np.testing.assert_allclose(found, rings[0], atol=0.05)


def test_outside_its_regions_a_mosaic_without_a_view_moves_nothing():
    dtm = sloping(0.0, 0.0)
    facts = facts_at(180.0, 60.0)._replace(view=None, regions=regions_of((90.0, 60.0), (90.0, 60.0), (90.0, 60.0))[:1])
    rings = house(dtm, 0.3, 5.0, 2.0)
    table, _ = planes.planes(*fed(rings, facts._replace(regions=()), dtm), facts, dtm, (6.0, 3.0), 7.5, "robust")
    result = ground.ground(table, facts, dtm)
    found = shapely.get_coordinates(shapely.from_wkb(result["outline_map"][0].as_py()))[:-1]
    np.testing.assert_allclose(found, rings[0][:, :2], atol=1e-6)
    assert result["sigma_along"].to_pylist() == [None, None]


def test_sigma_of_position_is_what_shaken_angles_and_heights_give():
    """Closed form against 20,000 draws of height, elevation and azimuth."""
    rng = np.random.default_rng(3)
    n, h, sigma_h, elevation, angle = 20_000, 9.0, 0.8, 62.0, 0.6
    el = np.radians(elevation + rng.normal(0, angle, n))
    az = np.radians(rng.normal(0, angle, n))
    length = (h + rng.normal(0, sigma_h, n)) / np.tan(el)
    along, across = view.position_sigma(np.array([h]), np.array([sigma_h]), np.array([elevation]), angle)
    assert along[0] == pytest.approx(np.std(length * np.cos(az)), rel=0.03)
    assert across[0] == pytest.approx(np.std(length * np.sin(az)), rel=0.03)
