"""Rasters and terrain behind a URL: the same pixels as from disk, and no more of the file than asked for."""

from __future__ import annotations

import http.server
import threading
from pathlib import Path

import numpy as np
import pytest
import rasterio
import toy
from affine import Affine

from kibs_steps import fingerprint, imagery, plan, scene, sources, tiled, tiles
from kibs_steps.grid import Tiling, Window
from kibs_steps.publish import run

SIDE = 3000


class Ranges(http.server.BaseHTTPRequestHandler):
    """A file server that answers range requests and counts the bytes it sends."""

    folder: Path
    sent = 0
    tag = "one"

    def do_HEAD(self):
        self._answer(body=False)

    def do_GET(self):
        self._answer(body=True)

    def _answer(self, body: bool) -> None:
        path = self.folder / self.path.lstrip("/")
        if not path.is_file():
            self.send_error(404)
            return
        data = path.read_bytes()
        first, last = 0, len(data) - 1
        asked = self.headers.get("Range")
        if asked:
            start, end = asked.removeprefix("bytes=").split("-")
            first, last = int(start), min(int(end or last), last)
        self.send_response(206 if asked else 200)
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("ETag", f'"{self.tag}"')
        self.send_header("Content-Length", str(last - first + 1))
        if asked:
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
        self.end_headers()
        if body:
            self.wfile.write(data[first : last + 1])
            type(self).sent += last - first + 1

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def served(tmp_path):
    """A folder, its URL and the handler that counts."""
    handler = type("Counting", (Ranges,), {"folder": tmp_path, "sent": 0})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield tmp_path, f"http://127.0.0.1:{server.server_port}", handler
    server.shutdown()
    server.server_close()


def write(path: Path, image: np.ndarray, **layout: object) -> Path:
    """A georeferenced raster (bands, rows, cols) with a layout of its own."""
    profile = {"driver": "GTiff", "dtype": image.dtype, "count": len(image), "height": image.shape[1]}
    place = {"crs": "EPSG:32631", "transform": Affine(toy.GSD, 0, toy.X0, 0, -toy.GSD, toy.Y0)}
    with rasterio.open(path, "w", width=image.shape[2], **profile, **place, **layout) as target:
        target.write(image)
    return path


def noise(side: int = SIDE) -> np.ndarray:
    return np.random.default_rng(0).integers(1, 255, (3, side, side), np.uint8)


def test_a_block_by_url_is_the_block_from_disk(served):
    """Scene and block are the same, and only the windows travel: raster and terrain behind URLs."""
    folder, url, handler = served
    write(folder / "town.tif", noise(), tiled=True, blockxsize=256, blockysize=256)
    heights = np.linspace(90, 110, 400 * 400, dtype=np.float32).reshape(1, 400, 400)
    with rasterio.open(
        folder / "dtm.tif", "w", driver="GTiff", dtype="float32", count=1, width=400, height=400, crs="EPSG:32631",
        transform=Affine(5, 0, toy.X0 - 400, 0, -5, toy.Y0 + 400),
    ) as target:  # fmt: skip
        target.write(heights)
    near = scene.build("town", folder / "town.tif", folder / "dtm.tif", toy.GSD, folder / "near")
    far = scene.build(
        "town", sources.place(f"{url}/town.tif"), sources.place(f"{url}/dtm.tif"), toy.GSD, folder / "far"
    )
    assert far._replace(raster=near.raster, folder=near.folder) == near
    assert (folder / "near/dtm.tif").read_bytes() == (folder / "far/dtm.tif").read_bytes()
    handler.sent = 0
    tiling = Tiling(64, 8, 4)
    block = tiling.block_of("r005c005")
    for one, other in zip(tiles.read_block(near, tiling, block), tiles.read_block(far, tiling, block), strict=True):
        assert (one == other).all()
    assert 0 < handler.sent < (folder / "town.tif").stat().st_size / 4


def test_a_changed_remote_file_is_noticed(served):
    folder, url, handler = served
    (folder / "a.tif").write_bytes(b"content")
    path = sources.place(f"{url}/a.tif")
    first = sources.content(path, folder / "cache.json")
    assert first == sources.content(path, folder / "cache.json")
    handler.tag = "two"
    assert sources.content(path, folder / "cache.json") != first
    assert run.inputs([path], folder / "cache.json") == [{"file": path, "version": ['"two"', None, "7"]}]


