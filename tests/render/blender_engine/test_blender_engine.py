"""The Blender engine against closed forms, against itself, and against the other path tracer."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.obstacles import ObstacleShape
from drogue_models.parameters import SatinPaint
from drogue_models.parts import Part, drogue_part_ids
from geometry.circles import disc_area_px2, project_disc_centers
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES
from labelgen.frame_labels import label_frame
from labelgen.validation.label_checks import check_against_passes
from render.camera.sensor import expose
from render.engine import RenderEngine, load_engine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import paper_view_recipe
from tests.support.rods import receiver_rod_frame, rod_coverage

if TYPE_CHECKING:
    from render.blender_engine.blender_engine import BlenderEngine

from tests.support.blender_interpreter import needs_blender

pytestmark = [pytest.mark.blender, needs_blender]

LAMP_CD_M2 = 1e6
PASSES = ("radiance_cd_m2", "coverage", "part_id", "depth_m", "normal")


@pytest.fixture(scope="module")
def blender() -> Iterator[BlenderEngine]:
    # Not at the top: the test is collected where Blender is missing, too.
    from render.blender_engine.blender_engine import BlenderEngine

    engine = BlenderEngine()
    yield engine
    engine.close()


def lit(frame: FrameSpec, luminance_cd_m2: float) -> FrameSpec:
    drogue = frame.drogue.model_copy(update={"marker_luminance_cd_m2": luminance_cd_m2})
    return frame.model_copy(update={"drogue": drogue})


def lamp_coverage(engine: RenderEngine, frame: FrameSpec, settings: RenderSettings) -> dict[str, np.ndarray]:
    """Coverage by the markers: light of the lamps alone over their luminance, by eye."""
    on, off = engine.render(lit(frame, LAMP_CD_M2), settings), engine.render(frame, settings)
    return {
        eye: (getattr(on, eye).radiance_cd_m2 - getattr(off, eye).radiance_cd_m2) @ REC709_LUMINANCE / LAMP_CD_M2
        for eye in EYES
    }


def moments(image: np.ndarray, near_px: np.ndarray, reach_px: float) -> tuple[np.ndarray, float]:
    """Centroid, and area, of what lies within reach of a place."""
    u0, v0 = np.floor(near_px - reach_px).astype(int)
    u1, v1 = np.ceil(near_px + reach_px).astype(int) + 1
    v, u = np.mgrid[v0:v1, u0:u1]
    weight = np.where(np.hypot(u - near_px[0], v - near_px[1]) <= reach_px, image[v0:v1, u0:u1], 0.0)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum(), weight.sum()


@pytest.mark.slow
def test_lit_markers_are_where_and_as_large_as_the_labels_say(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(4.0, 8.0), samples=36)
    errors, areas = [], []
    for index in range(2):
        frame = sample_frame(recipe, index)
        layout = marker_layout(frame.drogue)
        clear = frame.model_copy(
            update={"environment": frame.environment.model_copy(update={"visibility_m": 400_000.0})}
        )
        images = lamp_coverage(blender, clear, recipe.render)
        for eye in EYES:
            radii = np.full(layout.count, layout.radius_m)
            truth = project_disc_centers(recipe.rig, frame.left_from_drogue, layout.centers_m, radii, eye)
            for center_m, center_px in zip(layout.centers_m, truth, strict=True):
                area = disc_area_px2(recipe.rig, frame.left_from_drogue, center_m, layout.radius_m, eye)
                got, got_area = moments(images[eye], center_px, 1.1 * np.sqrt(area / np.pi) + 2.5)
                errors.append(got - center_px)
                areas.append(got_area / area)
    # 36 samples in each of some 20 edge pixels leave 0.006 px at 8 m; the pixel lattice itself moves centroids by
    # 0.04 w^-1.5 = 0.006 px at 8 m (3.5 px radius).
    assert np.sqrt(np.mean(np.square(errors))) < 0.02
    assert np.abs(np.mean(errors, axis=0)).max() < 0.005
    # One area: 1 % at 8 m; the mean of 32 of them 0.2 %.
    assert np.mean(areas) == pytest.approx(1.0, abs=0.006)


def test_passes_of_pixel_centres(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(2.0,), samples=1)
    frame = sample_frame(recipe, 0)
    radiance = blender.render(frame, recipe.render)
    layout = marker_layout(frame.drogue)
    normal = frame.left_from_drogue.rotation[:, 2]
    for eye in EYES:
        seen = getattr(radiance, eye)
        on_marker = (seen.part_id >= 32) & (seen.part_id < 32 + layout.count)
        v, u = np.nonzero(on_marker)
        assert len(u) > 500
        rays = recipe.rig.camera.rays(np.stack([u, v], axis=-1))
        origin = frame.left_from_drogue.translation_m - recipe.rig.eye_offset_m(eye)
        plane_depth = (origin @ normal) / (rays @ normal)
        # float32 of 3 m carries 2e-7 m; Blender's camera is float32 all the way, some ten roundings.
        np.testing.assert_allclose(seen.depth_m[on_marker], plane_depth, atol=5e-6)
        np.testing.assert_allclose(seen.normal[on_marker], np.broadcast_to(-normal, (len(u), 3)), atol=1e-5)
        assert np.isinf(seen.depth_m[seen.part_id == 0]).all()
        for marker in range(layout.count):
            assert seen.amodal_px[32 + marker] == np.count_nonzero(seen.part_id == 32 + marker)
    assert check_against_passes(label_frame(frame, radiance, expose(frame, radiance)), radiance) == []


def test_a_marker_before_the_hub_takes_nothing_of_its_amodal_area(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0,), samples=1)
    pose = RigidTransform(rotation_from_angles(0.0, 0.85, 0.0), np.array([0.1, 0.05, 3.0]))
    frame = sample_frame(recipe, 0).model_copy(update={"left_from_drogue": pose})
    by_blender = blender.render(frame, recipe.render)
    by_areas = load_engine("analytic").render(frame, recipe.render)
    for eye in EYES:
        found, wanted = (getattr(radiance, eye).amodal_px[Part.HUB] for radiance in (by_blender, by_areas))
        # Circles of meshes are polygons: a centre or two at the edge. A marker hides a quarter of the hub or more.
        assert np.count_nonzero(getattr(by_blender, eye).part_id == Part.HUB) < 0.75 * wanted
        assert abs(found - wanted) <= 2


@pytest.mark.slow
@pytest.mark.mitsuba
def test_both_path_tracers_agree(blender: BlenderEngine, engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(2.0,), samples=36)
    settings = recipe.render.model_copy(update={"surround_samples_per_px": 36})
    frame = sample_frame(recipe, 0)
    theirs, ours = blender.render(frame, settings), engine.render(frame, settings)
    for eye in EYES:
        a, b = getattr(theirs, eye), getattr(ours, eye)
        drogue_a, drogue_b = (np.isin(seen.part_id, drogue_part_ids(8)) for seen in (a, b))
        # A few pixel centres fall on an edge within rounding.
        assert np.count_nonzero(drogue_a != drogue_b) <= 1e-3 * np.count_nonzero(drogue_a)
        assert a.coverage.sum() == pytest.approx(b.coverage.sum(), rel=1e-3)
        marker = (a.part_id >= 32) & (b.part_id >= 32)
        masks = {"marker": marker}
        masks |= {part: (a.part_id == part) & (b.part_id == part) for part in (Part.FACE, Part.RIM, Part.HOSE)}
        for name, mask in masks.items():
            got = [float((seen.radiance_cd_m2[mask] @ REC709_LUMINANCE).mean()) for seen in (a, b)]
            # Noise of 36 paths over a thousand pixels: 0.5 %, with parts of a pixel's width 1 %.
            assert got[0] == pytest.approx(got[1], rel=0.02), name


@pytest.mark.slow
@pytest.mark.mitsuba
def test_rough_plastic_means_the_same_to_both(blender: BlenderEngine, engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(1.8,), samples=36)
    # Blender takes as many everywhere.
    settings = recipe.render.model_copy(update={"edge_samples_per_px": 36})
    frame = sample_frame(recipe, 0)
    # The sun behind the cameras, so that the facets have something to mirror.
    environment = frame.environment.model_copy(update={"sun_azimuth_deg": 190.0, "sun_elevation_deg": 25.0})
    satin = SatinPaint(parts=("ribs", "coupling"), sheen_fraction=0.4, roughness=0.25)
    shiny = frame.model_copy(
        update={"environment": environment, "drogue": frame.drogue.model_copy(update={"satin": satin})}
    )
    matt = shiny.model_copy(update={"drogue": frame.drogue})
    theirs, ours = (renderer.render(shiny, settings) for renderer in (blender, engine))
    # A few per cent of noise are little beside the sheen.
    dull = blender.render(matt, settings.model_copy(update={"samples_per_px": 4}))
    for part in (Part.RIBS, Part.COUPLING):
        where = (theirs.left.part_id == part) & (ours.left.part_id == part)
        got, expected, without = (
            float((seen.left.radiance_cd_m2[where] @ REC709_LUMINANCE).mean()) for seen in (theirs, ours, dull)
        )
        # Noise of 36 paths over a thousand pixels is 0.4 %; facets hide each other by two formulas that differ by a
        # few percent of the sheen at grazing light.
        assert got == pytest.approx(expected, rel=0.02), part.name
        assert got > 1.3 * without, part.name


def test_noise_is_what_two_renderings_by_other_samples_differ_by(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0,), samples=16)
    frame = sample_frame(recipe, 0)
    one, other = (blender.render(frame.model_copy(update={"seed": seed}), recipe.render) for seed in (1, 2))
    error, value = 0.0, 0.0
    for eye in EYES:
        a, b = (getattr(radiance, eye) for radiance in (one, other))
        where = np.isin(a.part_id, drogue_part_ids(8))
        images = [seen.radiance_cd_m2[where] @ REC709_LUMINANCE for seen in (a, b)]
        error += np.square(images[0] - images[1]).sum() / 2
        value += np.square(images[0]).sum()
    measured = np.sqrt(error / value)
    # Halves of one sequence avoid each other: where errors fall with the power 1.5 of the samples, as on edges, half
    # their difference is 1.35 times the error of the mean. Twice the pixels leave 5 % of chance.
    assert 0.9 * measured < one.monte_carlo_noise_fraction < 1.6 * measured


@pytest.mark.slow
def test_same_frame_same_bits_whatever_came_before(blender: BlenderEngine) -> None:
    from render.blender_engine.blender_engine import BlenderEngine

    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0, 5.0), samples=4, speed_m_s=2.0)
    first = blender.render(sample_frame(recipe, 0), recipe.render)
    blender.render(lit(sample_frame(recipe, 1), LAMP_CD_M2), recipe.render)
    again = blender.render(sample_frame(recipe, 0), recipe.render)
    fresh = BlenderEngine()
    other = fresh.render(sample_frame(recipe, 0), recipe.render)
    fresh.close()
    assert first.engine_version == other.engine_version
    for eye in EYES:
        for name in PASSES:
            reference = getattr(getattr(first, eye), name)
            assert np.array_equal(reference, getattr(getattr(again, eye), name)), name
            assert np.array_equal(reference, getattr(getattr(other, eye), name)), name


@pytest.mark.slow
def test_moving_drogue_is_blurred_around_its_middle(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0,), samples=36)
    frame = sample_frame(recipe, 0)
    still = frame.model_copy(update={"exposure": frame.exposure.model_copy(update={"time_s": 0.01})})
    across = still.left_from_drogue.rotation.T @ np.array([3.0, 0.0, 0.0])
    moving = still.model_copy(update={"drogue_twist_per_s": np.concatenate([across, np.zeros(3)])})
    layout = marker_layout(still.drogue)
    radii = np.full(layout.count, layout.radius_m)
    truth = project_disc_centers(recipe.rig, still.left_from_drogue, layout.centers_m, radii, "left")
    travel_px = recipe.rig.camera.fx_px * 3.0 * 0.01 / 3.0
    sharp, blurred = (lamp_coverage(blender, f, recipe.render)["left"] for f in (still, moving))
    for center in truth:
        reach = 1.1 * layout.radius_m * recipe.rig.camera.fx_px / 3.0 + 1 + travel_px / 2
        (place, area), (still_place, still_area) = (moments(image, center, reach) for image in (blurred, sharp))
        # 36 random times of a streak of 5 px scatter each edge pixel; 0.13 px is 4 standard errors of the centroid.
        assert np.abs(place - still_place).max() < 0.13
        assert area == pytest.approx(still_area, rel=0.04)
    row = round(truth[0, 1])
    width = [np.count_nonzero(image[row] > 0.02) for image in (sharp, blurred)]
    # Two markers lie on the row; the streaks' ends are spread over a pixel each.
    assert width[1] - width[0] == pytest.approx(2 * travel_px, abs=4)


def test_the_receiver_s_parts_stay_sharp_while_the_drogue_moves(blender: BlenderEngine) -> None:
    frame = receiver_rod_frame()
    expected = rod_coverage(frame)
    seen = blender.render(frame, RenderSettings(surround_samples_per_px=64)).left
    error = (seen.coverage - expected)[80:, 20:140]
    # 64 random rays leave 0.06 where half of a pixel is covered.
    assert np.sqrt(np.mean(error[expected[80:, 20:140] > 0] ** 2)) < 0.08
    assert np.abs(error).max() < 0.35


def test_frames_without_a_drogue(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.125, stations_m=(5.0,), samples=4)
    frame = sample_frame(recipe, 0).model_copy(
        update={"drogue": None, "left_from_drogue": None, "left_from_tanker": None, "hose_nodes_left_m": None}
    )
    empty = blender.render(frame, recipe.render)
    assert not empty.left.part_id.any() and not empty.right.coverage.any()
    ball = Obstacle(
        kind="distractor",
        shape=ObstacleShape(form="ball", radius_m=0.5),
        left_from_object=RigidTransform(np.eye(3), np.array([0.0, 0.0, 10.0])),
        reflectance_rgb=(0.5, 0.5, 0.5),
    )
    seen = blender.render(frame.model_copy(update={"bystanders": (ball,)}), recipe.render).left
    radius_px = recipe.rig.camera.fx_px * 0.5 / np.sqrt(10.0**2 - 0.5**2)
    # A mesh of 64 sections is smaller than its ball by 0.3 %; the outline is 84 px long and its pixels are counted.
    assert np.count_nonzero(seen.part_id == Part.DISTRACTOR) == pytest.approx(np.pi * radius_px**2, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_blender_ends_with_the_process_that_uses_it(tmp_path: Path, how: signal.Signals) -> None:
    code = (
        "import sys, time\n"
        "from render.blender_engine.process import BlenderProcess\n"
        "process = BlenderProcess()\n"
        "print(process._process.pid, process.folder, flush=True)\n"
        "time.sleep(600)\n"
    )
    user = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    pid, folder = user.stdout.readline().split()
    # As Ctrl-C, job schedulers and a batch's end do: to all of the user's group at the same time.
    os.killpg(user.pid, how)
    user.wait()
    # Ends within moments; a minute is for a machine under load.
    for _ in range(600):
        if not Path(folder).exists() and not _runs(int(pid)):
            break
        time.sleep(0.1)
    assert not _runs(int(pid)) and not Path(folder).exists()


def _runs(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0]
    except OSError:
        return False


@pytest.mark.slow
def test_a_killed_blender_costs_one_try(blender: BlenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.125, stations_m=(5.0,), samples=2)
    frame = sample_frame(recipe, 0)
    before = blender.render(frame, recipe.render)
    os.kill(blender._process._process.pid, signal.SIGKILL)
    after = blender.render(frame, recipe.render)
    assert np.array_equal(before.left.radiance_cd_m2, after.left.radiance_cd_m2)


def test_blender_rests_when_it_has_nothing_to_draw(blender: BlenderEngine) -> None:
    """With one thread Cycles leaves one of TBB's awake, which takes a core for as long as the process lives."""
    recipe = paper_view_recipe(scale=0.125, stations_m=(5.0,), samples=2)
    blender.render(sample_frame(recipe, 0), recipe.render)
    tasks = [*Path(f"/proc/{blender._process._process.pid}/task").iterdir()]
    assert len(tasks) > 1

    def awake() -> bool:
        # State after the name, which stands in brackets and may hold anything.
        return any((task / "stat").read_text().rpartition(")")[2].split()[0] == "R" for task in tasks)

    # Threads that have just had work look around for more, for much less time than so many looks at them take.
    assert any(not awake() for _ in range(200_000))
