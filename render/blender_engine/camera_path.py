"""The image window of a picture, and the path of its camera while the shutter is open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datasets_manifest.types.frame import FrameSpec
from geometry.distortion import Lens
from geometry.se3 import RigidTransform, exp_twist
from geometry.stereo import Eye, StereoRig
from render.blender_engine.messages import CameraPath, DistortedEye, ImageWindow
from render.camera.exposure_motion import NEAREST_M, image_window

_SHARP_BELOW_PX = 0.05
# Blender silently makes smaller pictures as large as this.
_LEAST_SIDE_PX = 4
_MOMENTS = 5
_BLENDER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])


class EyePath:
    """One eye of a frame in the stage's axes.

    Attributes:
        middle: `stage_from_eye` at mid-exposure.
        still: camera path of mid-exposure alone.
        moving: camera path of five moments, or of one when nothing moves by a twentieth of a pixel.
    """

    def __init__(self, frame: FrameSpec, eye: Eye, corners_m: NDArray[np.float32]) -> None:
        self._camera, self._rig, self._eye = frame.rig.camera, frame.rig, eye
        eye_from_left = exp_twist(np.concatenate([-frame.rig.eye_offset_m(eye), np.zeros(3)]))
        half_s = frame.exposure.time_s / 2
        moments_s = np.linspace(-half_s, half_s, _MOMENTS)
        poses = [(eye_from_left @ frame.left_from_stage_at(float(offset_s))).inverse() for offset_s in moments_s]
        self.middle = poses[_MOMENTS // 2]
        self._poses = poses if self._moves(poses, corners_m) else [self.middle]
        self.still, self.moving = _camera_path([self.middle]), _camera_path(self._poses)

    def _moves(self, poses: list[RigidTransform], corners_m: NDArray[np.float32]) -> bool:
        """Whether any corner's image when the shutter opens or closes differs from that at mid-exposure."""
        seen = [poses[index].inverse().apply(corners_m) for index in (0, _MOMENTS // 2, -1)]
        front = np.min([points[:, 2] for points in seen], axis=0) > NEAREST_M
        opened, middle, closed = (self._camera.project(points[front]) for points in seen)
        return bool(max(np.abs(end - middle).max(initial=0.0) for end in (opened, closed)) >= _SHARP_BELOW_PX)

    def window(self, corners_m: NDArray[np.float32]) -> ImageWindow | None:
        """The image window of parts with these corners while the shutter is open; None outside the image.

        Args:
            corners_m: (V, 3) in the stage's axes. [m]
        """
        window = image_window(self._rig, self._poses, corners_m)
        if window is None:
            return None
        last_first = np.array([self._camera.width_px, self._camera.height_px]) - _LEAST_SIDE_PX
        first = np.minimum(window[0], last_first)
        return _window(self._rig, self._eye, first, np.maximum(window[1], first + _LEAST_SIDE_PX))


def contains(outer: ImageWindow | None, inner: ImageWindow) -> bool:
    """Whether one window contains another; an absent one contains nothing."""
    return (
        outer is not None
        and outer.left_px <= inner.left_px
        and outer.top_px <= inner.top_px
        and outer.left_px + outer.width_px >= inner.left_px + inner.width_px
        and outer.top_px + outer.height_px >= inner.top_px + inner.height_px
    )


def _distorted_eye(rig: StereoRig, eye: Eye) -> DistortedEye | None:
    """The lens model of an eye, or None for a pinhole with square pixels."""
    camera, lens = rig.camera, rig.lens(eye)
    if lens is None and camera.fx_px == camera.fy_px:
        return None
    real = lens or Lens(camera)
    return DistortedEye(
        focal_px=(real.camera.fx_px, real.camera.fy_px),
        distortion=tuple(real.distortion.coefficients().tolist()),
        ideal_from_real=tuple(real.ideal_from_real.ravel().tolist()),
    )


def _window(rig: StereoRig, eye: Eye, first: NDArray[np.int_], end: NDArray[np.int_]) -> ImageWindow:
    lens = rig.lens(eye)
    camera = rig.camera if lens is None else lens.camera
    left, top, width, height = (int(value) for value in (*first, *(end - first)))
    return ImageWindow(
        left_px=left,
        top_px=top,
        width_px=width,
        height_px=height,
        focal_px=camera.fx_px,
        center_px=(camera.cx_px, camera.cy_px),
        eye=_distorted_eye(rig, eye),
    )


def _camera_path(poses: list[RigidTransform]) -> CameraPath:
    quaternions = Rotation.from_matrix([pose.rotation @ _BLENDER_FROM_OPENCV for pose in poses]).as_quat(
        scalar_first=True
    )
    for index in range(1, len(quaternions)):
        if quaternions[index] @ quaternions[index - 1] < 0:
            quaternions[index] *= -1
    return CameraPath(positions_m=np.stack([pose.translation_m for pose in poses]), quaternions=quaternions)
