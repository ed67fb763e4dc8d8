"""Tracing with Mitsuba's LLVM variant: all rays are ours, so one compiled kernel serves every frame."""

from __future__ import annotations

import time

import cv2
import drjit as dr
import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import Part
from geometry.stereo import EYES, Eye
from render.camera.exposure_motion import blur_px
from render.compositing import InPicture, TracedEye
from render.mitsuba_engine.jit_arrays import reserve_numbers
from render.mitsuba_engine.paths.center_passes import CenterPasses
from render.mitsuba_engine.paths.context_paths import trace_around
from render.mitsuba_engine.paths.denoised_paths import SmoothedPaths
from render.mitsuba_engine.paths.drogue_paths import trace_paths
from render.mitsuba_engine.paths.rays import FrameRays, Sampled
from render.mitsuba_engine.scene import DrogueScene, SceneCache
from render.mitsuba_engine.trace_request import IN_OPEN, OF_DROGUE, Plan, ToTrace, Traced, parts_in, plan_pixels
from render.surfaces import dirty_parts


class LlvmTracer:
    """Holds the scene of the last drogue and the kernels."""

    def __init__(self) -> None:
        dr.set_thread_count(1)
        self._last_number = reserve_numbers()
        self._scenes = SceneCache()

    def trace(self, wanted: ToTrace) -> Traced:
        """Passes and radiance of both eyes."""
        frame = wanted.frame
        stage_s: dict[str, float] = {}
        started = time.process_time()
        scene = self._scenes.scene_of(frame, wanted.around)
        stage_s["scene"], started = time.process_time() - started, time.process_time()
        moves_px = blur_px(frame)
        times = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        eyes: dict[Eye, TracedEye] = {}
        plans: dict[Eye, Plan] = {}
        for eye in EYES:
            passes = CenterPasses(frame, eye, scene)
            seen = [passes.part_ids(moment) for moment in times]
            sunlit = [passes.sunlit(ids, moment) for (ids, _), moment in zip(seen, times, strict=True)]
            plans[eye] = plan_pixels([ids for ids, _ in seen], sunlit, 1 + int(np.ceil(moves_px)), dirty_parts(frame))
            eyes[eye] = passes.traced_eye(*seen[0])
        stage_s["passes"], started = time.process_time() - started, time.process_time()
        found = _sampled(wanted, scene, eyes, plans)
        size = frame.rig.camera.width_px * frame.rig.camera.height_px
        traced = Traced(
            {eye: eyes[eye].lit_by(*_of_eye(index, size, found.pixel, found.light)) for index, eye in enumerate(EYES)},
            {
                eye: eyes[eye].lit_by(*_of_eye(index, size, found.again, found.light_again))
                for index, eye in enumerate(EYES)
            },
            {eye: found.error_again[found.again // size == index] for index, eye in enumerate(EYES)},
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


def _sampled(wanted: ToTrace, scene: DrogueScene, eyes: dict[Eye, TracedEye], plans: dict[Eye, Plan]) -> Sampled:
    """What samples say, smoothed where that is asked for; light on a drogue only if all of it is matt."""
    frame, settings = wanted.frame, wanted.settings
    centers = _centers(eyes, plans)
    matt = frame.drogue is not None and frame.drogue.satin is None
    smoothed = settings.denoise and matt and any(len(pixel) > 0 for pixel in centers.values())
    in_open = IN_OPEN.copy()
    # Ribs have narrow sides that few centres see: what is smoothed had better vary little with the direction.
    in_open[Part.RIBS] = smoothed
    rays, moves_px = FrameRays(frame, scene, wanted.around, in_open), blur_px(frame)
    if smoothed:
        assert frame.left_from_drogue is not None
        px_per_m = frame.rig.camera.fx_px / float(frame.left_from_drogue.translation_m[2])
        picture = InPicture(frame, eyes, wanted.behind)
        found = SmoothedPaths(rays, settings, px_per_m, moves_px).trace(plans, centers, picture)
    else:
        found = trace_paths(rays, plans, settings)
    pixel, met = rays.of_both(plans, "surround"), np.concatenate([eyes[eye].part_id.reshape(-1) > 0 for eye in EYES])
    return found.beside(pixel, trace_around(rays, pixel, met, settings, moves_px))


def _centers(eyes: dict[Eye, TracedEye], plans: dict[Eye, Plan]) -> dict[str, NDArray[np.int64]]:
    """Pixels of both eyes whose centres see something, on the drogue and around its edges, by `IN_OPEN`."""
    found: dict[str, list[NDArray[np.int64]]] = {"open": [], "hidden": []}
    for index, eye in enumerate(EYES):
        part_id = eyes[eye].part_id
        near = np.zeros(part_id.shape, dtype=np.uint8)
        for kind in ("edges", "deep_edges"):
            near.reshape(-1)[getattr(plans[eye], kind)] = 1
        # A ray looks for its light at the centres of the nine nearest pixels.
        near = cv2.dilate(near, np.ones((3, 3), dtype=np.uint8))
        met = ((near > 0) & (part_id > 0)) | parts_in(part_id, OF_DROGUE)
        in_open = parts_in(part_id, IN_OPEN)
        found["open"].append(np.flatnonzero(met & in_open) + index * part_id.size)
        found["hidden"].append(np.flatnonzero(met & ~in_open) + index * part_id.size)
    return {kind: np.concatenate(pixels) for kind, pixels in found.items()}
