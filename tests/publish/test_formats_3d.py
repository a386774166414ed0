"""GLB, OBJ, 3D Tiles, points, DSM, viewer: the same buildings, watertight, in place; independent readers agree."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import city
import numpy as np
import pyproj
import pytest
import rasterio
import shapely
import toy_city
import trimesh

from kibs_steps import mesh, store, view
from kibs_steps import scene as scenes
from kibs_steps.publish import dsm, glb, ksr, obj, tiles3d, viewer
from kibs_steps.publish.gltf import Glb
from kibs_steps.scene import Direction, Region


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Folder and arguments of a small city."""
    folder = tmp_path_factory.mktemp("town")
    return folder, city.built(folder)


def test_triangles_are_watertight_and_keep_the_volume(town):
    folder, _ = town
    found = {m.building: m for m in mesh.meshes([folder / "meshes.parquet"])}
    assert sorted(found) == sorted(city.VOLUMES)
    for building, volume in city.VOLUMES.items():
        body = trimesh.Trimesh(
            **trimesh.triangles.to_kwargs(found[building].triangles - found[building].triangles[0, 0])
        )
        body.merge_vertices(digits_vertex=3)
        assert body.is_watertight
        assert body.is_winding_consistent
        own = found[building].attributes
        below = (own["footprint_area"]) * (own["volume"] - volume) / own["footprint_area"]  # down to the lowest ground
        assert body.volume == pytest.approx(volume + below, rel=1e-6)
        assert body.volume == pytest.approx(own["volume"], rel=1e-6)


def test_a_face_with_a_hole_is_triangulated_with_its_vertices_only():
    outer = np.array([[0, 0, 5], [9000, 0, 5], [9000, 9000, 5], [0, 9000, 5]])
    hole = np.array([[3000, 3000, 5], [3000, 6000, 5], [6000, 6000, 5], [6000, 3000, 5]])
    vertices = np.concatenate([outer, hole])
    index, face = mesh.triangulated([[[0, 1, 2, 3], [4, 5, 6, 7]], [[3, 2, 1, 0]]], vertices)
    triangles = vertices[index]
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2] / 2e6
    assert area[face == 0].sum() == 72.0
    assert (area[face == 0] > 0).all()
    assert area[face == 1].sum() == -81.0
    assert {tuple(p) for p in triangles[face == 0].reshape(-1, 3).tolist()} == {
        tuple(p) for p in [*outer.tolist(), *hole.tolist()]
    }


def test_glb_has_a_node_per_building_with_its_attributes(town, tmp_path):
    folder, arguments = town
    out = tmp_path / "city.glb"
    glb.main([*arguments, "--out", str(out)])
    again = tmp_path / "again.glb"
    glb.main([*arguments, "--out", str(again)])
    assert out.read_bytes() == again.read_bytes()
    world = trimesh.load(out)
    assert sorted(world.graph.nodes_geometry) == [f"building-{b}" for b in sorted(city.VOLUMES)]
    scene = scenes.read(folder / "scene.json")
    for building in city.VOLUMES:
        transform, name = world.graph[f"building-{building}"]
        body = world.geometry[name].copy()
        assert body.metadata["building_id"] == building
        points = trimesh.transform_points(body.vertices, transform)
        placed = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]]) + glb.origin_of(scene)
        (expected,) = [m for m in mesh.meshes([folder / "meshes.parquet"]) if m.building == building]
        low, high = expected.triangles.reshape(-1, 3).min(axis=0), expected.triangles.reshape(-1, 3).max(axis=0)
        np.testing.assert_allclose([placed.min(axis=0), placed.max(axis=0)], [low, high], atol=2e-3)


def test_vertex_colours_are_light_as_gltf_takes_them(town, tmp_path):
    _, arguments = town
    glb.main([*arguments, "--out", str(tmp_path / "city.glb")])
    found = set()
    for body in trimesh.load(tmp_path / "city.glb").geometry.values():
        colours = body.visual.vertex_attributes["color"]
        found |= {tuple(c) for c in np.asarray(colours)[:, :3].tolist()}
    for colour in mesh.COLOURS / 255:
        light = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
        assert tuple(np.rint(255 * light).astype(int).tolist()) in found
    assert len(found) == 3


