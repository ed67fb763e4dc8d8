"""Image files as OpenCV's own reader gives them; Pillow and the definition of EXIF are the oracles."""

from __future__ import annotations

import io
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from datasets_manifest.importers.image_files import decode_image_file, read_image, read_photograph

# Four corners of four colours, so that each of the eight orientations looks different.
STORED = np.zeros((16, 24, 3), np.uint8)
STORED[:8, :12], STORED[:8, 12:] = (240, 16, 16), (16, 240, 16)
STORED[8:, :12], STORED[8:, 12:] = (16, 16, 240), (240, 240, 16)
# EXIF 2.3, tag 274: where the stored first row and first column are in the upright picture.
UPRIGHT: dict[int, Any] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
FORMATS: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": 100, "subsampling": 0},
    "PNG": {},
    "TIFF": {},
    "WEBP": {"lossless": True},
}


def encoded(picture: np.ndarray, kind: str, orientation: int | None = None) -> np.ndarray:
    exif = Image.Exif()
    if orientation is not None:
        exif[274] = orientation
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, kind, exif=exif, **FORMATS[kind])
    return np.frombuffer(stream.getvalue(), np.uint8)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@pytest.mark.parametrize("orientation", UPRIGHT)
def test_orientation_is_applied_as_the_calibration_snippet_applies_it(
    kind: str, orientation: int, tmp_path: Path
) -> None:
    path = tmp_path / f"picture.{kind.lower()}"
    encoded(STORED, kind, orientation).tofile(path)
    pixels, is_turned = read_image(path)
    # JPEG's transform is not lossless; the colours differ by 200.
    np.testing.assert_allclose(pixels.astype(int), UPRIGHT[orientation](STORED), atol=30)
    assert is_turned == (orientation != 1)
    # docs/how-to/calibrate.md reads its boards so; OpenCV 4.11 gives None for a TIFF on its side.
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert (grey is None) == (kind == "TIFF" and orientation > 4)
    if grey is None:
        return
    np.testing.assert_allclose(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(int), grey, atol=2)


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_orientation_turns_deep_images_alike(orientation: int) -> None:
    deep = STORED[:, :, 0].astype(np.uint16) * 257
    pixels, _ = decode_image_file(encoded(deep, "PNG", orientation), "deep")
    np.testing.assert_array_equal(pixels, UPRIGHT[orientation](deep))


@pytest.mark.parametrize("orientation", [2, 3, 6])
def test_orientation_that_opencv_does_not_apply_is_refused(orientation: int) -> None:
    with pytest.raises(ValueError, match=rf"a\.webp: has the orientation {orientation} of EXIF.*save it upright"):
        decode_image_file(encoded(STORED, "WEBP", orientation), "a.webp")
    # The advice: Pillow's picture, saved upright.
    upright = UPRIGHT[orientation](STORED)
    np.testing.assert_array_equal(decode_image_file(encoded(upright, "WEBP"), "a.webp")[0], upright)


def test_orientation_in_xmp_alone_is_refused(tmp_path: Path) -> None:
    xmp, path = b'<x:xmpmeta><rdf:RDF><rdf:Description tiff:Orientation="3"/></rdf:RDF></x:xmpmeta>', tmp_path / "a.jpg"
    Image.fromarray(STORED).save(path, "JPEG", xmp=xmp, **FORMATS["JPEG"])
    with pytest.raises(ValueError, match="has the orientation 3"):
        read_image(path)
    # JPEG's transform is not lossless; the colours differ by 200.
    np.testing.assert_allclose(read_photograph(path).astype(int), UPRIGHT[3](STORED), atol=30)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("orientation", UPRIGHT)
def test_photographs_are_turned_upright_whatever_their_format(kind: str, orientation: int, tmp_path: Path) -> None:
    path = tmp_path / "picture"
    encoded(STORED, kind, orientation).tofile(path)
    with Image.open(path) as stored:
        np.testing.assert_array_equal(read_photograph(path), ImageOps.exif_transpose(stored))


