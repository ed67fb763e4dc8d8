"""Drawing the environment of a scene."""

from __future__ import annotations

import numpy as np

from datasets_manifest.frame import CloudLayer, Environment
from datasets_manifest.recipe import Clouds, EnvironmentRanges, Range
from drogue_models.parameters import ReflectanceRgb
from scenes.seeding import generator

# Mean diffuse reflectances in linear Rec. 709, our choice within published ranges: sea, forest, fields, dry land.
GROUND_COVERS: tuple[ReflectanceRgb, ...] = (
    (0.020, 0.032, 0.045),
    (0.035, 0.050, 0.028),
    (0.105, 0.105, 0.060),
    (0.200, 0.165, 0.115),
)


def draw(rng: np.random.Generator, limits: Range) -> float:
    """A uniform draw; one number is used up even when both ends are equal."""
    return float(rng.uniform(limits.low, limits.high))


def environment_of_scene(seed: int, scene_id: int, ranges: EnvironmentRanges) -> Environment:
    """The environment of a scene: a function of seed and scene alone."""
    return sample_environment(generator(seed, scene_id, "environment"), ranges)


def sample_environment(rng: np.random.Generator, ranges: EnvironmentRanges) -> Environment:
    """Sky, sun, air, ground and cloud drawn from their ranges."""
    return Environment(
        sun_elevation_deg=draw(rng, ranges.sun_elevation_deg),
        sun_azimuth_deg=draw(rng, ranges.sun_azimuth_deg),
        turbidity=draw(rng, ranges.turbidity),
        visibility_m=draw(rng, ranges.visibility_m),
        altitude_m=draw(rng, ranges.altitude_m),
        ground_reflectance_rgb=GROUND_COVERS[int(rng.integers(len(GROUND_COVERS)))],
        ground_texture_seed=int(rng.integers(2**31)),
        cloud=sample_cloud(rng, ranges.clouds),
    )


def sample_cloud(rng: np.random.Generator, clouds: Clouds) -> CloudLayer | None:
    """A cloud layer, or none."""
    layer = CloudLayer(
        height_above_camera_m=draw(rng, clouds.height_above_camera_m),
        cover_fraction=draw(rng, clouds.cover_fraction),
        feature_size_m=draw(rng, clouds.feature_size_m),
        optical_depth=draw(rng, clouds.optical_depth),
        texture_seed=int(rng.integers(2**31)),
    )
    return layer if rng.random() < clouds.scene_fraction else None
