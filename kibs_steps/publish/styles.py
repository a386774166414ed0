"""Styles: how QGIS shows the layers of `city.gpkg` when it is opened, as QML in the table `layer_styles`.

Buildings are coloured by height; roof sections by where they face (hue) and how steep they are (strength); what is *seen*
is drawn as lines, to lie over the raster.
"""

from __future__ import annotations

from datetime import datetime
from xml.sax.saxutils import escape, quoteattr

import pyarrow as pa

HEIGHTS = (  # up to (m above ground), colour
    (4, "#34265e"),
    (7, "#365c8d"),
    (10, "#277f8e"),
    (15, "#2ea67f"),
    (25, "#84cc5e"),
    (1000, "#f0e55c"),
)
FACING = (
    'CASE WHEN "azimuth" IS NULL THEN color_hsv(0, 0, 96) '
    'ELSE color_hsv("azimuth", clamp(12, "slope" * 1.9, 75), 94) END'
)
CERTAINTY = "ramp_color('RdYlGn', 1 - clamp(0, \"sigma\" / 3, 1))"


def _options(values: dict[str, str]) -> str:
    options = "".join(f'<Option type="QString" name={quoteattr(k)} value={quoteattr(v)}/>' for k, v in values.items())
    return f'<Option type="Map">{options}</Option>'


def _computed(properties: dict[str, str]) -> str:
    if not properties:
        return ""
    inner = "".join(
        f'<Option type="Map" name="{name}"><Option type="bool" name="active" value="true"/>'
        f'<Option type="QString" name="expression" value={quoteattr(expression)}/>'
        '<Option type="int" name="type" value="3"/></Option>'
        for name, expression in properties.items()
    )
    return (
        '<data_defined_properties><Option type="Map"><Option type="QString" name="name" value=""/>'
        f'<Option type="Map" name="properties">{inner}</Option>'
        '<Option type="QString" name="type" value="collection"/></Option></data_defined_properties>'
    )


def _rgba(colour: str, alpha: int) -> str:
    return ",".join(str(int(colour[i : i + 2], 16)) for i in (1, 3, 5)) + f",{alpha}"


def _symbol(
    kind: str, layer: str, values: dict[str, str], computed: dict[str, str] | None = None, name: str = "0"
) -> str:
    return (
        f'<symbol type="{kind}" name="{name}" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="{layer}" enabled="1" locked="0" pass="0">{_options(values)}{_computed(computed or {})}</layer></symbol>'
    )


def fill(
    colour: str, alpha: int, line: str, width: float, computed: dict[str, str] | None = None, name: str = "0"
) -> str:
    """A filled outline: colours as #rrggbb, `alpha` 0–255, line `width` in mm."""
    values = {
        "color": _rgba(colour, alpha),
        "style": "solid" if alpha else "no",
        "outline_color": _rgba(line, 255),
        "outline_style": "solid",
        "outline_width": f"{width:g}",
        "outline_width_unit": "MM",
        "joinstyle": "round",
    }
    return _symbol("fill", "SimpleFill", values, computed, name)


def single(symbol: str) -> str:
    """All features alike."""
    return (
        f'<renderer-v2 type="singleSymbol" symbollevels="0" forceraster="0"><symbols>{symbol}</symbols></renderer-v2>'
    )


def graduated(attribute: str, steps: tuple[tuple[float, str], ...], unit: str) -> str:
    """Fills by the size of an attribute: (upper end, colour) from 0 on."""
    lows = [0, *(high for high, _ in steps[:-1])]
    ranges, symbols = [], []
    for i, (low, (high, colour)) in enumerate(zip(lows, steps, strict=True)):
        label = f"over {low:g} {unit}" if i == len(steps) - 1 else f"{low:g} – {high:g} {unit}"
        bottom = -1000 if i == 0 else low
        ranges.append(f'<range lower="{bottom}" upper="{high}" symbol="{i}" label="{label}" render="true"/>')
        symbols.append(fill(colour, 235, "#2b2b2b", 0.1, name=str(i)))
    return (
        f'<renderer-v2 type="graduatedSymbol" attr="{attribute}" graduatedMethod="GraduatedColor" symbollevels="0">'
        f"<ranges>{''.join(ranges)}</ranges><symbols>{''.join(symbols)}</symbols></renderer-v2>"
    )


def qml(renderer: str) -> str:
    """A QGIS style document."""
    head = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    return f'{head}<qgis version="3.22.0" styleCategories="Symbology">{renderer}</qgis>'


DOT = {
    "color": _rgba("#ffffff", 255),
    "name": "circle",
    "outline_color": _rgba("#202020", 255),
    "outline_width": "0.1",
    "outline_width_unit": "MM",
    "size": "1.1",
    "size_unit": "MM",
}
STYLES = {
    "buildings": ("by height", qml(graduated("height", HEIGHTS, "m"))),
    "footprints": ("outline", qml(single(fill("#000000", 0, "#505050", 0.2)))),
    "roof_sections": ("by direction", qml(single(fill("#dddddd", 255, "#2b2b2b", 0.1, {"fillColor": FACING})))),
    "roof_sections_image": (
        "over the raster",
        qml(single(fill("#000000", 0, "#fad73c", 0.35, {"outlineColor": FACING}))),
    ),
    "corners": ("by certainty", qml(single(_symbol("marker", "SimpleMarker", DOT, {"fillColor": CERTAINTY})))),
    "blocks": ("outline", qml(single(fill("#000000", 0, "#8a5a9e", 0.2)))),
}


def table(layers: list[str], geometry: str, date: str) -> pa.Table:
    """`layer_styles` as QGIS writes it, one default style per layer; `date` as ISO text."""
    when = datetime.fromisoformat(date)
    rows = [
        {
            "f_table_catalog": "",
            "f_table_schema": "",
            "f_table_name": name,
            "f_geometry_column": geometry,
            "styleName": STYLES[name][0],
            "styleQML": STYLES[name][1],
            "styleSLD": "",
            "useAsDefault": True,
            "description": escape(f"{name}, {STYLES[name][0]}"),
            "owner": "",
            "ui": None,
            "update_time": when,
        }
        for name in layers
    ]
    kinds = dict.fromkeys(rows[0], pa.string()) | {"useAsDefault": pa.bool_(), "update_time": pa.timestamp("ms", "UTC")}
    return pa.Table.from_pylist(rows, pa.schema(list(kinds.items())))
