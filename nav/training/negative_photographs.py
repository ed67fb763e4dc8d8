"""Photographs without a drogue, in which a network learns to find none."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.importers.photographs import find_photographs, shown_photograph
from nav.training.augmentation import Image
from nav.training.training_settings import SizePx

# A photograph of at least so many times the network's input is also used in quarters, in which details stay visible.
_QUARTERED_FROM = 1.5
# A picture is a strip where less than one part in so many of it fills the input.
_STRIP, _MARGIN_PX = 16, 2


@dataclass(frozen=True, eq=False)
class Photographs:
    """Cut-outs of photographs that show no drogue.

    Attributes:
        images: (N, H, W, 3) red, green, blue, encoded for a screen.
        sha256: of size and pixels.
    """

    images: NDArray[np.uint8]
    sha256: str


def read_photographs(folder: Path, size_px: SizePx) -> Photographs:
    """The photographs in a folder and the folders in it, at the size of the network's input.

    Each fills the input and is cropped to its shape; a large one is also taken in four quarters.

    Args:
        folder: of files that `find_photographs` finds.
        size_px: (height, width) of the network's input.

    Raises:
        ValueError: no pictures, or one that cannot be read; names the file.
    """
    images = np.stack([cut for path in find_photographs(folder) for cut in _cut_outs(shown_photograph(path), size_px)])
    digest = hashlib.sha256(str(images.shape).encode())
    digest.update(images.data)
    return Photographs(images, digest.hexdigest())


def _cut_outs(picture: NDArray[np.uint8], size_px: SizePx) -> Iterator[Image]:
    if picture.ndim == 2:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    yield _filled(picture, size_px)
    height, width = picture.shape[:2]
    if min(height / size_px[0], width / size_px[1]) >= _QUARTERED_FROM:
        for rows in (slice(0, height // 2), slice(height // 2, height)):
            for columns in (slice(0, width // 2), slice(width // 2, width)):
                yield _filled(picture[rows, columns], size_px)


def _filled(picture: Image, size_px: SizePx) -> Image:
    """The middle of a picture, as large as it fills the size."""
    # Of a strip, only so much of the middle is enlarged as may be seen.
    height, width = picture.shape[:2]
    rows, columns = (
        min(side, math.ceil(other * wanted / beside) + _MARGIN_PX)
        for side, other, wanted, beside in ((height, width, *size_px), (width, height, *reversed(size_px)))
    )
    if rows < height / _STRIP or columns < width / _STRIP:
        top, left = (height - rows) // 2, (width - columns) // 2
        picture = picture[top : top + rows, left : left + columns]
    scale = max(size_px[0] / picture.shape[0], size_px[1] / picture.shape[1])
    shape = tuple(max(round(side * scale), wanted) for side, wanted in zip(picture.shape[:2], size_px, strict=True))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(np.ascontiguousarray(picture), (shape[1], shape[0]), interpolation=interpolation)
    top, left = (shape[0] - size_px[0]) // 2, (shape[1] - size_px[1]) // 2
    return np.asarray(resized[top : top + size_px[0], left : left + size_px[1]], dtype=np.uint8)
