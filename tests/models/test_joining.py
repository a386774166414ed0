"""Basins join by what lies between them: sums against counting, what adds up, what does not depend on numbers or directions."""

import itertools

import numpy as np
import pytest
import toy
from hypothesis import given, settings
from hypothesis import strategies as st

from kibs_steps.models import contract as contracts
from kibs_steps.models import heads, joining, regions, runtime

SIDE = 20


def patches(seed, most=9):
    """Random rectangular basins 1…n over a part of a tile, with an image and maps: basins, rgb, maps, level."""
    rng = np.random.default_rng(seed)
    basins = np.zeros((SIDE, SIDE), int)
    for label in range(1, most):
        row, col = rng.integers(0, SIDE - 3, 2)
        basins[row : row + rng.integers(2, 9), col : col + rng.integers(2, 9)] = label
    basins = heads.relabelled(basins)
    rgb = rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    roof, edge, slope, centre = (rng.random((n, SIDE, SIDE)).astype(np.float32) for n in (1, 1, 2, 2))
    maps = {"roof": roof, "edge": edge, "slope": slope - 0.5, "centre": 8 * centre - 4}
    return basins, rgb, maps, rng.random((SIDE, SIDE)).astype(np.float32)


def flat(side):
    """Maps of nothing: sides (rows, cols)."""
    return {name: np.zeros((n, *side)) for name, n in (("roof", 1), ("edge", 1), ("slope", 2), ("centre", 2))}


def policy(**weights):
    """The contract's `join` whose logit is a weighted sum of some traits and a bias."""
    bias = weights.pop("bias", 0.0)
    column = [[float(weights.get(name.replace(" ", "_"), 0.0))] for name in joining.TRAITS]
    n = len(joining.TRAITS)
    return {"mean": [0.0] * n, "spread": [1.0] * n, "layers": [{"weights": column, "bias": [bias]}], "least": 0.5}


def test_sums_are_what_counting_finds():
    basins, rgb, maps, level = patches(1)
    found = joining.graph(basins, rgb, maps, level)
    roof, edge, slope, centre = maps["roof"][0], maps["edge"][0], maps["slope"], maps["centre"]
    for label in range(1, basins.max() + 1):
        row, col = np.nonzero(basins == label)
        colour = rgb[row, col] / 255
        bright = colour.mean(1)
        places = (col.sum(), row.sum(), (col * col).sum(), (col * row).sum(), (row * row).sum())
        values = [*colour.sum(0), (bright**2).sum(), roof[row, col].sum(), edge[row, col].sum()]
        tilt = slope[:, row, col].astype(float)
        aim = np.stack([col, row]) + centre[:, row, col].astype(float)
        values += [*tilt.sum(1), (tilt**2).sum(), *aim.sum(1), (aim**2).sum(), level[row, col].max()]
        np.testing.assert_allclose(found.basins[label - 1], (len(row), *places, *values), rtol=1e-6)
    rims = {}
    for row, col in itertools.product(range(SIDE), range(SIDE)):
        for there in ((row + 1, col), (row, col + 1)):
            if max(there) < SIDE and 0 < basins[row, col] != basins[there] > 0:
                pair = tuple(sorted((basins[row, col] - 1, basins[there] - 1)))
                x, y = (col + there[1]) / 2, (row + there[0]) / 2
                height = min(level[row, col], level[there])
                contrast = abs(rgb[row, col].mean() - rgb[there].mean()) / 255
                shown = (1, x, y, x * x, x * y, y * y, max(edge[row, col], edge[there]), height, contrast)
                rims.setdefault(pair, []).append((*shown, height))
    assert list(map(tuple, found.pairs)) == sorted(rims)
    for pair, sums in zip(found.pairs, found.rims, strict=True):
        parts = np.array(rims[tuple(pair)])
        np.testing.assert_allclose(sums, (*parts[:, :-1].sum(0), parts[:, -1].max()), rtol=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_sums_of_what_has_joined_are_those_of_one_basin(seed, left):
    basins, *shown = patches(seed)
    number = np.random.default_rng(seed).integers(0, left, basins.max())
    number = np.unique(number, return_inverse=True)[1]
    once = joining.graph(np.append(0, number + 1)[basins], *shown)
    steps = joining.merged(joining.graph(basins, *shown), number)
    np.testing.assert_array_equal(once.pairs, steps.pairs)
    np.testing.assert_allclose(once.basins, steps.basins, rtol=1e-9)
    np.testing.assert_allclose(once.rims, steps.rims, rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 3), st.booleans())
