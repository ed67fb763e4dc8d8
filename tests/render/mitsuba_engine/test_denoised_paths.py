"""Light smoothed over surfaces, against paths through every pixel alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import FIRST_MARKER_ID, MAX_MARKERS, Part, drogue_part_ids
from geometry.stereo import EYES
from render.camera.optics import blur
from render.engine import EyeRadiance, RenderEngine, StereoRadiance
from scenes.sampler import sample_frame
from tests.support.recipe_builder import build_recipe, paper_view_recipe, stations

pytestmark = pytest.mark.mitsuba


@pytest.fixture(scope="module")
def settled(engine: RenderEngine) -> tuple[Recipe, FrameSpec, StereoRadiance]:
    """A frame at a quarter of the paper's scale, its recipe, and what many paths through every pixel make of it."""
    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0,))
    frame = sample_frame(recipe, 0)
    many = {"samples_per_px": 100, "open_samples_per_px": 36, "edge_samples_per_px": 400, "denoise": False}
    return recipe, frame, engine.render(reseeded(frame, 99), recipe.render.model_copy(update=many))


def reseeded(frame: FrameSpec, seed: int) -> FrameSpec:
    return frame.model_copy(update={"seed": seed})


@pytest.fixture(scope="module")
def smoothed(engine: RenderEngine, settled: tuple[Recipe, FrameSpec, StereoRadiance]) -> list[StereoRadiance]:
    """Two pictures of the settled frame with smoothed light, which share no random number."""
    recipe, frame, _ = settled
    return [engine.render(reseeded(frame, seed), recipe.render) for seed in (1, 2)]


def of_drogue(seen: EyeRadiance) -> np.ndarray:
    return np.isin(seen.part_id, drogue_part_ids(MAX_MARKERS))


def over_sensor(frame: FrameSpec, first: StereoRadiance, second: StereoRadiance) -> float:
    """Rms difference of two renders over the sensor's noise on the drogue, both behind the lens."""
    sensor, per_cd_m2 = frame.sensor, frame.sensor.electrons_per_cd_m2(frame.exposure)
    squares, electrons = [], []
    for eye in EYES:
        a, b = getattr(first, eye), getattr(second, eye)
        difference = blur(a.radiance_cd_m2, sensor.psf_sigma_px) - blur(b.radiance_cd_m2, sensor.psf_sigma_px)
        squares.append((per_cd_m2 * difference[of_drogue(a)]) ** 2)
        electrons.append(per_cd_m2 * b.radiance_cd_m2[of_drogue(b)])
    return np.sqrt(np.mean(np.concatenate(squares)) / (np.mean(np.concatenate(electrons)) + sensor.read_noise_e**2))


