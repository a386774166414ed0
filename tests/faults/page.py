"""The tables of refusals in docs/inputs.md, written from the cases: `python tests/faults/page.py` in the project's folder."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import bad_rasters  # noqa: F401  (adds its cases to the table)
import bad_settings  # noqa: F401
from cases import CASES

PAGE = Path(__file__).parents[2] / "docs/inputs.md"


def tables() -> str:
    """The page's tables of refusals."""
    lines = []
    for part in dict.fromkeys(c.part for c in CASES):
        lines += [f"### {part.capitalize()}", "| given | error | message |", "|---|---|---|"]
        lines += [
            f"| {c.given} | `{c.error}` | {c.message.replace('|', chr(92) + '|')} |" for c in CASES if c.part == part
        ]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    before, _, rest = PAGE.read_text().partition("<!-- refused -->\n")
    after = rest.partition("<!-- end -->")[2]
    PAGE.write_text(before + "<!-- refused -->\n" + tables() + "<!-- end -->" + after)
