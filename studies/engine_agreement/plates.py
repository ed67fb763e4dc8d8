"""Light on a white plate by both engines, and by the surroundings' own integral."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.recipe.recipe import Recipe, RenderSettings, load_recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part
from geometry.se3 import RigidTransform, rotation_from_angles
from render.engine import RenderEngine
from scenes.environment_radiance import surroundings
from scenes.sampler import sample_frame
from studies.engine_agreement.measures import luminance

WHITE = (1.0, 1.0, 1.0)
# Facing the camera, and turned up, down and aside.
TILTS_DEG = ((0.0, 0.0), (35.0, 0.0), (-35.0, 0.0), (0.0, 40.0))


@dataclass(frozen=True)
class PlateLight:
    """Illuminance of one plate by either engine, and from the surroundings without anything around. [lux]"""

    pitch_deg: float
    yaw_deg: float
    one_lux: float
    other_lux: float
    integral_lux: float

    @property
    def ratio(self) -> float:
        """One engine's light over the other's."""
        return self.one_lux / self.other_lux


def compare_plate(tilt_deg: tuple[float, float], samples: int, one: RenderEngine, other: RenderEngine) -> PlateLight:
    """Light on the drogue's face, painted white: it shines with illuminance / pi.

    Args:
        tilt_deg: pitch and yaw of the plate. [deg]
        samples: through each of its pixels.
        one, other: engines.
    """
    frame, settings = plate_frame(samples, tilt_deg)
    got = []
    for engine in (one, other):
        seen = engine.render(frame, settings).left
        inside = (seen.part_id == Part.FACE) & (seen.coverage > 0.999)
        got.append(np.pi * float(luminance(seen.radiance_cd_m2[inside]).mean()))
    assert frame.left_from_drogue is not None
    normal = -(frame.world_from_left @ frame.left_from_drogue).rotation[:, 2]
    integral = luminance(surroundings(frame.environment).plate_illuminance_lux(normal))
    return PlateLight(*tilt_deg, got[0], got[1], float(integral))


def plate_frame(samples: int, tilt_deg: tuple[float, float]) -> tuple[FrameSpec, RenderSettings]:
    """A frame of the white plate, and how to render it; arguments as `compare_plate`."""
    recipe = _plate_recipe(samples)
    return _tilted(recipe, *tilt_deg), recipe.render


def _plate_recipe(samples: int) -> Recipe:
    recipe, _ = load_recipe("smoke")
    changes = {
        "distance": {"law": "stations", "stations_m": (4.0,)},
        "render": {**recipe.render.model_dump(), "samples_per_px": samples, "surround_samples_per_px": 4},
    }
    return Recipe.model_validate({**recipe.model_dump(), **changes})


def _tilted(recipe: Recipe, pitch_deg: float, yaw_deg: float) -> FrameSpec:
    frame = sample_frame(recipe, 0)
    assert frame.drogue is not None
    drogue = DrogueParameters.model_validate(
        frame.drogue.model_dump() | {"face_reflectance_rgb": WHITE, "marker_reflectance_rgb": WHITE}
    )
    # The sun behind the cameras, so that nothing throws a shadow on the plate; air that takes nothing.
    environment = frame.environment.model_copy(
        update={"sun_azimuth_deg": 190.0, "sun_elevation_deg": 35.0, "visibility_m": 400_000.0}
    )
    rotation = rotation_from_angles(float(np.radians(pitch_deg)), float(np.radians(yaw_deg)), 0.0)
    pose = RigidTransform(rotation, np.array([0.0, 0.0, 4.0]))
    return frame.model_copy(update={"drogue": drogue, "environment": environment, "left_from_drogue": pose})
