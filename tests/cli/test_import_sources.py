"""Recordings as other cameras, programs and public datasets leave them; what an error advises is done, and works."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from datasets_manifest.calibration.calibration_files import opencv_stereo
from datasets_manifest.storage.blind import BlindDataset
from droguekit.cli.main import DONE, WRONG_INPUT, run
from geometry.pinhole import PinholeCamera
from geometry.stereo import StereoRig
from tests.support.ros_messages import (
    BASELINE_M,
    FOCAL_PX,
    HEIGHT,
    HUMBLE,
    IMAGE,
    INFO,
    WIDTH,
    header,
    image,
    stereo,
    write_bag2,
)

Messages = list[tuple[str, str, Any]]


def import_with(source: Path, *options: str, out: str = "imported") -> int:
    """Import into a folder beside the source."""
    return run(["import", str(source), "--out", str(source.parent / out), *options])


def calibration(folder: Path) -> tuple[str, str]:
    rig = StereoRig(PinholeCamera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, 3.5, 2.5), BASELINE_M)
    (folder / "stereo.yaml").write_text(opencv_stereo(rig))
    return "--calibration", str(folder / "stereo.yaml")


def save(folder: Path, *names: str, values: np.ndarray | None = None) -> Path:
    pixels = np.full((HEIGHT, WIDTH), 9, np.uint8) if values is None else values
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), pixels)
    return folder


def times_s(source: Path, out: str = "imported") -> list[float]:
    dataset = BlindDataset(source.parent / out)
    return [dataset.pair(index).images.time_s for index in dataset.frame_indices]


def only(kind: str, messages: Messages) -> Messages:
    return [message for message in messages if message[1] == kind]


def moved(messages: Messages, topic: Callable[[str], str]) -> Messages:
    return [(topic(name), kind, message) for name, kind, message in messages]


def test_euroc_folder(tmp_path: Path) -> None:
    stamps = (1403636579763555584, 1403636579813555456)
    source = save(tmp_path / "MH_01", *(f"mav0/cam{eye}/data/{stamp}.png" for eye in (0, 1) for stamp in stamps))
    for eye in (0, 1):
        (source / f"mav0/cam{eye}/data.csv").write_text("#timestamp [ns],filename\n")
    (source / "mav0/imu0").mkdir()
    assert import_with(source, *calibration(tmp_path)) == DONE
    assert times_s(source) == pytest.approx([1e-9 * stamp for stamp in stamps], abs=5e-7, rel=0)


def test_euroc_bag_has_no_camera_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """/cam0/image_raw and /cam1/image_raw alone."""
    names = {"/left/image_raw": "/cam0/image_raw", "/right/image_raw": "/cam1/image_raw"}
    source = write_bag2(tmp_path / "MH_01", moved(only(IMAGE, stereo((1, 2))), names.__getitem__))
    assert import_with(source) == WRONG_INPUT
    said = capsys.readouterr().err
    assert "has no CameraInfo on /cam0/camera_info and /cam1/camera_info" in said and "or give --calibration" in said
    assert import_with(source, *calibration(tmp_path)) == DONE


def test_tum_vi_images_use_all_16_bits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """12 bits in the upper part of 16; a dark first pair hides it."""
    dark, bright = (np.full((HEIGHT, WIDTH), value << 4, np.uint16) for value in (200, 4000))
    source = save(tmp_path / "room1", "left/1.png", "right/1.png", values=dark)
    save(source, "left/2.png", "right/2.png", values=bright)
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    assert "left/2.png: has values beyond 12 bits; say by --bits how many the camera has" in capsys.readouterr().err
    assert import_with(source, *calibration(tmp_path), "--bits", "16") == DONE
    dataset = BlindDataset(tmp_path / "imported")
    assert [int(dataset.pair(index).images.left[0, 0]) for index in (0, 1)] == [200, 4000]
    # The other order shows the depth at once.
    (source / "left/2.png").rename(source / "left/0.png")
    (source / "right/2.png").rename(source / "right/0.png")
    assert import_with(source, *calibration(tmp_path), out="bright-first") == DONE


def test_kitti_raw_has_two_pairs_of_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "2011_09_26_drive_0001_sync"
    save(source, *(f"image_0{camera}/data/000000000{n}.png" for camera in range(4) for n in range(2)))
    for camera in range(4):
        (source / f"image_0{camera}/timestamps.txt").write_text(
            "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.068\n"
        )
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    said = capsys.readouterr().err
    advised = said.split("choose one by --folders from ")[1].split(" and ")
    assert advised[1].strip() == "image_02/data,image_03/data"
    assert import_with(source, *calibration(tmp_path), "--folders", advised[1].strip()) == DONE
    assert times_s(source) == pytest.approx([1317042145.964389445, 1317042146.068], abs=5e-7, rel=0)


def test_zed_exports_an_image_sequence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """ZED_SVO_Export, mode 2; modes 3 and 4 have depth instead of the right view."""
    source = save(tmp_path / "zed", *(f"{eye}00000{n}.png" for eye in ("left", "right") for n in range(3)))
    assert import_with(source, *calibration(tmp_path)) == DONE and len(times_s(source)) == 3
    source = save(tmp_path / "depth", *(f"{eye}00000{n}.png" for eye in ("left", "depth") for n in range(3)))
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    assert "has no images of the right view, and 3 of the other" in capsys.readouterr().err


def test_zed_bag_has_colour_and_grey(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """bgra8 rectified images in two topics an eye, whose CameraInfo is the rectified images'."""
    messages: Messages = []
    for name, kind, message in stereo((1, 2)):
        eye = name.split("/")[1]
        if kind == INFO:
            messages.append((f"/zed/zed_node/{eye}/camera_info", kind, message))
            continue
        colour = np.dstack(
            [message.data.reshape(HEIGHT, WIDTH, 3)[:, :, ::-1], np.full((HEIGHT, WIDTH), 255, np.uint8)]
        )
        kind_of = HUMBLE.types[IMAGE]
        bgra = kind_of(message.header, HEIGHT, WIDTH, "bgra8", 0, 4 * WIDTH, colour.reshape(-1))
        grey = kind_of(message.header, HEIGHT, WIDTH, "mono8", 0, WIDTH, colour[:, :, 0].reshape(-1))
        messages.append((f"/zed/zed_node/{eye}/image_rect_color", IMAGE, bgra))
        messages.append((f"/zed/zed_node/{eye}/image_rect_gray", IMAGE, grey))
    source = write_bag2(tmp_path / "zed", messages)
    assert import_with(source) == WRONG_INPUT
    said = capsys.readouterr().err
    listed = said.split("choose by --topics LEFT,RIGHT from ")[1].strip().split(", ")
    chosen = ",".join(topic for topic in listed if topic.endswith("color"))
    assert import_with(source, "--topics", chosen) == DONE
    pair = BlindDataset(tmp_path / "imported").pair(0)
    assert pair.images.left[0, 0].tolist() == [0, 1, 2] and pair.rig.baseline_m == pytest.approx(BASELINE_M)


