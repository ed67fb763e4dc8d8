"""The Blender engine: a frame becomes radiance and passes, rendered by Cycles in a process of its own."""

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
from render.background import air_in_front, backgrounds
from render.blender_engine.camera_path import EyePath, contains
from render.blender_engine.messages import (
    CENTER_SAMPLE,
    FEATURES,
    FIRST_RANDOM_SAMPLE,
    LIGHT,
    PASSES,
    ImageWindow,
    PictureRequest,
)
from render.blender_engine.process import (
    BlenderEndedError,
    BlenderProcess,
    CenterPixels,
    paste,
    read_light,
    read_passes,
)
from render.blender_engine.stage import Stage
from render.compositing import TracedEye, amodal_counts
from render.device import Device, driver_version
from render.engine import EyeRadiance, StereoRadiance
from render.hidden_features import add_hidden_centers
from render.surfaces import shows_surfaces
from render.version import RENDER_VERSION
from scenes.environment_radiance import EnvironmentRadiance, environment_radiance
from scenes.sky.photometry import REC709_LUMINANCE

# Hose, tanker and other objects are convex enough for direct light from sky, sun and ground.
_CONTEXT_DEPTH = 2


@dataclass(frozen=True, eq=False)
class _EyeJob:
    """One eye of one frame.

    Attributes:
        unit_cd_m2: radiance that Blender's numbers count in. [cd/m2]
        seeds: of the frame's pictures.
    """

    frame: FrameSpec
    settings: RenderSettings
    eye: Eye
    unit_cd_m2: float
    seeds: np.random.Generator


@dataclass(frozen=True, eq=False)
class _HalfDifference:
    """Half the difference between two halves of the samples, on the drogue's pixels of one eye.

    Attributes:
        pixel: (P,) flat indices.
        light: (P, 4) of radiance from parts alone [cd/m2] and coverage.
    """

    pixel: NDArray[np.int64]
    light: NDArray[np.float32]


