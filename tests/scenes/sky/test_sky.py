from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer, Environment, Moon
from scenes.atmosphere.scattering_sky import ScatteringLuminary, ScatteringSky
from scenes.clouds.cloud_layers import opacity_towards
from scenes.environment_radiance import EnvironmentRadiance
from scenes.sky.clear_sky import ClearSky
from scenes.sky.photometry import (
    CHANNEL_WAVELENGTH_UM,
    REC709_FROM_XYZ,
    SOLAR_ILLUMINANCE_LUX,
    beam_transmission,
    direction_from_angles,
    hemisphere,
    infrared_light,
    light_in_band,
    luminance,
)
from scenes.sky.sky_models import DaylightSky, moon_illuminance_lux, star_catalogue


def environment(**changes: Moon | float | tuple[CloudLayer, ...]) -> Environment:
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


def test_zenith_luminance_is_the_published_formula() -> None:
    """Y_z = (4.0453 T - 4.9710) tan((4/9 - T/120)(pi - 2 s)) - 0.2155 T + 2.4192 [kcd/m2], worked by hand for T = 3."""
    sky = DaylightSky(3.0, sun_elevation_deg=50.0, sun_azimuth_deg=60.0, altitude_m=3000.0)
    s = np.radians(40.0)
    expected = (4.0453 * 3 - 4.9710) * np.tan((4 / 9 - 3 / 120) * (np.pi - 2 * s)) - 0.2155 * 3 + 2.4192
    got = luminance(sky.radiance(np.array([0.0, 0.0, 1.0])))
    assert float(got) == pytest.approx(expected * 1e3, rel=2e-4)


def colour_temperature_k(radiance: np.ndarray) -> float:
    """After McCamy 1992, Color Research and Application 17(2), 142; above 12,500 K it only ranks."""
    xyz = np.linalg.inv(REC709_FROM_XYZ) @ np.asarray(radiance, dtype=float)
    x, y = xyz[:2] / xyz.sum()
    n = (x - 0.3320) / (0.1858 - y)
    return 449 * n**3 + 3525 * n**2 + 6823.3 * n + 5520.33


def test_colours_of_the_clear_sky() -> None:
    """Blue overhead, about white towards a sun of 18 degrees, warm towards a setting one."""
    high = ClearSky(environment(sun_elevation_deg=50.0, turbidity=2.5))
    # Clear zeniths are measured between about 12,000 and 25,000 K; with the sun outside the air for white instead of
    # D65, 15 reciprocal megakelvin less: 14,500 to 40,000 K.
    assert 14_500 < colour_temperature_k(high.radiance(direction_from_angles(90.0, 0.0))) < 40_000
    low, setting = (ClearSky(environment(sun_elevation_deg=elevation, turbidity=2.5)) for elevation in (18.0, 1.0))
    towards = [colour_temperature_k(sky.radiance(direction_from_angles(6.0, 60.0))) for sky in (low, setting)]
    assert 5000 < towards[0] < 7500
    assert towards[1] < 4200


def test_sunlight_at_the_ground_has_the_level_of_a_clear_day() -> None:
    """Direct normal illuminance under a high sun is 80-105 klux on clear days (IES handbook)."""
    sky = ClearSky(environment(sun_elevation_deg=60.0))
    assert 80_000 < float(luminance(sky.sun_illuminance_lux)) < 105_000


def test_low_sun_is_dimmer_and_redder() -> None:
    high, low = (ClearSky(environment(sun_elevation_deg=e)).sun_illuminance_lux for e in (60.0, 5.0))
    assert np.all(low < high)
    assert low[0] / low[2] > 2 * high[0] / high[2]


def test_brightest_near_the_sun() -> None:
    sky = ClearSky(environment())
    towards = sky.radiance(sky.sun_direction)
    away = sky.radiance(direction_from_angles(40.0, 60.0 + 180.0))
    assert luminance(towards) > 2 * luminance(away)


