"""Compiled kernels serve the frames of all scenes: compiling takes longer than tracing a frame.

Memory stays what the kept scenes and the largest frame take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from droguekit.api.recipe_rendering import load_recipe
from droguekit.batch.execution import resident_gib
from droguekit.batch.worker_pool import run_in_own_process
from geometry.se3 import RigidTransform
from render.engine import load_engine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RIG_160_PX, paper_view_recipe

if TYPE_CHECKING:
    from render.mitsuba_engine.mitsuba_engine import MitsubaEngine

# Kernels do not depend on the sky, and clouds take most of a small frame's time.
CLEAR = [{"name": "clear"}]


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
    kernels: Callable[[FrameSpec, RenderSettings], set[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_scenes = 2
    monkeypatch.setattr("render.mitsuba_engine.scene.KEPT_SCENES", kept_scenes)
    recipe = paper_view_recipe(scale=0.125, stations_m=(6.0,), samples=4)
    settings = recipe.render.model_copy(update={"edge_samples_per_px": 16})
    frame = sample_frame(recipe, 0)
    known: set[str] = set()
    new = []
    # More than twice as many scenes as are kept, so that old ones go meanwhile; each drogue covers other pixels.
    for index in range(kept_scenes + 5):
        moved_m = np.array([0.013, 0.008, 0.0]) * index
        missing = index % frame.drogue.marker_count
        taken = kernels(without_marker(frame, missing, moved_m), settings)
        new.append(len(taken - known))
        known |= taken
    assert new[0] > 6
    # Calls into scenes are compiled for all kinds of paint that any kept scene has, those of other tests too, until the
    # scenes here have taken their places.
    settled = new[kept_scenes + 1 :]
    # A ray that slips between the drogue's parts is sent again, by two kernels of its own. Were arrays used where NumPy
    # has put them, there would be variants for those that lie on 64 bytes and for those that do not, one or two a
    # scene; with numbers of shapes or pixels compiled in, five and more.
    assert sum(settled) <= 2, str(new)


@dataclass(frozen=True)
class Usage:
    """What a process has used after a frame: new kernels, bytes allocated for the device, and its own memory. [GiB]"""

    new_kernels: int
    allocated_bytes: int
    resident_gib: float


def usage_over_frames() -> list[Usage] | None:
    """Renders fifty frames of other drogues, paints, obstacles, distances and motions, then the first ten twice again.

    None for the scalar variant.
    """
    import drjit as dr

    engine = load_engine("mitsuba")
    if "scalar_rgb" in engine.version:
        return None
    recipe = load_recipe("detector-small", rig=RIG_160_PX, frames={"count": 50, "scenes": 16}, families=CLEAR)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    known: set[str] = set()
    usage = []
    for index in [*range(recipe.frames.count), *range(10), *range(10)]:
        dr.kernel_history_clear()
        engine.render(sample_frame(recipe, index), recipe.render)
        taken = {kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel}
        allocated = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
        usage.append(Usage(len(taken - known), allocated, resident_gib()))
        known |= taken
    return usage


@pytest.mark.slow  # 70 frames
def test_kernels_and_memory_settle_over_the_frames_of_a_varied_recipe() -> None:
    usage = run_in_own_process(usage_over_frames)
    if usage is None:
        pytest.skip("the scalar variant compiles nothing")
    early, late, again, settled = usage[:25], usage[25:50], usage[50:60], usage[60:]
    assert sum(after.new_kernels for after in early) > 30
    # The number of paths from a pixel, one of few, is compiled into a kernel; rare ones may come late.
    assert sum(after.new_kernels for after in late) <= 3, str(usage)
    # Frames that were rendered before meet other kept scenes, whose kinds of paint are compiled into calls. Once these
    # were there too, nothing more is taken.
    assert sum(after.new_kernels for after in again) <= 2, str(usage)
    assert sum(after.new_kernels for after in settled) == 0, str(usage)
    # A frame that is nearer than all before takes more memory.
    assert settled[-1].allocated_bytes == late[-1].allocated_bytes
    assert settled[-1].resident_gib <= 1.05 * late[-1].resident_gib
