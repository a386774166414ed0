"""COCO annotations of samples, and samples of COCO annotations.

Sections: one category; one annotation per section, its mask as run lengths (RLE). Corners: one annotation per corner, the
square of q × q px about it, cut at the tile; its category is the height bin (id = bin + 1), the last category holds corners of
unknown height. Ground where sections or corners are not known is annotated as a crowd (`iscrowd` 1), which COCO's own metrics
leave out. Beyond COCO's fields images carry `geometry`, corners their exact `corner` (col, row px) and `height` (m), section
crowds whether the ground is `roof`, so that a sample comes back as it was but for `height` and `surface` per pixel.

Ids count from 1 through the whole file and are never made of names. In: samples by name. Out: `images/NAME.png`,
`sections.json`, `corners.json`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from kibs_steps import cli, photographs, store
from kibs_steps.errors import KibsError
from kibs_steps.learn.samples import CORRECTED, UNKNOWN, Sample, contents

if TYPE_CHECKING:
    from pycocotools.coco import COCO

SQUARE = 15  # px: side q of a corner's square (PAPER, data and tiling)
SECTION = 1  # category id
ROOFS = (
    "section",
    "sections",
    "roof",
    "roofs",
    "roof_section",
    "roof_sections",
)  # names of categories that are roof sections
UNMOVED = 0.5  # px between a square and that of its exact corner


class BadAnnotations(KibsError):
    """Annotations that do not describe the images they lie beside."""


class Bins(NamedTuple):
    """Height classes: edges (B + 1,) and centres (B,), m above ground."""

    edges: Sequence[float]
    centres: Sequence[float]

    def of(self, heights: np.ndarray) -> np.ndarray:
        """Bin (n,) of heights (n,) m; those beyond the ends belong to the end bins, unknown ones (NaN) to none: B."""
        found = np.clip(np.searchsorted(self.edges, heights, side="right") - 1, 0, len(self.centres) - 1)
        return np.where(np.isfinite(heights), found, len(self.centres))


def paper_bins(highest: int = 19) -> Bins:
    """The paper's classes: one per metre from 1 m to `highest`."""
    centres = np.arange(1.0, highest + 1)
    return Bins([*(centres - 0.5).tolist(), highest + 0.5], centres.tolist())


def squares(corners: np.ndarray, size: tuple[int, int], side: int = SQUARE) -> np.ndarray:
    """Boxes (n, 4) int (x0, y0, x1, y1 px, end excluded): `side` px squares about corners (n, 2), cut at (rows, cols)."""
    first = np.floor(np.asarray(corners, float).reshape(-1, 2) - (side - 1) / 2).astype(int)
    limit = np.array([size[1], size[0]])
    return np.hstack([np.clip(first, 0, limit - 1), np.clip(first + side, 1, limit)])


