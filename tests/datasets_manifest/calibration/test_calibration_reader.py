"""Calibration files of OpenCV: our exports back, and files as its users write them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.calibration.calibration_reader import read_calibration
from datasets_manifest.recipe.rigs import resolve_rig
from geometry.distortion import Lens, OpenCvDistortion
from geometry.se3 import exp_twist
from geometry.stereo import EYES, StereoRig
from tests.support.stereo_calibrations import (
    D1,
    D2,
    EVERYTHING,
    INTRINSICS,
    M1,
    M2,
    P1,
    P2,
    POINTS_M,
    POSE,
    R1,
    R2,
    RECTIFICATION,
    SIZE,
    SIZE_PX,
    R,
    T,
    check_rig,
    storage,
)


def long_models() -> StereoRig:
    """The paper's rig with lenses of OpenCV's whole model."""
    ideal = resolve_rig("rgb-ideal")[0]
    turn = exp_twist([0, 0, 0, 0.003, -0.004, 0.005]).rotation
    model = OpenCvDistortion(0.52, -2.5, 4e-4, -3e-4, 1.5, 0.40, -2.3, 1.4, 1e-3, -5e-4, -8e-4, 3e-4, 0.02, -0.03)
    rational = OpenCvDistortion(-0.08, 0.03, 2e-4, -1e-4, 0.01, 0.02, -0.01, 0.003)
    return StereoRig(
        ideal.camera, ideal.baseline_m, lenses=(Lens(ideal.camera, model), Lens(ideal.camera, rational, turn))
    )


RIGS = {
    "ideal": resolve_rig("rgb-ideal")[0],
    "real": resolve_rig("paper-real", 3)[0],
    "mono": resolve_rig({"preset": "mono", "width_px": 640, "height_px": 480, "focal_px": 700.5}, 3)[0],
    "bayer": resolve_rig({"preset": "paper-colour", "baseline_m": 0.2371, "eyes": {"k1": -0.07, "p2": 3e-4}}, 3)[0],
    "long": long_models(),
}
LAYOUTS = {
    "OpenCV": ("opencv_stereo.yaml",),
    "ROS": ("ros_left.yaml", "ros_right.yaml"),
    "Kalibr": ("kalibr_camchain.yaml",),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", RIGS)
def test_every_export_comes_back(name: str, layout: str, tmp_path: Path) -> None:
    rig, files = RIGS[name], calibration_files(RIGS[name])
    if layout == "Kalibr" and name == "long":
        assert "kalibr_camchain.yaml" not in files
        return
    paths = [tmp_path / file for file in LAYOUTS[layout]]
    for path in paths:
        path.write_text(files[path.name])
    found = read_calibration(paths)
    back = found.rig
    assert found.layout == layout
    assert (back.lenses is None) == (rig.lenses is None)
    # Files hold 16 digits.
    assert back.baseline_m == pytest.approx(rig.baseline_m, rel=1e-14)
    points, seen = POINTS_M, POINTS_M
    if layout != "Kalibr":
        assert found.is_rectification_given
        np.testing.assert_allclose(back.camera.matrix(), rig.camera.matrix(), rtol=1e-14)
    elif rig.lenses is not None and back.lenses is not None:
        # Kalibr's file holds no rectification: the frames agree in the axes of the left lens.
        points, seen = (POINTS_M @ one.lenses[0].ideal_from_real.T for one in (rig, back) if one.lenses is not None)
    for eye in EYES:
        np.testing.assert_allclose(back.image(seen, eye), rig.image(points, eye), atol=1e-8)
    for one, other in zip(rig.lenses or (), back.lenses or (), strict=True):
        assert type(one.distortion) is type(other.distortion)
        np.testing.assert_allclose(one.distortion.coefficients(), other.distortion.coefficients(), rtol=1e-14)


@pytest.mark.parametrize("suffix", ["yaml", "yml", "xml", "json"])
def test_the_rectification_of_a_file_is_the_frame(suffix: str, tmp_path: Path) -> None:
    found = read_calibration([storage(tmp_path / f"stereo.{suffix}", EVERYTHING)])
    assert found.layout == "OpenCV" and found.is_rectification_given
    check_rig(found.rig, R1)
    np.testing.assert_allclose(found.rig.camera.matrix(), P1[:, :3], rtol=1e-14)


def test_another_rectification_than_opencv_s_is_kept(tmp_path: Path) -> None:
    # Both rectified cameras may turn about the baseline.
    turn = cv2.Rodrigues(np.array([0.02, 0.0, 0.0]))[0]
    turned = {"R1": turn @ R1, "R2": turn @ R2}
    found = read_calibration([storage(tmp_path / "stereo.yml", EVERYTHING | turned)])
    check_rig(found.rig, turn @ R1)


def test_without_a_rectification_it_is_opencv_s(tmp_path: Path) -> None:
    found = read_calibration([storage(tmp_path / "stereo.yml", SIZE | INTRINSICS | POSE)])
    assert not found.is_rectification_given
    check_rig(found.rig, R1)


def test_the_file_of_the_documentation_is_read(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs/how-to/calibrate.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    namespace: dict[str, Any] = {}
    exec(compile(code, "calibrate.md", "exec", dont_inherit=True), namespace)
    namespace["write_stereo"](tmp_path / "stereo.yaml", SIZE_PX, (0.1, M1, D1, M2, D2, R, T[:, None], None, None))
    check_rig(read_calibration([tmp_path / "stereo.yaml"]).rig, R1)


@pytest.mark.parametrize("extrinsics", [POSE, POSE | RECTIFICATION, RECTIFICATION], ids=["pose", "both", "rectified"])
def test_intrinsics_and_extrinsics_are_two_files(extrinsics: dict[str, Any], tmp_path: Path) -> None:
    paths = [storage(tmp_path / "intrinsics.yml", INTRINSICS), storage(tmp_path / "extrinsics.yml", extrinsics)]
    for order in (paths, paths[::-1]):
        check_rig(read_calibration(order, size_px=SIZE_PX).rig, R1)
    with pytest.raises(ValueError, match=r"intrinsics\.yml and .*extrinsics\.yml: lacks image_width .* --image-size"):
        read_calibration(paths)
    with pytest.raises(ValueError, match=r"intrinsics\.yml: lacks R, T"):
        read_calibration(paths[:1], size_px=SIZE_PX)
    with pytest.raises(ValueError, match=r"extrinsics\.yml: lacks M1, D1, M2, D2"):
        read_calibration(paths[1:], size_px=SIZE_PX)


@pytest.mark.parametrize(
    "names",
    [
        ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
        ("K1", "D1", "K2", "D2"),
        ("CM1", "D1", "CM2", "D2"),
    ],
)
def test_other_names_of_the_same_matrices(names: tuple[str, ...], tmp_path: Path) -> None:
    renamed = dict(zip(names, INTRINSICS.values(), strict=True))
    path = storage(tmp_path / "stereo.yml", SIZE | renamed | POSE | RECTIFICATION)
    check_rig(read_calibration([path]).rig, R1)
    with pytest.raises(ValueError, match=f"M1: stands beside|{names[0]}: stands beside"):
        read_calibration([storage(tmp_path / "both.yml", EVERYTHING | renamed)])


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_lists_of_numbers_under_opencv_s_names(suffix: str, tmp_path: Path) -> None:
    values = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in EVERYTHING.items()}
    path = tmp_path / f"stereo.{suffix}"
    path.write_text(yaml.safe_dump(values) if suffix == "yaml" else json.dumps(values))
    check_rig(read_calibration([path]).rig, R1)


@pytest.mark.parametrize("count", [8, 12, 14])
def test_long_models_of_files_are_read_in_full(count: int, tmp_path: Path) -> None:
    long = np.array([0.52, -2.5, 4e-4, -3e-4, 1.5, 0.40, -2.3, 1.4, 1e-3, -5e-4, -8e-4, 3e-4, 0.02, -0.03])[:count]
    path = storage(tmp_path / "stereo.yml", EVERYTHING | {"D1": long})
    check_rig(read_calibration([path]).rig, R1, D1=long)


@pytest.mark.parametrize("decimals", [5, 6])
def test_printed_decimals_are_read(decimals: int, tmp_path: Path) -> None:
    names = ("R", "R1", "R2")
    path = storage(tmp_path / "stereo.yml", EVERYTHING | {n: np.round(EVERYTHING[n], decimals) for n in names})
    # Half a unit of the last decimal in a few entries at a focal length of 2140 px.
    check_rig(read_calibration([path]).rig, R1, atol_px=2140 * 3 * 0.5 * 10**-decimals)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"M1": M1.T}, r"stereo\.yml: M1: is transposed"),
        ({"D2": D2[:3]}, r"stereo\.yml: D2: must have 4, 5, 8, 12 or 14"),
        ({"R": np.round(R, 2)}, r"stereo\.yml: R: is not a rotation"),
        ({"R1": 1.001 * R1}, r"stereo\.yml: R1: is not a rotation"),
        (
            {"R": R.T},
            r"stereo\.yml: P2: the rectification .* does not fit R and T: its eyes are turned by 2\.\d+ degrees",
        ),
        ({"T": 1000 * T}, r"stereo\.yml: P2: .* 0\.12\d+ m long instead of 120\.\d+ m"),
        ({"T": T * [1, 1, -5]}, r"stereo\.yml: P2: .* baseline by 3\.\d+ degrees"),
        ({"T": -T}, r"stereo\.yml: P2: .* baseline by 180 degrees"),
        ({"T": 0 * T}, r"stereo\.yml: P2: does not fit a T of 0"),
        ({"T": np.array([0.0])}, r"stereo\.yml: T: must have 3x1 entries"),
        ({"P2": P1}, r"stereo\.yml: P2: entry .0, 3. must be -fx times the baseline"),
        ({"image_width": 600}, r"stereo\.yml: M1: the principal point .* outside the image of 600x960 px"),
        ({"image_width": 0}, "lacks image_width or image_height"),
        ({"M1": "2140"}, r"stereo\.yml: M1: must have 3x3 entries"),
        ({"R2": "none"}, r"stereo\.yml: R2: must be numbers"),
    ],
)
def test_what_contradicts_is_refused(changes: dict[str, Any], fault: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=fault):
        read_calibration([storage(tmp_path / "stereo.yml", EVERYTHING | changes)])


def test_without_a_rectification_the_translation_is_named(tmp_path: Path) -> None:
    for shift, fault in ((-T, "stereo.yml: T: the right camera"), (100 * T, "stereo.yml: T: must be in metres")):
        with pytest.raises(ValueError, match=fault):
            read_calibration([storage(tmp_path / "stereo.yml", SIZE | INTRINSICS | POSE | {"T": shift})])


def test_half_a_rectification_is_refused(tmp_path: Path) -> None:
    values = {name: value for name, value in EVERYTHING.items() if name not in ("P1", "P2")}
    with pytest.raises(ValueError, match=r"stereo\.yml: has R1, R2 alone; give R1, R2, P1 and P2, or none"):
        read_calibration([storage(tmp_path / "stereo.yml", values)])


def test_files_that_differ_are_refused(tmp_path: Path) -> None:
    one, other = storage(tmp_path / "a.yml", EVERYTHING), storage(tmp_path / "b.yml", EVERYTHING | {"T": 2 * T})
    with pytest.raises(ValueError, match=r"b\.yml: T: differs from .*a\.yml: T"):
        read_calibration([one, other])


def test_an_image_size_that_contradicts_is_refused(tmp_path: Path) -> None:
    path = storage(tmp_path / "stereo.yml", EVERYTHING)
    assert read_calibration([path], size_px=SIZE_PX).rig.camera.width_px == 1280
    with pytest.raises(ValueError, match=r"stereo\.yml: is for images of 1280x960 px, not "):
        read_calibration([path], size_px=(640, 480))


def test_millimetres_are_scaled(tmp_path: Path) -> None:
    values = EVERYTHING | {"T": 1000 * T, "P2": P2 * [1, 1, 1, 1000]}
    path = storage(tmp_path / "stereo.yml", values)
    with pytest.raises(ValueError, match=r"120\.\d+ m is not a plausible baseline"):
        read_calibration([path])
    check_rig(read_calibration([path], unit_m=1e-3).rig, R1)


DEEP = 100_000


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("storage.yaml", "%YAML:1.0\n---\nM1: !!opencv-matrix\n" + "[" * DEEP),
        ("storage.yaml", "%YAML:1.0\n---\nM1: !!opencv-matrix\n" + "- " * DEEP + "1"),
        ("storage.yaml", "%YAML:1.0\n---\n" + "".join(f"{' ' * depth}a: # !!opencv-matrix\n" for depth in range(900))),
        ("storage.xml", '<?xml version="1.0"?>\n<opencv_storage>\n' + "<a>" * DEEP),
        ("storage.json", '{"a":' * DEEP),
        ("plain.yaml", "a: " + "{a: " * DEEP),
        ("plain.yaml", "? " * DEEP),
    ],
)
def test_calibrations_nested_too_deep_are_refused(name: str, text: str, tmp_path: Path) -> None:
    """Without a limit the parsers overflow their stack, which ends the process."""
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}: is nested too deep for a calibration"):
        read_calibration([tmp_path / name])


def test_too_many_keys_are_refused(tmp_path: Path) -> None:
    """OpenCV's reader takes time with their square."""
    path = tmp_path / "storage.json"
    path.write_text(json.dumps(dict.fromkeys(map(str, range(9000)), 0)))
    with pytest.raises(ValueError, match=r"storage\.json: has more than 8000 keys, too many for a calibration"):
        read_calibration([path])


def test_an_element_of_too_many_numbers_is_refused(tmp_path: Path) -> None:
    """OpenCV's reader takes minutes for a megabyte of them."""
    path = tmp_path / "storage.xml"
    path.write_text('<?xml version="1.0"?><opencv_storage><a>' + "1 " * 450_000 + "</a></opencv_storage>")
    with pytest.raises(ValueError, match=r"storage\.xml: has an element of more than 25000 numbers"):
        read_calibration([path])


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [*a]\n",
        "a: &a [1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(
            f"{this}: &{this} [{', '.join([f'*{before}'] * 8)}]\n" for before, this in ["ab", "bc", "cd", "de", "ef"]
        )
        + "g: [*f, *f, *f, *f]\n",
    ],
)
def test_references_that_stand_for_too_much_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "bomb.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"bomb\.yaml: is not YAML: stands for more than 100000 values"):
        read_calibration([tmp_path / "bomb.yaml"])