def test_both_views_in_one_topic_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages = moved(only(IMAGE, stereo((1, 2)))[::2], lambda _: "/zed/zed_node/stereo/image_rect_color")
    assert import_with(write_bag2(tmp_path / "wide", messages)) == WRONG_INPUT
    assert "a pair needs two image topics; there are /zed/zed_node/stereo/image_rect_color" in capsys.readouterr().err


def test_realsense_viewer_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Topics of librealsense, whose CameraInfo lies elsewhere and has no baseline."""
    messages: Messages = []
    for name, kind, message in stereo((1, 2)):
        base = f"/device_0/sensor_0/Infrared_{1 + ('right' in name)}"
        if kind == INFO:
            message.p[3] = 0.0
        messages.append((f"{base}/info/camera_info" if kind == INFO else f"{base}/image/data", kind, message))
    source = write_bag2(tmp_path / "d435", messages)
    assert import_with(source) == WRONG_INPUT
    said = capsys.readouterr().err
    assert "choose it by --camera-info LEFT,RIGHT from " in said
    listed = said.split("LEFT,RIGHT from ")[1].split(", or give")[0].split(", ")
    assert import_with(source, "--camera-info", ",".join(listed)) == WRONG_INPUT
    assert "Infrared_2/info/camera_info: P" in capsys.readouterr().err
    assert import_with(source, *calibration(tmp_path)) == DONE


def test_cameras_without_a_common_trigger(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Stamps of OAK cameras differ by some microseconds, those of USB cameras by milliseconds."""
    messages: Messages = []
    for place, stamp_s in enumerate((1.0, 1.05, 1.1)):
        for is_right, eye in enumerate(("left", "right")):
            head = header(HUMBLE, stamp_s + is_right * 12e-6)
            messages.append((f"/{eye}/image_raw", IMAGE, image(HUMBLE, head, place)))
    source = write_bag2(tmp_path / "oak", [*messages, *only(INFO, stereo((1,)))])
    assert import_with(source) == WRONG_INPUT
    assert "the nearest differ by 0.012 ms (--stamp-tolerance-ms)" in capsys.readouterr().err
    assert import_with(source, "--stamp-tolerance-ms", "0.1") == DONE
    assert times_s(source) == pytest.approx([1.0, 1.05, 1.1])
    said = capsys.readouterr()
    assert "the right ones' differ by up to 0.012 ms" in said.err + said.out


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_compressed_recording(
    mode: CompressionMode, plugin: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`ros2 bag record --compression-format zstd`, and the file of it without its metadata."""
    writer = Writer(tmp_path / "zstd", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for place, (topic, kind, message) in enumerate(stereo((1, 2))):
            known = {connection.topic: connection for connection in writer.connections}
            connection = known.get(topic) or writer.add_connection(topic, kind, typestore=HUMBLE)
            writer.write(connection, (place + 1) * 10**8, HUMBLE.serialize_cdr(message, kind))
    assert import_with(tmp_path / "zstd") == DONE and times_s(tmp_path / "zstd") == [1.0, 2.0]
    capsys.readouterr()
    (file,) = (path for path in (tmp_path / "zstd").iterdir() if path.name != "metadata.yaml")
    shutil.copy(file, tmp_path / file.name)
    result = import_with(tmp_path / file.name, out="alone")
    said = capsys.readouterr().err
    assert result == DONE or (result == WRONG_INPUT and said.count("\n") == 1)
    assert result == DONE or not (tmp_path / "alone").exists()


def test_recording_that_was_not_closed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A power failure leaves no metadata.yaml, and an MCAP file without its end."""
    folder = write_bag2(tmp_path / "lost", stereo((1, 2)))
    (folder / "metadata.yaml").unlink()
    assert import_with(folder) == DONE
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-300])
    capsys.readouterr()
    assert import_with(folder, out="cut") == WRONG_INPUT
    said = capsys.readouterr().err
    assert f"{file}: cannot be read as a ROS bag" in said and said.count("\n") == 1


