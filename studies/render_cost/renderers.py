"""Noise and cost of a stereo pair by our renderer, and by plain scripts around Mitsuba and Blender.

A plain script gives every pixel the same number of samples. Mitsuba renders with its own sensor and path integrator, in
a process of its own; Blender by `cycles_script`.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.se3 import exp_twist
from geometry.stereo import EYES, Eye
from render.blender_engine.camera_path import EyePath
from render.blender_engine.interpreter import find_blender
from render.blender_engine.messages import FrameSetup, ImageWindow
from render.blender_engine.process import read_light
from render.blender_engine.stage import Stage
from render.camera.sensor import expose
from render.compositing import inside_one_part
from render.engine import load_engine
from render.mitsuba_engine.trace_request import DROGUE_PARTS
from scenes.environment_radiance import environment_radiance
from scenes.sky.photometry import REC709_LUMINANCE
from studies.render_cost.cycles_messages import CyclesRequest, DenoisedPicture, cpu_seconds
from studies.render_cost.noise_search import (
    MeasuredView,
    NoiseEstimate,
    RenderCost,
    frame_at,
    noise_of,
    reach_noise,
    recipe_at,
    relative_noise,
    with_seed_offset,
)

STEP = 8
"""Samples of one launch; further launches take the rest, which bounds memory."""
_NEAREST_M, _FARTHEST_M = 0.01, 1e5
_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
_MOST_PATHS_MITSUBA = 100_000_000
_PICTURES_FOR_NOISE = 4
_Crop = tuple[int, int, int, int]
_PILOT_SAMPLES = 4
_MOST_PATHS_CYCLES = 20_000_000


def measure_own_path(distance_m: float, seed: int, repeat: int) -> tuple[NoiseEstimate, RenderCost, MeasuredView]:
    """Noise and cost of our renderer with default settings.

    Args:
        distance_m: of the drogue. [m]
        seed: of the frame.
        repeat: pairs over which the cost is averaged; fewer than `SCENES`.

    Returns:
        Noise, cost, and the view for the other renderers.
    """
    cv2.setNumThreads(1)
    engine = load_engine("mitsuba")
    settings = recipe_at(distance_m, seed).render
    # Loading the engine and compiling kernels do not count.
    engine.render(frame_at(distance_m, seed, index=repeat), settings)
    spent_s = 0.0
    # Each in a scene of its own, so that no sky is cached; the last one is the view that all renderers draw.
    for index in reversed(range(repeat)):
        began_s = cpu_seconds()
        frame = frame_at(distance_m, seed, index)
        radiance = engine.render(frame, settings)
        expose(frame, radiance)
        spent_s += cpu_seconds() - began_s

    def luminance(drawn: FrameSpec) -> NDArray[np.float64]:
        seen: NDArray[np.float64] = engine.render(drawn, settings).left.radiance_cd_m2 @ REC709_LUMINANCE
        return seen

    drogue = DROGUE_PARTS[radiance.left.part_id] > 0
    inside = drogue & inside_one_part(radiance.left.part_id)
    seen = [luminance(with_seed_offset(frame, by)) for by in range(_PICTURES_FOR_NOISE)]
    pairs = list(zip(seen[::2], seen[1::2], strict=True))
    noise, noise_inside = (
        float(np.sqrt(np.mean([relative_noise(one, other, mask) ** 2 for one, other in pairs])))
        for mask in (drogue, inside)
    )
    mean = float(np.mean(seen, axis=0)[drogue].mean())
    found = NoiseEstimate(samples=settings.samples_per_px, noise=noise, noise_inside=noise_inside, mean_cd_m2=mean)
    view = MeasuredView(frame=frame, settings=settings, drogue=drogue, inside=inside)
    return found, RenderCost(spent_s / repeat), view


def measure_plain_mitsuba(view: MeasuredView, noise: float) -> tuple[NoiseEstimate, RenderCost]:
    """Samples and cost of a Mitsuba pair at a given noise; loading the scene and compiling kernels do not count.

    Noise is measured around the drogue, and the cost with one launch over every pixel of both eyes.

    Args:
        view: to render.
        noise: to be reached.
    """
    # Sets the variant and the number of threads, as for our own renderer.
    load_engine("mitsuba")
    import mitsuba as mi

    from render.mitsuba_engine.scene import SceneCache

    scene = SceneCache().scene_of(view.frame, environment_radiance(view.frame.environment)).scene
    # No Russian roulette, as for all renderers of this comparison.
    depth = view.settings.max_depth
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": depth + 1})

    def launched(sensor: Any, seed: int) -> NDArray[np.float64]:
        image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=STEP, seed=seed))
        luminance: NDArray[np.float64] = image[..., :3] @ REC709_LUMINANCE
        return luminance

    around = mi.load_dict(_sensor(view, "left", view.crop))

    def noise_at(samples: int) -> NoiseEstimate:
        launches = -(-samples // STEP)
        one, other = (
            np.mean([launched(around, first * launches + each) for each in range(launches)], axis=0) for first in (0, 1)
        )
        return noise_of(launches * STEP, (one, other), view.masks)

    most_samples = max(STEP, _MOST_PATHS_MITSUBA // view.masks[0].size)
    found = reach_noise(noise_at, noise, STEP, most_samples)
    whole = [mi.load_dict(_sensor(view, eye)) for eye in EYES]
    launched(whole[0], 0)
    began_s = cpu_seconds()
    for sensor in whole:
        launched(sensor, 1)
    return found, RenderCost((cpu_seconds() - began_s) * -(-found.samples // STEP))


def _sensor(view: MeasuredView, eye: Eye, crop: _Crop | None = None) -> dict[str, Any]:
    import mitsuba as mi

    camera = view.frame.rig.camera
    left, top, width, height = crop or (0, 0, camera.width_px, camera.height_px)
    eye_from_left = exp_twist(np.concatenate([-view.frame.rig.eye_offset_m(eye), np.zeros(3)]))
    stage_from_eye = (eye_from_left @ view.frame.left_from_stage_at(0.0)).inverse().as_matrix()
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f((stage_from_eye @ _MITSUBA_FROM_OPENCV).tolist()),
        "fov": float(np.degrees(2 * np.arctan(camera.width_px / 2 / camera.fx_px))),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - (camera.cx_px + 0.5) / camera.width_px,
        "principal_point_offset_y": 0.5 - (camera.cy_px + 0.5) / camera.height_px,
        "near_clip": _NEAREST_M,
        "far_clip": _FARTHEST_M,
        "sampler": {"type": "independent", "sample_count": STEP},
        "film": {
            "type": "hdrfilm",
            "width": camera.width_px,
            "height": camera.height_px,
            "crop_offset_x": left,
            "crop_offset_y": top,
            "crop_width": width,
            "crop_height": height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def measure_plain_cycles(
    view: MeasuredView, noise: float, full_samples: int | None
) -> tuple[NoiseEstimate, RenderCost]:
    """Samples and cost of a denoised Cycles pair at a given noise; starting Blender and loading the scene do not count.

    Noise is measured around the drogue, and the cost over every pixel of both eyes.

    Args:
        view: to render.
        noise: to be reached.
        full_samples: most samples over every pixel; with fewer than needed the cost is a lower bound.

    Raises:
        ValueError: this Python has no Blender; a script of the study runs on it.
        OSError: its process failed; the message has its last line.
    """
    if not find_blender().is_this_python:
        raise ValueError("this study needs Blender's package in this Python: pip install 'droguekit[blender]'")
    setup = Stage().set_frame(view.frame, environment_radiance(view.frame.environment))
    around = view.crop

    def noise_at(samples: int) -> NoiseEstimate:
        requests = [_Request("left", around, samples, seed) for seed in (1, 2)]
        (_, one), (_, other) = _render_pictures(view, setup, requests)
        return noise_of(samples, (one, other), view.masks)

    found = reach_noise(noise_at, noise, _PILOT_SAMPLES, max(_PILOT_SAMPLES, _MOST_PATHS_CYCLES // view.masks[0].size))
    camera = view.frame.rig.camera
    whole = (0, 0, camera.width_px, camera.height_px)
    samples = min(found.samples, full_samples or found.samples)
    # The first one loads the scene.
    requests = [_Request("left", around, 1, 1), *(_Request(eye, whole, samples, 1) for eye in EYES)]
    spent_s = [cpu_s for cpu_s, _ in _render_pictures(view, setup, requests)]
    return found, RenderCost(sum(spent_s[1:]), samples < found.samples)


@dataclass(frozen=True)
class _Request:
    eye: Eye
    crop: tuple[int, int, int, int]
    samples: int
    seed: int


def _render_pictures(
    view: MeasuredView, setup: FrameSetup, requests: list[_Request]
) -> list[tuple[float, NDArray[np.float32]]]:
    """CPU time and luminance of each picture. [s, unit of the light]"""
    camera = view.frame.rig.camera
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        files = [Path(folder) / str(index) for index in range(len(requests))]
        pictures = []
        for request, file in zip(requests, files, strict=True):
            left, top, width, height = request.crop
            window = ImageWindow(
                left_px=left,
                top_px=top,
                width_px=width,
                height_px=height,
                focal_px=camera.fx_px,
                center_px=(camera.cx_px, camera.cy_px),
            )
            path = EyePath(view.frame, request.eye, np.zeros((0, 3), dtype=np.float32)).still
            bounces = view.settings.max_depth - 2
            pictures.append(
                DenoisedPicture(
                    window=window,
                    path=path,
                    samples=request.samples,
                    bounces=bounces,
                    seed=request.seed,
                    file=str(file),
                )
            )
        spent_s = _run(CyclesRequest(setup, tuple(pictures)), Path(folder))
        unit = np.float32(setup.light.unit_cd_m2)
        seen = [read_light(file.with_suffix(".exr"))[..., :3] @ REC709_LUMINANCE * unit for file in files]
    return list(zip(spent_s, seen, strict=True))


def _run(request: CyclesRequest, folder: Path) -> list[float]:
    """CPU time of each picture. [s]"""
    ended = subprocess.run(
        # -P: a file in the working folder must not replace one of Blender's modules.
        [sys.executable, "-P", "-m", "studies.render_cost.cycles_script"],
        input=pickle.dumps(request),
        capture_output=True,
        env={**os.environ, "BLENDER_USER_RESOURCES": str(folder)},
        check=False,
    )
    if ended.returncode != 0:
        last = ended.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise OSError(f"Blender's process ended with status {ended.returncode}: {' '.join(last)}")
    spent_s: list[float] = json.loads(ended.stdout)
    return spent_s
