from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.types.images import Pixels
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection
from nav.numerics.eye_threads import map_eyes
from nav.tracking.opencv_trackers import MedianFlowEyeTracker, MilEyeTracker
from nav.tracking.region import Box, EyeImage

BOXES: dict[Eye, Box] = {"left": (40.0, 35.0, 30.0, 30.0), "right": (45.0, 30.0, 34.0, 28.0)}
LARGE_PX2 = 1e6


def noise_image(number: int) -> EyeImage:
    noise = np.random.default_rng(number).random((100, 120, 3)).astype(np.float32)
    picture: Pixels = (4095 * cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 1, cv2.NORM_MINMAX)).astype(
        np.uint16
    )
    return EyeImage(picture, 0.04 * number)


@pytest.mark.parametrize("kind", [MilEyeTracker, MedianFlowEyeTracker])
def test_both_eyes_are_followed_at_once_as_one_after_the_other(
    kind: type[MilEyeTracker] | type[MedianFlowEyeTracker],
) -> None:
    def follow(area_px2: float) -> list[dict[Eye, Detection | None]]:
        trackers = {eye: kind(noise_image(0), BOXES[eye]) for eye in EYES}
        answers = []
        for number in range(1, 5):
            image = noise_image(number)
            found = map_eyes(lambda eye, image=image: trackers[eye].locate(image, None, None), EYES, area_px2)
            for eye in EYES:
                trackers[eye].learn(image, found[eye])
            answers.append(found)
        return answers

    in_turn = follow(0.0)
    for _ in range(3):
        assert follow(LARGE_PX2) == in_turn
