from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.frame import CloudLayer, Environment
from scenes.sky import ClearSky, direction_from_angles
from scenes.surroundings import Surroundings, luminance
from scenes.texture import sample_texture


def environment(**changes):
    values = {
        "sun_elevation_deg": 40.0,
        "sun_azimuth_deg": 60.0,
        "turbidity": 2.5,
        "visibility_m": 50_000.0,
        "altitude_m": 3000.0,
        "ground_reflectance_rgb": (0.1, 0.1, 0.06),
        "ground_texture_seed": 3,
    }
    return Environment.model_validate(values | changes)


def test_zenith_luminance_is_the_published_formula():
    """Y_z = (4.0453 T - 4.9710) tan((4/9 - T/120)(pi - 2 s)) - 0.2155 T + 2.4192 [kcd/m2], worked by hand for T = 3."""
    sky = ClearSky(environment(turbidity=3.0, sun_elevation_deg=50.0))
    s = np.radians(40.0)
    expected = (4.0453 * 3 - 4.9710) * np.tan((4 / 9 - 3 / 120) * (np.pi - 2 * s)) - 0.2155 * 3 + 2.4192
    got = luminance(sky.radiance(np.array([0.0, 0.0, 1.0])))
    assert float(got) == pytest.approx(expected * 1e3, rel=2e-4)


def test_sunlight_at_the_ground_has_the_level_of_a_clear_day():
    """Direct normal illuminance under a high sun is 80-105 klux on clear days (IES handbook)."""
    sky = ClearSky(environment(sun_elevation_deg=60.0))
    assert 80_000 < float(luminance(sky.sun_illuminance_lux)) < 105_000


def test_low_sun_is_dimmer_and_redder():
    high, low = (ClearSky(environment(sun_elevation_deg=e)).sun_illuminance_lux for e in (60.0, 5.0))
    assert np.all(low < high)
    assert low[0] / low[2] > 2 * high[0] / high[2]


def test_brightest_near_the_sun():
    sky = ClearSky(environment())
    towards = sky.radiance(sky.sun_direction)
    away = sky.radiance(direction_from_angles(40.0, 60.0 + 180.0))
    assert luminance(towards) > 2 * luminance(away)


def test_blue_overhead_and_finite_everywhere():
    rng = np.random.default_rng(2)
    directions = rng.standard_normal((500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for elevation in (1.0, 10.0, 45.0, 90.0):
        values = ClearSky(environment(sun_elevation_deg=elevation)).radiance(directions)
        assert np.isfinite(values).all() and (values >= 0).all()
    zenith = ClearSky(environment()).radiance(np.array([0.0, 0.0, 1.0]))
    assert zenith[2] > 1.3 * zenith[0]


@pytest.mark.parametrize("cloud_height_m", [None, 1500.0, -1200.0])
def test_no_seam_at_the_horizon(cloud_height_m):
    """Just above and just below the horizon haze has made sky, ground and cloud one."""
    cloud = None
    if cloud_height_m is not None:
        cloud = CloudLayer(
            height_above_camera_m=cloud_height_m,
            cover_fraction=0.5,
            feature_size_m=2000,
            optical_depth=8,
            texture_seed=1,
        )
    around = Surroundings(environment(cloud=cloud))
    azimuth = np.linspace(0, 2 * np.pi, 200)
    rows = []
    for elevation in (-0.002, 0.002):
        up = np.full_like(azimuth, np.sin(elevation))
        rows.append(np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), up], axis=-1))
    image = luminance(around.radiance(np.array(rows, dtype=np.float32)))
    # 0.002 rad at 3 km altitude is 1500 km of air: only the sky's own gradient over 0.004 rad is left.
    assert np.abs(image[1] / image[0] - 1).max() < 0.03


def test_ground_contrast_falls_as_koschmieder_says():
    """Contrast of ground against horizon goes with exp(-extinction x distance)."""
    around = Surroundings(environment(sun_azimuth_deg=0.0))
    contrasts = []
    for depression in (0.5, 0.25):
        azimuth = np.linspace(0, 2 * np.pi, 720)
        down = np.full_like(azimuth, -np.sin(depression))
        rays = np.stack([np.cos(depression) * np.cos(azimuth), np.cos(depression) * np.sin(azimuth), down], axis=-1)
        rays = rays[None].astype(np.float32)
        _, horizon = around.clear_radiance(rays)
        ground = luminance(around.ground_illuminance_lux * np.array([0.1, 0.1, 0.06]) / np.pi)
        mean_contrast = (luminance(around.radiance(rays)) - luminance(horizon)).mean()
        contrasts.append(mean_contrast / (ground - luminance(horizon).mean()))
    distance_m = 3000 / np.sin([0.5, 0.25])
    expected = np.exp(-3.912 / 50_000 * distance_m)
    # The texture's mean over a circle of ground scatters by a few percent of the contrast.
    np.testing.assert_allclose(contrasts, expected, rtol=0.05)


def test_plate_illuminance_of_level_ground_agrees_with_the_sky_integral():
    around = Surroundings(environment())
    up = around.plate_illuminance_lux(np.array([0.0, 0.0, 1.0]))
    # Two quadratures of the same sky, 4 and 1.4 degrees wide.
    np.testing.assert_allclose(up, around.ground_illuminance_lux, rtol=0.01)


def test_cloud_cover_is_the_stated_share():
    fractions = []
    for seed in range(6):
        cloud = CloudLayer(
            height_above_camera_m=1000, cover_fraction=0.4, feature_size_m=1500, optical_depth=10, texture_seed=seed
        )
        x, y = np.meshgrid(np.linspace(0, 60, 400), np.linspace(0, 60, 400))
        texture = sample_texture(cloud.texture_seed, 1.6, x.astype(np.float32), y.astype(np.float32))
        fractions.append(np.mean(texture > 0.2533))  # the Gaussian quantile of 0.6
    # One tile holds some 64 independent blobs: 6 % standard deviation each, 2.5 % of the mean of six.
    assert np.mean(fractions) == pytest.approx(0.4, abs=0.06)


def test_texture_repeats_without_a_seam():
    x = np.linspace(0, 8, 4097, dtype=np.float32)[None]
    values = sample_texture(5, 1.6, x, np.zeros_like(x))[0]
    jumps = np.abs(np.diff(values))
    assert jumps.max() < 12 * np.median(jumps) + 0.2
