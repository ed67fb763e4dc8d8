"""Stereo pairs in a ROS 1 or ROS 2 bag."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from datasets_manifest.calibration.camera_info import CameraInfo, rig_of_camera_info
from datasets_manifest.importers.imported_dataset import ImportedPair
from datasets_manifest.importers.ros_images import decode_image, message_stamp_ns
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig

_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO_TYPE = "sensor_msgs/msg/CameraInfo"


class RosBag:
    """The pairs of a bag: images with equal time stamps.

    Attributes:
        count: number of pairs.
        left_out: images without a partner.
    """

    def __init__(self, path: Path, topics: tuple[str, str] | None = None) -> None:
        """List the pairs of a bag; images are decoded later.

        Args:
            path: a rosbag2 folder, or a `.bag` file of ROS 1.
            topics: of the left and the right images; by default the two whose names differ in left and right.

        Raises:
            ValueError: not a bag, a damaged one, or topics that do not fit.
        """
        self._path = path
        with self._open() as reader:
            self._topics = topics or _stereo_topics(reader)
            for topic in self._topics:
                if not any(c.topic == topic and c.msgtype in _IMAGE_TYPES for c in reader.connections):
                    raise ValueError(f"{path}: has no images on {topic}; there are {_image_topics(reader)}")
            stamps: dict[str, set[int]] = {topic: set() for topic in self._topics}
            for connection, _, message in _messages(reader, self._topics, path):
                stamp_ns = message_stamp_ns(message)
                if stamp_ns in stamps[connection.topic]:
                    raise ValueError(
                        f"{path}: {connection.topic} has two images stamped {stamp_ns} ns, which cannot be paired"
                    )
                stamps[connection.topic].add(stamp_ns)
        left, right = (stamps[topic] for topic in self._topics)
        self._both = left & right
        alone = {self._topics[0]: left - right, self._topics[1]: right - left}
        self.left_out = tuple(
            f"{topic}: {len(times)} images without one of the same time stamp on the other topic"
            for topic, times in alone.items()
            if times
        )
        self.count = len(self._both)
        if not self.count:
            raise ValueError(f"{path}: no images on {' and '.join(self._topics)} have equal time stamps")

    def __iter__(self) -> Iterator[ImportedPair]:
        waiting: dict[int, dict[str, Any]] = {}
        with self._open() as reader:
            for connection, _, message in _messages(reader, self._topics, self._path):
                stamp_ns = message_stamp_ns(message)
                if stamp_ns not in self._both:
                    continue
                views = waiting.setdefault(stamp_ns, {})
                views[connection.topic] = message
                if len(views) == len(EYES):
                    name = f"{self._path}: at {stamp_ns} ns"
                    left, right = (decode_image(views[topic], name) for topic in self._topics)
                    del waiting[stamp_ns]
                    yield ImportedPair(self._topics, 1e-9 * stamp_ns, left, right)

    def rig(self) -> StereoRig:
        """The cameras, from the CameraInfo of both image topics; their rectified left one is the left frame.

        Raises:
            ValueError: there is none, or it does not describe a stereo pair.
        """
        for topic in self._topics:
            if "image_rect" in topic:
                raise ValueError(
                    f"{topic}: is rectified, and its CameraInfo is the raw images'; choose those by --topics, or give "
                    "--calibration"
                )
        topics = tuple(topic.removesuffix("/compressed").rsplit("/", 1)[0] + "/camera_info" for topic in self._topics)
        found: dict[str, Any] = {}
        with self._open() as reader:
            for connection, _, message in _messages(reader, topics, self._path):
                found.setdefault(connection.topic, message)
                if len(found) == len(EYES):
                    break
        if len(found) < len(EYES):
            raise ValueError(f"{self._path}: has no CameraInfo on {' and '.join(topics)}; give --calibration")
        left, right = (_camera_info(found[topic], f"{self._path}: {topic}") for topic in topics)
        return rig_of_camera_info(left, right)

    @contextmanager
    def _open(self) -> Iterator[AnyReader]:
        try:
            reader = AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        except Exception as error:  # whatever a damaged bag makes its reader raise
            message = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{self._path}: is not a ROS bag: {message}") from error
        try:
            yield reader
        finally:
            reader.close()


def _messages(reader: AnyReader, topics: tuple[str, ...], path: Path) -> Iterator[tuple[Connection, int, Any]]:
    """Decoded messages of some topics; errors of the reader on damaged bags become a ValueError of one line."""
    connections = [connection for connection in reader.connections if connection.topic in topics]
    if not connections:
        return
    try:
        for connection, time_ns, data in reader.messages(connections=connections):
            yield connection, time_ns, reader.deserialize(data, connection.msgtype)
    except GeneratorExit:
        raise
    except Exception as error:
        raise ValueError(f"{path}: is damaged: {type(error).__name__}: {error}") from error


def _image_topics(reader: AnyReader) -> str:
    return ", ".join(sorted(c.topic for c in reader.connections if c.msgtype in _IMAGE_TYPES)) or "none"


def _stereo_topics(reader: AnyReader) -> tuple[str, str]:
    """The image topics whose names differ in left and right."""
    topics = {connection.topic for connection in reader.connections if connection.msgtype in _IMAGE_TYPES}
    pairs = sorted((topic, topic.replace("left", "right")) for topic in topics if "left" in topic)
    pairs = [pair for pair in pairs if pair[1] in topics]
    if len(pairs) != 1:
        raise ValueError(
            f"topics: {len(pairs)} pairs of image topics are named left and right; choose by --topics LEFT,RIGHT from "
            f"{_image_topics(reader)}"
        )
    return pairs[0]


def _camera_info(message: Any, topic: str) -> CameraInfo:
    size_px, model = (int(message.width), int(message.height)), str(message.distortion_model)
    return CameraInfo(topic, size_px, model, *(_numbers(message, name) for name in ("d", "k", "r", "p")))


def _numbers(info: Any, name: str) -> Array:
    """A field of CameraInfo, whose matrices have capital names in ROS 1."""
    return np.asarray(getattr(info, name if hasattr(info, name) else name.upper()), dtype=np.float64).reshape(-1)
