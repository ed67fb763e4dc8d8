"""How pictures look, as a few numbers, and which of a dataset's pictures a photograph is nearest to, if any is near.

The numbers say nothing of what is in the picture. They are about light, colour, sharpness and noise, by which pictures
of a camera differ from those that a network was trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import Pixels
from droguekit.batch.progress import ProgressReport
from droguekit.scoring.report.label_drawing import display_picture
from geometry.se3 import Array

LOOKS = (
    "brightness",
    "contrast",
    "saturation",
    "warmth",
    "share of black",
    "share of white",
    "detail",
    "noise",
    "slope",
)
"""What is measured, in the order of the numbers."""
_MORE = (
    *("brighter", "of more contrast", "more colourful", "warmer in colour", "with more black", "with more white"),
    *("of more detail", "noisier", "darker below than above"),
)
_LESS = (
    *("darker", "of less contrast", "paler", "colder in colour", "with less black", "with less white"),
    *("of less detail", "less noisy", "brighter below than above"),
)
# Strips are made shorter than they are.
_WIDTH_PX, _TALLEST_PX = 256, 2048
_BLACK, _WHITE = 0.05, 0.95
# A level step of 8 bits, below which detail and noise cannot be told from rounding.
_STEP = 1.0 / 255.0
_COVERED_QUANTILE, _LEAST_REACH = 0.95, 1e-9
_MOST_PICTURES = 240


def measure_looks(picture: Pixels) -> Array:
    """(9,) numbers of `LOOKS` of a picture for screens; those of detail and noise are decadic logarithms.

    Noise is Immerkaer's estimate (1996, doi:10.1006/cviu.1996.0060), here of the median, so that edges count less.

    Args:
        picture: (H, W, 3) red, green, blue, or (H, W) grey, uint8 on the sRGB curve.
    """
    color = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture
    grey = color.mean(axis=2, dtype=np.float32) / np.float32(255.0)
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6.0
    noise = float(np.median(np.abs(cv2.filter2D(grey, -1, kernel)))) / 0.6745
    size = _WIDTH_PX, min(max(2, round(_WIDTH_PX * grey.shape[0] / grey.shape[1])), _TALLEST_PX)
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)
    light = small.mean(axis=2)
    detail = float((light - cv2.GaussianBlur(light, (0, 0), 2.0)).std())
    middle = size[1] // 2
    return np.array(
        [
            light.mean(),
            light.std(),
            (small.max(axis=2) - small.min(axis=2)).mean(),
            small[..., 0].mean() - small[..., 2].mean(),
            (light < _BLACK).mean(),
            (light > _WHITE).mean(),
            np.log10(detail + _STEP),
            np.log10(noise + _STEP),
            light[:middle].mean() - light[middle:].mean(),
        ],
        dtype=np.float64,
    )


@dataclass(frozen=True, eq=False)
class Likeness:
    """How a picture compares with those of a dataset.

    Attributes:
        family: of the picture that looks most like it.
        distance: to that one over the distance within which 95 % of the dataset's own pictures have a neighbour of
            another scene; above 1 no condition of the dataset is near.
        difference: in words, by what it differs most from all of them; None where something is near.
    """

    family: str
    distance: float
    difference: str | None

    @property
    def is_covered(self) -> bool:
        """Whether a picture of the dataset looks like it."""
        return self.difference is None


class KnownLooks:
    """The looks of a dataset's pictures, by family of conditions.

    Args:
        looks: (N, 9) of the pictures.
        families, scenes: of each.

    Raises:
        ValueError: the pictures are of fewer than two scenes.
    """

    def __init__(self, looks: Array, families: Sequence[str], scenes: Sequence[int]) -> None:
        self.families = tuple(families)
        scene = np.asarray(scenes)
        if len(np.unique(scene)) < 2:
            raise ValueError("must have pictures of two scenes or more to tell how alike its own are")
        # A number that hardly varies must not decide by its last digits.
        self._scale = np.maximum(looks.std(axis=0), 0.02)
        self._mean = looks.mean(axis=0)
        self._looks = (looks - self._mean) / self._scale
        gaps = np.linalg.norm(self._looks[:, None] - self._looks[None], axis=2)
        gaps[scene[:, None] == scene[None]] = np.inf
        # Pictures that are all alike are near one another, and nothing else is.
        self._reach = max(float(np.quantile(gaps.min(axis=1), _COVERED_QUANTILE)), _LEAST_REACH)

    def likeness(self, looks: Array) -> Likeness:
        """How a picture of (9,) looks compares with these."""
        own = (looks - self._mean) / self._scale
        gaps = np.linalg.norm(self._looks - own, axis=1)
        nearest = int(np.argmin(gaps))
        distance = float(gaps[nearest]) / self._reach
        if distance <= 1.0:
            return Likeness(self.families[nearest], distance, None)
        beyond = np.maximum(self._looks.min(axis=0) - own, own - self._looks.max(axis=0))
        if beyond.max() > 0:
            place = int(np.argmax(beyond))
            word = (_MORE if own[place] > 0 else _LESS)[place]
            return Likeness(self.families[nearest], distance, f"{word} than all of them")
        place = int(np.argmax(np.abs(self._looks[nearest] - own)))
        word = (_MORE if own[place] > self._looks[nearest, place] else _LESS)[place]
        return Likeness(self.families[nearest], distance, f"{word} than the nearest, in a mixture that none has")


def known_looks(dataset: Dataset, report: ProgressReport) -> KnownLooks:
    """The looks of up to 240 left pictures of a dataset, spread over it.

    Raises:
        ValueError: there are no pictures, one or its record cannot be read, the record was changed, or all are of one
            scene; names the dataset.
    """
    indices = dataset.frame_indices
    if not indices:
        raise ValueError(f"{dataset.path}: holds no pairs yet")
    chosen: list[int] = [indices[k * len(indices) // _MOST_PICTURES] for k in range(_MOST_PICTURES)]
    chosen = sorted(set(chosen if len(indices) > _MOST_PICTURES else indices))
    looks, families, scenes = list[NDArray[np.float64]](), list[str](), list[int]()
    report.begin("known pictures", len(chosen))
    try:
        for index in chosen:
            record = dataset.unchanged_record(index)
            looks.append(measure_looks(display_picture(dataset.images(index))))
            families.append(record.conditions.family)
            scenes.append(record.scene_id)
            report.advance()
    finally:
        report.end()
    try:
        return KnownLooks(np.array(looks).reshape(-1, len(LOOKS)), families, scenes)
    except ValueError as error:
        raise ValueError(f"{dataset.path}: {error}") from error
