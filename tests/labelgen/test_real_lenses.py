"""Labels of a rig with real lenses against its pixels and OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import FIRST_MARKER_ID
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, StereoRig
from labelgen.frame_labels import label_frame
from labelgen.validation.dataset_checks import validate_dataset
from labelgen.validation.label_checks import box_faults, check_against_passes, projection_faults
from render.camera.optics import light_on_sensor
from render.camera.sensor import expose
from render.engine import StereoRadiance, load_engine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import PLAIN_SKY, RIG_320_PX, RecipeTable, build_recipe, recipe_text, stations
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


def turned_away(engine: str = "analytic") -> tuple[FrameSpec, Recipe]:
    """A frame whose drogue is 54 degrees aside, where the polynomial of its strong lens folds back into the image."""
    recipe = build_recipe(
        name="turned-away",
        seed=2,
        rig=RIG_320_PX | {"eyes": {"k1": -0.5}},
        frames={"count": 40},
        pose={"camera_pitch_deg": 10},
        environment=PLAIN_SKY,
        exposure={"time_s": 0.002},
        render={"engine": engine},
        sequence={
            "frames_per_sequence": 40,
            "frame_rate_hz": 20,
            "release_m": [13.8, 0.5, -5],
            "receiver": {"manoeuvres": ["station"], "start_m": 6.0},
            "losses": {
                "kinds": ["out-of-view"],
                "begins_s": 0.6,
                "lasts_s": 0.5,
                "onset_s": 0.4,
                "turn_deg": 54,
            },
        },
    )
    return sample_frame(recipe, 14), recipe


def test_a_drogue_far_beyond_the_field_of_a_lens_is_not_in_the_image() -> None:
    frame, recipe = turned_away()
    centers_m = frame.left_from_drogue.apply(marker_layout(frame.drogue).centers_m)
    for eye in EYES:
        # By the polynomial alone.
        assert frame.rig.camera.contains(frame.rig.real_px(frame.rig.project(centers_m, eye), eye)).any()
    radiance = load_engine("analytic").render(frame, recipe.render)
    record = label_frame(frame, radiance, expose(frame, radiance))
    assert record.conditions.markers_in_view == (0, 0) and record.conditions.hub_in_view == (False, False)
    for seen, view in ((radiance.left, record.views.left), (radiance.right, record.views.right)):
        assert not seen.part_id.any() and not seen.coverage.any() and view.visible_drogue_px == 0
        features = [*view.markers, view.hub]
        assert not any(feature.in_image for feature in features) and view.truncated
        places = np.array([[one.center_proj_px, one.center_ellipse_px] for one in features])
        assert not frame.rig.camera.contains(places).any()
        u, v, width, height = view.box_full_xywh_px
        assert u > 319.5 or u + width < -0.5 or v > 239.5 or v + height < -0.5
    assert check_against_passes(record, radiance) == []
    assert projection_faults(record) == [] and box_faults(record) == []


def test_labels_that_a_lens_folds_into_the_image_are_faults() -> None:
    frame, recipe = turned_away()
    radiance = load_engine("analytic").render(frame, recipe.render)
    record = label_frame(frame, radiance, expose(frame, radiance))
    marker = record.views.left.markers[0]
    folded = marker.model_copy(update={"center_proj_px": (160.0, 120.0)})
    left = record.views.left.model_copy(update={"markers": (folded, *record.views.left.markers[1:])})
    wrong = record.model_copy(update={"views": record.views.model_copy(update={"left": left})})
    assert projection_faults(wrong) == ["left: markers[0]: center_proj_px: lies on the image, the lens does not see it"]


def test_a_drogue_that_reaches_beyond_the_field_is_cut_off_where_the_lens_sees_nothing() -> None:
    """Areas, passes and boxes of a near drogue at the edge of the image, against the rays of its pixels."""
    frame, recipe = turned_away()
    camera = PinholeCamera(320, 240, 200.0, 200.0, 159.5, 119.5)
    lens = Lens(camera, BrownConrady(k1=-0.145))
    rig = StereoRig(camera, 0.12, lenses=(lens, lens))
    pose = RigidTransform(rotation_from_angles(0.2, -0.3, 0.4), np.array([0.7, 0.1, 0.6]))
    near = frame.model_copy(update={"rig": rig, "left_from_drogue": pose, "left_twist_per_s": np.zeros(6)})
    radiance = load_engine("analytic").render(near, recipe.render)
    record = label_frame(near, radiance, expose(near, radiance))
    layout = marker_layout(near.drogue)
    for eye, seen, view in zip(
        EYES, (radiance.left, radiance.right), (record.views.left, record.views.right), strict=True
    ):
        ideal = rig.project(pose.apply(layout.centers_m), eye)
        assert 0 < rig.is_in_field(ideal, eye).sum() < layout.count
        covered = seen.part_id != 0
        # Rays through pixel centres and areas are computed apart; they may differ on pixels that an edge crosses.
        assert covered.sum() > 2000 and (np.abs(seen.coverage - covered) < 0.5 + 1e-9).mean() > 0.999
        u, v, width, height = view.box_full_xywh_px
        rows, columns = np.nonzero(covered)
        assert u < columns.min() and u + width > 319.5 and v < rows.min() and v + height > rows.max()
    assert check_against_passes(record, radiance) == []
    assert projection_faults(record) == [] and box_faults(record) == []
