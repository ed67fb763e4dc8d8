"""Crops: where a point of the image lies in them, whatever the augmentation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from studies.learned_pose.keypoint_corpus import EyeSample
from studies.learned_pose.keypoint_crops import (
    CROP_PX,
    PATCH_PX,
    CropView,
    build_crop,
    crop_from_patch,
    cut_patch,
    image_from_crop,
    inverse_affine,
    map_points,
    sample_box,
    sample_view,
)
from studies.learned_pose.simcc import CROP_PX as SIMCC_PX
from studies.learned_pose.yolo_pose import YoloPose, best_keypoints, label_row, mirrored_keypoints
from tests.support.detector_networks import write_rows_network

VIEWS = [CropView(), *(sample_view(np.random.default_rng(seed)) for seed in range(6))]


def blob_image(center_px: tuple[float, float], sigma_px: float) -> np.ndarray:
    """A spot on the grey of the padding, so that the patch's edge does not show."""
    y, x = np.mgrid[:480, :640]
    light = 114 + 130 * np.exp(-((x - center_px[0]) ** 2 + (y - center_px[1]) ** 2) / (2 * sigma_px**2))
    return np.repeat(np.rint(light)[..., None], 3, axis=2).astype(np.uint8)


def centroid(image: np.ndarray) -> np.ndarray:
    light = image[..., 0].astype(float) - 114
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("side_px", [60.0, 330.0])
def test_a_spot_lies_where_the_map_says(view: CropView, side_px: float) -> None:
    # A box that is enlarged, and one that is shrunk.
    box = (300.3 - side_px / 2, 240.7 - side_px / 2, side_px, 0.9 * side_px)
    spot = (300.3 + 0.17 * side_px, 240.7 - 0.21 * side_px)
    patch = cut_patch(blob_image(spot, 0.03 * side_px), box)
    crop = build_crop(patch.pixels, replace(view, gain=1.0, offset_dn=0.0, noise_dn=0.0))
    # The spot's skirt in whole numbers moves the centroid by a few hundredths; half a pixel of the patch, the usual
    # mistake, is 0.3 px here.
    expected = map_points(inverse_affine(image_from_crop(patch, view)), np.array(spot))
    np.testing.assert_allclose(centroid(crop), expected, atol=0.1)


def test_patches_reach_over_the_edge() -> None:
    image = np.full((480, 640, 3), 7, np.uint8)
    patch = cut_patch(image, (-40.0, -40.0, 80.0, 80.0))
    assert patch.pixels.shape == (PATCH_PX, PATCH_PX, 3)
    assert patch.pixels[0, 0, 0] == 114 and patch.pixels[-1, -1, 0] == 7
    far = cut_patch(image, (5000.0, 5000.0, 80.0, 80.0))
    assert (far.pixels == 114).all()


def test_augmentations_change_the_light_and_plain_crops_do_not() -> None:
    patch = np.full((PATCH_PX, PATCH_PX, 3), 100, np.uint8)
    assert (build_crop(patch, CropView()) == 100).all()
    assert (build_crop(patch, CropView(gain=1.2, offset_dn=-10)) == 110).all()
    noisy = build_crop(patch, CropView(noise_dn=5), np.random.default_rng(0)).astype(float)
    # 196,608 draws: the deviation errs by 0.2 %; rounding adds a twelfth to the variance.
    assert noisy.std() == pytest.approx(np.sqrt(25 + 1 / 12), rel=0.01)
    with pytest.raises(ValueError, match="rng: noise needs a generator"):
        build_crop(patch, CropView(noise_dn=5))


def test_a_detectors_box_is_near_the_true_one() -> None:
    boxes = np.array([sample_box(np.random.default_rng(seed), (100.0, 200.0, 50.0, 40.0)) for seed in range(200)])
    middles = boxes[:, :2] + boxes[:, 2:] / 2 - [125, 220]
    assert 0.02 * 50 < np.abs(middles).max() <= 0.03 * 50
    assert 0.04 < np.abs(boxes[:, 2:] / [50, 40] - 1).max() <= 0.05


