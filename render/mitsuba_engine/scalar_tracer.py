"""Tracing with Mitsuba's scalar variant and its own sensor, for machines without a usable LLVM library; slower."""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from render.camera.exposure_motion import motion_blur_px, pose_polynomial, receiver_pixels
from render.compositing import TracedEye, amodal_counts
from render.hidden_features import add_hidden_centers
from render.mitsuba_engine.scene import DrogueScene, SceneCache
from render.mitsuba_engine.trace_request import (
    CONTEXT_DEPTH,
    DROGUE_PARTS,
    OFF_CENTER,
    SamplingPlan,
    TraceRequest,
    TraceResult,
    leaked_rays,
    plan_pixels,
)

# Motion blur is the mean of so many still images.
_MOVING_SLICES = 8
_TILE_PX = 32
_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


class ScalarTracer:
    """Keeps the scenes of recent drogues."""

    def __init__(self) -> None:
        dr.set_thread_count(1)
        self._scenes = SceneCache()

    def trace(self, request: TraceRequest) -> TraceResult:
        """Passes and radiance of both eyes."""
        frame, settings = request.frame, request.settings
        stage_s = {"scene": 0.0, "passes": 0.0, "paths": 0.0}
        started = time.process_time()
        scene = self._scenes.scene_of(frame, request.ambient)
        stage_s["scene"], started = time.process_time() - started, time.process_time()
        moves_px = motion_blur_px(frame)
        times = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        seeds = frame_generator(frame.seed, frame.frame_index, "mitsuba samples")
        eyes: dict[Eye, TracedEye] = {}
        duplicates: dict[Eye, TracedEye] = {}
        for eye in EYES:
            view = _View(frame, eye)
            seen = [view.passes(scene.scene, s) for s in times]
            view.held = view.receiver_pixels(frame, eye, seen[0])
            for part_id, depth, normal in seen[1:]:
                part_id[view.held], depth[view.held] = seen[0][0][view.held], seen[0][1][view.held]
                normal[view.held] = seen[0][2][view.held]
            sunlit = [view.sunlit(scene, passes, s) for (passes, s) in zip(seen, times, strict=True)]
            alone = view.passes(scene.features, 0.0)
            plan = plan_pixels(
                [part_id for part_id, _, _ in seen], sunlit, 1 + int(np.ceil(moves_px)), scene.uneven_parts
            )
            stage_s["passes"], started = stage_s["passes"] + time.process_time() - started, time.process_time()
            slices = _MOVING_SLICES if moves_px >= 0.05 else 1
            halves = [_Half(view, scene, slices, seeds).light(plan, settings) for _ in range(2)]
            traced, pixel = _untraced_eye(seen[0], alone), _in_order(plan)
            ids = alone[0].reshape(-1)
            traced.amodal_px = add_hidden_centers(
                traced.amodal_px, frame, eye, scene.triangles_m, (np.arange(ids.size), ids)
            )
            mean, difference = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / np.float32(np.sqrt(2))
            eyes[eye] = traced.with_light(pixel, mean)
            # Differs from the mean by as much as two independent means of so many samples would.
            duplicates[eye] = traced.with_light(pixel, mean + difference)
            stage_s["paths"], started = stage_s["paths"] + time.process_time() - started, time.process_time()
        no_error = {eye: np.zeros((len(duplicates[eye].pixel), 3), dtype=np.float32) for eye in EYES}
        return TraceResult(eyes=eyes, duplicates=duplicates, duplicate_error=no_error, stage_s=stage_s)


def _in_order(plan: SamplingPlan) -> NDArray[np.int64]:
    return np.concatenate([plan.open, plan.sheltered, plan.deep, plan.deep_edges, plan.edges, plan.context])


