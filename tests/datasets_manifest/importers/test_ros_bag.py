"""Bags that are not ours, written by the rosbags library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from datasets_manifest.importers.ros_bag import RosBag

HUMBLE, NOETIC = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
IMAGE, INFO, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 8, 6, 20.0, 0.25


def header(types: Any, stamp_s: int, *sequence: int) -> Any:
    return types.types["std_msgs/msg/Header"](*sequence, types.types["builtin_interfaces/msg/Time"](stamp_s, 0), "")


def picture(value: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), (value, value + 1, value + 2), np.uint8)


def image(types: Any, head: Any, value: int, encoding: str = "rgb8") -> Any:
    data = picture(value)[:, :, ::-1] if encoding == "bgr8" else picture(value)
    return types.types[IMAGE](head, HEIGHT, WIDTH, encoding, 0, 3 * WIDTH, np.ascontiguousarray(data).reshape(-1))


def info(types: Any, head: Any, is_right: bool) -> Any:
    k = np.array([FOCAL_PX, 0, 3.5, 0, FOCAL_PX, 2.5, 0, 0, 1])
    p = np.array([FOCAL_PX, 0, 3.5, -FOCAL_PX * BASELINE_M * is_right, 0, FOCAL_PX, 2.5, 0, 0, 0, 1, 0])
    region = types.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return types.types[INFO](head, HEIGHT, WIDTH, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region)


def write_bag2(path: Path, messages: list[tuple[str, str, Any]]) -> Path:
    """(topic, type, message), a tenth of a second after each other."""
    with Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=HUMBLE) for topic, kind in {m[:2] for m in messages}
        }
        for place, (topic, kind, message) in enumerate(messages):
            writer.write(connections[topic], place * 10**8, HUMBLE.serialize_cdr(message, kind))
    return path


def stereo(stamps_s: tuple[int, ...], encoding: str = "rgb8") -> list[tuple[str, str, Any]]:
    found: list[tuple[str, str, Any]] = []
    for place, stamp_s in enumerate(stamps_s):
        for is_right, eye in enumerate(("left", "right")):
            head = header(HUMBLE, stamp_s)
            found.append((f"/{eye}/image_raw", IMAGE, image(HUMBLE, head, 10 * place + 50 * is_right, encoding)))
            found.append((f"/{eye}/camera_info", INFO, info(HUMBLE, head, bool(is_right))))
    return found


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
    path = tmp_path / "flight.bag"
    with Writer1(path) as writer:
        for is_right, eye in enumerate(("left", "right")):
            for kind, topic in ((IMAGE, f"/{eye}/image_raw"), (INFO, f"/{eye}/camera_info")):
                connection = writer.add_connection(topic, kind, typestore=NOETIC)
                head = header(NOETIC, 1, 0)
                message = image(NOETIC, head, 7) if kind == IMAGE else info(NOETIC, head, bool(is_right))
                writer.write(connection, 10**9, NOETIC.serialize_ros1(message, kind))
    bag = RosBag(path)
    assert [pair.left[0, 0, 0] for pair in bag] == [7]
    assert bag.rig().baseline_m == pytest.approx(BASELINE_M)


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


def test_what_cannot_be_paired_or_rectified_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two images stamped 0 ns"):
        RosBag(write_bag2(tmp_path / "unstamped", stereo((0, 0))))
    rectified = [(topic.replace("image_raw", "image_rect"), kind, message) for topic, kind, message in stereo((1,))]
    with pytest.raises(ValueError, match="is rectified"):
        RosBag(write_bag2(tmp_path / "rectified", rectified)).rig()
    with pytest.raises(ValueError, match="no images on /a"):
        RosBag(tmp_path / "rectified", ("/a", "/b"))
    with pytest.raises(ValueError, match="is not a ROS bag"):
        RosBag(tmp_path / "nowhere")
