"""The Blender engine: a frame becomes radiance and passes, drawn by Cycles in its own process."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import MAX_MARKERS, drogue_part_ids
from geometry.stereo import EYES, Eye
from render.background import air_before, backgrounds
from render.blender_engine.camera_path import EyePath, holds
from render.blender_engine.messages import CENTER_SAMPLE, FEATURES, FIRST_RANDOM_SAMPLE, LIGHT, PASSES, Picture, Window
from render.blender_engine.process import (
    BlenderEndedError,
    BlenderProcess,
    CenterPixels,
    bpy_version,
    place,
    read_light,
    read_passes,
)
from render.blender_engine.stage import Stage
from render.compositing import TracedEye, amodal_counts
from render.engine import EyeRadiance, StereoRadiance
from render.version import RENDER_VERSION
from scenes.environment_radiance import Surroundings, surroundings
from scenes.sky.clear_sky import REC709_LUMINANCE

# Hose, tanker and bystanders are convex enough for light straight from sky, sun and ground.
_AROUND_DEPTH = 2


@dataclass(frozen=True, eq=False)
class _Job:
    """One eye of one frame, and what its light counts in."""

    frame: FrameSpec
    settings: RenderSettings
    eye: Eye
    unit_cd_m2: float
    seeds: np.random.Generator


@dataclass(frozen=True, eq=False)
class _Scatter:
    """How far two halves of the samples lie apart on the drogue's pixels of one eye.

    Attributes:
        pixel: (P,) flat indices.
        light: (P, 4) half the difference of radiance from parts alone [cd/m2] and coverage.
    """

    pixel: NDArray[np.int64]
    light: NDArray[np.float32]


class BlenderEngine:
    """Path tracing by Cycles on the CPU, of the windows that hold drogue, hose and tanker; the rest is the sky itself.

    One engine holds one Blender process with one thread.

    Raises:
        ValueError: Blender is not installed or cannot be loaded.
    """

    name = "blender"

    def __init__(self) -> None:
        self.version = f"blender {bpy_version()} cycles cpu, render version {RENDER_VERSION}"
        self._stage = Stage()
        self._process = BlenderProcess()
        self._stage_s: dict[str, float] = {}

    def close(self) -> None:
        """End Blender's process; it also ends by itself with the engine."""
        self._process.close()

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes.

        Args:
            frame: what to render.
            settings: how.

        Raises:
            ValueError: Blender ended twice, or cannot draw real lenses.
        """
        self._stage_s = dict.fromkeys(("sky", "scene", "passes", "paths", "composite"), 0.0)
        started = time.process_time()
        behind = backgrounds(frame)
        self._stage_s["sky"] = time.process_time() - started
        if frame.left_from_drogue is None and not frame.bystanders:
            return self._stereo({eye: _empty(behind[eye]).over(behind[eye]) for eye in EYES}, 0.0)
        around = surroundings(frame.environment)
        try:
            traced, scatter = self._trace(frame, settings, around)
        except BlenderEndedError:
            # A process that the system has killed costs one try.
            self._process.close()
            self._process = BlenderProcess()
            self._stage.forget()
            try:
                traced, scatter = self._trace(frame, settings, around)
            except BlenderEndedError as error:
                raise ValueError(f"engine blender: {error}") from error
        started = time.process_time()
        for eye in EYES:
            # Half the difference of two halves is light and coverage too, and the air dims it alike.
            apart = traced[eye].lit_by(scatter[eye].pixel, scatter[eye].light)
            apart.put_behind_air(*air_before(frame, apart.pixel))
            scatter[eye] = _Scatter(apart.pixel, np.column_stack([apart.radiance_cd_m2, apart.coverage]))
            traced[eye].put_behind_air(*air_before(frame, traced[eye].pixel))
        eyes = {eye: traced[eye].over(behind[eye]) for eye in EYES}
        self._stage_s["composite"] += time.process_time() - started
        return self._stereo(eyes, _noise_fraction(scatter, eyes, behind))

    def _stereo(self, eyes: dict[Eye, EyeRadiance], noise: float) -> StereoRadiance:
        return StereoRadiance(eyes["left"], eyes["right"], self.name, self.version, noise, self._stage_s)

    def _trace(
        self, frame: FrameSpec, settings: RenderSettings, around: Surroundings
    ) -> tuple[dict[Eye, TracedEye], dict[Eye, _Scatter]]:
        """Both eyes, and what tells their noise."""
        started = time.process_time()
        setup = self._stage.set_frame(frame, around)
        self._stage_s["scene"] += time.process_time() - started + self._process.ask(setup)
        seeds = frame_generator(frame.seed, frame.frame_index, "blender samples")
        eyes, scatter = {}, {}
        for eye in EYES:
            eyes[eye], scatter[eye] = self._eye(_Job(frame, settings, eye, setup.light.unit_cd_m2, seeds))
        return eyes, scatter

    def _eye(self, job: _Job) -> tuple[TracedEye, _Scatter]:
        """One eye, and how far its samples scatter."""
        camera, settings = job.frame.rig.camera, job.settings
        traced = _empty(np.zeros((camera.height_px, camera.width_px, 3), dtype=np.float32))
        path = EyePath(job.frame, job.eye, np.concatenate([self._stage.drogue_m, *self._stage.around_m]))
        drogue = path.window(self._stage.drogue_m)
        around = [window for corners_m in self._stage.around_m if (window := path.window(corners_m)) is not None]
        around = [window for window in around if not holds(drogue, window)]
        for window in [*around, *([] if drogue is None else [drogue])]:
            seen = self._passes(path, window, PASSES, job)
            place(traced.part_id, window, seen.part_id)
            place(traced.depth_m, window, seen.depth_m)
            in_eye = np.einsum("...i,ij->...j", seen.normal, path.middle.rotation)
            place(traced.normal, window, in_eye.astype(np.float32))
        light = np.zeros((camera.height_px, camera.width_px, 4), dtype=np.float32)
        for window in around:
            place(light, window, self._light(path, window, (0, settings.surround_samples_per_px), _AROUND_DEPTH, job))
        apart = np.zeros_like(light)
        if drogue is not None:
            traced.amodal_px.update(self._amodal(path, drogue, traced, job))
            rgba, half_difference = self._light_in_halves(path, drogue, job)
            place(light, drogue, rgba)
            place(apart, drogue, half_difference)
        in_cd_m2 = np.array([job.unit_cd_m2, job.unit_cd_m2, job.unit_cd_m2, 1.0], dtype=np.float32)
        covered = np.flatnonzero(light[..., 3])
        of_drogue = np.flatnonzero(np.isin(traced.part_id, drogue_part_ids(MAX_MARKERS)))
        scatter = _Scatter(of_drogue, apart.reshape(-1, 4)[of_drogue] * in_cd_m2)
        return traced.lit_by(covered, light.reshape(-1, 4)[covered] * in_cd_m2), scatter

    def _light_in_halves(
        self, path: EyePath, window: Window, job: _Job
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(h, w, 4) light, and half the difference between two halves of its samples."""
        samples, depth = job.settings.samples_per_px, job.settings.max_depth
        if samples == 1:
            # One sample does not tell its error, which is about as large as the light itself.
            rgba = self._light(path, window, (0, 1), depth, job)
            return rgba, rgba
        first = samples // 2
        shares = (0, first), (first, samples - first)
        seed = int(job.seeds.integers(2**31))
        one, two = (self._light(path, window, share, depth, job, seed) for share in shares)
        return (one * first + two * (samples - first)) / np.float32(samples), (one - two) / np.float32(2)

    def _light(
        self,
        path: EyePath,
        window: Window,
        samples: tuple[int, int],
        depth: int,
        job: _Job,
        seed: int | None = None,
    ) -> NDArray[np.float32]:
        """(h, w, 4) light weighted by coverage, and coverage."""
        chosen = int(job.seeds.integers(2**31)) if seed is None else seed
        file = self._process.folder / LIGHT
        # Segments count the camera's ray and the last one, to sun or sky.
        first, count = samples
        share = FIRST_RANDOM_SAMPLE + first, count
        order = Picture(LIGHT, window, path.moving, share, depth - 2, chosen, str(file))
        self._stage_s["paths"] += self._process.ask(order)
        started = time.process_time()
        rgba = read_light(file.with_suffix(".exr"))
        self._stage_s["composite"] += time.process_time() - started
        return rgba

    def _passes(self, path: EyePath, window: Window, kind: str, job: _Job) -> CenterPixels:
        """What the pixel centres meet at mid-exposure."""
        file = self._process.folder / kind
        self._stage_s["passes"] += self._process.ask(
            Picture(kind, window, path.still, (CENTER_SAMPLE, 1), 0, 0, str(file))
        )
        started = time.process_time()
        pixels = read_passes(file.with_suffix(".exr"))
        if window.eye is not None:
            rays = job.frame.rig.rays(_places_px(window), job.eye)
            pixels = replace(pixels, depth_m=pixels.depth_m / np.linalg.norm(rays, axis=-1).astype(np.float32))
        self._stage_s["passes"] += time.process_time() - started
        return pixels

    def _amodal(self, path: EyePath, window: Window, traced: TracedEye, job: _Job) -> dict[int, int]:
        alone = self._passes(path, window, FEATURES, job)
        inside = _slices(window)
        return amodal_counts(
            traced.part_id[inside].ravel(),
            traced.depth_m[inside].ravel(),
            alone.part_id.ravel(),
            alone.depth_m.ravel(),
        )


