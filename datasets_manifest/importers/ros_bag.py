"""Stereo pairs in a ROS 1 or ROS 2 bag."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.reader import Reader as Ros2Reader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore

from datasets_manifest.calibration.camera_info import CameraInfo, rig_of_camera_info
from datasets_manifest.importers.bag_chunks import check_bag, check_database
from datasets_manifest.importers.imported_dataset import ImportedPair
from datasets_manifest.importers.ros_images import RosImage, decode_image, message_stamp_ns
from datasets_manifest.importers.stamp_pairs import match_stamps, smallest_difference_ns
from datasets_manifest.types.images import PIXEL_VALUES_TOPIC, PixelValues, parse_pixel_values
from drogue_models.untrusted_files import limited_memory
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig

_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_TEXT_TYPE = "std_msgs/msg/String"
_READ_TYPES = (*_IMAGE_TYPES, _INFO_TYPE, _TEXT_TYPE)
# The longest definition, that of CameraInfo, has 8000 characters with its comments.
_MOST_DEFINITION = 2**16
# A bag may be played into another namespace.
_PIXEL_VALUES_NAME: Final = PIXEL_VALUES_TOPIC.rsplit("/", 1)[1]
# Words of the left and the right topic's names; those of RealSense and EuRoC are numbered.
_VIEW_WORDS = (
    ("left", "right"),
    ("infra1", "infra2"),
    ("Infrared_1", "Infrared_2"),
    ("cam0", "cam1"),
    ("camera0", "camera1"),
)
_RECTIFIED = re.compile(r"(?<![a-z])rect(?![a-z])|rectified")
# Pairs that wait for an earlier time stamp; more would fill the memory, and come from clocks that were set.
_MOST_WAITING = 256
# Sizes of rounding in the matrices of a rectified image.
_ROUNDING = 1e-9


class RosBag:
    """The pairs of a bag, in the order of their time stamps.

    Attributes:
        count: number of pairs.
        left_out: images without a partner.
        remarks: what was understood.
    """

    def __init__(self, path: Path, topics: tuple[str, str] | None = None, tolerance_ns: int = 0) -> None:
        """List the pairs of a bag; images are decoded later.

        Args:
            path: a rosbag2 folder, a `.mcap` or `.db3` file of one, or a `.bag` file of ROS 1.
            topics: of the left and the right images; by default the two whose names differ in left and right.
            tolerance_ns: by how much the time stamps of a pair may differ. [ns]

        Raises:
            ValueError: not a bag, a damaged one, or topics or time stamps that do not fit.
        """
        self._path = path
        try:
            self._file_bytes = check_bag(path)
        except OSError as error:
            raise ValueError(f"{path}: cannot be read as a ROS bag: {error.strerror}") from error
        with self._open() as reader:
            self._topics = topics or _stereo_topics(reader)
            for topic in self._topics:
                if not any(c.topic == topic and c.msgtype in _IMAGE_TYPES for c in reader.connections):
                    raise ValueError(f"{path}: has no images on {topic}; there are {_topics_of(reader, _IMAGE_TYPES)}")
            stamps: dict[str, set[int]] = {topic: set() for topic in self._topics}
            for connection, message in self._messages(reader, self._topics):
                stamp_ns = message_stamp_ns(message)
                if stamp_ns in stamps[connection.topic]:
                    raise ValueError(
                        f"{path}: {connection.topic} has two images stamped {stamp_ns} ns, which cannot be paired"
                    )
                stamps[connection.topic].add(stamp_ns)
            self._values = self._pixel_values(reader)
        left, right = (stamps[topic] for topic in self._topics)
        self._pairs = match_stamps(left, right, tolerance_ns, str(path))
        self.count = len(self._pairs)
        if not self.count:
            nearest_ns = smallest_difference_ns(left, right)
            hint = (
                "" if nearest_ns is None else f"; the nearest differ by {nearest_ns / 1e6:g} ms (--stamp-tolerance-ms)"
            )
            raise ValueError(f"{path}: no images on {' and '.join(self._topics)} have equal time stamps{hint}")
        within = f" within {tolerance_ns / 1e6:g} ms" if tolerance_ns else ""
        alone = [len(times) - self.count for times in (left, right)]
        self.left_out = tuple(
            f"{topic}: {count} images without one of the same time stamp{within} on the other topic"
            for topic, count in zip(self._topics, alone, strict=True)
            if count
        )
        apart_ns = max(abs(first - second) for first, second in self._pairs)
        said = f"times: those of the left images; the right ones' differ by up to {apart_ns / 1e6:g} ms"
        self.remarks: tuple[str, ...] = (said,) if apart_ns else ()

    def __iter__(self) -> Iterator[ImportedPair]:
        places = [{pair[eye]: place for place, pair in enumerate(self._pairs)} for eye in range(len(EYES))]
        waiting: dict[int, dict[int, Any]] = {}
        due = 0
        with self._open() as reader:
            for connection, message in self._messages(reader, self._topics):
                eye = self._topics.index(connection.topic)
                place = places[eye].get(message_stamp_ns(message))
                if place is None:
                    continue
                waiting.setdefault(place, {})[eye] = message
                while len(waiting.get(due, ())) == len(EYES):
                    views = waiting.pop(due)
                    yield self._pair(due, views[0], views[1])
                    due += 1
                if len(waiting) > _MOST_WAITING:
                    raise ValueError(
                        f"{self._path}: {len(waiting)} pairs were recorded before the one stamped "
                        f"{self._pairs[due][0]} ns, which is earlier; a bag must hold the times of one clock"
                    )

    def _pair(self, place: int, left: Any, right: Any) -> ImportedPair:
        stamps = self._pairs[place]
        images: list[RosImage] = []
        for topic, stamp_ns, message in zip(self._topics, stamps, (left, right), strict=True):
            images.append(decode_image(message, f"{self._path}: {topic} at {stamp_ns} ns"))
        first, second = images
        if self._values is not None and stamps[0] not in self._values:
            raise ValueError(f"{self._path}: its {_PIXEL_VALUES_NAME} say nothing of the pair at {stamps[0]} ns")
        return ImportedPair(
            self._topics,
            1e-9 * stamps[0],
            first.pixels,
            second.pixels,
            left_mosaic=first.mosaic,
            right_mosaic=second.mosaic,
            turned_count=first.is_turned + second.is_turned,
            values=None if self._values is None else self._values[stamps[0]],
        )

    def rig(self, topics: tuple[str, str] | None = None, unit_m: float = 1.0) -> StereoRig:
        """The cameras, from the CameraInfo of both image topics; their rectified left one is the left frame.

        Args:
            topics: of the left and the right CameraInfo; by default `camera_info` beside each image topic.
            unit_m: the unit of the baseline in them; ROS's is the metre. [m]

        Raises:
            ValueError: there is none, it changes, or it does not describe the images of a stereo pair.
        """
        if topics is None:
            bases = [topic.removesuffix("/compressed").rsplit("/", 1)[0] for topic in self._topics]
            topics = f"{bases[0]}/camera_info", f"{bases[1]}/camera_info"
        found: dict[str, Any] = {}
        with self._open() as reader:
            for connection, message in self._messages(reader, topics):
                if connection.msgtype != _INFO_TYPE:
                    continue
                first = found.setdefault(connection.topic, message)
                if _fields(first) != _fields(message):
                    raise ValueError(
                        f"{self._path}: {connection.topic} changes at {message_stamp_ns(message)} ns, and a rig is "
                        "fixed; give --calibration"
                    )
            missing = [topic for topic in topics if topic not in found]
            if missing:
                raise ValueError(
                    f"{self._path}: has no CameraInfo on {' and '.join(missing)}; choose it by --camera-info "
                    f"LEFT,RIGHT from {_topics_of(reader, (_INFO_TYPE,))}, or give --calibration"
                )
        left, right = (
            _camera_info(found[topic], f"{self._path}: {topic}", images)
            for topic, images in zip(topics, self._topics, strict=True)
        )
        return rig_of_camera_info(left, right, unit_m)

    def _pixel_values(self, reader: _BagReader) -> dict[int, PixelValues] | None:
        """What the bag says of the pixel values, by time stamp, or None where it says nothing."""
        topics = {c.topic for c in reader.connections if c.msgtype == _TEXT_TYPE}
        topics = {topic for topic in topics if topic.rsplit("/", 1)[-1] == _PIXEL_VALUES_NAME}
        if len(topics) > 1:
            raise ValueError(f"{self._path}: has several rigs' pixel values, on {' and '.join(sorted(topics))}")
        found: dict[int, PixelValues] = {}
        for connection, message in self._messages(reader, tuple(topics)):
            try:
                values = parse_pixel_values(str(message.data))
            except ValueError as error:
                raise ValueError(f"{self._path}: {connection.topic}: {error}") from error
            found[values.stamp_ns] = values
        return found or None

    def _messages(self, reader: _BagReader, topics: tuple[str, ...]) -> Iterator[tuple[Connection, Any]]:
        """Decoded messages of some topics; errors of the reader on damaged bags become a ValueError of one line."""
        connections = [connection for connection in reader.connections if connection.topic in topics]
        messages = reader.messages(connections)
        while True:
            try:
                # Whoever takes a message takes memory of its own.
                with limited_memory(self._file_bytes):
                    found = next(messages, None)
                    message = None if found is None else reader.deserialize(found[2], found[0].msgtype)
            except Exception as error:
                reason = " ".join(str(error).split())
                raise ValueError(f"{self._path}: is damaged: {type(error).__name__}: {reason}") from error
            if found is None:
                return
            yield found[0], message

    @contextmanager
    def _open(self) -> Iterator[_BagReader]:
        try:
            with limited_memory(self._file_bytes):
                reader = _BagReader(self._path)
        except Exception as error:  # whatever a damaged bag makes its reader raise
            message = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{self._path}: cannot be read as a ROS bag: {message}") from error
        try:
            yield reader
        finally:
            reader.close()


class _Database(Sqlite3Reader):
    def open(self) -> None:
        check_database(Path(str(self.path)))
        super().open()


class _Recording(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {"mcap": McapReader, "sqlite3": _Database}


class _OfAnyCase(dict[str, Any]):
    """By the suffix of a file, which other systems write in capitals."""

    def get(self, key: str, default: Any = None) -> Any:
        return super().get(key.lower(), default)


class _Ros2Reader(Ros2Reader):
    STORAGE_PLUGINS: Mapping[str, Any] = _OfAnyCase({"dir": _Recording, ".mcap": McapReader, ".db3": _Database})


class _BagReader:
    """The topics of a bag that are read here, and their messages.

    Definitions of messages that a bag brings along are compared with those of ROS, and not parsed: a parser may take
    minutes for a hostile one.

    Attributes:
        connections: the topics.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag; whatever a damaged one makes its reader raise is raised."""
        is_ros1 = path.suffix.lower() == ".bag"
        self._reader: Ros1Reader | _Ros2Reader = Ros1Reader(path) if is_ros1 else _Ros2Reader(path)
        self._reader.open()
        try:
            store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
            self.deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
            # Databases give their topics in no certain order; errors name the first by name.
            known = [each for each in self._reader.connections if each.msgtype in _READ_TYPES]
            self.connections = sorted(known, key=lambda connection: connection.topic)
            for kind in _READ_TYPES:
                text, digest = store.generate_msgdef(kind, ros_version=1 if is_ros1 else 2)
                digest = digest if is_ros1 else store.hash_rihs01(kind)
                for connection in self.connections:
                    if connection.msgtype == kind and not _is_defined_as(connection, text, digest):
                        raise ValueError(f"{connection.topic}: its definition of {kind} is not that of ROS")
        except BaseException:
            self._reader.close()
            raise

    def messages(self, connections: Sequence[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Topic, time of recording [ns] and bytes of all messages of some topics."""
        return self._reader.messages(connections=connections) if connections else iter(())

    def close(self) -> None:
        """Close the files."""
        self._reader.close()


