"""Pictures of nothing but a ground, to paste drogues on: drawings, haze and walls have no more behind a drogue."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

_SIDE_PX = 480
_LEVELS_DN = (10.0, 245.0)


def write_plain_grounds(folder: Path, count: int) -> None:
    """Grounds of one colour, and grounds that fade from one into another, as PNG.

    Args:
        folder: made if missing; files in it are overwritten.
        count: how many; every third is even, and every second grey.

    Raises:
        OSError: a picture cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for number in range(count):
        first, last = rng.uniform(*_LEVELS_DN, (2, 1 if number % 2 else 3))
        share = np.linspace(0, 0 if number % 3 == 0 else 1, _SIDE_PX)[:, None, None]
        ground = np.broadcast_to(first + share * (last - first), (_SIDE_PX, _SIDE_PX, 3))
        turned = np.rot90(np.rint(ground).astype(np.uint8), int(rng.integers(4)))
        if not cv2.imwrite(str(folder / f"{number:03d}.png"), np.ascontiguousarray(turned)):
            raise OSError(f"{folder}: a picture cannot be written")
