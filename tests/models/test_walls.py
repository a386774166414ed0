"""Walls and shadows: a house as it must be seen tells its height, whatever the view; lifts go to sections and their corners."""

import numpy as np
import pytest
import toy

from kibs_steps import corners, heightmap, raster, scene, store, view
from kibs_steps.models import contract, walls

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
    alone = told.copy()
    alone[4] = 0  # the sun alone tells nothing
    assert not walls.traits(*house(8.0, 10.5, told), HEIGHTS, alone).along[0, : 2 * walls.SEEN].any()
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
    assert not walls.leads({**terms, "whole": [*terms["whole"][1:], [0.0]]})


def test_sections_are_lifted_and_neighbours_alike():
    """Neighbours err alike: two halves of one roof are lifted alike. How sections are numbered is of no account."""
    told = geometry(180.0, 55.0)
    labels, surface, distribution = house(9.0, 6.5, told)
    halves = np.where(np.arange(SIDE) < 100, labels, 2 * labels)
    terms = {"heights": HEIGHTS, "walls": by_walls()}
    outputs = {"surface": surface, "height": distribution}
    lift, looks = corners.lifts(outputs, halves, told, terms)
    assert lift[1:] == pytest.approx([2.5, 2.5], abs=1.25)
    assert looks[1:] == pytest.approx([20, 20], rel=0.4)  # px of their rims towards the satellite
    again = corners.lifts(outputs, np.where(halves, halves + 70_000, 0).astype(np.uint32), told, terms)
    assert [a.tobytes() for a in again] == [lift.tobytes(), looks.tobytes()]


