"""Blender's pictures through real lenses, against the labels and against the other path tracer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import FIRST_MARKER_ID
from geometry.stereo import EYES
from labelgen.frame_labels import label_frame
from labelgen.validation.label_checks import check_against_passes
from render.camera.sensor import expose
from render.engine import RenderEngine, StereoRadiance
from scenes.sampler import sample_frame
from tests.support.blender_interpreter import needs_blender
from tests.support.recipe_builder import build_recipe, stations

pytestmark = [pytest.mark.blender, needs_blender]


@pytest.fixture(scope="module")
def made() -> tuple[Recipe, FrameSpec, StereoRadiance]:
    from render.blender_engine.blender_engine import BlenderEngine

    recipe = build_recipe(
        name="real-lenses",
        seed=3,
        rig={
            "preset": "rgb-ideal",
            "width_px": 320,
            "height_px": 240,
            "focal_px": 533.3,
            "eyes": {
                "k1": -0.2,
                "k2": 0.1,
                "p1": 0.002,
                "p2": -0.003,
                "principal_point_px": 6.0,
                "focal_fraction": 0.01,
                "right_rotation_deg": 0.5,
            },
        },
        frames={"count": 2},
        distance=stations(2.0),
        pose={"speed_m_s": 0.5},
        render={"engine": "blender", "samples_per_px": 16},
    )
    frame = sample_frame(recipe, 0)
    engine = BlenderEngine()
    try:
        radiance = engine.render(frame, recipe.render)
    except ValueError as error:
        if "was built without Open Shading Language" not in str(error):
            raise
        pytest.skip(str(error))
    finally:
        engine.close()
    return recipe, frame, radiance


def test_labels_and_passes_agree(made: tuple[Recipe, FrameSpec, StereoRadiance]) -> None:
    _, frame, radiance = made
    assert check_against_passes(label_frame(frame, radiance, expose(frame, radiance)), radiance) == []


def test_markers_are_where_the_lens_shows_them(made: tuple[Recipe, FrameSpec, StereoRadiance]) -> None:
    _, frame, radiance = made
    layout = marker_layout(frame.drogue)
    for eye in EYES:
        parts = getattr(radiance, eye).part_id
        centers = frame.rig.image(frame.left_from_drogue.apply(layout.centers_m), eye)
        straight = frame.rig.project(frame.left_from_drogue.apply(layout.centers_m), eye)
        for marker, (center, ideal) in enumerate(zip(centers, straight, strict=True)):
            rows, columns = np.nonzero(parts == FIRST_MARKER_ID + marker)
            # Pixel centres on a disc of 13 px radius: 0.04 px by the lattice, and 0.06 px that a disc's centre and its
            # image's centre are apart at this distance.
            assert np.hypot(columns.mean() - center[0], rows.mean() - center[1]) < 0.15
            assert np.hypot(*(center - ideal)) > 1.0


@pytest.mark.mitsuba
def test_both_path_tracers_agree(made: Any, engine: RenderEngine) -> None:
    if engine.version.find("llvm") < 0:
        pytest.skip("the scalar variant draws ideal eyes only")
    recipe, frame, theirs = made
    # Blender takes sixteen everywhere.
    ours = engine.render(frame, recipe.render.model_copy(update={"edge_samples_per_px": 64}))
    for eye in EYES:
        a, b = getattr(theirs, eye), getattr(ours, eye)
        # A few pixel centres fall on an edge within rounding.
        assert np.mean(a.part_id != b.part_id) < 1e-3
        same = (a.part_id == b.part_id) & (a.part_id > 0)
        # Some ten roundings of float32 at up to 30 m (the tanker), most of them on slanted surfaces.
        np.testing.assert_allclose(a.depth_m[same], b.depth_m[same], rtol=1e-4)
        assert np.median(np.abs(a.depth_m[same] / b.depth_m[same] - 1)) < 1e-6
        np.testing.assert_allclose(a.normal[same], b.normal[same], atol=1e-3)
        assert a.coverage.sum() == pytest.approx(b.coverage.sum(), rel=2e-3)
        # Noise of 16 paths and more over ten thousand pixels, most of it on edges.
        assert a.radiance_cd_m2.mean() == pytest.approx(b.radiance_cd_m2.mean(), rel=2e-3)
