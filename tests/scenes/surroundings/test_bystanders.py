"""What a recipe draws around a drogue: receivers by scene, distractors where they belong, and no old stream moves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from datasets_manifest.recipe.aircraft_ranges import ReceiverRanges
from datasets_manifest.recipe.drogue_ranges import DistractorForm
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import obstacle_mesh
from drogue_models.obstacles import DISTRACTOR_BODIES, PROBE_FORMS
from drogue_models.surroundings.bystanders import bystander_surface
from geometry.se3 import Array, RigidTransform
from render.surfaces import frame_tanker_surfaces
from scenes.sampler import sample_frame
from scenes.surroundings.distractor_sampling import DistractorScene, sample_distractor
from scenes.surroundings.receiver_sampling import receiver_of_scene
from tests.support.recipe_builder import RecipeTable, between, build_recipe

BASE: RecipeTable = {
    "name": "around-test",
    "seed": 4,
    "rig": {"preset": "rgb-ideal", "probe_tip_body_m": [2.6, 0.5, 0.35]},
    "frames": {"count": 300, "scenes": 300},
    "distance": between(3, 20),
}
ALL_BODIES = list(DISTRACTOR_BODIES)


def recipe(**sections: Any) -> Recipe:
    return build_recipe(BASE, **sections)


def vertices_left_m(obstacle: Obstacle) -> Array:
    painted = bystander_surface(obstacle.shape, obstacle.reflectance_rgb, obstacle.luminance_cd_m2)
    return obstacle.left_from_object.apply(np.asarray(painted.mesh.vertices))


def receivers(count: int = 300, **keys: Any) -> list[tuple[Obstacle, ...]]:
    drawn = recipe()
    return [receiver_of_scene(4, scene, ReceiverRanges(**keys), drawn.rig, False) for scene in range(count)]


def probes(frames: list[tuple[Obstacle, ...]]) -> list[Obstacle]:
    return [found for frame in frames for found in frame if found.kind == "probe"]


def test_the_section_adds_bystanders_and_changes_nothing_else() -> None:
    plain, drawn = sample_frame(recipe(), 3), sample_frame(recipe(receiver={}), 3)
    before, after = (frame.model_dump(mode="json") for frame in (plain, drawn))
    assert {key for key in after if after[key] != before.get(key)} <= {"bystanders"}


def test_all_probes_and_sides_come_in_their_shares() -> None:
    found = receivers()
    forms = [probe.shape.form for probe in probes(found)]
    assert set(forms) == set(PROBE_FORMS)
    # Six choices; four standard errors of a share of 300 are 0.09.
    assert len(forms) / 300 == pytest.approx(5 / 6, abs=0.09)
    assert all(forms.count(form) / 300 == pytest.approx(1 / 6, abs=0.09) for form in PROBE_FORMS)
    rig = recipe().rig
    sideways = np.array(
        [
            (rig.body_from_left @ probe.left_from_object).translation_m[1]
            for probe in probes(found)
            if probe.shape.form != "probe-nose"
        ]
    )
    left, right = (sideways < -0.2).mean(), (sideways > 0.2).mean()
    assert left == pytest.approx(0.25, abs=0.12) and right == pytest.approx(0.5, abs=0.14)
    assert (np.abs(sideways) < 0.06).mean() == pytest.approx(0.25, abs=0.12)


def test_the_tip_is_where_the_rig_has_it_in_sequences() -> None:
    rig = recipe().rig
    kept = [receiver_of_scene(4, scene, ReceiverRanges(), rig, True) for scene in range(60)]
    for probe in probes(kept):
        np.testing.assert_allclose(
            (rig.body_from_left @ probe.left_from_object).translation_m, rig.probe_tip_body_m, atol=1e-12
        )


def test_mounting_moves_the_probes_box_by_more_than_80_px() -> None:
    rig = recipe().rig
    starts = []
    for probe in probes(receivers(60)):
        points = vertices_left_m(probe)
        seen = points[points[:, 2] > 0.5]
        pixel = rig.image(seen, "left")
        inside = ((pixel > 0) & (pixel < [rig.camera.width_px, rig.camera.height_px])).all(axis=1)
        if inside.any():
            starts.append(pixel[inside].min(axis=0))
    assert len(starts) > 40
    # The left edge of the box, and its upper one, where the sides do not add to the spread.
    across_px, down_px = np.std(starts, axis=0)
    assert across_px > 80 and down_px > 60


def test_parts_of_the_cockpit_come_in_their_shares_and_stay_at_the_edges() -> None:
    found = receivers(
        100, probes=("none",), nose_scene_fraction=0.4, canopy_scene_fraction=0.5, glare_shield_scene_fraction=0.3
    )
    forms = [part.shape.form for frame in found for part in frame]
    # Four standard errors of a binomial share of 100.
    assert forms.count("nose") / 100 == pytest.approx(0.4, abs=0.2)
    assert forms.count("canopy-frame") / 100 == pytest.approx(0.5, abs=0.2)
    assert forms.count("glare-shield") / 100 == pytest.approx(0.3, abs=0.19)
    rig = recipe().rig
    camera = rig.camera
    for part in (part for frame in found[:30] for part in frame):
        assert part.kind == "obstacle"
        points = vertices_left_m(part)
        for eye in ("left", "right"):
            pixel = rig.image(points[points[:, 2] > 0.1], eye)
            share = (pixel + 0.5) / [camera.width_px, camera.height_px]
            middle = (np.abs(share - 0.5) < 0.25).all(axis=1)
            assert not middle.any(), part.shape.form


def test_a_scene_keeps_its_receiver_in_all_its_frames() -> None:
    one_scene = build_recipe(BASE, frames={"count": 4, "scenes": 1}, receiver={})
    frames = [sample_frame(one_scene, index).bystanders for index in range(4)]
    assert all(frame == frames[0] for frame in frames)


def with_bodies(index: int, forms: list[str], empty_fraction: float = 0.0) -> FrameSpec:
    drawn = recipe(
        frames={"empty_fraction": empty_fraction}, target={"distractor_frame_fraction": 1.0, "distractor_forms": forms}
    )
    return sample_frame(drawn, index)


@pytest.mark.parametrize("index", range(12))
def test_distractors_stay_behind_the_drogue(index: int) -> None:
    frame = with_bodies(index, ALL_BODIES)
    assert frame.left_from_drogue is not None
    distractors = [found for found in frame.bystanders if found.kind == "distractor"]
    assert distractors
    for found in distractors:
        # The middle keeps 1 m beyond the rim; a large body reaches nearer by its own size at most.
        assert vertices_left_m(found)[:, 2].max() > frame.left_from_drogue.translation_m[2] + 1.0
        assert found.left_from_object.translation_m[2] > frame.left_from_drogue.translation_m[2]


@pytest.mark.parametrize("form", ["ball", "disc", "ring"])
def test_plain_distractors_stay_behind_the_drogue_however_far_it_is(form: DistractorForm) -> None:
    rng, rim_m = np.random.default_rng(6), 60.0
    scene = DistractorScene(
        rig=recipe().rig,
        forms=(form,),
        nearest_m=rim_m,
        world_from_left=RigidTransform.identity(),
        left_from_tanker=None,
        tanker=(),
    )
    for _ in range(100):
        drawn = sample_distractor(rng, scene)
        mesh = obstacle_mesh(drawn.shape)
        assert drawn.left_from_object.apply(np.asarray(mesh.vertices))[:, 2].min() > rim_m


@pytest.mark.parametrize("form", ["roundel", "lamp", "antenna"])
def test_bodies_of_the_skin_touch_the_tanker(form: str) -> None:
    touching = 0
    for index in range(10):
        frame = with_bodies(index, [form])
        assert frame.left_from_tanker is not None
        skin = trimesh.util.concatenate([painted.mesh for painted in frame_tanker_surfaces(frame)])
        for found in frame.bystanders:
            place = (frame.left_from_tanker.inverse() @ found.left_from_object).translation_m
            corners = np.asarray(skin.triangles)
            nearest = trimesh.triangles.closest_point(corners, np.tile(place, (len(corners), 1)))
            touching += bool(np.linalg.norm(nearest - place, axis=1).min() < 0.03)
    assert touching >= 8


def test_empty_frames_have_bodies_too() -> None:
    frames = [with_bodies(index, ALL_BODIES, 1.0) for index in range(8)]
    assert all(any(found.kind == "distractor" for found in frame.bystanders) for frame in frames)
    assert all(frame.drogue is None for frame in frames)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"receiver": {"probes": []}}, "receiver.probes"),
        ({"receiver": {"probes": ["probe-bent"]}}, "receiver.probes"),
        ({"receiver": {"nose_scene_fraction": 0.7, "glare_shield_scene_fraction": 0.7}}, "must add up to at most 1"),
        ({"receiver": {}, "target": {"probe": True}}, "target.probe: draws a second probe beside that of"),
        ({"receiver": {}, "render": {"engine": "analytic"}}, "receiver: the engine analytic draws none"),
    ],
)
def test_wrong_sections_are_refused_in_one_line(sections: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        recipe(**sections)