def test_blue_overhead_and_finite_everywhere() -> None:
    rng = np.random.default_rng(2)
    directions = rng.standard_normal((500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for elevation in (1.0, 10.0, 45.0, 90.0):
        values = ClearSky(environment(sun_elevation_deg=elevation)).radiance(directions)
        assert np.isfinite(values).all() and (values >= 0).all()
    zenith = ClearSky(environment()).radiance(np.array([0.0, 0.0, 1.0]))
    assert zenith[2] > 1.3 * zenith[0]


@pytest.mark.parametrize("cloud_height_m", [None, 1500.0, -1200.0])
def test_no_seam_at_the_horizon(cloud_height_m: float | None) -> None:
    """Just above and just below the horizon haze has made sky, ground and cloud one."""
    clouds = ()
    if cloud_height_m is not None:
        layer = CloudLayer(
            height_above_camera_m=cloud_height_m,
            cover_fraction=0.5,
            feature_size_m=2000,
            optical_depth=8,
            texture_seed=1,
        )
        clouds = (layer,)
    around = EnvironmentRadiance(environment(clouds=clouds))
    azimuth = np.linspace(0, 2 * np.pi, 200)
    rows = []
    for elevation in (-0.002, 0.002):
        up = np.full_like(azimuth, np.sin(elevation))
        rows.append(np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), up], axis=-1))
    image = luminance(around.radiance(np.array(rows, dtype=np.float32)))
    # 0.002 rad at 3 km altitude is 1500 km of air: only the sky's own gradient over 0.004 rad is left.
    assert np.abs(image[1] / image[0] - 1).max() < 0.03


def test_ground_contrast_falls_as_koschmieder_says() -> None:
    """Contrast of ground against horizon goes with exp(-extinction x distance)."""
    around = EnvironmentRadiance(environment(sun_azimuth_deg=0.0))
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


def test_plate_illuminance_of_level_ground_agrees_with_the_sky_integral() -> None:
    around = EnvironmentRadiance(environment())
    up = around.plate_illuminance_lux(np.array([0.0, 0.0, 1.0]))
    # Two quadratures of the same sky, 4 and 1.4 degrees wide.
    np.testing.assert_allclose(up, around.ground_illuminance_lux, rtol=0.01)


def level_illuminance_lux(sky: ClearSky) -> float:
    directions, weight = hemisphere(45)
    from_sky = float((luminance(sky.radiance(directions)) * weight).sum())
    return from_sky + float(luminance(sky.beam.beam_illuminance_lux())) * max(sky.beam.direction[2], 0.0)


@pytest.mark.parametrize(
    ("elevation_deg", "low_lux", "high_lux"),
    [
        (60.0, 85_000, 120_000),  # high sun, clear: 100 klux (IES handbook)
        (10.0, 8_000, 13_500),  # 10.9 klux (Janiczek and DeYoung 1987, both terms)
        (-0.833, 410, 585),  # sunset to -6 and -12 degrees: AMS Glossary of Meteorology, "civil twilight",
        (-6.0, 2.0, 3.5),  # "nautical twilight" and "astronomical twilight"
        (-12.0, 0.004, 0.008),
        (-18.0, 0.0006, 0.002),  # starlight and airglow
        (-50.0, 0.0006, 0.002),
    ],
)
def test_light_of_the_whole_clear_sky_is_what_is_measured(elevation_deg: float, low_lux: int, high_lux: int) -> None:
    assert low_lux < level_illuminance_lux(ClearSky(environment(sun_elevation_deg=elevation_deg))) < high_lux


@pytest.mark.parametrize("turbidity", [1.9, 2.5, 4.0, 10.0])
def test_sky_and_sun_send_less_than_comes_to_the_air(turbidity: float) -> None:
    elevations_deg = np.arange(5.0, 91.0, 5.0)
    lux = [
        level_illuminance_lux(ClearSky(environment(turbidity=turbidity, sun_elevation_deg=e))) for e in elevations_deg
    ]
    assert np.all(lux < SOLAR_ILLUMINANCE_LUX * np.sin(np.radians(elevations_deg)))


@pytest.mark.parametrize("elevation_deg", [10.0, 16.0, 22.0, 35.0, 60.0, 90.0])
def test_clear_daylight_is_that_of_the_scattering_sky(elevation_deg: float) -> None:
    clear = environment(sun_elevation_deg=elevation_deg, ground_reflectance_rgb=(0.1, 0.1, 0.1), altitude_m=10.0)
    sun = ScatteringSky(clear.model_copy(update={"sky_model": "scattering"})).sun
    assert isinstance(sun, ScatteringLuminary)
    from_beam = float(luminance(sun.beam_illuminance_lux())) * float(sun.direction[2])
    scattered = float(luminance(sun.ground_sky_lux)) + from_beam
    # The two beams differ by up to 13 % under a low sun, and what is measured there is some tenth less.
    assert level_illuminance_lux(ClearSky(clear)) == pytest.approx(scattered, rel=0.1)


