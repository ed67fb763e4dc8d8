"""Path-traced pixels against the closed forms and OpenCV: what the labels rest on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RenderSettings, load_recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from geometry.circles import disc_area_px2, project_disc_centers
from geometry.stereo import EYES
from labelgen.disc_images import marker_discs
from render.engine import RenderEngine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import paper_view_recipe

pytestmark = pytest.mark.mitsuba

# (1 - Rec. 709 luminance of the lamp's light is 1 by construction): far above any sky.
LAMP_CD_M2 = 1e6
# Rays through other things, whose light is taken off again.
FEWEST_ELSEWHERE = {"open_samples_per_px": 1, "surround_samples_per_px": 1}
# For passes, which are those of pixel centres however few rays make the light.
FEWEST = {**FEWEST_ELSEWHERE, "samples_per_px": 1, "edge_samples_per_px": 1, "denoise": False}


def lit(frame: FrameSpec, luminance_cd_m2: float) -> FrameSpec:
    drogue = frame.drogue.model_copy(update={"marker_luminance_cd_m2": luminance_cd_m2})
    return frame.model_copy(update={"drogue": drogue})


def without_clouds(frame: FrameSpec) -> FrameSpec:
    """The frame below a sky that takes no time."""
    return frame.model_copy(update={"environment": frame.environment.model_copy(update={"clouds": (), "mist": None})})


def emission_images(engine: RenderEngine, frame: FrameSpec, settings: RenderSettings) -> dict[str, np.ndarray]:
    """Light of the lamps alone: the same frame with lamps minus without.

    Sun and sky bring below 1 % of the lamps' light: four rays through an edge know their step to half of that, and add
    0.25 % to the 1.3 % by which 64 jittered rays miss the lamp's share of a pixel.
    """
    on = engine.render(lit(frame, LAMP_CD_M2), settings)
    off = engine.render(frame, settings.model_copy(update={**FEWEST, "edge_samples_per_px": 4}))
    return {
        eye: (getattr(on, eye).radiance_cd_m2 - getattr(off, eye).radiance_cd_m2) @ REC709_LUMINANCE for eye in EYES
    }


def centroid_and_area(image: np.ndarray, center_px: np.ndarray, radius_px: float) -> tuple[np.ndarray, float]:
    """Weighted centroid and area within a window that reaches 2.5 px beyond the disc."""
    reach = radius_px + 2.5
    u0, v0 = np.floor(center_px - reach).astype(int)
    u1, v1 = np.ceil(center_px + reach).astype(int) + 1
    v, u = np.mgrid[v0:v1, u0:u1]
    weight = np.where(np.hypot(u - center_px[0], v - center_px[1]) <= reach, image[v0:v1, u0:u1], 0.0) / LAMP_CD_M2
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum(), weight.sum()


def test_centroids_of_lit_markers_are_the_ellipse_centres(engine: RenderEngine) -> None:
    errors, area_ratios = [], []
    # Near drogues in a quarter or half as many pixels a side: their markers have 5 px and more all the same. Far ones
    # in the middle of the paper's view.
    views = ((0.25, 2.0, 1.0), (0.5, 10.0, 0.25), (1.0, 20.0, 0.25), (1.0, 40.0, 0.125))
    for scale, distance_m, window in views:
        recipe = paper_view_recipe(scale, (distance_m,), samples=1, window=window)
        settings = recipe.render.model_copy(update={"edge_samples_per_px": 64, **FEWEST_ELSEWHERE})
        frame = sample_frame(recipe, 0)
        images = emission_images(engine, frame, settings)
        layout = marker_layout(frame.drogue)
        radii = np.full(layout.count, layout.radius_m)
        for eye in EYES:
            truth = project_disc_centers(recipe.rig, frame.left_from_drogue, layout.centers_m, radii, eye)
            for center_m, center_px in zip(layout.centers_m, truth, strict=True):
                area = disc_area_px2(recipe.rig, frame.left_from_drogue, center_m, layout.radius_m, eye)
                measured, got_area = centroid_and_area(images[eye], center_px, 1.1 * np.sqrt(area / np.pi))
                errors.append(measured - center_px)
                area_ratios.append(got_area / area)
    errors = np.array(errors)
    assert len(errors) == 4 * 8 * 2
    print("rms px", np.sqrt(np.mean(errors**2)), "mean px", errors.mean(axis=0), "area", np.mean(area_ratios))
    # The bar that the labels are held to; 64 jittered samples in each pixel of an edge leave about 0.0045 px of noise,
    # which falls with the square root of the radius.
    assert np.sqrt(np.mean(errors**2)) <= 0.01
    assert np.abs(errors.mean(axis=0)).max() <= 0.003
    # Area: haze over 40 m takes below 0.1 %; sampling noise of one area is below 1 %, of the mean below 0.1 %.
    assert np.mean(area_ratios) == pytest.approx(1.0, abs=0.004)


def test_opencv_predicts_the_same_places() -> None:
    """The 3-D centres that labels project, projected by cv2.projectPoints, in both eyes."""
    recipe = paper_view_recipe(stations_m=(2.0, 10.0, 40.0))
    for index in range(3):
        frame = sample_frame(recipe, index)
        layout = marker_layout(frame.drogue)
        rotation_vector, _ = cv2.Rodrigues(frame.left_from_drogue.rotation)
        for eye in EYES:
            translation = frame.left_from_drogue.translation_m - recipe.rig.eye_offset_m(eye)
            theirs, _ = cv2.projectPoints(
                layout.centers_m, rotation_vector, translation, recipe.rig.camera.matrix(), np.zeros(5)
            )
            ours = recipe.rig.project(frame.left_from_drogue.apply(layout.centers_m), eye)
            # Rodrigues and back costs a few ulp of 2000 px.
            np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-9)


def test_passes_of_pixel_centres(engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(3.0,), samples=1)
    frame = without_clouds(sample_frame(recipe, 0))
    radiance = engine.render(frame, recipe.render.model_copy(update=FEWEST))
    layout = marker_layout(frame.drogue)
    normal = frame.left_from_drogue.rotation[:, 2]
    for eye in EYES:
        seen = getattr(radiance, eye)
        on_marker = (seen.part_id >= 32) & (seen.part_id < 32 + layout.count)
        v, u = np.nonzero(on_marker)
        rays = recipe.rig.camera.rays(np.stack([u, v], axis=-1))
        origin = frame.left_from_drogue.translation_m - recipe.rig.eye_offset_m(eye)
        plane_depth = (origin @ normal) / (rays @ normal)
        # float32 coordinates of 3 m carry 2e-7 m; a few roundings on the way.
        np.testing.assert_allclose(seen.depth_m[on_marker], plane_depth, atol=3e-6)
        # Visible faces look at the camera, against the drogue's axis.
        np.testing.assert_allclose(seen.normal[on_marker], np.broadcast_to(-normal, (len(u), 3)), atol=1e-5)
        points = rays * plane_depth[:, None] + recipe.rig.eye_offset_m(eye)
        in_drogue = frame.left_from_drogue.inverse().apply(points)
        index = seen.part_id[on_marker] - 32
        offset = np.linalg.norm(in_drogue - layout.centers_m[index], axis=1)
        assert offset.max() <= layout.radius_m * 1.001
        assert np.isinf(seen.depth_m[seen.part_id == 0]).all()
        # Nothing stands before the markers, so what is visible is all there is, on the same grid.
        for marker in range(layout.count):
            assert seen.amodal_px[32 + marker] == np.count_nonzero(seen.part_id == 32 + marker)


def test_same_frame_same_bits(engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.125, stations_m=(3.0, 5.0), samples=4)
    settings = recipe.render.model_copy(update={"edge_samples_per_px": 16})
    first = engine.render(sample_frame(recipe, 0), settings)
    engine.render(sample_frame(recipe, 1), settings)
    again = engine.render(sample_frame(recipe, 0), settings)
    for eye in EYES:
        for name in ("radiance_cd_m2", "coverage", "part_id", "depth_m", "normal"):
            assert np.array_equal(getattr(getattr(first, eye), name), getattr(getattr(again, eye), name)), name


def test_moving_drogue_is_blurred_around_its_middle(engine: RenderEngine) -> None:
    """The centroid of a streak is the mid-exposure place, and the streak is as long as speed times time says."""
    recipe = paper_view_recipe(scale=0.25, stations_m=(5.0,), samples=1, window=0.5)
    settings = recipe.render.model_copy(update={"edge_samples_per_px": 64, **FEWEST_ELSEWHERE})
    still = sample_frame(recipe, 0).model_copy(
        update={"exposure": sample_frame(recipe, 0).exposure.model_copy(update={"time_s": 0.01})}
    )
    across = still.left_from_drogue.rotation.T @ np.array([6.0, 0.0, 0.0])
    moving = still.model_copy(update={"drogue_twist_per_s": np.concatenate([across, np.zeros(3)])})
    layout = marker_layout(still.drogue)
    truth = project_disc_centers(
        recipe.rig, still.left_from_drogue, layout.centers_m, np.full(8, layout.radius_m), "left"
    )
    sharp, blurred = (emission_images(engine, frame, settings)["left"] for frame in (still, moving))
    travel_px = recipe.rig.camera.fx_px * 6.0 * 0.01 / 5.0
    for center in truth:
        radius_px = 1.1 * layout.radius_m * recipe.rig.camera.fx_px / 5.0 + travel_px / 2
        place, area = centroid_and_area(blurred, center, radius_px)
        still_place, still_area = centroid_and_area(sharp, center, radius_px)
        # 64 random times of a streak of 6 px scatter each pixel that an end sweeps. Around a disc of radius r those are
        # 4 r 6 px2, by 1/6 of a pixel's light for one time: 0.08 px / sqrt(r / px), here 0.035 px. Four of them:
        assert np.abs(place - still_place).max() < 0.14
        assert area == pytest.approx(still_area, rel=0.03)
    row = round(truth[0, 1])
    width = [np.count_nonzero(image[row] > 0.02 * LAMP_CD_M2) for image in (sharp, blurred)]
    # The streak's ends are spread over a pixel each.
    assert width[1] - width[0] == pytest.approx(2 * travel_px, abs=4)


def test_rays_through_seams_are_sent_again(engine: RenderEngine) -> None:
    """At this place a pixel centre's ray slips between two triangles of a marker's front and ends on its back."""
    # Frames found by search, in streams of the seed alone.
    recipe = load_recipe("demo", seed=11, changes={"frames": {"stream": ""}}).recipe
    settings = recipe.render.model_copy(update=FEWEST)
    frame = without_clouds(sample_frame(recipe, 49))
    seen = engine.render(frame, settings).right
    normal = frame.left_from_drogue.rotation[:, 2]
    v, u = np.nonzero(seen.part_id >= 32)
    rays = recipe.rig.camera.rays(np.stack([u, v], axis=-1))
    origin = frame.left_from_drogue.translation_m - recipe.rig.eye_offset_m("right")
    # A ray that was moved by 0.01 px meets the tilted plane 2e-6 m away; the marker's back is 3 mm behind.
    np.testing.assert_allclose(seen.depth_m[v, u], (origin @ normal) / (rays @ normal), atol=1e-5)


@pytest.mark.parametrize("index", [341, pytest.param(594, marks=pytest.mark.slow)])
def test_rays_that_slip_into_a_markers_pocket_are_sent_again(engine: RenderEngine, index: int) -> None:
    """In these frames a ray just beyond a marker slips through the face's front and ends on the marker's wall."""
    # Frames found by search, in streams of the seed alone.
    recipe = load_recipe("detector-small", seed=1, changes={"frames": {"stream": ""}}).recipe
    settings = recipe.render.model_copy(update=FEWEST)
    frame = without_clouds(sample_frame(recipe, index))
    seen = engine.render(frame, settings).right
    layout = marker_layout(frame.drogue)
    for number, disc in enumerate(marker_discs(layout, recipe.rig, frame.left_from_drogue, "right")):
        rows, columns = np.nonzero(seen.part_id == 32 + number)
        beyond = disc.distance_m(np.stack([columns, rows], axis=-1).astype(float)) / disc.radius_m - 1
        # The wall stands 0.9 % of the radius beyond the pixel's place on the front; polygons keep within 0.01 %.
        assert beyond.max(initial=-1.0) < 5e-4
