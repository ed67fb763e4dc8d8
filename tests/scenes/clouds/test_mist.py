"""Where mist ends, and what its patches look like."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.environment import Environment, Mist
from scenes.clouds.thin_layers import mist_depth
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


@pytest.mark.parametrize("seed", range(1, 5))
def test_patches_leave_no_line_where_the_way_through_mist_gets_long(seed: int) -> None:
    """Over a wide view patches even out, so that the mean light of a row changes smoothly with its height.

    Second differences of the share of mist's light, between rows 0.1 degrees apart and 70 degrees wide. Ten steps of
    0.03 to 0.6 sizes of patches gave 0.011 to 0.019, some 2 degrees above the horizon.
    """
    elevations, azimuths = np.radians(np.arange(-15.0, 15.0, 0.1))[:, None], np.radians(np.linspace(-35.0, 35.0, 300))
    level = np.cos(elevations)
    rays = np.stack(
        [level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations) + 0.0 * azimuths], axis=-1
    ).astype(np.float32)
    mist = Mist(visibility_m=1500, above_m=80, below_m=300, patchiness=0.9, texture_seed=seed)
    depth, tone = mist_depth(mist, rays, (0.0, 0.0))
    rows = (tone * (1.0 - np.exp(-depth))).mean(axis=1)
    assert np.abs(np.diff(rows, 2)).max() < 0.004
    # There are patches, all the same.
    assert tone.std() > 0.02