def test_files_without_fields_for_it_tell_the_licence_too(town, tmp_path):
    _, arguments = town
    contract = {"trained_on": {"licence": "CC BY-NC 4.0"}}
    (tmp_path / "m.json").write_text(json.dumps({"file": "x/corners.onnx", "contract": contract}))
    arguments = [*arguments, "--models", str(tmp_path / "m.json")]
    obj.main([*arguments, "--out", str(tmp_path / "city.obj"), "--materials", str(tmp_path / "city.mtl")])
    ksr.main([*arguments, "--out", str(tmp_path / "points.ply")])
    for name in ("city.obj", "points.ply"):
        assert b"licence corners.onnx: CC BY-NC 4.0" in (tmp_path / name).read_bytes()[:1024]


def test_roofs_wear_the_image_where_they_are_seen(town, tmp_path):
    folder, arguments = town
    out = tmp_path / "city.glb"
    glb.main([*arguments, "--drape", "--out", str(out)])
    world = trimesh.load(out)
    roof = world.geometry["building-201-roof"]
    scene = scenes.read(folder / "scene.json")
    (expected,) = [m for m in mesh.meshes([folder / "meshes.parquet"]) if m.building == 201]
    corners = expected.triangles[expected.kind[expected.face] == 0].reshape(-1, 3)
    seen = corners[:, :2].copy()
    for _ in range(40):
        seen = corners[:, :2] - (corners[:, 2] - toy_city.GROUND.at(seen))[:, None] * scene.lean
    uv = scene.grid.to_image(seen) / (scene.grid.width, scene.grid.height)
    np.testing.assert_allclose(np.sort(roof.visual.uv[:, 0]), np.sort(uv[:, 0]), atol=1e-4)
    np.testing.assert_allclose(np.sort(1 - roof.visual.uv[:, 1]), np.sort(uv[:, 1]), atol=1e-4)
    assert roof.visual.material.baseColorTexture.size == (scene.grid.width, scene.grid.height)
    content = out.read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    (texture,) = tree["textures"]  # beyond the image's edge its rim goes on, not its other side
    assert tree["samplers"][texture["sampler"]] == {"wrapS": 33071, "wrapT": 33071}


def test_a_roof_across_regions_wears_the_one_view_that_shows_it(tmp_path):
    """A roof seen west of a border, from the east, one side of which stands beyond it."""
    scene = toy_city.make_scene(tmp_path, direction=None)
    left, bottom, right, top = scene.grid.bounds
    parts = (shapely.box(left, bottom, left + 60, top), shapely.box(left + 60, bottom, right, top))
    leans = [view.lean(azimuth, 60.0) for azimuth in (90.0, 270.0)]
    regions = tuple(Region(part, Direction(0.0, 60.0, lean)) for part, lean in zip(parts, leans, strict=True))
    scene = scene._replace(regions=regions)
    dtm = scene.terrain(scene.grid.bounds)
    seen = np.array([[left + x, top - y] for x, y in ((40, 40), (56, 40), (56, 50), (40, 50))])
    standing, z = view.ground_position(seen, np.full(4, 10.0), dtm, np.tile(leans[0], (4, 1)))
    assert standing[0, 0] < left + 60 < standing[1, 0]
    corners = np.column_stack([standing, z])
    index = np.array([[0, 1, 2], [0, 2, 3]])
    none = np.zeros(1, int)
    roof = mesh.Mesh(1, {}, [{}], none, corners, index, np.zeros(2, int), np.array([1]), np.array([4]), np.arange(4))
    with Glb(tmp_path) as content:
        body = glb.draped(content, roof, np.zeros(3), scene, dtm)
        content.add("nodes", {"mesh": content.add("meshes", {"primitives": [body]})})
        content.save(tmp_path / "roof.glb", {"nodes": [0]}, materials=[glb.MATT, glb.MATT])
    (found,) = trimesh.load(tmp_path / "roof.glb", process=False).geometry.values()
    uv = scene.grid.to_image(seen[index.ravel()]) / (scene.grid.width, scene.grid.height)
    np.testing.assert_allclose(found.visual.uv * (1, -1) + (0, 1), uv, atol=1e-4)


def test_an_empty_city_is_a_valid_glb(tmp_path):
    glb.write(tmp_path / "empty.glb", [], np.zeros(3), {})
    assert trimesh.load(tmp_path / "empty.glb").is_empty


