"""A pair as a plain script around Mitsuba makes it: its own sensor, its own path integrator, every pixel alike.

Runs in a process of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import exp_twist
from geometry.stereo import EYES, Eye
from render.engine import load_engine
from scenes.environment_radiance import surroundings
from scenes.sky.clear_sky import REC709_LUMINANCE
from studies.render_cost.noise_search import Cost, NoiseAt, cpu_seconds, noise_of, reach_noise
from studies.render_cost.views import View

STEP = 8
"""Samples of one launch: more are launched again, which bounds memory and is the same to independent samples."""

_NEAREST_M, _FARTHEST_M = 0.01, 1e5
_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


_MOST_PATHS = 100_000_000
_Crop = tuple[int, int, int, int]


def measure_plain_mitsuba(view: View, noise: float) -> tuple[NoiseAt, Cost]:
    """Samples and cost of a pair with a given noise; loading the scene and compiling kernels do not count.

    Noise is measured around the drogue, and the cost with one launch over every pixel of both eyes.

    Args:
        view: what to draw.
        noise: to be reached.
    """
    # Chooses the variant and the number of threads, as for our own path.
    load_engine("mitsuba")
    import mitsuba as mi

    from render.mitsuba_engine.scene import SceneCache

    scene = SceneCache().scene_of(view.frame, surroundings(view.frame.environment)).scene
    # Nothing is ended by lot, as everywhere in this comparison.
    depth = view.settings.max_depth
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": depth + 1})

    def launched(sensor: Any, seed: int) -> NDArray[np.float64]:
        image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=STEP, seed=seed))
        luminance: NDArray[np.float64] = image[..., :3] @ REC709_LUMINANCE
        return luminance

    around = mi.load_dict(_sensor(view, "left", view.crop))

    def noise_at(samples: int) -> NoiseAt:
        launches = -(-samples // STEP)
        one, other = (
            np.mean([launched(around, first * launches + each) for each in range(launches)], axis=0) for first in (0, 1)
        )
        return noise_of(launches * STEP, (one, other), view.masks)

    most_samples = max(STEP, _MOST_PATHS // view.masks[0].size)
    found = reach_noise(noise_at, noise, STEP, most_samples)
    whole = [mi.load_dict(_sensor(view, eye)) for eye in EYES]
    launched(whole[0], 0)
    began_s = cpu_seconds()
    for sensor in whole:
        launched(sensor, 1)
    return found, Cost((cpu_seconds() - began_s) * -(-found.samples // STEP))


def _sensor(view: View, eye: Eye, crop: _Crop | None = None) -> dict[str, Any]:
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
