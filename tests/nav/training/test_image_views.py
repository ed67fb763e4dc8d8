from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.images import StereoImages
from nav.detector.input_image import PADDING_DN, input_image
from nav.training.image_views import (
    LEAST_VISIBLE_FRACTION,
    ImageView,
    ViewRanges,
    Window,
    clipped_boxes,
    draw_view,
    moved_boxes,
    sample_view,
    show,
    whole_view,
)
from nav.training.mosaic import sample_windows

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


def test_boxes_go_where_the_pixels_go() -> None:
    window, compared = Window(20, 10, 200, 170), 0
    for seed in range(30):
        view = sample_view(np.random.default_rng(seed), SOURCE_WH, BOX, window, ViewRanges((0.4, 1.6), 8, 0.5))
        visible, shares = clipped_boxes(moved_boxes(BOX, view), window)
        canvas = np.zeros((200, 240, 3), np.uint8)
        draw_view(canvas, ellipse_image(), view)
        if shares[0] == 1:  # what is cut off is not round any more
            # Interpolation blurs an edge by about a pixel of the coarser of the two images, of up to 1.6 px here.
            np.testing.assert_allclose(box_of_bright(canvas), visible[0], atol=2.5)
            compared += 1
    assert compared > 5


def test_the_rest_of_the_canvas_stays() -> None:
    canvas = np.full((100, 120, 3), 7, np.uint8)
    window = Window(30, 20, 40, 50)
    draw_view(canvas, ellipse_image(), ImageView(np.eye(2), np.zeros(2), window))
    inside = np.zeros((100, 120), bool)
    inside[20:70, 30:70] = True
    assert (canvas[~inside] == 7).all()
    # Without a scale the window shows the image's own pixels.
    np.testing.assert_array_equal(canvas[inside], ellipse_image()[20:70, 30:70].reshape(-1, 3))


def test_a_drogue_of_which_too_little_shows_leaves_no_trace() -> None:
    window = Window(0, 0, 120, 120)
    cut = ImageView(np.eye(2), np.array([120 - 60 - 0.2 * 50, 0.0]), window)
    canvas = np.zeros((120, 120, 3), np.uint8)
    kept = show(canvas, ellipse_image(), BOX, cut)
    assert len(kept) == 0
    assert not (canvas > PADDING_DN).any()


def test_a_drogue_at_the_edge_keeps_what_shows() -> None:
    window = Window(0, 0, 120, 120)
    share = LEAST_VISIBLE_FRACTION + 0.1
    cut = ImageView(np.eye(2), np.array([120 - 60 - share * 50, 0.0]), window)
    kept = show(np.zeros((120, 120, 3), np.uint8), ellipse_image(), BOX, cut)
    np.testing.assert_allclose(kept, [[100.0, 40.0, 20.0, 36.0]], atol=1e-9)  # sums of a few numbers


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_turning_an_ellipse_against_its_outline(flip: float) -> None:
    angle = np.radians(23)
    linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([flip, 1.0])
    view = ImageView(linear, np.array([50.0, -10.0]), Window(0, 0, 10, 10))
    t = np.linspace(0, 2 * np.pi, 100_001)
    outline = BOX[0, :2] + BOX[0, 2:] / 2 + np.column_stack([np.cos(t), np.sin(t)]) * BOX[0, 2:] / 2
    moved = outline @ linear.T + view.shift
    expected = [*moved.min(axis=0), *np.ptp(moved, axis=0)]
    # The outline's points are so close that the extremes lie within radius * step^2 / 8 < 1e-8 px.
    np.testing.assert_allclose(moved_boxes(BOX, view)[0], expected, atol=1e-6)


def test_the_whole_view_is_what_the_detector_sees() -> None:
    picture = np.zeros((240, 320, 3), np.uint8)
    stereo = StereoImages(picture, picture, 0.0, 1e-3, encoding="gamma")
    at_once, place = input_image(stereo, "left", (128, 96))
    boxes = np.array([[30.0, 50.0, 100.0, 80.0]])
    cached, cached_place = input_image(stereo, "left", (256, 192))
    canvas = np.full((96, 128, 3), PADDING_DN, np.uint8)
    shown = show(canvas, cached, cached_place.to_input(boxes), whole_view((256, 192), (128, 96)))
    np.testing.assert_allclose(shown, place.to_input(boxes), atol=1e-9)  # sums of a few numbers
    np.testing.assert_array_equal(canvas, at_once)


@pytest.mark.parametrize("seed", range(20))
def test_four_windows_cover_the_canvas_once(seed: int) -> None:
    covered = np.zeros((96, 128), int)
    for window in sample_windows(np.random.default_rng(seed), (128, 96)):
        covered[window.y : window.y + window.height, window.x : window.x + window.width] += 1
    assert (covered == 1).all()
