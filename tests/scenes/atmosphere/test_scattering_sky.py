"""The sky of the scattering atmosphere against Monte Carlo paths, closed forms and published illuminances."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.environment_ranges import EnvironmentRanges
from datasets_manifest.types.environment import CloudLayer, Environment, Mist
from scenes.atmosphere.air_layers import (
    MOLECULE_DEPTH,
    RGB_WEIGHTS,
    WAVELENGTH_UM,
    AirLayers,
    aerosol_phase,
    height_along_m,
    horizon_dip_rad,
    ray_length_m,
)
from scenes.atmosphere.scattering_sky import ScatteringAir, ScatteringSky
from scenes.atmosphere.sky_tables import scattered_into_rays
from scenes.clouds.cloud_layers import CloudLight, render_cloud_layer
from scenes.environment_radiance import EnvironmentRadiance
from scenes.ground_view import ground_view
from scenes.sky.photometry import SOLAR_ILLUMINANCE_LUX, direction_from_angles, hemisphere, luminance
from tests.scenes.atmosphere.monte_carlo_sky import AIRS, Air, sky_radiance, table_over_paths

HAZE = AirLayers(6.6e-5, 1500.0, (0.2, 0.2, 0.2))
GREEN = 4


def environment(**changes: object) -> Environment:
    values = {
        "sun_elevation_deg": 40.0,
        "sun_azimuth_deg": 60.0,
        "turbidity": 2.5,
        "visibility_m": 50_000.0,
        "altitude_m": 3000.0,
        "ground_reflectance_rgb": (0.1, 0.1, 0.06),
        "ground_texture_seed": 3,
        "sky_model": "scattering",
    }
    return Environment.model_validate(values | changes)


@pytest.mark.parametrize(
    ("height_m", "sun_deg", "view_deg", "apart_deg", "paths"),
    [
        (10.0, 50.0, 30.0, 90.0, 2000),
        (10.0, 50.0, 5.0, 150.0, 1500),
        # Haze sends the bright ring of the horizon forward: without second moments a third of it was missing here.
        (10.0, 20.0, 0.5, 180.0, 1500),
        (3000.0, 5.0, 2.0, 40.0, 1500),
        (3000.0, -4.0, 10.0, 10.0, 3000),
    ],
)
def test_sky_is_that_of_paths_through_the_same_air(
    height_m: float, sun_deg: float, view_deg: float, apart_deg: float, paths: int
) -> None:
    sun, view = direction_from_angles(sun_deg, 0.0), direction_from_angles(view_deg, apart_deg)
    air = Air(*HAZE.depths[:, GREEN], HAZE.aerosol_scale_m)
    expected, error = sky_radiance(air, 0.2, height_m, sun, view, paths)
    smooth, peaked = scattered_into_rays(HAZE, height_m, float(sun[2]), np.array([view[2]]), np.array([view @ sun]))
    found = smooth[0, GREEN] + peaked[0, GREEN] * aerosol_phase(view @ sun)
    # Few moments stand for light that was scattered before: a tenth at most, beside three standard errors of the paths.
    assert abs(found - expected) < 0.1 * expected + 3 * error


@pytest.mark.slow  # 39 views of 2000 paths each
def test_sky_is_that_of_paths_in_many_views_of_thin_clear_and_hazy_air() -> None:
    ratios, errors = np.array([list(table_over_paths(air)) for air in AIRS]).transpose(2, 0, 1)
    assert np.sqrt((np.log(ratios) ** 2).mean()) < 0.08
    # What more moments would change, beside three standard errors of the paths.
    assert np.all(np.abs(np.log(ratios)) < 0.13 + 3 * errors)


def test_light_scattered_once_by_thin_air_has_a_closed_form() -> None:
    """Thin aerosol alone, straight up under a high sun: phase function times what it scatters, and nothing else."""
    thin, none = AirLayers(2e-6, 1000.0, (0.0, 0.0, 0.0)), AirLayers(0.0, 1000.0, (0.0, 0.0, 0.0))
    sun_sine, towards = np.sin(np.radians(60.0)), np.array([np.sin(np.radians(60.0))])
    _, peaked = scattered_into_rays(thin, 0.0, sun_sine, np.array([1.0]), towards)
    assert scattered_into_rays(none, 0.0, sun_sine, np.array([1.0]), towards)[1].max() == 0.0
    # Molecules dim the sun down to each height, and what is scattered from there to the ground.
    heights = np.arange(10.0, 12_000.0, 20.0)
    down = none.transmittance(heights, np.full(heights.shape, sun_sine))
    seen = none.transmittance(np.zeros(1), np.ones(1)) / none.transmittance(heights, np.ones(heights.shape))
    share = np.exp(-heights / 1000.0) / np.exp(-heights / 1000.0).sum()
    np.testing.assert_allclose(peaked[0], thin.scattered[1] * (share[:, None] * down * seen).sum(axis=0), rtol=0.02)


def test_transmittance_is_that_of_the_columns() -> None:
    """Straight up by the vertical depths, and along other rays by a fine sum over their length."""
    np.testing.assert_allclose(
        HAZE.transmittance(np.array([0.0]), np.array([1.0]))[0], np.exp(-HAZE.depths.sum(axis=0)), rtol=2e-3
    )
    for height_m, elevation_deg in ((0.0, 3.0), (3000.0, 0.0), (3000.0, -1.2), (9000.0, -2.0)):
        height, sine = np.array([height_m]), np.array([np.sin(np.radians(elevation_deg))])
        length_m, falls = ray_length_m(height, sine)
        assert not falls[0]
        middle_m = (np.arange(100_000) + 0.5) / 100_000 * length_m
        column = HAZE.densities(np.maximum(height_along_m(height, sine, middle_m), 0.0)).mean(axis=1) * length_m
        # Interpolation in the table, of depths up to 5.
        np.testing.assert_allclose(
            -np.log(HAZE.transmittance(height, sine)[0]), column @ HAZE.depths, rtol=0.01, atol=2e-3
        )


def test_molecules_scatter_as_published() -> None:
    """Vertical optical depth 0.36 at 400 nm and 0.098 at 550 nm (Hansen and Travis 1974, table 1: 0.0972 at 550)."""
    assert MOLECULE_DEPTH[0] == pytest.approx(0.3637, rel=0.01)
    assert np.interp(0.55, WAVELENGTH_UM, MOLECULE_DEPTH) == pytest.approx(0.0972, rel=0.02)


def test_sunlight_outside_the_atmosphere_is_white() -> None:
    np.testing.assert_allclose(RGB_WEIGHTS.sum(axis=0), 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("elevation_deg", "low_lux", "high_lux"),
    [
        (60.0, 85_000, 120_000),  # as for the other skies: IES handbook, Janiczek and DeYoung 1987,
        (10.0, 8_000, 13_500),  # and the AMS Glossary of Meteorology for twilight
        (-0.833, 410, 585),
        (-6.0, 2.0, 3.5),
        (-12.0, 0.004, 0.008),
        (-18.0, 0.0006, 0.002),
        (-50.0, 0.0006, 0.002),
    ],
)
def test_light_of_the_whole_sky_is_what_is_measured(elevation_deg: float, low_lux: float, high_lux: float) -> None:
    around = EnvironmentRadiance(environment(sun_elevation_deg=elevation_deg))
    assert low_lux < float(luminance(around.ground_illuminance_lux)) < high_lux


def test_no_more_light_arrives_than_the_sun_sends_and_both_ways_to_count_it_agree() -> None:
    around = EnvironmentRadiance(environment(altitude_m=10.0))
    assert isinstance(around.sky, ScatteringSky)
    directions, weight = hemisphere(45)
    integral = float((luminance(around.sky.radiance(directions)) * weight).sum())
    of_table = float(luminance(around.sky.luminaries[0].ground_sky_lux))
    # Moments and exact first scattering share little but the air.
    assert integral == pytest.approx(of_table, rel=0.08)
    assert luminance(around.ground_illuminance_lux) < SOLAR_ILLUMINANCE_LUX * np.sin(np.radians(40.0))


def test_contrast_falls_as_koschmieder_says_in_thin_haze_near_the_ground() -> None:
    """Along a level ray the air is even: it hides a black thing by the share that it does not transmit."""
    around = EnvironmentRadiance(environment(visibility_m=12_000.0, altitude_m=10.0))
    assert isinstance(around.air, ScatteringAir)
    assert around.extinction_per_m == pytest.approx(3.912 / 12_000.0, rel=0.03)
    level = direction_from_angles(0.0, 150.0)[None]
    horizon = luminance(around.sky.radiance(level))
    for distance_m in (1000.0, 2500.0, 5000.0):
        seen, clear = around.air._up_to(level, np.array([distance_m]))
        expected = np.exp(-around.extinction_per_m * distance_m)
        assert luminance(clear)[0] == pytest.approx(expected, abs=0.02)
        # Colours fade at rates of their own, and haze is a little thinner 1 km up, where the ray ends.
        assert (1.0 - luminance(seen)[0] / horizon[0]) == pytest.approx(expected, abs=0.04)


def test_mist_is_lit_from_below_too() -> None:
    """Over a closed deck by as much as the deck sends up; and over land it is grey, as the light on it is white."""
    mist = Mist(visibility_m=300.0, above_m=100.0, below_m=100.0)
    deck = CloudLayer(
        kind="stratus",
        height_above_camera_m=-1000.0,
        cover_fraction=1.0,
        feature_size_m=2000,
        optical_depth=60,
        texture_seed=1,
    )
    level = direction_from_angles(0.0, 150.0)
    land, over_deck = (
        EnvironmentRadiance(environment(mist=mist, clouds=clouds)).air.mist_light(level) for clouds in ((), (deck,))
    )
    # A deck of that depth reflects nine tenths, and land a tenth to a fifth with the air before it.
    assert 1.4 < luminance(over_deck) / luminance(land) < 1.9
    np.testing.assert_allclose(land / land.mean(), 1.0, atol=0.05)


def test_things_fade_into_the_air_around_the_camera() -> None:
    """`L t + A (1 - t)` over some hundred metres is what the tables say."""
    around = EnvironmentRadiance(environment())
    assert isinstance(around.air, ScatteringAir)
    rays = np.stack([direction_from_angles(elevation, 20.0) for elevation in (-20.0, 0.0, 15.0)])
    seen, _ = around.air._up_to(rays, np.full(3, 150.0))
    hidden = -np.expm1(-150.0 * around.extinction_per_m)
    np.testing.assert_allclose(around.airlight(rays) * hidden, seen, rtol=0.02)


def test_the_sun_sets_at_the_horizon_that_height_lowers() -> None:
    dip_deg = float(np.degrees(horizon_dip_rad(3000.0)))
    assert dip_deg == pytest.approx(1.758, abs=0.005)  # arccos(R / (R + h)), R = 6371 km

    def lit_px(elevation_deg: float) -> int:
        sky = ScatteringSky(environment(sun_elevation_deg=elevation_deg, sun_azimuth_deg=0.0))
        offset = np.radians(np.linspace(-0.4, 0.4, 81))
        elevation = np.radians(elevation_deg) + offset[:, None]
        rays = np.stack(
            np.broadcast_arrays(
                np.cos(elevation) * np.cos(offset), np.cos(elevation) * np.sin(offset), np.sin(elevation)
            ),
            axis=-1,
        ).astype(np.float32)
        image = np.zeros(rays.shape, dtype=np.float32)
        sky.add_discs(image, rays, 1.0)
        has_beam = sky.beam.beam_illuminance_lux().max() > 0
        assert has_beam == bool(image.any())
        return int((image.max(axis=-1) > 0).sum())

    whole = lit_px(0.0)
    assert lit_px(-1.3) == pytest.approx(whole, rel=0.02)
    assert lit_px(-dip_deg) == pytest.approx(whole / 2, rel=0.05)
    assert lit_px(-dip_deg - 0.3) == 0


def test_twilight_is_brightest_and_reddest_low_over_the_sun() -> None:
    sky = ScatteringSky(environment(sun_elevation_deg=-4.0))
    low, high, away = (
        sky.radiance(direction_from_angles(elevation, 60.0 + apart)) for elevation, apart in ((1, 0), (9, 0), (1, 180))
    )
    zenith = sky.radiance(direction_from_angles(90.0, 0.0))
    assert luminance(low) > 1.5 * luminance(high) and luminance(low) > 10 * luminance(away)
    assert low[2] / low[0] < 0.5 < 1.0 < high[2] / high[0] < zenith[2] / zenith[0]


def test_horizon_by_day_is_bright_and_whitish() -> None:
    """CIE's clear sky has Y(20 deg) / Y(0) = 0.61 across the sun, and its horizon is nearly white."""
    sky = ScatteringSky(environment(sun_elevation_deg=50.0, altitude_m=10.0))
    low, middle, third = (sky.radiance(direction_from_angles(elevation, 150.0)) for elevation in (0.2, 20.0, 3.0))
    assert 0.45 < luminance(middle) / luminance(low) < 0.75
    assert 1.0 < third[2] / third[0] < 1.7 < middle[2] / middle[0]


