"""What an export for screens has to show of stored pixel values, by the formula of the standard."""

from __future__ import annotations

import numpy as np

from datasets_manifest.storage.reader import Dataset


def shown(stored: np.ndarray, source: Dataset, frame_index: int, levels: int = 255) -> np.ndarray:
    """Linear pixel values on the sRGB curve (IEC 61966-2-1), 0 at the black level of the pair."""
    sensor = source.manifest.recipe.sensor
    assert sensor.encoding == "linear"
    black = source.record(frame_index).image_black_level_dn
    light = np.maximum((stored.astype(float) - black) / (2**sensor.output_bits - 1 - black), 0.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(levels * level).astype(np.uint8 if levels == 255 else np.uint16)
