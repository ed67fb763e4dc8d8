"""Tracing with Mitsuba's scalar variant, for machines without a usable LLVM: slower, through Mitsuba's own sensor."""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from render.mitsuba_engine.scene import DrogueScene, SceneCache
from render.mitsuba_engine.traced import (
    ASIDE,
    Traced,
    TracedEye,
    amodal_counts,
    inside_one_part,
    pixels_to_trace,
    settings_by_plan,
)
from render.motion import blur_px, pose_polynomial
from scenes.seeding import generator
from scenes.sky import REC709_LUMINANCE
from scenes.surroundings import Surroundings

# Motion is rendered as so many still pictures; two are enough for the noise estimate of a still scene.
_MOVING_SLICES, _STILL_SLICES = 8, 2
_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


class ScalarTracer:
    """Holds the scene of the last drogue."""

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
        moments = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        seeds = generator(frame.seed, frame.frame_index, "mitsuba samples")
        eyes: dict[Eye, TracedEye] = {}
        noise: list[float] = []
        for eye in EYES:
            view = _View(frame, eye)
            seen = [view.passes(self._scene.scene, moment) for moment in moments]
            alone = view.passes(self._scene.features, 0.0)
            stage_s["passes"] = stage_s.get("passes", 0.0) + time.process_time() - started
            started = time.process_time()
            plans = pixels_to_trace(
                [part_id for part_id, _, _ in seen], 1 + int(np.ceil(moves_px)), frame.drogue.marker_count
            )
            eyes[eye] = _passes_of(seen[0], alone)
            noise += self._fill_radiance(eyes[eye], view, plans, settings, (seeds, moves_px))
            stage_s["paths"] = stage_s.get("paths", 0.0) + time.process_time() - started
            started = time.process_time()
        return Traced(eyes, float(np.sqrt(np.mean(np.square(noise)))) if noise else 1.0, stage_s)

    def _fill_radiance(
        self,
        traced: TracedEye,
        view: _View,
        plans: tuple[NDArray[np.int64], NDArray[np.int64]],
        settings: RenderSettings,
        context: tuple[np.random.Generator, float],
    ) -> list[float]:
        """Trace the planned pixels; returns the relative noise of the drogue's pixels where it can be told."""
        seeds, moves_px = context
        slices = _STILL_SLICES if moves_px < 0.05 else _MOVING_SLICES
        chunks: list[tuple[NDArray[np.int64], NDArray[np.float32]]] = []
        noise: list[float] = []
        for pixel, samples, depth in zip(plans, *settings_by_plan(settings), strict=True):
            if len(pixel) == 0:
                continue
            pictures = []
            for index in range(min(slices, samples)):
                # Samples that do not divide evenly go to the first slices.
                count = samples // min(slices, samples) + (index < samples % min(slices, samples))
                moment = (index + 0.5) / min(slices, samples) * 2 - 1 if moves_px >= 0.05 else 0.0
                rgba = view.radiance(self._scene, (pixel, moment, count, depth), int(seeds.integers(2**31)))
                pictures.append(rgba.reshape(-1, 4)[pixel])
            mean = np.mean(pictures, axis=0)
            if pixel is plans[0] and len(pictures) > 1 and moves_px < 0.05:
                noise.append(_relative_noise(pictures, inside_one_part(traced.part_id).reshape(-1)[pixel]))
            chunks.append((pixel, mean.astype(np.float32)))
        if chunks:
            traced.pixel = np.concatenate([pixel for pixel, _ in chunks])
            values = np.concatenate([rgba for _, rgba in chunks])
            traced.radiance_cd_m2, traced.coverage = values[:, :3], values[:, 3]
        return noise


_Passes = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]


def _passes_of(seen: _Passes, alone: _Passes) -> TracedEye:
    amodal = amodal_counts(seen[0], seen[1], alone[0], alone[1])
    nothing = np.zeros(0, dtype=np.float32)
    return TracedEye(*seen, amodal, np.zeros(0, dtype=np.int64), nothing.reshape(0, 3), nothing)


def _relative_noise(pictures: list[NDArray[np.float32]], inside: NDArray[np.bool_]) -> float:
    """Relative standard error of the mean of two pictures, from their half difference inside parts."""
    first, second = (np.einsum("pc,c->p", picture[:, :3], REC709_LUMINANCE) for picture in pictures[:2])
    full = inside & (first + second > 0)
    if not full.any():
        return 1.0
    relative = (first[full] - second[full]) / (first[full] + second[full])
    return float(np.sqrt(np.mean(relative**2)))