def column(lowest_deg: float, highest_deg: float) -> np.ndarray:
    elevation = np.radians(np.linspace(highest_deg, lowest_deg, 240))[:, None] + np.zeros((1, 3))
    azimuth = np.radians(150.0) + np.array([0.0, 2e-4, 4e-4])
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.stack(rays, axis=-1).astype(np.float32)


def test_an_overcast_leaves_no_gap_above_the_ground() -> None:
    """The layer reaches down to the horizon, which lies 1 degree below level here."""
    deck = CloudLayer(
        kind="stratus",
        height_above_camera_m=800.0,
        cover_fraction=1.0,
        feature_size_m=2000,
        optical_depth=30,
        texture_seed=1,
    )
    around = EnvironmentRadiance(environment(altitude_m=1000.0, visibility_m=25_000.0, clouds=(deck,)))
    # So low that the air hides the mottle of the deck.
    light = luminance(around.radiance(column(-1.5, 0.5)))[:, 1]
    # The clear sky there is five times as bright as the air under the deck.
    assert light.max() < 1.1 * np.median(light)


@pytest.mark.parametrize("height_m", [500.0, 1500.0])
def test_the_horizon_under_an_overcast_is_not_lit_by_the_sun_above_it(height_m: float) -> None:
    """Air under a deck is in its shade: far away, where little of the deck is seen, no bright strip is left."""
    deck = CloudLayer(
        kind="stratus",
        height_above_camera_m=height_m,
        thickness_m=400.0,
        cover_fraction=1.0,
        optical_depth=40.0,
        feature_size_m=2500.0,
        texture_seed=1,
    )
    under = EnvironmentRadiance(environment(sun_elevation_deg=25.0, altitude_m=1000.0, clouds=(deck,)))
    azimuths = np.radians(np.linspace(-40.0, 40.0, 81))
    strips = []
    for elevation_deg in (0.2, 15.0):
        sine, cosine = np.sin(np.radians(elevation_deg)), np.cos(np.radians(elevation_deg))
        row = np.stack([cosine * np.cos(azimuths), cosine * np.sin(azimuths), np.full(azimuths.shape, sine)], axis=-1)
        strips.append(float(luminance(under.radiance(row[None].astype(np.float32))).mean()))
    assert strips[0] < 1.7 * strips[1]
    # Straight up, where most air is above the deck, the sky in a gap is nearly that of a clear day.
    up = np.array([[[0.0, 0.0, 1.0]]], dtype=np.float32)
    open_sky = EnvironmentRadiance(environment(sun_elevation_deg=25.0, altitude_m=1000.0)).clear_radiance(up)[0]
    share = under.clear_radiance(up)[0] / open_sky
    assert share.min() > 0.7 and share.max() < 1.0


