"""The Mitsuba engine: a frame becomes radiance and passes."""

from __future__ import annotations

import os
import time
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from geometry.stereo import EYES, Eye
from render.background import air_before, backgrounds
from render.engine import EyeRadiance, StereoRadiance
from render.mitsuba_engine.render_noise import MonteCarloNoise, measure_noise
from render.mitsuba_engine.trace_request import OF_DROGUE, ToTrace, Traced
from render.mitsuba_engine.variant import probe_variant
from render.version import RENDER_VERSION
from scenes.environment_radiance import surroundings


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

        Raises:
            ValueError: the rig has real lenses, which the slow variant does not know.
        """
        if frame.rig.lenses is not None and self.variant.variant == "scalar_rgb":
            raise ValueError(f"rig: mitsuba as scalar_rgb draws ideal eyes only ({self.variant.reason}); use analytic")
        stage_s: dict[str, float] = {}
        started = time.process_time()
        behind = backgrounds(frame)
        stage_s["sky"] = time.process_time() - started
        if frame.drogue is None and not frame.bystanders:
            empty = {eye: _empty_eye(behind[eye]) for eye in EYES}
            return StereoRadiance(empty["left"], empty["right"], self.name, self.version, 0.0, stage_s)
        around = surroundings(frame.environment)
        traced = self._tracer.trace(ToTrace(frame, settings, around, behind))
        stage_s |= traced.stage_s
        started = time.process_time()
        for eye in EYES:
            seen, again = traced.eyes[eye], traced.again[eye]
            seen.put_behind_air(*air_before(frame, seen.pixel))
            traced.error_again[eye] *= again.put_behind_air(*air_before(frame, again.pixel))
        noise = _noise(frame, traced, behind)
        eyes = {eye: traced.eyes[eye].over(behind[eye]) for eye in EYES}
        stage_s["composite"] = time.process_time() - started
        return StereoRadiance(
            eyes["left"], eyes["right"], self.name, self.version, noise.fraction, stage_s, noise.over_sensor
        )


def _noise(frame: FrameSpec, traced: Traced, behind: dict[Eye, NDArray[np.float32]]) -> MonteCarloNoise:
    """Noise of the pixels whose centres see the drogue, edges included."""
    first, second, shared = [], [], []
    for eye in EYES:
        seen, again = traced.eyes[eye], traced.again[eye]
        place = np.zeros(seen.part_id.size, dtype=np.int64)
        place[seen.pixel] = np.arange(len(seen.pixel))
        of_drogue = OF_DROGUE[seen.part_id.reshape(-1)[again.pixel]] > 0
        first.append(seen.pixels_over(behind[eye])[place[again.pixel[of_drogue]]])
        second.append(again.pixels_over(behind[eye])[of_drogue])
        shared.append(traced.error_again[eye][of_drogue])
    return measure_noise(frame, np.concatenate(first), np.concatenate(second), np.concatenate(shared))


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
