"""Frames whose Mitsuba scenes share shapes: one drogue in two conditions, at two places of its tanker and hose."""

from __future__ import annotations

from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from render.engine import EyeRadiance, RenderEngine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import paper_view_recipe


def pictures_in_both_orders(engine: RenderEngine) -> list[tuple[EyeRadiance, EyeRadiance]]:
    """Left pictures of every frame, once with the frames in turn and once in the other order.

    What a frame's scene has in common with others was meanwhile moved and painted for these.
    """
    recipe = paper_view_recipe(scale=0.0625, stations_m=(2.5, 4.0), samples=1)
    frames = [_worn(sample_frame(recipe, index), missing) for index in range(2) for missing in range(2)]
    seen = [[engine.render(frame, recipe.render).left for frame in order] for order in (frames, frames[::-1])]
    return list(zip(seen[0], seen[1][::-1], strict=True))


def _worn(frame: FrameSpec, missing: int) -> FrameSpec:
    """The frame with lamps and without one of them, with paint and lamps that differ by which is missing."""
    assert frame.drogue is not None
    share = 0.5 + 0.5 * missing
    states = tuple(
        SurfaceCondition(missing=index == missing, reflectance_fraction=share, lamp_fraction=share)
        for index in range(frame.drogue.marker_count)
    )
    lit = frame.drogue.model_copy(update={"marker_luminance_cd_m2": 2e4})
    worn = DrogueCondition(markers=states, body_reflectance_fraction=share)
    return frame.model_copy(update={"drogue": lit, "condition": worn})
