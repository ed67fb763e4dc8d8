"""Four images side by side on one canvas, each at a scale of its own: more sizes, places and surroundings of drogues.

Source of the idea: Bochkovskiy et al. 2020, arXiv:2004.10934, section 3.3; the seed paper trains with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nav.training.image_views import Boxes, ImageView, ViewRanges, Window, sample_view

TILES = 4
_CROSSING_RANGE = (0.3, 0.7)  # where the four meet, as shares of width and height; nearer to an edge one is a sliver


def sample_windows(rng: np.random.Generator, canvas_wh: tuple[int, int]) -> list[Window]:
    """Four rectangles that fill a canvas and meet in one point."""
    x, y = (round(rng.uniform(*_CROSSING_RANGE) * side) for side in canvas_wh)
    width, height = canvas_wh
    return [
        Window(0, 0, x, y),
        Window(x, 0, width - x, y),
        Window(0, y, x, height - y),
        Window(x, y, width - x, height - y),
    ]


def sample_mosaic(
    rng: np.random.Generator,
    source_whs: Sequence[tuple[int, int]],
    boxes: Sequence[Boxes],
    canvas_wh: tuple[int, int],
    ranges: ViewRanges,
) -> list[ImageView]:
    """A view of each of four images, one for each rectangle."""
    windows = sample_windows(rng, canvas_wh)
    return [
        sample_view(rng, source_wh, own, window, ranges)
        for source_wh, own, window in zip(source_whs, boxes, windows, strict=True)
    ]