class BlenderEngine:
    """Path tracing by Cycles, in image windows that hold drogue, hose and tanker; all else is background.

    One engine holds one Blender process.

    Raises:
        EngineUnavailableError: Cycles cannot use the device.
        ValueError: Blender is not installed or cannot be loaded.
    """

    name = "blender"

    def __init__(self, device: Device = "cpu") -> None:
        self._stage, self._device = Stage(), device
        self._process = BlenderProcess(device=device)
        gpu = self._process.gpu
        # Pixels depend on the GPU and its driver too.
        by = "cpu" if gpu is None else f"optix ({gpu}, driver {driver_version() or 'unknown'})"
        self.version = f"blender {self._process.version} cycles {by}, render version {RENDER_VERSION}"
        self._stage_s: dict[str, float] = {}

    def close(self) -> None:
        """End Blender's process; it also ends by itself with the engine."""
        self._process.close()

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes.

        Args:
            frame: what to render.
            settings: samples and depths.

        Raises:
            ValueError: Blender ended twice, or cannot render lenses with distortion.
        """
        self._stage_s = dict.fromkeys(("sky", "scene", "passes", "paths", "composite"), 0.0)
        started = time.process_time()
        background = backgrounds(frame)
        self._stage_s["sky"] = time.process_time() - started
        if not shows_surfaces(frame):
            return self._stereo({eye: _empty_eye(frame).composite_over(background[eye]) for eye in EYES}, 0.0)
        ambient = environment_radiance(frame.environment)
        try:
            traced, half_differences = self._trace(frame, settings, ambient)
        except BlenderEndedError:
            # A process that the system has killed is started again once.
            self._process.close()
            self._process = BlenderProcess(device=self._device)
            self._stage.forget()
            try:
                traced, half_differences = self._trace(frame, settings, ambient)
            except BlenderEndedError as error:
                raise ValueError(f"engine blender: {error}") from error
        started = time.process_time()
        for eye in EYES:
            # A difference is light and coverage too, and the air attenuates it alike.
            difference = traced[eye].with_light(half_differences[eye].pixel, half_differences[eye].light)
            difference.apply_air(*air_in_front(frame, eye, difference.pixel))
            half_differences[eye] = _HalfDifference(
                pixel=difference.pixel, light=np.column_stack([difference.radiance_cd_m2, difference.coverage])
            )
            air, optical_depth_per_m = air_in_front(frame, eye, traced[eye].pixel)
            traced[eye].apply_air(air, optical_depth_per_m)
            traced[eye].limit_edges(optical_depth_per_m)
        eyes = {eye: traced[eye].composite_over(background[eye]) for eye in EYES}
        self._stage_s["composite"] += time.process_time() - started
        return self._stereo(eyes, _noise_fraction(half_differences, eyes, background))

    def _stereo(self, eyes: dict[Eye, EyeRadiance], noise: float) -> StereoRadiance:
        return StereoRadiance(
            left=eyes["left"],
            right=eyes["right"],
            engine=self.name,
            engine_version=self.version,
            monte_carlo_noise_fraction=noise,
            stage_s=self._stage_s,
        )

    def _trace(
        self, frame: FrameSpec, settings: RenderSettings, ambient: EnvironmentRadiance
    ) -> tuple[dict[Eye, TracedEye], dict[Eye, _HalfDifference]]:
        """Both eyes, and half the differences that their noise follows from."""
        started = time.process_time()
        setup = self._stage.set_frame(frame, ambient)
        self._stage_s["scene"] += time.process_time() - started + self._process.ask(setup)
        seeds = frame_generator(frame.seed, frame.frame_index, "blender samples")
        eyes, half_differences = {}, {}
        for eye in EYES:
            job = _EyeJob(frame=frame, settings=settings, eye=eye, unit_cd_m2=setup.light.unit_cd_m2, seeds=seeds)
            eyes[eye], half_differences[eye] = self._trace_eye(job)
        return eyes, half_differences

    def _trace_eye(self, job: _EyeJob) -> tuple[TracedEye, _HalfDifference]:
        camera, settings = job.frame.rig.camera, job.settings
        traced = _empty_eye(job.frame)
        path = EyePath(job.frame, job.eye, np.concatenate([self._stage.drogue_m, *self._stage.context_m]))
        drogue = path.window(self._stage.drogue_m)
        context = [window for corners_m in self._stage.context_m if (window := path.window(corners_m)) is not None]
        context = [window for window in context if not contains(drogue, window)]
        for window in [*context, *([] if drogue is None else [drogue])]:
            seen = self._passes(path, window, PASSES, job)
            paste(traced.part_id, window, seen.part_id)
            paste(traced.depth_m, window, seen.depth_m)
            in_eye = np.einsum("...i,ij->...j", seen.normal, path.middle.rotation)
            paste(traced.normal, window, in_eye.astype(np.float32))
        light = np.zeros((camera.height_px, camera.width_px, 4), dtype=np.float32)
        for window in context:
            paste(light, window, self._light(path, window, (0, settings.surround_samples_per_px), _CONTEXT_DEPTH, job))
        for corners_m in self._stage.neighbours_m:
            window = path.window(corners_m)
            if window is not None:
                paste(light, window, self._light(path, window, (0, settings.samples_per_px), settings.max_depth, job))
        difference = np.zeros_like(light)
        if drogue is not None:
            traced.amodal_px.update(self._amodal(path, drogue, traced, job))
            rgba, half_difference = self._light_in_halves(path, drogue, job)
            paste(light, drogue, rgba)
            paste(difference, drogue, half_difference)
        in_cd_m2 = np.array([job.unit_cd_m2, job.unit_cd_m2, job.unit_cd_m2, 1.0], dtype=np.float32)
        covered = np.flatnonzero(light[..., 3])
        of_drogue = np.flatnonzero(np.isin(traced.part_id, drogue_part_ids(MAX_MARKERS)))
        on_drogue = _HalfDifference(pixel=of_drogue, light=difference.reshape(-1, 4)[of_drogue] * in_cd_m2)
        return traced.with_light(covered, light.reshape(-1, 4)[covered] * in_cd_m2), on_drogue

    def _light_in_halves(
        self, path: EyePath, window: ImageWindow, job: _EyeJob
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(h, w, 4) light, and half the difference between two halves of its samples."""
        samples, depth = job.settings.samples_per_px, job.settings.max_depth
        if samples == 1:
            # One sample does not show its error, which is about as large as the light itself.
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
        window: ImageWindow,
        samples: tuple[int, int],
        depth: int,
        job: _EyeJob,
        seed: int | None = None,
    ) -> NDArray[np.float32]:
        """(h, w, 4) light weighted by coverage, and coverage."""
        chosen = int(job.seeds.integers(2**31)) if seed is None else seed
        file = self._process.folder / LIGHT
        # A depth counts the camera ray and the last segment, to sun or sky; bounces count neither.
        first, count = samples
        share = FIRST_RANDOM_SAMPLE + first, count
        request = PictureRequest(
            kind=LIGHT,
            window=window,
            path=path.moving,
            samples=share,
            bounces=depth - 2,
            seed=chosen,
            file=str(file),
        )
        self._stage_s["paths"] += self._process.ask(request)
        started = time.process_time()
        rgba = read_light(file.with_suffix(".exr"))
        self._stage_s["composite"] += time.process_time() - started
        return rgba

    def _passes(self, path: EyePath, window: ImageWindow, kind: str, job: _EyeJob) -> CenterPixels:
        """What the rays through the pixel centres hit at mid-exposure."""
        file = self._process.folder / kind
        request = PictureRequest(
            kind=kind,
            window=window,
            path=path.still,
            samples=(CENTER_SAMPLE, 1),
            bounces=0,
            seed=0,
            file=str(file),
        )
        self._stage_s["passes"] += self._process.ask(request)
        started = time.process_time()
        pixels = read_passes(file.with_suffix(".exr"))
        if window.eye is not None:
            rays = job.frame.rig.rays(_places_px(window), job.eye)
            pixels = replace(pixels, depth_m=pixels.depth_m / np.linalg.norm(rays, axis=-1).astype(np.float32))
        self._stage_s["passes"] += time.process_time() - started
        return pixels

    def _amodal(self, path: EyePath, window: ImageWindow, traced: TracedEye, job: _EyeJob) -> dict[int, int]:
        alone = self._passes(path, window, FEATURES, job)
        inside = _slices(window)
        counts = amodal_counts(
            traced.part_id[inside].ravel(),
            traced.depth_m[inside].ravel(),
            alone.part_id.ravel(),
            alone.depth_m.ravel(),
        )
        pixel = np.arange(traced.part_id.size).reshape(traced.part_id.shape)[inside].ravel()
        seen = pixel, alone.part_id.ravel()
        return add_hidden_centers(counts, job.frame, job.eye, self._stage.triangles_m, seen)