class _View:
    """One eye as a Mitsuba sensor."""

    def __init__(self, frame: FrameSpec, eye: Eye) -> None:
        self._camera = frame.rig.camera
        self._pose = pose_polynomial(frame, eye)
        self._emits = frame.drogue is not None and frame.drogue.marker_luminance_cd_m2 > 0

    def _drogue_from_eye(self, s: float) -> Array:
        """(4, 4) pose at time s of the exposure, from -1 to 1."""
        pose = np.eye(4)
        pose[:3] = self._pose[0] + s * (self._pose[1] + s * self._pose[2])
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ vt
        return pose

    def _sensor(self, s: float, sampler: dict[str, Any], pixel_format: str, crop: dict[str, int]) -> Any:
        camera = self._camera
        to_world = self._drogue_from_eye(s) @ _MITSUBA_FROM_OPENCV
        return mi.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(np.degrees(2 * np.arctan(camera.width_px / (2 * camera.fx_px)))),
                "principal_point_offset_x": 0.5 - (camera.cx_px + 0.5) / camera.width_px,
                "principal_point_offset_y": 0.5 - (camera.cy_px + 0.5) / camera.height_px,
                "near_clip": 0.01,
                "far_clip": 1e4,
                "to_world": mi.ScalarTransform4f(to_world.tolist()),
                "sampler": sampler,
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width_px,
                    "height": camera.height_px,
                    "pixel_format": pixel_format,
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                    **crop,
                },
            }
        )

    def passes(self, scene: Any, s: float) -> _Passes:
        """Part ids, planar depth and normals along the rays through the pixel centres."""
        center_sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
        sensor = self._sensor(s, center_sampler, "rgb", {})
        integrator = mi.load_dict({"type": "aov", "aovs": "id:shape_index,p:position,n:geo_normal"})
        values = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=1, seed=0))[..., -7:]
        # The integrator counts shapes from 1; 0 is no shape.
        table = np.array([0, *(int(shape.id().removeprefix("part_")) for shape in scene.shapes())], dtype=np.uint8)
        part_id: NDArray[np.uint8] = table[values[..., 0].astype(np.int64)]
        hit = part_id > 0
        pose = self._drogue_from_eye(s)
        self._mend_leaks(scene, pose, (part_id, values))
        depth = np.where(hit, np.einsum("...i,i->...", values[..., 1:4] - pose[:3, 3], pose[:3, 2]), np.inf).astype(
            np.float32
        )
        normal = np.where(hit[..., None], np.einsum("...i,ij->...j", values[..., 4:], pose[:3, :3]), 0.0).astype(
            np.float32
        )
        return part_id, depth, normal

    def _mend_leaks(self, scene: Any, pose: Array, passes: tuple[NDArray[np.uint8], NDArray[np.float32]]) -> None:
        """Look again, a little aside, where a ray slipped between two triangles into a closed part."""
        part_id, values = passes
        towards = values[..., 1:4] - pose[:3, 3]
        for v, u in np.argwhere((part_id > 0) & ((values[..., 4:] * towards).sum(axis=-1) > 0)):
            for place in ASIDE:
                ray_px = np.array([u + place[0] - 0.5, v + place[1] - 0.5])
                direction = pose[:3, :3] @ self._camera.rays(ray_px)
                direction /= np.linalg.norm(direction)
                hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(pose[:3, 3].tolist()), mi.Vector3f(direction.tolist())))
                if hit.is_valid() and np.array(hit.n) @ direction < 0:
                    part_id[v, u] = int(hit.shape.id().removeprefix("part_"))
                    values[v, u, 1:] = [*hit.p, *hit.n]
                    break

    def radiance(
        self, scene: DrogueScene, what: tuple[NDArray[np.int64], float, int, int], seed: int
    ) -> NDArray[np.float32]:
        """(H, W, 4) light from parts, weighted by coverage, and coverage.

        Args:
            scene: what to render.
            what: flat pixel indices that matter, time of the exposure, samples a pixel, longest path.
            seed: of the sampler.
        """
        pixel, s, count, max_depth = what
        rows, columns = np.divmod(pixel, self._camera.width_px)
        top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
        crop = {
            "crop_offset_x": int(left),
            "crop_offset_y": int(top),
            "crop_width": int(right - left),
            "crop_height": int(bottom - top),
        }
        sensor = self._sensor(s, {"type": "independent", "sample_count": count}, "rgba", crop)
        path = {"type": "path", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True}
        total = np.zeros((self._camera.height_px, self._camera.width_px, 4), dtype=np.float32)
        window = total[top:bottom, left:right]
        window[:] = np.array(mi.render(scene.scene, sensor=sensor, integrator=mi.load_dict(path), spp=count, seed=seed))
        if self._emits:
            # Hidden emitters come out black: their own light is added from a render of the features alone.
            direct = {"type": "path", "max_depth": 1}
            lit = mi.render(scene.features, sensor=sensor, integrator=mi.load_dict(direct), spp=count, seed=seed)
            window[..., :3] += np.array(lit)[..., :3]
        return total
