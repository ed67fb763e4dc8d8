"""Messages and bags of a stereo rig, written by the rosbags library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

HUMBLE, NOETIC = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
IMAGE, INFO, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
TEXT = "std_msgs/msg/String"
WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 8, 6, 20.0, 0.25


def header(types: Any, stamp_s: float, *sequence: int) -> Any:
    stamp = types.types["builtin_interfaces/msg/Time"](*divmod(round(stamp_s * 1e9), 10**9))
    return types.types["std_msgs/msg/Header"](*sequence, stamp, "")


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


def write_bag1(path: Path, stamps_s: tuple[float, ...]) -> Path:
    """A bag of ROS 1 with as many pairs, and their calibration."""
    with Writer1(path) as writer:
        connections = {
            (eye, kind): writer.add_connection(f"/{eye}/{name}", kind, typestore=NOETIC)
            for eye in ("left", "right")
            for kind, name in ((IMAGE, "image_raw"), (INFO, "camera_info"))
        }
        for place, stamp_s in enumerate(stamps_s):
            for (eye, kind), connection in connections.items():
                head, is_right = header(NOETIC, stamp_s, 0), eye == "right"
                message = image(NOETIC, head, 10 * place + 7) if kind == IMAGE else info(NOETIC, head, is_right)
                writer.write(connection, (place + 1) * 10**8, NOETIC.serialize_ros1(message, kind))
    return path


def write_bag2(path: Path, messages: list[tuple[str, str, Any]], plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """(topic, type, message), a tenth of a second after each other."""
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=HUMBLE) for topic, kind in {m[:2] for m in messages}
        }
        for place, (topic, kind, message) in enumerate(messages):
            writer.write(connections[topic], place * 10**8, HUMBLE.serialize_cdr(message, kind))
    return path


def stereo(stamps_s: tuple[float, ...], encoding: str = "rgb8") -> list[tuple[str, str, Any]]:
    found: list[tuple[str, str, Any]] = []
    for place, stamp_s in enumerate(stamps_s):
        for is_right, eye in enumerate(("left", "right")):
            head = header(HUMBLE, stamp_s)
            found.append((f"/{eye}/image_raw", IMAGE, image(HUMBLE, head, 10 * place + 50 * is_right, encoding)))
            found.append((f"/{eye}/camera_info", INFO, info(HUMBLE, head, bool(is_right))))
    return found
