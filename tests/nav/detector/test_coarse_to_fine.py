"""Small boxes are looked at again, in windows at twice the scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datasets_manifest.types.images import StereoImages
from geometry.se3 import Array
from nav.detector.coarse_to_fine import FINE_SCALE, WINDOW_PX, SecondLook, detect_again, window_corners
from nav.detector.model_metadata import ModelMetadata
from nav.detector.onnx_detector import OnnxDetector
from nav.detector.output_maps import MAP_CHANNELS, STRIDES
from tests.support.detector_networks import write_red_squares

SMALL_PX, THRESHOLD = 80.0, 0.5
FINE_PX = (1280, 960)
LOOK = SecondLook(FINE_PX, SMALL_PX, THRESHOLD)
FINE = np.zeros((*FINE_PX[::-1], 3), np.uint8)


def boxes_of(*rows: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Square boxes and scores of rows x, y, side, score."""
    return np.array([[x, y, side, side] for x, y, side, _ in rows]).reshape(-1, 4), np.array([row[3] for row in rows])


def answers(*rows: tuple[int, int, float, float]) -> list[NDArray[np.float32]]:
    """Output maps of one image that hold one box for each row: column and row of a cell of 8 px, side [px], score."""
    maps = [np.full((1, MAP_CHANNELS, WINDOW_PX // stride, WINDOW_PX // stride), -9, np.float32) for stride in STRIDES]
    for column, row, side_px, score in rows:
        maps[0][0, 0, row, column] = np.log(score / (1 - score))
        maps[0][0, 1:, row, column] = np.log(side_px / 2 / STRIDES[0])
    return maps


def again(
    coarse: tuple[Array, Array], *windows: list[NDArray[np.float32]], least_score: float = 0.05
) -> tuple[Array, Array, list[NDArray[np.uint8]]]:
    """What is found in one image whose windows have these output maps; and the windows that were looked at."""
    seen: list[NDArray[np.uint8]] = []

    def run(images: Sequence[NDArray[np.uint8]]) -> Sequence[NDArray[Any]]:
        seen.extend(images)
        return [np.concatenate(each) for each in zip(*windows[: len(images)], strict=True)]

    ((boxes, scores),) = detect_again([coarse], [lambda: FINE], run, LOOK, least_score, 20)
    return boxes, scores, seen


@pytest.mark.parametrize(("x", "y"), [(300.0, 200.0), (0.0, 0.0), (620.0, 460.0)])
def test_a_window_shows_the_box_that_it_is_for(x: float, y: float) -> None:
    ((left, top),) = window_corners(*boxes_of((x, y, 20, 0.4)), LOOK)
    assert 0 <= left <= FINE_PX[0] - WINDOW_PX and 0 <= top <= FINE_PX[1] - WINDOW_PX
    low, high = FINE_SCALE * np.array([x, y]), FINE_SCALE * np.array([x + 20, y + 20])
    assert (low >= (left, top)).all() and (high <= np.array([left, top]) + WINDOW_PX).all()


def test_only_small_uncertain_boxes_are_looked_at_again() -> None:
    rows = (100.0, 100.0, 30.0, 0.3), (400.0, 300.0, 30.0, 0.8), (250.0, 250.0, 90.0, 0.4), (500.0, 20.0, 30.0, 0.02)
    assert len(window_corners(*boxes_of(*rows), LOOK)) == 1
    assert window_corners(*boxes_of(*rows[1:]), LOOK) == []


def test_a_part_of_a_large_certain_drogue_is_not_looked_at_again() -> None:
    whole, hub = (100.0, 100.0, 200.0, 0.9), (180.0, 180.0, 40.0, 0.4)
    assert window_corners(*boxes_of(whole, hub), LOOK) == []
    uncertain = boxes_of((100.0, 100.0, 200.0, 0.45), hub)
    assert len(window_corners(*uncertain, LOOK)) == 1
    # Nor does a part count that the window of a box beside the drogue shows: its middle is at (292, 152) in the input.
    boxes, _, seen = again(boxes_of(whole, (310.0, 130.0, 40.0, 0.3)), answers((2, 12, 40, 0.8), (14, 12, 40, 0.7)))
    assert len(seen) == 1
    assert sorted(boxes[:, 2].tolist()) == pytest.approx([20, 200], abs=1e-3)


def test_neighbouring_boxes_share_a_window_and_there_are_two_at_most() -> None:
    near = (100.0, 100.0, 20.0, 0.4), (110.0, 105.0, 20.0, 0.3)
    assert len(window_corners(*boxes_of(*near), LOOK)) == 1
    apart = [(100.0 * column, 100.0, 20.0, 0.4) for column in range(1, 6)]
    assert len(window_corners(*boxes_of(*apart), LOOK)) == 2


def test_what_the_window_shows_replaces_the_box_and_its_score() -> None:
    # The cell's middle is at (12.5, 12.5) cells, 100 px of the window; the window begins at (2 * 110 - 96, same) px.
    boxes, scores, _ = again(boxes_of((100, 100, 20, 0.4)), answers((12, 12, 44, 0.8)))
    assert scores == pytest.approx([0.8], abs=1e-6)
    middle = (2 * 110 - 96 + 100) / 2
    # Logarithms are float32.
    np.testing.assert_allclose(boxes, [[middle - 11, middle - 11, 22, 22]], atol=1e-3)


def test_a_box_of_which_the_window_shows_nothing_is_gone() -> None:
    boxes, scores, _ = again(boxes_of((100, 100, 20, 0.6), (400, 300, 150, 0.3)), answers())
    assert scores.tolist() == [0.3] and boxes[0, 2] == 150


def test_boxes_at_the_edge_of_a_window_stay_as_they_were() -> None:
    # The window reaches from 62 to 158 px of the input; the second box's middle is 4 px from its edge.
    boxes, scores, _ = again(
        boxes_of((100, 100, 20, 0.4), (144, 100, 20, 0.09)), answers((12, 12, 44, 0.8), (23, 12, 44, 0.6))
    )
    assert scores == pytest.approx([0.8, 0.09], abs=1e-6)
    assert boxes[1].tolist() == [144, 100, 20, 20]


@pytest.mark.parametrize(("x", "y"), [(0, 200), (620, 200), (300, 0), (300, 460), (-8, -8)])
def test_a_box_at_the_edge_of_the_image_can_be_replaced_too(x: float, y: float) -> None:
    boxes, _, seen = again(boxes_of((x, y, 20, 0.6)), answers())
    assert len(seen) == 1 and len(boxes) == 0


def test_a_box_that_the_window_of_another_cuts_has_one_of_its_own() -> None:
    small, wide = (100.0, 100.0, 20.0, 0.6), (93.0, 71.0, 78.0, 0.58)
    boxes, _, seen = again(boxes_of(small, wide), answers(), answers())
    assert len(seen) == 2 and len(boxes) == 0
    # With both windows taken by others it stays as it was.
    other = (400.0, 300.0, 20.0, 0.59)
    boxes, scores, seen = again(boxes_of(small, other, wide), answers(), answers())
    assert len(seen) == 2 and scores.tolist() == [0.58] and boxes[0].tolist() == [93, 71, 78, 78]


def test_windows_of_several_images_are_not_mixed_up() -> None:
    coarse = [boxes_of((100, 100, 20, 0.4)), boxes_of(), boxes_of((100, 100, 20, 0.4), (400, 300, 20, 0.3))]
    scores = iter((0.8, 0.75, 0.72))

    def run(images: Sequence[NDArray[np.uint8]]) -> Sequence[NDArray[Any]]:
        maps = [answers((12, 12, 44, next(scores))) for _ in images]
        return [np.concatenate(each) for each in zip(*maps, strict=True)]

    found = detect_again(coarse, [lambda: FINE] * 3, run, LOOK, 0.05, 20)
    assert [score.round(2).tolist() for _, score in found] == [[0.8], [], [0.75, 0.72]]


def test_low_scores_are_left_out_after_the_second_look() -> None:
    _, scores, _ = again(boxes_of((100, 100, 20, 0.2)), answers((12, 12, 44, 0.6)), least_score=0.5)
    assert scores == pytest.approx([0.6], abs=1e-6)
    _, scores, _ = again(boxes_of((100, 100, 20, 0.6)), answers((12, 12, 44, 0.3)), least_score=0.5)
    assert len(scores) == 0


def test_images_smaller_than_a_window_are_not_looked_at_again() -> None:
    assert window_corners(*boxes_of((10, 10, 20, 0.4)), SecondLook((640, 128), SMALL_PX, THRESHOLD)) == []


def test_the_detector_measures_small_squares_at_twice_the_scale(tmp_path: Path) -> None:
    # The network of these tests predicts boxes of two cells, of 8 px or more, around red cells; this red is uncertain.
    image = np.full((512, 640, 3), 90, np.uint8)
    image[192:224, 256:288] = (193, 0, 0)
    images = StereoImages(image, image, time_s=0.0, exposure_s=1e-3, encoding="gamma")
    for small_below_px, shrink in ((0.0, 1), (SMALL_PX, FINE_SCALE)):
        metadata = ModelMetadata(input_size_px=(320, 256), score_threshold=0.5, small_below_px=small_below_px)
        detector = OnnxDetector(write_red_squares(tmp_path, metadata=metadata))
        for found in detector.candidates(images, 0.3).values():
            assert min(one.box_xywh_px[2] for one in found) == pytest.approx(32 / shrink)
        # A single picture is searched at its own size, twice that of the pair's images.
        alone = detector.candidates_in_picture(image, 0.3)
        assert min(one.box_xywh_px[2] for one in alone) == pytest.approx(16 / shrink)


def test_inputs_whose_double_is_too_large_are_not_looked_at_again(tmp_path: Path) -> None:
    image = np.full((64, 96, 3), 90, np.uint8)
    image[16:32, 16:32] = (193, 0, 0)
    metadata = ModelMetadata(input_size_px=(320, 256), score_threshold=0.5, small_below_px=SMALL_PX)
    file = write_red_squares(tmp_path, metadata=metadata)
    images = StereoImages(image, image, time_s=0.0, exposure_s=1e-3, encoding="gamma")
    # Twice 2080 px is more than an input may have.
    assert OnnxDetector(file, input_size_px=(2080, 64)).candidates(images, 0.3)["left"]


def test_a_network_of_one_size_cannot_look_again(tmp_path: Path) -> None:
    metadata = ModelMetadata(input_size_px=(320, 256), small_below_px=80.0)
    file = write_red_squares(tmp_path, metadata=metadata, shape=(2, 3, 256, 320))
    with pytest.raises(ValueError, match="small_below_px: takes 320x256 px only, and no windows of 192x192 px"):
        OnnxDetector(file)


@pytest.mark.parametrize("wrong", [-1, float("nan"), 97, "80", True])
def test_boxes_that_no_window_can_show_are_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match="small_below_px: must be 0 to 96"):
        ModelMetadata(small_below_px=wrong)


def test_below_a_high_threshold_nothing_is_certain() -> None:
    box = boxes_of((100, 100, 20, 0.75))
    assert window_corners(*box, LOOK) == []
    assert len(window_corners(*box, SecondLook(FINE_PX, SMALL_PX, 0.8))) == 1