def _noise_fraction(
    half_differences: dict[Eye, _HalfDifference],
    eyes: dict[Eye, EyeRadiance],
    background: dict[Eye, NDArray[np.float32]],
) -> float:
    """Root mean square error of luminance over root mean square luminance, on the drogue's pixels, edges included.

    The halves of one sample sequence avoid each other's places, so that this overestimates the error of their mean.
    """
    errors, values = [], []
    for eye, difference in half_differences.items():
        pixel, light = difference.pixel, difference.light
        through = light[:, :3] - light[:, 3:] * background[eye].reshape(-1, 3)[pixel]
        errors.append(through @ REC709_LUMINANCE)
        values.append(eyes[eye].radiance_cd_m2.reshape(-1, 3)[pixel] @ REC709_LUMINANCE)
    squares = [np.sum(np.square(np.concatenate(rows)), dtype=np.float64) for rows in (errors, values)]
    return float(np.sqrt(squares[0] / max(squares[1], 1e-30)))


def _places_px(window: ImageWindow) -> NDArray[np.float64]:
    """(h, w, 2) pixel centres in the whole image. [px]"""
    v, u = np.mgrid[_slices(window)].astype(np.float64)
    return np.stack([u, v], axis=-1)


def _slices(window: ImageWindow) -> tuple[slice, slice]:
    return (
        slice(window.top_px, window.top_px + window.height_px),
        slice(window.left_px, window.left_px + window.width_px),
    )


def _empty_eye(frame: FrameSpec) -> TracedEye:
    camera = frame.rig.camera
    return TracedEye.empty(camera.height_px, camera.width_px)
