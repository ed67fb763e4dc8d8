"""Compiled kernels serve the frames of all scenes: compiling takes longer than tracing a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from geometry.se3 import RigidTransform
from scenes.sampler import sample_frame
from tests.support.recipe_builder import paper_view_recipe

if TYPE_CHECKING:
    from render.mitsuba_engine.mitsuba_engine import MitsubaEngine


@pytest.fixture
def kernels(engine: MitsubaEngine) -> Iterator[Callable[[FrameSpec, RenderSettings], set[str]]]:
    """A function that renders a frame and returns the hashes of the kernels that it took."""
    import drjit as dr

    if engine.variant.variant == "scalar_rgb":
        pytest.skip("the scalar variant compiles nothing")

    def of(frame: FrameSpec, settings: RenderSettings) -> set[str]:
        dr.kernel_history_clear()
        engine.render(frame, settings)
        return {kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel}

    kept = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    yield of
    dr.set_flag(dr.JitFlag.KernelHistory, kept)
    dr.kernel_history_clear()


def without_marker(frame: FrameSpec, missing: int, moved_m: np.ndarray) -> FrameSpec:
    markers = tuple(SurfaceCondition(missing=index == missing) for index in range(frame.drogue.marker_count))
    pose = RigidTransform(frame.left_from_drogue.rotation, frame.left_from_drogue.translation_m + moved_m)
    return frame.model_copy(update={"condition": DrogueCondition(markers=markers), "left_from_drogue": pose})


def test_new_scenes_and_other_pixels_take_the_same_kernels(
    kernels: Callable[[FrameSpec, RenderSettings], set[str]],
) -> None:
    from render.mitsuba_engine.scene import KEPT_SCENES

    recipe = paper_view_recipe(scale=0.25, stations_m=(4.0,), samples=4)
    settings = recipe.render.model_copy(update={"edge_samples_per_px": 16})
    frame = sample_frame(recipe, 0)
    known: set[str] = set()
    new = []
    # Twice as many scenes as are kept, so that old ones go meanwhile; each drogue covers other pixels.
    for index in range(2 * KEPT_SCENES + 2):
        moved_m = np.array([0.013, 0.008, 0.0]) * index
        missing = index % frame.drogue.marker_count
        taken = kernels(without_marker(frame, missing, moved_m), settings)
        new.append(len(taken - known))
        known |= taken
    assert new[0] > 6
    # Calls into scenes are compiled for all kinds of paint that any kept scene has, those of other tests too, until the
    # scenes here have taken their places.
    settled = new[KEPT_SCENES + 1 :]
    # A ray that slips between the drogue's parts is sent again, by two kernels of its own. Were arrays used where NumPy
    # has put them, there would be variants for those that lie on 64 bytes and for those that do not, one or two a
    # scene; with numbers of shapes or pixels compiled in, five and more.
    assert sum(settled) <= 2, str(new)
