from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.image_codecs import decode_png, encode_png


@pytest.mark.parametrize(("shape", "dtype", "high"), [((5, 7, 3), np.uint8, 256), ((5, 7), np.uint8, 256)])
@pytest.mark.parametrize("wide", [False, True])
def test_images_come_back_bit_for_bit(shape: tuple[int, ...], dtype: type[Any], high: int, wide: bool) -> None:
    dtype, high = (np.uint16, 4096) if wide else (dtype, high)
    image = np.random.default_rng(1).integers(0, high, shape, dtype=dtype)
    again = decode_png(encode_png(image), "image")
    assert again.dtype == image.dtype
    np.testing.assert_array_equal(again, image)


def test_red_is_red_for_other_readers() -> None:
    image = np.zeros((4, 4, 3), dtype=np.uint8)
    image[..., 0] = 200
    bgr = cv2.imdecode(np.frombuffer(encode_png(image), np.uint8), cv2.IMREAD_COLOR)
    assert bgr[0, 0].tolist() == [0, 0, 200]


def test_the_same_image_gives_the_same_bytes() -> None:
    image = np.random.default_rng(2).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    assert encode_png(image) == encode_png(image.copy())


def test_every_truncation_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    data = encode_png(np.random.default_rng(3).integers(0, 256, (8, 8), dtype=np.uint8))
    for length in range(len(data)):
        with pytest.raises(ValueError, match=r"^x\.png: (not a PNG file|the PNG is truncated)$"):
            decode_png(data[:length], "x.png")
    assert capfd.readouterr() == ("", "")


def test_every_flipped_byte_is_named() -> None:
    data = encode_png(np.random.default_rng(4).integers(0, 256, (8, 8), dtype=np.uint8))
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x40
        with pytest.raises(ValueError, match=r"^x\.png: "):
            decode_png(bytes(damaged), "x.png")


def test_transparency_is_refused() -> None:
    done, data = cv2.imencode(".png", np.zeros((4, 4, 4), dtype=np.uint8))
    assert done
    with pytest.raises(ValueError, match=r"x\.png: must be 8 or 16 bit grey or RGB"):
        decode_png(data.tobytes(), "x.png")
