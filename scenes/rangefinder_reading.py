"""Drawing what a laser rangefinder reads."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.rangefinder import Rangefinder


def sample_reading_m(rangefinder: Rangefinder, seed: int, frame_index: int, distance_m: float) -> float:
    """The reading at one distance: the same offset in all frames of a dataset, noise of each frame's own. [m]"""
    offset_m = frame_generator(seed, 0, "rangefinder offset").uniform(-1.0, 1.0) * rangefinder.offset_m
    noise_m = frame_generator(seed, frame_index, "rangefinder noise").standard_normal() * rangefinder.noise_m
    reading_m, step_m = distance_m + offset_m + noise_m, rangefinder.resolution_m
    # Decimal digits rather than a multiple of a step that float64 cannot hold.
    return float(np.round(step_m * np.rint(reading_m / step_m), 12)) if step_m > 0 else float(reading_m)
