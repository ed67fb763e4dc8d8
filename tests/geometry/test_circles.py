from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.random import Generator

from geometry.circles import disc_area_px2, disc_outline, ellipse_center_points, project_disc_centers
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, Eye, paper_rig

RIG = paper_rig()


def sample_pose(rng: Generator) -> RigidTransform:
    depth = rng.uniform(1.7, 40.0)
    pitch, yaw = rng.uniform(-0.5, 0.5, size=2)
    x, y = rng.uniform(-0.15, 0.15, size=2) * depth
    return RigidTransform(rotation_from_angles(pitch, yaw, rng.uniform(-3, 3)), np.array([x, y, depth]))


def outline_px(pose: RigidTransform, center_m: np.ndarray, radius_m: float, eye: Eye, count: int) -> np.ndarray:
    return RIG.project(disc_outline(pose, center_m, radius_m, count), eye)


def conic_center(points_px: np.ndarray) -> np.ndarray:
    """Centre of the conic through the points, from the null space of its five-parameter equation."""
    middle, scale = points_px.mean(axis=0), np.ptp(points_px)
    x, y = ((points_px - middle) / scale).T
    a, b, c, d, e, _ = np.linalg.svd(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1))[2][-1]
    return middle + scale * np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])


def polygon_area_px2(points_px: np.ndarray) -> float:
    x, y = (points_px - points_px.mean(axis=0)).T
    return float(abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2)


@pytest.mark.parametrize(("depth_m", "offset_px"), [(2.0, 0.2280), (1.5, 0.4054)])
def test_offset_of_the_specification(depth_m: float, offset_px: float) -> None:
    pose = RigidTransform(rotation_from_angles(np.radians(10), 0.0, 0.0), np.array([0.0, 0.0, depth_m]))
    center = project_disc_centers(RIG, pose, np.zeros((1, 3)), 0.05, "left")[0]
    # Printed to four decimals.
    assert np.linalg.norm(center - RIG.project(pose.translation_m, "left")) == pytest.approx(offset_px, abs=5e-5)


def test_center_is_that_of_the_conic_through_the_outline() -> None:
    rng = np.random.default_rng(20)
    for _ in range(50):
        pose = sample_pose(rng)
        center = np.array([*rng.uniform(-0.28, 0.28, size=2), rng.uniform(0.0, 0.25)])
        for eye in EYES:
            expected = conic_center(outline_px(pose, center, 0.05, eye, 64))
            got = project_disc_centers(RIG, pose, center[None], np.array([0.05]), eye)[0]
            # Pixels of 1e3 are rounded to 1e-13; the fit of an ellipse a few pixels wide amplifies it.
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9)


def test_center_is_that_of_opencv_s_ellipse() -> None:
    pose = RigidTransform(rotation_from_angles(0.3, -0.2, 0.1), np.array([0.2, -0.1, 2.0]))
    center = np.array([0.0, 0.27, 0.0])
    fitted = cv2.fitEllipseDirect(outline_px(pose, center, 0.05, "left", 720).astype(np.float32))[0]
    got = project_disc_centers(RIG, pose, center[None], np.array([0.05]), "left")[0]
    # OpenCV takes and returns float32: 6e-5 px at 1000 px, averaged and rounded once more.
    np.testing.assert_allclose(got, fitted, rtol=0, atol=2e-4)


def test_offset_falls_with_the_square_of_the_distance() -> None:
    depths = np.array([2.0, 4.0, 8.0, 16.0, 32.0])
    offsets = []
    for depth in depths:
        pose = RigidTransform(rotation_from_angles(0.15, 0.0, 0.0), np.array([0.0, 0.0, depth]))
        center = project_disc_centers(RIG, pose, np.zeros((1, 3)), 0.05, "left")[0]
        offsets.append(np.linalg.norm(center - RIG.project(pose.translation_m, "left")))
    # On the axis the law's next order is (r sin(tilt) / Z)^2, 1.4e-5 at 2 m.
    assert np.polyfit(np.log(depths), np.log(offsets), 1)[0] == pytest.approx(-2.0, abs=1e-5)


def test_sign_of_the_normal_does_not_matter() -> None:
    rng = np.random.default_rng(21)
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centers = rng.uniform([-1, -1, 2], [1, 1, 9], size=(20, 3))
    np.testing.assert_array_equal(
        ellipse_center_points(centers, normals, 0.05), ellipse_center_points(centers, -normals, 0.05)
    )


def test_facing_disc_keeps_its_centre() -> None:
    centers = np.array([[0.3, -0.2, 2.0]])
    np.testing.assert_array_equal(ellipse_center_points(centers, [[0.0, 0.0, 1.0]], 0.05), centers)


def test_area_is_that_of_the_outline() -> None:
    rng = np.random.default_rng(22)
    count = 4096
    for _ in range(30):
        pose = sample_pose(rng)
        center = np.array([0.0, 0.27, 0.0])
        for eye in EYES:
            polygon = polygon_area_px2(outline_px(pose, center, 0.05, eye, count))
            # An inscribed polygon misses (2 pi / n)^2 / 6 of the area, up to perspective's uneven spacing.
            missing = (2 * np.pi / count) ** 2 / 6
            assert disc_area_px2(RIG, pose, center, 0.05, eye) == pytest.approx(polygon, rel=2 * missing)