def test_a_deck_below_ends_at_a_horizon_of_its_own() -> None:
    """1500 m below, a level deck of a round Earth is seen up to sqrt(2 h / R) = 1.24 degrees below level."""
    deck = CloudLayer(
        kind="stratus",
        height_above_camera_m=-1500.0,
        cover_fraction=1.0,
        feature_size_m=2000,
        optical_depth=30,
        texture_seed=1,
    )
    rays = column(-3.0, 0.5)
    light = CloudLight(np.array([0.0, 0.0, 1.0]), np.ones(3), np.ones(3), np.ones(3))
    seen = render_cloud_layer(deck, rays, light, horizon_sine=-0.03)
    elevation_deg = np.degrees(np.arcsin(rays[:, 1, 2]))
    opaque = seen.opacity[:, 1] > 0.5
    # It becomes opaque over 0.29 degrees.
    assert elevation_deg[opaque].max() == pytest.approx(-1.24 - 0.14, abs=0.06)
    assert np.all(seen.opacity[elevation_deg > -1.2] == 0.0)
    near = seen.distance_m[-1, 1]
    # The top of the deck 3 degrees down: h = s sin e - s^2 / 2 R, and somewhat farther, for its top is uneven.
    expected = 1500.0 / np.sin(np.radians(3.0))
    assert expected < near < 1.5 * expected


