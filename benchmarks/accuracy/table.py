"""The benchmark's table: rows of figures as Markdown."""

from __future__ import annotations

from typing import Any

COLUMNS = {
    "iou": ("pixel IoU", 3),
    "ap50": ("AP50", 3),
    "mean_best_iou": ("best IoU", 3),
    "pq": ("PQ", 3),
    "corner_precision": ("corner prec. 2 px", 2),
    "corner_recall": ("corner recall 2 px", 2),
    "found_mae": ("MAE found, m", 2),
    "found_rmse": ("RMSE", 2),
    "found_nmad": ("NMAD", 2),
    "found_bias": ("bias", 2),
    "roof_mae": ("MAE all roof, m", 2),
    "slope_error": ("slope, °", 1),
    "azimuth_error": ("azimuth, °", 1),
}
BY_HEIGHT = "found_mae_by_height"


def markdown(rows: list[dict[str, Any]], methods: dict[str, dict[str, Any]]) -> str:
    """What was compared, one table for all sets, and height errors by height bin."""
    lines = ["| method | initial weights | tiles seen | minutes | state | ms per tile | tile, px |"]
    lines.append("|---|---|---|---|---|---|---|")
    for name, m in methods.items():
        cost = _said(m.get("ms_per_tile"), 0)
        cells = (name, m["init"], m["tiles_seen"], m["minutes"], m["state"], cost, str(m["tile"]))
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += ["", "| set | method | " + " | ".join(title for title, _ in COLUMNS.values()) + " |"]
    lines.append("|---|---|" + "---|" * len(COLUMNS))
    for row in rows:
        cells = [_said(row.get(key), digits) for key, (_, digits) in COLUMNS.items()]
        lines.append(f"| {row['set']} | {row['method']} | " + " | ".join(cells) + " |")
    with_heights = [row for row in rows if row.get(BY_HEIGHT)]
    if with_heights:
        bins = list(dict.fromkeys(name for row in with_heights for name in row[BY_HEIGHT]))
        lines += ["", "Mean absolute height error (m) on correctly segmented pixels, by true height:", ""]
        lines += ["| set | method | " + " | ".join(bins) + " |", "|---|---|" + "---|" * len(bins)]
        for row in with_heights:
            cells = [_said(row[BY_HEIGHT].get(name), 2) for name in bins]
            lines.append(f"| {row['set']} | {row['method']} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def mean_of_places(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row `C mean` per method: the mean over the places of set C."""
    found = []
    for method in dict.fromkeys(row["method"] for row in rows):
        ious = [row["iou"] for row in rows if row["method"] == method and row["set"].startswith("C ")]
        if ious:
            found.append({"set": "C mean", "method": method, "iou": sum(ious) / len(ious)})
    return found


def _said(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
