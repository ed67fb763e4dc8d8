"""Pixels of every kind of frame against plain formulas and OpenCV, damage on the way, and what is refused."""

from __future__ import annotations

import io
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from droguekit.capture.libav_stream import LibavPlace, LibavStream, libav_place, pixels_of_frame, without_secrets
from droguekit.capture.stereo_source import DAMAGED, CapturedImage
from nav.realtime import MonotonicClock
from tests.support.live_streams import FFV1, FFV1_DEEP, FFV1_GREY, Codec, encode

RNG = np.random.default_rng(5)
COLORS = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)
GREY = RNG.integers(0, 256, (48, 64), dtype=np.uint8)
DEEP = RNG.integers(0, 65536, (48, 64), dtype=np.uint16)
# Y, Cb, Cr of the frames below.
LEVELS = (120, 100, 180)


def images_of(path: str | Path) -> tuple[list[CapturedImage], Counter[str]]:
    stream = LibavStream(LibavPlace(str(path), str(path), is_file=True), None, MonotonicClock())
    stream.open()
    left_out: Counter[str] = Counter()
    return list(stream.images(threading.Event(), left_out)), left_out


@pytest.mark.parametrize(
    ("codec", "image"),
    [(FFV1, COLORS), (FFV1_GREY, GREY), (FFV1_DEEP, DEEP), (Codec("avi", "rawvideo", "bgr24"), COLORS)],
)
def test_lossless_images_arrive_bit_for_bit(codec: Codec, image: np.ndarray, tmp_path: Path) -> None:
    images = [np.roll(image, shift, 0) for shift in range(3)]
    # A camera that waits for light, or drops images, has no even rate.
    encode(str(tmp_path / "flight"), images, codec, times=None if codec.container == "avi" else (0, 3, 4))
    captured, left_out = images_of(tmp_path / "flight")
    assert left_out == {}
    times_s = [0, 0.04, 0.08] if codec.container == "avi" else [0, 0.12, 0.16]
    assert [each.time_s for each in captured] == pytest.approx(times_s)
    for each, want in zip(captured, images, strict=True):
        np.testing.assert_array_equal(each.load().pixels, want)
        assert each.load().mosaic is None


@pytest.mark.parametrize("kind", ["rgb24", "bgr24", "rgb0", "bgr0", "rgba", "gbrp", "rgb48le", "bgr48le", "gbrp16le"])
def test_red_green_and_blue_stay(kind: str) -> None:
    deep = RNG.integers(0, 65536, (48, 64, 3), dtype=np.uint16)
    if "48" in kind or "16" in kind:
        frame = av.VideoFrame.from_ndarray(deep[:, :, ::-1] if kind == "bgr48le" else deep, format="rgb48le")
        frame = _relabelled(frame) if kind == "bgr48le" else frame.reformat(format=kind)
        np.testing.assert_array_equal(pixels_of_frame(frame, "camera").pixels, deep)
    else:
        frame = av.VideoFrame.from_ndarray(COLORS, format="rgb24").reformat(format=kind)
        np.testing.assert_array_equal(pixels_of_frame(frame, "camera").pixels, COLORS)


def _relabelled(frame: av.VideoFrame) -> av.VideoFrame:
    """The same bytes, called blue, green, red."""
    other = av.VideoFrame(frame.width, frame.height, "bgr48le")
    other.planes[0].update(bytes(frame.planes[0]))
    return other


@pytest.mark.parametrize(
    ("pattern", "code"),
    [("rggb", cv2.COLOR_BayerRGGB2RGB), ("bggr", cv2.COLOR_BayerBGGR2RGB), ("gbrg", cv2.COLOR_BayerGBRG2RGB)],
)
def test_mosaics_are_interpolated_as_in_bags(pattern: str, code: int) -> None:
    frame = av.VideoFrame(64, 48, f"bayer_{pattern}8")
    frame.planes[0].update(GREY.tobytes())
    image = pixels_of_frame(frame, "camera")
    np.testing.assert_array_equal(image.pixels, cv2.cvtColor(GREY, code))
    if pattern == "rggb":
        np.testing.assert_array_equal(image.mosaic, GREY)
    else:
        assert image.mosaic is None


def even_frame(kind: str, matrix: int, color_range: int) -> av.VideoFrame:
    frame = av.VideoFrame(64, 48, kind)
    for plane, level in zip(frame.planes, LEVELS, strict=True):
        plane.update(bytes([level]) * (plane.line_size * plane.height))
    frame.colorspace, frame.color_range = matrix, color_range
    return frame


