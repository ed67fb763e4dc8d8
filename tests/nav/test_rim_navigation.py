"""The pose by the rim, from pictures of a drogue without markers to the record of its estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datasets_manifest.types.estimates import NoFix, PoseEstimate, Region
from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig
from nav.detector.detector import Detection, StereoDetection
from nav.pair_measurement import PairMeasurement, estimate_pose
from nav.pair_navigator import NOT_DETECTED, PairNavigator
from nav.pose.joint_rim import ROLL_SD_RAD
from nav.tracking.region import rim_boxes
from tests.support.painted_pairs import make_pose

CAMERA = PinholeCamera(320, 240, 640.0, 640.0, 159.5, 119.5)
RIG = StereoRig(CAMERA, 0.12)
BARE = DrogueParameters(name="bare", marker_positions_m=(), hub=None)
POSE = make_pose(0.1, -0.08, 3.6, 9, -7, 25)


def paint(rig: StereoRig, pose: RigidTransform, face_dn: float = 8.0, seed: int = 0) -> StereoImages:
    """A dark flat ring before a bright sky, by rays through nine places of every pixel, with blur and noise."""
    rng = np.random.default_rng(seed)
    width, height = rig.camera.width_px, rig.camera.height_px
    eyes = []
    for eye in ("left", "right"):
        light = np.zeros((height, width))
        for dy in (-1 / 3, 0.0, 1 / 3):
            for dx in (-1 / 3, 0.0, 1 / 3):
                # Rays that the lens's blur of half a pixel moves.
                x, y = np.meshgrid(np.arange(width) + dx, np.arange(height) + dy)
                jitter = rng.normal(0, 0.5, (2, height, width))
                rays = rig.rays(np.stack([x, y], -1) + np.moveaxis(jitter, 0, -1), eye)
                axis, offset = pose.rotation[:, 2], rig.eye_offset_m(eye)
                tube = pose.translation_m + BARE.rim_tube_radius_m * axis
                scale = ((tube - offset) @ axis) / (rays @ axis)
                on_plane = (offset + scale[..., None] * rays - tube) @ pose.rotation
                radius = np.hypot(on_plane[..., 0], on_plane[..., 1])
                is_face = (radius < BARE.rim_radius_m) & (radius > BARE.face_inner_radius_m)
                light += np.where(is_face, face_dn, 150.0) / 9
        eyes.append(np.rint(light + rng.normal(0, 1.5, light.shape)).clip(0, 255).astype(np.uint8))
    return StereoImages(*eyes, time_s=0.0, exposure_s=1e-3)


class Boxes:
    """A detector that knows the boxes, off by a twentieth of their width."""

    name = "boxes"

    def __init__(self, rig: StereoRig, eyes: tuple[str, ...] = ("left", "right")) -> None:
        self._boxes, self._eyes = rim_boxes(rig, 0.33, POSE), eyes

    def detect(self, images: StereoImages) -> StereoDetection:
        found: list[Detection | None] = []
        for eye in ("left", "right"):
            one = self._boxes.of(eye)
            assert one is not None
            x, y, width, height = one.box_xywh_px
            box = x + 0.05 * width, y - 0.05 * width, width, height
            found.append(Detection(box, 0.9) if eye in self._eyes else None)
        return StereoDetection(*found)

    def candidates(self, images: StereoImages, least_score: float) -> dict[Any, tuple[Detection, ...]]:
        return {}


def estimate(images: StereoImages, rig: StereoRig = RIG, **detector: Any) -> PoseEstimate | NoFix:
    navigator = PairNavigator(rig, BARE, Boxes(rig, **detector))
    by_markers, by_rim = navigator.estimate(3, images, ["joint", "joint-rim"])
    assert isinstance(by_markers, NoFix)
    assert by_markers.reason == "the drogue has no markers, a pose needs 3; joint-rim measures its rim"
    return by_rim


def deviations(found: PoseEstimate) -> np.ndarray:
    """Errors of the position and of the axis, in their stated standard deviations."""
    assert found.covariance is not None
    turn = np.cross(POSE.rotation[:, 2], found.left_from_drogue.rotation[:, 2])
    error = np.concatenate([found.left_from_drogue.translation_m - POSE.translation_m, turn])
    across = np.zeros((5, 6))
    across[:3, :3], across[3:, 3:] = np.eye(3), found.left_from_drogue.rotation[:, :2].T
    spread = across @ found.covariance @ across.T
    return (across @ error) / np.sqrt(np.diag(spread))


@pytest.mark.parametrize("eyes", [("left", "right"), ("left",), ("right",)])
def test_a_drogue_without_markers_has_a_pose(eyes: tuple[str, ...]) -> None:
    found = estimate(paint(RIG, POSE), eyes=eyes)
    assert isinstance(found, PoseEstimate), found
    assert np.abs(deviations(found)).max() < 4
    assert np.linalg.norm(found.left_from_drogue.translation_m - POSE.translation_m) < 0.01
    # The record: no markers, the boxes, the stated deviations, and an open roll.
    assert found.features == ()
    assert {region.source for region in found.regions} == {"detector"}
    assert set(found.stage_s) == {"detect", "rim", "pose"}
    axis = found.left_from_drogue.rotation[:, 2]
    assert found.covariance is not None
    assert axis @ found.covariance[3:, 3:] @ axis == pytest.approx(ROLL_SD_RAD**2, rel=0.01)
    assert PoseEstimate.model_validate_json(found.model_dump_json()).method == "joint-rim"


def test_a_distorting_lens_moves_the_edge_and_not_the_pose() -> None:
    lens = Lens(CAMERA, BrownConrady(k1=-0.2, k2=0.05, p1=1e-3, p2=-1e-3))
    rig = replace(RIG, lenses=(lens, lens))
    found = estimate(paint(rig, POSE), rig)
    assert isinstance(found, PoseEstimate), found
    assert np.abs(deviations(found)).max() < 4


def test_a_box_beyond_the_image_of_a_folding_lens() -> None:
    # It folds 205 px from the axis, where the image's corner is 200 px away and the box's middle 213 px.
    lens = Lens(CAMERA, BrownConrady(k1=-1.45))
    rig = replace(RIG, lenses=(lens, lens))
    box = Region(eye="left", box_xywh_px=(-60.0, -60.0, 100.0, 100.0), source="detector", score=0.9)
    flat = StereoImages(*np.full((2, 240, 320), 150, np.uint8), time_s=0.0, exposure_s=1e-3)
    measured = PairNavigator(rig, BARE, Boxes(RIG)).measure_rim(flat, PairMeasurement(NOT_DETECTED, {}, regions=(box,)))
    assert isinstance(estimate_pose(0, measured, "joint-rim"), NoFix)


def test_a_lit_drogue_has_no_pose_and_says_why() -> None:
    found = estimate(paint(RIG, POSE, face_dn=70.0))
    assert isinstance(found, NoFix)
    assert "no dark silhouette in the left image" in found.reason
    assert found.regions


def test_nothing_found_and_other_images_say_so() -> None:
    assert "no drogue detected" in str(estimate(paint(RIG, POSE), eyes=()))
    small = StereoImages(np.zeros((9, 9), np.uint8), np.zeros((9, 9), np.uint8), 0.0, 1e-3)
    navigator = PairNavigator(RIG, BARE, Boxes(RIG))
    (wrong,) = navigator.estimate(0, small, ["joint-rim"])
    assert isinstance(wrong, NoFix)
    assert "9x9" in wrong.reason
