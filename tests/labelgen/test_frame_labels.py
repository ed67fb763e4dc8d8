from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import ViewRecord
from datasets_manifest.types.video_camera import Spectrum, VideoCamera
from drogue_models.marker_layout import marker_layout
from drogue_models.meshes import drogue_meshes
from drogue_models.parts import FIRST_MARKER_ID, drogue_part_ids
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES
from labelgen.disc_images import marker_discs
from labelgen.frame_labels import label_frame, signal_to_noise
from labelgen.part_pixels import drogue_box, drogue_hull_m, mask_box
from render.camera.optics import saturation_cd_m2
from render.camera.sensor import dn_per_electron, expose
from render.engine import EyeRadiance
from tests.support.drawn_pairs import Pair


def views_of(pair: Pair) -> tuple[tuple[str, ViewRecord, EyeRadiance], tuple[str, ViewRecord, EyeRadiance]]:
    return (
        ("left", pair.record.views.left, pair.radiance.left),
        ("right", pair.record.views.right, pair.radiance.right),
    )


def test_centers_are_what_opencv_projects(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        layout, rig, pose = marker_layout(pair.frame.drogue), pair.frame.rig, pair.frame.left_from_drogue
        points = np.vstack([layout.centers_m, layout.hub_center_m])
        for eye, view, _ in views_of(pair):
            want, _ = cv2.projectPoints(
                points,
                cv2.Rodrigues(pose.rotation)[0],
                pose.translation_m - rig.eye_offset_m(eye),
                rig.camera.matrix(),
                None,
            )
            got = [marker.center_proj_px for marker in view.markers] + [view.hub.center_proj_px]
            # Rodrigues and back loses a few of float64's last bits: 1e-15 rad times 400 px.
            np.testing.assert_allclose(got, want[:, 0], atol=1e-9)


def test_ellipse_centers_are_those_of_drawn_ellipses(full_pairs: list[Pair]) -> None:
    # OpenCV fits an ellipse through projected points of each circle, knowing nothing of dual conics.
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(90)], axis=-1)
    for pair in full_pairs:
        layout, rig, pose = marker_layout(pair.frame.drogue), pair.frame.rig, pair.frame.left_from_drogue
        for eye, view, _ in views_of(pair):
            cases = [
                (center, layout.radius_m, marker.center_ellipse_px)
                for center, marker in zip(layout.centers_m, view.markers, strict=True)
            ]
            cases.append((layout.hub_center_m, layout.hub_outer_radius_m, view.hub.center_ellipse_px))
            cases.append((layout.hub_center_m, layout.hub_inner_radius_m, view.hub.center_ellipse_inner_px))
            for center, radius_m, label in cases:
                outline = rig.project(pose.apply(center + radius_m * circle), eye)
                (u, v), _, _ = cv2.fitEllipseDirect(outline.astype(np.float32))
                # The fit works in float32 on coordinates of a few hundred pixels.
                np.testing.assert_allclose(label, (u, v), atol=2e-3)


