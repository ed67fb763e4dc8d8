"""Maps and lamps of surfaces: both path tracers draw them where they are, and as bright as they are."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from drogue_models.painted_mesh import PaintedMesh, Sheen
from drogue_models.parts import FIRST_MARKER_ID, Part
from drogue_models.surface_looks import SurfaceWear
from geometry.se3 import RigidTransform
from geometry.stereo import EYES
from render.compositing import inside_one_part
from render.engine import EyeRadiance, RenderEngine, StereoRadiance, load_engine
from render.surfaces import frame_surfaces
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from tests.support.painted_plate import DISTANCE_M, QUARTERS, frame_with, plate, quarter_means, quarters
from tests.support.recipe_builder import paper_view_recipe
from tests.support.shared_shapes import pictures_in_both_orders

RECIPE = paper_view_recipe(scale=0.25, stations_m=(2.5,), samples=16)
SETTINGS: RenderSettings = RECIPE.render.model_copy(update={"surround_samples_per_px": 16})
PLACE = (0.0, 0.0, DISTANCE_M)
LAMP_CD_M2 = 1e6

ENGINES = [
    pytest.param("mitsuba", marks=pytest.mark.mitsuba),
    pytest.param(
        "blender",
        marks=[
            pytest.mark.blender,
            pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed"),
        ],
    ),
]


@pytest.fixture(scope="module", params=ENGINES)
def tracer(request: pytest.FixtureRequest) -> Iterator[RenderEngine]:
    if request.param == "mitsuba":
        yield request.getfixturevalue("engine")
        return
    blender = load_engine("blender")
    yield blender
    blender.close()  # type: ignore[attr-defined]


@pytest.fixture
def frame() -> FrameSpec:
    return sample_frame(RECIPE, 0)


def test_maps_lie_the_right_way_round(tracer: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    painted = frame_with(monkeypatch, frame, [(plate(quarters()), PLACE)])
    means = quarter_means(painted, tracer.render(painted, SETTINGS).left)
    even = frame_with(monkeypatch, frame, [(plate(np.full(3, 0.5)), PLACE)])
    light = quarter_means(even, tracer.render(even, SETTINGS).left) / 0.5
    # The sky's light is traced by some dozens of paths a pixel in one engine, over thousands of pixels.
    np.testing.assert_allclose(means / light, QUARTERS, rtol=0.02)


def test_other_maps_on_the_same_mesh_are_drawn_anew(
    tracer: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = frame_with(monkeypatch, frame, [(plate(quarters()), PLACE)])
    tracer.render(first, SETTINGS)
    turned = frame_with(monkeypatch, frame, [(plate(quarters()[::-1]), PLACE)])
    means = quarter_means(turned, tracer.render(turned, SETTINGS).left)
    finer = frame_with(monkeypatch, frame, [(plate(quarters(32)[::-1]), PLACE)])
    np.testing.assert_allclose(means, quarter_means(finer, tracer.render(finer, SETTINGS).left), rtol=0.02)
    # The upper quarters now have the colours that the lower ones had.
    assert means[0, 0].argmax() == 2 and means[1, 0].argmax() == 0


def test_small_lamps_shine_and_leave_no_speckles(
    tracer: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    bulb = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    wall = plate(np.full(3, 0.5))
    near_wall = (0.0, 0.0, DISTANCE_M - 0.06)
    seen = {}
    for level in (0.0, LAMP_CD_M2):
        lamp = PaintedMesh(mesh=bulb, reflectance=np.full(3, 0.5), emission_cd_m2=np.full(3, level), smooth=True)
        lit = frame_with(monkeypatch, frame, [(wall, PLACE), (lamp, near_wall)])
        seen[level] = tracer.render(lit, SETTINGS).left.radiance_cd_m2
    added = (seen[LAMP_CD_M2] - seen[0.0]).max(axis=-1)
    camera = frame.rig.camera
    u, v = camera.project(np.array(near_wall))
    row, column = np.mgrid[: camera.height_px, : camera.width_px]
    away_px = np.hypot(column - u, row - v)
    radius_px = camera.fx_px * 0.02 / near_wall[2]
    assert added[away_px < radius_px - 1].min() == pytest.approx(LAMP_CD_M2, rel=1e-3)
    # Its light, over all pixels, is that of a disc of its size: the outline is drawn by rays.
    area_px2 = added[away_px < radius_px + 2].sum() / LAMP_CD_M2
    assert area_px2 == pytest.approx(np.pi * radius_px**2, rel=0.1)
    wall_light = seen[0.0][away_px < 30].mean()
    # What is left is the paths' noise of the wall in daylight; one path that met the lamp would add hundreds of times.
    assert added[away_px > radius_px + 2].max() < 0.5 * wall_light


def test_a_lamp_smaller_than_a_pixel_keeps_its_light(
    engine: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall, radius_m = plate(np.full(3, 0.05)), 0.002
    bulb = trimesh.creation.icosphere(subdivisions=2, radius=radius_m)
    lamp = PaintedMesh(mesh=bulb, reflectance=np.full(3, 0.05), emission_cd_m2=np.full(3, LAMP_CD_M2))
    totals = []
    camera = frame.rig.camera
    for shift in np.linspace(0.0, 1.0, 5):
        # Through all places of a pixel: its centre's ray meets the lamp or not.
        place = (0.1 + shift * DISTANCE_M / camera.fx_px, 0.1, DISTANCE_M - 0.05)
        lit = frame_with(monkeypatch, frame, [(wall, PLACE), (lamp, place)])
        radiance = engine.render(lit, SETTINGS).left.radiance_cd_m2[..., 0].astype(np.float64)
        u, v = np.rint(camera.project(np.array(place))).astype(int)
        totals.append(radiance[v - 3 : v + 4, u - 3 : u + 4].sum() / LAMP_CD_M2)
    area_px2 = np.pi * (camera.fx_px * radius_m / DISTANCE_M) ** 2
    assert area_px2 < 0.3
    # 256 rays, of which a fifth of a pixel's area takes some 50.
    np.testing.assert_allclose(totals, area_px2, rtol=0.5)
    assert np.mean(totals) == pytest.approx(area_px2, rel=0.2)


def test_worn_drogues_share_a_scene_and_take_their_own_maps(engine: RenderEngine, frame: FrameSpec) -> None:
    # All pictures share their random numbers, so that noise is no difference.
    few = SETTINGS.model_copy(update={"edge_samples_per_px": 1, "noise_over_sensor": 100.0})

    def worn(seed: int) -> FrameSpec:
        return frame.model_copy(update={"condition": DrogueCondition(wear=SurfaceWear(seed=seed, fading=0.9))})

    first = engine.render(worn(1), few).left
    scenes = len(engine._tracer._scenes._scenes)  # type: ignore[attr-defined]
    other = engine.render(worn(2), few).left
    again = engine.render(worn(1), few).left
    assert len(engine._tracer._scenes._scenes) == scenes  # type: ignore[attr-defined]
    np.testing.assert_array_equal(again.radiance_cd_m2, first.radiance_cd_m2)
    face = first.part_id == Part.FACE
    ratio = other.radiance_cd_m2[face] / first.radiance_cd_m2[face]
    assert ratio.std() > 0.03


def test_few_scenes_with_large_maps_are_kept(
    engine: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene_module = pytest.importorskip("render.mitsuba_engine.scene")
    monkeypatch.setattr(scene_module, "_MOST_MAP_BYTES", 3 * 512 * 512 * 3 * 4)
    scenes, ambient = scene_module.SceneCache(), environment_radiance(frame.environment)
    kept = []
    for index in range(5):
        # Maps of unequal sizes take scenes of their own.
        painted = frame_with(monkeypatch, frame, [(plate(np.full((512, 512 + index, 3), 0.5)), PLACE)])
        scenes.scene_of(painted, ambient)
        kept.append(len(scenes._scenes))
    assert kept == [1, 2, 2, 2, 2]
    huge = frame_with(monkeypatch, frame, [(plate(np.full((2048, 2048, 3), 0.5)), PLACE)])
    assert scenes.scene_of(huge, ambient) is scenes.scene_of(huge, ambient)


def test_scenes_share_shapes_and_each_frame_has_its_own_places_and_paints(
    engine: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = SETTINGS.model_copy(update={"edge_samples_per_px": 1, "noise_over_sensor": 100.0})
    light, dark, bright = plate(quarters()), plate(0.5 * quarters()), plate(np.full(3, 0.9))
    right, aside = (0.2, 0.0, DISTANCE_M), (bright, (0.1, 1.0, DISTANCE_M))
    views = [[(light, right)], [(light, PLACE)], [(dark, right), aside]]

    def picture(view: list[tuple[PaintedMesh, tuple[float, float, float]]]) -> EyeRadiance:
        return engine.render(frame_with(monkeypatch, frame, view), few).left

    pictures = [picture(view) for view in views]
    scenes = engine._tracer._scenes._scenes  # type: ignore[attr-defined]
    last, before = (scenes[key] for key in list(scenes)[:-3:-1])
    ((key, shape),) = before.shapes.items()
    assert last.shapes[key] is shape and len(last.shapes) == 2
    # Each was moved and painted for another one meanwhile; the first finds its plate in its place, but painted.
    for view, shown in zip(views, pictures, strict=True):
        np.testing.assert_array_equal(picture(view).radiance_cd_m2, shown.radiance_cd_m2)
    first, moved = ((shown.part_id > 0).any(axis=0) for shown in pictures[:2])
    shift_px = 0.2 * frame.rig.camera.fx_px / DISTANCE_M
    assert np.flatnonzero(first)[[0, -1]] - np.flatnonzero(moved)[[0, -1]] == pytest.approx(shift_px, abs=1)


@pytest.mark.slow
def test_one_drogue_in_two_conditions_is_drawn_alike_in_any_order(engine: RenderEngine) -> None:
    pairs = pictures_in_both_orders(engine)
    scenes = list(engine._tracer._scenes._scenes.values())  # type: ignore[attr-defined]
    # All but the two lamps of which each scene lacks one, and their fronts.
    assert len(scenes[-1].shapes.keys() & scenes[-2].shapes.keys()) == len(scenes[-1].shapes) - 2
    for one, other in pairs:
        np.testing.assert_array_equal(one.part_id, other.part_id)
        np.testing.assert_array_equal(one.radiance_cd_m2, other.radiance_cd_m2)
    # The conditions and places are not one.
    seen = [one.radiance_cd_m2 for one, _ in pairs]
    assert all(not np.array_equal(seen[i], seen[j]) for i in range(4) for j in range(i))


def test_only_dirt_and_bold_maps_count_as_edges_all_over(frame: FrameSpec) -> None:
    states = (SurfaceCondition(dirt_fraction=0.3), *(SurfaceCondition() for _ in range(frame.drogue.marker_count - 1)))
    for fraction in (1.0, 0.7):
        worn = DrogueCondition(markers=states, wear=SurfaceWear(seed=1), body_reflectance_fraction=fraction)
        surfaces = frame_surfaces(frame.model_copy(update={"condition": worn}), RigidTransform.identity())
        assert surfaces.uneven_parts == {FIRST_MARKER_ID}
        face = surfaces.fixed[f"part_{int(Part.FACE)}"]
        np.testing.assert_allclose(face.reflectance, face.painted.reflectance * np.float32(fraction), rtol=1e-6)


@pytest.mark.slow
def test_maps_leave_smoothed_light_unbiased(engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=1 / 3, stations_m=(3.0,))
    worst = SurfaceWear(seed=2, soot=0.8, oil=0.8, edge_wear=0.8, fading=0.8, tape=0.5)
    worn = sample_frame(recipe, 0).model_copy(update={"condition": DrogueCondition(wear=worst)})
    # Edges are left out below.
    many = {"samples_per_px": 100, "open_samples_per_px": 36, "edge_samples_per_px": 1, "denoise": False}
    truth = engine.render(worn.model_copy(update={"seed": 99}), recipe.render.model_copy(update=many))
    few = recipe.render.model_copy(update={"edge_samples_per_px": 16})
    renders = [engine.render(worn.model_copy(update={"seed": seed}), few) for seed in range(2)]

    def light_inside(seen: StereoRadiance, part: Part) -> np.ndarray:
        """Of both eyes, summed over the colours."""
        views = [getattr(seen, eye) for eye in EYES]
        inside = [(view.part_id == part) & inside_one_part(view.part_id) for view in views]
        lights = [view.radiance_cd_m2[where].sum(axis=-1) for view, where in zip(views, inside, strict=True)]
        return np.concatenate(lights).astype(float)

    for part in (Part.FACE, Part.HUB, Part.COUPLING):
        (first, second), theirs = (light_inside(seen, part) for seen in renders), light_inside(truth, part)
        ours = (first + second) / 2
        # In one picture and eye the face's mean has 0.03 % of noise, that of hub and coupling, some 250 pixels each, up
        # to 0.8 %, of two pictures and both eyes 0.4 %. With 0.3 % of many paths' own that is 0.5 %.
        assert ours.mean() / theirs.mean() == pytest.approx(1.0, abs=0.002 if part == Part.FACE else 0.015)
        # Where the map is dark, light that was divided by little is multiplied by as little again. Another picture than
        # those compared says where: noise would choose what it darkens. On the few such pixels of the coupling there is
        # too much of it.
        if part != Part.COUPLING:
            dark = first <= np.quantile(first, 0.1)
            assert second[dark].mean() / theirs[dark].mean() == pytest.approx(1.0, abs=0.04)
        if part == Part.FACE:
            assert np.corrcoef(ours, theirs)[0, 1] > 0.99


def test_a_sheen_beside_the_drogue_is_as_bright_as_paths_alone_find_it(
    engine: RenderEngine, frame: FrameSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    shiny = replace(plate(quarters()), sheen=Sheen(0.3, 0.3))
    painted = frame_with(monkeypatch, frame, [(shiny, PLACE)])
    many = {"denoise": False, "surround_samples_per_px": 100}
    alone = quarter_means(painted, engine.render(painted, SETTINGS.model_copy(update=many)).left)
    np.testing.assert_allclose(quarter_means(painted, engine.render(painted, SETTINGS).left), alone, rtol=0.02)
    matt = frame_with(monkeypatch, frame, [(plate(quarters()), PLACE)])
    assert not np.allclose(quarter_means(matt, engine.render(matt, SETTINGS).left), alone, rtol=0.1)
