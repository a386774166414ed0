"""Walls and shadows: a house as it must be seen tells its height, whatever the view; lifts go to sections and their corners."""

import numpy as np
import pytest
import toy

from kibs_steps import corners, raster, scene, store, view
from kibs_steps.models import contract, heads, walls

SIDE, GSD = 192, 0.38
EDGES = np.arange(0.0, 31.0)
HEIGHTS = {"edges": EDGES.tolist(), "centres": (EDGES[:-1] + 0.5).tolist(), "fallback": 6.0}


def geometry(azimuth, elevation, sun=None):
    """What networks are told (6,)."""
    told = np.zeros(6, np.float32)
    for k, direction in enumerate(((azimuth, elevation), sun)):
        if direction:
            east, north = view.lean(*direction)
            told[2 * k : 2 * k + 2], told[4 + k] = (-east / GSD, north / GSD), 1
    return told


def house(true, told_height, told, size=40, at=(80, 80)):
    """A flat roof of `true` m over its own walls on level ground, shade behind it: labels, surface, distribution. The height map
    says `told_height` m."""
    rows, cols = np.mgrid[:SIDE, :SIDE]

    def block(dx, dy):
        return (cols >= at[0] + dx) & (cols < at[0] + size + dx) & (rows >= at[1] + dy) & (rows < at[1] + size + dy)

    roof = block(0, 0)
    surface = np.zeros((walls.KINDS, SIDE, SIDE), np.float32)
    surface[walls.GROUND] = 1
    steps = np.arange(0, true + 0.01, 0.05)
    for kind, (dx, dy) in ((walls.SHADE, told[2:4] - told[:2]), (walls.WALL, -told[:2])):
        if kind == walls.SHADE and not told[5]:
            continue
        for metres in steps:
            covered = block(*np.rint([dx * metres, dy * metres]).astype(int))
            surface[:, covered] = 0
            surface[kind, covered] = 1
    surface[:, roof] = 0
    surface[walls.ROOF, roof] = 1
    distribution = np.zeros((len(EDGES) - 1, SIDE // 4, SIDE // 4), np.float32)
    distribution[int(told_height)] = 1
    return roof.astype(np.int32), surface[:, ::2, ::2].copy(), distribution


def ends(seen):
    """The offset (m) at which most walls end on the ground, and most shadows."""
    sides = (seen.along[0, k * walls.SEEN + walls.KINDS + 2] for k in (0, 1))
    return [float(walls.OFFSETS[np.argmax(np.convolve(side, np.ones(3), "same"))]) for side in sides]


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 181.1, 250.0])
@pytest.mark.parametrize(("true", "told"), [(9.0, 6.5), (6.0, 9.5), (15.0, 12.5)])
def test_walls_end_where_the_height_says(azimuth, true, told):
    told_geometry = geometry(azimuth, 55.0)
    seen = walls.traits(*house(true, told, told_geometry), HEIGHTS, told_geometry)
    assert seen.labels.tolist() == [1]
    assert ends(seen)[0] == pytest.approx(true - told, abs=1.0)
    middle = seen.height[100, 100]
    assert middle == pytest.approx(np.floor(told) + 0.5, abs=1e-4)


def test_shadows_end_where_the_height_says():
    told = geometry(180.0, 55.0, (150.0, 45.0))
    seen = walls.traits(*house(8.0, 10.5, told), HEIGHTS, told)
    assert ends(seen)[1] == pytest.approx(8.0 - 10.5, abs=1.0)
    unlit = geometry(180.0, 55.0)
    assert not walls.traits(*house(8.0, 10.5, unlit), HEIGHTS, unlit).along[0, walls.SEEN : 2 * walls.SEEN].any()


def test_a_turned_tile_has_the_same_traits():
    told = geometry(200.0, 55.0, (150.0, 45.0))
    labels, surface, distribution = house(9.0, 7.5, told, at=(70, 90))
    seen = walls.traits(labels, surface, distribution, HEIGHTS, told)
    turned = told.copy()
    turned[:4] = np.stack([told[[1, 3]], -told[[0, 2]]], axis=1).ravel()  # a quarter turn counter-clockwise
    about = [np.ascontiguousarray(np.rot90(a, axes=(-2, -1))) for a in (labels, surface, distribution)]
    other = walls.traits(*about, HEIGHTS, turned)
    assert np.abs(other.along - seen.along).max() < 0.08
    assert np.abs(other.whole - seen.whole).max() < 0.05


def test_nothing_is_seen_from_straight_above_and_of_small_sections():
    told = geometry(0.0, 90.0)
    labels, surface, distribution = house(9.0, 7.5, told)
    seen = walls.traits(labels, surface, distribution, HEIGHTS, told)
    assert not seen.along[:, : 2 * walls.SEEN].any()
    small = np.zeros_like(labels)
    small[10:13, 10:15] = 1
    assert not len(walls.traits(small, surface, distribution, HEIGHTS, told).labels)
    terms = by_walls()
    assert walls.lifts(small, walls.traits(small, surface, distribution, HEIGHTS, told), terms).tolist() == [0, 0]


