from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter

from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.recipe.rigs import resolve_rig
from datasets_manifest.storage.writer import write_calibration
from datasets_manifest.types.field_types import Rig, write_rig
from geometry.distortion import BrownConrady, Lens, OpenCvDistortion
from geometry.stereo import EYES, StereoRig
from tests.support.recipe_builder import RecipeTable, Section, build_recipe, stations
from tests.support.stereo_calibrations import opencv_ideal_px

BASE: RecipeTable = {
    "name": "rig-test",
    "frames": {"count": 1},
    "distance": stations(5.0),
    "render": {"engine": "analytic"},
}


def test_ideal_presets_have_no_lenses() -> None:
    for name in ("rgb-ideal", "paper-colour", "mono"):
        rig, _ = resolve_rig(name, 3)
        assert rig.lenses is None and "lenses" not in write_rig(rig)


def test_real_eyes_are_drawn_by_the_seed() -> None:
    one, again, other = (write_rig(resolve_rig("paper-real", seed)[0])["lenses"] for seed in (1, 1, 2))
    assert one == again != other
    left, right = one
    assert np.array_equal(left["ideal_from_real"], np.eye(3))
    assert not np.array_equal(right["ideal_from_real"], np.eye(3))
    assert left["distortion"] != right["distortion"]


def test_ranges_of_a_table_hold() -> None:
    rig, _ = resolve_rig({"preset": "mono", "eyes": {"k1": [-0.1, -0.05], "k3": 0.01, "right_rotation_deg": 0.5}}, 9)
    for lens in rig.lenses:
        assert -0.1 <= lens.distortion.k1 <= -0.05
        assert lens.distortion.k3 == 0.01 and lens.distortion.p1 == 0
        assert lens.camera == rig.camera
    turn, _ = cv2.Rodrigues(np.array(rig.lenses[1].ideal_from_real))
    # Each of three axes up to the limit.
    assert 0 < np.degrees(np.linalg.norm(turn)) <= 0.5 * np.sqrt(3)


def test_json_gives_the_rig_back() -> None:
    recipe = build_recipe(BASE, rig="paper-real", seed=4)
    again = Recipe.model_validate_json(recipe.model_dump_json())
    assert again.model_dump_json() == recipe.model_dump_json()
    pixels = np.array([[10.0, 20.0], [1200.0, 900.0]])
    for eye in EYES:
        assert np.array_equal(again.rig.real_px(pixels, eye), recipe.rig.real_px(pixels, eye))


def test_calibration_rectifies_the_real_images(tmp_path: Path) -> None:
    """OpenCV, given the written file alone, takes real pixels to the ideal rig's."""
    rig, _ = resolve_rig("paper-real", 6)
    path = write_calibration(tmp_path, rig)[0]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    m = {name: storage.getNode(name).mat() for name in opencv_stereo_matrices(rig)}
    points = np.random.default_rng(2).uniform([-0.2, -0.15, 1], [0.2, 0.15, 1], (50, 3)) * 8.0
    for eye, number in zip(EYES, "12", strict=True):
        matrix, distortion, rotation, projection = (m[letter + number] for letter in "MDRP")
        seen = rig.image(points, eye)
        found = opencv_ideal_px(seen, matrix, distortion, rotation, projection[:, :3])
        # 16 digits in the file and OpenCV's own iteration.
        np.testing.assert_allclose(found, rig.project(points, eye), atol=1e-8)
    in_left = m["R1"].T @ points.T
    in_right = (m["R"] @ in_left + m["T"]).T
    wanted, _ = cv2.projectPoints(in_right, np.zeros(3), np.zeros(3), m["M2"], m["D2"])
    np.testing.assert_allclose(rig.image(points, "right"), wanted[:, 0], atol=1e-8)


def test_engines_without_lenses_are_named() -> None:
    with pytest.raises(ValueError, match=r"render\.engine: foreign draws ideal eyes only"):
        build_recipe(BASE, rig="paper-real", render={"engine": "foreign"})


@pytest.mark.parametrize("eyes", [{"k1": 3.0}, {"k9": 0.1}, {"k1": -1.9, "k2": -2.0}, {"right_rotation_deg": -1}])
def test_wrong_eyes_are_refused(eyes: Section) -> None:
    with pytest.raises(ValueError, match="rig: "):
        build_recipe(BASE, rig={"preset": "mono", "focal_px": 600.0, "eyes": eyes})


def test_long_lens_models_come_back_from_json() -> None:
    short, long = BrownConrady(-0.05, 0.01, 1e-4, -2e-4, 0.003), OpenCvDistortion(*np.linspace(1e-4, 2e-3, 14).tolist())
    ideal = resolve_rig("mono")[0]
    rig = StereoRig(ideal.camera, ideal.baseline_m, lenses=(Lens(ideal.camera, short), Lens(ideal.camera, long)))
    table = json.loads(json.dumps(write_rig(rig)))
    # Records of rigs with short models keep the bytes that they had.
    assert list(table["lenses"][0]["distortion"]) == ["k1", "k2", "p1", "p2", "k3"]
    assert [lens.distortion for lens in TypeAdapter(Rig).validate_python(table).lenses] == [short, long]


def test_whole_floats_are_read_as_sizes_of_images() -> None:
    rig = resolve_rig("paper-real", 1)[0]
    table = json.loads(json.dumps(write_rig(rig)))
    for camera in (table["camera"], table["lenses"][0]["camera"]):
        camera["width_px"] = float(camera["width_px"])
    again = TypeAdapter(Rig).validate_python(table)
    assert isinstance(again.camera.width_px, int) and isinstance(again.lenses[0].camera.width_px, int)
    assert write_rig(again) == write_rig(rig)
    table["camera"]["height_px"] = 960.5
    with pytest.raises(ValueError, match=r"must be positive whole numbers, got 1280 and 960\.5"):
        TypeAdapter(Rig).validate_python(table)
