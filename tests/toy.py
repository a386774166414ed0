"""A toy world for tests: houses painted in plain colours, and ONNX models that read those colours.

Roofs are red (R > 150) with the section's own green; corner pixels are (0, 8·height, 255). The models are a handful of ONNX
operators, so detections are exact and every step runs in milliseconds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import rasterio
from affine import Affine
from onnx import TensorProto, helper, numpy_helper

TILE, MARGIN, GSD = 64, 8, 0.38
X0, Y0 = 500_000.0, 5_400_000.0
CENTRES = [float(h) for h in range(32)]
VIEW = {"view_azimuth": 181.1, "view_elevation": 59.3}

Section = tuple[int, int, int, int, int, tuple[float, float, float, float]]  # col, row, width, height, green, heights


def contract(task: str, /, **changes: object) -> dict:
    """A valid contract for a toy model."""
    base = {
        "contract": 1,
        "task": task,
        "head": "dense",
        "gsd": GSD,
        "tile": TILE,
        "margin": MARGIN,
        "input": {"channels": "RGB", "scale": 1.0, "mean": [0.0, 0.0, 0.0], "std": [1.0, 1.0, 1.0]},
        "thresholds": {"roof": 0.5, "prominence": 0.2, "min_area": 6, "corner": 0.5, "corner_radius": 3.0},
        "trained_on": {"data": ["toy"], "licence": "CC0-1.0", "view_elevation": [50, 90]},
    }
    if task in ("corners", "both"):
        keep = [None, None, None]
        base["blend"] = {"inside": keep, "rim": keep, "outside": keep}
        edges = [c - 0.5 for c in CENTRES] + [CENTRES[-1] + 0.5]
        base["heights"] = {"edges": edges, "centres": CENTRES, "fallback": 6.0, "fallback_sigma": 2.0}
    return {**base, **changes}


def save(
    nodes: list,
    constants: dict[str, np.ndarray],
    outputs: dict[str, list],
    path: Path,
    terms: dict | None,
    geometry: bool = False,
) -> Path:
    """Write an ONNX model of an image, and of view and sun if it looks at `geometry`."""
    inputs = {"image": [1, 3, TILE, TILE]} | ({"geometry": [1, 6]} if geometry else {})
    given = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in inputs.items()]
    out = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in outputs.items()]
    init = [numpy_helper.from_array(np.asarray(v), k) for k, v in constants.items()]
    model = helper.make_model(
        helper.make_graph(nodes, "toy", given, out, init), opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    )
    if terms is not None:
        helper.set_model_props(model, {"kibs": json.dumps(terms)})
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)
    return path


def section_parts() -> tuple[list, dict[str, np.ndarray], dict[str, list]]:
    """Nodes, constants, outputs: roof where red is high; edge where the colour changes within 3×3 px; distance 1 inside."""
    n = helper.make_node
    pool = {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1]}
    nodes = [
        n("Slice", ["image", "i0", "i1", "axis"], ["red"]),
        n("Sub", ["red", "red_level"], ["red0"]),
        n("Sigmoid", ["red0"], ["roof"]),
        n("Slice", ["image", "i1", "i2", "axis"], ["green"]),
        n("MaxPool", ["green"], ["high"], **pool),
        n("Neg", ["green"], ["minus"]),
        n("MaxPool", ["minus"], ["low"], **pool),
        n("Add", ["high", "low"], ["range"]),
        n("Clip", ["range", "zero", "one"], ["edge"]),
        n("Sub", ["one", "edge"], ["inner"]),
        n("Mul", ["inner", "roof"], ["distance"]),
    ]
    constants = {k: np.array([i], np.int64) for i, k in enumerate(("i0", "i1", "i2", "i3"))}
    constants |= {"axis": np.array([1], np.int64), "red_level": np.float32(150.5)}
    constants |= {"zero": np.float32(0), "one": np.float32(1)}
    shape = [1, 1, TILE, TILE]
    return nodes, constants, {"roof": shape, "edge": shape, "distance": shape}


def corner_parts(bias: float = 0.0) -> tuple[list, dict[str, np.ndarray], dict[str, list]]:
    """Nodes, constants, outputs: corner where blue is 255 and red 0; its height is green / 8 (+ `bias` m) as a triangle."""
    n = helper.make_node
    nodes = [
        n("Slice", ["image", "i0", "i1", "axis"], ["red"]),
        n("Slice", ["image", "i1", "i2", "axis"], ["green"]),
        n("Slice", ["image", "i2", "i3", "axis"], ["blue"]),
        n("Sub", ["blue", "red"], ["difference"]),
        n("Sub", ["difference", "level"], ["excess"]),
        n("Sigmoid", ["excess"], ["corner"]),
        n("Concat", ["zeros", "zeros"], ["offset"], axis=1),
        n("Mul", ["green", "eighth"], ["metres0"]),
        n("Add", ["metres0", "bias"], ["metres"]),
        n("Sub", ["metres", "centres"], ["away"]),
        n("Abs", ["away"], ["apart"]),
        n("Sub", ["one", "apart"], ["peak"]),
        n("Relu", ["peak"], ["height"]),
    ]
    constants = {k: np.array([i], np.int64) for i, k in enumerate(("i0", "i1", "i2", "i3"))}
    constants |= {
        "axis": np.array([1], np.int64),
        "level": np.float32(250),
        "eighth": np.float32(1 / 8),
        "bias": np.float32(bias),
        "one": np.float32(1),
        "centres": np.array(CENTRES, np.float32).reshape(1, -1, 1, 1),
        "zeros": np.zeros((1, 1, TILE, TILE), np.float32),
    }
    outputs = {"corner": [1, 1, TILE, TILE], "offset": [1, 2, TILE, TILE]}
    return nodes, constants, {**outputs, "height": [1, len(CENTRES), TILE, TILE]}


def sections_model(path: Path, terms: dict | None = None) -> Path:
    """A model of sections after `section_parts`."""
    nodes, constants, outputs = section_parts()
    used = {name for node in nodes for name in node.input}
    constants = {k: v for k, v in constants.items() if k in used}
    return save(nodes, constants, outputs, path, contract("sections") if terms is None else terms)


def lit_sections_model(path: Path, **changes: object) -> Path:
    """The same roofs, seen the more surely the farther north (up) the shadow falls that it is told of."""
    nodes, constants, outputs = section_parts()
    n = helper.make_node
    nodes[1:3] = [
        n("Sub", ["red", "red_level"], ["red1"]),
        n("Slice", ["geometry", "i3", "i4", "axis"], ["shadow_down"]),
        n("Neg", ["shadow_down"], ["shadow_up"]),
        n("Relu", ["shadow_up"], ["north"]),
        n("Mul", ["north", "share"], ["gain"]),
        n("Add", ["gain", "least"], ["sureness"]),
        n("Mul", ["red1", "sureness"], ["red0"]),
        n("Sigmoid", ["red0"], ["roof"]),
    ]
    constants |= {"i4": np.array([4], np.int64), "least": np.float32(0.02), "share": np.float32(0.01)}
    return save(nodes, constants, outputs, path, contract("sections", geometry_input=True, **changes), geometry=True)


def corners_model(path: Path, terms: dict | None = None, bias: float = 0.0) -> Path:
    """A model of corners after `corner_parts`."""
    return save(*corner_parts(bias), path, contract("corners") if terms is None else terms)


def walled_corners_model(path: Path, walls: dict, untold: Sequence[str] = ()) -> Path:
    """The same corners by a model that has `walls` in its contract, and sees ground everywhere."""
    nodes, constants, outputs = corner_parts()
    nodes.append(helper.make_node("Identity", ["ground"], ["surface"]))
    shape = [1, 5, TILE // 2, TILE // 2]
    ground = np.zeros(shape, np.float32)
    ground[:, 0] = 1
    terms = contract("corners", walls=walls)
    terms["trained_on"] |= {"untold": list(untold)} if untold else {}
    return save(nodes, {**constants, "ground": ground}, {**outputs, "surface": shape}, path, terms)


def both_model(path: Path, terms: dict | None = None, bias: float = 0.0) -> Path:
    """One model that gives what the two give."""
    nodes, constants, outputs = section_parts()
    more, other_constants, other_outputs = corner_parts(bias)
    made = {name for node in nodes for name in node.output}
    nodes += [node for node in more if not made & set(node.output)]
    terms = contract("both") if terms is None else terms
    return save(nodes, {**constants, **other_constants}, {**outputs, **other_outputs}, path, terms)


def models(folder: Path) -> Path:
    """A model set."""
    sections_model(folder / "sections.onnx")
    corners_model(folder / "corners.onnx")
    return folder


def houses(rng: np.random.Generator, width: int, height: int) -> list[Section]:
    """Houses of two sections with a common ridge, never touching each other; heights in eighths of a metre."""
    found: list[Section] = []
    for row in range(4, height - 30, 30):
        for col in range(4, width - 36, 36):
            w, h = int(rng.integers(14, 28)), int(rng.integers(12, 22))
            left, top = col + int(rng.integers(0, 6)), row + int(rng.integers(0, 6))
            eave, rise, half = float(rng.integers(3, 8)), float(rng.integers(1, 4)), h // 2
            ridge = eave + rise
            green = int(rng.integers(40, 90))
            found.append((left, top, w, half, green, (eave, eave, ridge, ridge)))
            found.append((left, top + half, w, h - half, green + 60, (ridge, ridge, eave, eave)))
    return found


def paint(sections: list[Section], width: int, height: int) -> np.ndarray:
    """The raster (height, width, 3) uint8: corner pixels just inside each section's four corners."""
    image = np.full((height, width, 3), (90, 110, 80), np.uint8)
    for col, row, w, h, green, _ in sections:
        image[row : row + h, col : col + w] = (200, green, 60)
    for col, row, w, h, _, (z0, z1, z2, z3) in sections:
        for c, r, z in ((col, row, z0), (col + w - 1, row, z1), (col + w - 1, row + h - 1, z2), (col, row + h - 1, z3)):
            image[r, c] = (0, round(8 * z), 255)
    return image


def raster(path: Path, image: np.ndarray) -> Path:
    """Write the image as a georeferenced GeoTIFF."""
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 3, "height": image.shape[0], "width": image.shape[1]}
    with rasterio.open(path, "w", **profile, crs="EPSG:32631", transform=Affine(GSD, 0, X0, 0, -GSD, Y0)) as target:
        target.write(image.transpose(2, 0, 1))
    return path
