"""CityJSON 2.0: `city.city.json` and the same city as CityJSONSeq, `city.city.jsonl`.

In: the blocks' `solids.city.jsonl`. Out: one file with all buildings and one shared vertex list, and one with a building per
line, both in order of building ids, so that the cut into blocks leaves no trace. Vertices are integers, millimetres from the
scene's lower left corner. The reference system is the EPSG code of the grid; where the scene names a vertical CRS and EPSG
has a compound of the two, that; else the horizontal one alone (CityJSON asks for a 3D CRS, but heights without a named datum
have none).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kibs_steps import cli, scene, store, sums
from kibs_steps.publish import licences

CRS_URL = "https://www.opengis.net/def/crs/EPSG/0/{}"


def reference_system(crs: str, vertical: str | None) -> str | None:
    """URL of a CRS, EPSG's compound with `vertical` if there is one; None where EPSG does not know it."""
    import pyproj

    horizontal = pyproj.CRS.from_user_input(crs).to_epsg()
    if horizontal is None:
        return None
    if vertical is not None:
        height = pyproj.CRS.from_user_input(vertical)
        for info in pyproj.database.query_crs_info("EPSG", pyproj.enums.PJType.COMPOUND_CRS):
            compound = pyproj.CRS.from_epsg(info.code)
            if [part.to_epsg() for part in compound.sub_crs_list] == [horizontal, height.to_epsg()]:
                return CRS_URL.format(info.code)
    return CRS_URL.format(horizontal)


def metadata(
    title: str, url: str | None, extent: Sequence[float] | None, date: str | None, licence: str
) -> dict[str, Any]:
    """The metadata object; what is unknown is left out."""
    values = {
        "geographicalExtent": None if extent is None else [round(float(v), 3) for v in extent],
        "referenceDate": date,
        "referenceSystem": url,
        "title": title,
        "licence": licence or None,
    }
    return {key: value for key, value in values.items() if value is not None}


class Line(NamedTuple):
    """Where a building's feature is: its number, file, byte offset, and how many vertices it has."""

    building: int
    path: str
    offset: int
    vertices: int


def index_of(path: str | Path) -> tuple[list[Line], np.ndarray]:
    """The features of a CityJSONSeq and their vertices (n, 3), one after the other. Raises `store.DamagedFile`."""
    sums.check(path)
    found, vertices = [], [np.zeros((0, 3), np.int64)]
    with open(path, "rb") as lines:
        offset = len(lines.readline())
        for line in lines:
            try:
                feature = json.loads(line)
                vertices.append(np.array(feature["vertices"], np.int64).reshape(-1, 3))
                found.append(Line(int(feature["id"].rsplit("-", 1)[1]), str(path), offset, len(vertices[-1])))
            except (ValueError, KeyError, IndexError) as error:
                raise store.DamagedFile(f"{path} is damaged at byte {offset}: delete it and run again") from error
            offset += len(line)
    return found, np.concatenate(vertices)


def feature_at(line: Line) -> dict[str, Any]:
    """The feature an index line stands for."""
    with open(line.path, "rb") as source:
        source.seek(line.offset)
        return json.loads(source.readline())


def transform(path: str | Path) -> dict[str, Any]:
    """The transform in a CityJSONSeq's header. Raises `store.DamagedFile`."""
    sums.check(path)
    with open(path, encoding="utf-8") as lines:
        try:
            return json.loads(lines.readline())["transform"]
        except (ValueError, KeyError) as error:
            raise store.DamagedFile(f"{path} has no CityJSON header: delete it and run again") from error


def renumbered(content: Any, index: np.ndarray) -> Any:
    """Nested lists of vertex numbers with each number replaced by index[number]."""
    if isinstance(content, list):
        return [renumbered(item, index) for item in content]
    return int(index[content])


def extent_of(vertices: np.ndarray, placed: dict[str, Any]) -> np.ndarray | None:
    """(min x, y, z, max x, y, z) in map metres of integer vertices (n, 3); None without any."""
    if not len(vertices):
        return None
    corners = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    return (corners * placed["scale"] + placed["translate"]).ravel()


def publish(paths: Sequence[str | Path], out: Path, sequence: Path, known: dict[str, Any]) -> None:
    """Write both files from the blocks' sequences; `known` are arguments of `metadata` but the extent.

    Buildings are read one by one, twice; only the vertices of the whole city are held in memory.
    """
    placed = transform(paths[0])
    lines: list[Line] = []
    every = []
    for path in paths:
        if transform(path) != placed:
            raise store.DamagedFile(f"{path} and {paths[0]} have different transforms: delete both and run again")
        found, of_block = index_of(path)
        lines += found
        every.append(of_block)
    first = np.cumsum([0, *(line.vertices for line in lines)])
    vertices, place = np.unique(np.concatenate(every), axis=0, return_inverse=True)
    place = place.ravel()
    head = {"type": "CityJSON", "version": "2.0", "transform": placed}
    head["metadata"] = metadata(extent=extent_of(vertices, placed), **known)

    def text(content: Any) -> str:
        return json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False)

    with out.open("w", encoding="utf-8") as city, sequence.open("w", encoding="utf-8") as features:
        features.write(text({**head, "CityObjects": {}, "vertices": []}) + "\n")
        city.write(text(head)[:-1] + ',"CityObjects":{')
        separator = ""
        for k in sorted(range(len(lines)), key=lambda k: lines[k].building):
            feature = feature_at(lines[k])
            features.write(text(feature) + "\n")
            for key, thing in feature["CityObjects"].items():
                for geometry in thing.get("geometry", []):
                    geometry["boundaries"] = renumbered(geometry["boundaries"], place[first[k] : first[k + 1]])
                city.write(f"{separator}{text(key)}:{text(thing)}")
                separator = ","
        city.write('},"vertices":[')
        for k in range(0, len(vertices), 100_000):
            city.write(("," if k else "") + text(vertices[k : k + 100_000].tolist())[1:-1])
        city.write("]}\n")


def main(argv: list[str] | None = None) -> None:
    """Write the city as CityJSON and CityJSONSeq."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.publish.cityjson", description=main.__doc__)
    parser.add_argument("--scene", required=True, help="scene.json")
    parser.add_argument("--solids", nargs="+", required=True, help="solids.city.jsonl of every block")
    parser.add_argument("--title", help="title of the city; the scene's name unless given")
    parser.add_argument("--date", help="reference date, YYYY-MM-DD")
    parser.add_argument("--models", nargs="*", default=[], help="models/*.json: their licences go into the metadata")
    parser.add_argument("--out", required=True, help="out: city.city.json")
    parser.add_argument("--seq", required=True, help="out: city.city.jsonl")
    args = parser.parse_args(argv)
    facts = scene.read(args.scene)
    vertical = store.read_json(args.scene).get("vertical_crs")
    url = reference_system(facts.grid.crs, vertical)
    if url is None:
        print("warning: the grid's CRS has no EPSG code: the CityJSON says no reference system", file=sys.stderr)
    elif vertical is None:
        print("warning: no vertical_crs is given: the CityJSON's reference system is horizontal only", file=sys.stderr)
    elif url == reference_system(facts.grid.crs, None):
        print(f"warning: EPSG has no compound of {facts.grid.crs} and {vertical}: horizontal only", file=sys.stderr)
    known = {"title": args.title or facts.name, "url": url, "date": args.date, "licence": licences.line(args.models)}
    with store.whole(args.out) as city, store.whole(args.seq) as lines:
        publish(args.solids, city, lines, known)


if __name__ == "__main__":
    cli.run(main)
