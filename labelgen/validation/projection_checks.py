"""A record's points against OpenCV's own projection, and row against row of a pair once rectified."""

from __future__ import annotations

import cv2
import numpy as np

from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from geometry.distortion import Lens
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.validation.label_checks import named_features

# Two ways to project in float64 agree far better; a pixel convention that is wrong does not.
_PROJECTION_TOLERANCE_PX = 1e-6
# The eyes' rows come out of the same numbers.
_EPIPOLAR_TOLERANCE_PX = 1e-9


def projection_faults(record: PairRecord) -> list[str]:
    """What is wrong with the centres of markers and hub, and with the corners of a calibration board."""
    if record.frame.board is not None:
        board = record.frame.board
        corners_m = board.shape.corners_m()
        labels = dict.fromkeys(EYES, record.views.left.board_corners_px) | {
            "right": record.views.right.board_corners_px
        }
        names = [f"board_corners_px[{index}]" for index in range(len(corners_m))]
        labelled = {eye: np.array(labels[eye], dtype=np.float64).reshape(-1, 2) for eye in EYES}
        return _point_faults(record.frame.rig, board.left_from_board, corners_m, labelled, names)
    if record.views.left.board_corners_px or record.views.right.board_corners_px:
        return ["board_corners_px: are given, the frame has no board"]
    pose, drogue = record.left_from_drogue, record.frame.drogue
    if pose is None or drogue is None:
        return []
    layout = marker_layout(drogue)
    centers_m = layout.centers_m
    if layout.hub_center_m is not None:
        centers_m = np.vstack([centers_m, layout.hub_center_m])
    if any(len(view.markers) != layout.count for view in (record.views.left, record.views.right)):
        return [f"markers: must be the drogue's {layout.count} in both eyes"]
    named = {eye: named_features(record, layout, pose, eye) for eye in EYES}
    labelled = {eye: np.array([view.center_proj_px for _, view, _ in named[eye]]).reshape(-1, 2) for eye in EYES}
    names = [f"{name}: center_proj_px" for name, _, _ in named["left"]]
    return _point_faults(record.frame.rig, pose, centers_m, labelled, names)


def box_faults(record: PairRecord) -> list[str]:
    """Centres of markers and hub that lie outside the drogue's full box."""
    faults = []
    for eye in EYES:
        view = record.views.left if eye == "left" else record.views.right
        if view.box_full_xywh_px is None:
            continue
        low = np.array(view.box_full_xywh_px[:2])
        high = low + view.box_full_xywh_px[2:]
        features = [*view.markers, *([view.hub] if view.hub is not None else [])]
        for index, feature in enumerate(features):
            point = np.array(feature.center_proj_px)
            if not ((point >= low) & (point <= high)).all():
                name = f"markers[{index}]" if index < len(view.markers) else "hub"
                faults.append(f"{eye}: {name}: center_proj_px {feature.center_proj_px} lies outside box_full_xywh_px")
    return faults


def _point_faults(
    rig: StereoRig, pose: RigidTransform, points_m: Array, labelled: dict[Eye, Array], names: list[str]
) -> list[str]:
    """Faults of (N, 2) labels of both eyes against the images of (N, 3) points at a pose."""
    faults, ideal = [], {}
    for eye in EYES:
        if len(labelled[eye]) != len(points_m):
            return [f"{eye}: has {len(labelled[eye])} features, there are {len(points_m)}"]
        lens = rig.lens(eye) or Lens(rig.camera)
        real_from_ideal = lens.ideal_from_real.T
        turn, _ = cv2.Rodrigues(real_from_ideal @ pose.rotation)
        offset = real_from_ideal @ (pose.translation_m - rig.eye_offset_m(eye))
        want, _ = cv2.projectPoints(points_m, turn, offset, lens.camera.matrix(), lens.distortion.coefficients())
        error = np.abs(labelled[eye] - want[:, 0]).max(axis=1)
        for index in np.flatnonzero(~(error <= _PROJECTION_TOLERANCE_PX)):
            faults.append(f"{eye}: {names[index]}: is {error[index]:.3g} px off the pose's image")
        try:
            ideal[eye] = rig.ideal_px(labelled[eye], eye)
        except ValueError:
            return [*faults, f"{eye}: labels lie where the lens sees nothing"]
    gap = float(np.abs(ideal["left"][:, 1] - ideal["right"][:, 1]).max())
    if not gap <= _EPIPOLAR_TOLERANCE_PX:
        faults.append(f"rows of left and right differ by {gap:.3g} px once rectified")
    return faults