@pytest.mark.parametrize("kind", ["yuv444p", "yuvj444p", "yuv420p", "yuv422p"])
@pytest.mark.parametrize(
    ("matrix", "red", "blue"),
    [
        *((matrix, 0.299, 0.114) for matrix in (2, 5, 6)),
        *((1, 0.2126, 0.0722), (4, 0.30, 0.11), (7, 0.212, 0.087), (9, 0.2627, 0.0593)),
    ],
)
@pytest.mark.parametrize("color_range", [0, 1, 2])
def test_luma_and_chroma_are_converted_by_the_matrix_and_range_that_they_name(
    kind: str, matrix: int, red: float, blue: float, color_range: int
) -> None:
    # ITU-T H.273, table 4: weights of red and blue in Y. ITU-R BT.601-7 and BT.709-6, section 3: the ranges of 8 bits.
    luma, cb, cr = (float(level) for level in LEVELS)
    if color_range == 2 or kind.startswith("yuvj"):
        luma, cb, cr = luma, (cb - 128) / 255, (cr - 128) / 255
    else:
        luma, cb, cr = (luma - 16) * 255 / 219, (cb - 128) / 224, (cr - 128) / 224
    r, b = luma + 255 * 2 * (1 - red) * cr, luma + 255 * 2 * (1 - blue) * cb
    want = [r, (luma - red * r - blue * b) / (1 - red - blue), b]
    pixel = pixels_of_frame(even_frame(kind, matrix, color_range), "camera").pixels[20, 20]
    np.testing.assert_allclose(pixel, want, atol=0.6)  # rounding


@pytest.mark.parametrize("kind", ["pal8", "yuv420p10le", "rgb565le", "ya8", "grayf32le"])
def test_other_formats_are_named(kind: str) -> None:
    with pytest.raises(ValueError, match=f"camera: images of the format {kind} are not read; send RGB, grey, or 8-bit"):
        pixels_of_frame(av.VideoFrame(64, 48, kind), "camera")


@pytest.mark.parametrize("matrix", [0, 3, 8, 10])
def test_other_matrices_are_named(matrix: int) -> None:
    with pytest.raises(ValueError, match=rf"camera: colours by the matrix {matrix} of ITU-T H.273 are not read"):
        pixels_of_frame(even_frame("yuv444p", matrix, 1), "camera")


def moving(seed: int) -> list[np.ndarray]:
    colors = np.random.default_rng(seed).integers(0, 256, (6, 16, 3), dtype=np.uint8)
    blocks = np.kron(colors, np.ones((16, 16, 1), np.uint8))
    return [np.roll(blocks, 16 * index, 1) for index in range(30)]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("lost", [(40,), (40, 41, 80), tuple(range(50, 60))])
def test_after_lost_packets_no_image_is_used_that_was_built_on_them(
    lost: tuple[int, ...], seed: int, tmp_path: Path
) -> None:
    images, file = moving(seed), io.BytesIO()
    # A key frame every ten images; each of the others changes the one before.
    options = {"qp": "0", "tune": "zerolatency", "g": "10", "keyint_min": "10", "sc_threshold": "0"}
    encode(file, images, Codec("mpegts", "libx264rgb", "rgb24", options))
    data = file.getvalue()
    packets = [data[place : place + 188] for place in range(0, len(data), 188)]
    (tmp_path / "lossy.ts").write_bytes(b"".join(p for index, p in enumerate(packets) if index not in lost))
    captured, left_out = images_of(tmp_path / "lossy.ts")
    indices = [round(25 * (each.time_s - captured[0].time_s)) for each in captured]
    for index, each in zip(indices, captured, strict=True):
        np.testing.assert_array_equal(each.load().pixels, images[index])
    assert indices[:3] == [0, 1, 2]
    # All losses are before the third key frame.
    assert indices[-10:] == list(range(20, 30))
    assert len(lost) < 10 or left_out[DAMAGED] > 0