def sample() -> EyeSample:
    angles = 0.2 + np.pi / 4 * np.arange(8)
    markers_px = np.array([320.0, 240.0]) + 70 * np.column_stack([np.cos(angles), np.sin(angles)])
    true_box = (230.0, 150.0, 180.0, 180.0)
    patch = cut_patch(np.zeros((480, 640, 3), np.uint8), sample_box(np.random.default_rng(1), true_box))
    return EyeSample(
        0, "left", true_box, true_box, patch, map_points(inverse_affine(patch.image_from_patch), markers_px)
    )


def test_labels_are_read_back_as_the_points_of_the_crop() -> None:
    one = sample()
    name, *numbers = map(float, label_row(one).split())
    assert name == 0
    keypoints = np.array(numbers[4:]).reshape(8, 3)
    assert (keypoints[:, 2] == 2).all()
    # A network that answers with the label in pixels gives the markers back.
    answer = np.zeros((5 + 24, 1344), np.float32)
    answer[4, [7, 900]] = 0.5, 0.9
    answer[5:, 900] = (keypoints * [CROP_PX, CROP_PX, 1]).ravel()
    found = best_keypoints(answer)
    assert found is not None
    expected = map_points(crop_from_patch(CropView()), one.markers_px)
    gaps = np.linalg.norm(found[:, None] - expected, axis=2)
    # Single precision of numbers up to 256.
    assert gaps.min(axis=1).max() < 1e-4 and sorted(gaps.argmin(axis=1).tolist()) == list(range(8))
    x, y = (found - found.mean(axis=0)).T
    assert (np.diff(np.arctan2(x, -y) % (2 * np.pi)) > 0).all()
    low = np.array(numbers[:2]) - np.array(numbers[2:4]) / 2
    to_crop = inverse_affine(image_from_crop(one.patch, CropView()))
    np.testing.assert_allclose(CROP_PX * low - 0.5, map_points(to_crop, np.array([230.0, 150.0])), atol=1e-9)


def test_no_drogue_is_no_keypoints() -> None:
    assert best_keypoints(np.zeros((29, 1344), np.float32)) is None


def test_a_network_with_another_output_is_refused(tmp_path: Path) -> None:
    # That of a detector without keypoints, and that of a network which suppresses doubles itself.
    for shape in ((2, 5, 30), (2, 300, 30)):
        file = write_rows_network(tmp_path / "other.onnx", np.zeros(shape, np.float32))
        with pytest.raises(ValueError, match="must give a box, a score and keypoints in each cell"):
            YoloPose(file, 1)
    answer = np.zeros((2, 29, 40), np.float32)
    answer[0, 4, 3], answer[0, 5:, 3] = 0.7, 40
    network = YoloPose(write_rows_network(tmp_path / "pose.onnx", answer, (CROP_PX, CROP_PX)), 1)
    left, right = network.keypoints([np.zeros((CROP_PX, CROP_PX, 3), np.uint8)] * 2)
    assert left is not None and (left == 39.5).all() and left.shape == (8, 2) and right is None


def test_a_mirrored_picture_has_the_mirrored_keypoints() -> None:
    angles = np.radians(10) + np.pi / 4 * np.arange(8)
    points = np.column_stack([np.sin(angles), -np.cos(angles)])
    mirrored = points * [-1, 1]
    order = np.argsort(np.arctan2(mirrored[:, 0], -mirrored[:, 1]) % (2 * np.pi))
    assert order.tolist() == mirrored_keypoints(8)


def test_the_networks_share_one_input() -> None:
    assert SIMCC_PX == CROP_PX
    crop = build_crop(cv2.resize(np.zeros((8, 8, 3), np.uint8), (PATCH_PX, PATCH_PX)), CropView())
    assert crop.shape == (CROP_PX, CROP_PX, 3)
