from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.types.images import StereoImages
from nav.detector.input_image import PADDING_DN, input_image, network_input
from nav.training.augmentation import (
    MIN_VISIBLE_FRACTION,
    CanvasWindow,
    ImageView,
    ViewRanges,
    clip_boxes,
    paint_view,
    sample_mosaic_windows,
    sample_view,
    transform_boxes,
    warp_view,
    whole_view,
)
from nav.training.corpus import CachedPair, Corpus, ImageCache
from nav.training.evaluation import to_tensor, whole_image
from nav.training.training_state import ComputeDevice

SOURCE_WH = (160, 120)
BOX = np.array([[60.0, 40.0, 50.0, 36.0]])


def ellipse_image() -> np.ndarray:
    image = np.zeros((SOURCE_WH[1], SOURCE_WH[0], 3), np.uint8)
    x, y, width, height = BOX[0]
    # OpenCV counts from pixel centres and paints every pixel whose centre the ellipse covers.
    cv2.ellipse(image, ((x + width / 2 - 0.5, y + height / 2 - 0.5), (width, height), 0.0), (255, 255, 255), -1)
    return image


def box_of_bright(canvas: np.ndarray) -> np.ndarray:
    rows, columns = (np.flatnonzero((canvas[..., 0] > 180).any(axis=axis)) for axis in (1, 0))
    return np.array([columns[0], rows[0], columns[-1] + 1 - columns[0], rows[-1] + 1 - rows[0]], dtype=float)