def annotations(
    samples: Iterable[tuple[str, Sample]], bins: Bins, side: int = SQUARE
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The two COCO data sets, of sections and of corners, of named samples."""
    images, sections, corners = [], [], []
    for number, (name, sample) in enumerate(samples, start=1):
        rows, cols = sample.labels.shape
        images.append(
            {
                "id": number,
                "file_name": f"{name}.png",
                "width": cols,
                "height": rows,
                "geometry": [float(v) for v in sample.geometry],
            }
        )
        for label in np.unique(sample.labels[sample.labels > 0]).tolist():
            sections.append(_annotation(len(sections) + 1, number, SECTION, sample.labels == label))
        for roof in np.unique(sample.roof[sample.labels < 0]).tolist():
            where = (sample.labels < 0) & (sample.roof == roof)
            sections.append(_annotation(len(sections) + 1, number, SECTION, where, crowd=True) | {"roof": roof})
        boxes = squares(sample.corners, (rows, cols), side)
        kinds = bins.of(sample.corner_heights)
        for (x0, y0, x1, y1), kind, corner, height in zip(
            boxes.tolist(), kinds.tolist(), sample.corners, sample.corner_heights, strict=True
        ):
            where = np.zeros((rows, cols), bool)
            where[y0:y1, x0:x1] = True
            known = float(height) if np.isfinite(height) else None
            corners.append(
                _annotation(len(corners) + 1, number, kind + 1, where)
                | {"corner": [float(v) for v in corner], "height": known}
            )
        unknown = sample.corners_known == 0
        if unknown.any():
            corners.append(_annotation(len(corners) + 1, number, len(bins.centres) + 1, unknown, crowd=True))
    names = [f"{low:g}-{high:g} m" for low, high in zip(bins.edges[:-1], bins.edges[1:], strict=True)]
    info = {"bins": {"edges": list(bins.edges), "centres": list(bins.centres)}, "square": side}
    return (
        {"info": {}, "images": images, "annotations": sections, "categories": [{"id": SECTION, "name": "section"}]},
        {
            "info": info,
            "images": images,
            "annotations": corners,
            "categories": [{"id": i, "name": name} for i, name in enumerate([*names, "unknown height"], start=1)],
        },
    )


def _annotation(number: int, image: int, category: int, where: np.ndarray, crowd: bool = False) -> dict[str, Any]:
    from pycocotools import mask as masks

    code = masks.encode(np.asfortranarray(where.astype(np.uint8)))
    return {
        "id": number,
        "image_id": image,
        "category_id": category,
        "iscrowd": int(crowd),
        "area": float(masks.area(code)),
        "bbox": masks.toBbox(code).tolist(),
        "segmentation": {"size": list(code["size"]), "counts": code["counts"].decode("ascii")},
    }


def write(folder: str | Path, samples: Iterable[tuple[str, Sample]], bins: Bins, side: int = SQUARE) -> None:
    """Write images and both annotation files of named samples."""
    folder = Path(folder)

    def pictured() -> Iterator[tuple[str, Sample]]:
        for name, sample in samples:
            with store.whole(folder / "images" / f"{name}.png", summed=False) as temporary:
                cv2.imwrite(str(temporary), sample.rgb[..., ::-1])
            yield name, sample

    for kind, content in zip(("sections", "corners"), annotations(pictured(), bins, side), strict=True):
        store.write_json(folder / f"{kind}.json", content, summed=False)


def read(folder: str | Path, images: str | Path | None = None) -> Iterator[tuple[str, Sample]]:
    """Named samples of `sections.json` and, where it is there, `corners.json`, in order of their ids.

    Files of other makers are taken too: polygons as segmentations, corners without exact place (the middle of their box) and
    height (the centre of their bin), and so are squares that were moved or given another class since their exact values were
    written; where sections overlap the later annotation lies on top. Without `corners.json` corners
    are unknown; `images` is FOLDER/images unless given. Raises `BadAnnotations`.
    """
    folder = Path(folder)
    pictures = Path(images) if images else folder / "images"
    sections = _opened(folder / "sections.json")
    corners = _opened(folder / "corners.json") if (folder / "corners.json").is_file() else None
    by_name = {image["file_name"]: key for key, image in corners.imgs.items()} if corners else {}
    roofs = roofs_of(sections, folder / "sections.json")
    for key in sorted(sections.imgs):
        image = sections.imgs[key]
        rgb = cv2.imread(str(pictures / image["file_name"]), cv2.IMREAD_COLOR)
        if rgb is None or rgb.shape[:2] != (image["height"], image["width"]):
            found = "missing or unreadable" if rgb is None else f"{rgb.shape[1]}×{rgb.shape[0]} px"
            raise BadAnnotations(
                f"{pictures / image['file_name']} is {found}, {folder / 'sections.json'} speaks of "
                f"{image['width']}×{image['height']} px: put images and annotations of one export together"
            )
        sample = _with_sections(Sample.ground(np.ascontiguousarray(rgb[..., ::-1])), sections, key, roofs)
        sample = _with_corners(sample, corners, by_name.get(image["file_name"]))
        geometry = np.asarray(image.get("geometry", np.zeros(6)), np.float32)
        yield Path(image["file_name"]).stem, sample._replace(geometry=geometry)


def _opened(path: Path) -> COCO:
    """A COCO index without pycocotools' chatter; `BadAnnotations` for what is none."""
    from pycocotools.coco import COCO

    if not path.is_file():
        raise BadAnnotations(f"no {path}: give a folder with sections.json, corners.json and images/")
    content = store.read_json(path)
    if not isinstance(content, dict) or not {"images", "annotations", "categories"} <= set(content):
        raise BadAnnotations(f"{path} is no COCO data set: it needs images, annotations and categories")
    index = COCO()
    index.dataset = content
    images = {image["id"] for image in content["images"]}
    ids = [a["id"] for a in content["annotations"]]
    if len(images) < len(content["images"]) or len(set(ids)) < len(ids):
        raise BadAnnotations(f"{path} uses an id twice: number images and annotations anew")
    for annotation in content["annotations"]:
        if annotation["image_id"] not in images:
            raise BadAnnotations(f"{path}: annotation {annotation['id']} belongs to no image of the file")
    index.anns = {a["id"]: a for a in content["annotations"]}
    index.imgs = {image["id"]: image for image in content["images"]}
    index.cats = {c["id"]: c for c in content["categories"]}
    for annotation in content["annotations"]:
        index.imgToAnns[annotation["image_id"]].append(annotation)
    return index


def roofs_of(index: COCO, path: Path) -> set[int]:
    """The categories of roof sections: of several those that are called so (`ROOFS`). Raises `BadAnnotations` if none is."""
    names = {
        key: str(category.get("name", "")).strip().lower().replace(" ", "_") for key, category in index.cats.items()
    }
    found = {key for key, name in names.items() if len(names) == 1 or name in ROOFS}
    if not found:
        raise BadAnnotations(
            f"{path} has the categories {', '.join(sorted(names.values()))}: call that of roof sections one of {', '.join(ROOFS)}"
        )
    return found


def _with_sections(sample: Sample, index: COCO, key: int, roofs: set[int]) -> Sample:
    labels, roof = sample.labels.copy(), sample.roof.copy()
    number = 0
    for annotation in sorted(index.imgToAnns[key], key=lambda a: (-a.get("iscrowd", 0), a["id"])):
        if annotation["category_id"] not in roofs:
            continue
        where = index.annToMask(annotation) > 0
        if annotation.get("iscrowd", 0):
            labels[where], roof[where] = -1, annotation.get("roof", UNKNOWN)
        else:
            number += 1
            labels[where], roof[where] = number, 1
    return sample._replace(labels=labels, roof=roof)


def _with_corners(sample: Sample, index: COCO | None, key: int | None) -> Sample:
    known = np.full(sample.labels.shape, index is not None, np.uint8)
    if index is None or key is None:
        return sample._replace(corners_known=known)
    info = index.dataset.get("info", {})
    written = info.get("bins") or {}
    bins = paper_bins()._replace(**{key: written[key] for key in Bins._fields if key in written})
    classed = set(Bins._fields) <= set(written)  # else nobody knows which class an exact height belongs to
    side = info.get("square", SQUARE)
    places, heights = [], []
    for annotation in sorted(index.imgToAnns[key], key=lambda a: a["id"]):
        if annotation.get("iscrowd", 0):
            known[index.annToMask(annotation) > 0] = 0
            continue
        x, y, width, height = annotation["bbox"]
        box = np.array([x, y, x + width, y + height])
        exact = annotation.get("corner")
        moved = exact is None or np.abs(squares(np.array([exact]), known.shape, side)[0] - box).max() > UNMOVED
        places.append([x + width / 2, y + height / 2] if moved else exact)
        kind = annotation["category_id"] - 1
        told = np.array([annotation.get("height", np.nan)], float)  # None, null in the file, is NaN too
        middle = bins.centres[kind] if 0 <= kind < len(bins.centres) else np.nan
        same = bins.of(told)[0] == kind if classed else np.isfinite(told[0])
        heights.append(told[0] if same else middle)
    return sample._replace(
        corners=np.array(places, np.float32).reshape(-1, 2),
        corner_heights=np.array(heights, np.float32),
        corners_known=known,
    )


def main(argv: list[str] | None = None) -> None:
    """Write kept samples (npz) as COCO data sets, or COCO data sets as samples."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.coco", description=main.__doc__)
    parser.add_argument("--samples", required=True, help="folder of samples, *.npz")
    parser.add_argument("--coco", required=True, help="folder with sections.json, corners.json, images/")
    parser.add_argument("--to", choices=["coco", "samples"], default="coco")
    parser.add_argument("--square", type=int, default=SQUARE, help="side of a corner's square, px")
    parser.add_argument("--highest", type=int, default=19, help="highest of the paper's height classes, m")
    args = parser.parse_args(argv)
    if args.to == "samples":
        for name, sample in read(args.coco):
            sample.save(Path(args.samples) / f"{name}.npz")
        own = Path(args.samples).parent
        if (own / "own.json").is_file():  # a run that learned from them as they were has to know
            store.write_json(own / CORRECTED, contents(own), summed=False)
        return
    files = sorted(Path(args.samples).glob("[!.]*.npz"))
    if not files:
        raise photographs.NoTrainingData(
            f"{args.samples} holds no samples (*.npz): make some with kibs_steps.learn.own"
        )
    named = ((path.stem, Sample.load(path)) for path in files)
    write(args.coco, named, paper_bins(args.highest), args.square)


if __name__ == "__main__":
    cli.run(main)
