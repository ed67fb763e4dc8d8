"""Where mist ends."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.environment import Environment, Mist
from scenes.environment_radiance import EnvironmentRadiance


@pytest.mark.parametrize("sky_model", ["daylight", "scattering"])
@pytest.mark.parametrize("patchiness", [0.0, 0.5])
def test_mist_ends_at_the_ground(patchiness: float, sky_model: str) -> None:
    """However deep mist is said to be, there is only the altitude of it: one picture, one light."""
    rays = np.random.default_rng(5).standard_normal((24, 24, 3))
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    to_ground, deeper = (
        EnvironmentRadiance(
            Environment(
                sun_elevation_deg=40.0,
                sun_azimuth_deg=60.0,
                turbidity=2.5,
                visibility_m=50_000.0,
                altitude_m=50.0,
                ground_reflectance_rgb=(0.1, 0.1, 0.06),
                ground_texture_seed=3,
                sky_model=sky_model,
                mist=Mist(visibility_m=600, above_m=50, below_m=below_m, patchiness=patchiness, texture_seed=7),
            )
        )
        for below_m in (50.0, 2000.0)
    )
    np.testing.assert_array_equal(deeper.radiance(rays), to_ground.radiance(rays))
    np.testing.assert_array_equal(deeper.ground_illuminance_lux, to_ground.ground_illuminance_lux)
