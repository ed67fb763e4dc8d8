from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from geometry.pinhole import PinholeCamera
from geometry.se3 import exp_twist

CAMERA = PinholeCamera(1280, 960, 2133.0, 2140.0, 639.5, 470.25)


def sample_points_m(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.3, -0.2, 1.5], [0.3, 0.2, 40.0], size=(count, 3))
    points[:, :2] *= points[:, 2:]
    return points


def test_projection_agrees_with_opencv() -> None:
    camera_from_object = exp_twist([0.1, -0.2, 0.3, 0.2, -0.1, 0.05])
    points = camera_from_object.inverse().apply(sample_points_m(500))
    rvec = cv2.Rodrigues(camera_from_object.rotation)[0]
    expected, _ = cv2.projectPoints(points, rvec, camera_from_object.translation_m, CAMERA.matrix(), None)
    # Pixel coordinates up to 1e3 and two conversions of the rotation in float64.
    np.testing.assert_allclose(CAMERA.project(camera_from_object.apply(points)), expected[:, 0], rtol=0, atol=1e-9)


def test_rays_are_the_inverse_of_projection() -> None:
    points = sample_points_m(100)
    rays = CAMERA.rays(CAMERA.project(points))
    np.testing.assert_allclose(rays * points[:, 2:], points, rtol=0, atol=1e-12)  # 40 m in float64


def test_axis_meets_the_principal_point() -> None:
    np.testing.assert_array_equal(CAMERA.project([0.0, 0.0, 3.0]), [639.5, 470.25])


def test_image_ends_half_a_pixel_outside_the_outer_centres() -> None:
    corners = [[-0.5, -0.5], [1279.5, 959.5], [-0.51, 0.0], [0.0, 959.51], [5.0, 5.0]]
    assert CAMERA.contains(corners).tolist() == [True, True, False, False, True]
    assert CAMERA.contains(corners, margin_px=6.0).tolist() == [False] * 5


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("width_px", 0, "width_px, height_px: must be positive whole numbers"),
        ("fx_px", 0.0, "fx_px, fy_px: must be positive and finite"),
        ("fy_px", -1.0, "fx_px, fy_px: must be positive and finite"),
        ("fx_px", float("nan"), "fx_px, fy_px: must be positive and finite"),
        ("fy_px", float("inf"), "fx_px, fy_px: must be positive and finite"),
        ("cx_px", float("nan"), "cx_px, cy_px: must be finite, got nan, 470.25"),
        ("cy_px", float("inf"), "cx_px, cy_px: must be finite, got 639.5, inf"),
    ],
)
def test_impossible_cameras_are_refused(name: str, value: float, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        replace(CAMERA, **{name: value})


@pytest.mark.parametrize("size", [float("nan"), 1280.5, 1280.0, True, "1280"])
def test_sizes_are_whole_numbers(size: Any) -> None:
    for name in ("width_px", "height_px"):
        with pytest.raises(ValueError, match="width_px, height_px: must be positive whole numbers"):
            replace(CAMERA, **{name: size})
    assert replace(CAMERA, width_px=np.int64(640)).width_px == 640