def test_obj_is_read_back_with_the_volume(town, tmp_path):
    folder, arguments = town
    obj.main([*arguments, "--out", str(tmp_path / "city.obj"), "--materials", str(tmp_path / "city.mtl")])
    text = (tmp_path / "city.obj").read_text()
    assert re.findall(r"^o (\S+)", text, re.M) == [f"building-{b}" for b in sorted(city.VOLUMES)]
    assert set(re.findall(r"^usemtl (\S+)", text, re.M)) == set(mesh.KINDS)
    vertices = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("v ")], float)
    faces = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("f ")], int) - 1
    body = trimesh.Trimesh(vertices, faces)
    total = sum(m.attributes["volume"] for m in mesh.meshes([folder / "meshes.parquet"]))
    assert body.volume == pytest.approx(total, rel=1e-3)


def test_tiles_made_again_leave_what_a_user_put_beside_them(town, tmp_path):
    _, arguments = town
    folder = tmp_path / "tiles3d"
    tiles3d.main([*arguments, "--out", str(folder / "tileset.json")])
    made = {path.name: path.read_bytes() for path in folder.glob("[!.]*")}
    (folder / "index.html").write_text("a page")
    (folder / "0_0.glb.changed").write_text("set aside")
    with store.whole(folder / "99_99.glb") as gone:  # of a city that was larger
        gone.write_text("a tile")
    tiles3d.main([*arguments, "--out", str(folder / "tileset.json")])
    after = {path.name: path.read_bytes() for path in folder.glob("[!.]*")}
    assert after == {**made, "index.html": b"a page", "0_0.glb.changed": b"set aside"}


def test_tiles_stand_at_their_place_on_the_earth(town, tmp_path):
    folder, arguments = town
    tiles3d.main([*arguments, "--out", str(tmp_path / "tiles3d/tileset.json")])
    tileset = json.loads((tmp_path / "tiles3d/tileset.json").read_text())
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    to_earth = pyproj.Transformer.from_crs(pyproj.CRS(toy_city.CRS).to_3d(), "EPSG:4978", always_xy=True)
    ids, points = [], []
    for child in tileset["root"]["children"]:
        file = tmp_path / "tiles3d" / child["content"]["uri"]
        world = trimesh.load(file)
        transform, name = world.graph["buildings"]
        body = world.geometry[name]
        p = trimesh.transform_points(body.vertices, transform)
        z_up = np.column_stack([p[:, 0], -p[:, 2], p[:, 1]])
        points.append(z_up @ matrix[:3, :3].T + matrix[:3, 3])
        tree = json.loads(file.read_bytes()[20 : 20 + int.from_bytes(file.read_bytes()[12:16], "little")])
        (table,) = tree["extensions"]["EXT_structural_metadata"]["propertyTables"]
        view = tree["bufferViews"][table["properties"]["building_id"]["values"]]
        start = 20 + int.from_bytes(file.read_bytes()[12:16], "little") + 8 + view.get("byteOffset", 0)
        ids += np.frombuffer(file.read_bytes()[start : start + 4 * table["count"]], np.uint32).tolist()
        feature = body.vertex_attributes["_FEATURE_ID_0"]
        assert set(np.unique(feature)) == set(range(table["count"]))
        centre, half = np.array(child["boundingVolume"]["box"][:3]), np.array(child["boundingVolume"]["box"][3::4])
        assert (np.abs(z_up - centre) <= half + 0.01).all()
    assert sorted(ids) == sorted(city.VOLUMES)
    corners = np.concatenate([m.triangles.reshape(-1, 3) for m in mesh.meshes([folder / "meshes.parquet"])])
    expected = np.column_stack(to_earth.transform(*corners.T))
    points = np.concatenate(points)
    for axis in range(3):
        np.testing.assert_allclose(
            [points[:, axis].min(), points[:, axis].max()],
            [expected[:, axis].min(), expected[:, axis].max()],
            atol=0.01,
        )


