from __future__ import annotations

import cv2
import numpy as np
import pytest

from nav.training import augmentation
from nav.training.augmentation import color_jitter


def test_color_jitter_varies_and_does_not_change_its_input() -> None:
    image = np.full((32, 48, 3), 128, np.uint8)
    varied = [color_jitter(np.random.default_rng(seed), image) for seed in range(200)]
    assert (image == 128).all()
    assert all(each.shape == image.shape and each.dtype == np.uint8 for each in varied)
    means = np.array([each.mean() for each in varied])
    assert means.min() < 40 and means.max() > 180  # low light, and nearly twice the exposure
    assert means.min() > 18  # 20, less what blur, rounding and cut-off noise change
    dim = [color_jitter(np.random.default_rng(seed), image // 6).mean() for seed in range(200)]
    # What is dark already is exposed, cast and curved as all images are, by 0.55, 0.7 and a gamma of 1.45 at worst.
    assert min(dim) > 255 * (21 / 255) ** 1.45 * 0.55 * 0.7
    again = color_jitter(np.random.default_rng(7), image)
    np.testing.assert_array_equal(again, varied[7])


def disc_image() -> np.ndarray:
    """(480, 640, 3) a white disc far from the corner that pictures are stretched about."""
    image = np.zeros((480, 640, 3), np.uint8)
    return cv2.circle(image, (560, 420), 14, (255, 255, 255), -1, cv2.LINE_AA)


def center_px(image: np.ndarray) -> np.ndarray:
    rows, columns = np.indices(image.shape[:2])
    light = image[..., 1].astype(float)
    return np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()


@pytest.mark.parametrize(
    "changes",
    [
        {"_RESAMPLED_FRACTION": 1.0, "_SHARPENED_FRACTION": 0.0, "_COMPRESSED_FRACTION": 0.0},
        {"_MOTION_PX": (3, 9)},
    ],
    ids=["resampled", "blurred"],
)
def test_boxes_stay_where_pictures_are_resampled_or_blurred(
    changes: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in changes.items():
        monkeypatch.setattr(augmentation, name, value)
    change = augmentation._processed if "_RESAMPLED_FRACTION" in changes else augmentation._motion_blur
    image = disc_image()
    shifts = [center_px(change(np.random.default_rng(seed), image)) - center_px(image) for seed in range(40)]
    # Light in whole numbers, of a disc whose edge has some hundred pixels.
    assert np.abs(shifts).max() < 0.05
