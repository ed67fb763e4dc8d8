"""A stereo pair as a plain Blender script renders it: Cycles' own camera and world, equal samples per pixel, denoised.

Runs as Blender's own process, which reads a request from its standard input and prints the CPU time of each picture. No
other module imports it.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
from typing import Any

import bpy

from render.blender_engine.blender_scene import BlenderScene, set_threads
from render.blender_engine.messages import LIGHT
from studies.render_cost.cycles_messages import CyclesRequest, DenoisedPicture, cpu_seconds

_SENSOR_WIDTH_MM = 36.0
_NEAREST_M, _FARTHEST_M = 0.01, 1e5


def main() -> None:
    """Carry out one request."""
    answers = os.fdopen(os.dup(1), "w")
    # Blender prints on standard output, which is redirected to standard error.
    os.dup2(2, 1)
    request: CyclesRequest = pickle.load(sys.stdin.buffer)
    blender = BlenderScene()
    blender.set_frame(request.setup)
    scene = blender.scenes[LIGHT]
    # Blender's default sampling of sky and sun.
    scene.world.cycles.sampling_method = "AUTOMATIC"
    spent_s = []
    for picture in request.pictures:
        began_s = cpu_seconds()
        _render(scene, blender.camera, picture)
        spent_s.append(cpu_seconds() - began_s)
    json.dump(spent_s, answers)
    answers.flush()


def _render(scene: Any, camera: Any, picture: DenoisedPicture) -> None:
    window, lens = picture.window, camera.data
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", _SENSOR_WIDTH_MM
    lens.lens = _SENSOR_WIDTH_MM * window.focal_px / window.width_px
    lens.shift_x = -(window.center_px[0] - window.left_px - (window.width_px - 1) / 2) / window.width_px
    lens.shift_y = (window.center_px[1] - window.top_px - (window.height_px - 1) / 2) / window.width_px
    lens.clip_start, lens.clip_end = _NEAREST_M, _FARTHEST_M
    camera.location, camera.rotation_quaternion = picture.path.positions_m[0], picture.path.quaternions[0]
    render, cycles = scene.render, scene.cycles
    render.engine, cycles.device = "CYCLES", "CPU"
    render.resolution_x, render.resolution_y, render.resolution_percentage = window.width_px, window.height_px, 100
    render.use_persistent_data = True
    set_threads(scene)
    render.use_compositing = render.use_sequencer = False
    render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth, render.image_settings.exr_codec = "32", "NONE"
    render.filepath = picture.file
    cycles.samples, cycles.seed = picture.samples, picture.seed
    cycles.use_adaptive_sampling = False
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.max_bounces = cycles.diffuse_bounces = picture.bounces
    cycles.pixel_filter_type = "BOX"
    bpy.ops.render.render(write_still=True, scene=scene.name)


if __name__ == "__main__":
    main()