def test_stereo_rows_agree_and_disparity_gives_the_depth(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        rig, layout = pair.frame.rig, marker_layout(pair.frame.drogue)
        left = np.array([marker.center_proj_px for marker in pair.record.views.left.markers])
        right = np.array([marker.center_proj_px for marker in pair.record.views.right.markers])
        np.testing.assert_array_equal(left[:, 1], right[:, 1])
        depth = pair.frame.left_from_drogue.apply(layout.centers_m)[:, 2]
        np.testing.assert_allclose(rig.camera.fx_px * rig.baseline_m / (left - right)[:, 0], depth, rtol=1e-12)


def test_unoccluded_markers_are_wholly_visible(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        for _, view, _ in views_of(pair):
            assert [marker.visible_fraction for marker in view.markers] == [1.0] * 8
            assert all(marker.in_image for marker in view.markers)
            # The mouth cuts the hub only beyond 28 degrees.
            assert view.hub.visible_fraction == 1.0


def test_a_hidden_marker_is_counted(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    frame, radiance = pair.frame, pair.radiance
    hidden = radiance.left.part_id.copy()
    rows, columns = np.nonzero(hidden == 34)
    half = rows < np.median(rows)
    hidden[rows[half], columns[half]] = 16
    eye = type(radiance.left)(**{**radiance.left.__dict__, "part_id": hidden})
    pair_with_hose = type(radiance)(**{**radiance.__dict__, "left": eye})
    record = label_frame(frame, pair_with_hose, pair.images)
    assert record.views.left.markers[2].visible_fraction == 1 - half.sum() / rows.size
    assert record.views.right.markers[2].visible_fraction == 1.0


def test_boxes(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        for eye, view, seen in views_of(pair):
            vertices = np.concatenate([mesh.vertices for mesh in drogue_meshes(pair.frame.drogue).values()])
            image = pair.frame.rig.project(pair.frame.left_from_drogue.apply(vertices), eye)
            u, v, width, height = view.box_full_xywh_px
            np.testing.assert_allclose([u, v], image.min(axis=0), rtol=1e-12)
            np.testing.assert_allclose([u + width, v + height], image.max(axis=0), rtol=1e-12)
            mask = np.isin(seen.part_id, drogue_part_ids(8)).astype(np.uint8)
            left, top, columns, rows = cv2.boundingRect(mask)
            assert view.box_visible_xywh_px == (left - 0.5, top - 0.5, columns, rows)
            assert view.visible_drogue_px == mask.sum()
            # Nothing stands before the drogue: its pixels reach its outline within a pixel.
            np.testing.assert_allclose(view.box_visible_xywh_px, view.box_full_xywh_px, atol=2.0)
            assert not view.truncated


def test_full_mask_has_the_full_frame_as_its_box() -> None:
    assert mask_box(np.ones((960, 1280), dtype=bool)) == (-0.5, -0.5, 1280.0, 960.0)
    assert mask_box(np.zeros((960, 1280), dtype=bool)) is None


def test_hull_is_made_once_for_each_drogue(full_pairs: list[Pair]) -> None:
    first = drogue_hull_m(full_pairs[0].frame.drogue)
    assert drogue_hull_m(full_pairs[1].frame.drogue) is first
    assert not first.flags.writeable


def test_a_drogue_behind_the_camera_is_refused(full_pairs: list[Pair]) -> None:
    frame = full_pairs[0].frame
    with pytest.raises(ValueError, match="in front of the camera"):
        drogue_box(frame.drogue, frame.rig, RigidTransform(np.eye(3), np.array([0.0, 0.0, -0.2])), "left")


def test_poses_follow_the_motion(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    velocity = np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.5])
    moving = pair.frame.model_copy(update={"drogue_twist_per_s": velocity})
    record = label_frame(moving, pair.radiance, pair.images)
    half_s = moving.exposure.time_s / 2
    middle = record.left_from_drogue
    for pose, offset_s in ((record.left_from_drogue_open, -half_s), (record.left_from_drogue_close, half_s)):
        moved = middle.inverse() @ pose
        # To first order in the motion over half an exposure, here below 1e-2.
        np.testing.assert_allclose(moved.translation_m, velocity[:3] * offset_s, atol=1e-4 * half_s)


@pytest.mark.parametrize("roll_deg", [-100.0, -22.5, -1e-300, 0.0, 10.0, 44.999, 45.0, 170.0])
def test_roll_modulo_the_symmetry(full_pairs: list[Pair], roll_deg: float) -> None:
    pair = full_pairs[0]
    turned = RigidTransform(
        rotation_from_angles(0.02, -0.03, np.radians(roll_deg)), pair.frame.left_from_drogue.translation_m
    )
    record = label_frame(pair.frame.model_copy(update={"left_from_drogue": turned}), pair.radiance, pair.images)
    assert 0.0 <= record.roll_modulo_deg < 45.0
    # Full turns of the markers lie between the two, up to rounding on either side of a turn.
    turns = (record.roll_deg - record.roll_modulo_deg) / 45.0
    assert abs(turns - round(turns)) < 1e-9
    assert record.roll_deg == pytest.approx(roll_deg, abs=1e-9)


def test_empty_frames_have_no_labels(pairs: list[Pair]) -> None:
    for pair in pairs:
        if pair.frame.drogue is not None:
            continue
        record = pair.record
        assert record.left_from_drogue is None and record.roll_modulo_deg is None
        assert record.conditions.distance_m is None
        for _, view, _ in views_of(pair):
            assert view.markers == () and view.hub is None and view.visible_drogue_px == 0
            assert view.box_full_xywh_px is None and view.box_visible_xywh_px is None


def test_conditions(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        conditions = pair.record.conditions
        assert conditions.distance_m == pair.frame.left_from_drogue.translation_m[2]
        # The drawn sky is grey of 2000 cd/m2 everywhere.
        assert conditions.background_luminance_cd_m2 == pytest.approx(2000.0, rel=1e-6)


def test_signal_to_noise_follows_shot_and_read_noise(full_pairs: list[Pair]) -> None:
    pair = full_pairs[-1]
    sensor = pair.frame.sensor
    per_level = sensor.electrons_per_cd_m2(pair.frame.exposure)
    signal_e, around_e = (min(level * per_level, sensor.full_well_e) for level in (6000.0, 150.0))
    want = (signal_e - around_e) / np.sqrt((signal_e + around_e) / 2 + sensor.read_noise_e**2)
    for marker in pair.record.views.left.markers:
        # The drawn radiance is even over every part, so that only float32 rounds.
        assert marker.signal_to_noise == pytest.approx(want, rel=1e-5)


@pytest.mark.parametrize("spectrum", ["grey", "near-infrared"])
def test_signal_to_noise_is_that_of_the_cameras_band(full_pairs: list[Pair], spectrum: Spectrum) -> None:
    pair = full_pairs[-1]
    exact = pair.frame.sensor.model_copy(update={"noise_free": True, "output_bits": 8, "encoding": "linear"})
    frame = pair.frame.model_copy(update={"camera": VideoCamera(spectrum=spectrum), "sensor": exact})
    red, grey = np.float32([6000.0, 400.0, 300.0]), np.float32([150.0, 150.0, 150.0])

    def painted(seen: EyeRadiance, is_red: np.ndarray) -> EyeRadiance:
        return replace(seen, radiance_cd_m2=np.where(is_red[..., None], red, grey))

    def electrons(is_red: bool) -> float:
        """Of a picture that is even all over, which no lens changes."""
        eyes = [
            painted(seen, np.full(seen.part_id.shape, is_red)) for seen in (pair.radiance.left, pair.radiance.right)
        ]
        level = np.float64(expose(frame, replace(pair.radiance, left=eyes[0], right=eyes[1])).left)[20:-20, 20:-20]
        stored = level.mean() / 255 * (2**exact.adc_bits - 1) - exact.black_level_dn
        return float(stored / dn_per_electron(exact, frame.exposure.gain))

    signal_e, around_e = electrons(True), electrons(False)
    want = (signal_e - around_e) / np.sqrt((signal_e + around_e) / 2 + exact.read_noise_e**2)
    seen = painted(pair.radiance.left, pair.radiance.left.part_id >= FIRST_MARKER_ID)
    assert frame.drogue is not None and frame.left_from_drogue is not None
    for disc in marker_discs(marker_layout(frame.drogue), frame.rig, frame.left_from_drogue, "left"):
        # The picture has 8 bits; in the wrong band the contrast is off by a factor of two and more.
        assert signal_to_noise(frame, disc, seen) == pytest.approx(want, rel=0.03)


@pytest.mark.parametrize(("gain", "longer"), [(1.0, 16.0), (16.0, 1.0)])
def test_a_white_picture_has_no_contrast(full_pairs: list[Pair], gain: float, longer: float) -> None:
    """Whether the sites are full or the converter clips what the gain makes of their electrons."""
    frame, seen = full_pairs[-1].frame, full_pairs[-1].radiance.left
    exposure = frame.exposure.model_copy(update={"gain": gain, "time_s": longer * frame.exposure.time_s})
    frame = frame.model_copy(update={"exposure": exposure})
    is_marker = (seen.part_id >= FIRST_MARKER_ID)[..., None]
    light = np.float32(saturation_cd_m2(frame)) * np.where(is_marker, np.float32(8.0), np.float32(1.1))
    seen = replace(seen, radiance_cd_m2=np.repeat(light, 3, axis=2))
    assert frame.drogue is not None and frame.left_from_drogue is not None
    for disc in marker_discs(marker_layout(frame.drogue), frame.rig, frame.left_from_drogue, "left"):
        assert signal_to_noise(frame, disc, seen) == 0.0


def test_other_images_are_refused(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    small = np.zeros((10, 10, 3), dtype=np.uint8)
    with pytest.raises(ValueError, match="images: must be"):
        label_frame(pair.frame, pair.radiance, StereoImages(small, small, pair.frame.time_s, 1e-3))


def test_eyes_are_not_swapped(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        for left, right in zip(*(getattr(pair.record.views, eye).markers for eye in EYES), strict=True):
            assert left.center_proj_px[0] > right.center_proj_px[0]
