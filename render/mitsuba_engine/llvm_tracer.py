"""Tracing with Mitsuba's LLVM variant: all rays are ours, so one compiled kernel serves every frame."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings
from geometry.stereo import EYES, Eye
from render.mitsuba_engine.camera_rays import CameraRays
from render.mitsuba_engine.center_passes import CenterPasses
from render.mitsuba_engine.noise import TWICE_EVERY
from render.mitsuba_engine.scene import DrogueScene, SceneCache, by_shape
from render.mitsuba_engine.sky_irradiance import SkyIrradiance, as_mitsuba_reads
from render.mitsuba_engine.sun_sky_paths import Lights, trace_first, trace_rest
from render.mitsuba_engine.traced import IN_OPEN, SURROUND_DEPTH, Plan, Traced, TracedEye, plan_pixels
from render.motion import blur_px
from scenes.seeding import generator
from scenes.surroundings import Surroundings

# Lanes of one launch: bounds memory (about 300 bytes a lane) without costing speed.
_MOST_LANES = 2_000_000


@dataclass(frozen=True, eq=False)
class _Job:
    """Pixels that are traced alike.

    Attributes:
        pixel: (P,) flat indices; those of the right eye come after all of the left.
        count: samples a pixel.
        max_depth: longest path in segments; 1 leaves out the light that comes by way of other surfaces.
    """

    pixel: NDArray[np.int64]
    count: int
    max_depth: int


@dataclass(frozen=True, eq=False)
class _Light:
    """Means over the samples of each pixel: what `trace_first` and `trace_rest` give, and coverage; (P, 3|3|1)."""

    first: NDArray[np.float32]
    rest: NDArray[np.float32]
    coverage: NDArray[np.float32]

    def seen(self) -> NDArray[np.float32]:
        """(P, 4) radiance and coverage."""
        # The rest of a dark pixel can come out below the first part's zero.
        return np.concatenate([np.maximum(self.first + self.rest, 0.0), self.coverage], axis=1)

    def with_first_of(self, other: _Light) -> _Light:
        """The same with what more samples say of the first surfaces."""
        return _Light(other.first, self.rest, other.coverage)

    def __getitem__(self, part: slice) -> _Light:
        return _Light(self.first[part], self.rest[part], self.coverage[part])


class LlvmTracer:
    """Holds the scene of the last drogue and the kernels."""

    def __init__(self) -> None:
        dr.set_thread_count(1)
        self._scenes = SceneCache()

    def trace(self, frame: FrameSpec, settings: RenderSettings, around: Surroundings) -> Traced:
        """Passes and radiance of both eyes of a frame with a drogue."""
        stage_s: dict[str, float] = {}
        started = time.process_time()
        scene = self._scenes.scene_of(frame, around)
        stage_s["scene"], started = time.process_time() - started, time.process_time()
        moves_px = blur_px(frame)
        times = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        eyes: dict[Eye, TracedEye] = {}
        plans: dict[Eye, Plan] = {}
        for eye in EYES:
            passes = CenterPasses(frame, eye, scene)
            seen = [passes.part_ids(moment) for moment in times]
            sunlit = [passes.sunlit(ids, moment) for (ids, _), moment in zip(seen, times, strict=True)]
            plans[eye] = plan_pixels([ids for ids, _ in seen], sunlit, 1 + int(np.ceil(moves_px)))
            eyes[eye] = passes.traced_eye(*seen[0])
        stage_s["passes"], started = time.process_time() - started, time.process_time()
        pixel, light, again, light_again = _Launches(frame, scene, around).radiance(plans, settings)
        size = frame.rig.camera.width_px * frame.rig.camera.height_px
        traced = Traced(
            {eye: eyes[eye].lit_by(*_of_eye(index, size, pixel, light)) for index, eye in enumerate(EYES)},
            {eye: eyes[eye].lit_by(*_of_eye(index, size, again, light_again)) for index, eye in enumerate(EYES)},
            stage_s,
        )
        stage_s["paths"] = time.process_time() - started
        return traced


def _of_eye(
    index: int, size: int, pixel: NDArray[np.int64], light: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """One eye's part of the pixels of both, with its own indices."""
    own = pixel // size == index
    return pixel[own] - index * size, light[own]