def test_points_lie_on_faces_and_look_outward(town, tmp_path):
    folder, arguments = town
    ksr.main([*arguments, "--out", str(tmp_path / "points.ply")])
    content = (tmp_path / "points.ply").read_bytes()
    head, body = content.split(b"end_header\n", 1)
    points = np.frombuffer(body, ksr.ROW)
    assert f"element vertex {len(points)}".encode() in head
    xyz = np.column_stack([points["x"], points["y"], points["z"]])
    normal = np.column_stack([points["nx"], points["ny"], points["nz"]])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    for m in mesh.meshes([folder / "meshes.parquet"]):
        origin = m.triangles[0, 0]
        body = trimesh.Trimesh(**trimesh.triangles.to_kwargs(m.triangles - origin))
        low, high = m.triangles.reshape(-1, 3).min(axis=0) - 0.1, m.triangles.reshape(-1, 3).max(axis=0) + 0.1
        mine = ((xyz > low) & (xyz < high)).all(axis=1) & (points["label"] > 0)
        sample = np.flatnonzero(mine)[::17]
        winding = body.face_normals
        for k in sample:  # the plane of some face holds the point and has its normal
            p = xyz[k] - origin
            on = np.abs(((p - body.triangles[:, 0]) * winding).sum(axis=1)) < 0.01
            assert (winding[on] @ normal[k] > 0.99).any()
    ground = xyz[points["label"] == 0]
    assert len(ground) > 100
    np.testing.assert_allclose(ground[:, 2], toy_city.GROUND.at(ground[:, :2]), atol=1e-3)
    assert set(points["label"]) == {0, 1, 2}


def test_dsm_is_terrain_with_roofs(town, tmp_path):
    folder, arguments = town
    dsm.main([*arguments, "--out", str(tmp_path / "dsm.tif")])
    with rasterio.open(tmp_path / "dsm.tif") as source:
        heights = source.read(1)
        assert source.dtypes == ("float32",)
        assert source.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    scene = scenes.read(folder / "scene.json")
    rows, cols = np.mgrid[: scene.grid.height, : scene.grid.width]
    ground = toy_city.GROUND.at(scene.grid.to_map(np.stack([cols, rows], axis=-1) + 0.5))
    raised = heights - ground > 0.05
    area = sum(m.attributes["footprint_area"] for m in mesh.meshes([folder / "meshes.parquet"]))
    assert raised.sum() * scene.grid.gsd**2 == pytest.approx(area, rel=0.03)
    np.testing.assert_allclose(heights[~raised], ground[~raised], atol=0.05)
    place = np.array([[toy_city.X0 + 10 + 7.0, toy_city.Y0 - 50 + 4.5]])  # on the hip's ridge
    col, row = scene.grid.to_image(place)[0].astype(int)
    base = float(toy_city.GROUND.at(np.array([(toy_city.X0 + 10, toy_city.Y0 - 50)]))[0]) + city.EAVES
    assert heights[row, col] == pytest.approx(base + 6 + 0.75 * 4.5, abs=0.4)


