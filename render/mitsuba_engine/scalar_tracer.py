"""Tracing with Mitsuba's scalar variant, for machines without a usable LLVM: slower, through Mitsuba's own sensor."""

from __future__ import annotations

import time
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from render.mitsuba_engine.scene import DrogueScene, scene_key
from render.mitsuba_engine.traced import Traced, TracedEye, blur_px, pixels_to_trace, pose_polynomial
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
        self._key: str | None = None
        self._scene: DrogueScene

    def trace(self, frame: FrameSpec, settings: RenderSettings, around: Surroundings) -> Traced:
        """Passes and radiance of both eyes of a frame with a drogue."""
        assert frame.drogue is not None
        stage_s: dict[str, float] = {}
        started = time.process_time()
        if scene_key(frame) != self._key:
            self._scene, self._key = DrogueScene(frame.drogue, frame), scene_key(frame)
        self._scene.set_frame(frame, around)
        stage_s["scene"], started = time.process_time() - started, time.process_time()
        moves_px = blur_px(frame)
        moments = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        seeds = generator(frame.seed, frame.frame_index, "mitsuba samples")
        eyes: dict[Eye, TracedEye] = {}
        noise: list[float] = []
        for eye in EYES:
            view = _View(frame, eye)
            seen = [view.passes(self._scene.scene, moment) for moment in moments]
            alone, _, _ = view.passes(self._scene.features, 0.0)
            stage_s["passes"] = stage_s.get("passes", 0.0) + time.process_time() - started
            started = time.process_time()
            plans = pixels_to_trace(
                [part_id for part_id, _, _ in seen], 1 + int(np.ceil(moves_px)), frame.drogue.marker_count
            )
            eyes[eye] = _passes_of(seen[0], alone)
            noise += self._fill_radiance(eyes[eye], view, plans, settings, (frame, around, seeds, moves_px))
            stage_s["paths"] = stage_s.get("paths", 0.0) + time.process_time() - started
            started = time.process_time()
        return Traced(eyes, float(np.sqrt(np.mean(np.square(noise)))) if noise else 1.0, stage_s)

    def _fill_radiance(
        self,
        traced: TracedEye,
        view: _View,
        plans: tuple[NDArray[np.int64], NDArray[np.int64]],
        settings: RenderSettings,
        context: tuple[FrameSpec, Surroundings, np.random.Generator, float],
    ) -> list[float]:
        frame, around, seeds, moves_px = context
        slices = _STILL_SLICES if moves_px < 0.05 else _MOVING_SLICES
        chunks: list[tuple[NDArray[np.int64], NDArray[np.float32]]] = []
        noise: list[float] = []
        for pixel, samples in zip(plans, (settings.samples_per_px, settings.surround_samples_per_px), strict=True):
            if len(pixel) == 0:
                continue
            pictures = []
            for index in range(min(slices, samples)):
                # Samples that do not divide evenly go to the first slices.
                count = samples // min(slices, samples) + (index < samples % min(slices, samples))
                moment = (index + 0.5) / min(slices, samples) * 2 - 1 if moves_px >= 0.05 else 0.0
                rgba = view.radiance(
                    self._scene, (pixel, moment, count, settings.max_depth), int(seeds.integers(2**31))
                )
                pictures.append(rgba.reshape(-1, 4)[pixel])
            mean = np.mean(pictures, axis=0)
            if pixel is plans[0] and len(pictures) > 1 and moves_px < 0.05:
                noise.append(_relative_noise(pictures))
            chunks.append((pixel, _through_haze(mean, traced, pixel, frame, around)))
        if chunks:
            traced.pixel = np.concatenate([pixel for pixel, _ in chunks])
            values = np.concatenate([rgba for _, rgba in chunks])
            traced.radiance_cd_m2, traced.coverage = values[:, :3], values[:, 3]
        return noise


def _passes_of(
    seen: tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]], alone: NDArray[np.uint8]
) -> TracedEye:
    counts = np.bincount(alone.ravel(), minlength=256)
    amodal = {part: int(counts[part]) for part in (int(Part.HUB), *range(FIRST_MARKER_ID, 256)) if counts[part]}
    nothing = np.zeros(0, dtype=np.float32)
    return TracedEye(*seen, amodal, np.zeros(0, dtype=np.int64), nothing.reshape(0, 3), nothing)


def _relative_noise(pictures: list[NDArray[np.float32]]) -> float:
    """Relative standard error of the mean of two pictures, from the half difference of full pixels."""
    first, second = (picture[:, :3] @ REC709_LUMINANCE for picture in pictures[:2])
    full = (pictures[0][:, 3] > 0.999) & (first + second > 0)
    if not full.any():
        return 1.0
    relative = (first[full] - second[full]) / (first[full] + second[full])
    return float(np.sqrt(np.mean(relative**2)))


def _through_haze(
    rgba: NDArray[np.float32], traced: TracedEye, pixel: NDArray[np.int64], frame: FrameSpec, around: Surroundings
) -> NDArray[np.float32]:
    """The pixels behind the air between them and the camera; an edge pixel has the depth of its nearest neighbour."""
    nearest = cv2.erode(traced.depth_m, np.ones((5, 5), dtype=np.uint8)).reshape(-1)[pixel]
    clear = np.exp(-frame.environment.extinction_per_m * np.where(np.isfinite(nearest), nearest, 0.0))[:, None]
    hazed = rgba[:, :3] * clear + rgba[:, 3:] * around.horizon_radiance * (1.0 - clear)
    result: NDArray[np.float32] = np.concatenate([hazed, rgba[:, 3:]], axis=1).astype(np.float32)
    return result


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

    def passes(self, scene: Any, s: float) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
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
        depth = np.where(hit, (values[..., 1:4] - pose[:3, 3]) @ pose[:3, 2], np.inf).astype(np.float32)
        normal = np.where(hit[..., None], values[..., 4:] @ pose[:3, :3], 0.0).astype(np.float32)
        return part_id, depth, normal

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
