"""Has a plain script around Blender make a pair, in Blender's own process."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geometry.stereo import EYES, Eye
from render.blender_engine.camera_path import EyePath
from render.blender_engine.messages import FrameSetup, Window
from render.blender_engine.picture_arrays import read_light
from render.blender_engine.process import bpy_version
from render.blender_engine.stage import Stage
from scenes.environment_radiance import surroundings
from scenes.sky.clear_sky import REC709_LUMINANCE
from studies.render_cost.cycles_orders import CyclesOrder, DenoisedPicture
from studies.render_cost.noise_search import Cost, NoiseAt, noise_of, reach_noise
from studies.render_cost.views import View

_PILOT_SAMPLES = 4
_MOST_PATHS = 20_000_000


def measure_plain_cycles(view: View, noise: float, full_samples: int | None) -> tuple[NoiseAt, Cost]:
    """Samples and cost of a denoised pair with a given noise; starting Blender and loading the scene do not count.

    Noise is measured around the drogue, and the cost over every pixel of both eyes.

    Args:
        view: what to draw.
        noise: to be reached.
        full_samples: most samples over every pixel; with fewer than needed the cost is a lower bound.

    Raises:
        ValueError: Blender is not installed.
        OSError: its process failed; says what it said last.
    """
    bpy_version()
    setup = Stage().set_frame(view.frame, surroundings(view.frame.environment))
    around = view.crop

    def noise_at(samples: int) -> NoiseAt:
        orders = [_Wanted("left", around, samples, seed) for seed in (1, 2)]
        (_, one), (_, other) = _taken(view, setup, orders)
        return noise_of(samples, (one, other), view.masks)

    found = reach_noise(noise_at, noise, _PILOT_SAMPLES, max(_PILOT_SAMPLES, _MOST_PATHS // view.masks[0].size))
    camera = view.frame.rig.camera
    whole = (0, 0, camera.width_px, camera.height_px)
    samples = min(found.samples, full_samples or found.samples)
    # The first one loads the scene.
    orders = [_Wanted("left", around, 1, 1), *(_Wanted(eye, whole, samples, 1) for eye in EYES)]
    spent_s = [cpu_s for cpu_s, _ in _taken(view, setup, orders)]
    return found, Cost(sum(spent_s[1:]), samples < found.samples)


@dataclass(frozen=True)
class _Wanted:
    eye: Eye
    crop: tuple[int, int, int, int]
    samples: int
    seed: int


def _taken(view: View, setup: FrameSetup, orders: list[_Wanted]) -> list[tuple[float, NDArray[np.float32]]]:
    """CPU time and luminance of each picture. [s, unit of the light]"""
    camera = view.frame.rig.camera
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        files = [Path(folder) / str(index) for index in range(len(orders))]
        pictures = []
        for order, file in zip(orders, files, strict=True):
            window = Window(*order.crop, camera.fx_px, (camera.cx_px, camera.cy_px))
            path = EyePath(view.frame, order.eye, np.zeros((0, 3), dtype=np.float32)).still
            bounces = view.settings.max_depth - 2
            pictures.append(DenoisedPicture(window, path, order.samples, bounces, order.seed, str(file)))
        spent_s = _run(CyclesOrder(setup, tuple(pictures)), Path(folder))
        unit = np.float32(setup.light.unit_cd_m2)
        seen = [read_light(file.with_suffix(".exr"))[..., :3] @ REC709_LUMINANCE * unit for file in files]
    return list(zip(spent_s, seen, strict=True))


def _run(order: CyclesOrder, folder: Path) -> list[float]:
    """CPU time of each picture. [s]"""
    ended = subprocess.run(
        # -P: a file that lies where the user works must not stand in for a module of Blender's.
        [sys.executable, "-P", "-m", "studies.render_cost.cycles_script"],
        input=pickle.dumps(order),
        capture_output=True,
        env={**os.environ, "BLENDER_USER_RESOURCES": str(folder)},
        check=False,
    )
    if ended.returncode != 0:
        last = ended.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise OSError(f"Blender's process ended with status {ended.returncode}: {' '.join(last)}")
    spent_s: list[float] = json.loads(ended.stdout)
    return spent_s
