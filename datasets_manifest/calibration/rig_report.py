"""Says in words which rig a calibration gives, and what is unlikely about it."""

from __future__ import annotations

from math import atan, degrees

import numpy as np
from scipy.spatial.transform import Rotation

from datasets_manifest.calibration.calibration_reader import StereoCalibration
from geometry.distortion import Lens
from geometry.se3 import Array
from geometry.stereo import EYES

# Stereo cameras for drogues within 40 m; the paper's is 0.12 m. [m]
_USUAL_BASELINES_M = (0.02, 1.0)
_USUAL_FIELDS_DEG = (5.0, 120.0)
# Of the focal lengths of two eyes of one kind, and of square pixels.
_USUAL_RATIO = 1.1
# Of the principal point from the middle, in sides of the image.
_USUAL_SHIFT = 0.1
_USUAL_TURN_DEG = 10.0
# Of decentred lenses; the third and fourth coefficient of a fisheye lens are often larger.
_USUAL_TANGENTIAL = 0.01


def rig_report(calibration: StereoCalibration) -> list[str]:
    """Lines about a rig: baseline, image size, focal lengths, fields of view, frame; then what is unlikely."""
    rig = calibration.rig
    lenses = rig.lenses or (Lens(rig.camera), Lens(rig.camera))
    lines = [
        f"rig ({calibration.layout}): baseline {rig.baseline_m:.6g} m, images of {rig.camera.width_px}x"
        f"{rig.camera.height_px} px"
    ]
    for eye, lens in zip(EYES, lenses, strict=True):
        camera = lens.camera
        across, down = _fields_deg(lens)
        count = int(np.count_nonzero(lens.distortion.coefficients()))
        shape = f"{count} distortion coefficients" if count else "no distortion"
        lines.append(
            f"  {eye}: focal lengths {camera.fx_px:.6g}, {camera.fy_px:.6g} px, principal point {camera.cx_px:.6g}, "
            f"{camera.cy_px:.6g} px, field of view {across:.1f} x {down:.1f} degrees, {shape}"
        )
    if rig.lenses is None:
        frame = "the images are rectified"
    elif calibration.is_rectification_given:
        frame = "the calibration's rectified left camera"
    else:
        frame = "the left camera as cv2.stereoRectify rectifies it"
    return [*lines, f"  frame of the poses: {frame}", *(f"warning: {line}" for line in _unlikely(calibration, lenses))]


def _unlikely(calibration: StereoCalibration, lenses: tuple[Lens, Lens]) -> list[str]:
    rig = calibration.rig
    found = []
    low_m, high_m = _USUAL_BASELINES_M
    if not low_m <= rig.baseline_m <= high_m:
        found.append(
            f"a baseline of {rig.baseline_m:g} m is unusual; every distance is proportional to it: compare it with the "
            "real cameras, and see --calibration-unit"
        )
    for eye, lens in zip(EYES, lenses, strict=True):
        camera = lens.camera
        low_deg, high_deg = _USUAL_FIELDS_DEG
        across, _ = _fields_deg(lens)
        if not low_deg <= across <= high_deg:
            found.append(f"{eye}: a field of view of {across:.1f} degrees is unusual; was it calibrated at this size?")
        if _differ(camera.fx_px, camera.fy_px):
            found.append(f"{eye}: fx and fy differ by more than 10 %, though pixels are nearly always square")
        middle = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
        if abs(camera.cx_px - middle[0]) > _USUAL_SHIFT * camera.width_px or (
            abs(camera.cy_px - middle[1]) > _USUAL_SHIFT * camera.height_px
        ):
            found.append(
                f"{eye}: the principal point lies far from the middle ({middle[0]:g}, {middle[1]:g}) px; was it "
                "calibrated at this size?"
            )
        p1, p2 = lens.distortion.p1, lens.distortion.p2
        if max(abs(p1), abs(p2)) > _USUAL_TANGENTIAL:
            found.append(
                f"{eye}: tangential distortion p1 = {p1:g}, p2 = {p2:g} is unusual; coefficients of cv2.fisheye have "
                "another meaning and are not read"
            )
    if _differ(lenses[0].camera.fx_px, lenses[1].camera.fx_px):
        found.append("the focal lengths of the two cameras differ by more than 10 %")
    turn_deg = degrees(Rotation.from_matrix(_right_from_left(lenses)).magnitude())
    if turn_deg > _USUAL_TURN_DEG:
        found.append(f"the two cameras are turned against each other by {turn_deg:.1f} degrees")
    return found


def _fields_deg(lens: Lens) -> tuple[float, float]:
    """Horizontal and vertical field of view of an eye through its principal point, with its distortion. [deg]"""
    camera = lens.camera
    ends_px = np.array(
        [
            [-0.5, camera.cy_px],
            [camera.width_px - 0.5, camera.cy_px],
            [camera.cx_px, -0.5],
            [camera.cx_px, camera.height_px - 0.5],
        ]
    )
    places = lens.distortion.undistort(camera.rays(ends_px)[:, :2])
    across = atan(places[1, 0]) - atan(places[0, 0])
    down = atan(places[3, 1]) - atan(places[2, 1])
    return degrees(across), degrees(down)


def _right_from_left(lenses: tuple[Lens, Lens]) -> Array:
    rotation: Array = lenses[1].ideal_from_real.T @ lenses[0].ideal_from_real
    return rotation


def _differ(one: float, other: float) -> bool:
    return max(one, other) > _USUAL_RATIO * min(one, other)
