"""Recipes whose rig is a calibration of real cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe, load_recipe
from datasets_manifest.recipe.rigs import resolve_rig
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import write_calibration
from geometry.stereo import EYES
from tests.support.recipe_builder import RecipeTable, Section, build_recipe, recipe_text, stations
from tests.support.small_datasets import rendered
from tests.support.stereo_calibrations import (
    D1,
    D2,
    EVERYTHING,
    INTRINSICS,
    M1,
    M2,
    POSE,
    R1,
    R2,
    SIZE,
    T,
    check_rig,
    storage,
)

BASE: RecipeTable = {
    "name": "calibrated",
    "frames": {"count": 2},
    "distance": stations(2.0, 12.0),
    "render": {"engine": "analytic"},
}


def recipe_of(files: str | list[str], **keys: Any) -> Recipe:
    return build_recipe(BASE, rig={"preset": "paper-real", "calibration": files, **keys})


def test_cameras_see_points_where_opencv_sees_them(tmp_path: Path) -> None:
    recipe = recipe_of(str(storage(tmp_path / "stereo.yaml", EVERYTHING)))
    check_rig(recipe.rig, R1)
    assert recipe.rig.baseline_m == pytest.approx(np.linalg.norm(T))
    # What the calibration says nothing about is the preset's.
    preset, sensor = resolve_rig("paper-real")
    assert recipe.sensor == sensor
    np.testing.assert_array_equal(recipe.rig.probe_tip_body_m, preset.probe_tip_body_m)
    again = Recipe.model_validate_json(recipe.model_dump_json())
    assert again.model_dump_json() == recipe.model_dump_json()


def test_labels_of_a_dataset_lie_where_opencv_sees_the_markers(tmp_path: Path) -> None:
    file = storage(tmp_path / "stereo.yaml", EVERYTHING)
    text = recipe_text(BASE, rig={"preset": "mono", "calibration": str(file)})
    dataset = Dataset(rendered(text, tmp_path / "data"))
    for record in dataset.records():
        ideal_m = record.left_from_drogue.apply(record.frame.drogue.marker_centers_m)
        for view, rectifying, offset_m, matrix, distortion in (
            (record.views.left, R1, 0.0, M1, D1),
            (record.views.right, R2, np.linalg.norm(T), M2, D2),
        ):
            seen_m = (ideal_m - [offset_m, 0.0, 0.0]) @ rectifying
            want_px = cv2.projectPoints(seen_m, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
            got_px = np.array([marker.center_proj_px for marker in view.markers])
            np.testing.assert_allclose(got_px, want_px, atol=1e-6)


def test_files_are_named_as_seen_from_the_file_that_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cameras").mkdir()
    storage(tmp_path / "cameras" / "stereo.yaml", EVERYTHING)
    (tmp_path / "cameras" / "mine.toml").write_text('preset = "mono"\ncalibration = "stereo.yaml"\n')
    by_file, by_table = (
        recipe_text(BASE, rig=rig)
        for rig in ("cameras/mine.toml", {"preset": "mono", "calibration": "cameras/stereo.yaml"})
    )
    monkeypatch.chdir("/")
    for text in (by_file, by_table):
        (tmp_path / "recipe.toml").write_text(text)
        check_rig(load_recipe(str(tmp_path / "recipe.toml")).recipe.rig, R1)


def test_two_files_may_belong_together(tmp_path: Path) -> None:
    rig = recipe_of(str(storage(tmp_path / "stereo.yaml", EVERYTHING))).rig
    write_calibration(tmp_path, rig)
    both = recipe_of([str(tmp_path / "calibration" / f"ros_{eye}.yaml") for eye in ("left", "right")]).rig
    pixels = np.array([[10.0, 20.0], [1200.0, 900.0]])
    for eye in EYES:
        np.testing.assert_allclose(both.real_px(pixels, eye), rig.real_px(pixels, eye), atol=1e-8)


def test_a_baseline_in_millimetres_and_a_size_that_the_file_lacks(tmp_path: Path) -> None:
    in_mm = INTRINSICS | {"R": POSE["R"], "T": POSE["T"] * 1000}
    file = str(storage(tmp_path / "stereo.yaml", in_mm))
    check_rig(recipe_of(file, calibration_unit="mm", width_px=1280, height_px=960).rig, R1)
    with pytest.raises(ValueError, match=r"rig: .*stereo\.yaml: lacks image_width .*width_px and height_px"):
        recipe_of(file, calibration_unit="mm")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"focal_px": 2000.0}, "focal_px: the calibration sets it; leave it out"),
        ({"baseline_m": 0.1, "eyes": {"k1": 0.1}}, "baseline_m, eyes: the calibration sets it"),
        ({"width_px": 1280}, "give both, or none"),
        ({"width_px": 640, "height_px": 480}, "stereo.yaml: is for images of 1280x960 px, not 640x480"),
        ({"calibration_unit": "inch"}, "calibration_unit"),
        ({"calibration_unit": "mm"}, "must be in metres"),
        ({"calibration": "nowhere.yaml"}, "nowhere.yaml: there is no such calibration file"),
        ({"calibration": []}, "must be one file, or two that belong together"),
        ({"calibration": 3}, "must be one file, or two that belong together"),
    ],
)
def test_keys_that_do_not_fit_are_told(tmp_path: Path, keys: Section, message: str) -> None:
    file = storage(tmp_path / "stereo.yaml", EVERYTHING)
    with pytest.raises(ValueError, match=message) as told:
        build_recipe(BASE, rig={"preset": "mono", "calibration": str(file)} | keys)
    assert str(told.value).startswith("rig: ")
    assert "\n" not in str(told.value)


def test_blender_takes_five_coefficients(tmp_path: Path) -> None:
    longer = np.append(D1, [1e-4, 0.0, 0.0])
    five, eight = (
        {
            "preset": "mono",
            "calibration": str(storage(tmp_path / f"{len(D)}.yaml", SIZE | INTRINSICS | POSE | {"D1": D})),
        }
        for D in (D1, longer)
    )
    for engine, rig in (("blender", five), ("mitsuba", eight), ("analytic", eight)):
        assert build_recipe(BASE, rig=rig, render={"engine": engine}).rig.lenses
    with pytest.raises(ValueError, match=r"render\.engine: blender draws lenses with k1, k2, p1, p2 and k3"):
        build_recipe(BASE, rig=eight, render={"engine": "blender"})


def test_a_unit_without_a_calibration_is_told() -> None:
    with pytest.raises(ValueError, match="rig: calibration_unit: is of a calibration"):
        build_recipe(BASE, rig={"preset": "mono", "calibration_unit": "mm"})


def test_a_calibration_in_the_place_of_a_rig_is_told() -> None:
    with pytest.raises(ValueError, match=r'stereo\.yaml: write .*`calibration = "stereo\.yaml"`'):
        build_recipe(BASE, rig="stereo.yaml")
