"""Boxes of a pass at full size and one at half: which pass finds which drogue."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from nav.detector.input_image import letterbox
from nav.detector.model_metadata import ModelMetadata
from nav.detector.multiscale_inference import half_size_px, merge_scales, pass_sizes, to_full_size
from nav.detector.onnx_detector import OnnxDetector
from tests.support.detector_networks import write_red_squares

LARGE_PX = 160.0
NONE = (np.zeros((0, 4)), np.zeros(0))


def found(*rows: tuple[int, int, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Boxes and scores of rows x, y, side, score."""
    return np.array([[x, y, side, side] for x, y, side, _ in rows], float), np.array([row[3] for row in rows], float)


@pytest.mark.parametrize("side_px", [20.0, 127.0, 129.0, 160.0, 199.0, 201.0, 400.0])
def test_a_drogue_found_by_both_passes_has_one_box(side_px: float) -> None:
    boxes, scores = merge_scales(found((10, 10, side_px, 0.8)), found((11, 10, side_px, 0.7)), LARGE_PX, 20)
    assert len(boxes) == 1
    # From the full size well below the limit, from half the size well above it, near it the better one.
    assert scores[0] == (0.7 if side_px > 1.25 * LARGE_PX else 0.8)


@pytest.mark.parametrize("side_px", [150.0, 170.0])
def test_near_the_limit_either_pass_is_enough(side_px: float) -> None:
    only = found((10, 10, side_px, 0.6))
    assert len(merge_scales(only, NONE, LARGE_PX, 20)[0]) == len(merge_scales(NONE, only, LARGE_PX, 20)[0]) == 1


def test_parts_of_a_large_drogue_get_no_boxes() -> None:
    large, marker, aside = (100, 100, 300, 0.8), (150, 150, 40, 0.7), (500, 20, 40, 0.6)
    boxes, scores = merge_scales(found(marker, aside), found(large), LARGE_PX, 20)
    assert scores.tolist() == [0.8, 0.6] and boxes[1, 0] == 500
    # A large box removes no better box within it.
    boxes, _ = merge_scales(found((150, 150, 40, 0.9)), found(large), LARGE_PX, 20)
    assert len(boxes) == 2


def test_the_number_of_boxes_is_limited() -> None:
    many = found(*((50 * index, 0, 30, 0.9 - 0.1 * index) for index in range(6)))
    assert merge_scales(many, NONE, LARGE_PX, 2)[1].tolist() == pytest.approx([0.9, 0.8])
    assert len(merge_scales(NONE, NONE, LARGE_PX, 20)[0]) == 0


def test_half_a_size_is_a_multiple_of_32() -> None:
    assert half_size_px((640, 480)) == (320, 256)
    assert half_size_px((64, 32)) == (32, 32)


def test_boxes_come_back_from_half_the_size() -> None:
    # 640 x 480 is centred in 320 x 256, with eight pixels of grey above and below.
    placement = letterbox((640, 480), (320, 256))
    boxes, _ = to_full_size((np.array([[10.0, 28.0, 50.0, 60.0]]), np.array([0.5])), placement)
    np.testing.assert_allclose(boxes, [[20.0, 40.0, 100.0, 120.0]], atol=1e-9)


def test_the_second_pass_sees_squares_that_are_twice_as_large(tmp_path: Path) -> None:
    # The network of these tests predicts boxes of two cells, of 8 px or more, around red cells.
    image = np.full((256, 320, 3), 90, np.uint8)
    image[64:192, 64:192] = (255, 0, 0)
    images = StereoImages(image, image, time_s=0.0, exposure_s=1e-3, encoding="gamma")
    sides = {}
    for large_from_px in (0.0, 12.0):
        metadata = ModelMetadata(input_size_px=(320, 256), score_threshold=0.6, large_from_px=large_from_px)
        detector = OnnxDetector(write_red_squares(tmp_path, metadata=metadata))
        assert len(detector.pass_sizes_px) == 1 + (large_from_px > 0)
        sides[large_from_px] = min(box.box_xywh_px[2] for box in detector.candidates(images, 0.6)["left"])
    # With a limit of 12 px, boxes of 16 px at full size are not taken from the full-size pass.
    assert sides[0.0] == pytest.approx(16) and sides[12.0] == pytest.approx(32)


def test_passes_end_at_half_the_size_of_the_training() -> None:
    assert pass_sizes((640, 480), (640, 480)) == ((640, 480), (320, 256))
    assert pass_sizes((1280, 736), (640, 480)) == ((1280, 736), (640, 384), (320, 192))
    assert pass_sizes((320, 256), (640, 480)) == ((320, 256), (160, 128))


def red_square_detector(folder: Path) -> OnnxDetector:
    metadata = ModelMetadata(input_size_px=(320, 256), score_threshold=0.6, large_from_px=12.0)
    return OnnxDetector(write_red_squares(folder, metadata=metadata))


@pytest.mark.parametrize(("width", "height"), [(640, 512), (2000, 1500), (100, 70)])
def test_a_single_picture_is_searched_at_its_own_size(tmp_path: Path, width: int, height: int) -> None:
    picture = np.full((height, width, 3), 90, np.uint8)
    low, high = np.array([0.25 * width, 0.25 * height]), np.array([0.75 * width, 0.75 * height])
    picture[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])] = (255, 0, 0)
    found = red_square_detector(tmp_path).candidates_in_picture(picture, 0.6)
    assert found
    # One cell of the smallest pass, which has at most 320 px, is 8 px there.
    cell = 8 * max(width, height) / 160
    for one in found:
        middle = np.array(one.box_xywh_px[:2]) + np.array(one.box_xywh_px[2:]) / 2
        assert (middle > low - cell).all() and (middle < high + cell).all()


@pytest.mark.parametrize(("width", "height"), [(300, 9000), (5, 400), (1, 1)])
def test_pictures_of_odd_shapes_are_searched_too(tmp_path: Path, width: int, height: int) -> None:
    assert red_square_detector(tmp_path).candidates_in_picture(np.full((height, width), 90, np.uint8), 0.6) == ()


def test_the_largest_drogues_come_from_the_smallest_pass(tmp_path: Path) -> None:
    picture = np.full((512, 640, 3), 90, np.uint8)
    picture[128:384, 128:384] = (255, 0, 0)
    found = red_square_detector(tmp_path).candidates_in_picture(picture, 0.6)
    # Two cells of 8 px at a quarter of the size; smaller boxes are not taken from the other passes.
    assert min(one.box_xywh_px[2] for one in found) == pytest.approx(64)


def test_a_network_of_one_size_and_two_images_takes_single_pictures(tmp_path: Path) -> None:
    detector = OnnxDetector(write_red_squares(tmp_path, shape=(2, 3, 256, 320)))
    picture = np.full((512, 640), 90, np.uint8)
    assert detector.candidates_in_picture(picture, 0.6) == ()


def test_a_network_of_one_size_cannot_have_a_second_pass(tmp_path: Path) -> None:
    metadata = ModelMetadata(input_size_px=(320, 256), large_from_px=100.0)
    file = write_red_squares(tmp_path, metadata=metadata, shape=(2, 3, 256, 320))
    with pytest.raises(ValueError, match="large_from_px: takes 320x256 px only, and not half of it"):
        OnnxDetector(file)


@pytest.mark.parametrize("wrong", [-1, float("nan"), 5000, "160", True])
def test_wrong_limits_are_named(wrong: float) -> None:
    with pytest.raises(ValueError, match="large_from_px: must be 0 to 4096"):
        ModelMetadata(large_from_px=wrong)
