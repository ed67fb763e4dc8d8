"""A dataset as ROS 2 bags (rosbag2 folders with MCAP files), one for each sequence.

Frames of reference, each a child of the one before: `map` (east, north, up), `base_link` (the receiver's body: forward,
left, up; REP-103), `stereo_left_optical` (OpenCV's axes), and under it `stereo_right_optical` and `drogue`. Images and
calibrations of both eyes are stamped `stereo_left_optical`, as ROS wants of stereo pairs.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from datasets_manifest.atomic import new_folder
from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.images import PIXEL_VALUES_TOPIC, PixelValues, StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import drogue_text, load_drogue, preset_names
from geometry.se3 import FLU_FROM_FRD, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.export.export_log import ExportLog, SequenceOrder, sequence_name

DROGUE_FILE = "drogue.toml"

MAP_FRAME, BASE_FRAME = "map", "base_link"

LEFT_FRAME, RIGHT_FRAME, DROGUE_FRAME = "stereo_left_optical", "stereo_right_optical", "drogue"

POSE_TOPIC = "/drogue/pose"

_TOPICS = {
    **{f"/stereo/{eye}/image_raw": "sensor_msgs/msg/Image" for eye in EYES},
    **{f"/stereo/{eye}/camera_info": "sensor_msgs/msg/CameraInfo" for eye in EYES},
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    POSE_TOPIC: "geometry_msgs/msg/PoseStamped",
    PIXEL_VALUES_TOPIC: "std_msgs/msg/String",
}

# Message definitions of the oldest ROS 2 release that is still maintained; later ones read them.
TYPES = get_typestore(Stores.ROS2_HUMBLE)

_NANOSECONDS = 10**9

_NEVER = QosTime(2147483647, 4294967295)


def write_rosbag(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write a bag for each sequence: images, their meaning, CameraInfo, transforms, and the drogue's true pose.

    Args:
        dataset: folder.
        out: folder to make; it holds a folder for each bag, and a file of the drogue where that is no shipped one.
        log: receives the progress, and counts pairs without a pose and drogues beside the sought one.

    Returns:
        The bags' folders, and the drogue's file.

    Raises:
        ValueError: a pair that cannot be read, or times that do not ascend.
        OSError: it cannot be written; nothing incomplete is left.
    """
    source = Dataset(dataset)
    recipe = source.manifest.recipe
    log.remarks.append(_drogue_remark(recipe, out / DROGUE_FILE))
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
            log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
            if record.left_from_drogue is None:
                log.lost("pairs without a drogue have no pose")
        if not recipe.variants and not _is_shipped(recipe.drogue):
            names.append(DROGUE_FILE)
            (folder / DROGUE_FILE).write_text(drogue_text(recipe.drogue), encoding="utf-8")
    return [out / name for name in names]


def _is_shipped(drogue: DrogueParameters) -> bool:
    return drogue.name in preset_names() and load_drogue(drogue.name) == drogue


def _drogue_remark(recipe: Recipe, file: Path) -> str:
    """How to tell the command `import`, which takes a bag for one of the preset red-8, which drogue it shows."""
    if recipe.variants:
        return "shows several drogues, and import knows one for all pairs"
    drogue = recipe.drogue
    if _is_shipped(drogue):
        return f"import it with --drogue {drogue.name}"
    mesh = "" if drogue.body_mesh is None else f"; its mesh {drogue.body_mesh.path} must lie in that file's folder"
    return f"import it with --drogue {file}{mesh}"


class _Bag:
    """One open bag."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections = {
            topic: writer.add_connection(
                topic, type_name, typestore=TYPES, offered_qos_profiles=[_qos(topic == "/tf_static")]
            )
            for topic, type_name in _TOPICS.items()
        }

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        data = TYPES.serialize_cdr(message, _TOPICS[topic])
        self._writer.write(self._connections[topic], stamp_ns, data)

    def write_pair(self, source: Dataset, record: PairRecord, stamp_ns: int) -> None:
        rig, images = record.frame.rig, source.images(record.frame_index)
        moving = moving_transforms(rig, record.frame.world_from_left, record.left_from_drogue)
        self.write("/tf", transforms_message(moving, stamp_ns), stamp_ns)
        values = message("std_msgs/msg/String", pixel_values(images, record.frame.sensor, stamp_ns).as_text())
        self.write(PIXEL_VALUES_TOPIC, values, stamp_ns)
        for eye in EYES:
            self.write(camera_info_topic(eye), camera_info_message(rig, eye, stamp_ns), stamp_ns)
            self.write(image_topic(eye), image_message(images, eye, stamp_ns), stamp_ns)
        if record.left_from_drogue is not None:
            self.write(POSE_TOPIC, pose_message(record.left_from_drogue, stamp_ns), stamp_ns)


@contextmanager
def _open_bag(path: Path, rig: StereoRig, start_ns: int) -> Iterator[_Bag]:
    """A new bag with the fixed transforms."""
    # Humble reads no newer form of metadata; later releases read this one.
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        bag = _Bag(writer)
        bag.write("/tf_static", transforms_message(fixed_transforms(rig), start_ns), start_ns)
        yield bag


def _qos(is_kept: bool) -> Qos:
    """Reliable delivery; with `is_kept` later subscribers receive the last message too."""
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


def image_topic(eye: str) -> str:
    """Topic of an eye's images."""
    return f"/stereo/{eye}/image_raw"


