"""The sensor against closed forms: camera equation, photon transfer, full well, mosaic, encoding."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from datasets_manifest.recipe.rigs import SENSORS
from datasets_manifest.types.frame import Exposure, FrameSpec, Sensor
from render.camera.sensor import MONO_WEIGHTS, dn_per_electron, expose
from render.camera.sensor_readout import normal_quantiles
from render.engine import EyeRadiance, StereoRadiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import CHANNEL_WAVELENGTH_UM, SOLAR_ILLUMINANCE_LUX, SUN_SOLID_ANGLE_SR
from tests.support.recipe_builder import paper_view_recipe

SHAPE = (96, 128)


def flat_pair(level_cd_m2: float, rgb: tuple[float, ...] = (1.0, 1.0, 1.0)) -> StereoRadiance:
    radiance = np.full((*SHAPE, 3), level_cd_m2, dtype=np.float32) * np.array(rgb, dtype=np.float32)
    nothing = np.zeros(SHAPE, dtype=np.float32)
    eye = EyeRadiance(
        radiance_cd_m2=radiance,
        coverage=nothing,
        part_id=nothing.astype(np.uint8),
        depth_m=nothing,
        normal=np.zeros((*SHAPE, 3), np.float32),
        amodal_px={},
    )
    return StereoRadiance(
        left=eye,
        right=eye,
        engine="test pattern",
        engine_version="1",
        monte_carlo_noise_fraction=0.0,
        stage_s={},
    )


@pytest.fixture
def frame() -> FrameSpec:
    return sample_frame(paper_view_recipe(scale=0.1), 0)


def with_sensor(
    frame: FrameSpec,
    name: str = "rgb-ideal",
    seed: int = 5,
    time_s: float = 1e-3,
    gain: float = 1.0,
    **changes: float | str,
) -> FrameSpec:
    sensor = SENSORS[name].model_copy(update={"output_bits": 12, **changes})
    exposure = Exposure(time_s=time_s, f_number=2.8, gain=gain)
    return frame.model_copy(update={"sensor": sensor, "exposure": exposure, "seed": seed})


def level_for(frame: FrameSpec, electrons: float) -> float:
    return electrons / frame.sensor.electrons_per_cd_m2(frame.exposure)


def test_white_marker_at_50_klux_fills_7000_electrons_in_0_13_ms() -> None:
    """The specification's own example: white at 50 klux, f/2.8, 0.13 ms."""
    sensor = SENSORS["rgb-ideal"]
    luminance = 50_000 * 0.8 / np.pi
    electrons = luminance * sensor.electrons_per_cd_m2(Exposure(time_s=0.13e-3, f_number=2.8))
    assert electrons == pytest.approx(7000, rel=0.01)


def test_noise_is_normal_far_into_its_tails() -> None:
    """All sums of two quantiles together, so that nothing but the table is tested."""
    quantiles = np.sort(normal_quantiles().astype(np.float64))
    places = np.linspace(-4.5, 4.5, 91)
    got = np.array([np.searchsorted(quantiles, place - quantiles, side="right").mean() for place in places])
    got /= len(quantiles)
    # Half a step of one table: 1 / 2^17.
    np.testing.assert_allclose(got, ndtr(places), atol=8e-6)
    # What is left of the tails, relative: 6 % are missing beyond 4.5 deviations.
    np.testing.assert_allclose(got[places <= -3.0], ndtr(places[places <= -3.0]), rtol=0.07)


def test_noise_differs_from_site_to_site_and_does_not_hang_together(frame: FrameSpec) -> None:
    """Each site has bits of its own: neighbours, and the halves of one draw of the generator, are uncorrelated."""
    frame = with_sensor(frame, prnu_fraction=0.0)
    numbers = expose(frame, flat_pair(level_for(frame, 2000))).left.astype(float).ravel()
    for step in (1, 2, 3, 128 * 3):
        correlation = np.corrcoef(numbers[:-step], numbers[step:])[0, 1]
        assert abs(correlation) < 4 / np.sqrt(numbers.size)  # four standard errors


