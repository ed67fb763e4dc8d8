from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from nav.detector.input_image import PADDING_DN, input_image, letterbox, network_input

SIZES = [((1280, 960), (640, 480)), ((1280, 960), (416, 320)), ((1000, 400), (416, 320)), ((333, 777), (640, 480))]


def stereo(left: np.ndarray, **kwargs: object) -> StereoImages:
    return StereoImages(left, left[:, ::-1].copy(), 0.0, 0.0, **kwargs)  # type: ignore[arg-type]


def srgb(light: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(("image_size", "input_size"), SIZES)
def test_boxes_come_back(image_size: tuple[int, int], input_size: tuple[int, int]) -> None:
    place = letterbox(image_size, input_size)
    rng = np.random.default_rng(1)
    boxes = np.hstack((rng.uniform(-50, 1200, (20, 2)), rng.uniform(1, 800, (20, 2))))
    np.testing.assert_allclose(place.to_image(place.to_input(boxes)), boxes, atol=1e-9)
    assert place.to_input(np.zeros((0, 4))).shape == (0, 4)


@pytest.mark.parametrize(("image_size", "input_size"), SIZES)
def test_the_whole_image_fills_one_direction_and_lies_in_the_middle(
    image_size: tuple[int, int], input_size: tuple[int, int]
) -> None:
    ((left, top, width, height),) = letterbox(image_size, input_size).to_input(np.array([[-0.5, -0.5, *image_size]]))
    assert left >= 0 and top >= 0
    # Margins differ by a pixel where they are odd.
    assert abs(input_size[0] - width - 2 * left) <= 1 + 1e-9
    assert abs(input_size[1] - height - 2 * top) <= 1 + 1e-9
    assert min(input_size[0] - width, input_size[1] - height) < 1e-9


@pytest.mark.parametrize(("image_size", "input_size"), SIZES)
def test_pixels_move_as_boxes_do(image_size: tuple[int, int], input_size: tuple[int, int]) -> None:
    """The centre of gravity of a bright rectangle on black lies in the middle of its box."""
    width, height = image_size
    x, y, w, h = 40, 60, 90, 70
    picture = np.zeros((height, width, 3), np.uint8)
    picture[y : y + h, x : x + w] = 255
    pixels, place = input_image(stereo(picture, encoding="gamma"), "left", input_size)
    assert pixels.shape == (input_size[1], input_size[0], 3)
    ((left, top, wide, high),) = place.to_input(np.array([[x - 0.5, y - 0.5, w, h]]))
    ((image_left, image_top, image_wide, image_high),) = place.to_input(np.array([[-0.5, -0.5, width, height]])).round()
    inside = (
        pixels[int(image_top) : int(image_top + image_high), int(image_left) : int(image_left + image_wide), 0] / 255
    )
    rows, columns = (np.arange(count) + 0.5 for count in inside.shape)
    # Levels are rounded to 1/255 along an edge of some 30 px, and enlarging interpolates.
    assert (inside.sum(axis=0) @ columns) / inside.sum() + image_left == pytest.approx(left + wide / 2, abs=0.1)
    assert (inside.sum(axis=1) @ rows) / inside.sum() + image_top == pytest.approx(top + high / 2, abs=0.1)
    assert inside.sum() == pytest.approx(wide * high, rel=0.02)


def test_what_the_image_leaves_is_grey() -> None:
    pixels, _ = input_image(stereo(np.zeros((400, 1000, 3), np.uint8), encoding="gamma"), "left", (320, 320))
    assert (pixels[:90] == PADDING_DN).all() and (pixels[-90:] == PADDING_DN).all()
    assert (pixels[100:220] == 0).all()


def test_halving_averages_four_pixels() -> None:
    picture = np.random.default_rng(2).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    pixels, _ = input_image(stereo(picture, encoding="gamma"), "left", (64, 32))
    means = picture.reshape(32, 2, 64, 2, 3).mean(axis=(1, 3))
    # Rounding of halves.
    assert abs(pixels.astype(float) - means).max() <= 0.5


@pytest.mark.parametrize(("bits", "black_dn"), [(8, 0.0), (12, 0.0), (8, 16.0), (12, 240.0)])
@pytest.mark.parametrize("encoding", ["linear", "gamma"])
def test_the_same_light_looks_the_same_from_every_sensor(bits: int, black_dn: float, encoding: str) -> None:
    light = np.tile(np.linspace(0.05, 1, 128)[None, :, None], (64, 1, 3))
    top = 2**bits - 1
    black = black_dn / top
    if encoding == "gamma":
        # The black level is a number of the encoded image.
        black = float(np.where(black <= 0.04045, black / 12.92, ((black + 0.055) / 1.055) ** 2.4))
    raw = black + (1 - black) * light
    codes = np.round(top * (srgb(raw) if encoding == "gamma" else raw)).astype(np.uint8 if bits == 8 else np.uint16)
    images = stereo(codes, bits=bits, encoding=encoding, black_level_dn=black_dn)
    pixels, _ = input_image(images, "left", (128, 64))
    # Half a level of 8 linear bits at a light of 0.05, where the curve has a slope of 2.5, and rounding twice.
    assert abs(pixels - 255 * srgb(light)).max() <= 0.5 * 2.5 / (1 - black) + 1.1


def test_a_mono_picture_has_three_equal_channels() -> None:
    picture = np.random.default_rng(3).integers(0, 256, (64, 96), dtype=np.uint8)
    pixels, _ = input_image(stereo(picture, encoding="gamma"), "left", (96, 64))
    assert (pixels == picture[..., None]).all()


def test_eyes_and_channels_keep_their_order() -> None:
    picture = np.random.default_rng(4).integers(0, 256, (32, 64, 3), dtype=np.uint8)
    images = stereo(picture, encoding="gamma")
    both = [input_image(images, eye, (64, 32))[0] for eye in ("left", "right")]
    batch = network_input(both)
    assert batch.dtype == np.float32 and batch.shape == (2, 3, 32, 64)
    # Division by 255 in float32.
    np.testing.assert_allclose(batch[0].transpose(1, 2, 0), picture / 255, atol=1e-6)
    np.testing.assert_allclose(batch[1].transpose(1, 2, 0), picture[:, ::-1] / 255, atol=1e-6)


@pytest.mark.parametrize("size", [(640, 470), (0, 32), (-32, 32), (31, 31)])
def test_sizes_that_no_network_takes_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"input_size_px: must be multiples of 32, got {size[0]}x{size[1]}"):
        letterbox((1280, 960), size)


def test_absurd_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="input_size_px: must be at most 4096 a side, got 3200x3200000"):
        letterbox((1280, 960), (3200, 3_200_000))


@pytest.mark.parametrize(("image_size", "input_size"), [*SIZES, ((1000, 701), (640, 480)), ((999, 700), (640, 480))])
def test_an_enlarged_input_shows_the_image_at_the_same_place(
    image_size: tuple[int, int], input_size: tuple[int, int]
) -> None:
    white = np.full((image_size[1], image_size[0], 3), 255, np.uint8)
    plain, place = input_image(stereo(white, encoding="gamma"), "left", input_size)
    large, same = input_image(stereo(white, encoding="gamma"), "left", input_size, enlarged=2)
    assert same == place
    np.testing.assert_array_equal(large, plain.repeat(2, axis=0).repeat(2, axis=1))