def by_walls(strength=60.0):
    """Terms that lift to where most walls end on the ground."""
    first = np.zeros((5, walls.TRAITS, 2))
    first[1:4, walls.KINDS + 2, 0] = 1
    last = np.zeros((5, 2, 1))
    last[2, 0] = strength
    layers = [{"weights": w.reshape(-1, w.shape[2]).tolist(), "bias": [0.0] * w.shape[2]} for w in (first, last)]
    return {"layers": layers, "whole": np.zeros((walls.WHOLE, 2)).tolist(), "bias": [0.0, 0.0]}


def test_terms_lead_from_the_traits_to_one_number():
    terms = by_walls()
    assert walls.leads(terms)
    assert not walls.leads({**terms, "bias": [0.0]})
    assert not walls.leads({**terms, "layers": terms["layers"][:1]})


def test_a_section_is_lifted_and_its_corners_and_neighbours_with_it():
    """Neighbours err alike: two halves of one roof are lifted alike."""
    told = geometry(180.0, 55.0)
    labels, surface, distribution = house(9.0, 6.5, told)
    terms = {"heights": HEIGHTS, "walls": by_walls()}
    outputs = {"surface": surface, "height": distribution}
    shown = np.full((48, 48), 6.5), np.ones((48, 48))
    found = heads.Corners(np.array([80.4, 20.0]), np.array([80.4, 20.0]), np.array([6.5, 3.0]), np.ones(2), np.ones(2))
    moved, (mean, sigma) = corners.lifted(found, shown, outputs, 7 * labels, told, terms)
    assert mean[25, 25] == pytest.approx(9.0, abs=1.25)
    assert mean[0, 0] == 6.5
    assert moved.height[0] == pytest.approx(mean[25, 25])
    assert moved.height[1] == 3.0
    assert (sigma == 1).all()
    halves = np.where(np.arange(SIDE) < 100, labels, 2 * labels)
    lift = walls.lifts(halves, walls.traits(halves, surface, distribution, HEIGHTS, told), by_walls())
    assert lift[1:] == pytest.approx([2.5, 2.5], abs=1.25)


def test_medians_lie_where_half_of_the_shares_are():
    shares = np.zeros((3, len(walls.OFFSETS)))
    shares[0, 24] = 1
    shares[1, [10, 11]] = 0.5
    shares[2, 20], shares[2, 30] = 0.75, 0.25
    assert walls.medians(shares) == pytest.approx([0.0, -6.75, -2.0 + 0.5 * (0.5 / 0.75) - 0.25])


def by(metres):
    """Terms that lift by so many metres, whatever is seen."""
    first = np.zeros((5, walls.TRAITS, 2))
    first[2, walls.TRAITS - 2] = 10, -10  # the trait that is the offset itself, in 10 m
    layers = [(first, [-metres, metres]), (np.r_[[[[0], [0]]] * 2, [[[-9], [-9]]], [[[0], [0]]] * 2], [0.0])]
    told = [{"weights": w.reshape(-1, w.shape[2]).tolist(), "bias": bias} for w, bias in layers]
    return {"layers": told, "whole": np.zeros((walls.WHOLE, 2)).tolist(), "bias": [0.0, 0.0]}


@pytest.mark.parametrize(("angles", "lift"), [((181.1, 59.3), 3.0), ((181.1, 88.0), 0.0), (None, 0.0)])
def test_the_step_lifts_where_roofs_are_known_to_lean(tmp_path, angles, lift):
    image = toy.paint([(20, 20, 20, 16, 80, (8.0, 8.0, 8.0, 8.0))], toy.TILE, toy.TILE)
    raster.write(tmp_path / "blended.tif", image)
    raster.write(tmp_path / "labels.tif", (image[..., 0] != 90).astype(np.uint32) * 5)
    told = [f"--view-azimuth={angles[0]}", f"--view-elevation={angles[1]}"] if angles else []
    picture = toy.raster(tmp_path / "town.tif", image)
    scene.main(["--name=t", f"--raster={picture}", "--dtm=50", "--gsd=0.38", f"--out={tmp_path / 'scene.json'}", *told])
    heights = {}
    for name, terms in (("plain", by(0.0)), ("lifted", by(3.0))):
        model = contract.load(toy.walled_corners_model(tmp_path / f"{name}.onnx", terms), "corners")
        record = {"file": str(model.path), "sha256": model.sha256, "contract": model.contract}
        store.write_json(tmp_path / f"{name}.json", record)
        files = [f"--{key}={tmp_path / f'{key}.tif'}" for key in ("blended", "labels")]
        files += [f"--scene={tmp_path / 'scene.json'}", f"--model={tmp_path / f'{name}.json'}"]
        out = [f"--out={tmp_path / f'{name}.parquet'}", f"--heights={tmp_path / f'{name}_heights.parquet'}"]
        corners.main([*files, *out, "--name=r0c0", "--margin=8", "--block=1"])
        heights[name] = store.read_table(tmp_path / f"{name}.parquet")["height"].to_numpy()
    assert len(heights["plain"]) == 4
    assert heights["lifted"] - heights["plain"] == pytest.approx([lift] * 4, abs=0.3)
