"""Aged surfaces, bystanders and real lenses in the Mitsuba engine: what is drawn is what the frame says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import DrogueCondition, Obstacle, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from drogue_models.obstacles import ObstacleShape
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.se3 import RigidTransform
from render.engine import EyeRadiance, RenderEngine, load_engine
from render.surfaces import clean_reflectance_rgb, frame_surfaces
from scenes.sampler import sample_frame
from tests.support.recipe_builder import build_recipe, paper_view_recipe, stations

NEW = SurfaceCondition()


def aged(frame: FrameSpec, states: dict[int, SurfaceCondition], **more: Any) -> FrameSpec:
    markers = tuple(states.get(index, NEW) for index in range(frame.drogue.marker_count))
    return frame.model_copy(update={"condition": DrogueCondition(markers=markers, **more)})


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    drawn = paper_view_recipe(scale=0.25, stations_m=(2.5,), samples=16)
    # What is looked at lies inside parts, and pictures that are compared share their random numbers.
    few = {"edge_samples_per_px": 16, "noise_over_sensor": 100.0}
    return drawn.model_copy(update={"render": drawn.render.model_copy(update=few)})


@pytest.fixture(scope="module")
def frame(recipe: Recipe) -> FrameSpec:
    return sample_frame(recipe, 0)


@pytest.fixture(scope="module")
def plain(engine: RenderEngine, recipe: Recipe, frame: FrameSpec) -> EyeRadiance:
    """The left eye's view of the frame as it is."""
    return engine.render(frame, recipe.render).left


def marker_light(seen: EyeRadiance, index: int) -> float:
    mask = seen.part_id == FIRST_MARKER_ID + index
    return float(seen.radiance_cd_m2[mask].mean())


def test_faded_paint_reflects_less_in_its_share(
    engine: RenderEngine, recipe: Recipe, frame: FrameSpec, plain: EyeRadiance
) -> None:
    faded = engine.render(aged(frame, {2: SurfaceCondition(reflectance_fraction=0.5)}), recipe.render).left
    # Light from the marker itself and from its neighbours' reflexes: the paths' noise is 1 % over some 200 pixels.
    assert marker_light(faded, 2) / marker_light(plain, 2) == pytest.approx(0.5, abs=0.05)
    assert marker_light(faded, 5) == pytest.approx(marker_light(plain, 5), rel=0.02)


def test_a_frame_as_new_after_an_aged_one_is_as_new(
    engine: RenderEngine, recipe: Recipe, frame: FrameSpec, plain: EyeRadiance
) -> None:
    engine.render(aged(frame, {0: SurfaceCondition(reflectance_fraction=0.2)}), recipe.render)
    assert np.array_equal(engine.render(frame, recipe.render).left.radiance_cd_m2, plain.radiance_cd_m2)


def test_a_missing_marker_is_gone(engine: RenderEngine, recipe: Recipe, frame: FrameSpec) -> None:
    seen = engine.render(aged(frame, {3: SurfaceCondition(missing=True)}), recipe.render)
    for eye in (seen.left, seen.right):
        assert FIRST_MARKER_ID + 3 not in eye.part_id
        assert FIRST_MARKER_ID + 3 not in eye.amodal_px
        assert FIRST_MARKER_ID + 4 in eye.part_id


def test_dirt_lies_where_its_map_has_it(engine: RenderEngine, recipe: Recipe, frame: FrameSpec) -> None:
    dirty = SurfaceCondition(dirt_fraction=0.4, dirt_seed=11)
    soiled = aged(frame, {1: dirty})
    plain = engine.render(aged(frame, {}), recipe.render).left
    seen = engine.render(soiled, recipe.render).left
    part = FIRST_MARKER_ID + 1
    rows, columns = np.nonzero(seen.part_id == part)
    # Points of the marker's plane behind the pixel centres, from its depth pass.
    rays = frame.rig.camera.rays(np.stack([columns, rows], axis=-1).astype(float))
    points = frame.left_from_drogue.inverse().apply(rays * seen.depth_m[rows, columns][:, None].astype(float))
    place = (points[:, :2] - frame.drogue.marker_positions_m[1]) / (2 * frame.drogue.marker_radius_m) + 0.5
    texels = np.clip((place * 64).astype(int), 0, 63)
    soiled_map = frame_surfaces(soiled, RigidTransform.identity()).fixed[f"part_{part}"].reflectance
    expected = soiled_map[texels[:, 1], texels[:, 0], 0] / clean_reflectance_rgb(frame, part)[0]
    ratio = seen.radiance_cd_m2[rows, columns, 0] / plain.radiance_cd_m2[rows, columns, 0]
    # A pixel is some ten texels wide: edges of blotches blur, which leaves the correlation high.
    assert np.corrcoef(ratio, expected)[0, 1] > 0.85


