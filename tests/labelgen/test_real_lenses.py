"""Labels of a rig with real lenses against its pixels and OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import FIRST_MARKER_ID
from geometry.stereo import EYES
from labelgen.frame_labels import label_frame
from labelgen.validation.dataset_checks import validate_dataset
from labelgen.validation.label_checks import check_against_passes
from render.camera.optics import light_on_sensor
from render.camera.sensor import expose
from render.engine import StereoRadiance, load_engine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RIG_320_PX, RecipeTable, build_recipe, recipe_text, stations
from tests.support.small_datasets import rendered

BASE: RecipeTable = {
    "name": "real-lenses",
    "seed": 3,
    "rig": {"preset": "paper-real"},
    "frames": {"count": 4},
    "distance": stations(2.0, 5.0),
    "render": {"engine": "analytic"},
}


@pytest.fixture(scope="module")
def made() -> tuple[FrameSpec, StereoRadiance, PairRecord]:
    recipe = build_recipe(BASE)
    frame = sample_frame(recipe, 0)
    radiance = load_engine("analytic").render(frame, recipe.render)
    return frame, radiance, label_frame(frame, radiance, expose(frame, radiance))


def test_labels_and_passes_agree(made: tuple[FrameSpec, StereoRadiance, PairRecord]) -> None:
    _, radiance, record = made
    assert check_against_passes(record, radiance) == []


def test_marker_centres_are_opencv_s(made: tuple[FrameSpec, StereoRadiance, PairRecord]) -> None:
    frame, _, record = made
    layout = marker_layout(frame.drogue)
    for eye, view in zip(EYES, (record.views.left, record.views.right), strict=True):
        lens = frame.rig.lens(eye)
        turn, _ = cv2.Rodrigues(lens.ideal_from_real.T @ frame.left_from_drogue.rotation)
        shift = lens.ideal_from_real.T @ (frame.left_from_drogue.translation_m - frame.rig.eye_offset_m(eye))
        wanted, _ = cv2.projectPoints(
            layout.centers_m, turn, shift, lens.camera.matrix(), lens.distortion.coefficients()
        )
        got = np.array([marker.center_proj_px for marker in view.markers])
        np.testing.assert_allclose(got, wanted[:, 0], atol=1e-8)
        # And they are not where ideal eyes would show them.
        assert np.abs(got - frame.rig.project(frame.left_from_drogue.apply(layout.centers_m), eye)).max() > 1


def test_light_stands_where_labels_say(made: tuple[FrameSpec, StereoRadiance, PairRecord]) -> None:
    """Centre of gravity of each marker's light over the even face against `center_ellipse_px`."""
    _, radiance, record = made
    for seen, view in ((radiance.left, record.views.left), (radiance.right, record.views.right)):
        for index, marker in enumerate(view.markers):
            near = cv2.dilate((seen.part_id == FIRST_MARKER_ID + index).astype(np.uint8), np.ones((3, 3), np.uint8))
            light = seen.radiance_cd_m2[..., 0].astype(float)
            dark = np.median(light[seen.part_id == 1])
            rows, columns = np.nonzero(near)
            weight = light[rows, columns] - dark
            found = np.array([weight @ columns, weight @ rows]) / weight.sum()
            # Exact coverage: what is left is polygons for circles, 1e-4 px of their edge, and float32.
            np.testing.assert_allclose(found, marker.center_ellipse_px, atol=1e-3)


def test_vignetting_of_real_eyes_is_centred_on_their_axes(made: tuple[FrameSpec, StereoRadiance, PairRecord]) -> None:
    frame, radiance, _ = made
    plain = frame.model_copy(update={"sensor": frame.sensor.model_copy(update={"optics": type(frame.sensor.optics)()})})
    for eye, seen in zip(EYES, (radiance.left, radiance.right), strict=True):
        focused = frame.sensor.optics.model_copy(update={"focus_distance_m": None})
        dimmed = frame.model_copy(update={"sensor": frame.sensor.model_copy(update={"optics": focused})})
        share = (light_on_sensor(dimmed, seen, eye) / light_on_sensor(plain, seen, eye))[..., 1]
        row, column = np.unravel_index(int(share.argmax()), share.shape)
        camera = frame.rig.lens(eye).camera
        # The maximum is flat: cos^4 loses 1e-7, a float32's last digit, within half a pixel.
        assert abs(column - camera.cx_px) < 3 and abs(row - camera.cy_px) < 3


def test_a_dataset_of_real_eyes_is_valid(tmp_path: Path) -> None:
    small = recipe_text(BASE, rig=RIG_320_PX | {"preset": "paper-real"})
    dataset = rendered(small, tmp_path / "set", range(2))
    assert validate_dataset(dataset).faults == []
