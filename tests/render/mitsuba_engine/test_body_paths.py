"""Light inside baskets, ribbons, leaves and cones: shared by both eyes, and as many paths on each part as it needs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP, Part, drogue_part_ids
from geometry.stereo import EYES
from render.camera.optics import blur
from render.engine import RenderEngine, StereoRadiance
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RIG_160_PX, RIG_320_PX, build_recipe, stations

pytestmark = pytest.mark.mitsuba


@pytest.fixture(scope="module")
def ribbons(engine: RenderEngine) -> tuple[Recipe, FrameSpec, list[StereoRadiance]]:
    """A frame that looks into grey ribbons, and two pictures of it; with more noise than usual, which is quicker."""
    recipe = build_recipe(
        name="body",
        drogue="ribbons-grey",
        rig=RIG_160_PX,
        frames={"count": 1},
        distance=stations(2.0),
        render={"noise_over_sensor": 0.8},
        environment={"ground": "sea", "clouds": {"scene_fraction": 0.0}},
    )
    frame = sample_frame(recipe, 0)
    return recipe, frame, [engine.render(frame.model_copy(update={"seed": seed}), recipe.render) for seed in (1, 2)]


def test_stated_noise_is_that_of_two_pictures(ribbons: tuple[Recipe, FrameSpec, list[StereoRadiance]]) -> None:
    _, frame, (first, second) = ribbons
    per_cd_m2, squares, electrons = frame.sensor.electrons_per_cd_m2(frame.exposure), [], []
    for eye in EYES:
        a, b = getattr(first, eye), getattr(second, eye)
        seen = np.isin(a.part_id, drogue_part_ids(frame.drogue.marker_count))
        shift = blur(a.radiance_cd_m2, frame.sensor.psf_sigma_px) - blur(b.radiance_cd_m2, frame.sensor.psf_sigma_px)
        squares.append((per_cd_m2 * shift[seen]) ** 2)
        electrons.append(per_cd_m2 * a.radiance_cd_m2[seen])
    sensor = np.mean(np.concatenate(electrons)) + frame.sensor.read_noise_e**2
    measured = np.sqrt(np.mean(np.concatenate(squares)) / sensor / 2)
    stated = np.mean([first.monte_carlo_over_sensor_noise, second.monte_carlo_over_sensor_noise])
    # As for other drogues: the lens is taken to leave all of the error that neighbours share.
    assert 0.8 < stated / measured < 1.5
    assert stated < 0.9


def test_parts_are_as_bright_as_by_paths_alone(
    engine: RenderEngine, ribbons: tuple[Recipe, FrameSpec, list[StereoRadiance]]
) -> None:
    recipe, frame, smoothed = ribbons
    many = {"denoise": False, "samples_per_px": 64, "open_samples_per_px": 64, "edge_samples_per_px": 64}
    alone = engine.render(frame.model_copy(update={"seed": 3}), recipe.render.model_copy(update=many))
    for part in (Part.RIM, Part.CANOPY, Part.RIBS, Part.COUPLING):
        means = [
            np.mean([getattr(seen, eye).radiance_cd_m2[getattr(seen, eye).part_id == part].mean() for eye in EYES])
            for seen in (*smoothed, alone)
        ]
        # Some hundred pixels of a few per cent each.
        assert np.mean(means[:2]) == pytest.approx(means[2], rel=0.02), part.name


def test_wider_means_keep_the_light_and_meet_the_noise(
    engine: RenderEngine, ribbons: tuple[Recipe, FrameSpec, list[StereoRadiance]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """White cloth near by takes them; here all that takes any second paths does."""
    from render.mitsuba_engine.paths import body_paths

    recipe, frame, before = ribbons
    monkeypatch.setattr(body_paths, "_MANY_PATHS", 0)
    wider = engine.render(frame.model_copy(update={"seed": 4}), recipe.render)
    assert wider.monte_carlo_over_sensor_noise < 0.9
    for part in (Part.RIM, Part.CANOPY, Part.RIBS, Part.COUPLING):
        means = [seen.left.radiance_cd_m2[seen.left.part_id == part].mean() for seen in (*before, wider)]
        assert means[2] == pytest.approx(np.mean(means[:2]), rel=0.03), part.name
    assert np.any(wider.left.radiance_cd_m2 != before[0].left.radiance_cd_m2)


def test_light_on_markers_is_averaged_over_less(engine: RenderEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over steps of 20 mm it moved the centroid of one marker in twelve by 0.02 px."""
    from render.mitsuba_engine.paths import body_paths

    steps: dict[int, list[float]] = {}

    class Recorded(body_paths.SurfaceCells):
        def __init__(self, part: np.ndarray, point: np.ndarray, normal: np.ndarray, step_m: np.ndarray) -> None:
            for own in np.unique(part):
                steps.setdefault(int(own), []).append(float(step_m[part == own].max()))
            super().__init__(part, point, normal, step_m)

    monkeypatch.setattr(body_paths, "SurfaceCells", Recorded)
    monkeypatch.setattr(body_paths, "_MANY_PATHS", 0)
    recipe = build_recipe(
        name="markers",
        drogue="basket-strut-markers",
        rig=RIG_320_PX,
        frames={"count": 1},
        distance=stations(2.2),
        render={"noise_over_sensor": 0.8},
        environment={"ground": "sea", "clouds": {"scene_fraction": 0.0}},
    )
    engine.render(sample_frame(recipe, 0), recipe.render)
    markers = [widths for part, widths in steps.items() if part % INSTANCE_STEP >= FIRST_MARKER_ID]
    assert len(markers) == 12
    assert np.unique(markers) == pytest.approx([0.008])
    assert steps[Part.RIBS] == pytest.approx([0.02, 0.03])


