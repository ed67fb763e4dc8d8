"""Bags that are not ours, written by the rosbags library."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag2 import StoragePlugin

from datasets_manifest.importers.ros_bag import RosBag
from datasets_manifest.importers.ros_images import decode_image
from tests.support.ros_messages import (
    BASELINE_M,
    COMPRESSED,
    FOCAL_PX,
    HEIGHT,
    HUMBLE,
    IMAGE,
    INFO,
    TEXT,
    WIDTH,
    header,
    image,
    picture,
    stereo,
    write_bag1,
    write_bag2,
)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_pairs_and_calibration_of_a_ros_2_bag(encoding: str, tmp_path: Path) -> None:
    bag = RosBag(write_bag2(tmp_path / "bag", stereo((1, 2, 3), encoding)))
    pairs = list(bag)
    assert bag.count == len(pairs) == 3
    for place, pair in enumerate(pairs):
        np.testing.assert_array_equal(pair.left, picture(10 * place))
        np.testing.assert_array_equal(pair.right, picture(10 * place + 50))
        assert pair.time_s == place + 1
    rig = bag.rig()
    assert rig.baseline_m == pytest.approx(BASELINE_M) and rig.camera.fx_px == FOCAL_PX and rig.lenses is None


def test_a_ros_1_bag_has_matrices_with_capital_names(tmp_path: Path) -> None:
    bag = RosBag(write_bag1(tmp_path / "flight.bag", (1,)))
    assert [pair.left[0, 0, 0] for pair in bag] == [7]
    assert bag.rig().baseline_m == pytest.approx(BASELINE_M)


@pytest.mark.parametrize("name", ["X.BAG", "X.MCAP", "X.Db3"])
def test_a_suffix_may_be_in_capitals(name: str, tmp_path: Path) -> None:
    capital = tmp_path / name
    if name == "X.BAG":
        write_bag1(tmp_path / "x.bag", (1,)).rename(capital)
    else:
        plugin = StoragePlugin.MCAP if name == "X.MCAP" else StoragePlugin.SQLITE3
        bag = write_bag2(tmp_path / "x", stereo((1,)), plugin)
        (file,) = (path for path in bag.iterdir() if path.suffix == name[1:].lower())
        file.rename(capital)
    assert RosBag(capital).count == 1


def test_compressed_images_have_their_calibration_beside_the_raw_topic(tmp_path: Path) -> None:
    messages = [message for message in stereo((1,)) if message[1] == INFO]
    for eye in ("left", "right"):
        data = np.frombuffer(cv2.imencode(".png", picture(9)[:, :, ::-1])[1].tobytes(), np.uint8)
        message = HUMBLE.types[COMPRESSED](header(HUMBLE, 1), "png", data)
        messages.append((f"/{eye}/image_raw/compressed", COMPRESSED, message))
    bag = RosBag(write_bag2(tmp_path / "bag", messages))
    (pair,) = bag
    np.testing.assert_array_equal(pair.left, picture(9))
    assert bag.rig().camera.width_px == WIDTH


def test_images_without_a_partner_are_told(tmp_path: Path) -> None:
    messages = stereo((1, 2))
    del messages[-2]  # the second right image
    bag = RosBag(write_bag2(tmp_path / "bag", messages))
    assert bag.count == 1 and bag.left_out == (
        "/left/image_raw: 1 images without one of the same time stamp on the other topic",
    )


def test_what_cannot_be_paired_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two images stamped 0 ns"):
        RosBag(write_bag2(tmp_path / "unstamped", stereo((0, 0))))
    with pytest.raises(ValueError, match="two images stamped 2000000000 ns"):
        RosBag(write_bag2(tmp_path / "repeated", stereo((1, 2, 2, 3))))
    with pytest.raises(ValueError, match=r"no images on /a; there are /left/image_raw, /right/image_raw$"):
        RosBag(tmp_path / "unstamped", ("/a", "/b"))
    with pytest.raises(ValueError, match="cannot be read as a ROS bag"):
        RosBag(tmp_path / "nowhere")


@pytest.mark.parametrize("order", [(3, 2, 1), (2, 3, 1), (1, 3, 2)])
def test_pairs_come_in_the_order_of_their_stamps(order: tuple[int, ...], tmp_path: Path) -> None:
    """However they were recorded: a tracker and a filter need time that ascends."""
    bag = RosBag(write_bag2(tmp_path / "bag", stereo(order)))
    pairs = list(bag)
    assert [pair.time_s for pair in pairs] == [1.0, 2.0, 3.0]
    # `stereo` paints by the place in the recording.
    assert [int(pair.left[0, 0, 0]) for pair in pairs] == [10 * order.index(stamp) for stamp in (1, 2, 3)]
    assert [int(pair.right[0, 0, 0]) for pair in pairs] == [10 * order.index(stamp) + 50 for stamp in (1, 2, 3)]


def test_one_view_may_be_recorded_long_after_the_other(tmp_path: Path) -> None:
    messages = sorted(stereo(tuple(range(1, 20))), key=lambda message: "right" in message[0])
    assert len(list(RosBag(write_bag2(tmp_path / "bag", messages)))) == 19


def test_two_clocks_in_a_bag_are_refused(tmp_path: Path) -> None:
    bag = RosBag(write_bag2(tmp_path / "bag", stereo((*range(1000, 1300), 5))))
    with pytest.raises(ValueError, match=r"pairs were recorded before the one stamped 5000000000 ns.*one clock"):
        list(bag)


def apart(difference_s: float) -> list[tuple[str, str, Any]]:
    """Three pairs whose right images are stamped later than the left ones."""
    found = []
    for stamp_s in (1.0, 1.1, 1.2):
        for is_right, eye in enumerate(("left", "right")):
            head = header(HUMBLE, stamp_s + is_right * difference_s)
            found.append((f"/{eye}/image_raw", IMAGE, image(HUMBLE, head, 50 * is_right)))
    return found


def test_stamps_of_a_pair_may_differ_within_the_tolerance(tmp_path: Path) -> None:
    path = write_bag2(tmp_path / "bag", apart(0.002))
    with pytest.raises(ValueError, match=r"equal time stamps; the nearest differ by 2 ms \(--stamp-tolerance-ms\)"):
        RosBag(path)
    bag = RosBag(path, tolerance_ns=2_000_000)
    assert [pair.time_s for pair in bag] == pytest.approx([1.0, 1.1, 1.2])
    assert bag.remarks == ("times: those of the left images; the right ones' differ by up to 2 ms",)
    with pytest.raises(ValueError, match="has two partners within 150 ms"):
        RosBag(path, tolerance_ns=150_000_000)


def renamed(messages: list[tuple[str, str, Any]], *changes: tuple[str, str]) -> list[tuple[str, str, Any]]:
    found = []
    for topic, kind, message in messages:
        for old, new in changes:
            topic = topic.replace(old, new)
        found.append((topic, kind, message))
    return found


@pytest.mark.parametrize(
    "changes",
    [
        (("/left/image_raw", "/camera/infra1/image_rect_raw"), ("/right/image_raw", "/camera/infra2/image_rect_raw"),
         ("/left/", "/camera/infra1/"), ("/right/", "/camera/infra2/")),
        (("/left/image_raw", "/zed/zed_node/left/image_rect_color"),
         ("/right/image_raw", "/zed/zed_node/right/image_rect_color"),
         ("/left/camera", "/zed/zed_node/left/camera"), ("/right/camera", "/zed/zed_node/right/camera")),
        (("/left/image_raw", "/zed/zed_node/left/color/rect/image"),
         ("/right/image_raw", "/zed/zed_node/right/color/rect/image"),
         ("/left/camera", "/zed/zed_node/left/color/rect/camera"),
         ("/right/camera", "/zed/zed_node/right/color/rect/camera")),
    ],
)  # fmt: skip
def test_rectified_images_with_their_own_camera_info_are_read(
    changes: tuple[tuple[str, str], ...], tmp_path: Path
) -> None:
    bag = RosBag(write_bag2(tmp_path / "bag", renamed(stereo((1, 2)), *changes)))
    rig = bag.rig()
    assert len(list(bag)) == 2
    assert rig.lenses is None and rig.camera.fx_px == FOCAL_PX and rig.baseline_m == pytest.approx(BASELINE_M)


@pytest.mark.parametrize("field", ["d", "k", "r"])
def test_rectified_images_with_the_raw_ones_camera_info_are_refused(field: str, tmp_path: Path) -> None:
    messages = renamed(stereo((1,)), ("image_raw", "image_rect"))
    for _, kind, message in messages:
        if kind == INFO:
            getattr(message, field)[0 if field == "d" else 4 if field == "k" else 1] += 0.01
    with pytest.raises(ValueError, match=r"image_rect: is rectified, and .*camera_info is of the raw images"):
        RosBag(write_bag2(tmp_path / "bag", messages)).rig()


def test_camera_info_of_another_name_can_be_named(tmp_path: Path) -> None:
    bag = RosBag(
        write_bag2(tmp_path / "bag", renamed(stereo((1,)), ("/left/camera_info", "/info/a"), ("/right/c", "/c")))
    )
    with pytest.raises(ValueError, match=r"no CameraInfo on .*by --camera-info LEFT,RIGHT from /camera_info, /info/a"):
        bag.rig()
    assert bag.rig(("/info/a", "/camera_info")).baseline_m == pytest.approx(BASELINE_M)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda info: setattr(info.roi, "x_offset", 2), "region of interest or binning"),
        (lambda info: setattr(info, "binning_y", 2), "region of interest or binning"),
    ],
)
def test_camera_info_of_a_part_of_the_sensor_is_refused(change: Any, fault: str, tmp_path: Path) -> None:
    messages = stereo((1,))
    change(messages[1][2])
    with pytest.raises(ValueError, match=f"/left/camera_info: has a {fault}"):
        RosBag(write_bag2(tmp_path / "bag", messages)).rig()


def test_camera_info_that_changes_is_refused(tmp_path: Path) -> None:
    messages = stereo((1, 2))
    messages[-1][2].p[3] *= 1.1
    with pytest.raises(ValueError, match="/right/camera_info changes at 2000000000 ns"):
        RosBag(write_bag2(tmp_path / "bag", messages)).rig()


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bare_file_of_a_bag_is_read(plugin: StoragePlugin, tmp_path: Path) -> None:
    folder = write_bag2(tmp_path / "bag", stereo((1, 2)), plugin)
    (file,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    file.rename(tmp_path / file.name)
    bag = RosBag(tmp_path / file.name)
    assert len(list(bag)) == 2 and bag.rig().baseline_m == pytest.approx(BASELINE_M)


def turned_jpeg(orientation: int) -> np.ndarray:
    """A picture whose upper half is bright, with an EXIF orientation."""
    picture, exif, stream = np.zeros((HEIGHT, WIDTH, 3), np.uint8), Image.Exif(), io.BytesIO()
    picture[: HEIGHT // 2] = 250
    exif[274] = orientation
    Image.fromarray(picture).save(stream, "JPEG", quality=100, exif=exif)
    return np.frombuffer(stream.getvalue(), np.uint8)


def compressed(data: np.ndarray, kind: str = "jpeg") -> list[tuple[str, str, Any]]:
    return [
        (f"/{eye}/image_raw/compressed", COMPRESSED, HUMBLE.types[COMPRESSED](header(HUMBLE, 1), kind, data))
        for eye in ("left", "right")
    ]


def test_compressed_images_are_turned_as_their_exif_orientation_says(tmp_path: Path) -> None:
    (pair,) = RosBag(write_bag2(tmp_path / "bag", compressed(turned_jpeg(3))))
    assert pair.left[0, 0, 0] < 60 and pair.left[-1, 0, 0] > 190 and pair.turned_count == 2
    (pair,) = RosBag(write_bag2(tmp_path / "upright", compressed(turned_jpeg(1))))
    assert pair.left[0, 0, 0] > 190 and pair.turned_count == 0


def mosaic(pattern: str) -> np.ndarray:
    """The mosaic of a scene of one colour."""
    grey = np.zeros((HEIGHT, WIDTH), np.uint8)
    for place, letter in enumerate(pattern):
        grey[place // 2 :: 2, place % 2 :: 2] = {"r": 40, "g": 90, "b": 200}[letter]
    return grey


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("is_compressed", [False, True])
def test_mosaics_have_their_colours_and_are_kept(pattern: str, is_compressed: bool, tmp_path: Path) -> None:
    grey = mosaic(pattern)
    if is_compressed:
        data = np.frombuffer(cv2.imencode(".png", grey)[1].tobytes(), np.uint8)
        messages = compressed(data, f"bayer_{pattern}8; png compressed bayer_{pattern}8")
    else:
        raw = (header(HUMBLE, 1), HEIGHT, WIDTH, f"bayer_{pattern}8", 0, WIDTH, grey.reshape(-1))
        messages = [(f"/{eye}/image_raw", IMAGE, HUMBLE.types[IMAGE](*raw)) for eye in ("left", "right")]
    (pair,) = RosBag(write_bag2(tmp_path / "bag", messages))
    assert pair.left[2:-2, 2:-2].reshape(-1, 3).tolist() == [[40, 90, 200]] * ((HEIGHT - 4) * (WIDTH - 4))
    if pattern == "rggb":
        np.testing.assert_array_equal(pair.left_mosaic, grey)
        np.testing.assert_array_equal(pair.right_mosaic, grey)
    else:
        assert pair.left_mosaic is None and pair.right_mosaic is None


def with_values(messages: list[tuple[str, str, Any]], *texts: str, topic: str = "/stereo/pixel_values") -> Any:
    return [*messages, *((topic, TEXT, HUMBLE.types[TEXT](text)) for text in texts)]


def values(stamp_s: int, **changes: Any) -> str:
    fields = {"encoding": "linear", "black_level_dn": 4.0, "bits": 8, "exposure_s": 0.002}
    return json.dumps({"stamp_ns": stamp_s * 10**9, **fields, **changes})


@pytest.mark.parametrize("topic", ["/stereo/pixel_values", "/replayed/stereo/pixel_values"])
def test_pixel_values_in_a_bag_belong_to_their_pairs(topic: str, tmp_path: Path) -> None:
    texts = values(2, exposure_s=0.004), values(1)
    bag = RosBag(write_bag2(tmp_path / "bag", with_values(stereo((1, 2)), *texts, topic=topic)))
    said = [pair.values for pair in bag]
    assert [(v.encoding, v.black_level_dn, v.exposure_s) for v in said if v] == [
        ("linear", 4, 0.002),
        ("linear", 4, 0.004),
    ]


def test_pixel_values_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="pixel_values say nothing of the pair at 2000000000 ns"):
        list(RosBag(write_bag2(tmp_path / "one", with_values(stereo((1, 2)), values(1)))))
    with pytest.raises(ValueError, match=r"/stereo/pixel_values: encoding: .*got 'log'"):
        RosBag(write_bag2(tmp_path / "log", with_values(stereo((1,)), values(1, encoding="log"))))
    two = with_values(with_values(stereo((1,)), values(1)), values(1), topic="/b/pixel_values")
    with pytest.raises(ValueError, match="several rigs' pixel values, on /b/pixel_values and /stereo/pixel_values"):
        RosBag(write_bag2(tmp_path / "two", two))


@pytest.mark.parametrize(
    ("encoding", "is_read"), [("8UC1", True), ("16UC1", True), ("8UC3", False), ("yuv422", False), ("32FC1", False)]
)
def test_names_of_encodings(encoding: str, is_read: bool) -> None:
    item = 2 if encoding.startswith("16") else 1
    data = np.arange(HEIGHT * WIDTH * item, dtype=np.uint8)
    message = HUMBLE.types[IMAGE](header(HUMBLE, 1), HEIGHT, WIDTH, encoding, 0, WIDTH * item, data)
    if is_read:
        want = data.view(np.dtype(f"<u{item}")).reshape(HEIGHT, WIDTH)
        np.testing.assert_array_equal(decode_image(message, "a").pixels, want)
    else:
        with pytest.raises(ValueError, match=f"a: encoding '{encoding}' is not read; use rgb8"):
            decode_image(message, "a")


@pytest.mark.parametrize("encoding", ["mono8", "bayer_rggb8"])
@pytest.mark.parametrize(("height", "width"), [(0, WIDTH), (HEIGHT, 0)])
def test_an_image_without_pixels_is_refused(encoding: str, height: int, width: int) -> None:
    message = HUMBLE.types[IMAGE](header(HUMBLE, 1), height, width, encoding, 0, width, np.zeros(0, np.uint8))
    with pytest.raises(ValueError, match=f"a: 0 bytes are not an image of {width}x{height}"):
        decode_image(message, "a")