def test_an_orientation_beyond_the_definition_is_upright() -> None:
    np.testing.assert_array_equal(decode_image_file(encoded(STORED, "PNG", 9), "a.png")[0], STORED)


def profiled(pixels: np.ndarray, mode: str) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(pixels, mode).save(file, "PNG", icc_profile=b"no profile" * 20)
    return np.frombuffer(file.getvalue(), np.uint8)


@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("is_checksum_wrong", [False, True])
def test_a_faulty_color_profile_is_no_matter_for_the_terminal(
    mode: str, is_checksum_wrong: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    pixels = np.random.default_rng(3).integers(256, size=(12, 16) if mode == "L" else (12, 16, 3), dtype=np.uint8)
    data = profiled(pixels, mode).copy()
    if is_checksum_wrong:
        data[data.tobytes().index(b"iCCP") + 20] ^= 1
    cv2.imdecode(data, cv2.IMREAD_ANYCOLOR)
    assert "libpng warning: iCCP" in capfd.readouterr().err
    found, _ = decode_image_file(data, "picture")
    np.testing.assert_array_equal(found, pixels)
    assert capfd.readouterr() == ("", "")
    # A profile that is cut off leaves nothing to read.
    with pytest.raises(ValueError, match="picture: is truncated"):
        decode_image_file(data[:60], "picture")


def flipped(data: np.ndarray, share: float) -> np.ndarray:
    """The bytes of a file with one wrong, as by a fault of a disk."""
    wrong = data.copy()
    wrong[int(share * data.size)] ^= 0x5A
    return wrong


def landscape(seed: int) -> np.ndarray:
    """(48, 64, 3) smooth colours, which JPEG codes by long runs."""
    return cv2.resize(np.random.default_rng(seed).integers(0, 255, (6, 8, 3)).astype(np.uint8), (64, 48))


def filled(data: np.ndarray, count: int) -> np.ndarray:
    """A JPEG with so many bytes behind its pixels."""
    return np.concatenate([data[:-2], np.full(count, 7, np.uint8), data[-2:]])


def test_a_jpeg_that_its_decoder_calls_corrupt_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    whole = encoded(landscape(2), "JPEG")
    for wrong in (flipped(whole, 0.6), filled(whole, 40)):
        assert cv2.imdecode(wrong, cv2.IMREAD_COLOR) is not None
        assert capfd.readouterr().err.startswith("Corrupt JPEG data: ")
        with pytest.raises(ValueError, match=r"^a\.jpg: is damaged \(Corrupt JPEG data: .*\); copy it anew"):
            decode_image_file(wrong, "a.jpg")
        assert capfd.readouterr() == ("", "")
    pixels, _ = decode_image_file(whole, "a.jpg")
    np.testing.assert_allclose(pixels.astype(int), landscape(2), atol=30)
    # As webcams write them.
    np.testing.assert_array_equal(decode_image_file(filled(whole, 9), "a.jpg")[0], pixels)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("codec", ["tiff_lzw", "tiff_adobe_deflate"])
@pytest.mark.parametrize("bands", ["L", "RGB"])
def test_a_compressed_tiff_with_wrong_bytes_is_refused(
    codec: str, bands: str, capfd: pytest.CaptureFixture[str]
) -> None:
    stream = io.BytesIO()
    Image.fromarray(landscape(2)).convert(bands).save(stream, "TIFF", compression=codec)
    whole = np.frombuffer(stream.getvalue(), np.uint8)
    wrong = whole.copy()
    wrong[whole.size // 3 : whole.size // 3 + 20] ^= 0x5A
    assert cv2.imdecode(wrong, cv2.IMREAD_ANYCOLOR) is not None
    capfd.readouterr()
    with pytest.raises(ValueError, match=r"^a\.tif: is damaged \(.*\); copy it anew"):
        decode_image_file(wrong, "a.tif")
    decode_image_file(whole, "a.tif")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "BMP", "PPM", "TIFF", "WEBP"])
