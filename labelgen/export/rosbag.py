"""A dataset as ROS 2 bags (rosbag2 folders with MCAP files), one for each sequence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PairRecord
from geometry.stereo import EYES, StereoRig
from labelgen.export import ros_messages as ros
from labelgen.export.export_log import ExportLog
from labelgen.export.sequences import SequenceOrder, sequence_name

POSE_TOPIC = "/drogue/pose"
_TOPICS = {
    **{f"/stereo/{eye}/image_raw": "sensor_msgs/msg/Image" for eye in EYES},
    **{f"/stereo/{eye}/camera_info": "sensor_msgs/msg/CameraInfo" for eye in EYES},
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    POSE_TOPIC: "geometry_msgs/msg/PoseStamped",
}
_NEVER = QosTime(2147483647, 4294967295)


def image_topic(eye: str) -> str:
    """Topic of an eye's images."""
    return f"/stereo/{eye}/image_raw"


def camera_info_topic(eye: str) -> str:
    """Topic of an eye's calibration."""
    return f"/stereo/{eye}/camera_info"


def write_rosbag(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write a bag a sequence: images, CameraInfo, transforms, and the true pose of the drogue.

    Args:
        dataset: folder.
        out: folder to make; it holds a folder a bag.
        log: is told the progress, and which pairs have no pose.

    Returns:
        The bags' folders.

    Raises:
        ValueError: a pair that cannot be read, or times that do not ascend.
        OSError: it cannot be written; nothing half-written is left.
    """
    source = Dataset(dataset)
    order = SequenceOrder()
    names = []
    with new_folder(out) as folder, ExitStack() as bag_is_open:
        bag: _Bag | None = None
        for record in log.records(source):
            stamp_ns = order.stamp_ns(record)
            if bag is None or order.is_first:
                bag_is_open.close()
                names.append(sequence_name(record.sequence_id))
                bag = bag_is_open.enter_context(_open_bag(folder / names[-1], record.frame.rig, stamp_ns))
            bag.write_pair(source, record, stamp_ns)
            if record.left_from_drogue is None:
                log.lost("pairs without a drogue have no pose")
    return [out / name for name in names]


class _Bag:
    """One open bag."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections = {
            topic: writer.add_connection(
                topic, type_name, typestore=ros.TYPES, offered_qos_profiles=[_qos(topic == "/tf_static")]
            )
            for topic, type_name in _TOPICS.items()
        }

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        data = ros.TYPES.serialize_cdr(message, _TOPICS[topic])
        self._writer.write(self._connections[topic], stamp_ns, data)

    def write_pair(self, source: Dataset, record: PairRecord, stamp_ns: int) -> None:
        rig, images = record.frame.rig, source.images(record.frame_index)
        moving = ros.moving_transforms(rig, record.frame.world_from_left, record.left_from_drogue)
        self.write("/tf", ros.transforms_message(moving, stamp_ns), stamp_ns)
        for eye in EYES:
            self.write(camera_info_topic(eye), ros.camera_info_message(rig, eye, stamp_ns), stamp_ns)
            self.write(image_topic(eye), ros.image_message(images, eye, stamp_ns), stamp_ns)
        if record.left_from_drogue is not None:
            self.write(POSE_TOPIC, ros.pose_message(record.left_from_drogue, stamp_ns), stamp_ns)


@contextmanager
def _open_bag(path: Path, rig: StereoRig, start_ns: int) -> Iterator[_Bag]:
    """A new bag with what stands still in it."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        bag = _Bag(writer)
        bag.write("/tf_static", ros.transforms_message(ros.fixed_transforms(rig), start_ns), start_ns)
        yield bag


def _qos(is_kept: bool) -> Qos:
    """Reliable delivery; what is kept reaches those too who listen later."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if is_kept else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if is_kept else QosDurability.VOLATILE,
        deadline=_NEVER,
        lifespan=_NEVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_NEVER,
        avoid_ros_namespace_conventions=False,
    )
