"""Part id, depth, normal and amodal counts by the rays through the pixel centres."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.stereo import Eye
from render.camera.exposure_motion import image_window
from render.compositing import TracedEye, amodal_counts
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import CameraRays, rows_of
from render.mitsuba_engine.scene import DrogueScene, by_shape
from render.mitsuba_engine.trace_request import DROGUE_PARTS, OFF_CENTER, leaked_rays, parts_in

CENTER = (0.5, 0.5)


class CenterPasses:
    """Part id, depth and normal by the rays through the pixel centres of one eye."""

    def __init__(self, frame: FrameSpec, eye: Eye, scene: DrogueScene) -> None:
        self._rays = CameraRays(frame, eye)
        self._scene = scene
        camera = frame.rig.camera
        self._shape = (camera.height_px, camera.width_px)
        self._rig = frame.rig

    def _center_rays(self, pixel: Any, moment: float = 0.5, place: tuple[float, float] = CENTER) -> Any:
        return self._rays.rays(pixel, mi.Point2f(*place), dr.opaque(mi.Float, moment))

    def part_ids(self, s: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """(H, W) part ids and distances [m] at time s of the exposure, from -1 (shutter opens) to 1 (it closes)."""
        ids, distance_m = np.zeros(self._shape, dtype=np.uint8), np.full(self._shape, np.inf, dtype=np.float32)
        # Most rays miss; those through windows without objects need not be traced.
        pixel = self._pixels_of(self._scene.object_corners_m, s)
        if len(pixel):
            rays = self._center_rays(jit_array(mi.UInt32, pixel), (s + 1) / 2)
            ids.reshape(-1)[pixel], distance_m.reshape(-1)[pixel] = self._hits(self._scene.scene, rays)
        return ids, distance_m

    def _pixels_of(self, corners_of_objects_m: list[NDArray[np.float64]], s: float) -> NDArray[np.int64]:
        """(P,) flat indices of pixels that may show one of some objects, by points whose convex hulls hold them."""
        held = np.zeros(self._shape, dtype=np.bool_)
        pose = self._rays.stage_from_eye(s)
        for corners_m in corners_of_objects_m:
            window = image_window(self._rig, [pose], corners_m)
            if window is not None:
                (left, top), (right, bottom) = window
                held[top:bottom, left:right] = True
        return np.flatnonzero(held)

    def sunlit(self, part_id: NDArray[np.uint8], s: float) -> NDArray[np.bool_]:
        """(H, W) where the rays of `part_ids` at time s hit surfaces of the drogue that the sun lights."""
        sunlit = np.zeros(self._shape, dtype=np.bool_)
        pixel = np.flatnonzero(parts_in(part_id, DROGUE_PARTS))
        if len(pixel):
            to_sun, _ = self._scene.sun
            ray = self._center_rays(jit_array(mi.UInt32, pixel), (s + 1) / 2)
            surface = self._scene.scene.ray_intersect(ray, mi.RayFlags.Minimal, True)
            faces = surface.is_valid() & (dr.dot(surface.n, to_sun) > 0)
            sunlit.reshape(-1)[pixel] = np.array(faces & ~self._scene.scene.ray_test(surface.spawn_ray(to_sun), faces))
        return sunlit

    @staticmethod
    def _hits(scene: Any, ray: Any) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        table = jit_array(mi.UInt32, by_shape(scene, np.arange(256, dtype=np.uint32)))
        number: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
        ids = dr.gather(mi.UInt32, table, number, hit.is_valid())
        dr.eval(ids, hit.t)
        return np.array(ids).astype(np.uint8), np.array(hit.t)

    def traced_eye(self, part_id: NDArray[np.uint8], distance_m: NDArray[np.float32]) -> TracedEye:
        """The passes at mid-exposure, from the part ids and distances there; both are corrected where rays leaked."""
        depth = np.full(self._shape, np.inf, dtype=np.float32)
        normal = np.zeros((*self._shape, 3), dtype=np.float32)
        covered = np.flatnonzero(part_id > 0)
        if len(covered):
            pose = self._rays.pose_at_middle
            points, normals = self._surface(covered, CENTER)
            leaked = leaked_rays(part_id.reshape(-1)[covered], normals, points - pose[:, 3])
            for place in OFF_CENTER:
                if not leaked.any():
                    break
                retry = np.flatnonzero(leaked)
                aside = covered[retry]
                points[retry], normals[retry] = self._surface(aside, place)
                ids, distances = self._hits(
                    self._scene.scene, self._center_rays(jit_array(mi.UInt32, aside), place=place)
                )
                part_id.reshape(-1)[aside], distance_m.reshape(-1)[aside] = ids, distances
                leaked[retry] = leaked_rays(ids, normals[retry], points[retry] - pose[:, 3])
            met = part_id.reshape(-1)[covered] > 0
            depth.reshape(-1)[covered[met]] = (points[met] - pose[:, 3]) @ pose[:, 2]
            normal.reshape(-1, 3)[covered[met]] = normals[met] @ pose[:, :3]
        return TracedEye.untraced(
            part_id=part_id, depth_m=depth, normal=normal, amodal_px=self._amodal(part_id, distance_m)
        )

    def _surface(
        self, pixel: NDArray[np.int64], place: tuple[float, float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(P, 3) points and normals in the drogue frame."""
        ray = self._center_rays(jit_array(mi.UInt32, pixel), place=place)
        hit = self._scene.scene.ray_intersect(ray, mi.RayFlags.Minimal, True)
        # Robust intersection gives exact distances, but points on narrow triangles only to a millimetre.
        point = ray(dr.select(hit.is_valid(), hit.t, 0.0))
        dr.eval(point, hit.n)
        return rows_of(point), rows_of(hit.n)

    def _amodal(self, part_id: NDArray[np.uint8], distance_m: NDArray[np.float32]) -> dict[int, int]:
        """Pixel centres that each marker and the hub would cover if nothing occluded it."""
        pixel = self._pixels_of([self._scene.features_m], 0.0)
        if not len(pixel):
            return {}
        alone_id, alone_m = self._hits(self._scene.features, self._center_rays(jit_array(mi.UInt32, pixel)))
        return amodal_counts(part_id.reshape(-1)[pixel], distance_m.reshape(-1)[pixel], alone_id, alone_m)
