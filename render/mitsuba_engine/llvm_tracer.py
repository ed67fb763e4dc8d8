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
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, Eye
from render.mitsuba_engine.scene import DrogueScene, scene_key
from render.mitsuba_engine.sun_sky_paths import trace_paths
from render.mitsuba_engine.traced import (
    Traced,
    TracedEye,
    amodal_counts,
    blur_px,
    inside_one_part,
    pixels_to_trace,
    pose_polynomial,
    settings_by_plan,
)
from scenes.seeding import generator
from scenes.sky import REC709_LUMINANCE
from scenes.surroundings import Surroundings

# Lanes of one launch: bounds memory (about 300 bytes a lane) without costing speed.
_MOST_LANES = 2_000_000
_PLAN = ("drogue", "surround")
CENTER = (0.5, 0.5)
# Next to the centre by a thousandth of a pixel, off any axis: for rays that slip through a seam at the centre itself.
ASIDE = (0.501, 0.5007)


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
        times = (0.0,) if moves_px < 0.05 else (0.0, -1.0, 1.0)
        eyes: dict[Eye, TracedEye] = {}
        plans: dict[Eye, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
        for eye in EYES:
            passes = _Passes(frame, eye, self._scene)
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
            camera = _CameraRays(frame, eye)
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
        camera: _CameraRays,
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
        camera: _CameraRays,
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


class _CameraRays:
    """Rays of one eye in the drogue frame."""

    def __init__(self, frame: FrameSpec, eye: Eye) -> None:
        self.camera: PinholeCamera = frame.rig.camera
        self._pose = pose_polynomial(frame, eye)
        self.pose_at_middle = self._pose[0]
        self.moves = bool(np.abs(self._pose[1:]).max() > 0)
        # Plain numbers would become part of the compiled kernel, and every frame would compile its own.
        self._opaque_pose = [
            [[dr.opaque(mi.Float, float(value)) for value in row] for row in coefficient] for coefficient in self._pose
        ]

    def rays(self, pixel: Any, place: Any, moment: Any) -> Any:
        """Rays through pixels.

        Args:
            pixel: flat pixel indices.
            place: 2-D place in the pixel's box, (0.5, 0.5) its centre.
            moment: time in the exposure, 0 when the shutter opens and 1 when it closes.
        """
        camera = self.camera
        row = pixel // camera.width_px
        u = mi.Float(pixel - row * camera.width_px) + (place.x - 0.5)
        v = mi.Float(row) + (place.y - 0.5)
        local = dr.normalize(
            mi.Vector3f((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, mi.Float(1.0))
        )
        pose = self._pose_at(2.0 * moment - 1.0)
        direction = mi.Vector3f(*[pose[i][0] * local.x + pose[i][1] * local.y + pose[i][2] * local.z for i in range(3)])
        return mi.Ray3f(mi.Point3f(*[pose[i][3] for i in range(3)]), dr.normalize(direction))

    def _pose_at(self, s: Any) -> list[list[Any]]:
        c = self._opaque_pose
        if not self.moves:
            return c[0]
        return [[c[0][i][j] + s * (c[1][i][j] + s * c[2][i][j]) for j in range(4)] for i in range(3)]


class _Passes:
    """Part id, depth and normal by the rays through the pixel centres of one eye."""

    def __init__(self, frame: FrameSpec, eye: Eye, scene: DrogueScene) -> None:
        self._rays = _CameraRays(frame, eye)
        self._scene = scene
        camera = frame.rig.camera
        self._shape = (camera.height_px, camera.width_px)

    def _center_rays(self, pixel: Any, moment: float = 0.5, place: tuple[float, float] = CENTER) -> Any:
        return self._rays.rays(pixel, mi.Point2f(*place), dr.opaque(mi.Float, moment))

    def part_ids(self, s: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """(H, W) part ids and distances [m] at time s of the exposure, from -1 (shutter opens) to 1 (it closes)."""
        pixel = dr.arange(mi.UInt32, self._shape[0] * self._shape[1])
        ids, distance = self._hits(self._scene.scene, self._center_rays(pixel, (s + 1) / 2))
        return ids.reshape(self._shape), distance.reshape(self._shape)

    @staticmethod
    def _hits(scene: Any, ray: Any) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        registry: Any = dr.reinterpret_array(mi.UInt32, scene.shapes_dr())
        registry_ids = np.array(registry)
        table = np.zeros(int(registry_ids.max()) + 1, dtype=np.uint32)
        for index, shape in zip(registry_ids, scene.shapes(), strict=True):
            table[index] = int(shape.id().removeprefix("part_"))
        of_hit: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
        ids = dr.gather(mi.UInt32, mi.UInt32(table), of_hit, hit.is_valid())
        dr.eval(ids, hit.t)
        return np.array(ids).astype(np.uint8), np.array(hit.t)

    def traced_eye(self, part_id: NDArray[np.uint8], distance_m: NDArray[np.float32]) -> TracedEye:
        """The passes at mid-exposure, without radiance yet."""
        depth = np.full(self._shape, np.inf, dtype=np.float32)
        normal = np.zeros((*self._shape, 3), dtype=np.float32)
        covered = np.flatnonzero(part_id)
        if len(covered):
            points, normals, leaked = self._surface(covered, CENTER)
            if leaked.any():
                aside = covered[leaked]
                points[leaked], normals[leaked], _ = self._surface(aside, ASIDE)
                ids, distances = self._hits(self._scene.scene, self._center_rays(mi.UInt32(aside), place=ASIDE))
                part_id.reshape(-1)[aside], distance_m.reshape(-1)[aside] = ids, distances
            pose = self._rays.pose_at_middle
            depth.reshape(-1)[covered] = np.einsum("pi,i->p", points - pose[:, 3], pose[:, 2])
            normal.reshape(-1, 3)[covered] = np.einsum("pi,ij->pj", normals, pose[:, :3])
        return TracedEye(
            part_id,
            depth,
            normal,
            self._amodal(part_id, distance_m),
            np.zeros(0, dtype=np.int64),
            np.zeros((0, 3), dtype=np.float32),
            np.zeros(0, dtype=np.float32),
        )

    def _surface(
        self, pixel: NDArray[np.int64], place: tuple[float, float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """(P, 3) points and normals in the drogue frame, and (P,) which rays slipped into a part through a seam.

        All parts are closed: a surface that looks away from the camera is seen from inside, by a ray that passed
        exactly between two triangles.
        """
        ray = self._center_rays(mi.UInt32(pixel), place=place)
        hit = self._scene.scene.ray_intersect(ray, mi.RayFlags.Minimal, True)
        inside = hit.is_valid() & (dr.dot(hit.n, ray.d) > 0)
        dr.eval(hit.p, hit.n, inside)
        return np.array(hit.p).T, np.array(hit.n).T, np.array(inside)

    def _amodal(self, part_id: NDArray[np.uint8], distance_m: NDArray[np.float32]) -> dict[int, int]:
        """Pixel centres that each marker and the hub would cover alone, on the image's grid."""
        rows, columns = np.flatnonzero(part_id.any(axis=1)), np.flatnonzero(part_id.any(axis=0))
        if not len(rows):
            return {}
        # Where a hidden feature would be, something else is seen: what is covered bounds the features too.
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        pixel = np.arange(part_id.size, dtype=np.uint32).reshape(self._shape)[window].ravel()
        alone_id, alone_m = self._hits(self._scene.features, self._center_rays(mi.UInt32(pixel)))
        return amodal_counts(part_id[window].ravel(), distance_m[window].ravel(), alone_id, alone_m)
