"""Rendering one picture of a Blender scene, through a pinhole or a lens with distortion.

Only Blender's own process imports this module.
"""

from __future__ import annotations

import hashlib
import importlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from render.blender_engine.blender_scene import BlenderScene, set_threads
from render.blender_engine.messages import LIGHT, CameraPath, DistortedEye, ImageWindow, PictureRequest

# Newton's method doubles the digits with each step; float32 has seven.
_SHADER = """
shader real_eye(output point position = 0.0, output vector direction = 0.0, output color throughput = 1.0)
{{
    point raster = camera_shader_raster_position();
    float seen_x = ({left} - 0.5 + raster.x * {width} - {cx}) / {fx};
    float seen_y = ({top} - 0.5 + (1.0 - raster.y) * {height} - {cy}) / {fy};
    float x = seen_x, y = seen_y;
    for (int step = 0; step < 8; step++) {{
        float r2 = x * x + y * y;
        float radial = 1.0 + r2 * ({k1} + r2 * ({k2} + r2 * {k3}));
        float slope = {k1} + r2 * (2.0 * {k2} + r2 * 3.0 * {k3});
        float off_x = seen_x - (x * radial + 2.0 * {p1} * x * y + {p2} * (r2 + 2.0 * x * x));
        float off_y = seen_y - (y * radial + {p1} * (r2 + 2.0 * y * y) + 2.0 * {p2} * x * y);
        float xx = radial + 2.0 * x * x * slope + 2.0 * {p1} * y + 6.0 * {p2} * x;
        float xy = 2.0 * x * y * slope + 2.0 * {p1} * x + 2.0 * {p2} * y;
        float yy = radial + 2.0 * y * y * slope + 6.0 * {p1} * y + 2.0 * {p2} * x;
        float determinant = xx * yy - xy * xy;
        x += (yy * off_x - xy * off_y) / determinant;
        y += (xx * off_y - xy * off_x) / determinant;
    }}
    float right = {r0} * x + {r1} * y + {r2};
    float down = {r3} * x + {r4} * y + {r5};
    float forward = {r6} * x + {r7} * y + {r8};
    direction = normalize(vector(right, -down, forward));
}}
"""
# Only the ratio of focal length to sensor width counts. Blender limits the sensor width, not the focal length.
_SENSOR_WIDTH_MM = 36.0
_NEAREST_M, _FARTHEST_M = 0.01, 1e5
# Blender tabulates the filter coarsely: a sample at the centre is off by up to a thousandth of its width.
_NARROWEST_FILTER_PX = 0.01
_MIDDLE_FRAME = 1


def render_picture(scene: BlenderScene, request: PictureRequest) -> None:
    """Render and write one picture as EXR of 32-bit floats."""
    target = scene.scenes[request.kind]
    _set_lens(scene.camera.data, request)
    _set_path(scene.camera, request.path)
    _set_output(target, request)
    _set_sampling(target, request)
    target.render.use_motion_blur = len(request.path.positions_m) > 1
    target.frame_set(_MIDDLE_FRAME)
    bpy.ops.render.render(write_still=True, scene=target.name)


def _set_lens(camera: Any, request: PictureRequest) -> None:
    window = request.window
    camera.clip_start, camera.clip_end = _NEAREST_M, _FARTHEST_M
    if window.eye is not None:
        set_distorted_eye(camera, window, window.eye, Path(request.file).parent)
        return
    camera.type = "PERSP"
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = _SENSOR_WIDTH_MM
    camera.lens = _SENSOR_WIDTH_MM * window.focal_px / window.width_px
    # From the middle of the window to the principal point, in units of the window's width.
    to_right = window.center_px[0] - (window.left_px + (window.width_px - 1) / 2)
    to_down = window.center_px[1] - (window.top_px + (window.height_px - 1) / 2)
    camera.shift_x, camera.shift_y = -to_right / window.width_px, to_down / window.width_px


def _set_path(camera: Any, path: CameraPath) -> None:
    camera.animation_data_clear()
    count = len(path.positions_m)
    if count == 1:
        camera.location, camera.rotation_quaternion = path.positions_m[0], path.quaternions[0]
        return
    # Blender evaluates the camera at exactly these 2^n + 1 moments.
    camera.cycles.motion_steps = int(np.log2(count - 1))
    moments = _MIDDLE_FRAME + np.linspace(-0.5, 0.5, count)
    for moment, position, quaternion in zip(moments, path.positions_m, path.quaternions, strict=True):
        camera.location, camera.rotation_quaternion = position, quaternion
        camera.keyframe_insert("location", frame=moment)
        camera.keyframe_insert("rotation_quaternion", frame=moment)


def _set_output(scene: Any, request: PictureRequest) -> None:
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = request.window.width_px, request.window.height_px
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
    render.filepath = request.file


def _set_sampling(scene: Any, request: PictureRequest) -> None:
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_auto_tile = False
    cycles.sampling_pattern = "TABULATED_SOBOL"
    first, count = request.samples
    cycles.samples = first + count
    cycles.use_sample_subset = True
    cycles.sample_offset, cycles.sample_subset_length = first, count
    cycles.seed = request.seed
    # No clamping and no Russian roulette: they would bias the mean or add noise.
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = cycles.blur_glossy = 0.0
    cycles.min_light_bounces = cycles.max_bounces = request.bounces
    cycles.diffuse_bounces = cycles.glossy_bounces = request.bounces
    cycles.use_light_tree = False
    if request.kind == LIGHT:
        cycles.pixel_filter_type = "BOX"
    else:
        cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", _NARROWEST_FILTER_PX


def set_distorted_eye(camera: Any, window: ImageWindow, eye: DistortedEye, folder: Path) -> None:
    """Make a Blender camera render a window of the image of an eye with a lens."""
    camera.type, camera.custom_mode = "CUSTOM", "INTERNAL"
    bytecode = _compiled(_shader_source(window, eye), folder)
    digest = hashlib.md5(bytecode.encode(), usedforsecurity=False).hexdigest()
    if camera.custom_bytecode_hash != digest:
        camera.custom_bytecode, camera.custom_bytecode_hash = bytecode, digest


def _shader_source(window: ImageWindow, eye: DistortedEye) -> str:
    numbers = {
        "left": window.left_px,
        "top": window.top_px,
        "width": window.width_px,
        "height": window.height_px,
        **dict(zip(("fx", "fy"), eye.focal_px, strict=True)),
        **dict(zip(("cx", "cy"), window.center_px, strict=True)),
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), eye.distortion, strict=True)),
        **{f"r{index}": value for index, value in enumerate(eye.ideal_from_real)},
    }
    return _SHADER.format(**{name: f"({float(value)!r})" for name, value in numbers.items()})


@lru_cache(maxsize=64)
def _compiled(source: str, folder: Path) -> str:
    """Bytecode of the lens shader.

    Raises:
        RuntimeError: this Blender cannot compile it.
    """
    # Part of `bpy`; importable once `bpy` is loaded.
    cycles: Any = importlib.import_module("_cycles")
    text, result = folder / "real_eye.osl", folder / "real_eye.oso"
    text.write_text(source, encoding="ascii")
    if not cycles.osl_compile(str(text), str(result)):
        raise RuntimeError("this Blender was built without Open Shading Language, which real lenses need")
    return result.read_text(encoding="ascii")