@pytest.mark.parametrize("rows", [30, 60])
def test_a_roof_cut_by_a_seam_is_lifted_as_a_whole(rows):
    """The upper tile does not see the foot of its wall: it has nearly nothing to say."""
    told = geometry(180.0, 55.0)
    roof, surface, distribution = house(9.0, 6.5, told, size=rows)
    seam = 80 + rows // 2
    upper, lower = (np.zeros((len(heightmap.SUMS), 2)) for _ in range(2))
    for sums, first in ((upper, (seam + 8) // 4 * 4 - 88), (lower, (seam - 8) // 4 * 4)):
        numbers, kinds, heights = (
            a[..., first // k : (first + 88) // k, : 88 // k] for a, k in ((roof, 1), (surface, 2), (distribution, 4))
        )
        seen = walls.traits(numbers, kinds, heights, HEIGHTS, told)
        lift, looks = walls.lifts(numbers, seen, by_walls()), walls.looks(numbers, seen)
        sums[heightmap.LIFT], sums[heightmap.LOOKS] = lift * looks, looks
    assert abs(heightmap.lifts(upper.T)[1] - 2.5) > 1.5
    assert heightmap.lifts((upper + lower).T)[1] == pytest.approx(2.5, abs=1.0)


def test_medians_lie_where_half_of_the_shares_are():
    shares = np.zeros((3, len(walls.OFFSETS)))
    shares[0, 24] = 1
    shares[1, [10, 11]] = 0.5
    shares[2, 20], shares[2, 30] = 0.75, 0.25
    assert walls.medians(shares) == pytest.approx([0.0, -6.75, -2.0 + 0.5 * (0.5 / 0.75) - 0.25])
    shares[2, 20], shares[2, 30] = 0.5, 1.5  # whatever their sum
    assert walls.medians(shares)[2] == pytest.approx(3.0 - 0.25 + 0.5 * (0.5 / 1.5))


def by(metres):
    """Terms that lift by so many metres, whatever is seen."""
    first = np.zeros((5, walls.TRAITS, 2))
    first[2, walls.TRAITS - 2] = 10, -10  # the trait that is the offset itself, in 10 m
    layers = [(first, [-metres, metres]), (np.r_[[[[0], [0]]] * 2, [[[-9], [-9]]], [[[0], [0]]] * 2], [0.0])]
    told = [{"weights": w.reshape(-1, w.shape[2]).tolist(), "bias": bias} for w, bias in layers]
    return {"layers": told, "whole": np.zeros((walls.WHOLE, 2)).tolist(), "bias": [0.0, 0.0]}


@pytest.mark.parametrize(
    ("angles", "lift", "untold"),
    [((181.1, 59.3), 3.0, []), ((181.1, 88.0), 0.0, []), (None, 0.0, []), ((181.1, 59.3), 0.0, ["view"])],
)
def test_the_step_lifts_where_roofs_are_known_to_lean(tmp_path, angles, lift, untold):
    image = toy.paint([(20, 20, 20, 16, 80, (8.0, 8.0, 8.0, 8.0))], toy.TILE, toy.TILE)
    raster.write(tmp_path / "blended.tif", image)
    raster.write(tmp_path / "labels.tif", (image[..., 0] != 90).astype(np.uint32) * 5)
    told = [f"--view-azimuth={angles[0]}", f"--view-elevation={angles[1]}"] if angles else []
    picture = toy.raster(tmp_path / "town.tif", image)
    scene.main(["--name=t", f"--raster={picture}", "--dtm=50", "--gsd=0.38", f"--out={tmp_path / 'scene.json'}", *told])
    model = contract.load(toy.walled_corners_model(tmp_path / "m.onnx", by(3.0), untold=untold), "corners")
    store.write_json(tmp_path / "m.json", {"file": str(model.path), "sha256": model.sha256, "contract": model.contract})
    files = [f"--{key}={tmp_path / f'{key}.tif'}" for key in ("blended", "labels")]
    files += [f"--scene={tmp_path / 'scene.json'}", f"--model={tmp_path / 'm.json'}"]
    out = [f"--out={tmp_path / 'corners.parquet'}", f"--heights={tmp_path / 'heights.parquet'}"]
    corners.main([*files, *out, "--name=r0c0", "--margin=8", "--block=1"])
    assert store.read_table(tmp_path / "corners.parquet")["height"].to_pylist() == [8.0] * 4
    table = store.read_table(tmp_path / "heights.parquet")
    assert table["label"].to_pylist() == [5]
    assert heightmap.lifts(heightmap.column(table["sums"])) == pytest.approx([lift], abs=0.3)


def test_half_of_a_lift_is_that_of_all_that_is_near(monkeypatch):
    labels = np.zeros((40, 40), np.int64)
    labels[4:10, 4:14], labels[11:19, 4:14], labels[4:10, 16:40], labels[20:25, 4:14], labels[25:27, 4:14] = (
        1,
        2,
        3,
        4,
        5,
    )
    assert walls.neighbours(labels).tolist() == [[1, 2], [2, 4], [4, 5]]  # 3 is three px from 1
    assert walls.neighbours(labels.T).tolist() == [[1, 2], [2, 4], [4, 5]]
    seen = walls.Traits(np.arange(1, 5), *np.zeros((2, 4, 1, 1)), np.array([60, 80, 144, 50]), np.zeros((40, 40)))
    monkeypatch.setattr(walls, "likely", lambda seen, terms: None)
    monkeypatch.setattr(walls, "medians", lambda shares: np.array([3.0, -1.0, 5.0, 2.0]))
    together = np.array([(180 - 80) / 140, (180 - 80 + 100) / 190, 5, (100 - 80) / 130])
    expected = np.r_[0, (together + np.array([3, -1, 5, 2])) / 2, 0]
    assert walls.lifts(labels, seen, {}) == pytest.approx(expected)


def town():
    """Four sections to look at, two that share a rim, one at the border, and one too small; what is seen varies all over."""
    rows, cols = np.mgrid[:96, :96]
    labels = np.zeros((96, 96), np.int64)
    labels[20:50, 24:40], labels[20:50, 40:70], labels[60:84, 4:36], labels[80:, 50:80], labels[4:8, 4:9] = (
        1,
        2,
        3,
        4,
        5,
    )
    y, x = rows[::2, ::2], cols[::2, ::2]
    kinds = np.exp([2 * np.sin(0.37 * (k + 1) * y) * np.cos(0.29 * (k + 2) * x) for k in range(walls.KINDS)])
    mean = (2 + 0.2 * cols + 0.05 * rows)[2::4, 2::4]
    share = np.exp(-0.5 * ((EDGES[:-1, None, None] + 0.5 - mean) / 1.5) ** 2)
    return labels, *((a / a.sum(axis=0)).astype(np.float32) for a in (kinds, share))


def test_traits_stay_those_that_models_were_taught(monkeypatch):
    told = geometry(200.0, 50.0, (120.0, 40.0))
    seen = walls.traits(*town(), HEIGHTS, told)
    assert seen.labels.tolist() == [1, 2, 3, 4]
    weights = np.cos(np.arange(len(walls.OFFSETS)) ** 2 / 50)
    assert seen.along @ weights == pytest.approx(ALONG, abs=4e-3)
    assert seen.whole == pytest.approx(WHOLE, abs=1e-3)
    monkeypatch.setattr(walls, "MOST", 50)
    assert walls.traits(*town(), HEIGHTS, told).along == pytest.approx(seen.along, abs=1e-5)


# Of `town`: each trait of each section along the offsets, times a chirp; and each of its own.
ALONG = np.array(
    [
        -0.038, -0.153, -0.037, -0.031, -0.006, 0.484, 0.240, 0.298, 0.063, -0.164, -0.233, -0.239, -0.066, -0.218,
        0.160, 0.134, -0.014, -0.002, -0.025, -6.468, -5.866, -0.403, 1.032, 0.864, 0.997, 0.788, 0.838, 0.609,
        2.306, 0.436, 0.091, 0.679, 0.773, 0.756, 0.581, 0.524, 0.233, 6.454, 0.777, 0.136, -0.025, -6.470,
        -5.866, 0.743, -0.008, -0.030, -0.007, 0.086, -0.045, -0.348, -0.162, -0.101, 0.088, -0.349, -0.384, -0.434,
        -0.432, -0.553, -0.249, -0.150, -0.650, -0.125, -0.030, -6.456, -5.866, -0.540, 0.250, 0.378, 0.470, 0.385,
        0.228, 0.000, 0.000, 0.000, 0.083, 0.773, 0.858, 0.784, 1.524, 0.760, 0.000, 0.520, 0.001, 0.000,
        -0.027, -6.464, -5.866, 1.902,
    ]
).reshape(4, walls.TRAITS)  # fmt: skip
WHOLE = np.array(
    [
        0.235, 2.054, 1.369, 0.015, 0.470, 1.104, 1.754, 1.000, 1.000, 0.360, 1.967, 1.000, 0.475, 0.470,
        1.104, 1.754, 1.000, 1.000, 0.329, 1.985, 0.866, -0.040, 0.470, 1.104, 1.754, 1.000, 1.000, 0.235,
        0.685, 0.730, 0.940, 0.470, 1.104, 1.754, 1.000, 1.000,
    ]
).reshape(4, walls.WHOLE)  # fmt: skip
