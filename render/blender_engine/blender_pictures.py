"""Taking one picture of a Blender scene. Imported only in Blender's own process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from render.blender_engine.blender_lens import set_real_eye
from render.blender_engine.blender_scene import BlenderScene, set_threads
from render.blender_engine.messages import LIGHT, CameraPath, Picture

# Only the lens's ratio to the sensor's width counts, and Blender has no narrow sensors but lenses of any length.
_SENSOR_WIDTH_MM = 36.0
_NEAREST_M, _FARTHEST_M = 0.01, 1e5
# The filter is a coarse table: a sample meant for the centre misses it by up to a thousandth of the width.
_NARROWEST_FILTER_PX = 0.01
_MIDDLE_FRAME = 1


def take_picture(scene: BlenderScene, order: Picture) -> None:
    """Render and write one picture as EXR of 32-bit floats."""
    target = scene.scenes[order.kind]
    _set_lens(scene.camera.data, order)
    _set_path(scene.camera, order.path)
    _set_output(target, order)
    _set_sampling(target, order)
    target.render.use_motion_blur = len(order.path.positions_m) > 1
    target.frame_set(_MIDDLE_FRAME)
    bpy.ops.render.render(write_still=True, scene=target.name)


def _set_lens(camera: Any, order: Picture) -> None:
    window = order.window
    camera.clip_start, camera.clip_end = _NEAREST_M, _FARTHEST_M
    if window.eye is not None:
        set_real_eye(camera, window, window.eye, Path(order.file).parent)
        return
    camera.type = "PERSP"
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = _SENSOR_WIDTH_MM
    camera.lens = _SENSOR_WIDTH_MM * window.focal_px / window.width_px
    # From the middle of the window to the principal point; both shifts count in widths.
    to_right = window.center_px[0] - (window.left_px + (window.width_px - 1) / 2)
    to_down = window.center_px[1] - (window.top_px + (window.height_px - 1) / 2)
    camera.shift_x, camera.shift_y = -to_right / window.width_px, to_down / window.width_px


def _set_path(camera: Any, path: CameraPath) -> None:
    camera.animation_data_clear()
    count = len(path.positions_m)
    if count == 1:
        camera.location, camera.rotation_quaternion = path.positions_m[0], path.quaternions[0]
        return
    # 2^n + 1 moments, and Blender looks at the camera at exactly these.
    camera.cycles.motion_steps = int(np.log2(count - 1))
    moments = _MIDDLE_FRAME + np.linspace(-0.5, 0.5, count)
    for moment, position, quaternion in zip(moments, path.positions_m, path.quaternions, strict=True):
        camera.location, camera.rotation_quaternion = position, quaternion
        camera.keyframe_insert("location", frame=moment)
        camera.keyframe_insert("rotation_quaternion", frame=moment)


def _set_output(scene: Any, order: Picture) -> None:
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = order.window.width_px, order.window.height_px
    render.resolution_percentage = 100
    render.film_transparent = True
    render.use_persistent_data = True
    set_threads(scene)
    render.motion_blur_position, render.motion_blur_shutter = "CENTER", 1.0
    render.use_compositing = render.use_sequencer = False
    settings = render.image_settings
    settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_depth, settings.exr_codec = "32", "NONE"
    render.filepath = order.file


def _set_sampling(scene: Any, order: Picture) -> None:
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_auto_tile = False
    cycles.sampling_pattern = "TABULATED_SOBOL"
    first, count = order.samples
    cycles.samples = first + count
    cycles.use_sample_subset = True
    cycles.sample_offset, cycles.sample_subset_length = first, count
    cycles.seed = order.seed
    # Nothing is cut off or ended by lot: what is left out would be missing from the mean or add noise.
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = cycles.blur_glossy = 0.0
    cycles.min_light_bounces = cycles.max_bounces = order.bounces
    cycles.diffuse_bounces = cycles.glossy_bounces = order.bounces
    cycles.use_light_tree = False
    if order.kind == LIGHT:
        cycles.pixel_filter_type = "BOX"
    else:
        cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", _NARROWEST_FILTER_PX