def test_dsm_lies_where_the_ground_stands_that_the_image_shows(town, tmp_path):
    """Projected on a height 100 m below the ground, the image shows it 58 m beside its place."""
    folder, arguments = town
    facts = json.loads((folder / "scene.json").read_text())
    base = float(toy_city.GROUND.at(np.array([[toy_city.X0, toy_city.Y0]]))[0])
    (tmp_path / "scene.json").write_text(json.dumps({**facts, "projection_height": base - 100, "displaced": 80.0}))
    shutil.copy(folder / "dtm.tif", tmp_path)
    dsm.main(["--scene", str(tmp_path / "scene.json"), *arguments[2:], "--out", str(tmp_path / "dsm.tif")])
    made = scenes.read(tmp_path / "scene.json")
    with rasterio.open(tmp_path / "dsm.tif") as source:
        centre = np.array([source.xy(source.height // 2, source.width // 2)])
        middle = (source.read(1)[source.height // 2, source.width // 2], source.bounds)
    assert middle[0] >= toy_city.GROUND.at(centre)[0] - 0.05
    left, bottom, right, top = made.grid.bounds
    rims = np.array(
        [
            [left, (bottom + top) / 2],
            [right, (bottom + top) / 2],
            [(left + right) / 2, bottom],
            [(left + right) / 2, top],
        ]
    )
    stands, _ = view.ground_position(
        rims, np.zeros(4), made.terrain(made.grid.bounds), made.lean, made.projected_on(None)
    )
    assert np.hypot(*(stands - rims).T).min() > 40
    bounds = [stands[0, 0], stands[2, 1], stands[1, 0], stands[3, 1]]
    np.testing.assert_allclose(middle[1], bounds, atol=12)  # the ground slopes


def test_viewer_is_one_file_that_asks_for_nothing(town, tmp_path):
    _, arguments = town
    out = tmp_path / "viewer.html"
    viewer.main([*arguments, "--out", str(out)])
    text = out.read_text(encoding="utf-8")
    assert "SPDX-License-Identifier: MIT" in text
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=", text)
    again = tmp_path / "again.html"
    viewer.main([*arguments, "--out", str(again)])
    assert out.read_bytes() == again.read_bytes()
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    assert data["buildings"]["building_id"] == sorted(city.VOLUMES)


@pytest.mark.parametrize("above", [None, 40.0], ids=["projected on the terrain", "40 m above"])
def test_the_viewers_ground_lies_where_it_stands_under_what_the_image_shows(town, above):
    folder, _ = town
    made = scenes.read(folder / "scene.json")
    base = float(made.terrain(made.grid.bounds)(np.array([made.grid.bounds[:2]]))[0])
    made = made._replace(
        view=Direction(180.0, 60.0, view.lean(180.0, 60.0)), projection_height=None if above is None else base + above
    )
    origin = glb.origin_of(made)
    shape, points = viewer.terrain_of(made, origin)
    points = points + origin
    assert np.allclose(points[:, 2], made.terrain(made.grid.bounds)(points[:, :2]), atol=0.01)
    ground = made.projected_on(made.terrain(made.grid.bounds))
    seen = view.image_position(points[:, :2], points[:, 2], made.lean, ground)
    left, bottom, right, top = made.grid.bounds
    x, y = np.meshgrid(np.linspace(left, right, shape["cols"]), np.linspace(top, bottom, shape["rows"]))
    assert np.allclose(seen, np.column_stack([x.ravel(), y.ravel()]), atol=0.02)
    moved = np.hypot(*(points[:, :2] - seen).T)
    assert moved.max() < 0.02 if above is None else moved.min() > 0.4 * above


@pytest.mark.skipif(not shutil.which("chromium"), reason="chromium is not installed")
def test_the_viewer_draws_in_a_browser(town, tmp_path):
    _, arguments = town
    viewer.main([*arguments, "--out", str(tmp_path / "viewer.html")])
    page = f"file://{tmp_path / 'viewer.html'}#mode=1&pick=101"
    done = subprocess.run(
        ["chromium", "--headless", "--no-sandbox", f"--user-data-dir={tmp_path / 'profile'}", "--use-gl=angle",
         "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--virtual-time-budget=30000", "--dump-dom", page],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert 'data-ready="yes"' in done.stdout, done.stdout[-1000:] + done.stderr[-3000:]
    facts = re.search(r'<div id="facts".*?</div>', done.stdout, re.S)[0]
    assert "<td>101</td>" in facts
    assert "faces N" in done.stdout


def gltf_validator():
    """Folder of the npm package gltf-validator (KIBS_NPM: a folder with node_modules); the test is skipped without it."""
    folder = Path(os.environ.get("KIBS_NPM", ".")) / "node_modules/gltf-validator"
    if not (folder.is_dir() and shutil.which("node")):
        pytest.skip("gltf-validator is not installed (npm install gltf-validator; KIBS_NPM=its folder)")
    return folder


def test_gltf_validator_finds_no_error(town, tmp_path):
    package = gltf_validator()
    _, arguments = town
    glb.main([*arguments, "--out", str(tmp_path / "city.glb")])
    glb.main([*arguments, "--drape", "--out", str(tmp_path / "draped.glb")])
    tiles3d.main([*arguments, "--out", str(tmp_path / "tiles3d/tileset.json")])
    glb.write(tmp_path / "empty.glb", [], np.zeros(3), {"title": "none"})
    files = [str(f) for f in tmp_path.rglob("*.glb") if f.parent.name != ".sums"]
    script = """const v = require(process.argv[1]), fs = require("fs");
    (async () => { for (const f of process.argv.slice(2)) {
      const report = await v.validateBytes(new Uint8Array(fs.readFileSync(f)));
      if (report.issues.numErrors + report.issues.numWarnings) console.log(f, JSON.stringify(report.issues.messages.slice(0, 5)));
    } })();"""
    done = subprocess.run(["node", "-e", script, str(package), *files], capture_output=True, text=True, check=True)
    assert done.stdout == ""