def camera_info_topic(eye: str) -> str:
    """Topic of an eye's calibration."""
    return f"/stereo/{eye}/camera_info"


def message(type_name: str, *values: Any) -> Any:
    """A message of a type such as `sensor_msgs/msg/Image`, with its fields in their order."""
    return TYPES.types[type_name](*values)


def header(stamp_ns: int, frame: str) -> Any:
    """Time stamp and frame of reference."""
    stamp = message("builtin_interfaces/msg/Time", *divmod(stamp_ns, _NANOSECONDS))
    return message("std_msgs/msg/Header", stamp, frame)


def image_message(images: StereoImages, eye: Eye, stamp_ns: int) -> Any:
    """The image of an eye; of a Bayer sensor the raw mosaic."""
    left_pixels, left_mosaic = images.left, images.left_mosaic
    pixels, mosaic = (left_pixels, left_mosaic) if eye == "left" else (images.right, images.right_mosaic)
    kind = "bayer_rggb" if mosaic is not None else "rgb" if pixels.ndim == 3 else "mono"
    data = np.ascontiguousarray(pixels if mosaic is None else mosaic)
    height, width = data.shape[:2]
    return message(
        "sensor_msgs/msg/Image",
        header(stamp_ns, LEFT_FRAME),
        height,
        width,
        f"{kind}{8 * data.itemsize}",
        int(sys.byteorder == "big"),
        data.nbytes // height,
        data.reshape(-1).view(np.uint8),
    )


def pixel_values(images: StereoImages, sensor: Sensor, stamp_ns: int) -> PixelValues:
    """Meaning of the pixel values of a pair's Image messages: of the raw mosaic where there is one."""
    encoding, black_level_dn = images.encoding, images.black_level_dn
    if images.left_mosaic is not None and encoding != "linear":
        # The record has the black level of the image on the sRGB curve; the mosaic is linear.
        encoding = "linear"
        black_level_dn = float(round(sensor.black_level_dn * 2.0 ** (sensor.output_bits - sensor.adc_bits)))
    return PixelValues(
        stamp_ns=stamp_ns,
        encoding=encoding,
        black_level_dn=black_level_dn,
        bits=images.bits,
        exposure_s=images.exposure_s,
    )


def camera_info_message(rig: StereoRig, eye: Eye, stamp_ns: int) -> Any:
    """Calibration of an eye; the right one's projection has -f B in its last column."""
    matrices = opencv_stereo_matrices(rig)
    number = EYES.index(eye) + 1
    intrinsics, distortion, rotation, projection = (matrices[f"{name}{number}"] for name in ("M", "D", "R", "P"))
    everything = message("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    return message(
        "sensor_msgs/msg/CameraInfo",
        header(stamp_ns, LEFT_FRAME),
        rig.camera.height_px,
        rig.camera.width_px,
        "plumb_bob",
        *(np.array(matrix, dtype=np.float64).reshape(-1) for matrix in (distortion, intrinsics, rotation, projection)),
        0,
        0,
        everything,
    )


def pose_message(left_from_drogue: RigidTransform, stamp_ns: int) -> Any:
    """The drogue in the left eye's frame."""
    point = message("geometry_msgs/msg/Point", *left_from_drogue.translation_m.tolist())
    pose = message("geometry_msgs/msg/Pose", point, _quaternion(left_from_drogue))
    return message("geometry_msgs/msg/PoseStamped", header(stamp_ns, LEFT_FRAME), pose)


def transforms_message(transforms: dict[tuple[str, str], RigidTransform], stamp_ns: int) -> Any:
    """`parent_from_child` by (parent, child), as one message for `/tf`."""
    stamped = []
    for (parent, child), transform in transforms.items():
        shift = message("geometry_msgs/msg/Vector3", *transform.translation_m.tolist())
        body = message("geometry_msgs/msg/Transform", shift, _quaternion(transform))
        stamped.append(message("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, body))
    return message("tf2_msgs/msg/TFMessage", stamped)


def fixed_transforms(rig: StereoRig) -> dict[tuple[str, str], RigidTransform]:
    """Poses of the eyes on the receiver."""
    right = RigidTransform(np.eye(3), rig.eye_offset_m("right"))
    return {(BASE_FRAME, LEFT_FRAME): FLU_FROM_FRD @ rig.body_from_left, (LEFT_FRAME, RIGHT_FRAME): right}


def moving_transforms(
    rig: StereoRig, world_from_left: RigidTransform, left_from_drogue: RigidTransform | None
) -> dict[tuple[str, str], RigidTransform]:
    """Pose of the receiver in the world and, if there is a drogue, of the drogue in the left eye."""
    map_from_base = world_from_left @ (FLU_FROM_FRD @ rig.body_from_left).inverse()
    moving = {(MAP_FRAME, BASE_FRAME): map_from_base}
    if left_from_drogue is not None:
        moving[LEFT_FRAME, DROGUE_FRAME] = left_from_drogue
    return moving


def _quaternion(transform: RigidTransform) -> Any:
    """In ROS's order: x, y, z, w."""
    return message("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(transform.rotation).as_quat().tolist())
