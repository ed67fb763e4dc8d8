"""Tracing with Mitsuba's compiled variants, LLVM's and CUDA's.

Every ray is generated here, so that one compiled kernel serves every frame.
Rays through the pixel centres give part id, depth, normal and amodal counts, and with them the pixels to trace.
"""

from __future__ import annotations

import time
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import Part
from geometry.compiled_loops import compiled
from geometry.stereo import EYES, Eye
from render.camera.exposure_motion import NEAREST_M, image_window, motion_blur_px, receiver_pixels
from render.compositing import Compositor, TracedEye, amodal_counts
from render.hidden_features import add_hidden_centers
from render.mitsuba_engine.jit_arrays import jit_array, reserve_registry
from render.mitsuba_engine.paths.body_paths import DenoisedBodyPaths
from render.mitsuba_engine.paths.context_paths import SeenContext, trace_context
from render.mitsuba_engine.paths.denoised_paths import DenoisedPaths
from render.mitsuba_engine.paths.drogue_paths import trace_paths
from render.mitsuba_engine.paths.rays import CameraRays, FrameRays, SampledLight, rows_of
from render.mitsuba_engine.scene import DrogueScene, SceneCache, by_shape
from render.mitsuba_engine.trace_request import (
    DROGUE_PARTS,
    OFF_CENTER,
    OPEN_TO_SKY,
    SamplingPlan,
    TraceRequest,
    TraceResult,
    leaked_rays,
    parts_in,
    parts_table,
    plan_pixels,
)

# Parts of a smaller width may pass between pixel centres over a longer way than the pixels around a centre reach. [px]
_NARROW_PX = 1.2
_OF_DROGUE = {int(part) for part in np.flatnonzero(DROGUE_PARTS)}
_ANY_PART = parts_table(range(1, 256))


class WavefrontTracer:
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
        cameras = {eye: CameraRays(frame, eye) for eye in EYES}
        eyes: dict[Eye, TracedEye] = {}
        plans: dict[Eye, SamplingPlan] = {}
        narrow: dict[Eye, NDArray[np.uint8]] = {}
        for eye in EYES:
            passes = CenterPasses(frame, cameras[eye], eye, scene)
            middle = passes.part_ids(0.0)
            passes.hold(receiver_pixels(frame, eye, *middle))
            seen = [middle, *(passes.part_ids(s) for s in times[1:])]
            sunlit = [passes.sunlit(ids, s) for (ids, _), s in zip(seen, times, strict=True)]
            narrow[eye], margin_px = passes.narrow_parts(), 1 + int(np.ceil(moves_px))
            plans[eye] = plan_pixels([ids for ids, _ in seen], sunlit, margin_px, scene.uneven_parts, narrow[eye])
            eyes[eye] = passes.traced_eye(*seen[0])
        stage_s["passes"], started = time.process_time() - started, time.process_time()
        sampled = _sample_light(request, scene, [*cameras.values()], eyes, (plans, narrow))
        result = _by_eye(sampled, eyes, stage_s)
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
    request: TraceRequest,
    scene: DrogueScene,
    cameras: list[CameraRays],
    eyes: dict[Eye, TracedEye],
    planned: tuple[dict[Eye, SamplingPlan], dict[Eye, NDArray[np.uint8]]],
) -> SampledLight:
    """Sampled light of all planned pixels; denoised where the settings ask for it and all of the drogue is matt.

    Args:
        request: gives frame and settings.
        scene: set up for the frame.
        cameras: of both eyes.
        eyes: passes of both eyes.
        planned: what to trace, and what `CenterPasses.narrow_parts` gives.
    """
    frame, settings = request.frame, request.settings
    plans, narrow = planned
    centers = _center_pixels(eyes, plans)
    matt = frame.drogue is not None and frame.drogue.satin is None and not scene.shiny_parts & _OF_DROGUE
    denoise = settings.denoise and matt and any(len(pixel) > 0 for pixel in centers.values())
    open_to_sky = OPEN_TO_SKY.copy()
    # Few centres see the narrow sides of ribs: what is smoothed over them should vary little with the direction.
    open_to_sky[Part.RIBS] = denoise
    # What is known is the light on matt paint.
    open_to_sky[list(scene.shiny_parts)] = 0
    rays, moves_px = FrameRays(frame, scene, cameras, request.ambient, open_to_sky), motion_blur_px(frame)
    if denoise:
        assert frame.drogue is not None and frame.left_from_drogue is not None
        px_per_m = frame.rig.camera.fx_px / float(frame.left_from_drogue.translation_m[2])
        compositor = Compositor(frame=frame, eyes=eyes, background=request.background)
        kind = DenoisedPaths if frame.drogue.body is None else DenoisedBodyPaths
        sampled = kind(rays, settings, px_per_m, moves_px).trace(plans, centers, compositor)
    else:
        sampled = trace_paths(rays, plans, settings)
    pixel = rays.pixels_of_both_eyes(plans, "context")
    seen = SeenContext(
        covered=np.concatenate([eyes[eye].part_id.reshape(-1) > 0 for eye in EYES]),
        shiny=_near_parts(eyes, narrow, parts_table(scene.shiny_parts - _OF_DROGUE), moves_px),
        narrow=_near_parts({}, narrow, _ANY_PART, moves_px),
        lamps=_near_lamps(frame, scene, rays, moves_px),
    )
    return sampled.with_pixels(pixel, trace_context(rays, pixel, seen, settings, moves_px))


