"""What is said about a rig, with the right numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datasets_manifest.calibration.calibration_reader import StereoCalibration
from datasets_manifest.calibration.rig_report import rig_report
from datasets_manifest.recipe.rigs import resolve_rig
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import exp_twist
from geometry.stereo import StereoRig, paper_rig

CAMERA = PinholeCamera(1280, 960, 2133.0, 2133.0, 639.5, 479.5)


def lines(rig: StereoRig, is_given: bool = True) -> list[str]:
    return rig_report(StereoCalibration(rig, "OpenCV", is_given))


def warnings(**changes: Any) -> list[str]:
    """Of a rig with a camera of 2133 px whose right eye is changed."""
    baseline_m = changes.pop("baseline_m", 0.12)
    distortion = changes.pop("distortion", BrownConrady())
    turn = exp_twist([0, 0, 0, 0, np.radians(changes.pop("turn_deg", 0.0)), 0]).rotation
    lenses = Lens(CAMERA), Lens(replace(CAMERA, **changes), distortion, turn)
    return [line for line in lines(StereoRig(CAMERA, baseline_m, lenses=lenses)) if line.startswith("warning: ")]


def test_the_shipped_rigs_are_likely() -> None:
    for preset in ("rgb-ideal", "paper-real", "mono", "paper-colour"):
        said = lines(resolve_rig(preset, 3)[0])
        assert len(said) == 4 and not any(line.startswith("warning") for line in said)


def test_the_numbers_of_the_paper_s_rig() -> None:
    # 2 atan(640 / 2133.33) and 2 atan(480 / 2133.33) in degrees.
    eye = "focal lengths 2133.33, 2133.33 px, principal point 639.5, 479.5 px, field of view 33.4 x 25.4 degrees"
    assert lines(paper_rig()) == [
        "rig (OpenCV): baseline 0.12 m, images of 1280x960 px",
        f"  left: {eye}, no distortion",
        f"  right: {eye}, no distortion",
        "  frame of the poses: the images are rectified",
    ]
    real = resolve_rig("paper-real", 3)[0]
    assert lines(real)[3] == "  frame of the poses: the calibration's rectified left camera"
    assert lines(real, is_given=False)[3].endswith("as cv2.stereoRectify rectifies it")
    assert "4 distortion coefficients" in lines(real)[1]


def test_the_field_of_view_is_the_distorted_one() -> None:
    lens = Lens(CAMERA, BrownConrady(k1=-0.3))
    said = lines(StereoRig(CAMERA, 0.12, lenses=(lens, lens)))[1]
    # The image's edge lies at 640 px: x - 0.3 x^3 = 640 / 2133, whose smallest positive root is the ideal place.
    place = min(root.real for root in np.roots([-0.3, 0, 1, -640 / 2133]) if root.real > 0)
    assert f"field of view {2 * np.degrees(np.arctan(place)):.1f} x" in said


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        ({"baseline_m": 6.0}, "a baseline of 6 m is unusual"),
        ({"baseline_m": 0.012}, "a baseline of 0.012 m is unusual"),
        ({"fx_px": 300.0, "fy_px": 300.0}, "right: a field of view of 129.8 degrees is unusual"),
        ({"fx_px": 2400.0}, "right: fx and fy differ"),
        ({"fx_px": 2400.0, "fy_px": 2400.0}, "focal lengths of the two cameras differ"),
        ({"cx_px": 320.0, "cy_px": 240.0}, "right: the principal point lies far from the middle"),
        ({"distortion": BrownConrady(-0.05, 0.01, 0.03, 0.001)}, "right: tangential distortion p1 = 0.03, p2 = 0.001"),
        ({"turn_deg": 12.0}, "turned against each other by 12.0 degrees"),
    ],
)
def test_what_is_unlikely_is_told(changes: dict[str, Any], said: str | None) -> None:
    found = warnings(**changes)
    assert found == [] if said is None else any(said in line for line in found)
