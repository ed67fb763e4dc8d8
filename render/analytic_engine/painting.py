"""Areas become light: every part in its even radiance, weighted by the exact coverage of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.se3 import Array
from render.analytic_engine.pixel_coverage import pixel_coverage

_NO_AREA = shapely.Polygon()


def paint(
    moments: Sequence[dict[int, Any]], radiance: dict[int, Array], behind: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Parts over the surroundings.

    Args:
        moments: areas by part id (see `outlines.seen_areas`), at evenly spaced moments of the exposure.
        radiance: (3,) radiance by part id. [cd/m2]
        behind: (H, W, 3) radiance of the surroundings. [cd/m2]

    Returns:
        (H, W, 3) radiance [cd/m2], and (H, W) share of each pixel that parts cover.
    """
    height_px, width_px = behind.shape[:2]
    coverage = np.zeros((height_px, width_px), dtype=np.float32)
    painted = []
    for part in dict.fromkeys(part for areas in moments for part in areas):
        covered = pixel_coverage([areas.get(part, _NO_AREA) for areas in moments], width_px, height_px)
        if covered is not None:
            share = covered.share.astype(np.float32)
            painted.append((part, covered.rows, covered.columns, share))
            if _painted_on(part) == Part.SKY:
                coverage[covered.rows, covered.columns] += share
    image = behind.copy()
    for part, rows, columns, _ in painted:
        if _painted_on(part) == Part.SKY:
            # Windows may overlap: the pixels are weighted anew from the surroundings.
            open_share = 1.0 - coverage[rows, columns]
            for channel in range(3):
                np.multiply(behind[rows, columns, channel], open_share, out=image[rows, columns, channel])
    for part, rows, columns, share in painted:
        under = _painted_on(part)
        adds = (radiance[part] - (radiance[under] if under != Part.SKY else 0.0)).astype(np.float32)
        # By channel: a product over (h, w, 1) and (3,) takes three times as long.
        for channel in range(3):
            image[rows, columns, channel] += share * adds[channel]
    return image, coverage


def _painted_on(part: int) -> int:
    """The part whose light a part replaces."""
    if part == Part.HUB:
        return int(Part.COUPLING)
    return int(Part.FACE) if part >= FIRST_MARKER_ID else int(Part.SKY)