@pytest.mark.parametrize("fault", ["cut", "flipped"])
def test_decoders_write_nothing_of_their_own(kind: str, fault: str, capfd: pytest.CaptureFixture[str]) -> None:
    stream = io.BytesIO()
    Image.fromarray(landscape(2)).save(stream, kind)
    data = np.frombuffer(stream.getvalue(), np.uint8)
    # A flipped pixel of an uncompressed format cannot be noticed.
    with suppress(ValueError):
        decode_image_file(data[: int(0.6 * data.size)] if fault == "cut" else flipped(data, 0.75), "a.x")
    assert capfd.readouterr() == ("", "")


def test_what_others_write_meanwhile_is_passed_on(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    decode = cv2.imdecode

    def write_and_decode(*arguments: Any) -> Any:
        os.write(2, b"half of the work is done\n")
        return decode(*arguments)

    whole = encoded(landscape(2), "JPEG")
    monkeypatch.setattr(cv2, "imdecode", write_and_decode)
    with pytest.raises(ValueError, match="is damaged"):
        decode_image_file(flipped(whole, 0.6), "a.jpg")
    assert capfd.readouterr() == ("", "half of the work is done\n")
    decode_image_file(whole, "a.jpg")
    assert capfd.readouterr() == ("", "half of the work is done\n")


def test_damage_is_told_of_its_own_picture_in_many_threads(capfd: pytest.CaptureFixture[str]) -> None:
    whole = encoded(landscape(2), "JPEG")

    def is_whole(place: int) -> bool:
        try:
            decode_image_file(whole if place % 2 else flipped(whole, 0.6), "a.jpg")
        except ValueError:
            return False
        return True

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(is_whole, range(40))) == [place % 2 == 1 for place in range(40)]
    assert capfd.readouterr() == ("", "")


def test_webp_is_read() -> None:
    np.testing.assert_array_equal(decode_image_file(encoded(STORED, "WEBP"), "a.webp")[0], STORED)


@pytest.mark.parametrize("kind", ["TIFF", "WEBP"])
def test_several_images_in_one_file_are_refused(kind: str) -> None:
    stream = io.BytesIO()
    Image.fromarray(STORED).save(stream, kind, save_all=True, append_images=[Image.fromarray(STORED[::-1])])
    with pytest.raises(ValueError, match=r"pages\.x: holds 2 images"):
        decode_image_file(np.frombuffer(stream.getvalue(), np.uint8), "pages.x")


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_truncated_files_are_refused(kind: str, share: float) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (60, 80, 3), np.uint8)
    data = encoded(noise, kind)
    with pytest.raises(ValueError, match=r"cut\.x: is truncated"):
        decode_image_file(data[: int(share * len(data))], "cut.x")


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "P", "1", "I;16"])
def test_modes_are_those_of_opencv(mode: str) -> None:
    """Alpha is dropped and palettes are resolved, as before orientations were applied."""
    picture = Image.fromarray(STORED[:, :, 0].astype(np.uint16) * 250) if mode == "I;16" else Image.fromarray(STORED)
    stream = io.BytesIO()
    (picture if mode == "I;16" else picture.convert(mode)).save(stream, "PNG")
    data = np.frombuffer(stream.getvalue(), np.uint8)
    want = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    want = want if want.ndim == 2 else want[:, :, 2::-1]
    np.testing.assert_array_equal(decode_image_file(data, mode)[0], want)


def test_a_picture_that_would_fill_the_memory_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", fail)
    # A bitmap's header holds its size at bytes 18 to 26.
    stream = io.BytesIO()
    Image.fromarray(STORED).save(stream, "BMP")
    header = bytearray(stream.getvalue())
    for side_px, message in (
        (12_500, "must have 1 to 150000000 pixels, got 12500 x 12500"),
        (60_000, "too many pixels"),
    ):
        header[18:26] = side_px.to_bytes(4, "little") * 2
        with pytest.raises(ValueError, match=f"^a.bmp: .*{message}"):
            decode_image_file(np.frombuffer(bytes(header), np.uint8), "a.bmp")
