"""The Mitsuba engine: a frame becomes radiance and passes."""

from __future__ import annotations

import os
import time
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings
from geometry.stereo import EYES
from render.background import background
from render.engine import EyeRadiance, StereoRadiance
from render.mitsuba_engine.variant import probe_variant
from render.version import RENDER_VERSION
from scenes.surroundings import surroundings


class MitsubaEngine:
    """Path tracing of the pixels that see drogue, hose or tanker; the rest is the surroundings themselves.

    One process holds one engine, with one thread: results are then the same bit for bit in every run.

    Raises:
        ValueError: Mitsuba is not installed.
    """

    name = "mitsuba"

    def __init__(self) -> None:
        chosen = probe_variant()
        if chosen.library is not None:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(chosen.library)
        import mitsuba as mi

        mi.set_variant(chosen.variant)
        self.variant = chosen
        self.version = f"mitsuba {version('mitsuba')} {chosen.variant}, render version {RENDER_VERSION}"
        if chosen.variant == "scalar_rgb":
            from render.mitsuba_engine.scalar_tracer import ScalarTracer

            self._tracer: ScalarTracer | LlvmTracer = ScalarTracer()
        else:
            from render.mitsuba_engine.llvm_tracer import LlvmTracer

            self._tracer = LlvmTracer()

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes.

        Args:
            frame: what to render.
            settings: how.
        """
        stage_s: dict[str, float] = {}
        started = time.process_time()
        behind = background(frame)
        stage_s["sky"] = time.process_time() - started
        if frame.left_from_drogue is None:
            empty = {eye: _empty_eye(behind) for eye in EYES}
            return StereoRadiance(empty["left"], empty["right"], self.name, self.version, 0.0, stage_s)
        around = surroundings(frame.environment)
        traced = self._tracer.trace(frame, settings, around)
        stage_s |= traced.stage_s
        started = time.process_time()
        for eye in EYES:
            traced.eyes[eye].put_behind_air(frame.environment.extinction_per_m, around.horizon_radiance)
        eyes = {eye: traced.eyes[eye].over(behind) for eye in EYES}
        stage_s["composite"] = time.process_time() - started
        return StereoRadiance(
            eyes["left"], eyes["right"], self.name, self.version, traced.monte_carlo_noise_fraction, stage_s
        )


def _empty_eye(behind: NDArray[np.float32]) -> EyeRadiance:
    shape = behind.shape[:2]
    return EyeRadiance(
        radiance_cd_m2=behind,
        coverage=np.zeros(shape, dtype=np.float32),
        part_id=np.zeros(shape, dtype=np.uint8),
        depth_m=np.full(shape, np.inf, dtype=np.float32),
        normal=np.zeros((*shape, 3), dtype=np.float32),
        amodal_px={},
    )