def test_a_rectifying_node_keeps_the_raw_images_camera_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """image_rect beside image_raw, as stereo_image_proc publishes it."""
    messages = stereo((1, 2))
    for _, kind, message in messages:
        if kind == INFO:
            message.d[0] = -0.01
    rectified = moved(only(IMAGE, messages), lambda topic: topic.replace("image_raw", "image_rect"))
    source = write_bag2(tmp_path / "proc", [*messages, *rectified])
    assert import_with(source, "--topics", "/left/image_rect,/right/image_rect") == WRONG_INPUT
    assert "is of the raw images; choose those by --topics, or give --calibration" in capsys.readouterr().err
    assert import_with(source, "--topics", "/left/image_raw,/right/image_raw") == DONE
    options = ("--topics", "/left/image_rect,/right/image_rect", *calibration(tmp_path))
    assert import_with(source, *options, out="rectified") == DONE


def test_recordings_beside_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = save(tmp_path / "day", *(f"run{n}/{eye}/1.png" for n in (1, 2) for eye in ("left", "right")))
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    assert "has several recordings" in capsys.readouterr().err
    assert import_with(source / "run1", *calibration(tmp_path)) == DONE
    source = save(tmp_path / "both", "left/1.png", "right/1.png")
    write_bag2(source / "bag", stereo((1,)))
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    assert "holds images and the bag" in capsys.readouterr().err
    assert import_with(source / "bag") == DONE


