"""Detections through stitching: the same sections whatever the blocks, and every section whole."""

import numpy as np
import pyarrow as pa
import pytest
import shapely
import toy
from hypothesis import given, settings
from hypothesis import strategies as st

from kibs_steps import corners, heightmap, sections, stitch
from kibs_steps.grid import Grid, Tiling, Window
from kibs_steps.models import contract, heads, runtime, scoring

WIDTH, HEIGHT = 300, 230


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A painted raster, its sections, and both toy networks."""
    folder = toy.models(tmp_path_factory.mktemp("models"))
    truth = toy.houses(np.random.default_rng(3), WIDTH, HEIGHT)
    nets = {}
    for task in ("sections", "corners"):
        model = contract.load(folder / f"{task}.onnx", task)
        nets[task] = (runtime.open_network(model, np.zeros((1, 6), np.float32)), model.contract)
    return toy.paint(truth, WIDTH, HEIGHT), truth, nets


def detections(image, block_side, nets, shuffle=None, tolerance=0.0, scorer=None):
    """Stitched sections and corners of all blocks together, sorted by id."""
    grid = Grid("EPSG:32631", toy.X0, toy.Y0, toy.GSD, image.shape[1], image.shape[0])
    tiling = Tiling(toy.TILE, toy.MARGIN, block_side)
    padded = np.pad(image, ((toy.MARGIN, toy.MARGIN), (toy.MARGIN, toy.MARGIN), (0, 0)), mode="edge")
    inside = np.pad(np.ones(image.shape[:2], bool), toy.MARGIN)
    blocks = tiling.blocks(grid.width, grid.height)
    if shuffle is not None:
        blocks = [blocks[i] for i in shuffle.permutation(len(blocks))]
    pieces, links, seams, found, heights = {}, {}, {}, {}, {}
    for block in blocks:
        core = tiling.block_core(block, grid.width, grid.height)
        grown = core.grown(toy.MARGIN)  # the padded image starts a margin before the raster
        window = (slice(core.row, core.row + grown.height), slice(core.col, core.col + grown.width))
        network, terms = nets["sections"]
        views = sections.detect(
            padded[window], inside[window], tiling, block, grid, lambda _, told=network: told, terms
        )
        pieces[block] = sections.pieces(views, sections.grown(~inside[window]), tiling, core)
        inner = sections.inner_links(views, toy.MARGIN)
        links[block] = pa.table({"first": inner[:, 0], "second": inner[:, 1]})
        seams[block] = sections.seams(views, toy.MARGIN)
        network, terms = nets["corners"]
        tables, cells = [], [heightmap.HEIGHTS.empty_table()]
        for view in views:
            rgb = sections.tile_image(padded[window], view.tile, tiling, core, grid)
            outputs = network(rgb)
            tables.append(corners.of_tile(heads.decode_corners(outputs, terms), view.tile, tiling))
            cells.append(corners.heights_of_tile(heads.height_map(outputs, terms), view.labels, view.tile, tiling))
        found[block], heights[block] = pa.concat_tables(tables), pa.concat_tables(cells)
    read = stitch.Detections(
        lambda b, columns: pieces[b].select(columns),
        *(read.__getitem__ for read in (links, seams, found, heights)),
    )
    _, each, near = zip(*stitch.stitch(blocks, read, grid, tiling, tolerance, 3.0, scorer=scorer), strict=True)
    return pa.concat_tables(each).sort_by("section_id"), pa.concat_tables(near)


@pytest.mark.parametrize(
    "rows", [(17, 20), (19, 21), (19, 32)], ids=["beside the tiles' corner", "across it", "from it on"]
)
@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("rule", ["overlap", "touch"])
def test_a_seam_of_blocks_is_one_of_tiles(rows, bent, rule):
    """A roof across the corner of four tiles of 20 px: as many sections whether blocks are one or two tiles wide."""
    size, margin = 80, 2
    grid = Grid("EPSG:32631", 0.0, 0.0, toy.GSD, size, size)
    truth = np.zeros((size + 2 * margin,) * 2, np.int32)
    truth[margin + rows[0] : margin + rows[1], margin + 30 : margin + 50] = 1
    if bent:
        truth[margin + 20 :, margin + 40 :] = 0
    counts = []
    for side in (1, 2):
        tiling, files = Tiling(20 + 2 * margin, margin, side), {}
        blocks = tiling.blocks(size, size)
        for block in blocks:
            views, used = [], 0
            for tile in tiling.tiles(block, size, size):
                part = truth[tile.core.row : tile.core.row + tiling.tile, tile.core.col : tile.core.col + tiling.tile]
                seen = int(part.any())
                views.append(sections.View(tile, part * (used + 1), np.ones(seen), scoring.none(seen), used))
                used += seen
            core = tiling.block_core(block, size, size)
            nowhere = np.zeros((core.height + 2 * margin, core.width + 2 * margin), bool)
            inner = sections.inner_links(views, margin, rule)
            links = pa.table({"first": inner[:, 0], "second": inner[:, 1]})
            files[block] = sections.pieces(views, nowhere, tiling, core), links, sections.seams(views, margin)
        read = stitch.Detections(
            lambda b, columns, files=files: files[b][0].select(columns),
            lambda b, files=files: files[b][1],
            lambda b, files=files: files[b][2],
            lambda b: corners.CORNERS.empty_table(),
            lambda b: heightmap.HEIGHTS.empty_table(),
        )
        counts.append(sum(len(table) for _, table, _ in stitch.stitch(blocks, read, grid, tiling, 0.0, 5.0, rule)))
    assert counts[0] == counts[1] > 0


def test_every_painted_section_comes_back_once(world):
    """Sections cut by several seams are one section; the outline is the painted rectangle less its corner pixels."""
    image, truth, nets = world
    table, _ = detections(image, 2, nets)
    outlines = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False))
    assert len(outlines) == len(truth)
    for col, row, w, h, *_ in truth:
        box = shapely.box(col, row, col + w, row + h)
        iou = shapely.area(shapely.intersection(outlines, box)) / shapely.area(shapely.union(outlines, box))
        assert iou.max() > 1 - 6 / (w * h)


def test_heights_of_pieces_add_up_to_those_of_the_section(world):
    """Every cell of the height map counts once, for the section it lies in, on whichever side of a seam it was seen."""
    image, _, nets = world
    table, _ = detections(image, 2, nets)
    sums = heightmap.column(table["sums"])
    for box, row in zip(shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False)), sums, strict=True):
        n, x, y = row[:3]
        assert n == pytest.approx(box.area / heightmap.CELL)
        assert [x / n, y / n] == pytest.approx([box.centroid.x, box.centroid.y], abs=0.5)


def test_scores_are_of_whole_sections(world):
    """However seams cut a section, its evidence is that of all its pixels, and its score follows from that."""
    image, _, nets = world
    n = len(scoring.TRAITS)
    layer = {"weights": [[100.0 * (name == "area")] for name in scoring.TRAITS], "bias": [-3.0]}  # log px
    scorer = {"mean": [0.0] * n, "spread": [100.0] * n, "layers": [layer]}
    table, _ = detections(image, 2, nets, scorer=scorer)
    area = shapely.area(shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False)))
    np.testing.assert_allclose(table["score"].to_numpy(), 1 / (1 + np.exp(3.0) / area), rtol=1e-5)


def test_what_is_sure_is_asked_of_whole_sections():
    """A section stays whole though one of its parts alone would be too faint; what nothing is told of stays."""
    boxes = [
        shapely.box(0, 0, 4, 10),
        shapely.box(4, 0, 16, 10),
        shapely.box(40, 0, 50, 10),
        shapely.box(60, 0, 70, 10),
    ]
    area, roof = np.array([40.0, 120.0, 100.0, 0.0]), np.array([0.5, 0.8, 0.55, 0.0])
    evidence = scoring.none(4)
    evidence[:, scoring.EVIDENCE.index("area")] = area
    evidence[:, scoring.EVIDENCE.index("roof")] = area * roof
    none = np.zeros(4, np.int64)
    heights = np.zeros((4, len(heightmap.SUMS)))
    group = np.array([0, 0, 1, 2])
    pieces = stitch.Parts(none, group, np.array(boxes), np.full(4, 0.5), none > 0, none, none, evidence, heights)
    assert shapely.area(stitch.united(pieces, thresholds={"sure": 0.6}).geometry).tolist() == [160, 100]
    assert len(stitch.united(pieces).geometry) == 3
    # What is unlikely right must be surer: nothing is by its mean roof probability, everything by a scorer that doubts all.
    unlikely = {"sure": 0.5, "likely": 0.1, "surer": 0.7}
    doubtful = {"mean": [0.0] * 12, "spread": [1.0] * 12, "layers": [{"weights": [[0.0]] * 12, "bias": [-5.0]}]}
    assert shapely.area(stitch.united(pieces, thresholds=unlikely).geometry).tolist() == [160, 100, 100]
    assert shapely.area(stitch.united(pieces, doubtful, unlikely).geometry).tolist() == [160, 100]


@pytest.mark.parametrize("tolerance", [0.0, 1.5])
@pytest.mark.parametrize("side", [1, 3, 16])
def test_blocks_do_not_matter(world, side, tolerance):
    """Another block size, or another order of blocks, gives the same ids, outlines, scores."""
    image, _, nets = world
    expected, expected_corners = detections(image, 2, nets, tolerance=tolerance)
    table, found = detections(image, side, nets, np.random.default_rng(side), tolerance)
    assert table.equals(expected)
    assert places(found) == places(expected_corners)


def places(corners):
    """Corners as a set: a corner near sections of two blocks is listed for both."""
    return {(c["col"], c["row"], c["height"]) for c in corners.to_pylist()}


def test_corners_on_seams_are_kept_once(world):
    """Every painted corner comes back exactly once, also those within a pixel of a tile's seam."""
    image, truth, nets = world
    _, found = detections(image, 16, nets)
    painted = set()
    for col, row, w, h, *_ in truth:
        painted |= {(c + 0.5, r + 0.5) for c in (col, col + w - 1) for r in (row, row + h - 1)}
    got = list(zip(found["col"].to_pylist(), found["row"].to_pylist(), strict=True))
    assert len(got) == len(set(got))
    assert set(got) <= painted
    # Two sections' corners on a ridge lie one pixel apart; where a seam runs between them they count as one.
    for col, row in painted - set(got):
        assert min(abs(col - c) + abs(row - r) for c, r in got) <= 1