@pytest.mark.parametrize("elevation_deg", [0.0, -4.0, -8.0, -12.0, -25.0])
def test_zenith_is_as_bright_as_an_even_sky_of_the_same_light_or_darker(elevation_deg: float) -> None:
    """Twilight and night are brightest near the horizon: the zenith has 0.3 to 1 of E / pi."""
    sky = ClearSky(environment(sun_elevation_deg=elevation_deg))
    zenith = float(luminance(sky.radiance(np.array([0.0, 0.0, 1.0]))))
    assert 0.3 < zenith * np.pi / level_illuminance_lux(sky) < 1.0


def test_moonless_night_has_the_luminance_of_dark_sites() -> None:
    """21.9 to 21.3 magnitudes a square arc second at the zenith, with and without the brighter stars."""
    zenith = ClearSky(environment(sun_elevation_deg=-40.0)).radiance(np.array([0.0, 0.0, 1.0]))
    assert 1.9e-4 < float(luminance(zenith)) < 3.3e-4


def test_light_grows_with_the_sun_without_a_jump() -> None:
    elevations = np.arange(-20.0, 40.0, 0.5)
    light = np.log([level_illuminance_lux(ClearSky(environment(sun_elevation_deg=e))) for e in elevations])
    # Fastest in nautical twilight, where it falls from 2-3.5 to 0.004-0.008 lux over 6 degrees: 0.52 in half a degree.
    assert np.all(np.diff(light) > -1e-6) and np.diff(light).max() < 0.6
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for border in (2.0, 9.0, 4.0, 22.0):
        below, above = (
            ClearSky(environment(sun_elevation_deg=border + step)).radiance(directions) for step in (-0.005, 0.005)
        )
        # Near its horizon a hundredth of a degree of sun changes the reddest glow by a hundredth.
        np.testing.assert_allclose(below, above, rtol=0.02)


def test_twilight_glows_over_the_sun_and_is_blue_overhead() -> None:
    sky = ClearSky(environment(sun_elevation_deg=-6.0))
    towards, away = (sky.radiance(direction_from_angles(3.0, 60.0 + turn)) for turn in (0.0, 180.0))
    zenith = sky.radiance(np.array([0.0, 0.0, 1.0]))
    assert luminance(towards) > 1.5 * luminance(away)
    assert towards[0] / towards[2] > 2 * zenith[0] / zenith[2]
    assert zenith[2] > 1.5 * zenith[0]


def test_full_moon_is_as_bright_as_measured_and_fades_with_its_phase() -> None:
    """0.25 lux at most from a high full moon, about a tenth of it from a half one (Krisciunas and Schaefer 1991)."""
    night = environment(sun_elevation_deg=-50.0, moon=Moon(elevation_deg=60.0, azimuth_deg=20.0))
    sky = ClearSky(night)
    assert sky.beam is sky.moon
    assert 0.1 < level_illuminance_lux(sky) < 0.27
    assert 0.07 < moon_illuminance_lux(90.0) / moon_illuminance_lux(0.0) < 0.12
    assert moon_illuminance_lux(180.0) < 0.001


def test_a_cloud_hides_the_luminary_that_is_behind_it() -> None:
    """A moon by day behind cloud beside a sun in a gap, and the other way round."""
    heap = CloudLayer(kind="cumulus", height_above_camera_m=1500.0, cover_fraction=0.5, feature_size_m=2500.0,
                      optical_depth=14.0, texture_seed=0)  # fmt: skip
    bearings = np.arange(0.0, 360.0, 10.0)
    opacity = [opacity_towards(heap, direction_from_angles(40.0, azimuth_deg)) for azimuth_deg in bearings]
    behind, beside = bearings[int(np.argmax(opacity))], bearings[int(np.argmin(opacity))]
    assert max(opacity) > 0.999 and min(opacity) < 0.001
    shares = []
    for moon_deg, sun_deg in ((behind, beside), (beside, behind)):
        moon = Moon(elevation_deg=40.0, azimuth_deg=moon_deg)
        clouded = environment(sun_elevation_deg=40.0, sun_azimuth_deg=sun_deg, moon=moon, clouds=(heap,))
        around = EnvironmentRadiance(clouded)
        for luminary in around.sky.luminaries:
            seen, ray = np.zeros((1, 1, 3), np.float32), luminary.direction.astype(np.float32)[None, None]
            around.add_discs(seen, ray)
            whole = np.zeros((1, 1, 3), np.float32)
            around.sky.add_discs(whole, ray, 1.0)
            shares.append(float(seen.sum() / whole.sum()))
    # Sun in the gap, moon behind; then sun behind, moon in the gap.
    np.testing.assert_allclose(shares, [1.0, 0.0, 0.0, 1.0], atol=1e-3)


