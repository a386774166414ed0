"""What fills the blocks of a city, by name of the style.

Every filler takes a `Site` and a rectangle in street coordinates (s0, t0, s1, t1 in m) and builds there.
"""

from __future__ import annotations

from collections.abc import Callable

from kibs_steps.simulate.dwellings import rows, suburb, village
from kibs_steps.simulate.outdoors import park
from kibs_steps.simulate.site import Site
from kibs_steps.simulate.town import centre, desert, estate, perimeter
from kibs_steps.simulate.works import farm, harbour, industry

FILL: dict[str, Callable[[Site, float, float, float, float], None]] = {
    "suburb": suburb, "rows": rows, "village": village, "perimeter": perimeter, "centre": centre,
    "industry": industry, "farm": farm, "desert": desert, "park": park, "estate": estate, "harbour": harbour,
}  # fmt: skip