@pytest.mark.parametrize("electrons", [3.0, 20.0, 200.0, 2000.0, 8000.0])
def test_photon_transfer_curve(frame: FrameSpec, electrons: float) -> None:
    """Variance = shot + read^2 + (PRNU mean)^2 + quantisation, in electrons; mean = light."""
    frame = with_sensor(frame)
    images = expose(frame, flat_pair(level_for(frame, electrons)))
    per_electron = dn_per_electron(frame.sensor, 1.0)
    got = (images.left.astype(float) - frame.sensor.black_level_dn) / per_electron
    expected = (
        electrons
        + frame.sensor.read_noise_e**2
        + (frame.sensor.prnu_fraction * electrons) ** 2
        + 1 / (12 * per_electron**2)
    )
    count = got.size
    # Standard errors: mean sigma/sqrt(n), variance sqrt(2/n) relative; four of them, and half a DN of rounding bias.
    assert got.mean() == pytest.approx(electrons, abs=4 * np.sqrt(expected / count) + 0.05 / per_electron)
    assert got.var() == pytest.approx(expected, rel=4 * np.sqrt(2 / count) + 0.01)


def test_read_noise_alone_in_the_dark(frame: FrameSpec) -> None:
    frame = with_sensor(frame)
    images = expose(frame, flat_pair(0.0))
    assert images.left.mean() == pytest.approx(frame.sensor.black_level_dn, abs=0.1)
    assert images.left.min() > 0  # the black level keeps the noise from being cut off


def test_full_well_clips(frame: FrameSpec) -> None:
    frame = with_sensor(frame)
    images = expose(frame, flat_pair(level_for(frame, 3 * frame.sensor.full_well_e)))
    assert np.all(images.left == 4095)


def test_gain_scales_numbers_not_electrons(frame: FrameSpec) -> None:
    one, two = with_sensor(frame, read_noise_e=0.0), with_sensor(frame, gain=2.0, read_noise_e=0.0)
    level = level_for(one, 2000)
    low, high = (expose(f, flat_pair(level)).left.astype(float) - 64 for f in (one, two))
    # Same draws: doubled up to rounding of both.
    assert np.abs(high - 2 * low).max() <= 1.5


def test_gains_of_pixels_stay_from_frame_to_frame(frame: FrameSpec) -> None:
    frame = with_sensor(frame, read_noise_e=0.0)
    other = frame.model_copy(update={"frame_index": 1})
    pictures = [expose(f, flat_pair(level_for(f, 8000))).left.astype(float) for f in (frame, other)]
    correlation = np.corrcoef(pictures[0].ravel(), pictures[1].ravel())[0, 1]
    # PRNU 80 e- against shot noise 89 e-: 80^2 / (80^2 + 89^2) = 0.45; 0.02 is four standard errors.
    assert correlation == pytest.approx(0.444, abs=0.03)


def test_eyes_have_their_own_noise(frame: FrameSpec) -> None:
    images = expose(with_sensor(frame), flat_pair(1000.0))
    left, right = images.left.astype(float).ravel(), images.right.astype(float).ravel()
    assert abs(np.corrcoef(left, right)[0, 1]) < 4 / np.sqrt(left.size)


def test_mosaic_takes_one_colour_a_site(frame: FrameSpec) -> None:
    frame = with_sensor(frame, "paper-colour", read_noise_e=0.0, prnu_fraction=0.0)
    images = expose(frame, flat_pair(level_for(frame, 4000), rgb=(1.0, 0.5, 0.25)))
    mosaic = images.left_mosaic.astype(float) - 64
    per_electron = dn_per_electron(frame.sensor, 1.0)
    for rows, columns, electrons in ((0, 0, 4000), (0, 1, 2000), (1, 0, 2000), (1, 1, 1000)):
        assert mosaic[rows::2, columns::2].mean() == pytest.approx(electrons * per_electron, rel=0.01)
    # The demosaiced image shows red as red: channel order red, green, blue.
    means = images.left[8:-8, 8:-8].reshape(-1, 3).mean(axis=0) - 64
    np.testing.assert_allclose(means, np.array([4000, 2000, 1000]) * per_electron, rtol=0.02)


def test_mono_weighs_the_bands(frame: FrameSpec) -> None:
    frame = with_sensor(frame, "mono", read_noise_e=0.0)
    images = expose(frame, flat_pair(level_for(frame, 4000), rgb=(1.0, 0.0, 0.0)))
    assert images.left.ndim == 2
    expected = 4000 * MONO_WEIGHTS[0, 0] * dn_per_electron(frame.sensor, 1.0)
    assert images.left.mean() - 64 == pytest.approx(expected, rel=0.01)


