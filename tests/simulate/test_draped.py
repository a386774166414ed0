"""Photographed roofs in 3D: planar faces, one eave, the photograph on the right side of the house."""

import os
from pathlib import Path

import numpy as np
import pytest

from kibs_steps import terrain as dtm
from kibs_steps.grid import Grid
from kibs_steps.photographs import GRAPH_GSD, REDUCED, NoTrainingData, RoofGraph, read_roof_graphs
from kibs_steps.simulate import draped, scene
from kibs_steps.simulate.camera import Camera
from kibs_steps.simulate.pieces import ROOF, City, Paint, Place
from kibs_steps.simulate.rendering import render
from kibs_steps.simulate.site import Site
from kibs_steps.simulate.surfaces import palette
from kibs_steps.zbuffer import planes

PLAIN = Camera(0.4, (0, 0, 0), 0.0, 0.0, (0.0, 0.0), 0.0, 1.0, 0.0, 0.0, 1.0, (1, 1, 1), 1.0, 0)
# A hip roof in a photograph of 80 x 60 px: four eave corners, two ridge ends 12 px inside.
VERTICES = np.array([[10, 10], [70, 10], [70, 50], [10, 50], [30, 30], [50, 30]], float)
FACES = [np.array(f) for f in ([0, 1, 5, 4], [1, 2, 5], [2, 3, 4, 5], [3, 0, 4])]
NOMINAL = np.array([75, 75, 75, 75, 145, 145], float)


def photograph():
    """Red where the photograph is left, blue where it is right."""
    rgb = np.full((60, 80, 3), 60, np.uint8)
    rgb[:, :40, 0] = 220
    rgb[:, 40:, 2] = 220
    return rgb


GRAPH = RoofGraph("a_1", photograph(), VERTICES, FACES)


def site():
    return Site(np.random.default_rng(0), dtm.flat(0.0), palette(np.random.default_rng(0)), (0, 0, 60, 60), 0.0)


def off_plane(rings):
    plane = planes([type("Face", (), {"ring": r})() for r in rings])
    return max(
        np.abs((r - p) @ n).max() for r, p, n in zip(rings, plane.point, plane.normal, strict=True)
    )  # fmt: skip


def test_a_hip_roof_is_lifted_with_planar_faces():
    house = draped.lift(GRAPH, NOMINAL)
    assert len(house.rings) == 4
    assert off_plane(house.rings) < 1e-9
    metres = GRAPH_GSD * REDUCED
    assert np.allclose(house.size, [60 * metres, 40 * metres])
    points = np.unique(np.round(np.concatenate(house.rings), 9), axis=0)
    assert sorted(points[:, 2].tolist()) == pytest.approx([0, 0, 0, 0, 70 * GRAPH_GSD, 70 * GRAPH_GSD])


def test_roofs_that_are_not_planar_are_left_out():
    bent = NOMINAL.copy()
    bent[4] += 8
    assert draped.lift(GRAPH, bent) is None
    assert draped.lift(GRAPH, np.full(6, 75.0)) is None  # no slope: nothing to scale
    assert draped.lift(GRAPH, NOMINAL[:5]) is None


@pytest.mark.parametrize("seed", range(6))
def test_standing_houses_are_planar_with_one_eave_and_closed(seed):
    where = site()
    where.rng = np.random.default_rng(seed)
    assert draped.stand(where, Place(30, 30, 0.7), draped.lift(GRAPH, NOMINAL)) == 1
    rings = [f.ring for f in where.faces if f.kind == ROOF]
    assert off_plane(rings) < 0.01
    heights = np.unique(np.round(np.concatenate(rings)[:, 2], 6))
    assert len(heights) == 2
    assert heights[0] > 2
    assert all(planes([f]).normal[0, 2] > 0 for f in where.faces if f.kind == ROOF)
    assert not draped.stand(where, Place(31, 30, 0.1), draped.lift(GRAPH, NOMINAL))  # there is one already


@pytest.mark.parametrize(("seed", "angle"), [(0, 0.0), (1, 0.9), (2, 2.5), (3, 4.0)])
def test_the_photograph_lies_on_its_own_side(seed, angle):
    where = site()
    where.rng = np.random.default_rng(seed)
    draped.stand(where, Place(30, 30, angle), draped.lift(GRAPH, NOMINAL))
    ground = [Paint(np.array([[-99.0, -99.0], [199, -99], [199, 199], [-99, 199]]), where.kit.uses["asphalt"][0])]
    city = City(where.faces, ground, where.kit.materials, where.photographs)
    up, sun = scene._direction(0, 89.9), scene._direction(180, 70)
    grid = Grid("", 15, 45, 0.2, 150, 150)
    picture = render(city, dtm.flat(0.0), grid, up, sun, np.random.default_rng(0), look=PLAIN)
    rows, cols = np.nonzero(picture.section > 0)
    x_y = grid.to_map(np.stack([cols + 0.5, rows + 0.5], -1)) - 30
    # In the house's own frame x is left of the photograph where it is negative, unless the house is mirrored.
    along = x_y @ [np.cos(angle), np.sin(angle)]
    red = picture.rgb[rows, cols, 0].astype(int) > picture.rgb[rows, cols, 2]
    mirrored = where.photographs[0].onto[:, :2] @ [np.cos(angle), np.sin(angle)]
    left = along * np.sign(mirrored[0]) < 0
    clear = np.abs(along) > 0.6
    assert (red == left)[clear].mean() > 0.98


def test_missing_data_is_named(tmp_path):
    with pytest.raises(NoTrainingData, match="polyshape"):
        draped.read_heights(tmp_path / "none.tar")


@pytest.mark.long
@pytest.mark.skipif("KIBS_DATA" not in os.environ, reason="no real data: KIBS_DATA is not set")
def test_nearly_all_real_roofs_can_be_lifted():
    source = Path(os.environ["KIBS_DATA"]) / "roofgraph/roofgraph.tar"
    graphs = read_roof_graphs(source)
    found = draped.houses(graphs, draped.read_heights(source))
    assert len(found) > 0.95 * len(graphs)
    assert max(off_plane(h.rings) for h in found) < 0.01