@pytest.fixture
def cells_of(engine: RenderEngine) -> Callable[..., Any]:
    from render.mitsuba_engine.paths.surface_cells import SurfaceCells

    def cells(part: np.ndarray, point: np.ndarray, normal: np.ndarray, step_m: float = 0.02) -> SurfaceCells:
        return SurfaceCells(part, point.astype(np.float32), normal.astype(np.float32), np.full(len(part), step_m))

    return cells


def plate(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on a plate of 0.2 m that faces +z, and their normals."""
    point = np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 3)) * [1, 1, 0]
    return point, np.tile([0.0, 0.0, 1.0], (count, 1))


def test_neighbours_share_part_and_normal(cells_of: Callable[..., Any]) -> None:
    point, normal = plate(2000, 1)
    group = np.arange(2000) % 3
    part, facing = np.where(group == 1, 4, 3), normal * np.where(group == 2, -1, 1)[:, None]
    means = cells_of(part, point, facing).means(group[:, None].astype(float), np.ones(2000))
    # The back of a cloth and another part in the same place have no share in the mean.
    assert means[:, 0] == pytest.approx(group, abs=1e-9)


def test_means_keep_what_is_even_and_what_slopes(cells_of: Callable[..., Any]) -> None:
    point, normal = plate(20_000, 2)
    weights = np.random.default_rng(3).integers(1, 9, 20_000)
    means = cells_of(np.full(20_000, 3), point, normal).means(np.column_stack([np.ones(20_000), point[:, 0]]), weights)
    assert means[:, 0] == pytest.approx(1.0, abs=1e-12)
    inside = np.abs(point).max(axis=1) < 0.07
    # Half the kernel's points lie within a centimetre; some dozens of neighbours are not quite even around a point.
    assert np.abs(means[inside, 1] - point[inside, 0]).max() < 0.004
    assert np.mean(means[inside, 1] - point[inside, 0]) == pytest.approx(0.0, abs=2e-4)


def test_noise_falls_with_the_neighbours(cells_of: Callable[..., Any]) -> None:
    noise = np.random.default_rng(4).standard_normal((20_000, 1))
    left = {}
    for step_m in (0.01, 0.02):
        point, normal = plate(20_000, 5)
        means = cells_of(np.full(20_000, 3), point, normal, step_m).means(noise, np.ones(20_000))
        left[step_m] = np.std(means)
    # Half a point a square millimetre: some hundred neighbours within a step of 2 cm. Twice the step, half the noise.
    assert left[0.02] < 0.1
    assert left[0.01] / left[0.02] == pytest.approx(2.0, rel=0.1)


@pytest.fixture
def paths_by_part(engine: RenderEngine) -> Callable[..., np.ndarray]:
    from render.mitsuba_engine.paths.body_paths import _paths_by_part

    return _paths_by_part


def by_part(**values: float) -> np.ndarray:
    table = np.zeros(256)
    for name, value in values.items():
        table[Part[name]] = value
    return table


def test_parts_take_paths_by_their_error(paths_by_part: Callable[..., np.ndarray]) -> None:
    error = by_part(CANOPY=40.0, RIBS=0.4)
    error[FIRST_MARKER_ID] = 4.0
    centers = by_part(CANOPY=10_000, RIBS=10_000, HOSE=500).astype(int)
    centers[FIRST_MARKER_ID] = 100
    first = np.full(256, 2)
    paths = paths_by_part(first, centers, error, 1.0, 1e9)
    # By the law that errors go by; numbers are rounded up.
    assert 0.7 < np.sum(error * (first / paths) ** 1.2) <= 1.0
    assert paths[FIRST_MARKER_ID] > paths[Part.CANOPY] > paths[Part.RIBS]
    # No other division of as many paths does better.
    for give, take in ((Part.CANOPY, Part.RIBS), (Part.RIBS, Part.CANOPY), (FIRST_MARKER_ID, Part.CANOPY)):
        other = paths.astype(float)
        moved = 0.3 * paths[give] * centers[give]
        other[give] -= moved / centers[give]
        other[take] += moved / centers[take]
        assert np.sum(error * (first / other) ** 1.2) > np.sum(error * (first / paths) ** 1.2)


def test_paths_stay_within_what_may_be_taken(paths_by_part: Callable[..., np.ndarray]) -> None:
    centers = by_part(CANOPY=10_000, RIBS=1000).astype(int)
    paths = paths_by_part(np.full(256, 1), centers, by_part(CANOPY=1.0, RIBS=2.0), 1e-12, 1e6)
    assert 2 * paths @ centers == pytest.approx(1e6, rel=0.05)
