"""Noise and light level of the whole camera: photon transfer over levels, times and gains, and the camera equation."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.frame import Exposure, FrameSpec
from drogue_models.parts import FIRST_MARKER_ID
from drogue_models.presets import load_drogue
from render.camera.sensor import dn_per_electron, expose
from render.engine import EyeRadiance, RenderEngine, StereoRadiance, load_engine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import paper_view_recipe

SHAPE = (96, 128)
# 36864 samples an image give the variance within 0.74 % (one sigma); eight images within 0.26 %.
IMAGES = 8
WITHIN = 0.03


@pytest.fixture
def frame() -> FrameSpec:
    return sample_frame(paper_view_recipe(scale=0.1), 0)


def flat_numbers(
    frame: FrameSpec, electrons: float, gain: float, time_s: float, prnu_fraction: float = 0.0
) -> np.ndarray:
    """(N, H, W, 3) signals above black of a flat field. [DN]"""
    exposure = Exposure(time_s=time_s, f_number=2.8, gain=gain)
    sensor = frame.sensor.model_copy(update={"output_bits": 12, "prnu_fraction": prnu_fraction})
    level = electrons / sensor.electrons_per_cd_m2(exposure)
    light = np.full((*SHAPE, 3), level, dtype=np.float32)
    none = np.zeros(SHAPE, dtype=np.float32)
    eye = EyeRadiance(
        radiance_cd_m2=light,
        coverage=none,
        part_id=none.astype(np.uint8),
        depth_m=none,
        normal=np.zeros_like(light),
        amodal_px={},
    )
    radiance = StereoRadiance(
        left=eye,
        right=eye,
        engine="flat field",
        engine_version="1",
        monte_carlo_noise_fraction=0.0,
        stage_s={},
    )
    shots = []
    for index in range(IMAGES):
        changes = {"sensor": sensor, "exposure": exposure, "frame_index": index}
        images = expose(frame.model_copy(update=changes), radiance)
        shots.append(images.left.astype(np.float64) - sensor.black_level_dn)
    return np.array(shots)


@pytest.mark.parametrize("gain", [1.0, 4.0, 16.0])
@pytest.mark.parametrize("time_s", [5e-5, 1e-2])
def test_slope_of_the_curve_is_the_gain_and_its_intercept_the_read_noise(
    frame: FrameSpec, gain: float, time_s: float
) -> None:
    """Variance = K mean + (K read)^2 + 1/12: K by a line through several levels, read noise from the dark."""
    levels_e = np.array([30.0, 100.0, 300.0, 0.06 * 11_700]) / (1 if gain < 16 else 2)
    shots = [flat_numbers(frame, level, gain, time_s) for level in levels_e]
    means, variances = (np.array([getattr(shot, name)() for shot in shots]) for name in ("mean", "var"))
    per_electron = dn_per_electron(frame.sensor, gain)
    read_dn2 = (frame.sensor.read_noise_e * per_electron) ** 2
    np.testing.assert_allclose(means, levels_e * per_electron, rtol=WITHIN)
    np.testing.assert_allclose(variances, per_electron * means + read_dn2 + 1 / 12, rtol=WITHIN)
    slope, intercept = np.polyfit(means, variances, 1)
    assert slope == pytest.approx(per_electron, rel=WITHIN)
    # The line's end at zero hangs on the variance of the lowest level, 1 % of which is 1 % of this sum.
    assert intercept == pytest.approx(read_dn2 + 1 / 12, abs=WITHIN * variances[0])
    dark = flat_numbers(frame, 0.0, gain, time_s)
    assert dark.var() == pytest.approx(read_dn2 + 1 / 12, rel=WITHIN)


@pytest.mark.parametrize("prnu_fraction", [0.01, 0.03])
def test_gains_of_pixels_are_what_stays_in_the_mean_of_many_shots(frame: FrameSpec, prnu_fraction: float) -> None:
    electrons = 8000.0
    shots = flat_numbers(frame, electrons, 1.0, 1e-3, prnu_fraction)
    fixed = shots.mean(axis=0).var() - shots.var(axis=0, ddof=1).mean() / IMAGES
    # Spread of 36864 gains: 0.4 % of itself; the shot noise taken off is a tenth of the whole at 1 %.
    assert np.sqrt(fixed) / shots.mean() == pytest.approx(prnu_fraction, rel=WITHIN)


def lit_electrons(frame: FrameSpec, power: float, engine: RenderEngine) -> float:
    """Mean electrons of the red channel in the cores of the lit markers, read off the images, and their luminance."""
    drogue = frame.drogue.model_copy(
        update={"marker_luminance_cd_m2": 2000.0 * power, "marker_emission_rgb": (1.0, 1.0, 1.0)}
    )
    dark = frame.drogue.model_copy(update={"marker_luminance_cd_m2": 0.0})
    from datasets_manifest.recipe.recipe import RenderSettings

    means = []
    for shown in (drogue, dark):
        shot = frame.model_copy(update={"drogue": shown})
        # Few paths, however noisy they are: the markers' own light has no noise, and both pictures have the same noise
        # of the rest.
        settings = RenderSettings(engine=engine.name, samples_per_px=4, edge_samples_per_px=4, noise_over_sensor=100.0)
        radiance = engine.render(shot, settings)
        images = expose(shot, radiance)
        markers = radiance.left.part_id >= FIRST_MARKER_ID
        # Cores: pixels whose neighbours out to the lens's reach see markers too.
        core = markers.copy()
        for rows in range(-2, 3):
            for columns in range(-2, 3):
                core &= np.roll(markers, (rows, columns), axis=(0, 1))
        assert core.sum() > 300
        means.append(images.left[core].astype(float).mean())
    return (means[0] - means[1]) / dn_per_electron(frame.sensor, frame.exposure.gain)


def lit_frame(
    time_s: float = 2e-3, f_number: float = 2.8, distance_m: float = 3.0, gain: float = 1.0, scale: float = 1.0
) -> FrameSpec:
    """A frame in thick dusk: what the sun lights is taken off again anyway."""
    frame = sample_frame(paper_view_recipe(scale=scale, stations_m=(distance_m,)), 0)
    assert frame.drogue is not None and load_drogue("red-8").marker_count == 8
    changes = {
        "sensor": frame.sensor.model_copy(update={"output_bits": 12, "full_well_e": 1e6}),
        "exposure": Exposure(time_s=time_s, f_number=f_number, gain=gain),
        "environment": frame.environment.model_copy(update={"visibility_m": 20_000.0}),
    }
    return frame.model_copy(update=changes)


@pytest.mark.parametrize(
    ("power", "time_s", "f_number", "distance_m", "gain"),
    [
        (1.0, 2e-3, 2.8, 3.0, 1.0),
        (3.0, 2e-3, 2.8, 3.0, 1.0),
        (1.0, 8e-3, 2.8, 3.0, 1.0),
        (1.0, 2e-3, 1.4, 3.0, 1.0),
        (1.0, 2e-3, 2.8, 8.0, 1.0),
        (1.0, 2e-3, 2.8, 3.0, 4.0),
    ],
)
def test_electrons_of_a_lit_marker(
    power: float, time_s: float, f_number: float, distance_m: float, gain: float
) -> None:
    """L t q pi / (4 N^2) through the air of the distance; the luminance of an area does not fall with distance."""
    frame = lit_frame(time_s, f_number, distance_m, gain, scale=0.5)
    assert REC709_LUMINANCE.sum() == pytest.approx(1.0)
    assert lit_electrons(frame, power, load_engine("analytic")) == pytest.approx(
        expected_electrons(frame, power, distance_m), rel=WITHIN
    )


@pytest.mark.mitsuba
@pytest.mark.parametrize(("power", "f_number", "distance_m"), [(1.0, 2.8, 3.0), (3.0, 1.4, 1.7)])
def test_electrons_of_a_lit_marker_by_path_tracing(
    engine: RenderEngine, power: float, f_number: float, distance_m: float
) -> None:
    frame = lit_frame(f_number=f_number, distance_m=distance_m, scale=0.25)
    assert lit_electrons(frame, power, engine) == pytest.approx(
        expected_electrons(frame, power, distance_m), rel=WITHIN
    )


def expected_electrons(frame: FrameSpec, power: float, distance_m: float) -> float:
    air, exposure = np.exp(-frame.environment.extinction_per_m * distance_m), frame.exposure
    lux_s = 2000.0 * power * air * np.pi / (4 * exposure.f_number**2) * exposure.time_s
    return lux_s * frame.sensor.responsivity_e_per_lux_s


def test_light_of_a_whole_marker_falls_with_the_square_of_its_distance() -> None:
    """Electrons summed over a marker and its blur, against its image's area."""
    from datasets_manifest.recipe.recipe import RenderSettings

    sums = []
    for distance_m in (5.0, 10.0, 20.0):
        frame = lit_frame(distance_m=distance_m)
        pictures = []
        for luminance in (2000.0, 0.0):
            drogue = frame.drogue.model_copy(update={"marker_luminance_cd_m2": luminance})
            shot = frame.model_copy(update={"drogue": drogue})
            images = expose(shot, load_engine("analytic").render(shot, RenderSettings(engine="analytic")))
            pictures.append(images.left[..., 0].astype(float))
        air = np.exp(-frame.environment.extinction_per_m * distance_m)
        sums.append((pictures[0] - pictures[1]).sum() / air * distance_m**2)
    np.testing.assert_allclose(sums, sums[0], rtol=WITHIN)