def test_lamps_shine_in_their_share(engine: RenderEngine, recipe: Recipe, frame: FrameSpec, plain: EyeRadiance) -> None:
    lit = frame.model_copy(update={"drogue": frame.drogue.model_copy(update={"marker_luminance_cd_m2": 1e6})})
    states = {0: SurfaceCondition(lamp_fraction=0.5), 1: SurfaceCondition(lamp_fraction=0.0)}
    seen = engine.render(aged(lit, states), recipe.render).left
    own = [marker_light(seen, index) - marker_light(plain, index) for index in range(3)]
    # Other lamps' light that the markers reflect is below 1 % of their own.
    assert own[0] / own[2] == pytest.approx(0.5, abs=0.02)
    assert own[1] / own[2] == pytest.approx(0.0, abs=0.02)


def test_bystanders_hide_what_is_behind_them(engine: RenderEngine, recipe: Recipe, frame: FrameSpec) -> None:
    center = frame.left_from_drogue.translation_m
    ball = Obstacle(
        kind="distractor",
        shape=ObstacleShape(form="ball", radius_m=0.05),
        left_from_object=RigidTransform(np.eye(3), center * 0.5),
        reflectance_rgb=(0.8, 0.8, 0.8),
    )
    seen = engine.render(frame.model_copy(update={"bystanders": (ball,)}), recipe.render).left
    u, v = np.rint(frame.rig.camera.project(center)).astype(int)
    assert seen.part_id[v, u] == Part.DISTRACTOR
    nearest_m = float(center[2]) * 0.5 - 0.05
    assert seen.depth_m[v, u] == pytest.approx(nearest_m, abs=0.01)
    assert seen.amodal_px[int(Part.HUB)] > np.count_nonzero(seen.part_id == Part.HUB)


def test_a_frame_without_a_drogue_shows_its_bystanders(engine: RenderEngine, recipe: Recipe, frame: FrameSpec) -> None:
    ball = Obstacle(
        kind="distractor",
        shape=ObstacleShape(form="ball", radius_m=0.3),
        left_from_object=RigidTransform(np.eye(3), np.array([0.05, 0.1, 4.0])),
        reflectance_rgb=(0.6, 0.02, 0.02),
    )
    emptied = frame.model_copy(
        update={
            "drogue": None,
            "left_from_drogue": None,
            "left_from_tanker": None,
            "hose_nodes_left_m": None,
            "bystanders": (ball,),
        }
    )
    seen = engine.render(emptied, recipe.render).right
    assert set(np.unique(seen.part_id)) == {int(Part.SKY), int(Part.DISTRACTOR)}
    v, u = (float(index.mean()) for index in np.nonzero(seen.part_id == Part.DISTRACTOR))
    # The image of a ball off the axis leans outwards by less than a tenth of a pixel here; the lattice adds as much.
    assert (u, v) == pytest.approx(frame.rig.project([0.05, 0.1, 4.0], "right"), abs=0.3)
    assert seen.amodal_px == {}


def test_rays_go_through_real_lenses_as_the_analytic_engine_projects(engine: RenderEngine) -> None:
    if "scalar" in engine.version:
        pytest.skip("the scalar variant draws ideal eyes only")
    recipe = build_recipe(
        name="real-eyes",
        seed=3,
        rig={"preset": "paper-real", "width_px": 320, "height_px": 240, "focal_px": 533.3},
        frames={"count": 1},
        distance=stations(3.0),
        render={"samples_per_px": 1, "edge_samples_per_px": 1, "surround_samples_per_px": 1, "denoise": False},
    )
    frame = sample_frame(recipe, 0)
    traced, drawn = (renderer.render(frame, recipe.render) for renderer in (engine, load_engine("analytic")))
    for ours, theirs in ((traced.left, drawn.left), (traced.right, drawn.right)):
        marker, wanted = ours.part_id >= FIRST_MARKER_ID, theirs.part_id >= FIRST_MARKER_ID
        # Outlines of 128 corners stand up to 10 um off: a pixel centre in a thousand lies between.
        assert np.count_nonzero(marker != wanted) <= 1e-3 * np.count_nonzero(wanted) + 2
