"""The surroundings at camera resolution: one image serves both eyes, for a rectified pair shares its ray directions."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from geometry.pinhole import PinholeCamera
from scenes.surroundings import Surroundings, surroundings

# The clear sky varies over many degrees; the paper's camera has 37 px a degree.
_COARSE_STEP_PX = 8
_MOST_BLUR_SAMPLES = 8


def _directions(camera: PinholeCamera, rotation: NDArray[np.float64], u: NDArray, v: NDArray) -> NDArray[np.float32]:  # type: ignore[type-arg]
    """(len(v), len(u), 3) unit directions in world axes through the grid of pixel coordinates u, v."""
    x = ((u - camera.cx_px) / camera.fx_px).astype(np.float32)
    y = ((v - camera.cy_px) / camera.fy_px).astype(np.float32)
    r = rotation.astype(np.float32)
    inverse_length = 1.0 / np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
    out = np.empty((len(v), len(u), 3), dtype=np.float32)
    for axis in range(3):
        out[..., axis] = (r[axis, 0] * x[None, :] + (r[axis, 1] * y + r[axis, 2])[:, None]) * inverse_length
    return out


def _sharp_background(
    around: Surroundings, camera: PinholeCamera, rotation: NDArray[np.float64]
) -> NDArray[np.float32]:
    step = _COARSE_STEP_PX
    columns, rows = camera.width_px // step + 4, camera.height_px // step + 4
    coarse = _directions(camera, rotation, (np.arange(columns) - 1.0) * step, (np.arange(rows) - 1.0) * step)
    # Full pixel u lies at coarse coordinate u / step + 1.
    to_coarse = np.array([[1 / step, 0.0, 1.0], [0.0, 1 / step, 1.0]])
    size = (camera.width_px, camera.height_px)
    sky, horizon = (
        np.maximum(cv2.warpAffine(image, to_coarse, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP), 0.0)
        for image in around.clear_radiance(coarse)
    )
    directions = _directions(
        camera, rotation, np.arange(camera.width_px, dtype=float), np.arange(camera.height_px, dtype=float)
    )
    image = around.radiance(directions, sky, horizon)
    around.sky.add_sun_disc(image, directions)
    return image


def background(frame: FrameSpec) -> NDArray[np.float32]:
    """What both eyes see where nothing stands before the surroundings.

    Returns:
        (H, W, 3) radiance at pixel centres, averaged over the exposure when the camera turns. [cd/m2]
    """
    around = surroundings(frame.environment)
    turn_px = float(np.linalg.norm(frame.left_twist_per_s[3:])) * frame.exposure.time_s * frame.rig.camera.fx_px
    samples = int(np.clip(np.ceil(2 * turn_px), 1, _MOST_BLUR_SAMPLES)) if turn_px > 0.1 else 1
    total: NDArray[np.float32] | None = None
    for index in range(samples):
        offset_s = ((index + 0.5) / samples - 0.5) * frame.exposure.time_s
        image = _sharp_background(around, frame.rig.camera, frame.world_from_left_at(offset_s).rotation)
        total = image if total is None else total + image
    assert total is not None
    return total / np.float32(samples)