def test_times_before_zero_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = save(tmp_path / "flight", *(f"{eye}/{number}.png" for eye in ("left", "right") for number in (0, 1)))
    (source / "times.txt").write_text("-5.0\n0.1\n")
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "left/0.png: its time must be at least 0, got -5.0 s" in line
    (source / "times.txt").write_text("0.0\n0.1\n")
    assert import_with(source, *calibration(tmp_path)) == DONE


@pytest.mark.parametrize("place", ["", "left"])
def test_metadata_of_other_programs_makes_no_bag(place: str, tmp_path: Path) -> None:
    source = save(tmp_path / "flight", "left/1.png", "right/1.png")
    (source / place / "metadata.yaml").write_text("camera: left and right\nexposure_ms: 2\n")
    assert import_with(source, *calibration(tmp_path)) == DONE
    assert times_s(source) == [0.0]


def test_metadata_or_recordings_make_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A bag is one though its metadata is damaged, or its recording is missing."""
    bag = write_bag2(tmp_path / "bag", stereo((1,)))
    (recording,) = bag.glob("*.mcap")
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text("damaged: true\n")
    assert import_with(bag) == WRONG_INPUT and "bag" in capsys.readouterr().err
    (bag / "metadata.yaml").write_text(text)
    recording.unlink()
    assert import_with(bag) == WRONG_INPUT
    assert "holds no images" not in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp"])
def test_a_damaged_picture_is_told_in_one_line(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(4).integers(256, size=(HEIGHT, WIDTH, 3), dtype=np.uint8)
    source = save(tmp_path / "flight", f"left/1.{suffix}", f"right/1.{suffix}", values=noise)
    path = source / f"left/1.{suffix}"
    whole = path.read_bytes()
    path.write_bytes(whole[:-2] + bytes(range(1, 41)) + whole[-2:] if suffix == "jpg" else whole[:-30])
    assert import_with(source, *calibration(tmp_path)) == WRONG_INPUT
    (line,) = capfd.readouterr().err.splitlines()
    assert f"left/1.{suffix}: is " in line and "damaged" in line


@pytest.mark.parametrize("bits", [8, 16])
def test_raw_mosaics_are_kept(bits: int, tmp_path: Path) -> None:
    """FLIR's bayer_rggb8, and bayer_rggb16 with 12 bits in the upper part."""
    dtype = np.uint8 if bits == 8 else np.dtype("<u2")
    mosaic = (np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) * (1 if bits == 8 else 64 << 4)).astype(dtype)
    messages: Messages = []
    for eye in ("left", "right"):
        data = mosaic.view(np.uint8).reshape(-1)
        fields = (header(HUMBLE, 1), HEIGHT, WIDTH, f"bayer_rggb{bits}", 0, data.size // HEIGHT, data)
        messages.append((f"/{eye}/image_raw", IMAGE, HUMBLE.types[IMAGE](*fields)))
    source = write_bag2(tmp_path / "flir", [*messages, *only(INFO, stereo((1,)))])
    assert import_with(source, "--encoding", "linear") == DONE
    images = BlindDataset(tmp_path / "imported").pair(0).images
    want = mosaic if bits == 8 else mosaic >> 4
    for kept in (images.left_mosaic, images.right_mosaic):
        np.testing.assert_array_equal(kept, want)
    assert images.left.shape == (HEIGHT, WIDTH, 3) and images.bits == (8 if bits == 8 else 12)