def _near_parts(
    eyes: dict[Eye, TracedEye], narrow: dict[Eye, NDArray[np.uint8]], table: NDArray[np.uint8], moves_px: float
) -> NDArray[np.bool_]:
    """(2 H W,) which pixels may see parts that a table marks, at the centres of both eyes or where they are narrow."""
    kernel = np.ones((3 + 2 * int(np.ceil(moves_px)),) * 2, dtype=np.uint8)
    near = []
    for eye in EYES:
        marked = parts_in(narrow[eye], table)
        if eye in eyes:
            marked |= parts_in(eyes[eye].part_id, table)
        near.append((cv2.dilate(marked.astype(np.uint8), kernel) > 0).reshape(-1))
    return np.concatenate(near)


def _near_lamps(frame: FrameSpec, scene: DrogueScene, rays: FrameRays, moves_px: float) -> NDArray[np.bool_]:
    """(2 H W,) which pixels of both eyes may see a lamp beside the drogue, however small it is."""
    camera, reach_px = frame.rig.camera, 1 + int(np.ceil(moves_px))
    held = np.zeros((2, camera.height_px, camera.width_px), dtype=np.bool_)
    for index, eye in enumerate(EYES):
        eye_from_stage = rays.stage_from_eye(eye).inverse()
        for corners_m in scene.lamp_corners_m:
            points = eye_from_stage.apply(corners_m)
            if points[:, 2].min() < NEAREST_M:
                continue
            ideal_px = camera.project(points)
            if not frame.rig.is_in_field(ideal_px, eye).any():
                continue
            places = np.rint(frame.rig.image_px(ideal_px, eye))
            (left, top), (right, bottom) = places.min(axis=0) - reach_px, places.max(axis=0) + reach_px + 1
            columns, rows = (max(int(low), 0) for low in (left, top))
            held[index, rows : max(int(bottom), 0), columns : max(int(right), 0)] = True
    return held.reshape(-1)


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


CENTER = (0.5, 0.5)


