"""The analytic engine: flat rings over the background, with the exact coverage of every pixel."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from geometry.stereo import EYES, Eye
from render.analytic_engine.board_drawing import board_eye
from render.analytic_engine.flat_drogue import EyeView, flat_drogue, ring_radiance, visible_areas
from render.analytic_engine.pixel_coverage import paint
from render.analytic_engine.ring_passes import empty_passes, pixel_passes
from render.background import backgrounds
from render.camera.exposure_motion import motion_blur_px
from render.engine import EyeRadiance, StereoRadiance
from render.surfaces import missing_parts
from render.version import RENDER_VERSION
from scenes.environment_radiance import environment_radiance

_SHARP_BELOW_PX = 0.05
# Motion blur is the mean of sharp images this far apart at most, unless the motion is very long.
_BLUR_STEP_PX = 0.5
_MOST_BLUR_MOMENTS = 32


class AnalyticEngine:
    """Evenly lit discs and rings with exact edges: a test bed for estimators and a reference for other engines.

    There are no shadows, no light between parts, no canopy, ribs, hose, tanker or other objects; dirt is spread evenly.
    """

    name = "analytic"

    def __init__(self) -> None:
        self.version = f"analytic, shapely {version('shapely')}, render version {RENDER_VERSION}"

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes.

        Args:
            frame: what to render.
            settings: samples and depths, which this engine ignores.

        Raises:
            ValueError: part of the drogue is not in front of the camera.
        """
        stage_s = {"sky": 0.0, "light": 0.0, "passes": 0.0, "outlines": 0.0, "composite": 0.0}
        with _timed(stage_s, "sky"):
            background = backgrounds(frame)
        if frame.board is not None:
            with _timed(stage_s, "outlines"):
                boards = {eye: board_eye(frame, frame.board, eye, background[eye]) for eye in EYES}
            return self._stereo(boards, stage_s)
        if frame.drogue is None or frame.left_from_drogue is None:
            return self._stereo({eye: _empty_eye(frame, background[eye]) for eye in EYES}, stage_s)
        flat = flat_drogue(frame.drogue, missing_parts(frame))
        with _timed(stage_s, "light"):
            light = ring_radiance(frame, environment_radiance(frame.environment), flat.back_to_front)
        eyes = {}
        for eye in EYES:
            with _timed(stage_s, "passes"):
                passes = pixel_passes(flat, EyeView(frame.rig, eye, frame.left_from_drogue))
            with _timed(stage_s, "outlines"):
                views = [EyeView(frame.rig, eye, frame.left_from_drogue_at(offset_s)) for offset_s in _moments_s(frame)]
                moments = [visible_areas(flat, view) for view in views]
            with _timed(stage_s, "composite"):
                radiance, coverage = paint(moments, light, background[eye])
                eyes[eye] = EyeRadiance(radiance_cd_m2=radiance, coverage=coverage, **vars(passes))
        return self._stereo(eyes, stage_s)

    def _stereo(self, eyes: dict[Eye, EyeRadiance], stage_s: dict[str, float]) -> StereoRadiance:
        return StereoRadiance(
            left=eyes["left"],
            right=eyes["right"],
            engine=self.name,
            engine_version=self.version,
            monte_carlo_noise_fraction=0.0,
            stage_s=stage_s,
        )


@contextmanager
def _timed(stage_s: dict[str, float], stage: str) -> Iterator[None]:
    """Add the CPU time of a block to a stage."""
    started = time.process_time()
    yield
    stage_s[stage] += time.process_time() - started


def _empty_eye(frame: FrameSpec, background: NDArray[np.float32]) -> EyeRadiance:
    coverage = np.zeros(background.shape[:2], dtype=np.float32)
    return EyeRadiance(radiance_cd_m2=background.copy(), coverage=coverage, **vars(empty_passes(frame.rig.camera)))


def _moments_s(frame: FrameSpec) -> NDArray[np.float64]:
    """Times to average over, relative to mid-exposure: the middles of equal parts of the exposure. [s]"""
    moves_px = motion_blur_px(frame)
    steps = int(np.ceil(2 * moves_px / _BLUR_STEP_PX)) + 1
    count = 1 if moves_px < _SHARP_BELOW_PX else min(steps, _MOST_BLUR_MOMENTS)
    middles: NDArray[np.float64] = ((np.arange(count) + 0.5) / count - 0.5) * frame.exposure.time_s
    return middles
