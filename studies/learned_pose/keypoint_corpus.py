"""Patches and true keypoints of a dataset, for the training and the test of keypoint networks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord, PixelBox
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from nav.detector.input_image import input_image
from studies.learned_pose.keypoint_crops import (
    CropView,
    Patch,
    build_crop,
    crop_from_patch,
    cut_patch,
    inverse_affine,
    map_points,
    sample_box,
)

# Of a normal distribution, its standard deviation over its median distance from the middle.
_SIGMA_PER_MEDIAN = 1.4826

CropKeypoints = Callable[[Sequence[NDArray[np.uint8]]], list[Array]]
"""Crops of both eyes to (K, 2) keypoints of each, in pixel-centre coordinates of the crops. [px of the crop]"""


@dataclass(frozen=True, eq=False)
class EyeSample:
    """The drogue in one image.

    Attributes:
        frame_index: of the pair.
        eye: which image.
        true_box_xywh_px: around the drogue's visible pixels.
        box_xywh_px: the one that a detector would give.
        patch: about the latter.
        markers_px: (N, 2) true centres of the markers' ellipses in the patch, in the drogue's order. [px of the patch]
    """

    frame_index: int
    eye: Eye
    true_box_xywh_px: PixelBox
    box_xywh_px: PixelBox
    patch: Patch
    markers_px: Array


def eye_sample(record: PairRecord, images: StereoImages, eye: Eye) -> EyeSample:
    """The drogue in one image of a pair, in a box with a detector's errors, the same in every call.

    Raises:
        ValueError: the image shows no drogue.
    """
    view = record.views.left if eye == "left" else record.views.right
    true_box = view.box_visible_xywh_px
    if true_box is None:
        raise ValueError(f"frame {record.frame_index}: the {eye} image shows no drogue")
    rng = frame_generator(record.frame.seed, record.frame_index, f"learned pose box {eye}")
    box = sample_box(rng, true_box)
    # At its own size this is only the encoding for a screen that all networks here see.
    image, _ = input_image(images, eye, images.size_px)
    patch = cut_patch(image, box)
    centers = np.array([marker.center_ellipse_px for marker in view.markers], dtype=np.float64)
    markers = map_points(inverse_affine(patch.image_from_patch), centers)
    return EyeSample(record.frame_index, eye, true_box, box, patch, markers)


def split_samples(dataset: Path, split: SplitName) -> Iterator[EyeSample]:
    """Both images of every pair of a split.

    Raises:
        ValueError: the dataset cannot be read, or an image shows no drogue.
    """
    source = Dataset(dataset)
    splits = source.manifest.split_of_frame()
    for index in source.frame_indices:
        if splits[index] == split:
            record, images = source.record(index), source.images(index)
            yield from (eye_sample(record, images, eye) for eye in EYES)


@dataclass(frozen=True, eq=False)
class KeypointCorpus:
    """Patches in memory.

    Attributes:
        patches: (S, PATCH_PX, PATCH_PX, 3).
        markers_px: (S, N, 2) true centres in the patches. [px of the patch]
    """

    patches: NDArray[np.uint8]
    markers_px: Array

    def __len__(self) -> int:
        return len(self.patches)


def load_corpus(dataset: Path, split: SplitName) -> KeypointCorpus:
    """A split of a dataset.

    Raises:
        ValueError: the split is empty, the dataset cannot be read, or an image shows no drogue.
    """
    samples = list(split_samples(dataset, split))
    if not samples:
        raise ValueError(f"{dataset}: has no pairs in the split {split}")
    return KeypointCorpus(
        np.stack([sample.patch.pixels for sample in samples]), np.stack([sample.markers_px for sample in samples])
    )


def keypoint_sigma_px(find: CropKeypoints, corpus: KeypointCorpus) -> float:
    """Robust standard deviation of a coordinate of keypoints from the nearest true markers. [px of the crop]

    Raises:
        ValueError: no keypoint is found.
    """
    view, gaps = CropView(), []
    for first in range(0, len(corpus), len(EYES)):
        pair = slice(first, first + len(EYES))
        markers = map_points(crop_from_patch(view), corpus.markers_px[pair])
        found = find([build_crop(patch, view) for patch in corpus.patches[pair]])
        for points, true_points in zip(found, markers, strict=True):
            offsets = points[:, None] - true_points
            nearest = np.argmin((offsets**2).sum(axis=-1), axis=1)
            gaps.append(offsets[np.arange(len(points)), nearest])
    distances = np.abs(np.concatenate(gaps))
    if not distances.size:
        raise ValueError("keypoints: none is found in the validation split")
    return _SIGMA_PER_MEDIAN * float(np.median(distances))
