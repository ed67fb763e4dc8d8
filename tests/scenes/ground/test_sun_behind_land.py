"""Land in front of sun and moon: it hides their discs and stops their beam."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.environment import Environment, Moon
from scenes.environment_radiance import EnvironmentRadiance, environment_radiance
from scenes.ground.ground_radiance import MEAN_REFLECTANCE
from scenes.sky.photometry import direction_from_angles, luminance

HALF_PX, PIXEL_RAD = 40, 1.5e-4


def environment(kind: str, **changes: float | str | Moon) -> Environment:
    values = {
        "sun_elevation_deg": 1.0,
        "sun_azimuth_deg": 0.0,
        "turbidity": 2.5,
        "visibility_m": 60_000.0,
        "altitude_m": 100.0,
        "ground": kind,
        "ground_reflectance_rgb": MEAN_REFLECTANCE[kind],
        "ground_texture_seed": 3,
    }
    return Environment.model_validate(values | changes)


def disc(around: EnvironmentRadiance, to_light: np.ndarray | None = None) -> np.ndarray:
    """(81, 81) luminance of the disc alone, by a pinhole that looks at it."""
    to_light = around.beam_direction if to_light is None else to_light
    right = np.cross(to_light, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = PIXEL_RAD * np.arange(-HALF_PX, HALF_PX + 1)
    rays = to_light + offset[None, :, None] * right + offset[:, None, None] * np.cross(to_light, right)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    picture = np.zeros(rays.shape, dtype=np.float32)
    around.add_discs(picture, rays)
    return luminance(picture)


@pytest.mark.parametrize("sky_model", ["daylight", "scattering"])
def test_mountains_hide_the_sun_until_it_has_risen_over_them(sky_model: str) -> None:
    low, high = (
        EnvironmentRadiance(environment("mountains", sun_elevation_deg=elevation, sky_model=sky_model))
        for elevation in (1.0, 4.0)
    )
    assert low.air.beam_illuminance_lux.max() > 0.0
    assert not disc(low).any() and not low.beam_illuminance_lux.any()
    np.testing.assert_array_equal(high.beam_illuminance_lux, high.air.beam_illuminance_lux)
    # Pixels of 1.5e-4 rad in a disc of 9.3e-3 rad across.
    seen_lux = disc(high).sum() * PIXEL_RAD**2
    assert seen_lux == pytest.approx(float(luminance(high.beam_illuminance_lux)), rel=0.02)


def test_mountains_hide_the_moon() -> None:
    moon = Moon(elevation_deg=1.0, azimuth_deg=0.0)
    night = EnvironmentRadiance(environment("mountains", sun_elevation_deg=-40.0, moon=moon))
    assert night.air.beam_illuminance_lux.max() > 0.0
    assert not disc(night, direction_from_angles(1.0, 0.0)).any() and not night.beam_illuminance_lux.any()


def test_the_beam_loses_what_trees_hide_of_the_disc() -> None:
    shares = []
    for azimuth in (60.0, 120.0, 180.0):
        lit = {"sun_elevation_deg": 0.3, "sun_azimuth_deg": azimuth}
        around, open_sea = (EnvironmentRadiance(environment(kind, **lit)) for kind in ("forest", "sea"))
        shares.append(float(around.beam_illuminance_lux[1] / around.air.beam_illuminance_lux[1]))
        # Rays of the beam are five pixels apart, and trees as wide as those rays.
        assert shares[-1] == pytest.approx(disc(around).sum() / disc(open_sea).sum(), abs=0.08)
    assert min(shares) < 0.85 and max(shares) > 0.5


def test_level_ground_takes_nothing_of_the_beam() -> None:
    for elevation in (-0.5, 0.0, 0.5, 30.0):
        around = EnvironmentRadiance(environment("sea", sun_elevation_deg=elevation))
        np.testing.assert_array_equal(around.beam_illuminance_lux, around.air.beam_illuminance_lux)


def test_trees_that_pass_before_the_sun_take_its_light() -> None:
    here = environment("forest", sun_elevation_deg=0.3, sun_azimuth_deg=60.0)
    at_first = environment_radiance(here).beam_illuminance_lux
    passed = [
        environment_radiance(here.model_copy(update={"camera_offset_m": (0.0, north_m)})).beam_illuminance_lux[1]
        for north_m in (30.0, 60.0, 90.0)
    ]
    assert len(set(passed)) == 3
    # Nothing of the way stays behind.
    np.testing.assert_array_equal(environment_radiance(here).beam_illuminance_lux, at_first)