class CenterPasses:
    """Part id, depth and normal by the rays through the pixel centres of one eye."""

    def __init__(self, frame: FrameSpec, rays: CameraRays, eye: Eye, scene: DrogueScene) -> None:
        self._rays, self._scene = rays, scene
        camera = frame.rig.camera
        self._shape = (camera.height_px, camera.width_px)
        self._frame, self._rig, self._eye = frame, frame.rig, eye
        self._held = np.zeros(self._shape, dtype=np.bool_)

    def hold(self, held: NDArray[np.bool_]) -> None:
        """See in (H, W) pixels only what is there at mid-exposure."""
        self._held = held
        self._rays.hold(held)

    def _center_rays(self, pixel: Any, moment: float = 0.5, place: tuple[float, float] = CENTER) -> Any:
        return self._rays.rays(pixel, mi.Point2f(*place), dr.opaque(mi.Float, moment))

    def part_ids(self, s: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """(H, W) part ids and distances [m] at time s of the exposure, from -1 (shutter opens) to 1 (it closes)."""
        ids, distance_m = np.zeros(self._shape, dtype=np.uint8), np.full(self._shape, np.inf, dtype=np.float32)
        # Most rays miss; those through windows without objects need not be traced.
        pixel = self.pixels_of(self._scene.object_corners_m, s)
        if self._held.any():
            pixel = np.union1d(pixel, np.flatnonzero(self._held))
        if len(pixel):
            rays = self._center_rays(jit_array(mi.UInt32, pixel), (s + 1) / 2)
            ids.reshape(-1)[pixel], distance_m.reshape(-1)[pixel] = self._hits(self._scene.scene, rays)
        return ids, distance_m

    def pixels_of(self, corners_of_objects_m: list[NDArray[np.float64]], s: float) -> NDArray[np.int64]:
        """(P,) flat indices of pixels that may show one of some objects, by points whose convex hulls hold them."""
        held = np.zeros(self._shape, dtype=np.bool_)
        pose = self._rays.stage_from_eye(s)
        for corners_m in corners_of_objects_m:
            window = image_window(self._rig, [pose], corners_m)
            if window is not None:
                (left, top), (right, bottom) = window
                held[top:bottom, left:right] = True
        return np.flatnonzero(held)

    def narrow_parts(self) -> NDArray[np.uint8]:
        """(H, W) ids of parts narrower than a pixel at mid-exposure, where their edges are; 0 elsewhere."""
        ids = np.zeros(self._shape, dtype=np.uint8)
        camera, eye_from_stage = self._rays.camera, self._rays.stage_from_eye(0.0).inverse()
        for surface in self._scene.surfaces:
            edges, thickness_m = surface.painted.narrow_edges
            if not len(edges):
                continue
            ends = (eye_from_stage @ surface.axes_from_mesh).apply(surface.painted.mesh.vertices)[edges]
            nearest_m = ends[..., 2].min(axis=1)
            narrow = (nearest_m > NEAREST_M) & (thickness_m * camera.fx_px < _NARROW_PX * nearest_m)
            if narrow.any():
                ideal_px = camera.project(ends[narrow])
                seen = self._rig.is_in_field(ideal_px, self._eye).any(axis=-1)
                ends_px = self._rig.image_px(ideal_px[seen], self._eye)
                _draw_lines(np.ascontiguousarray(ends_px), int(surface.part_id), ids)
        return ids

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
        pixel = self.pixels_of([self._scene.features_m], 0.0)
        if not len(pixel):
            return {}
        alone_id, alone_m = self._hits(self._scene.features, self._center_rays(jit_array(mi.UInt32, pixel)))
        counts = amodal_counts(part_id.reshape(-1)[pixel], distance_m.reshape(-1)[pixel], alone_id, alone_m)
        return add_hidden_centers(counts, self._frame, self._eye, self._scene.triangles_m, (pixel, alone_id))


@compiled
def _draw_lines(ends_px: NDArray[np.float64], part_id: int, ids: NDArray[np.uint8]) -> None:
    """Write an id into the pixels of an (H, W) image on lines between (E, 2, 2) ends, at steps of at most a pixel."""
    for line in range(ends_px.shape[0]):
        u, v = ends_px[line, 0, 0], ends_px[line, 0, 1]
        across, down = ends_px[line, 1, 0] - u, ends_px[line, 1, 1] - v
        steps = max(int(np.ceil(max(abs(across), abs(down)))), 1)
        for step in range(steps + 1):
            column, row = int(np.rint(u + across * (step / steps))), int(np.rint(v + down * (step / steps)))
            if 0 <= column < ids.shape[1] and 0 <= row < ids.shape[0]:
                ids[row, column] = part_id
