"""Examples: a sample made into what a network is shown and what it is asked for.

In: samples (`learn.samples`). Out: image, geometry and targets by name, arrays that a DataLoader can stack.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage
from torch.utils.data import Dataset

from kibs_steps.blend import blend
from kibs_steps.learn import dataset, maskrcnn, targets
from kibs_steps.learn.architectures import SURFACES
from kibs_steps.learn.samples import Sample

DISTANCE_CLIP = 5.0  # px
BLEND = {"inside": [None, None, 255], "rim": [None, None, 128], "outside": [None, None, 0]}
BLENDED = {"sections": 0.0, "both": 0.4, "corners": 1.0}  # share of tiles that are shown blended


class Examples(Dataset):
    """Tiles of a mixture with their targets, as arrays a DataLoader can stack."""

    def __init__(self, mixture: dataset.Mixture, family: str, task: str):
        self.mixture, self.family, self.task = mixture, family, task

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self.mixture.seed, index, 1])
        return example_of(self.mixture[index], rng, self.family, self.task)


def example(sample: Sample, rng: np.random.Generator, blended: bool, task: str = "both") -> dict[str, np.ndarray]:
    """Image, plain or blended with sections as a model might find them, geometry and the targets of a task.

    A blended image shows the sections: what it is asked for is corners and heights.
    """
    size = sample.labels.shape
    found = {
        "image": (painted(sample, rng) if blended else sample.rgb).transpose(2, 0, 1).copy(),
        "geometry": sample.geometry,
        "surface": targets.surface(sample.surface, SURFACES),
        "slope": targets.slope(sample.labels, sample.height),
    }
    if task != "corners":
        plain = np.float32(not blended)
        found |= {
            "roof": np.where(blended, np.uint8(targets.IGNORED), sample.roof),
            "edge": targets.edge(sample.labels),
            "distance": targets.distance(sample.labels, DISTANCE_CLIP),
            "centre": targets.centre(sample.labels),
            "sections_known": plain * (sample.labels >= 0).astype(np.float32) * targets.section_weight(sample.labels),
        }
    if task != "sections":
        found |= {
            "heat": targets.corner_heat(sample.corners, size),
            "offset": targets.corner_offset(sample.corners, size),
            "corners_known": sample.corners_known,
            "corner_height": targets.corner_height(sample.corners, sample.corner_heights, size),
            "roof_height": targets.roof_height(sample.height),
        }
    return found


def example_of(sample: Sample, rng: np.random.Generator, family: str, task: str) -> dict[str, np.ndarray]:
    """The example of a sample that a run's family and task learn from."""
    if family == "maskrcnn":
        return maskrcnn.example(sample, task, supposed(sample, rng))
    return example(sample, rng, bool(rng.random() < BLENDED[task]), task)


def painted(sample: Sample, rng: np.random.Generator) -> np.ndarray:
    """The image (s, s, 3) uint8 blended with sections as a model might find them."""
    return blend(sample.rgb, supposed(sample, rng), **BLEND)


def supposed(sample: Sample, rng: np.random.Generator) -> np.ndarray:
    """Section labels (s, s) as a model might find them: mostly wrong in the ways models are wrong."""
    labels = np.maximum(sample.labels, 0)
    areas = ndimage.label((sample.labels < 0) & (sample.roof == 1))[0]
    labels = np.where(areas > 0, areas + labels.max(), labels).astype(np.int32)
    if rng.random() < 0.85:
        labels = targets.perturbed(labels, rng)
    return labels
