"""Tracing with Mitsuba's LLVM variant: all rays are ours, so one compiled kernel serves every frame."""

from __future__ import annotations

import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings
from geometry.stereo import EYES, Eye
from render.mitsuba_engine.camera_rays import CameraRays
from render.mitsuba_engine.center_passes import CenterPasses
from render.mitsuba_engine.scene import DrogueScene, SceneCache
from render.mitsuba_engine.sun_sky_paths import trace_paths
from render.mitsuba_engine.traced import (
    Traced,
    TracedEye,
    inside_one_part,
    pixels_to_trace,
    settings_by_plan,
)
from render.motion import blur_px
from scenes.seeding import generator
from scenes.sky import REC709_LUMINANCE
from scenes.surroundings import Surroundings

# Lanes of one launch: bounds memory (about 300 bytes a lane) without costing speed.
_MOST_LANES = 2_000_000
_PLAN = ("drogue", "surround")


@dataclass(frozen=True, eq=False)
class _Samples:
    """Sums over the samples of each pixel: (P, 3) radiance, (P,) coverage, (P,) relative variance of the mean."""

    radiance: NDArray[np.float32]
    coverage: NDArray[np.float32]
    variance: NDArray[np.float32]


class LlvmTracer:
    """Holds the scene of the last drogue and the kernels."""

    def __init__(self) -> None:
        dr.set_thread_count(1)
        self._scenes = SceneCache()
        self._scene: DrogueScene

    def trace(self, frame: FrameSpec, settings: RenderSettings, around: Surroundings) -> Traced:
        """Passes and radiance of both eyes of a frame with a drogue."""
        assert frame.drogue is not None
        stage_s: dict[str, float] = {}
        started = time.process_time()
        self._scene = self._scenes.scene_of(frame, around)
        stage_s["scene"], started = time.process_time() - started, time.process_time()
        moves_px = blur_px(frame)
        times = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        eyes: dict[Eye, TracedEye] = {}
        plans: dict[Eye, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
        for eye in EYES:
            passes = CenterPasses(frame, eye, self._scene)
            seen = [passes.part_ids(moment) for moment in times]
            eyes[eye] = passes.traced_eye(*seen[0])
            plans[eye] = pixels_to_trace(
                [ids for ids, _ in seen], 1 + int(np.ceil(moves_px)), frame.drogue.marker_count
            )
        stage_s["passes"], started = time.process_time() - started, time.process_time()
        noise = self._trace_radiance(frame, settings, eyes, plans)
        stage_s["paths"] = time.process_time() - started
        return Traced(eyes, noise, stage_s)

    def _trace_radiance(
        self,
        frame: FrameSpec,
        settings: RenderSettings,
        eyes: dict[Eye, TracedEye],
        plans: dict[Eye, tuple[NDArray[np.int64], NDArray[np.int64]]],
    ) -> float:
        """Fill in the traced pixels of both eyes; returns the relative noise of the drogue's pixels."""
        seeds = generator(frame.seed, frame.frame_index, "mitsuba samples")
        assert frame.drogue is not None
        lit = frame.drogue.marker_luminance_cd_m2 > 0
        noise: list[NDArray[np.float32]] = []
        for eye in EYES:
            camera = CameraRays(frame, eye)
            parts = []
            for name, pixel, count, depth in zip(_PLAN, plans[eye], *settings_by_plan(settings), strict=True):
                samples = self._sample_pixels(camera, pixel, count, (depth, lit), seeds)
                parts.append((pixel, samples))
                if name == "drogue" and count > 1:
                    noise.append(samples.variance[inside_one_part(eyes[eye].part_id).reshape(-1)[pixel]])
            eyes[eye].pixel = np.concatenate([pixel for pixel, _ in parts])
            eyes[eye].radiance_cd_m2 = np.concatenate([samples.radiance for _, samples in parts])
            eyes[eye].coverage = np.concatenate([samples.coverage for _, samples in parts])
        everything = np.concatenate(noise) if noise else np.zeros(0, dtype=np.float32)
        return float(np.sqrt(everything.mean(dtype=np.float64))) if len(everything) else 1.0

    def _sample_pixels(
        self,
        camera: CameraRays,
        pixel: NDArray[np.int64],
        count: int,
        path: tuple[int, bool],
        seeds: np.random.Generator,
    ) -> _Samples:
        """Mean over `count` paths through random places of each pixel, at random times of the exposure.

        Args:
            camera: gives the rays.
            pixel: (P,) flat indices.
            count: paths a pixel.
            path: the longest path, and whether lamps are lit.
            seeds: draws the sampler's seeds.
        """
        radiance = np.empty((len(pixel), 3), dtype=np.float32)
        coverage = np.empty(len(pixel), dtype=np.float32)
        variance = np.zeros(len(pixel), dtype=np.float32)
        step = max(_MOST_LANES // count, 1)
        for first in range(0, len(pixel), step):
            part = slice(first, min(first + step, len(pixel)))
            seed = int(seeds.integers(2**31))
            sums = self._launch(camera, pixel[part], count, path, seed)
            radiance[part], coverage[part] = sums[:, :3] / count, sums[:, 3] / count
            if count > 1:
                luminance = np.einsum("pc,c->p", radiance[part], REC709_LUMINANCE.astype(np.float32))
                spread = np.maximum(sums[:, 4] / count - luminance**2, 0.0) / (count - 1)
                variance[part] = spread / np.maximum(luminance, 1e-6) ** 2
        return _Samples(radiance, coverage, variance)

    def _launch(
        self,
        camera: CameraRays,
        pixel: NDArray[np.int64],
        count: int,
        path: tuple[int, bool],
        seed: int,
    ) -> NDArray[np.float32]:
        """(P, 5) sums over the paths of each pixel: red, green, blue, coverage, squared luminance."""
        lanes = len(pixel) * count
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        # The multijitter sampler rounds its count to a product of two near-equal factors.
        if sampler.sample_count() != count:
            sampler = mi.load_dict({"type": "independent", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, lanes)
        of_pixel = dr.arange(mi.UInt32, lanes) // count
        ray = camera.rays(dr.gather(mi.UInt32, mi.UInt32(pixel), of_pixel), sampler.next_2d(), sampler.next_1d())
        color, hit = trace_paths(self._scene.scene, self._scene.sun, sampler, ray, path)
        luminance = dr.dot(mi.Vector3f(color), mi.Vector3f(REC709_LUMINANCE.tolist()))
        channels = [color[0], color[1], color[2], dr.select(hit, mi.Float(1.0), 0.0), dr.square(luminance)]
        # Without this every sum would trace the paths again.
        dr.eval(channels)
        return np.stack([np.array(dr.block_sum(channel, count)) for channel in channels], axis=-1)
