"""What the pixels' centres see, against rays through all of them, and rays against closed surfaces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.stereo import EYES
from render.engine import RenderEngine
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RIG_320_PX, RecipeTable, build_recipe, paper_view_recipe, stations

pytestmark = pytest.mark.mitsuba


@pytest.fixture(scope="module")
def scene_of(engine: RenderEngine) -> Callable[[FrameSpec], Any]:
    from render.mitsuba_engine.scene import SceneCache

    scenes = SceneCache()
    return lambda frame: scenes.scene_of(frame, environment_radiance(frame.environment))


# The paper's field of view in a quarter as many pixels a side.
BASE: RecipeTable = {
    "name": "passes",
    "seed": 3,
    "rig": RIG_320_PX | {"probe_tip_body_m": [2.6, 0.5, 0.35]},
    "frames": {"count": 3},
    "distance": stations(2.0, 9.0, 33.0),
}
LENSES = {"k1": {"low": -0.1, "high": -0.05}, "principal_point_px": 4.0, "right_rotation_deg": 0.5}
MOVING = {"speed_m_s": 40.0, "rate_deg_s": 300.0}
BYSTANDERS = {"probe": True, "obstacle_frame_fraction": 1, "distractor_frame_fraction": 1}


@pytest.mark.parametrize(
    "changes",
    [{}, {"rig": {"eyes": LENSES}}, {"pose": MOVING}, {"target": BYSTANDERS}],
    ids=["ideal", "real lenses", "moving", "bystanders"],
)
def test_nothing_is_seen_where_no_ray_is_sent(
    scene_of: Callable[[FrameSpec], Any], changes: RecipeTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    from render.mitsuba_engine.paths.rays import CameraRays
    from render.mitsuba_engine.wavefront_tracer import CenterPasses

    recipe = build_recipe(BASE, **changes)
    for frame in (sample_frame(recipe, index) for index in range(recipe.frames.count)):
        scene = scene_of(frame)
        for eye in EYES:
            passes, everywhere = (CenterPasses(frame, CameraRays(frame, eye), eye, scene) for _ in range(2))
            size = frame.rig.camera.width_px * frame.rig.camera.height_px
            monkeypatch.setattr(everywhere, "pixels_of", lambda *_, size=size: np.arange(size))
            for s in (-1.0, 0.0, 1.0):
                (ids, distance_m), (all_ids, all_m) = passes.part_ids(s), everywhere.part_ids(s)
                assert ids.any() and set(np.unique(all_ids)) == set(np.unique(ids))
                # What a ray that grazes an edge meets may depend on the rays that travel with it.
                other = np.flatnonzero(ids != all_ids)
                sent = np.isin(other, passes.pixels_of(scene.object_corners_m, s))
                assert sent.all() and len(other) <= 3
                assert np.count_nonzero(distance_m != all_m) <= 3


def test_depths_are_those_of_the_plane_that_is_seen(engine: RenderEngine) -> None:
    # Depths are those of pixel centres, however few rays make the light.
    few = {"open_samples_per_px": 1, "edge_samples_per_px": 1, "surround_samples_per_px": 1, "denoise": False}
    for distance_m, window in ((3.0, 0.5), (11.0, 0.25), (36.0, 0.25)):
        recipe = paper_view_recipe(stations_m=(distance_m,), samples=1, window=window)
        frame = sample_frame(recipe, 0)
        seen = engine.render(frame, recipe.render.model_copy(update=few)).left
        axis, center_m = frame.left_from_drogue.rotation[:, 2], frame.left_from_drogue.translation_m
        # The front of the face lies in the drogue's plane z = 0.
        rows, columns = np.nonzero((seen.part_id == Part.FACE) & (seen.normal @ axis < -0.9))
        rays = frame.rig.camera.rays(np.column_stack([columns, rows]).astype(np.float64))
        depth_m = axis @ center_m / (rays @ axis)
        assert len(rows) > 100
        # Sums of three float32 products.
        assert np.abs(seen.depth_m[rows, columns] - depth_m).max() < 4 * np.finfo(np.float32).eps * depth_m.max()


def test_no_ray_passes_between_the_triangles_of_a_marker(scene_of: Callable[[FrameSpec], Any]) -> None:
    """Seen from inside, a marker is black: one such ray of four takes a quarter of a pixel's light away."""
    import drjit as dr
    import mitsuba as mi

    from render.mitsuba_engine.jit_arrays import jit_array
    from render.mitsuba_engine.paths.rays import CameraRays
    from render.mitsuba_engine.scene import by_shape

    rays = 1_000_000
    rng = np.random.default_rng(4)
    recipe = paper_view_recipe(stations_m=(24.0,))
    for frame in (sample_frame(recipe, index) for index in range(2)):
        scene = scene_of(frame)
        camera = CameraRays(frame, "left")
        for marker in range(frame.drogue.marker_count):
            center_m = np.array([*frame.drogue.marker_positions_m[marker], 0.0])
            center_px = frame.rig.camera.project(frame.left_from_drogue.apply(center_m))
            # A square inside the disc, however it is turned.
            half_px = (
                0.3 * frame.drogue.marker_radius_m * frame.rig.camera.fx_px / frame.left_from_drogue.translation_m[2]
            )
            at_px = center_px + rng.uniform(-half_px, half_px, (rays // frame.drogue.marker_count, 2))
            pixel = np.rint(at_px)
            place = (at_px - pixel + 0.5).astype(np.float32)
            flat = pixel[:, 1] * frame.rig.camera.width_px + pixel[:, 0]
            sent = camera.rays(
                jit_array(mi.UInt32, flat),
                mi.Point2f(jit_array(mi.Float, place[:, 0]), jit_array(mi.Float, place[:, 1])),
                mi.Float(0.5),
            )
            surface = scene.scene.ray_intersect(sent)
            parts = by_shape(scene.scene, np.arange(256))[np.array(dr.reinterpret_array(mi.UInt32, surface.shape))]
            assert set(parts) == {FIRST_MARKER_ID + marker}
            assert np.array(surface.wi.z).min() > 0