def center_of(canvas: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Centre of gravity of what is bright in and around a box, counted from the canvas's corner."""
    rows, columns = np.mgrid[: canvas.shape[0], : canvas.shape[1]] + 0.5
    low, high = box[:2] - 4, box[:2] + box[2:] + 4  # without the grey where the image ends
    is_near = (columns > low[0]) & (columns < high[0]) & (rows > low[1]) & (rows < high[1])
    weights = np.where(is_near, canvas[..., 0], 0.0)
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def test_boxes_move_with_the_pixels() -> None:
    window, compared = CanvasWindow(20, 10, 200, 170), 0
    for seed in range(30):
        view = sample_view(np.random.default_rng(seed), SOURCE_WH, BOX, window, ViewRanges((0.4, 1.6), 8, 0.5))
        visible, shares = clip_boxes(transform_boxes(BOX, view), window)
        canvas = np.zeros((200, 240, 3), np.uint8)
        warp_view(canvas, ellipse_image(), view)
        # What is cut off is not round any more. A whole box's share may miss one by its rounding.
        if shares[0] > 1 - 1e-9:
            # Interpolation blurs an edge by about a pixel of the coarser of the two images, of up to 1.6 px here.
            np.testing.assert_allclose(box_of_bright(canvas), visible[0], atol=2.5)
            # An edge's blur is the same on both sides: what is left is rounding to levels, and interpolation's phases.
            np.testing.assert_allclose(center_of(canvas, visible[0]), visible[0, :2] + visible[0, 2:] / 2, atol=0.1)
            compared += 1
    assert compared > 5


def test_a_mirrored_view_is_the_mirrored_image() -> None:
    image = np.random.default_rng(1).integers(0, 256, (SOURCE_WH[1], SOURCE_WH[0], 3), dtype=np.uint8)
    mirrored = ImageView(np.diag([-1.0, 1.0]), np.array([SOURCE_WH[0], 0.0]), CanvasWindow(0, 0, *SOURCE_WH))
    canvas = np.zeros_like(image)
    warp_view(canvas, image, mirrored)
    np.testing.assert_array_equal(canvas, image[:, ::-1])
    # 160 - 60 - 50
    np.testing.assert_array_equal(transform_boxes(BOX, mirrored), [[50.0, 40.0, 50.0, 36.0]])


def test_no_view_makes_a_drogue_smaller_than_any_in_use() -> None:
    canvas_wh, box = (416, 320), np.array([[100.0, 80.0, 11.0, 11.0]])
    ranges = ViewRanges((0.1, 2.0), 0, 0.5).on_canvas(canvas_wh, canvas_wh)
    heights = []
    for seed in range(200):
        view = sample_view(np.random.default_rng(seed), canvas_wh, box, CanvasWindow(100, 50, 200, 180), ranges)
        heights.append(transform_boxes(box, view)[0, 3])
    # The paper's drogue at 40 m has 17.5 px of 480; three quarters of its share are the limit.
    assert min(heights) == pytest.approx(0.75 * 17.5 / 480 * 320, rel=0.05)


def test_the_rest_of_the_canvas_stays() -> None:
    canvas = np.full((100, 120, 3), 7, np.uint8)
    window = CanvasWindow(30, 20, 40, 50)
    warp_view(canvas, ellipse_image(), ImageView(np.eye(2), np.zeros(2), window))
    inside = np.zeros((100, 120), bool)
    inside[20:70, 30:70] = True
    assert (canvas[~inside] == 7).all()
    # Without a scale the window shows the image's own pixels.
    np.testing.assert_array_equal(canvas[inside], ellipse_image()[20:70, 30:70].reshape(-1, 3))


def test_a_drogue_of_which_too_little_is_visible_is_painted_over() -> None:
    window = CanvasWindow(0, 0, 120, 120)
    cut = ImageView(np.eye(2), np.array([120 - 60 - 0.2 * 50, 0.0]), window)
    canvas = np.zeros((120, 120, 3), np.uint8)
    kept = paint_view(canvas, ellipse_image(), BOX, cut)
    assert len(kept) == 0
    assert not (canvas > PADDING_DN).any()


def test_a_drogue_at_the_edge_keeps_its_visible_part() -> None:
    window = CanvasWindow(0, 0, 120, 120)
    share = MIN_VISIBLE_FRACTION + 0.1
    cut = ImageView(np.eye(2), np.array([120 - 60 - share * 50, 0.0]), window)
    kept = paint_view(np.zeros((120, 120, 3), np.uint8), ellipse_image(), BOX, cut)
    np.testing.assert_allclose(kept, [[100.0, 40.0, 20.0, 36.0]], atol=1e-9)  # sums of a few numbers


def test_a_drogue_that_is_too_small_to_learn_from_is_painted_over() -> None:
    reduced = ImageView(np.eye(2) * 0.25, np.zeros(2), CanvasWindow(0, 0, 120, 120))
    for smallest_px, count in ((13.0, 0), (12.0, 1), (0.0, 1)):
        canvas = np.zeros((120, 120, 3), np.uint8)
        assert len(paint_view(canvas, ellipse_image(), BOX, reduced, smallest_px)) == count
        assert (canvas > PADDING_DN).any() == bool(count)


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_turning_an_ellipse_against_its_outline(flip: float) -> None:
    angle = np.radians(23)
    linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([flip, 1.0])
    view = ImageView(linear, np.array([50.0, -10.0]), CanvasWindow(0, 0, 10, 10))
    t = np.linspace(0, 2 * np.pi, 100_001)
    outline = BOX[0, :2] + BOX[0, 2:] / 2 + np.column_stack([np.cos(t), np.sin(t)]) * BOX[0, 2:] / 2
    moved = outline @ linear.T + view.shift
    expected = [*moved.min(axis=0), *np.ptp(moved, axis=0)]
    # The outline's points are so close that the extremes lie within radius * step^2 / 8 < 1e-8 px.
    np.testing.assert_allclose(transform_boxes(BOX, view)[0], expected, atol=1e-6)


def test_the_whole_view_is_the_detectors_input() -> None:
    picture = np.zeros((240, 320, 3), np.uint8)
    stereo = StereoImages(picture, picture, 0.0, 1e-3, encoding="gamma")
    at_once, place = input_image(stereo, "left", (128, 96))
    boxes = np.array([[30.0, 50.0, 100.0, 80.0]])
    cached, cached_place = input_image(stereo, "left", (256, 192))
    canvas = np.full((96, 128, 3), PADDING_DN, np.uint8)
    shown = paint_view(canvas, cached, cached_place.to_input(boxes), whole_view((256, 192), (128, 96)))
    np.testing.assert_allclose(shown, place.to_input(boxes), atol=1e-9)  # sums of a few numbers
    np.testing.assert_array_equal(canvas, at_once)


def test_validation_uses_the_detectors_input() -> None:
    picture = np.random.default_rng(2).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    stereo = StereoImages(picture, picture, 0.0, 1e-3, encoding="gamma")
    in_use, place = input_image(stereo, "left", (416, 320))
    assert place.offset_px == (0, 4)  # a reduction by 1.54, and margins
    pairs = (CachedPair(frame_index=0, split="val", boxes=((31.0, 50.0, 100.0, 81.0), None)),)
    corpus = Corpus(
        (),
        (480, 640),
        (ImageCache(np.stack([picture, picture])[None], pairs, PairFaults(), np.zeros(0, np.uint8)),),
        np.array([[0, 0]]),
    )
    image, boxes = whole_image(corpus, 0, 0, (320, 416))
    given = to_tensor(image[None], ComputeDevice(torch.device("cpu"), bf16=False))
    np.testing.assert_allclose(given.numpy(), network_input([in_use]), atol=1e-7)  # division or product in float32
    # Records count from pixel centres, a corpus from corners.
    np.testing.assert_allclose(boxes, place.to_input(np.array([[30.5, 49.5, 100, 81]])), atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_four_windows_cover_the_canvas_once(seed: int) -> None:
    covered = np.zeros((96, 128), int)
    for window in sample_mosaic_windows(np.random.default_rng(seed), (128, 96)):
        covered[window.y : window.y + window.height, window.x : window.x + window.width] += 1
    assert (covered == 1).all()