def _is_defined_as(connection: Connection, text: str, digest: str) -> bool:
    """Whether a topic's messages are defined by a text and a hash, as far as the bag says."""
    found = connection.msgdef
    if (connection.digest and connection.digest != digest) or len(found.data) > _MOST_DEFINITION:
        return False
    is_text = found.format == MessageDefinitionFormat.MSG and found.data.strip()
    return not is_text or _defined_fields(found.data) == _defined_fields(text)


def _defined_fields(definition: str) -> list[tuple[str, str]]:
    """Types, without their packages, and names of a message's fields, without those of the messages within."""
    lines = (line.partition("#")[0].split() for line in definition.partition("=" * 80)[0].splitlines())
    return [(words[0].rpartition("/")[2], words[1]) for words in lines if len(words) > 1]


def _topics_of(reader: _BagReader, types: tuple[str, ...]) -> str:
    return ", ".join(sorted({c.topic for c in reader.connections if c.msgtype in types})) or "none"


def _stereo_topics(reader: _BagReader) -> tuple[str, str]:
    """The image topics whose names differ in the words for left and right."""
    topics = {c.topic for c in reader.connections if c.msgtype in _IMAGE_TYPES}
    topics = {topic for topic in topics if not topic.endswith("/compressedDepth")}
    pairs = {(topic, topic.replace(left, right)) for topic in topics for left, right in _VIEW_WORDS if left in topic}
    pairs = {pair for pair in pairs if pair[1] in topics}
    if len(topics) < len(EYES):
        raise ValueError(f"topics: a pair needs two image topics; there are {_topics_of(reader, _IMAGE_TYPES)}")
    if len(pairs) != 1:
        raise ValueError(
            f"topics: {len(pairs)} pairs of image topics are named left and right; choose by --topics LEFT,RIGHT from "
            f"{_topics_of(reader, _IMAGE_TYPES)}"
        )
    return pairs.pop()


