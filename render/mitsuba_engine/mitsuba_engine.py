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
from render.background import air_in_front, backgrounds
from render.device import Device
from render.engine import EyeRadiance, StereoRadiance
from render.mitsuba_engine.render_noise import MonteCarloNoise, measure_noise
from render.mitsuba_engine.trace_request import DROGUE_PARTS, TraceRequest, TraceResult
from render.mitsuba_engine.variant import Variant, note_kernels, probe_variant
from render.surfaces import shows_surfaces
from render.version import RENDER_VERSION
from scenes.environment_radiance import environment_radiance

# New materials need new kernels, some 2 MiB for each frame of a corpus. They stay on disk, and to read them again from
# there takes less time than can be measured.
_FRAMES_TO_KEEP_KERNELS = 32


class MitsubaEngine:
    """Path tracing of the pixels that see drogue, hose or tanker; all others show the environment itself.

    One process holds one engine of each device, with one thread: results of the processor are then the same bit for
    bit in every run.

    Raises:
        EngineUnavailableError: Mitsuba is not installed, or cannot use the device.
    """

    name = "mitsuba"

    def __init__(self, device: Device = "cpu") -> None:
        chosen = probe_variant(device)
        if chosen.library is not None:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(chosen.library)
        import drjit as dr
        import mitsuba as mi

        mi.set_variant(chosen.variant)
        # Processes that compile the same kernel at the same time warn that another one has stored it first.
        dr.set_log_level(dr.LogLevel.Error)
        self.variant = chosen
        self._is_noted = False
        self._frames = 0
        self.version = engine_version(chosen)
        if chosen.variant == "scalar_rgb":
            from render.mitsuba_engine.scalar_tracer import ScalarTracer

            self._tracer: ScalarTracer | WavefrontTracer = ScalarTracer()
        else:
            from render.mitsuba_engine.wavefront_tracer import WavefrontTracer

            self._tracer = WavefrontTracer()

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes.

        Args:
            frame: what to render.
            settings: samples and depths.

        Raises:
            ValueError: the rig has lenses with distortion, which the scalar variant does not support.
        """
        if frame.rig.lenses is not None and self.variant.variant == "scalar_rgb":
            raise ValueError(f"rig: mitsuba as scalar_rgb draws ideal eyes only ({self.variant.reason}); use analytic")
        import mitsuba as mi

        # Another engine of this process may have set its own.
        mi.set_variant(self.variant.variant)
        self._limit_kernels()
        stage_s: dict[str, float] = {}
        started = time.process_time()
        background = backgrounds(frame)
        stage_s["sky"] = time.process_time() - started
        if not shows_surfaces(frame):
            return self._stereo({eye: _empty_eye(background[eye]) for eye in EYES}, 0.0, None, stage_s)
        ambient = environment_radiance(frame.environment)
        traced = self._tracer.trace(
            TraceRequest(frame=frame, settings=settings, ambient=ambient, background=background)
        )
        stage_s |= traced.stage_s
        started = time.process_time()
        for eye in EYES:
            seen, duplicate = traced.eyes[eye], traced.duplicates[eye]
            air, optical_depth_per_m = air_in_front(frame, eye, seen.pixel)
            seen.apply_air(air, optical_depth_per_m)
            seen.limit_edges(optical_depth_per_m)
            traced.duplicate_error[eye] *= duplicate.apply_air(*air_in_front(frame, eye, duplicate.pixel))
        if not self._is_noted:
            note_kernels(self.variant)
            self._is_noted = True
        noise = _noise(frame, traced, background)
        eyes = {eye: traced.eyes[eye].composite_over(background[eye]) for eye in EYES}
        stage_s["composite"] = time.process_time() - started
        return self._stereo(eyes, noise.fraction, noise.over_sensor, stage_s)

    def _limit_kernels(self) -> None:
        """Keep memory from growing with the number of frames."""
        import drjit as dr

        self._frames += 1
        if self._frames % _FRAMES_TO_KEEP_KERNELS == 0:
            dr.flush_kernel_cache()
            dr.flush_malloc_cache()

    def _stereo(
        self,
        eyes: dict[Eye, EyeRadiance],
        noise_fraction: float,
        noise_over_sensor: float | None,
        stage_s: dict[str, float],
    ) -> StereoRadiance:
        return StereoRadiance(
            left=eyes["left"],
            right=eyes["right"],
            engine=self.name,
            engine_version=self.version,
            monte_carlo_noise_fraction=noise_fraction,
            stage_s=stage_s,
            monte_carlo_over_sensor_noise=noise_over_sensor,
        )


def engine_version(chosen: Variant) -> str:
    """The engine down to its variant, and to the GPU and its driver, on which pixels depend too."""
    name = chosen.variant if chosen.gpu is None else f"{chosen.variant} ({chosen.gpu})"
    return f"mitsuba {version('mitsuba')} {name}, render version {RENDER_VERSION}"


def _noise(frame: FrameSpec, traced: TraceResult, background: dict[Eye, NDArray[np.float32]]) -> MonteCarloNoise:
    """Noise of the pixels whose centres see the drogue, edges included."""
    first, second, shared = [], [], []
    for eye in EYES:
        seen, duplicate = traced.eyes[eye], traced.duplicates[eye]
        row_of_pixel = np.zeros(seen.part_id.size, dtype=np.int64)
        row_of_pixel[seen.pixel] = np.arange(len(seen.pixel))
        of_drogue = DROGUE_PARTS[seen.part_id.reshape(-1)[duplicate.pixel]] > 0
        first.append(seen.composited_pixels(background[eye])[row_of_pixel[duplicate.pixel[of_drogue]]])
        second.append(duplicate.composited_pixels(background[eye])[of_drogue])
        shared.append(traced.duplicate_error[eye][of_drogue])
    return measure_noise(frame, np.concatenate(first), np.concatenate(second), np.concatenate(shared))


def _empty_eye(background: NDArray[np.float32]) -> EyeRadiance:
    shape = background.shape[:2]
    return EyeRadiance(
        radiance_cd_m2=background,
        coverage=np.zeros(shape, dtype=np.float32),
        part_id=np.zeros(shape, dtype=np.uint8),
        depth_m=np.full(shape, np.inf, dtype=np.float32),
        normal=np.zeros((*shape, 3), dtype=np.float32),
        amodal_px={},
    )