@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 90.0, 120.0])
def test_disc_of_the_moon_sends_what_the_moon_sends(phase_deg: float) -> None:
    """Radiance of the drawn disc over its solid angle is the moon's illuminance, and the sun's side is lit."""
    moon = Moon(elevation_deg=45.0, azimuth_deg=0.0, phase_angle_deg=phase_deg)
    sky = ClearSky(environment(sun_elevation_deg=-50.0, sun_azimuth_deg=0.0, moon=moon))
    to_moon = sky.moon.direction
    right, up = np.array([0.0, 1.0, 0.0]), np.cross(to_moon, [0.0, 1.0, 0.0])
    up = up if up[2] > 0 else -up
    offset = np.linspace(-0.006, 0.006, 241)
    rays = to_moon + offset[None, :, None] * right + offset[:, None, None] * up
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    image = np.zeros(rays.shape, dtype=np.float32)
    sky.add_discs(image, rays, 1.0)
    light = luminance(image)
    # The lattice of 180 points across the disc, and float32 directions of 6e-8 over 4.7e-3 rad.
    got = light.sum() * (offset[1] - offset[0]) ** 2
    assert got == pytest.approx(float(luminance(sky.moon.beam_illuminance_lux())), rel=0.02)
    if phase_deg > 0:
        assert light[:120].sum() > light[121:].sum()  # the sun stands below


def test_there_are_as_many_stars_as_there_are() -> None:
    """About 5000 stars to magnitude 6, some 500 to magnitude 4 and 15 to 25 to magnitude 1 on the whole sky (Allen)."""
    directions, lux = star_catalogue()
    magnitude = -2.5 * np.log10(lux) - 14.18
    assert directions.shape == (len(lux), 3)
    assert 4500 < len(lux) < 5600
    assert 400 < np.sum(magnitude < 4) < 620
    assert 5 < np.sum(magnitude < 1) < 35


@pytest.mark.parametrize("exponent", [0.0, 4.08])
def test_infrared_is_exact_for_white_and_for_light_that_molecules_scatter(exponent: float) -> None:
    light = (CHANNEL_WAVELENGTH_UM / 0.85) ** -exponent
    assert float(infrared_light(light, 850.0)) == pytest.approx(1.0, rel=1e-12)
    # Mixtures with white stay mixtures.
    assert float(infrared_light(0.3 * light + 0.7, 850.0)) == pytest.approx(1.0, rel=1e-12)


def test_infrared_of_haze_is_at_most_a_third_too_bright() -> None:
    """Haze falls with the 1.3rd power of the wavelength (Preetham et al. 1999), and less where its drops are large."""
    for exponent in np.linspace(0.0, 1.3, 14):
        light = float(infrared_light((CHANNEL_WAVELENGTH_UM / 0.85) ** -exponent, 850.0))
        assert 1 - 1e-9 < light < 4 / 3


def test_infrared_sunlight_at_the_ground_is_that_of_the_reference_spectrum() -> None:
    """ASTM G173-03 at 863 nm: 0.929 of 1.012 W/m2/nm arrive from a sun at 41.8 degrees; its haze is turbidity 1.74."""
    arrives = beam_transmission(41.8, 1.74)
    assert float(infrared_light(arrives, 863.0)) == pytest.approx(0.929 / 1.012, rel=0.05)


def test_infrared_sky_overhead_is_far_darker_than_the_visible_one() -> None:
    """Against sunlight: between Rayleigh's law and that of haze, from 550 to 850 nm."""
    sky = ClearSky(environment(turbidity=2.0, sun_elevation_deg=50.0))
    overhead, sun = sky.radiance(np.array([0.0, 0.0, 1.0])).astype(float), sky.sun_illuminance_lux
    share = [float(light_in_band(overhead, band) / light_in_band(sun, band)) for band in (None, 850.0)]
    # Sunlight that has come through the air is redder.
    assert 0.8 * (0.85 / 0.55) ** -4.08 < share[1] / share[0] < (0.85 / 0.55) ** -1.3
    assert float(infrared_light(np.array([0.05, 0.09, 0.03]), 850.0)) > 0.2
