"""Our own way to a pair, from drawing the frame to the sensor's numbers. Runs in a process of its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from render.camera.sensor import expose
from render.compositing import inside_one_part
from render.engine import load_engine
from render.mitsuba_engine.trace_request import OF_DROGUE
from scenes.sky.clear_sky import REC709_LUMINANCE
from studies.render_cost.noise_search import Cost, NoiseAt, cpu_seconds, relative_noise
from studies.render_cost.views import View, frame_at, recipe_at, reseeded

_PICTURES_FOR_NOISE = 4


def measure_own_path(distance_m: float, seed: int, repeat: int) -> tuple[NoiseAt, Cost, View]:
    """Cost and noise of our path with the settings that a recipe has by default.

    Args:
        distance_m: of the drogue. [m]
        seed: of the frame.
        repeat: pairs over which the cost is averaged; fewer than `SCENES`.

    Returns:
        Noise, cost, and the view for the others.
    """
    cv2.setNumThreads(1)
    engine = load_engine("mitsuba")
    settings = recipe_at(distance_m, seed).render
    # Loading the engine and compiling its kernels does not count.
    engine.render(frame_at(distance_m, seed, index=repeat), settings)
    spent_s = 0.0
    # Each in a scene of its own, so that no sky is at hand already; the last one is the view that all draw.
    for index in reversed(range(repeat)):
        began_s = cpu_seconds()
        frame = frame_at(distance_m, seed, index)
        radiance = engine.render(frame, settings)
        expose(frame, radiance)
        spent_s += cpu_seconds() - began_s

    def luminance(drawn: FrameSpec) -> NDArray[np.float64]:
        seen: NDArray[np.float64] = engine.render(drawn, settings).left.radiance_cd_m2 @ REC709_LUMINANCE
        return seen

    drogue = OF_DROGUE[radiance.left.part_id] > 0
    inside = drogue & inside_one_part(radiance.left.part_id)
    seen = [luminance(reseeded(frame, by)) for by in range(_PICTURES_FOR_NOISE)]
    pairs = list(zip(seen[::2], seen[1::2], strict=True))
    noise, noise_inside = (
        float(np.sqrt(np.mean([relative_noise(one, other, mask) ** 2 for one, other in pairs])))
        for mask in (drogue, inside)
    )
    mean = float(np.mean(seen, axis=0)[drogue].mean())
    found = NoiseAt(settings.samples_per_px, noise, noise_inside, mean)
    return found, Cost(spent_s / repeat), View(frame, settings, drogue, inside)
