"""All estimators on one pair, in the same boxes: ours, and poses from the keypoints of networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Region
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import MarkerLayout
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, StereoRig
from nav.pair_navigator import PairNavigator
from nav.pose.joint import joint
from nav.pose.monocular import mono_lm
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod
from studies.learned_pose.eye_poses import PointPose, consistent_pnp, pose_of_eye, refined_sqpnp
from studies.learned_pose.keypoint_corpus import CropKeypoints, EyeSample
from studies.learned_pose.keypoint_crops import CropView, build_crop, image_from_crop, map_points
from studies.learned_pose.keypoint_training import SimccKeypoints
from studies.learned_pose.ring_keypoints import EyeKeypoints, ring_observation
from studies.learned_pose.yolo_pose import YoloPose

OURS, OURS_MONO, OURS_CPNP = "ours, `joint`", "ours, `mono-lm`", "ours, CPnP"
YOLO, YOLO_CPNP, YOLO_STEREO = "YOLO26n-pose, PnP", "YOLO26n-pose, CPnP", "YOLO26n-pose, stereo"
SIMCC, SIMCC_CPNP, SIMCC_STEREO = "SimCC, PnP", "SimCC, CPnP", "SimCC, stereo"
ESTIMATORS = (OURS, OURS_MONO, OURS_CPNP, YOLO, YOLO_CPNP, YOLO_STEREO, SIMCC, SIMCC_CPNP, SIMCC_STEREO)
# A keypoint of whose distribution less lies about the peak has a second place that is as likely.
_LEAST_SHARE = 0.5

EyePair = tuple[EyeSample, EyeSample]
Poses = tuple[RigidTransform | None, ...]
"""`left_from_drogue` modulo roll: one of both eyes together, or one of each eye; None without a pose."""


@dataclass(frozen=True, eq=False)
class KeypointSource:
    """A network's keypoints.

    Attributes:
        find: the network.
        sigma_px: standard deviation of a coordinate. [px of the crop]
    """

    find: CropKeypoints
    sigma_px: float

    def observe(self, rig: StereoRig, layout: MarkerLayout, eyes: EyePair) -> Observation:
        """The markers of a pair as the network sees them."""
        crops = [build_crop(eye.patch.pixels, CropView()) for eye in eyes]
        left, right = (self._in_image(eye, points) for eye, points in zip(eyes, self.find(crops), strict=True))
        return ring_observation(rig, layout, (left, right))

    def _in_image(self, eye: EyeSample, points_px: Array) -> EyeKeypoints:
        to_image = image_from_crop(eye.patch, CropView())
        scale = float(np.sqrt(np.linalg.det(to_image[:, :2])))
        return EyeKeypoints(map_points(to_image, points_px), scale * self.sigma_px)


def clear_simcc_keypoints(network: SimccKeypoints) -> CropKeypoints:
    """Keypoints of a SimCC network, without those that may be in two places."""

    def find(crops: Sequence[NDArray[np.uint8]]) -> list[Array]:
        return [decoded.points_px[decoded.shares >= _LEAST_SHARE] for decoded in network.keypoints(crops)]

    return find


def yolo_keypoints(network: YoloPose) -> CropKeypoints:
    """Keypoints of a YOLO network; none where it finds no drogue."""

    def find(crops: Sequence[NDArray[np.uint8]]) -> list[Array]:
        return [np.zeros((0, 2)) if points is None else points for points in network.keypoints(crops)]

    return find


def our_markers(
    rig: StereoRig, drogue: DrogueParameters, images: StereoImages, eyes: EyePair
) -> Observation | NoFixReason:
    """The markers that our stack measures in the same boxes."""
    navigator = PairNavigator(rig, drogue)
    regions = tuple(
        Region(eye=eye, box_xywh_px=sample.box_xywh_px, source="study", score=1.0)
        for eye, sample in zip(EYES, eyes, strict=True)
    )
    return navigator.refine(images, navigator.measure(images, regions)).observation


def our_poses(observation: Observation | NoFixReason) -> dict[str, Poses]:
    """Poses from our markers."""
    if isinstance(observation, NoFixReason):
        return {OURS: (None,), OURS_MONO: (None, None), OURS_CPNP: (None, None)}
    return {
        OURS: (_solved(joint, observation),),
        OURS_MONO: tuple(_solved(mono_lm, _only_eye(observation, eye)) for eye in range(len(EYES))),
        OURS_CPNP: _of_eyes(observation, consistent_pnp),
    }


def learned_poses(observation: Observation, pnp: str, cpnp: str, stereo: str) -> dict[str, Poses]:
    """Poses from a network's markers, by the names of the estimators."""
    return {
        pnp: _of_eyes(observation, refined_sqpnp),
        cpnp: _of_eyes(observation, consistent_pnp),
        stereo: (_solved(joint, observation),),
    }


def _of_eyes(observation: Observation, solve: PointPose) -> Poses:
    return tuple(pose_of_eye(observation, eye, solve) for eye in range(len(EYES)))


def _solved(method: PoseMethod, observation: Observation) -> RigidTransform | None:
    answer = method(observation)
    return None if isinstance(answer, NoFixReason) else answer.left_from_drogue


def _only_eye(observation: Observation, eye: int) -> Observation:
    pixels = np.full_like(observation.pixels_px, np.nan)
    pixels[eye] = observation.pixels_px[eye]
    return replace(observation, pixels_px=pixels)