class _Half:
    """Traces the planned pixels of one eye with half the samples."""

    def __init__(self, view: _View, scene: DrogueScene, slices: int, seeds: np.random.Generator) -> None:
        self._view, self._scene, self._slices, self._seeds = view, scene, slices, seeds

    def light(self, plan: SamplingPlan, settings: RenderSettings) -> NDArray[np.float32]:
        """(P, 4) radiance and coverage of the pixels in the order of `_in_order`.

        Mitsuba's integrator uses no known light of the sky, so that parts in the open take as many paths as others.
        """
        base = np.concatenate([plan.open, plan.sheltered])
        fine = np.concatenate([plan.deep, plan.deep_edges, plan.edges])
        fine_count = max(settings.samples_per_px, settings.edge_samples_per_px)
        at_fine = np.zeros((len(fine), 4), dtype=np.float32)
        for tile in self._view.tiles(fine):
            at_fine[tile] = self._mean(fine[tile], fine_count, settings.max_depth)
        return np.concatenate(
            [
                self._mean(base, settings.samples_per_px, settings.max_depth),
                at_fine,
                self._mean(plan.context, settings.surround_samples_per_px, CONTEXT_DEPTH),
            ]
        )

    def _mean(self, pixel: NDArray[np.int64], samples: int, max_depth: int) -> NDArray[np.float32]:
        """Mean over the slices of the exposure; each slice takes at least one sample."""
        if not len(pixel):
            return np.zeros((0, 4), dtype=np.float32)
        count = -(-samples // (2 * self._slices))
        total = np.zeros((len(pixel), 4), dtype=np.float32)
        held = self._view.held.reshape(-1)[pixel]
        for index in range(self._slices):
            moment = (index + 0.5) / self._slices * 2 - 1
            seed = int(self._seeds.integers(2**31))
            for s, rows in ((moment, np.flatnonzero(~held)), (0.0, np.flatnonzero(held))):
                if len(rows):
                    total[rows] += self._view.radiance(self._scene, (pixel[rows], s, count, max_depth), seed)
        return total / np.float32(self._slices)


_Passes = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]


def _untraced_eye(seen: _Passes, alone: _Passes) -> TracedEye:
    part_id, depth_m, normal = seen
    amodal = amodal_counts(part_id, depth_m, alone[0], alone[1])
    return TracedEye.untraced(part_id=part_id, depth_m=depth_m, normal=normal, amodal_px=amodal)