@pytest.mark.parametrize(
    ("codec", "intra"),
    [
        (Codec("matroska", "libx264", "yuv420p", {"tune": "zerolatency", "g": "5", "slices": "4"}), False),
        (
            Codec(
                "matroska",
                "libx265",
                "yuv420p",
                {"tune": "zerolatency", "x265-params": "keyint=5:hash=1:log-level=none"},
            ),
            False,
        ),
        (Codec("matroska", "mjpeg", "yuvj420p"), True),
    ],
    ids=["h264 in slices", "h265 with hashes", "mjpeg"],
)
@pytest.mark.parametrize("damaged", [0, 5, 7])
def test_an_image_of_damaged_data_and_those_built_on_it_are_left_out(
    codec: Codec, intra: bool, damaged: int, tmp_path: Path
) -> None:
    """No container and no protocol tells of it, only the decoder."""
    whole, broken = tmp_path / "whole.mkv", tmp_path / "broken.mkv"
    encode(str(whole), moving(0)[:15], codec)
    with av.open(str(whole)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        first = packets[damaged].pos + packets[damaged].size * 7 // 10
    data = bytearray(whole.read_bytes())
    data[first : first + 20] = bytes(each ^ 0x5A for each in data[first : first + 20])
    broken.write_bytes(data)
    images = {each.time_s: each.load().pixels for each in images_of(whole)[0]}
    captured, left_out = images_of(broken)
    for each in captured:
        np.testing.assert_array_equal(each.load().pixels, images[each.time_s])
    lost = [damaged] if intra else range(damaged, 5 * (damaged // 5) + 5)
    assert [round(25 * each.time_s) for each in captured] == [index for index in range(15) if index not in lost]
    assert left_out[DAMAGED] > 0


def test_a_file_with_two_streams_without_stamps_or_turned_is_refused(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "two.mkv"), "w") as container:
        streams: list[Any] = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 64, 48, "bgr0"
        for stream in streams:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(COLORS, format="rgb24")))
            container.mux(stream.encode(None))
    with pytest.raises(ValueError, match="must have one video stream with both views side by side, got 2"):
        images_of(tmp_path / "two.mkv")
    encode(str(tmp_path / "raw.h264"), moving(0), Codec("h264", "libx264rgb", "rgb24"))
    with pytest.raises(ValueError, match="holds no time stamps; put it into a container"):
        images_of(tmp_path / "raw.h264")


@pytest.mark.parametrize(
    ("address", "printed"),
    [
        ("rtsp://me:secret@camera:554/stereo", "rtsp://camera:554/stereo"),
        ("http://camera/a@b", "http://camera/a@b"),
        ("udp://127.0.0.1:5000", "udp://127.0.0.1:5000"),
        ("rtsp://me:secret@camera/stereo@main", "rtsp://camera/stereo@main"),
        ("rtsp://me:sec@ret@camera/stereo", "rtsp://camera/stereo"),
        ("rtsp://me:sec/ret@camera/stereo", "rtsp://..."),
        ("rtsp://me:sec?ret@camera/stereo", "rtsp://..."),
        ("rtsp://me:12/34@camera/stereo", "rtsp://..."),
        ("rtsp://me:12?34@camera/stereo", "rtsp://..."),
        ("rtsp://camera:554/user=me&password=secret&channel=1/stereo", "rtsp://camera:554/.../stereo"),
        ("http://[::1]:80/video?user=me&password=secret", "http://[::1]:80/video?..."),
        ("/dev/video0", "/dev/video0"),
    ],
)
def test_a_password_is_not_printed(address: str, printed: str) -> None:
    assert without_secrets(address) == printed


def test_a_file_may_have_a_colon_in_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = "12:30:00.mkv"
    with Path(name).open("wb") as file:
        encode(file, [COLORS])
    stream = LibavStream(libav_place(name, (64, 48), 5.0, None, None), None, MonotonicClock())
    stream.open()
    assert stream.name == name
    assert len(list(stream.images(threading.Event(), Counter()))) == 1


def test_the_wait_between_the_last_images_is_no_decoding(tmp_path: Path) -> None:
    """Playback takes an image and waits; a decoder of pictures that depend on later ones gives the last all at once."""

    class Counted:
        """A clock that only the player moves."""

        time_s = 0.0

        def now_s(self) -> float:
            return self.time_s

    clock, images = Counted(), moving(3)
    encode(tmp_path / "flight.mkv", images, Codec("matroska", "libx264rgb", "rgb24", {"bf": "3"}))
    path = str(tmp_path / "flight.mkv")
    stream = LibavStream(LibavPlace(path, path, is_file=True), None, clock)
    stream.open()
    read_s = []
    for each in stream.images(threading.Event(), Counter()):
        read_s.append(each.decode_s)
        clock.time_s += 0.1
    assert len(read_s) == len(images) and max(read_s) == 0.0
