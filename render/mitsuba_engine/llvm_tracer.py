"""Tracing with Mitsuba's LLVM variant: every ray is generated here, so that one compiled kernel serves every frame."""

from __future__ import annotations

import time

import cv2
import drjit as dr
import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import Part
from geometry.stereo import EYES, Eye
from render.camera.exposure_motion import motion_blur_px
from render.compositing import Compositor, TracedEye
from render.mitsuba_engine.jit_arrays import reserve_registry
from render.mitsuba_engine.paths.center_passes import CenterPasses
from render.mitsuba_engine.paths.context_paths import trace_context
from render.mitsuba_engine.paths.denoised_paths import DenoisedPaths
from render.mitsuba_engine.paths.drogue_paths import trace_paths
from render.mitsuba_engine.paths.rays import FrameRays, SampledLight
from render.mitsuba_engine.scene import DrogueScene, SceneCache
from render.mitsuba_engine.trace_request import (
    DROGUE_PARTS,
    OPEN_TO_SKY,
    SamplingPlan,
    TraceRequest,
    TraceResult,
    parts_in,
    plan_pixels,
)
from render.surfaces import dirty_parts


class LlvmTracer:
    """Keeps the scenes of recent drogues and the compiled kernels."""

    def __init__(self) -> None:
        dr.set_thread_count(1)
        self._last_number = reserve_registry()
        self._scenes = SceneCache()

    def trace(self, request: TraceRequest) -> TraceResult:
        """Passes and radiance of both eyes."""
        frame = request.frame
        stage_s: dict[str, float] = {}
        started = time.process_time()
        scene = self._scenes.scene_of(frame, request.ambient)
        stage_s["scene"], started = time.process_time() - started, time.process_time()
        moves_px = motion_blur_px(frame)
        times = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        eyes: dict[Eye, TracedEye] = {}
        plans: dict[Eye, SamplingPlan] = {}
        for eye in EYES:
            passes = CenterPasses(frame, eye, scene)
            seen = [passes.part_ids(s) for s in times]
            sunlit = [passes.sunlit(ids, s) for (ids, _), s in zip(seen, times, strict=True)]
            plans[eye] = plan_pixels([ids for ids, _ in seen], sunlit, 1 + int(np.ceil(moves_px)), dirty_parts(frame))
            eyes[eye] = passes.traced_eye(*seen[0])
        stage_s["passes"], started = time.process_time() - started, time.process_time()
        result = _by_eye(_sample_light(request, scene, eyes, plans), eyes, stage_s)
        stage_s["paths"] = time.process_time() - started
        return result


def _by_eye(sampled: SampledLight, eyes: dict[Eye, TracedEye], stage_s: dict[str, float]) -> TraceResult:
    """The samples of both eyes, separated by eye; the right eye's flat indices come after all of the left's."""
    lit, duplicates, errors = {}, {}, {}
    for index, eye in enumerate(EYES):
        size = eyes[eye].part_id.size
        own, own_duplicates = sampled.pixel // size == index, sampled.duplicate_pixel // size == index
        lit[eye] = eyes[eye].with_light(sampled.pixel[own] - index * size, sampled.light[own])
        duplicates[eye] = eyes[eye].with_light(
            sampled.duplicate_pixel[own_duplicates] - index * size, sampled.duplicate_light[own_duplicates]
        )
        errors[eye] = sampled.duplicate_error[own_duplicates]
    return TraceResult(eyes=lit, duplicates=duplicates, duplicate_error=errors, stage_s=stage_s)


def _sample_light(
    request: TraceRequest, scene: DrogueScene, eyes: dict[Eye, TracedEye], plans: dict[Eye, SamplingPlan]
) -> SampledLight:
    """Sampled light of all planned pixels; denoised where the settings ask for it and all of the drogue is matt."""
    frame, settings = request.frame, request.settings
    centers = _center_pixels(eyes, plans)
    matt = frame.drogue is not None and frame.drogue.satin is None
    denoise = settings.denoise and matt and any(len(pixel) > 0 for pixel in centers.values())
    open_to_sky = OPEN_TO_SKY.copy()
    # Few centres see the narrow sides of ribs: what is smoothed over them should vary little with the direction.
    open_to_sky[Part.RIBS] = denoise
    rays, moves_px = FrameRays(frame, scene, request.ambient, open_to_sky), motion_blur_px(frame)
    if denoise:
        assert frame.left_from_drogue is not None
        px_per_m = frame.rig.camera.fx_px / float(frame.left_from_drogue.translation_m[2])
        compositor = Compositor(frame=frame, eyes=eyes, background=request.background)
        sampled = DenoisedPaths(rays, settings, px_per_m, moves_px).trace(plans, centers, compositor)
    else:
        sampled = trace_paths(rays, plans, settings)
    pixel = rays.pixels_of_both_eyes(plans, "context")
    covered = np.concatenate([eyes[eye].part_id.reshape(-1) > 0 for eye in EYES])
    return sampled.with_pixels(pixel, trace_context(rays, pixel, covered, settings, moves_px))


def _center_pixels(eyes: dict[Eye, TracedEye], plans: dict[Eye, SamplingPlan]) -> dict[str, NDArray[np.int64]]:
    """Pixels of both eyes whose centres see something, on the drogue and around its edges.

    Returns:
        Flat indices by "open" and "hidden": whether most of the sky is visible from the part (`OPEN_TO_SKY`).
    """
    centers: dict[str, list[NDArray[np.int64]]] = {"open": [], "hidden": []}
    for index, eye in enumerate(EYES):
        part_id = eyes[eye].part_id
        near = np.zeros(part_id.shape, dtype=np.uint8)
        for kind in ("edges", "deep_edges"):
            near.reshape(-1)[getattr(plans[eye], kind)] = 1
        # A ray looks up its light at the centres of the nine nearest pixels.
        near = cv2.dilate(near, np.ones((3, 3), dtype=np.uint8))
        chosen = ((near > 0) & (part_id > 0)) | parts_in(part_id, DROGUE_PARTS)
        is_open = parts_in(part_id, OPEN_TO_SKY)
        centers["open"].append(np.flatnonzero(chosen & is_open) + index * part_id.size)
        centers["hidden"].append(np.flatnonzero(chosen & ~is_open) + index * part_id.size)
    return {kind: np.concatenate(pixels) for kind, pixels in centers.items()}
