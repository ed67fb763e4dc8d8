"""PNG files of a dataset: bits, order of colours, and what damaged and oversized files do."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest

from datasets_manifest.storage.image_codecs import (
    MOST_PIXELS,
    check_image_size,
    decode_exr,
    decode_png,
    encode_png,
    read_passes,
)
from geometry.pinhole import PinholeCamera


def camera_of(width_px: int, height_px: int) -> PinholeCamera:
    return PinholeCamera(width_px, height_px, 100.0, 100.0, 0.0, 0.0)


@pytest.mark.parametrize(("shape", "dtype", "high"), [((5, 7, 3), np.uint8, 256), ((5, 7), np.uint8, 256)])
@pytest.mark.parametrize("wide", [False, True])
def test_images_come_back_bit_for_bit(shape: tuple[int, ...], dtype: type[Any], high: int, wide: bool) -> None:
    dtype, high = (np.uint16, 4096) if wide else (dtype, high)
    image = np.random.default_rng(1).integers(0, high, shape, dtype=dtype)
    again = decode_png(encode_png(image), "image", camera_of(7, 5))
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
            decode_png(data[:length], "x.png", camera_of(8, 8))
    assert capfd.readouterr() == ("", "")


def test_every_flipped_byte_is_named() -> None:
    data = encode_png(np.random.default_rng(4).integers(0, 256, (8, 8), dtype=np.uint8))
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x40
        with pytest.raises(ValueError, match=r"^x\.png: "):
            decode_png(bytes(damaged), "x.png", camera_of(8, 8))


def test_transparency_is_refused() -> None:
    done, data = cv2.imencode(".png", np.zeros((4, 4, 4), dtype=np.uint8))
    assert done
    with pytest.raises(ValueError, match=r"x\.png: must be 8 or 16 bit grey or RGB"):
        decode_png(data.tobytes(), "x.png", camera_of(4, 4))


def png_of_zeros(width_px: int, height_px: int) -> bytes:
    """A small file that holds a large grey image, written by the specification, without our encoder."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(min((width_px + 1) * height_px, 2**20)), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side_px", [9, 20_000, 60_000, 2**31 - 1])
def test_an_image_of_another_size_never_reaches_the_decoder(side_px: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", fail)
    with pytest.raises(ValueError, match=rf"^x\.png: must be 8 x 8 px, got {side_px} x {side_px}$"):
        decode_png(png_of_zeros(side_px, side_px), "x.png", camera_of(8, 8))


def test_a_png_without_a_header_is_named() -> None:
    data = png_of_zeros(8, 8)
    without = data[:8] + data[8 + 25 :]
    with pytest.raises(ValueError, match=r"^x\.png: the PNG is damaged \(no header\)$"):
        decode_png(without, "x.png", camera_of(8, 8))


@pytest.mark.parametrize("size", [(0, 5), (-3, 5), (MOST_PIXELS, 2)])
def test_counts_of_pixels_that_no_image_has(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="pixels, got"):
        check_image_size(*size, bytes_per_px=1, file_bytes=10**9)
    check_image_size(MOST_PIXELS, 1, bytes_per_px=1, file_bytes=10**9)


def test_a_small_file_holds_no_large_image() -> None:
    # A dark image of 12 million pixels is a few kilobytes as PNG, and all of them are allowed.
    check_image_size(4000, 3000, bytes_per_px=6, file_bytes=12_000)
    check_image_size(12_000, 10_000, bytes_per_px=6, file_bytes=7_200_000)
    with pytest.raises(ValueError, match="must not expand more than 100 times, got 7199999 bytes of 720000000"):
        check_image_size(12_000, 10_000, bytes_per_px=6, file_bytes=7_199_999)
    # By its rig and its header it is right.
    data = png_of_zeros(20_000, 20_000)
    with pytest.raises(ValueError, match=r"^x\.png: must (not expand|have 1 to)"):
        decode_png(data, "x.png", camera_of(20_000, 20_000))


def test_an_exr_file_of_many_channels_never_reaches_the_decoder(tmp_path: Path) -> None:
    """A megabyte of zeros in a hundred channels, of which each has the size of the rig."""
    camera, planes = camera_of(1000, 800), np.zeros((800, 1000), np.float32)
    OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
        {f"c{number}": planes for number in range(100)},
    ).write(str(tmp_path / "bomb.exr"))
    data = (tmp_path / "bomb.exr").read_bytes()
    assert len(data) < 2**20
    with pytest.raises(ValueError, match="must not expand more than 100 times"):
        read_passes(data, "bomb.exr", camera)


def test_an_exr_file_that_claims_too_many_pixels_never_reaches_the_decoder() -> None:
    window = struct.pack("<iiii", 0, 0, 99_999, 99_999)
    header = struct.pack("<ii", 20000630, 2) + b"dataWindow\0box2i\0" + struct.pack("<i", 16) + window + b"\0"
    with pytest.raises(ValueError, match="must have 1 to 150000000 pixels, got 100000 x 100000"):
        decode_exr(header)
