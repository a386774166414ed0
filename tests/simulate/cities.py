"""Known city models as CityJSON text: gable houses in several versions of the format."""

import json

import numpy as np

ROOF = {"RoofSurface": 0, "WallSurface": 1, "GroundSurface": 2}


def gable(x, y, base=5.0, long=10.0, wide=8.0, eave=4.0, ridge=7.0):
    """Surfaces of a gable house with its corner at (x, y): (ring, semantic type) each, outward normals, ridge along x."""
    a, b = x + long, y + wide
    m, e, r = y + wide / 2, base + eave, base + ridge
    return [
        ([[x, y, base], [x, b, base], [a, b, base], [a, y, base]], "GroundSurface"),
        ([[x, y, base], [a, y, base], [a, y, e], [x, y, e]], "WallSurface"),
        ([[a, b, base], [x, b, base], [x, b, e], [a, b, e]], "WallSurface"),
        ([[a, y, base], [a, b, base], [a, b, e], [a, m, r], [a, y, e]], "WallSurface"),
        ([[x, b, base], [x, y, base], [x, y, e], [x, m, r], [x, b, e]], "WallSurface"),
        ([[x, y, e], [a, y, e], [a, m, r], [x, m, r]], "RoofSurface"),
        ([[a, b, e], [x, b, e], [x, m, r], [a, m, r]], "RoofSurface"),
    ]


def document(houses, version="2.0", solid=True, crs=28992, semantics=True, lod=2.0, shift=(0.0, 0.0, 0.0)):
    """A CityJSON object of houses, each a list of (ring, type), one building with one part each."""
    corners, index = [], {}

    def vertex(point):
        key = tuple(np.round((np.array(point) - shift) * 1000).astype(int).tolist())
        if key not in index:
            index[key] = len(corners)
            corners.append(list(key))
        return index[key]

    objects = {}
    for i, house in enumerate(houses):
        faces = [[[vertex(p) for p in ring]] for ring, _ in house]
        values = [ROOF[kind] for _, kind in house]
        geometry = {"type": "Solid" if solid else "MultiSurface", "boundaries": [faces] if solid else faces}
        geometry["lod"] = lod if version < "1.0" else str(lod)
        if semantics:
            kinds = [{"type": t} for t in ROOF]
            geometry["semantics"] = {"surfaces": kinds, "values": [values] if solid else values}
        parents = {"parent": f"b{i}"} if version < "1.0" else {"parents": [f"b{i}"]}
        objects[f"b{i}"] = {"type": "Building", "children": [f"b{i}-0"], "geometry": []}
        objects[f"b{i}-0"] = {"type": "BuildingPart", "geometry": [geometry], **parents}
    return {
        "type": "CityJSON",
        "version": version,
        "transform": {"scale": [0.001] * 3, "translate": list(shift)},
        "metadata": {"referenceSystem": f"https://www.opengis.net/def/crs/EPSG/0/{crs}"} if crs else {},
        "CityObjects": objects,
        "vertices": corners,
    }


def write(path, houses, **how):
    """The document as a file."""
    path.write_text(json.dumps(document(houses, **how)))
    return path


def write_sequence(path, houses, **how):
    """The same as a CityJSONSeq: a header, then one feature a house."""
    header = {**document([], **how), "CityObjects": {}, "vertices": []}
    lines = [header]
    for i, house in enumerate(houses):
        one = document([house], **how)
        renamed = json.loads(json.dumps(one["CityObjects"]).replace('"b0', f'"b{i}'))
        lines.append({"type": "CityJSONFeature", "id": f"b{i}", "CityObjects": renamed, "vertices": one["vertices"]})
    path.write_text("\n".join(json.dumps(line) for line in lines))
    return path
