"""The rig in the names and conventions of OpenCV, from which every calibration file is made."""

from __future__ import annotations

import numpy as np

from geometry.distortion import Lens
from geometry.se3 import Array
from geometry.stereo import StereoRig


def opencv_stereo_matrices(rig: StereoRig) -> dict[str, Array]:
    """A rig in the names and conventions of `cv2.stereoRectify`: the truth, which no calibration would find exactly.

    Returns:
        M1, M2: (3, 3) intrinsics of the delivered images [px]; D1, D2: (1, 5) their distortion; R, T: right from left
        [m]; R1, R2: rectifying rotations; P1, P2: (3, 4) projections of the rectified images; Q: (4, 4) from
        (u, v, disparity, 1) of those to homogeneous points [m].

    Source: OpenCV's documentation of `stereoRectify`; its pixels too count from the centre of the top-left one.
    """
    camera, baseline_m = rig.camera, rig.baseline_m
    first, second = rig.lenses or (Lens(camera), Lens(camera))
    left = np.hstack([camera.matrix(), np.zeros((3, 1))])
    right = left.copy()
    right[0, 3] = -camera.fx_px * baseline_m
    # A pixel's row counts in units of fy, its disparity in units of fx.
    row_scale = camera.fx_px / camera.fy_px
    reprojection = np.array(
        [
            [1.0, 0.0, 0.0, -camera.cx_px],
            [0.0, row_scale, 0.0, -camera.cy_px * row_scale],
            [0.0, 0.0, 0.0, camera.fx_px],
            [0.0, 0.0, 1.0 / baseline_m, 0.0],
        ]
    )
    return {
        "M1": first.camera.matrix(),
        "D1": first.distortion.coefficients()[None],
        "M2": second.camera.matrix(),
        "D2": second.distortion.coefficients()[None],
        "R": second.ideal_from_real.T @ first.ideal_from_real,
        "T": second.ideal_from_real.T @ np.array([[-baseline_m], [0.0], [0.0]]),
        "R1": np.array(first.ideal_from_real),
        "R2": np.array(second.ideal_from_real),
        "P1": left,
        "P2": right,
        "Q": reprojection,
    }
