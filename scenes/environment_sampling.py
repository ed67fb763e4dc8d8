"""Sampling the environment of a scene: sun, clouds, mist, moon and ground."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.environment_ranges import (
    Clouds,
    EnvironmentMapRanges,
    EnvironmentRanges,
    MistRanges,
    MoonRanges,
)
from datasets_manifest.types.environment import (
    LEAST_THICKNESS_M,
    CloudLayer,
    Environment,
    EnvironmentMap,
    GroundKind,
    Mist,
    Moon,
)
from datasets_manifest.types.field_types import Range
from drogue_models.frozen_model import ReflectanceRgb
from scenes.ground.ground_radiance import MEAN_REFLECTANCE
from scenes.sky.equirectangular_sky import load_map

# Largest deviation of a scene's ground from the mean of its kind, in brightness and in colour.
_GROUND_SPREAD, _GROUND_TINT = 0.25, 0.06


def sample_uniform(rng: np.random.Generator, limits: Range) -> float:
    """A uniform sample; it consumes one random number even when both limits are equal."""
    return float(rng.uniform(limits.low, limits.high))


def environment_of_scene(seed: int, scene_id: int, ranges: EnvironmentRanges) -> Environment:
    """The environment of a scene: a function of seed and scene alone.

    Each part has a random stream of its own, so that a scene keeps its sky when the recipe gets another cloud layer,
    mist or a moon.
    """
    rng = frame_generator(seed, scene_id, "environment")
    sky = {
        "sun_elevation_deg": sample_uniform(rng, ranges.sun_elevation_deg),
        "sun_azimuth_deg": sample_uniform(rng, ranges.sun_azimuth_deg),
        "turbidity": sample_uniform(rng, ranges.turbidity),
        "visibility_m": sample_uniform(rng, ranges.visibility_m),
        "altitude_m": sample_uniform(rng, ranges.altitude_m),
    }
    ground = ranges.ground[int(rng.integers(len(ranges.ground)))]
    ground_texture_seed = int(rng.integers(2**31))
    ground_rng = frame_generator(seed, scene_id, "ground")
    # The first layer uses the scene's main stream, each other layer a stream of its own.
    layer_streams = [rng] + [
        frame_generator(seed, scene_id, f"cloud layer {index}") for index in range(1, len(ranges.clouds))
    ]
    layers = [
        sample_cloud(stream, frame_generator(seed, scene_id, f"cloud shape {index}"), clouds)
        for index, (stream, clouds) in enumerate(zip(layer_streams, ranges.clouds, strict=False))
    ]
    over_ground = [_over_ground(layer, sky["altitude_m"]) for layer in layers if layer is not None]
    environment = Environment(
        **sky,
        ground=ground,
        ground_reflectance_rgb=_sample_reflectance(ground_rng, ground),
        ground_texture_seed=ground_texture_seed,
        wind_speed_m_s=sample_uniform(ground_rng, ranges.wind_speed_m_s),
        clouds=tuple(layer for layer in over_ground if layer is not None),
        mist=sample_mist(
            frame_generator(seed, scene_id, "mist"), frame_generator(seed, scene_id, "mist patches"), ranges.mist
        ),
        moon=sample_moon(frame_generator(seed, scene_id, "moon"), ranges.moon),
        sky_model=ranges.sky_model,
    )
    return (
        environment if ranges.map is None else _mapped(environment, ranges.map, frame_generator(seed, scene_id, "map"))
    )


def _mapped(environment: Environment, ranges: EnvironmentMapRanges, rng: np.random.Generator) -> Environment:
    """The environment with a map for sky and ground, and with the map's sun if it has one."""
    environment_map = EnvironmentMap(
        path=ranges.path,
        sha256=ranges.sha256,
        folder=ranges.folder,
        cd_m2_per_unit=ranges.cd_m2_per_unit,
        horizontal_illuminance_lux=ranges.horizontal_illuminance_lux,
        rotation_deg=sample_uniform(rng, ranges.rotation_deg),
    )
    changes: dict[str, object] = {"clouds": (), "mist": None, "moon": None, "map": environment_map}
    light = load_map(environment_map)
    if light.sun_lux.max() > 0:
        x, y, z = light.sun_direction
        changes["sun_elevation_deg"] = float(np.degrees(np.arcsin(z)))
        changes["sun_azimuth_deg"] = float(np.degrees(np.arctan2(y, x)))
    return environment.model_copy(update=changes)


def _sample_reflectance(rng: np.random.Generator, ground: GroundKind) -> ReflectanceRgb:
    brightness, tint = 1.0 + _GROUND_SPREAD * rng.uniform(-1, 1), _GROUND_TINT * rng.uniform(-1, 1)
    red, green, blue = MEAN_REFLECTANCE[ground]
    return red * brightness * (1.0 + tint), green * brightness, blue * brightness * (1.0 - tint)


def sample_cloud(rng: np.random.Generator, shape_rng: np.random.Generator, clouds: Clouds) -> CloudLayer | None:
    """A cloud layer, or None; thickness and heading come from `shape_rng`."""
    layer = CloudLayer(
        kind=clouds.kind,
        height_above_camera_m=sample_uniform(rng, clouds.height_above_camera_m),
        cover_fraction=sample_uniform(rng, clouds.cover_fraction),
        feature_size_m=sample_uniform(rng, clouds.feature_size_m),
        optical_depth=sample_uniform(rng, clouds.optical_depth),
        texture_seed=int(rng.integers(2**31)),
        thickness_m=sample_uniform(shape_rng, clouds.thickness_m),
        heading_deg=sample_uniform(shape_rng, clouds.heading_deg),
    )
    return layer if rng.random() < clouds.scene_fraction else None


def _over_ground(layer: CloudLayer, altitude_m: float) -> CloudLayer | None:
    """The layer, thinner where it would reach into the ground, or None where there is no room for it."""
    room_m = altitude_m + layer.height_above_camera_m
    if layer.is_above or layer.thickness_m <= room_m:
        return layer
    return None if room_m < LEAST_THICKNESS_M else layer.model_copy(update={"thickness_m": room_m})


def sample_mist(rng: np.random.Generator, patch_rng: np.random.Generator, ranges: MistRanges) -> Mist | None:
    """Mist around the camera, or None; its patches come from `patch_rng`."""
    patchiness = sample_uniform(patch_rng, ranges.patchiness)
    mist = Mist(
        visibility_m=sample_uniform(rng, ranges.visibility_m),
        above_m=sample_uniform(rng, ranges.above_m),
        below_m=sample_uniform(rng, ranges.below_m),
        patchiness=patchiness,
        texture_seed=int(patch_rng.integers(1, 2**31)) if patchiness > 0 else 0,
    )
    return mist if rng.random() < ranges.scene_fraction else None


def sample_moon(rng: np.random.Generator, ranges: MoonRanges) -> Moon | None:
    """A moon, or None."""
    moon = Moon(
        elevation_deg=sample_uniform(rng, ranges.elevation_deg),
        azimuth_deg=sample_uniform(rng, ranges.azimuth_deg),
        phase_angle_deg=sample_uniform(rng, ranges.phase_angle_deg),
    )
    return moon if rng.random() < ranges.scene_fraction else None