class _Launches:
    """Sends the rays of one frame, those of both eyes together."""

    def __init__(self, frame: FrameSpec, scene: DrogueScene, around: Surroundings) -> None:
        self._scene = scene.scene
        self._cameras = [CameraRays(frame, eye) for eye in EYES]
        self._size = frame.rig.camera.width_px * frame.rig.camera.height_px
        self._seeds = generator(frame.seed, frame.frame_index, "mitsuba samples")
        to_sun, sun_lux = scene.sun
        world_from_stage = frame.world_from_left @ frame.left_from_stage_at(0.0)
        self._lights = Lights(
            to_sun,
            sun_lux,
            SkyIrradiance(as_mitsuba_reads(around.light_map), world_from_stage.rotation),
            mi.Float(by_shape(scene.scene, IN_OPEN)),
            frame.drogue is not None and frame.drogue.marker_luminance_cd_m2 > 0,
        )

    def radiance(
        self, plans: dict[Eye, Plan], settings: RenderSettings
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """Trace all planned pixels, and some of the drogue's once more.

        Returns:
            (P,) pixels of both eyes and their (P, 4) radiance and coverage; the same for what was traced again.
        """
        opened, sheltered, deep, edges, surround = (
            np.concatenate([getattr(plans[eye], kind) + index * self._size for index, eye in enumerate(EYES)])
            for kind in ("open", "sheltered", "deep", "edges", "surround")
        )
        depth, count = settings.max_depth, settings.samples_per_px
        fine = max(count, settings.edge_samples_per_px)
        of_open = self._trace(_Job(_and_some_again(opened), settings.open_samples_per_px, depth))
        of_sheltered = self._trace(_Job(_and_some_again(sheltered), count, depth))
        of_deep = self._trace(_Job(_and_some_again(deep), fine, depth))
        of_edges = self._trace(_Job(_and_some_again(edges), count, depth))
        if fine > count:
            of_edges = of_edges.with_first_of(self._trace(_Job(_and_some_again(edges), fine, 1)))
        of_surround = self._trace(_Job(surround, settings.surround_samples_per_px, SURROUND_DEPTH))
        twice = [(opened, of_open), (sheltered, of_sheltered), (deep, of_deep), (edges, of_edges)]
        parts = [*twice, (surround, of_surround)]
        return (
            np.concatenate([pixel for pixel, _ in parts]),
            np.concatenate([light[: len(pixel)].seen() for pixel, light in parts]),
            np.concatenate([pixel[::TWICE_EVERY] for pixel, _ in twice]),
            np.concatenate([light[len(pixel) :].seen() for pixel, light in twice]),
        )

    def _trace(self, job: _Job) -> _Light:
        """Means over paths through random places of each pixel, at random times of the exposure."""
        result = np.zeros((len(job.pixel), 7), dtype=np.float32)
        step = max(_MOST_LANES // job.count, 1)
        for first in range(0, len(job.pixel), step):
            part = slice(first, first + step)
            result[part] = self._launch(job.pixel[part], job, int(self._seeds.integers(2**31)))
        return _Light(result[:, :3], result[:, 4:], result[:, 3:4])

    def _launch(self, pixel: NDArray[np.int64], job: _Job, seed: int) -> NDArray[np.float32]:
        """(P, 7) means over the paths of each pixel: light of first surfaces, coverage, rest of the light."""
        lanes = len(pixel) * job.count
        sampler = mi.load_dict({"type": "multijitter", "sample_count": job.count})
        # The multijitter sampler rounds its count to a product of two near-equal factors.
        if sampler.sample_count() != job.count:
            sampler = mi.load_dict({"type": "independent", "sample_count": job.count})
        sampler.set_samples_per_wavefront(job.count)
        sampler.seed(seed, lanes)
        of_pixel = dr.arange(mi.UInt32, lanes) // job.count
        ray = self._rays(dr.gather(mi.UInt32, mi.UInt32(pixel), of_pixel), sampler)
        first, hit, surface, known = trace_first(self._scene, self._lights, ray)
        channels = [*first, dr.select(hit, mi.Float(1.0), 0.0)]
        if job.max_depth > 1:
            channels += [*trace_rest(self._scene, self._lights, sampler, (surface, hit, known), job.max_depth)]
        # Without this every sum would trace the paths again.
        dr.eval(channels)
        sums = np.zeros((len(pixel), 7), dtype=np.float32)
        for index, channel in enumerate(channels):
            sums[:, index] = np.array(dr.block_sum(channel, job.count))
        return sums / np.float32(job.count)

    def _rays(self, pixel: Any, sampler: Any) -> Any:
        """Rays of either eye, whichever the pixels belong to."""
        place, moment = sampler.next_2d(), sampler.next_1d()
        is_right = pixel >= self._size
        left, right = (
            camera.rays(dr.select(is_right, pixel - self._size, pixel), place, moment) for camera in self._cameras
        )
        return mi.Ray3f(dr.select(is_right, right.o, left.o), dr.select(is_right, right.d, left.d))


def _and_some_again(pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([pixel, pixel[::TWICE_EVERY]])