def _noise_fraction(
    scatter: dict[Eye, _Scatter], eyes: dict[Eye, EyeRadiance], behind: dict[Eye, NDArray[np.float32]]
) -> float:
    """Root mean square error of luminance over root mean square luminance, on the drogue's pixels, edges included.

    Halves of one sequence avoid each other's places, so that this is more than the error of their mean.
    """
    errors, values = [], []
    for eye, seen in scatter.items():
        through = seen.light[:, :3] - seen.light[:, 3:] * behind[eye].reshape(-1, 3)[seen.pixel]
        errors.append(through @ REC709_LUMINANCE)
        values.append(eyes[eye].radiance_cd_m2.reshape(-1, 3)[seen.pixel] @ REC709_LUMINANCE)
    squares = [np.sum(np.square(np.concatenate(rows)), dtype=np.float64) for rows in (errors, values)]
    return float(np.sqrt(squares[0] / max(squares[1], 1e-30)))


def _places_px(window: Window) -> NDArray[np.float64]:
    """(h, w, 2) pixel centres in the whole image. [px]"""
    v, u = np.mgrid[_slices(window)].astype(np.float64)
    return np.stack([u, v], axis=-1)


def _slices(window: Window) -> tuple[slice, slice]:
    return (
        slice(window.top_px, window.top_px + window.height_px),
        slice(window.left_px, window.left_px + window.width_px),
    )


def _empty(behind: NDArray[np.float32]) -> TracedEye:
    shape = behind.shape[:2]
    return TracedEye(
        np.zeros(shape, dtype=np.uint8),
        np.full(shape, np.inf, dtype=np.float32),
        np.zeros((*shape, 3), dtype=np.float32),
        {},
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 3), dtype=np.float32),
        np.zeros(0, dtype=np.float32),
    )
