"""How the eyes move against what is drawn while the shutter is open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.se3 import exp_twist
from geometry.stereo import Eye


def pose_polynomial(frame: FrameSpec, eye: Eye) -> NDArray[np.float64]:
    """Pose of an eye in the stage's axes (`FrameSpec.left_from_stage_at`) over the exposure.

    Returns:
        (3, 3, 4) coefficients c of `stage_from_eye(s) = c[0] + c[1] s + c[2] s^2`, s from -1 (shutter opens) to 1
        (it closes); exact at both ends and the middle, the rest is of third order in the motion.
    """
    half_s = frame.exposure.time_s / 2
    eye_from_left = exp_twist(np.concatenate([-frame.rig.eye_offset_m(eye), np.zeros(3)]))
    opened, middle, closed = (
        (eye_from_left @ frame.left_from_stage_at(offset_s)).inverse().as_matrix()[:3]
        for offset_s in (-half_s, 0.0, half_s)
    )
    return np.stack([middle, (closed - opened) / 2, (closed + opened) / 2 - middle])


def blur_px(frame: FrameSpec) -> float:
    """Largest movement of the image of what is drawn from mid-exposure to either end. [px]"""
    half_s = frame.exposure.time_s / 2
    if frame.drogue is not None:
        places_m = frame.drogue.rim_radius_m * np.array(
            [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=np.float64
        )
    else:
        places_m = np.array([bystander.left_from_object.translation_m for bystander in frame.bystanders])
    seen = [frame.rig.camera.project(frame.left_from_stage_at(s).apply(places_m)) for s in (-half_s, 0.0, half_s)]
    return float(max(np.abs(seen[0] - seen[1]).max(), np.abs(seen[2] - seen[1]).max()))