@pytest.fixture
def unsmoothed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light at pixel centres stays as it was traced, and is not traced again."""
    denoised_paths, surface_light = (
        pytest.importorskip(f"render.mitsuba_engine.paths.{name}") for name in ("denoised_paths", "surface_light")
    )
    monkeypatch.setattr(denoised_paths, "MOST_TIMES", 1.0)
    monkeypatch.setattr(surface_light.SurfaceLight, "smooth", lambda *_: None)


@pytest.mark.usefixtures("unsmoothed")
def test_smoothing_lessens_the_noise_of_the_same_paths(
    engine: RenderEngine, settled: tuple[Recipe, FrameSpec, StereoRadiance], smoothed: list[StereoRadiance]
) -> None:
    recipe, frame, _ = settled
    rough = [engine.render(reseeded(frame, seed), recipe.render) for seed in (1, 2)]
    # Most of what is left is the noise of edges: 0.83 was measured.
    assert over_sensor(frame, *smoothed) < 0.9 * over_sensor(frame, *rough)


def test_stated_noise_is_that_of_two_pictures(
    settled: tuple[Recipe, FrameSpec, StereoRadiance], smoothed: list[StereoRadiance]
) -> None:
    _, frame, _ = settled
    first, second = smoothed
    stated = np.mean([first.monte_carlo_over_sensor_noise, second.monte_carlo_over_sensor_noise])
    # A sixteenth of the pixels states it, a few edges make up most of it, and the lens is taken to leave all of the
    # error that neighbours share: rather too much than too little.
    assert 0.8 < stated / (over_sensor(frame, first, second) / np.sqrt(2)) < 1.5


@pytest.mark.parametrize("part", [Part.FACE, Part.RIBS, Part.COUPLING, Part.HUB, FIRST_MARKER_ID])
def test_smoothing_keeps_the_mean_light_of_parts(
    settled: tuple[Recipe, FrameSpec, StereoRadiance], smoothed: list[StereoRadiance], part: Part
) -> None:
    _, _, truth = settled
    means = [
        np.mean(np.concatenate([getattr(seen, eye).radiance_cd_m2[getattr(seen, eye).part_id == part] for eye in EYES]))
        for seen in (*smoothed, truth)
    ]
    # Means over some hundred pixels of 2 % noise; ribs are narrower than the smoothing.
    assert np.mean(means[:2]) == pytest.approx(means[2], rel=0.01 if part != Part.RIBS else 0.03)


def test_smoothing_moves_no_marker(
    settled: tuple[Recipe, FrameSpec, StereoRadiance], smoothed: list[StereoRadiance]
) -> None:
    _, frame, truth = settled
    markers = range(FIRST_MARKER_ID, FIRST_MARKER_ID + frame.drogue.marker_count)
    ours, theirs = (
        np.mean([[redness_centroid(seen.left, marker) for marker in markers] for seen in pictures], axis=0)
        for pictures in (smoothed, [truth])
    )
    shifts = np.linalg.norm(ours - theirs, axis=1)
    # What the renderer may do to a marker on average; the noise of one picture alone makes 0.003 to 0.007.
    assert np.mean(shifts) < 0.005


def redness_centroid(seen: EyeRadiance, marker: int) -> np.ndarray:
    """Centroid of red over blue around a marker. [px]"""
    rows, columns = np.nonzero(seen.part_id == marker)
    window = np.s_[rows.min() - 3 : rows.max() + 4, columns.min() - 3 : columns.max() + 4]
    red = seen.radiance_cd_m2[window][..., 0].astype(float) - seen.radiance_cd_m2[window][..., 2]
    red -= np.median(red[[0, -1]])
    v, u = np.indices(red.shape)
    # Beyond the marker's own surroundings other things are bluer than the face.
    near = (u - red.shape[1] / 2 + 0.5) ** 2 + (v - red.shape[0] / 2 + 0.5) ** 2 < (min(red.shape) / 2) ** 2
    return np.array([np.sum((values * red)[near]) for values in (u, v)]) / np.sum(red[near])


@pytest.fixture(scope="module")
def below_the_wing(engine: RenderEngine) -> tuple[Recipe, FrameSpec, StereoRadiance]:
    """A frame that shows pod and wing, its recipe, and what many paths through every pixel make of it."""
    recipe = paper_view_recipe(scale=1 / 3, stations_m=(12.0,))
    frame = next(frame for index in range(50) if shows_the_tanker(frame := sample_frame(recipe, index)))
    many = {"surround_samples_per_px": 64, "edge_samples_per_px": 16, "denoise": False}
    return recipe, frame, engine.render(reseeded(frame, 99), recipe.render.model_copy(update=many))


def shows_the_tanker(frame: FrameSpec) -> bool:
    """Whether the hose leaves the pod well within the left image."""
    camera, origin = frame.rig.camera, frame.left_from_tanker.translation_m
    u, v = origin[:2] / origin[2] * camera.fx_px + (camera.cx_px, camera.cy_px)
    return 60 < u < camera.width_px - 60 and 60 < v < camera.height_px - 60


def on_the_tanker(seen: EyeRadiance) -> np.ndarray:
    """(P, 3) light of pixels on pod and wing away from their outlines. [cd/m2]"""
    inside = cv2.erode((seen.part_id == Part.TANKER).astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
    return seen.radiance_cd_m2[inside]


@pytest.fixture(scope="module")
def tanker_twice(
    engine: RenderEngine, below_the_wing: tuple[Recipe, FrameSpec, StereoRadiance]
) -> tuple[np.ndarray, np.ndarray]:
    """Its light in two pictures that share no random number."""
    recipe, frame, _ = below_the_wing
    return pictures_of_the_tanker(engine, recipe, frame)


def pictures_of_the_tanker(engine: RenderEngine, recipe: Recipe, frame: FrameSpec) -> tuple[np.ndarray, np.ndarray]:
    settings = recipe.render.model_copy(update={"edge_samples_per_px": 16})
    first, second = (on_the_tanker(engine.render(reseeded(frame, seed), settings).left) for seed in (1, 2))
    return first, second


@pytest.mark.usefixtures("tanker_twice", "unsmoothed")
def test_smoothing_leaves_half_of_the_speckles_on_the_tanker(
    engine: RenderEngine,
    below_the_wing: tuple[Recipe, FrameSpec, StereoRadiance],
    tanker_twice: tuple[np.ndarray, np.ndarray],
) -> None:
    recipe, frame, _ = below_the_wing
    rough, smooth = (
        np.median(np.abs(first - second))
        for first, second in (pictures_of_the_tanker(engine, recipe, frame), tanker_twice)
    )
    # Narrow parts, of which this small picture has many, see few neighbours: 0.51 was measured.
    assert smooth < 0.7 * rough


def test_smoothed_light_on_the_tanker_is_unbiased(
    below_the_wing: tuple[Recipe, FrameSpec, StereoRadiance], tanker_twice: tuple[np.ndarray, np.ndarray]
) -> None:
    settled = on_the_tanker(below_the_wing[2].left)
    assert len(settled) > 2000
    assert np.mean(tanker_twice) == pytest.approx(settled.mean(), rel=0.01)


@pytest.mark.parametrize("index", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_probe_beside_the_drogue_brings_no_noise(engine: RenderEngine, index: int) -> None:
    """It stands close before markers and face, whose light from others is next to nothing elsewhere."""
    recipe = build_recipe(
        name="probe",
        seed=3,
        rig={
            "preset": "rgb-ideal",
            "width_px": 320,
            "height_px": 240,
            "focal_px": 533.0,
            "probe_tip_body_m": [2.6, 0.5, 0.35],
        },
        frames={"count": 2},
        distance=stations(2.2, 2.6),
        target={"probe": True},
    )
    frame = sample_frame(recipe, index)
    first, second = (engine.render(reseeded(frame, seed), recipe.render) for seed in (1, 2))
    # Two pictures differ by both their noises. With two paths from each pixel it was two to three times the sensor's.
    measured = over_sensor(frame, first, second) / np.sqrt(2)
    assert measured < 0.5
    assert first.monte_carlo_over_sensor_noise == pytest.approx(measured, rel=0.25)