def test_a_suite_chooses_by_the_pixels_of_a_url_too(served):
    """A raster of unknown GSD would get the finest set, which refuses coarse rasters."""
    folder, url, _ = served
    write(folder / "a.tif", noise(64))
    for name, gsd in (("fine", 0.25), ("usual", toy.GSD)):
        toy.sections_model(folder / "models" / name / "sections.onnx", toy.contract("sections", gsd=gsd))
        toy.corners_model(folder / "models" / name / "corners.onnx", toy.contract("corners", gsd=gsd))
    settings = {"models": str(folder / "models"), "method": "two_stage", "suppose": False}
    for raster in (f"{url}/a.tif", str(folder / "a.tif")):
        found = plan.models_for({**settings, "raster": raster}, folder)
        assert found["sections"].path.parent.name == "usual", raster
    with pytest.raises(sources.SourceUnreachable, match=r"nothing\.tif"):
        plan.models_for({**settings, "raster": f"{url}/nothing.tif"}, folder)


def test_what_does_not_answer_is_told(served):
    _, url, _ = served
    with pytest.raises(sources.SourceUnreachable, match=r"nothing\.tif"):
        sources.version(sources.place(f"{url}/nothing.tif"))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("https://x.org/a.tif", "/vsicurl/https://x.org/a.tif"),
        ("s3://bucket/key/a.tif", "/vsis3/bucket/key/a.tif"),
        ("gs://bucket/a.tif", "/vsigs/bucket/a.tif"),
        ("/vsis3/bucket/a.tif", "/vsis3/bucket/a.tif"),
        ("data/a.tif", "data/a.tif"),
        ("120.5", "120.5"),
    ],
)
def test_names(name, place):
    assert sources.place(name) == place
    assert sources.is_remote(place) == place.startswith("/vsi")


def test_files_are_known_by_content(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"a")
    assert sources.content(str(tmp_path / "a.tif"), tmp_path / "c.json") == fingerprint.of_file(
        tmp_path / "a.tif", tmp_path / "c.json"
    )
    assert sources.content("gone.tif", tmp_path / "c.json") == "gone.tif"
    assert sources.files("a.tif", "/vsis3/b/a.tif") == ["a.tif"]


class TestTiledCopy:
    @pytest.mark.parametrize(
        ("width", "cell", "poor"),
        [
            (30_000, (8, 30_000), True),
            (4_000, (8, 4_000), False),
            (30_000, (512, 512), False),
            (30_000, (30_000, 30_000), True),
        ],
    )
    def test_excess(self, width, cell, poor):
        assert (tiled.excess(width, width, cell) > tiled.TOO_MUCH) == poor

    def test_strips_pay_only_when_compressed_and_wide(self, tmp_path, monkeypatch):
        monkeypatch.setattr(tiled, "WINDOW", 100)
        image = noise(1000)
        layouts = {
            "strips": {"compress": "deflate"},
            "plain": {},
            "tiles": {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate"},
        }
        found = {name: tiled.needed(str(write(tmp_path / f"{name}.tif", image, **k))) for name, k in layouts.items()}
        assert found == {"strips": True, "plain": False, "tiles": False}

    def test_the_copy_has_the_same_blocks(self, tmp_path):
        """Values, mask and place of a masked raster survive."""
        image = noise(700)
        write(tmp_path / "a.tif", image, compress="deflate")
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK="YES"), rasterio.open(tmp_path / "a.tif", "r+") as target:
            mask = np.full((700, 700), 255, np.uint8)
            mask[:100] = 0
            target.write_mask(mask)
        facts = scene.build("town", tmp_path / "a.tif", 100, toy.GSD, tmp_path)
        tiled.main(["--raster", str(tmp_path / "a.tif"), "--out", str(tmp_path / "b.tif")])
        copy = facts._replace(raster=str(tmp_path / "b.tif"))
        window = Window(-10, 50, 400, 300)
        for one, other in zip(tiles.read_window(facts, window), tiles.read_window(copy, window), strict=True):
            assert (one == other).all()
        with imagery.opened(copy.raster) as source:
            assert source.block_shapes[0] == (512, 512)
