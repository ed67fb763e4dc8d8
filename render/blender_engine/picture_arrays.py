"""Blender's pictures as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from render.blender_engine.messages import NORMAL_PASS, Window

# Blender's depth where there is nothing is 1e10.
_NOTHING_M = 1e9


@dataclass(frozen=True, eq=False)
class CenterPixels:
    """What the pixel centres of a window meet.

    Attributes:
        part_id: (h, w) uint8, 0 for nothing.
        depth_m: (h, w) planar depth, inf for nothing. [m]
        normal: (h, w, 3) of the face, in the stage's axes.
    """

    part_id: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    normal: NDArray[np.float32]


def _channels(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels of all parts by their names, without the layer's."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found: dict[str, Any] = {}
        for part in file.parts:
            found |= {name.split(".", 1)[-1]: channel.pixels for name, channel in part.channels.items()}
    return found


def read_light(path: Path) -> NDArray[np.float32]:
    """(h, w, 4) light weighted by coverage, and coverage."""
    found = _channels(path)
    return np.stack([found[f"Combined.{channel}"] for channel in "RGBA"], axis=-1)


def read_passes(path: Path) -> CenterPixels:
    """Part ids, depth and normals."""
    found = _channels(path)
    part_id = np.rint(found["Object Index.X"]).astype(np.uint8)
    depth = found["Depth.Z"]
    normal = np.stack([found[f"{NORMAL_PASS}.{axis}"] for axis in "RGB"], axis=-1)
    return CenterPixels(
        part_id,
        np.where(depth < _NOTHING_M, depth, np.inf).astype(np.float32),
        normal,
    )


def place(whole: NDArray[Any], window: Window, values: NDArray[Any]) -> None:
    """Put a window's pixels into the image, in place."""
    rows = slice(window.top_px, window.top_px + window.height_px)
    columns = slice(window.left_px, window.left_px + window.width_px)
    whole[rows, columns] = values