def test_neither_numbers_nor_directions_count(seed, turns, mirrored):
    """Turned, mirrored and with other labels, a tile falls into the same sections."""
    basins, rgb, maps, level = patches(seed)
    join = policy(
        rim_edge=-4.0,
        brightness_apart=-5.0,
        slope_apart=-2.0,
        aims_apart=-2.0,
        aim_off_together=-1.0,
        fill_together=3.0,
        rim_bend=-0.5,
        bias=1.0,
    )
    found = joining.sections(basins, rgb, maps, level, join)

    def moved(image):
        return np.ascontiguousarray(np.rot90(image[:, ::-1] if mirrored else image, turns))

    labels = np.append(0, 1 + np.random.default_rng(seed).permutation(basins.max()))
    turned = {name: np.stack([moved(channel) for channel in values]) for name, values in maps.items()}
    for name in runtime.DIRECTED[1:]:
        if mirrored:
            turned[name][0] *= -1
        for _ in range(turns):  # counter-clockwise: what led east leads north
            turned[name] = np.stack([turned[name][1], -turned[name][0]])
    again = joining.sections(moved(labels[basins]), moved(rgb), turned, moved(level), join)
    np.testing.assert_array_equal(heads.relabelled(moved(found)), heads.relabelled(again))


def test_shapes_in_closed_form():
    tile = np.zeros((40, 60), int)
    tile[4:14, 5:45], tile[14:34, 5:45] = 1, 2
    rgb, maps = np.zeros((40, 60, 3), np.uint8), flat(tile.shape)
    rgb[tile == 1] = 51
    maps["slope"][0][tile == 1], maps["slope"][1][tile == 2] = 0.3, 0.4
    maps["slope"][1, 14:34, 5:45:2] += 0.2  # uneven: 0.4 and 0.6, a standard deviation of 0.1
    maps["centre"] = np.stack([24.5 - np.mgrid[:40, :60][1], 19.5 - np.mgrid[:40, :60][0]])  # all see one middle
    found = joining.graph(tile, rgb, maps, np.zeros(tile.shape))
    long, short = regions.spread(found.basins)
    np.testing.assert_allclose(long, 40 / np.sqrt(12))
    np.testing.assert_allclose(short, np.array([10, 20]) / np.sqrt(12))
    np.testing.assert_allclose(regions.fill(found.basins), 3 / np.pi)
    shown = dict(zip(joining.TRAITS, joining.traits(found)[0], strict=True))
    assert shown["brightness apart"] == pytest.approx(0.2)
    assert shown["colour apart"] == pytest.approx(0, abs=1e-9)
    assert shown["slope apart"] == pytest.approx(np.hypot(0.3, 0.5))
    assert shown["slope told apart"] == pytest.approx(np.hypot(0.3, 0.5) / np.sqrt(0.01 + 1e-4))
    assert (shown["slope least"], shown["slope most"]) == pytest.approx((0.3, 0.5))
    assert shown["aims apart"] == pytest.approx(0, abs=1e-9)
    # The rows lie from 4 to 13 and from 14 to 33: 8.5, 23.5, and 18.5 for both.
    assert shown["aim off least"] == pytest.approx(4 / np.sqrt(800))
    assert shown["aim off most"] == pytest.approx(11 / np.sqrt(400))
    assert shown["aim off together"] == pytest.approx(1 / np.sqrt(1200))
    assert shown["rim share"] == pytest.approx(np.log(40 / np.sqrt(400)))
    assert shown["rim bend"] == pytest.approx(1 / 40)  # a straight rim is as wide as a pixel
    assert shown["fill together"] == pytest.approx(3 / np.pi)