@pytest.mark.parametrize("altitude_m", [30.0, 3000.0, 12_000.0])
def test_ground_lies_on_the_round_earth(altitude_m: float) -> None:
    """Distance and angle of incidence by points on rays, whose distance from the Earth's centre is its radius."""
    dip = float(horizon_dip_rad(altitude_m))
    elevation = -np.array([[1.02 * dip, 1.5 * dip, 0.2, 1.2]])
    rays = np.stack([np.cos(elevation), np.zeros_like(elevation), np.sin(elevation)], axis=-1)
    view = ground_view(rays.astype(np.float32), altitude_m, 1e-3, is_round=True)
    distance_m = (view.x_m / rays[..., 0]).astype(np.float64)
    points = np.array([0.0, 0.0, 6.371e6 + altitude_m]) + distance_m[..., None] * rays
    # float32 directions of low rays are known to 6e-8 of 1.
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1) - 6.371e6, 0.0, atol=0.02 * altitude_m)
    sine = -(points / np.linalg.norm(points, axis=-1, keepdims=True) * rays).sum(axis=-1)
    np.testing.assert_allclose(view.sine, np.maximum(sine, 0.002), rtol=0.03)
    above = ground_view(-rays.astype(np.float32), altitude_m, 1e-3, is_round=True)
    np.testing.assert_allclose(-above.x_m / rays[..., 0], np.sqrt(2 * 6.371e6 * altitude_m + altitude_m**2), rtol=1e-5)


def test_older_environments_stay_as_they_were() -> None:
    assert "sky_model" not in environment(sky_model="daylight").model_dump_json()
    assert '"sky_model":"scattering"' in environment().model_dump_json()
    assert "sky_model" not in EnvironmentRanges().model_dump_json()


def test_a_map_leaves_no_sky_to_model() -> None:
    with pytest.raises(ValueError, match="sky_model: a map replaces the sky; leave out one of the two"):
        EnvironmentRanges.model_validate(
            {"sky_model": "scattering", "map": {"path": "a.exr", "sha256": "0" * 64, "cd_m2_per_unit": 1.0}}
        )
