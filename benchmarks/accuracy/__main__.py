"""One command: every model set on every test set; a JSON file and a Markdown table beside it.

`python -m benchmarks.accuracy --models DIR --data $KIBS_DATA --out table.json`. Results are kept in a working folder under what
they depend on, so a killed run goes on and a new model costs only itself.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks.accuracy import chips, methods, scenes, table
from kibs_steps import cli, fingerprint, store

CITY = "citymodels/bruxelles.city.json"  # shown in no training


def main(argv: list[str] | None = None) -> None:
    """Compare model sets on the fixed test sets."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=main.__doc__)
    parser.add_argument("--models", required=True, type=Path, help="folder of model sets")
    parser.add_argument("--data", type=Path, help="folder of real data; without it only set A, of made-up cities")
    parser.add_argument("--city", type=Path, help=f"CityJSON file of set A (default: DATA/{CITY})")
    parser.add_argument("--work", type=Path, default=Path("runs/accuracy"), help="folder for what is kept between runs")
    parser.add_argument("--size", type=int, default=1200, help="side of the scenes of set A, px")
    parser.add_argument("--count", type=int, default=48, help="tiles of set B")
    parser.add_argument("--per-place", type=int, default=24, help="tiles of each place of set C")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--out", required=True, type=Path, help="out: table.json; table.md lies beside it")
    args = parser.parse_args(argv)
    found = methods.of(args.models)
    city = args.city or (args.data / CITY if args.data and (args.data / CITY).is_file() else None)
    rows: list[dict[str, Any]] = []
    told: dict[str, dict[str, Any]] = {}
    samples: dict[float, dict[str, list]] = {}
    for method in found:
        contract = method.contract
        settings = scenes.make(args.work / "scenes", args.size, contract["gsd"], city)
        place = args.work / method.name.replace(" ", "_")
        for name, figures in scenes.run(method, settings, place, args.cores).items():
            rows.append({"set": name, "method": method.name, **figures})
        told[method.name] = {**method.training, "tile": contract["tile"]}
        if not args.data:
            continue
        kept = place / f"tiles-{fingerprint.of_values(method.signature, args.count, args.per_place)}.json"
        if not kept.is_file():
            gsd = contract["gsd"]
            if gsd not in samples:
                samples[gsd] = chips.sets(args.data, args.count, args.per_place, gsd)
            runner = chips.Runner(method)
            judged = {
                name: chips.figures(tiles, [runner(tile) for tile in tiles]) for name, tiles in samples[gsd].items()
            }
            store.write_json(kept, {"sets": judged, "ms_per_tile": 1000 * runner.seconds / max(runner.tiles, 1)})
        content = store.read_json(kept)
        rows += [{"set": name, "method": method.name, **figures} for name, figures in content["sets"].items()]
        told[method.name]["ms_per_tile"] = content["ms_per_tile"]
    rows += table.mean_of_places(rows)
    rows.sort(key=lambda row: row["set"])
    store.write_json(args.out, {"methods": told, "rows": rows})
    with store.whole(args.out.with_suffix(".md")) as temporary:
        temporary.write_text(table.markdown(rows, told), encoding="utf-8")
    print(args.out.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    cli.run(main)
