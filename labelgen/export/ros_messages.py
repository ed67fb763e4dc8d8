"""Images, calibration and truth of a pair as ROS 2 messages.

Frames of reference, each a child of the one before: `map` (east, north, up), `base_link` (the receiver's body: forward,
left, up; REP-103), `stereo_left_optical` (OpenCV's axes), and under it `stereo_right_optical` and `drogue`. Images and
calibrations of both eyes are stamped `stereo_left_optical`, as ROS wants of stereo pairs.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from datasets_manifest.calibration.calibration import opencv_stereo_matrices
from datasets_manifest.types.images import StereoImages
from geometry.body_axes import FLU_FROM_FRD
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye, StereoRig

MAP_FRAME, BASE_FRAME = "map", "base_link"
LEFT_FRAME, RIGHT_FRAME, DROGUE_FRAME = "stereo_left_optical", "stereo_right_optical", "drogue"

# Message definitions of the oldest ROS 2 release that is still maintained; later ones read them.
TYPES = get_typestore(Stores.ROS2_HUMBLE)
_NANOSECONDS = 10**9


def message(type_name: str, *values: Any) -> Any:
    """A message of a type such as `sensor_msgs/msg/Image`, with its fields in their order."""
    return TYPES.types[type_name](*values)


def header(stamp_ns: int, frame: str) -> Any:
    """Time stamp and frame of reference."""
    stamp = message("builtin_interfaces/msg/Time", *divmod(stamp_ns, _NANOSECONDS))
    return message("std_msgs/msg/Header", stamp, frame)


def image_message(images: StereoImages, eye: Eye, stamp_ns: int) -> Any:
    """What an eye saw, as it left the sensor: a Bayer sensor's mosaic as the mosaic."""
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
    """Where the eyes sit on the receiver."""
    right = RigidTransform(np.eye(3), rig.eye_offset_m("right"))
    return {(BASE_FRAME, LEFT_FRAME): FLU_FROM_FRD @ rig.body_from_left, (LEFT_FRAME, RIGHT_FRAME): right}


def moving_transforms(
    rig: StereoRig, world_from_left: RigidTransform, left_from_drogue: RigidTransform | None
) -> dict[tuple[str, str], RigidTransform]:
    """Where the receiver is in the world, and the drogue, if any, before the left eye."""
    map_from_base = world_from_left @ (FLU_FROM_FRD @ rig.body_from_left).inverse()
    moving = {(MAP_FRAME, BASE_FRAME): map_from_base}
    if left_from_drogue is not None:
        moving[LEFT_FRAME, DROGUE_FRAME] = left_from_drogue
    return moving


def _quaternion(transform: RigidTransform) -> Any:
    """In ROS's order: x, y, z, w."""
    return message("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(transform.rotation).as_quat().tolist())