class _View:
    """One eye as a Mitsuba sensor.

    Attributes:
        held: (H, W) pixels in which only what is there at mid-exposure is seen.
    """

    def __init__(self, frame: FrameSpec, eye: Eye) -> None:
        self._camera = frame.rig.camera
        self.held = np.zeros((self._camera.height_px, self._camera.width_px), dtype=np.bool_)
        self._pose = pose_polynomial(frame, eye)

    def _stage_from_eye(self, s: float) -> Array:
        """(4, 4) pose at time s of the exposure, from -1 to 1."""
        pose = np.eye(4)
        pose[:3] = self._pose[0] + s * (self._pose[1] + s * self._pose[2])
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ vt
        return pose

    def _sensor(self, s: float, sampler: dict[str, Any], pixel_format: str, crop: dict[str, int]) -> Any:
        camera = self._camera
        to_world = self._stage_from_eye(s) @ _MITSUBA_FROM_OPENCV
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
        table = np.array([0, *(int(shape.id().split("_")[1]) for shape in scene.shapes())], dtype=np.uint8)
        part_id: NDArray[np.uint8] = table[values[..., 0].astype(np.int64)]
        pose = self._stage_from_eye(s)
        self._repair_leaks(scene, pose, (part_id, values))
        hit = part_id > 0
        depth = np.where(hit, np.einsum("...i,i->...", values[..., 1:4] - pose[:3, 3], pose[:3, 2]), np.inf).astype(
            np.float32
        )
        normal = np.where(hit[..., None], np.einsum("...i,ij->...j", values[..., 4:], pose[:3, :3]), 0.0).astype(
            np.float32
        )
        return part_id, depth, normal

    def _repair_leaks(self, scene: Any, pose: Array, passes: tuple[NDArray[np.uint8], NDArray[np.float32]]) -> None:
        """Trace again, a little off centre, where a ray leaked between two triangles into a closed part."""
        part_id, values = passes
        towards = values[..., 1:4] - pose[:3, 3]
        for v, u in np.argwhere(leaked_rays(part_id, values[..., 4:], towards)):
            for place in OFF_CENTER:
                ray_px = np.array([u + place[0] - 0.5, v + place[1] - 0.5])
                direction = pose[:3, :3] @ self._camera.rays(ray_px)
                direction /= np.linalg.norm(direction)
                hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(pose[:3, 3].tolist()), mi.Vector3f(direction.tolist())))
                # An off-centre ray that misses sees the sky.
                part_id[v, u] = int(hit.shape.id().split("_")[1]) if hit.is_valid() else 0
                values[v, u, 1:] = [*hit.p, *hit.n]
                if not leaked_rays(part_id[v, u], values[v, u, 4:], direction):
                    break

    def receiver_pixels(self, frame: FrameSpec, eye: Eye, passes: _Passes) -> NDArray[np.bool_]:
        """(H, W) where the receiver's parts would be seen if they stood in the stage's axes."""
        part_id, depth_m, _ = passes
        v, u = np.indices(part_id.shape)
        along = np.linalg.norm(self._camera.rays(np.stack([u, v], axis=-1)), axis=-1)
        return receiver_pixels(frame, eye, part_id, depth_m * along.astype(np.float32))

    def sunlit(self, scene: DrogueScene, passes: _Passes, s: float) -> NDArray[np.bool_]:
        """(H, W) where surfaces of the drogue see the sun: one shadow ray per pixel."""
        part_id, depth, normal = passes
        sunlit = np.zeros(part_id.shape, dtype=np.bool_)
        pose, to_sun = self._stage_from_eye(s), np.array(scene.sun[0]).ravel()
        rows, columns = np.nonzero((DROGUE_PARTS[part_id] > 0) & (normal @ (pose[:3, :3].T @ to_sun) > 0))
        places = self._camera.rays(np.stack([columns, rows], axis=-1)) * depth[rows, columns, None]
        # A little off the surface, so that float32 rounding at distances of metres does not shadow it.
        starts = (places + 1e-4 * normal[rows, columns]) @ pose[:3, :3].T + pose[:3, 3]
        sun = mi.Vector3f(to_sun.tolist())
        for row, column, start in zip(rows, columns, starts, strict=True):
            sunlit[row, column] = not scene.scene.ray_test(mi.Ray3f(mi.Point3f(start.tolist()), sun))
        return sunlit

    def tiles(self, pixel: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Rows of `pixel` (P,) by square tile of the image: one crop around scattered pixels would be mostly waste."""
        rows, columns = np.divmod(pixel, self._camera.width_px)
        tile = rows // _TILE_PX * self._camera.width_px + columns // _TILE_PX
        order = np.argsort(tile, kind="stable")
        bounds = np.flatnonzero(np.diff(tile[order])) + 1
        return np.split(order, bounds) if len(pixel) else []

    def radiance(
        self, scene: DrogueScene, what: tuple[NDArray[np.int64], float, int, int], seed: int
    ) -> NDArray[np.float32]:
        """Light from parts, weighted by coverage, and coverage.

        Args:
            scene: what to render.
            what: (P,) flat pixel indices, time in the exposure, samples per pixel, and longest path.
            seed: of the sampler.

        Returns:
            (P, 4) radiance and coverage.
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
        window = np.array(mi.render(scene.scene, sensor=sensor, integrator=mi.load_dict(path), spp=count, seed=seed))
        if scene.glowing is not None:
            # Mitsuba renders hidden emitters black: their own light comes from a rendering without sky and sun.
            direct = {"type": "path", "max_depth": 1}
            lit = mi.render(scene.glowing, sensor=sensor, integrator=mi.load_dict(direct), spp=count, seed=seed)
            window[..., :3] += np.array(lit)[..., :3]
        of_pixels: NDArray[np.float32] = window[rows - top, columns - left].astype(np.float32)
        return of_pixels
