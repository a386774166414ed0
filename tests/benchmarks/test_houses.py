"""The count of houses: half covered is found, under half is not, a section over two houses spoils both."""

import json
import sys
from pathlib import Path

import geopandas
import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.houses import __main__ as houses
from kibs_steps.errors import KibsError

DRAWN = np.array([shapely.box(10, 10, 20, 20), shapely.box(30, 10, 40, 20), shapely.box(50, 10, 60, 20)])


def test_half_covered_is_found():
    sections = np.array([shapely.box(10, 10, 15, 20), shapely.box(30, 10, 34, 20), shapely.box(50, 5, 70, 30)])
    told = houses.count(DRAWN, sections)
    assert told.covered == pytest.approx([0.5, 0.4, 1.0])
    assert told.found.tolist() == [True, False, True]
    assert told.on_houses == pytest.approx((50 + 40 + 100) / (50 + 40 + 500))


def test_parts_count_together_and_only_once():
    twice = np.array([shapely.box(10, 10, 14, 20)] * 2 + [shapely.box(30, 10, 33, 20), shapely.box(33, 10, 36, 20)])
    assert houses.count(DRAWN, twice).found.tolist() == [False, True, False]


def test_a_section_over_two_houses_finds_neither():
    sections = np.array([shapely.box(10, 10, 40, 20), shapely.box(50, 10, 60, 20)])
    told = houses.count(DRAWN, sections)
    assert told.covered == pytest.approx([1.0, 1.0, 1.0])
    assert told.found.tolist() == [False, False, True]


def test_no_sections_find_nothing():
    assert not houses.count(DRAWN, np.zeros(0, object)).found.any()


def test_a_published_city_is_counted(tmp_path, capsys):
    raster = tmp_path / "r.tif"
    transform = Affine(0.5, 0, 500000, 0, -0.5, 5700000)
    with rasterio.open(
        raster, "w", width=80, height=40, count=1, dtype="uint8", crs="EPSG:32631", transform=transform
    ) as f:
        f.write(np.zeros((1, 40, 80), np.uint8))
    (tmp_path / "scene.json").write_text(json.dumps({"raster": str(raster)}))
    seen = shapely.box(500005, 5700000 - 10, 500010, 5700000 - 5)  # px 10–20, 10–20
    geopandas.GeoSeries([seen], crs="EPSG:32631").to_file(tmp_path / "city.gpkg", layer="roof_sections_image")
    outlines = [[list(p) for p in house.exterior.coords] for house in DRAWN]
    drawn = tmp_path / "houses.json"
    drawn.write_text(json.dumps({"size": [80, 40], "outlines": outlines}))
    houses.main([str(tmp_path / "city.gpkg"), f"--houses={drawn}"])
    assert (
        "1 of 3 houses by 1 sections, 100% of their area on these houses; missed (covered): 2 (0.00), 3 (0.00)"
        in capsys.readouterr().out
    )
    drawn.write_text(json.dumps({"size": [80, 41], "outlines": outlines}))
    with pytest.raises(KibsError, match="80 × 40 px"):
        houses.main([str(tmp_path / "city.gpkg"), f"--houses={drawn}"])