def test_filter_for_850_nm_leaves_a_tenth_of_sunlight_and_a_quarter_of_a_blue_sky(frame: FrameSpec) -> None:
    frame = with_sensor(frame, "mono-850", read_noise_e=0.0)
    per_electron = dn_per_electron(frame.sensor, 1.0)
    white = expose(frame, flat_pair(level_for(frame, 4000))).left
    assert white.ndim == 2
    assert white.mean() - 64 == pytest.approx(4000 * per_electron, rel=0.01)
    # Rayleigh's law from 610 to 850 nm.
    blue = tuple((CHANNEL_WAVELENGTH_UM / 0.610) ** -4.08)
    sky = expose(frame, flat_pair(level_for(frame, 4000), rgb=blue)).left
    assert sky.mean() - 64 == pytest.approx(4000 * (0.850 / 0.610) ** -4.08 * per_electron, rel=0.01)
    assert frame.sensor.responsivity_e_per_lux_s / SENSORS["mono"].responsivity_e_per_lux_s == pytest.approx(
        0.1, abs=0.01
    )


def test_responsivity_behind_the_filter_is_that_to_a_black_body_like_the_sun() -> None:
    """Planck's law at 5772 K (IAU 2015) and the sun's solid angle, instead of the table that the preset is from."""
    wavelength_m, planck_js, light_m_s, boltzmann_j_k = 850e-9, 6.626e-34, 2.998e8, 1.381e-23
    energy_j = planck_js * light_m_s / wavelength_m
    radiance = 2 * energy_j * light_m_s / wavelength_m**4 / np.expm1(energy_j / (boltzmann_j_k * 5772))
    irradiance = radiance * SUN_SOLID_ANGLE_SR * 50e-9
    electrons = irradiance * 0.9 * 0.2 * 3.75e-6**2 / energy_j
    # The sun's spectrum has lines there and is no black body's.
    assert SENSORS["mono-850"].responsivity_e_per_lux_s == pytest.approx(electrons / SOLAR_ILLUMINANCE_LUX, rel=0.05)


def test_a_band_needs_a_monochrome_sensor() -> None:
    with pytest.raises(ValueError, match="band_nm: needs color = 'mono', got 'rgb'"):
        Sensor.model_validate({**SENSORS["rgb-ideal"].model_dump(), "band_nm": 850.0})


@pytest.mark.parametrize("bits", [8, 12])
def test_bits_and_gamma(frame: FrameSpec, bits: int) -> None:
    frame = with_sensor(frame, output_bits=bits, encoding="gamma", read_noise_e=0.0, prnu_fraction=0.0)
    signal = 0.18
    images = expose(frame, flat_pair(level_for(frame, signal * frame.sensor.full_well_e)))
    assert images.left.dtype == (np.uint8 if bits == 8 else np.uint16)
    # sRGB of 18 % grey is 0.4614 of full scale; shot noise averages out, the curve's bend shifts it below 0.1 %.
    assert images.left.mean() / (2**bits - 1) == pytest.approx(0.4614, rel=0.005)


def test_same_frame_same_image(frame: FrameSpec) -> None:
    frame = with_sensor(frame)
    first, again = (expose(frame, flat_pair(1000.0)) for _ in range(2))
    assert np.array_equal(first.left, again.left) and np.array_equal(first.right, again.right)
    other = expose(frame.model_copy(update={"frame_index": 7}), flat_pair(1000.0))
    assert not np.array_equal(first.left, other.left)


def test_blur_keeps_light_and_place(frame: FrameSpec) -> None:
    """A point of light keeps its sum and centroid and spreads by the stated variance."""
    from render.camera.optics import blur

    image = np.zeros((41, 41, 1), dtype=np.float32)
    image[20, 17] = 1.0
    seen = blur(image, 0.8).reshape(41, 41)
    _, u = np.mgrid[:41, :41]
    assert seen.sum() == pytest.approx(1.0, abs=1e-6)
    assert (seen * u).sum() == pytest.approx(17.0, abs=1e-5)
    # The sampled Gaussian, cut at four sigma, keeps its variance within 0.5 %.
    assert (seen * (u - 17) ** 2).sum() == pytest.approx(0.64, rel=0.005)


@pytest.mark.parametrize("electrons", [3.0, 20.0, 4000.0])
def test_a_noise_free_picture_is_the_mean_of_noisy_ones(frame: FrameSpec, electrons: float) -> None:
    noisy, quiet = with_sensor(frame), with_sensor(frame, noise_free=True)
    pattern = flat_pair(level_for(noisy, electrons))
    numbers = expose(quiet, pattern).left
    assert numbers.min() == numbers.max()
    many = expose(noisy, pattern).left.astype(np.float64)
    # Four standard errors of the mean, and half a number for the rounding of the noise-free one.
    assert abs(many.mean() - numbers.mean()) < 4 * many.std() / np.sqrt(many.size) + 0.5
    assert many.std() > 0
