"""The parts that pixel centres see, against the circles of a drogue's face in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from drogue_models.marker_layout import marker_layout
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.stereo import EYES
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from tests.support.recipe_builder import paper_view_recipe

pytestmark = pytest.mark.mitsuba


@pytest.mark.parametrize("step_px", [1, 2])
@pytest.mark.usefixtures("engine")
def test_parts_are_those_of_the_circles_of_the_face(step_px: int) -> None:
    from render.mitsuba_engine.paths.rays import CameraRays, FrameRays
    from render.mitsuba_engine.paths.surface_light import SurfaceLight
    from render.mitsuba_engine.scene import SceneCache

    frame = sample_frame(paper_view_recipe(scale=0.25), 0)
    ambient = environment_radiance(frame.environment)
    scene = SceneCache().scene_of(frame, ambient)
    rays = FrameRays(frame, scene, [CameraRays(frame, eye) for eye in EYES], ambient, np.zeros(256, np.uint8))
    camera, drogue, pose = frame.rig.camera, frame.drogue, frame.left_from_drogue
    assert drogue is not None and pose is not None
    v, u = (grid.ravel() for grid in np.indices((camera.height_px, camera.width_px)))
    on_lattice = (u % step_px == 0) & (v % step_px == 0)
    seen = 0
    for number, eye in enumerate(EYES):
        # Where the rays of pixel centres meet the plane of the face, in the drogue's axes.
        way = pose.inverse().rotate(camera.rays(np.stack([u, v], axis=-1)))
        start = pose.inverse().apply(frame.rig.eye_offset_m(eye))
        place = (start - way * (start[2] / way[:, 2:]))[:, :2]
        # So far from every circle a pixel shows no other part: half a pixel across, and its tilt.
        margin_m = 0.6 * float(pose.translation_m[2]) / camera.fx_px
        away_m = np.linalg.norm(place[:, None] - marker_layout(drogue).centers_m[:, :2], axis=-1)
        radius_m, nearest = np.linalg.norm(place, axis=-1), away_m.argmin(axis=1)
        expected = np.full(len(u), 255)
        off = away_m.min(axis=1) > drogue.marker_radius_m + margin_m
        face = off & (radius_m > drogue.face_inner_radius_m + margin_m)
        face &= radius_m < drogue.rim_radius_m - 2 * drogue.rim_tube_radius_m - margin_m
        expected[face] = Part.FACE
        marked = away_m.min(axis=1) < drogue.marker_radius_m - margin_m
        expected[marked] = FIRST_MARKER_ID + nearest[marked]
        known = np.flatnonzero(expected < 255)
        light = SurfaceLight(rays, known[on_lattice[known]] + number * rays.size, 1.0, step_px)
        found = light.parts_at(known + number * rays.size)
        # A pixel between the centres has the part of the centre before it, where that is one.
        before = u[known] - u[known] % step_px + (v[known] - v[known] % step_px) * camera.width_px
        wanted = np.where(expected[before] < 255, expected[before], Part.SKY)
        np.testing.assert_array_equal(found, wanted)
        # The other eye has no centres.
        assert (light.parts_at(known + (1 - number) * rays.size) == Part.SKY).all()
        seen += np.unique(wanted[wanted != Part.SKY]).size
    # Face and eight markers, by both eyes.
    assert seen == 2 * 9