def test_shifted_raster_shifts_sections(world):
    """Cutting whole tile strides off the raster moves sections by as much and changes nothing else."""
    image, _, nets = world
    stride = toy.TILE - 2 * toy.MARGIN
    table, _ = detections(image, 2, nets)
    cut, _ = detections(image[:, stride:], 2, nets)
    outlines = shapely.from_wkb(table["outline"].to_numpy(zero_copy_only=False))
    moved = shapely.transform(outlines, lambda c: c - [stride, 0])
    whole = {shapely.normalize(g).wkt for g in moved[shapely.bounds(moved)[:, 0] > toy.MARGIN]}
    assert whole <= {shapely.normalize(g).wkt for g in shapely.from_wkb(cut["outline"].to_numpy(zero_copy_only=False))}


def test_links_need_mutual_choice():
    """A label that covers two of the neighbour's is linked to the larger one only; slight overlaps are not links."""
    first = np.zeros((10, 8), int)
    second = np.zeros((10, 8), int)
    first[:, :] = 1
    second[:6], second[6:] = 1, 2
    assert stitch.links_across(first, second).tolist() == [[1, 1]]
    second[:] = 0
    second[:2] = 5
    assert stitch.links_across(first, second).tolist() == []


def test_unconfirmed_slivers_are_voted_out():
    """A piece that lies mostly in the neighbour's core and is not linked falls; a linked or mostly inner one stands."""
    core, full = np.array([4, 4, 40, 0]), np.array([30, 30, 60, 12])
    assert stitch.confirmed(core, full, np.array([[1, 2]])).tolist() == [False, True, True, False]