def test_what_is_likely_joins_step_by_step_and_no_more():
    """Four strips in a row; a rim between the second and the third. The policy sees the rim alone."""
    basins = np.repeat([[1, 1, 1, 2, 2, 3, 3, 4, 4, 4]], 6, axis=0)
    maps, level = flat(basins.shape), np.zeros(basins.shape)
    maps["edge"][0, :, 4:6] = 1
    rgb = np.zeros((*basins.shape, 3), np.uint8)
    found = joining.sections(basins, rgb, maps, level, policy(rim_edge=-4.0, bias=1.0))
    assert len(np.unique(found)) == 2
    assert (found[:, :5] == found[0, 0]).all()
    assert (found[:, 5:] == found[0, 9]).all()
    none = joining.sections(basins, rgb, maps, level, policy(bias=-1.0))
    np.testing.assert_array_equal(none, basins)
    alone = joining.sections((basins == 1).astype(int), rgb, maps, level, policy(bias=1.0))
    np.testing.assert_array_equal(alone, basins == 1)


def test_maps_that_show_neither_slope_nor_centre():
    """They have no slope, and see their middle in their own places."""
    basins, rgb, maps, level = patches(3)
    silent = {name: maps[name] for name in ("roof", "edge")}
    nothing = silent | {name: np.zeros_like(maps[name]) for name in ("slope", "centre")}
    shown = [joining.traits(joining.graph(basins, rgb, some, level)) for some in (silent, nothing)]
    np.testing.assert_array_equal(*shown)
    assert not shown[0][:, [name.startswith("slope") for name in joining.TRAITS]].any()
    off = [name in ("aim off least", "aim off most") for name in joining.TRAITS]
    np.testing.assert_allclose(shown[0][:, off], 0, atol=1e-9)


@pytest.mark.parametrize("spoil", [lambda layers: layers.reverse(), lambda layers: layers[0]["weights"].pop()])
def test_layers_that_do_not_fit_are_refused(spoil):
    n = len(joining.TRAITS)
    layers = [{"weights": [[0.0] * 2] * n, "bias": [0.0] * 2}, {"weights": [[1.0], [1.0]], "bias": [0.0]}]
    terms = toy.contract("sections", join={**policy(), "layers": layers})
    contracts.validate(terms, "model")
    spoil(layers)
    with pytest.raises(contracts.ContractMismatch, match="join: its layers do not lead from 32 traits to one number"):
        contracts.validate(terms, "model")


def test_decoding_joins_where_the_contract_says_how():
    """A roof of two summits with a deep pass: two sections by prominence, one by a policy that joins everything. What rises less
    than `prominence` is one in any case."""
    distance = np.zeros((32, 32))
    distance[8:24, 4:14] = distance[8:24, 16:26] = 1.0
    roof = np.zeros((32, 32))
    roof[8:24, 4:26] = 1.0
    outputs = {"roof": roof[None], "edge": 0 * roof[None], "distance": distance[None]}
    terms = {"head": "dense", "thresholds": {"roof": 0.5, "prominence": 0.2, "min_area": 6}}
    rgb = np.zeros((32, 32, 3), np.uint8)
    assert heads.decode_sections(outputs, terms, rgb).labels.max() == 2
    assert heads.decode_sections(outputs, terms | {"join": policy(bias=-1.0)}, rgb).labels.max() == 2
    one = heads.decode_sections(outputs, terms | {"join": policy(bias=1.0)}, rgb)
    np.testing.assert_array_equal(one.labels, roof)
    shallow = outputs | {"distance": np.maximum(0.9 * roof, distance)[None]}
    never = heads.decode_sections(shallow, terms | {"join": policy(bias=-1.0)}, rgb)
    np.testing.assert_array_equal(never.labels, roof)
    nothing = {name: 0 * value for name, value in outputs.items()}
    assert not heads.decode_sections(nothing, terms | {"join": policy()}, rgb).labels.any()
