"""glTF: a binary file that grows part by part.

What is big (coordinates, colours, triangles) waits in temporary files, so memory holds the JSON alone: about a kilobyte per
part. All parts share one buffer view per kind of content; accessors count from its start. Nothing here knows of buildings.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import struct
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
VERTICES, ELEMENTS = 34962, 34963  # what a buffer view is for
TRIANGLES = 4
ALIGNED = 8  # bytes, where a buffer view starts


def y_up(points: np.ndarray) -> np.ndarray:
    """(east, north, up) as glTF's (x, y, z)."""
    return np.column_stack([points[:, 0], points[:, 2], -points[:, 1]])


class Glb:
    """A binary glTF 2.0 being written: a context manager, which takes its temporary files away."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.open = contextlib.ExitStack()
        self.views: dict[str, dict[str, Any]] = {}
        self.spools: dict[str, BinaryIO] = {}
        self.lists: dict[str, list[str]] = {"nodes": [], "meshes": [], "accessors": []}

    def __enter__(self) -> Glb:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.open.close()

    def add(self, name: str, content: dict[str, Any]) -> int:
        """Appends to `nodes`, `meshes` or `accessors`; returns the place."""
        self.lists[name].append(_text(content))
        return len(self.lists[name]) - 1

    def view(self, name: str, content: bytes, **about: Any) -> tuple[int, int]:
        """Appends bytes to the buffer view of that name; returns the view's place and where in it they start.

        `about`: `target`, `byteStride` of a new view.
        """
        if name not in self.views:
            self.spools[name] = self.open.enter_context(tempfile.TemporaryFile(dir=self.folder))  # noqa: SIM115
            self.views[name] = {"byteLength": 0, **about}
        start = self.views[name]["byteLength"]
        self.spools[name].write(content)
        self.views[name]["byteLength"] += len(content)
        return list(self.views).index(name), start

    def accessor(self, name: str, values: np.ndarray, target: int = VERTICES, **about: Any) -> int:
        """Appends an array (n,) or (n, k) to a view as an accessor of its own; returns its place."""
        values = np.ascontiguousarray(values)
        values = values.reshape(len(values), -1)
        stride = {"byteStride": values.strides[0]} if target == VERTICES else {}
        view, start = self.view(name, values.tobytes(), target=target, **stride)
        kind = {"componentType": COMPONENTS[values.dtype.name], "count": len(values), "type": SHAPES[values.shape[1]]}
        return self.add("accessors", {"bufferView": view, "byteOffset": start, **kind, **about})

    def primitive(self, points: np.ndarray, faces: np.ndarray, **attributes: int) -> dict[str, Any]:
        """Triangles (t, 3) of points (n, 3) in glTF's axes, with other accessors of the vertices."""
        points = points.astype(np.float32)
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        position = self.accessor("positions", points, **bounds)
        index = self.accessor("triangles", faces.astype(np.uint32).ravel(), ELEMENTS)
        return {"attributes": {"POSITION": position, **attributes}, "indices": index, "mode": TRIANGLES}

    def save(self, path: Path, scene: dict[str, Any], **more: Any) -> None:
        """Writes the file: `scene` names its nodes, `more` are further lists of the JSON (materials, images …)."""
        start, views = 0, []
        for view in self.views.values():
            views.append({"buffer": 0, "byteOffset": start, **view})
            start += -(-view["byteLength"] // ALIGNED) * ALIGNED
        tree = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [scene], **more}
        parts = [f'"{name}":[{",".join(texts)}]' for name, texts in self.lists.items() if texts]
        if views:
            parts.append(f'"bufferViews":{_text(views)},"buffers":[{{"byteLength":{start}}}]')
        head = ",".join([_text(tree)[:-1], *parts]).encode() + b"}"
        head += b" " * (-len(head) % 4)
        whole = 20 + len(head) + (8 + start if views else 0)
        with path.open("wb") as out:
            out.write(struct.pack("<4sIIII", b"glTF", 2, whole, len(head), 0x4E4F534A) + head)
            if views:
                out.write(struct.pack("<II", start, 0x004E4942))
            for spool in self.spools.values():
                spool.seek(0)
                shutil.copyfileobj(spool, out)
                out.write(b"\0" * (-spool.tell() % ALIGNED))


def _text(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"), allow_nan=False)
