"""Rigs of calibrations against OpenCV's own projection."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.calibration.stereo_calibration import StereoCalibration, read_opencv_stereo, rig_of_calibration
from datasets_manifest.recipe.rigs import resolve_rig
from geometry.stereo import EYES, StereoRig


def written(rig: StereoRig, folder: Path) -> Path:
    path = folder / "stereo.yaml"
    path.write_text(calibration_files(rig)["opencv_stereo.yaml"])
    return path


@pytest.fixture
def real() -> StereoCalibration:
    """A calibration as one finds it: both cameras turned a little, and not equal."""
    return StereoCalibration(
        size_px=(1280, 960),
        M1=np.array([[2140.0, 0, 650.0], [0, 2138.0, 470.0], [0, 0, 1]]),
        D1=np.array([-0.06, 0.02, 1e-4, -2e-4, 0.01]),
        M2=np.array([[2129.0, 0, 633.0], [0, 2131.0, 484.0], [0, 0, 1]]),
        D2=np.array([-0.05, 0.01, -1e-4, 1e-4]),
        R=cv2.Rodrigues(np.array([0.003, -0.02, 0.004]))[0],
        T=np.array([-0.1203, 0.0007, -0.0011]),
    )


def test_the_rig_shows_points_where_opencv_does(real: StereoCalibration) -> None:
    rig = rig_of_calibration(real)
    assert rig.lenses is not None
    rng = np.random.default_rng(5)
    points = np.stack([rng.uniform(-0.2, 0.2, 50), rng.uniform(-0.15, 0.15, 50), rng.uniform(1.0, 4.0, 50)], axis=1)
    points[:, :2] *= points[:, 2:]
    left_px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), real.M1, real.D1)[0][:, 0]
    right_px = cv2.projectPoints(points, cv2.Rodrigues(real.R)[0], real.T, real.M2, real.D2)[0][:, 0]
    in_rig = points @ rig.lenses[0].ideal_from_real.T
    # Both are double precision; OpenCV undistorts nothing here.
    np.testing.assert_allclose(rig.image(in_rig, "left"), left_px, atol=1e-8)
    np.testing.assert_allclose(rig.image(in_rig, "right"), right_px, atol=1e-8)


@pytest.mark.parametrize("preset", ["rgb-ideal", "paper-real"])
def test_our_own_calibration_comes_back(preset: str, tmp_path: Path) -> None:
    rig, _ = resolve_rig(preset, seed=3)
    back = rig_of_calibration(read_opencv_stereo(written(rig, tmp_path)))
    assert (back.lenses is None) == (rig.lenses is None)
    assert back.baseline_m == pytest.approx(rig.baseline_m, rel=1e-12)
    points = np.array([[0.3, -0.2, 4.0], [-0.5, 0.4, 9.0]])
    # Rectified axes may turn with both eyes; in those of the left lens they are the same.
    seen_by_left = points if rig.lenses is None else points @ rig.lenses[0].ideal_from_real
    again = seen_by_left if back.lenses is None else seen_by_left @ back.lenses[0].ideal_from_real.T
    for eye in EYES:
        # Numbers in the file have 16 digits, and OpenCV rectifies in double precision.
        np.testing.assert_allclose(back.image(again, eye), rig.image(points, eye), atol=1e-8)


def test_a_calibration_in_millimetres_wants_its_unit(tmp_path: Path) -> None:
    path = written(resolve_rig("rgb-ideal")[0], tmp_path)
    text = path.read_text()
    assert text.count("-1.2e-01") + text.count("-0.12") >= 1
    path.write_text(text.replace("-1.2e-01", "-120.").replace("-0.12", "-120."))
    with pytest.raises(ValueError, match="T: must be in metres, and 120 m is not a plausible baseline"):
        rig_of_calibration(read_opencv_stereo(path))
    assert rig_of_calibration(read_opencv_stereo(path, unit_m=1e-3)).baseline_m == pytest.approx(0.12)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_few_coefficients_are_the_first(count: int, real: StereoCalibration) -> None:
    padded = np.concatenate([real.D1[:count], np.zeros(5 - count)])
    short, long = (rig_of_calibration(changed(real, D1=given)) for given in (real.D1[:count], padded))
    np.testing.assert_array_equal(short.lenses[0].distortion.coefficients(), padded)
    assert short.camera == long.camera


def changed(calibration: StereoCalibration, **fields: object) -> StereoCalibration:
    return StereoCalibration(**{**vars(calibration), **fields})


def test_what_the_rig_cannot_have_is_refused(real: StereoCalibration) -> None:
    for fields, fault in (
        ({"T": -real.T}, "are the two swapped"),
        ({"T": np.array([0.0, -0.12, 0.0])}, "must stand to the right"),
        ({"D1": np.array([0.1, 0, 0, 0, 0, 0.2, 0, 0])}, "D1: must be k1, k2, p1, p2, k3"),
        ({"R": 2 * np.eye(3)}, "rotation"),
        ({"M1": np.zeros((3, 3))}, "M1"),
    ):
        with pytest.raises(ValueError, match=fault):
            rig_of_calibration(changed(real, **fields))


@pytest.mark.parametrize("content", ["", "hello", "%YAML:1.0\n---\nM1: 3\n", "{", "%YAML:1.0\n---\nimage_width: [1"])
def test_files_that_are_no_calibration_are_named(content: str, tmp_path: Path) -> None:
    path = tmp_path / "stereo.yaml"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"stereo\.yaml"):
        read_opencv_stereo(path)
    with pytest.raises(ValueError, match="no such calibration"):
        read_opencv_stereo(tmp_path / "none.yaml")