def _camera_info(message: Any, name: str, image_topic: str) -> CameraInfo:
    """A CameraInfo, of images as they were delivered.

    Raises:
        ValueError: it is of a part of the sensor, or of other images than those of the topic.
    """
    region, size_px = message.roi, (int(message.width), int(message.height))
    is_cut = (region.width, region.height) not in ((0, 0), size_px) or region.x_offset or region.y_offset
    if is_cut or message.binning_x > 1 or message.binning_y > 1:
        raise ValueError(f"{name}: has a region of interest or binning, which is not read; give --calibration")
    D, K, R, P = (_numbers(message, field) for field in "dkrp")
    if _RECTIFIED.search(image_topic):
        want = P.reshape(3, 4)[:, :3].ravel()
        if D.any() or not np.allclose(R, np.eye(3).ravel(), atol=_ROUNDING) or not np.allclose(K, want, rtol=_ROUNDING):
            raise ValueError(
                f"{image_topic}: is rectified, and {name} is of the raw images; choose those by --topics, or give "
                "--calibration"
            )
    return CameraInfo(name, size_px, str(message.distortion_model), D, K, R, P)


def _fields(info: Any) -> tuple[Any, ...]:
    """All that describes the camera in a CameraInfo, to compare two of them."""
    return info.width, info.height, info.distortion_model, *(_numbers(info, name).tolist() for name in "dkrp")


def _numbers(info: Any, name: str) -> Array:
    """A field of CameraInfo, whose matrices have capital names in ROS 1."""
    return np.asarray(getattr(info, name if hasattr(info, name) else name.upper()), dtype=np.float64).reshape(-1)
