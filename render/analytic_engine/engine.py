"""The analytic engine: flat rings over the surroundings, every pixel's coverage exact."""

from __future__ import annotations

import time
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings
from geometry.stereo import EYES, Eye
from render.analytic_engine.flat_parts import flat_drogue, ring_radiance
from render.analytic_engine.outlines import EyeView, seen_areas
from render.analytic_engine.painting import paint
from render.analytic_engine.passes import empty_passes, pixel_passes
from render.background import background
from render.engine import EyeRadiance, StereoRadiance
from render.mitsuba_engine.traced import blur_px
from render.version import RENDER_VERSION
from scenes.surroundings import surroundings

_SHARP_BELOW_PX = 0.05
# A streak is the mean of sharp images this far apart at most, unless it is very long.
_BLUR_STEP_PX = 0.5
_MOST_BLUR_MOMENTS = 32


class AnalyticEngine:
    """Evenly lit discs and rings with exact edges: the clean room for estimators, and an opinion on other engines.

    There are no shadows, no light between parts, no canopy, ribs, hose and tanker.
    """

    name = "analytic"

    def __init__(self) -> None:
        self.version = f"analytic, shapely {version('shapely')}, render version {RENDER_VERSION}"

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes.

        Args:
            frame: what to render.
            settings: samples and depths, which mean nothing here.

        Raises:
            ValueError: part of the drogue is not in front of the camera.
        """
        stage_s = {"sky": 0.0, "passes": 0.0, "outlines": 0.0, "composite": 0.0}
        started = time.process_time()
        behind = background(frame)
        stage_s["sky"] = time.process_time() - started
        eyes = {eye: _draw_eye(frame, eye, behind, stage_s) for eye in EYES}
        return StereoRadiance(eyes["left"], eyes["right"], self.name, self.version, 0.0, stage_s)


def _draw_eye(frame: FrameSpec, eye: Eye, behind: NDArray[np.float32], stage_s: dict[str, float]) -> EyeRadiance:
    """One eye over the surroundings `behind` (H, W, 3); adds its CPU seconds to `stage_s`."""
    if frame.drogue is None or frame.left_from_drogue is None:
        nothing = empty_passes(frame.rig.camera)
        coverage = np.zeros(behind.shape[:2], dtype=np.float32)
        return EyeRadiance(behind.copy(), coverage, nothing.part_id, nothing.depth_m, nothing.normal, nothing.amodal_px)
    times = [time.process_time()]
    flat = flat_drogue(frame.drogue)
    passes = pixel_passes(flat, EyeView(frame.rig, eye, frame.left_from_drogue))
    times.append(time.process_time())
    moments = [
        seen_areas(flat, EyeView(frame.rig, eye, frame.left_from_drogue_at(offset_s))) for offset_s in _moments_s(frame)
    ]
    times.append(time.process_time())
    light = ring_radiance(frame, surroundings(frame.environment), flat.back_to_front)
    radiance, coverage = paint(moments, light, behind)
    times.append(time.process_time())
    for stage, spent_s in zip(("passes", "outlines", "composite"), np.diff(times), strict=True):
        stage_s[stage] += float(spent_s)
    return EyeRadiance(radiance, coverage, passes.part_id, passes.depth_m, passes.normal, passes.amodal_px)


def _moments_s(frame: FrameSpec) -> NDArray[np.float64]:
    """Times to average over, from mid-exposure: the middles of equal parts of the exposure. [s]"""
    moves_px = blur_px(frame)
    steps = int(np.ceil(2 * moves_px / _BLUR_STEP_PX)) + 1
    count = 1 if moves_px < _SHARP_BELOW_PX else min(steps, _MOST_BLUR_MOMENTS)
    middles: NDArray[np.float64] = ((np.arange(count) + 0.5) / count - 0.5) * frame.exposure.time_s
    return middles
