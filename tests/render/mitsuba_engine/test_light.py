"""Light on the drogue against the surroundings' own integral: orientation and absolute level of sky and sun."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drogue_models.parameters import DrogueParameters, HubParameters
from drogue_models.parts import Part
from geometry.se3 import RigidTransform
from render.engine import RenderEngine
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import luminance
from tests.support.recipe_builder import paper_view_recipe

pytestmark = pytest.mark.mitsuba

WHITE = (1.0, 1.0, 1.0)
# For what is looked at inside parts that see most of the sky.
EVEN = {"samples_per_px": 4, "open_samples_per_px": 16, "edge_samples_per_px": 16, "noise_over_sensor": 100.0}


@pytest.mark.parametrize("sun_azimuth_deg", [0.0, 100.0, 180.0, 250.0])
def test_white_face_shines_as_its_irradiance_says(engine: RenderEngine, sun_azimuth_deg: float) -> None:
    """A white face sends back E / pi, with E integrated over the surroundings in numpy; nothing shades the face."""
    recipe = paper_view_recipe(scale=0.25, stations_m=(4.0,))
    frame = sample_frame(recipe, 0)
    drogue = DrogueParameters.model_validate(
        frame.drogue.model_dump() | {"face_reflectance_rgb": WHITE, "marker_reflectance_rgb": WHITE}
    )
    environment = frame.environment.model_copy(
        update={"sun_azimuth_deg": sun_azimuth_deg, "sun_elevation_deg": 35.0, "visibility_m": 400_000.0}
    )
    frame = frame.model_copy(update={"drogue": drogue, "environment": environment})
    seen = engine.render(frame, recipe.render.model_copy(update=EVEN)).left
    normal = -(frame.world_from_left @ frame.left_from_drogue).rotation[:, 2]
    expected = luminance(environment_radiance(environment).plate_illuminance_lux(normal)) / np.pi
    inside = (seen.part_id == Part.FACE) & (seen.coverage > 0.999)
    got = luminance(seen.radiance_cd_m2[inside]).mean()
    # Monte Carlo over some 1000 pixels of 16 paths: below 0.3 %; the sky map's texels of 1.4 degrees: below 1 %.
    # The rim torus and the hose reflect a little light on the face.
    assert got == pytest.approx(float(expected), rel=0.015)


def test_nothing_shadows_the_markers(engine: RenderEngine) -> None:
    """With the sun behind the receiver every marker is evenly lit: no shadow edge of rim or rib lies on it."""
    recipe = paper_view_recipe(scale=0.25, stations_m=(2.0,))
    frame = sample_frame(recipe, 0)
    environment = frame.environment.model_copy(update={"sun_azimuth_deg": 170.0, "sun_elevation_deg": 20.0})
    level = RigidTransform(np.eye(3), frame.left_from_drogue.translation_m * [0, 0, 1])
    drogue = frame.drogue.model_copy(update={"hub": HubParameters()})
    frame = frame.model_copy(update={"environment": environment, "left_from_drogue": level, "drogue": drogue})
    seen = engine.render(frame, recipe.render.model_copy(update=EVEN)).left
    for marker in range(8):
        # One pixel inside: pixels on the edge hold some of the dark face.
        inside = cv2.erode((seen.part_id == 32 + marker).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        values = seen.radiance_cd_m2[inside, 0]
        top, bottom = np.percentile(values, [99, 1])
        # Sun on a flat disc: only sampling noise of the sky's part (16 paths) may spread the pixels.
        assert (top - bottom) / values.mean() < 0.12
