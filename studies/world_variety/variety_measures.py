"""Numbers for the variety of a dataset: its drogues' looks, its tankers' silhouettes, the place of its probes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from skimage.feature import hog

from drogue_models.parts import Part
from droguekit.api.stereo_dataset import StereoDataset, StereoPair
from droguekit.scoring.report.label_drawing import display_picture

CROP_PX = 64
"""Side of the square to which drogues are scaled."""
# Share of the box that is shown around it on every side.
_MARGIN = 0.1
# Drogues of fewer pixels across say nothing of their build.
_SMALLEST_PX = 24
_SILHOUETTE_PX = 48
# Tankers whose scaled silhouettes share less than this of their union count as two.
_SAME_IOU = 0.7
# A tanker of which less is in view shows no silhouette.
_LEAST_TANKER_PX = 400


@dataclass(frozen=True, eq=False)
class Variety:
    """Variety of the left images of a dataset.

    Attributes:
        pairs: number of pairs.
        drogues: number of drogues that are large enough to compare.
        drogue_distance: mean distance between the embeddings of two drogues; 0 for equal looks, sqrt(2) at most.
        drogue_distance_p10: its tenth percentile: how near the nearer pairs are.
        tankers: number of tankers in view.
        silhouettes: number of distinct silhouettes among them.
        probes: number of probes in view.
        probe_sd_px: standard deviations of the middle of the probe's box, x and y. [px]
    """

    pairs: int
    drogues: int
    drogue_distance: float
    drogue_distance_p10: float
    tankers: int
    silhouettes: int
    probes: int
    probe_sd_px: tuple[float, float]


def measure_variety(dataset: StereoDataset) -> Variety:
    """Variety of a dataset that has its truth.

    Raises:
        ValueError: a file is missing or damaged, or fewer than two drogues are large enough.
    """
    crops = [crop for pair in dataset if (crop := drogue_crop(pair)) is not None]
    if len(crops) < 2:
        raise ValueError(f"{dataset.path}: has {len(crops)} drogues of at least {_SMALLEST_PX} px; needs two")
    distances = pdist(np.stack([embedding(crop) for crop in crops]))
    tankers = [
        mask for pair in dataset if (mask := _scaled_silhouette(pair.part_ids["left"] == Part.TANKER)) is not None
    ]
    probes = [_middle_px(seen) for pair in dataset if (seen := pair.part_ids["left"] == Part.PROBE).any()]
    middles = np.array(probes).reshape(-1, 2)
    spread = middles.std(axis=0, ddof=1) if len(middles) > 1 else np.zeros(2)
    return Variety(
        pairs=len(dataset),
        drogues=len(crops),
        drogue_distance=float(distances.mean()),
        drogue_distance_p10=float(np.percentile(distances, 10)),
        tankers=len(tankers),
        silhouettes=distinct_silhouettes(tankers),
        probes=len(middles),
        probe_sd_px=(float(spread[0]), float(spread[1])),
    )


def _middle_px(seen: NDArray[np.bool_]) -> tuple[float, float]:
    """Middle of the box around a mask, x and y. [px]"""
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return float(columns[0] + columns[-1]) / 2, float(rows[0] + rows[-1]) / 2


def drogue_crop(pair: StereoPair) -> NDArray[np.float32] | None:
    """(64, 64) the visible drogue of the left image in grey, from 0 to 1; None where there is none, or a small one."""
    box = pair.record.views.left.box_visible_xywh_px
    if box is None or min(box[2:]) < _SMALLEST_PX:
        return None
    x, y, width, height = box
    side = max(width, height) * (1 + 2 * _MARGIN)
    middle = x + width / 2, y + height / 2
    scale = CROP_PX / side
    shift = np.array([[scale, 0.0, CROP_PX / 2 - scale * middle[0]], [0.0, scale, CROP_PX / 2 - scale * middle[1]]])
    grey = cv2.cvtColor(display_picture(pair.images), cv2.COLOR_RGB2GRAY).astype(np.float32)
    # Blurred before it shrinks, so that struts do not alias.
    sigma = 0.4 / scale
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma) if sigma > 0.5 else grey
    crop = cv2.warpAffine(smooth, shift, (CROP_PX, CROP_PX), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    low, high = float(crop.min()), float(crop.max())
    result: NDArray[np.float32] = ((crop - low) / max(high - low, 1e-6)).astype(np.float32)
    return result


def embedding(crop: NDArray[np.float32]) -> NDArray[np.float64]:
    """Histograms of oriented gradients of a (64, 64) crop, as a vector of length 1 (doi:10.1109/CVPR.2005.177)."""
    vector = hog(crop, orientations=9, pixels_per_cell=(8, 8), cells_per_block=(2, 2), block_norm="L2-Hys")
    length = float(np.linalg.norm(vector))
    unit: NDArray[np.float64] = vector / length if length > 0 else vector
    return unit


def distinct_silhouettes(masks: list[NDArray[np.bool_]]) -> int:
    """How many of equally large masks differ from all earlier ones that were counted."""
    counted: list[NDArray[np.bool_]] = []
    for mask in masks:
        if all(float((mask & other).sum() / (mask | other).sum()) < _SAME_IOU for other in counted):
            counted.append(mask)
    return len(counted)


def _scaled_silhouette(seen: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """(48, 48) a silhouette scaled to the square, or None where too little is in view."""
    if int(seen.sum()) < _LEAST_TANKER_PX:
        return None
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    part = seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.float32)
    side = max(part.shape)
    square = np.zeros((side, side), dtype=np.float32)
    square[: part.shape[0], : part.shape[1]] = part
    scaled: NDArray[np.bool_] = cv2.resize(square, (_SILHOUETTE_PX,) * 2, interpolation=cv2.INTER_AREA) > 0.5
    return scaled if scaled.any() else None