def test_ids_are_positions_and_unique():
    grid = Grid("EPSG:32631", 0.0, 0.0, 1.0, 50, 40)
    boxes = np.array([shapely.box(10, 10, 20, 20), shapely.box(30, 5, 34, 9)])
    ids = stitch.section_ids(boxes, grid)
    for one, box in zip(ids, boxes, strict=True):
        row, col = divmod(int(one) - 1, 50)
        assert box.contains(shapely.Point(col + 0.5, row + 0.5))
    thin = np.array([shapely.box(10, 10, 10.2, 11), shapely.box(10.3, 10, 10.5, 11)])
    assert len(set(stitch.section_ids(thin, grid).tolist())) == 2
    assert (np.sort(stitch.section_ids(boxes[::-1], grid)) == np.sort(ids)).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_simplified_outlines_keep_sharing_rims(seed):
    """Smoothing a label image leaves no overlap and no gap between sections, and areas within a few pixels."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((24, 24), np.int32)
    points = rng.uniform(4, 20, (4, 2))
    rows, cols = np.mgrid[4:20, 4:20]
    near = np.argmin((rows[..., None] - points[:, 0]) ** 2 + (cols[..., None] - points[:, 1]) ** 2, axis=-1)
    labels[4:20, 4:20] = near + 1
    parts = sections.pixel_outlines(labels, Window(0, 0, 24, 24))
    outlines = np.array([p for g in shapely.from_wkb(list(parts.values())) for p in shapely.get_parts(g)])
    smooth = stitch.simplified(outlines, 1.5)
    assert shapely.is_valid(smooth).all()
    union = shapely.union_all(smooth)
    assert shapely.area(smooth).sum() == pytest.approx(shapely.area(union), abs=1e-6)
    assert not shapely.get_num_interior_rings(shapely.get_parts(union)).any()
    assert abs(shapely.area(union) - 256) < 12


def parts(boxes, group, **columns):
    """Pieces without evidence or heights."""
    n = len(boxes)
    none = np.zeros(n, np.int64)
    values = {"score": np.full(n, 0.5), "void": none > 0, "split": none, "owner": none, **columns}
    return stitch.Parts(
        none,
        np.array(group),
        np.array(boxes, object),
        *(np.array(values[name]) for name in ("score", "void", "split", "owner")),
        scoring.none(n),
        np.zeros((n, len(heightmap.SUMS))),
    )


def test_what_a_section_has_of_its_pieces():
    """Void as soon as one piece is; the score is the mean by area."""
    boxes = [shapely.box(0, 0, 4, 10), shapely.box(4, 0, 16, 10), shapely.box(40, 0, 50, 10)]
    whole = stitch.united(
        parts(boxes, [0, 0, 1], score=[0.2, 0.6, 0.3], void=[True, False, False], split=[2, 0, 1], owner=[0, 7, 0])
    )
    assert shapely.area(whole.geometry).tolist() == [160, 100]
    assert whole.score == pytest.approx([0.5, 0.3])
    assert whole.void.tolist() == [True, False]
    assert (whole.split.tolist(), whole.owner.tolist()) == ([2, 1], [7, 0])


def test_sections_at_each_side_of_the_raster_are_cut_by_it():
    grid = Grid("EPSG:32631", 0.0, 0.0, 1.0, 50, 40)
    boxes = [(0, 9, 9, 19), (9, 0, 19, 9), (41, 9, 50, 19), (9, 31, 19, 40), (1, 1, 49, 39)]
    outlines = np.array([shapely.box(*box) for box in boxes])
    assert stitch.touches_edge(outlines, grid).tolist() == [True] * 4 + [False]


def test_of_two_tiles_views_of_a_corner_the_better_stays():
    """Two corners of one tile are two, and what truth says is never merged."""
    rows = [  # tile, place, score, owner
        (0, 10.0, 0.4, 0),
        (1, 11.0, 0.9, 0),
        (0, 30.0, 0.4, 0),
        (0, 31.0, 0.9, 0),
        (0, 50.0, 0.4, 3),
        (1, 51.0, 0.9, 4),
    ]
    table = pa.Table.from_pylist(
        [
            {"tile_row": 0, "tile_col": tile, "col": x, "row": 5.0, "height": 6.0, "sigma": 0.5, "score": s, "owner": o}
            for tile, x, s, o in rows
        ],
        corners.CORNERS,
    )
    assert stitch.distinct_corners(table)["col"].to_pylist() == [11.0, 30.0, 31.0, 50.0, 51.0]
