"""The three Blender scenes of a stage, and pictures of them: everything lit, everything for the passes, features alone.

The stage stands still; camera, sun and sky move around it. A camera is a pinhole or has a lens with distortion. Only
Blender's own process imports this module, which needs `bpy`, numpy and the standard library alone.
"""

from __future__ import annotations

import hashlib
import importlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from render.blender_engine.messages import (
    FEATURES,
    LIGHT,
    NORMAL_PASS,
    PASSES,
    CameraPath,
    DistortedEye,
    FrameSetup,
    ImageWindow,
    MovedMesh,
    PartMesh,
    PictureRequest,
    StageLight,
    StageObjects,
    SurfaceAppearance,
)


class SurfaceMaterial:
    """The material of one object: matt, with an even colour or a map, possibly with a sheen, possibly emitting.

    Attributes:
        material: Blender's.
    """

    def __init__(self, name: str, has_map: bool) -> None:
        self.material = bpy.data.materials.new(name)
        # Lamps count where a path hits them, as in the Mitsuba engine.
        self.material.cycles.emission_sampling = "NONE"
        nodes, links = self.material.node_tree.nodes, self.material.node_tree.links
        nodes.clear()
        output, both = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeAddShader")
        self._diffuse, self._emission = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeEmission")
        self._diffuse.inputs["Roughness"].default_value = 0.0
        self._camera_only: Any = None
        self._map = None
        if has_map:
            self._map = nodes.new("ShaderNodeTexImage")
            self._map.extension = "EXTEND"
            links.new(self._map.outputs["Color"], self._diffuse.inputs["Color"])
        self._sheen, self._facets = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeBsdfAnisotropic")
        self._facets.distribution = "GGX"
        self._facets.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        links.new(self._diffuse.outputs["BSDF"], self._sheen.inputs[1])
        links.new(self._facets.outputs["BSDF"], self._sheen.inputs[2])
        links.new(self._sheen.outputs["Shader"], both.inputs[0])
        links.new(self._emission.outputs["Emission"], both.inputs[1])
        links.new(both.outputs["Shader"], output.inputs["Surface"])

    def set(self, appearance: SurfaceAppearance, unit_cd_m2: float) -> None:
        """Set what the surface reflects and emits."""
        if appearance.reflectance is not None:
            self._set_paint(appearance.reflectance)
        if not appearance.lights_others and self._camera_only is None:
            self._camera_only = self._seen_by_camera_only()
        fraction, roughness = appearance.sheen or (0.0, 1.0)
        self._sheen.inputs["Fac"].default_value = fraction
        # Blender's roughness is the root of the distribution's width.
        self._facets.inputs["Roughness"].default_value = roughness**0.5
        strength = float(appearance.emission_cd_m2.max())
        color = appearance.emission_cd_m2 / strength if strength > 0 else np.zeros(3)
        self._emission.inputs["Color"].default_value = (*color.tolist(), 1.0)
        held = self._emission.inputs["Strength"] if self._camera_only is None else self._camera_only
        held.default_value = strength / unit_cd_m2

    def _set_paint(self, reflectance: NDArray[np.floating[Any]]) -> None:
        if self._map is not None:
            replace_image(self._map, reflectance)
        else:
            self._diffuse.inputs["Color"].default_value = (*reflectance.tolist(), 1.0)

    def _seen_by_camera_only(self) -> Any:
        """Let other surfaces see no emission; returns the input that then holds its strength."""
        nodes, links = self.material.node_tree.nodes, self.material.node_tree.links
        path, product = nodes.new("ShaderNodeLightPath"), nodes.new("ShaderNodeMath")
        product.operation = "MULTIPLY"
        links.new(path.outputs["Is Camera Ray"], product.inputs[0])
        links.new(product.outputs["Value"], self._emission.inputs["Strength"])
        return product.inputs[1]


def replace_image(node: Any, rgb: NDArray[np.floating[Any]]) -> None:
    """Give an image node a new image.

    Args:
        node: of Blender, which shows an image.
        rgb: (h, w, 3), its first row at the bottom.
    """
    before = node.image
    height, width = rgb.shape[:2]
    image = bpy.data.images.new("map", width, height, float_buffer=True, alpha=False)
    image.colorspace_settings.name = "Non-Color"
    image.use_half_precision = False
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = rgb
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    node.image = image
    if before is not None:
        bpy.data.images.remove(before)


class BlenderScene:
    """The three scenes, and the objects in them.

    Attributes:
        scenes: by kind of picture.
        camera: the one camera of all of them.
        carried: objects that fly with the camera.
        device: that Cycles renders on, `CPU` or `GPU`.
    """

    def __init__(self) -> None:
        self.device = "CPU"
        first = bpy.data.scenes[0]
        for item in [*first.objects]:
            bpy.data.objects.remove(item)
        first.name = LIGHT
        self.scenes: dict[str, Any] = {LIGHT: first}
        for kind in (PASSES, FEATURES):
            self.scenes[kind] = bpy.data.scenes.new(kind)
        self.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        self.camera.rotation_mode = "QUATERNION"
        self._sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
        self._sun.rotation_mode = "QUATERNION"
        self._sun.data.angle = 0.0
        self._sky = _Sky()
        self.carried: list[Any] = []
        self._objects: dict[str, Any] = {}
        self._surfaces: dict[str, SurfaceMaterial] = {}
        probe = _probe_material()
        for kind, scene in self.scenes.items():
            scene.collection.objects.link(self.camera)
            scene.camera = self.camera
            if kind == LIGHT:
                scene.collection.objects.link(self._sun)
                scene.world = self._sky.world
            else:
                layer = scene.view_layers[0]
                layer.material_override = probe
                layer.use_pass_z = layer.use_pass_object_index = True
                layer.aovs.add().name = NORMAL_PASS

    def set_frame(self, setup: FrameSetup) -> None:
        """Set objects, surfaces and lights as a frame has them."""
        if setup.stage is not None:
            self._replace_objects(setup.stage)
        for name, moved in setup.moved.items():
            _set_vertices(self._objects[name].data, moved)
        for name, appearance in setup.appearances.items():
            self._surfaces[name].set(appearance, setup.light.unit_cd_m2)
        self._set_light(setup.light)

    def _replace_objects(self, stage: StageObjects) -> None:
        bpy.data.batch_remove([*self._objects.values(), *self.scenes[FEATURES].collection.objects.values()[1:]])
        bpy.data.batch_remove([*bpy.data.meshes, *(surface.material for surface in self._surfaces.values())])
        self._objects, self._surfaces = {}, {}
        for name, part in stage.objects.items():
            self._objects[name] = _mesh_object(name, part)
            self._surfaces[name] = SurfaceMaterial(name, part.map_uv is not None)
            self._objects[name].data.materials.append(self._surfaces[name].material)
            for kind in (LIGHT, PASSES):
                self.scenes[kind].collection.objects.link(self._objects[name])
        self.carried = [self._objects[name] for name, part in stage.objects.items() if part.flies_with_camera]
        for name, part in stage.features.items():
            self.scenes[FEATURES].collection.objects.link(_mesh_object(name, part))

    def _set_light(self, light: StageLight) -> None:
        self._sky.set(light)
        # A sun lamp shines along its own -z.
        self._sun.rotation_quaternion = light.stage_from_sun
        strength = float(light.sun.max())
        self._sun.data.energy = strength
        self._sun.data.color = (light.sun / strength).tolist() if strength > 0 else (0.0, 0.0, 0.0)


def choose_gpu() -> str | None:
    """Let Cycles use the first GPU that OptiX finds, and nothing else.

    Lenses with distortion are drawn on GPUs by OptiX alone, not by CUDA.

    Returns:
        Its name, or None where there is none.
    """
    preferences = bpy.context.preferences.addons["cycles"].preferences
    found = [device for device in preferences.get_devices_for_type("OPTIX") if device.type == "OPTIX"]
    if not found:
        return None
    preferences.compute_device_type = "OPTIX"
    for device in preferences.devices:
        device.use = device.type == "OPTIX" and device.id == found[0].id
    return str(found[0].name)


def set_threads(scene: Any) -> None:
    """Let Cycles use two threads: with one, TBB keeps a second thread awake that does nothing.

    Two threads on one core take no more CPU time than one; pixels stay the same.
    """
    scene.render.threads_mode, scene.render.threads = "FIXED", 2


class _Sky:
    """The sky map, in the stage's axes."""

    def __init__(self) -> None:
        self.world = bpy.data.worlds.new("sky")
        # Paths end in the sky, as in the Mitsuba engine; it is too even to be worth sampling as a light.
        self.world.cycles.sampling_method = "NONE"
        nodes, links = self.world.node_tree.nodes, self.world.node_tree.links
        nodes.clear()
        direction = nodes.new("ShaderNodeTexCoord")
        self._turn = nodes.new("ShaderNodeMapping")
        self._turn.vector_type = "VECTOR"
        self._texture = nodes.new("ShaderNodeTexEnvironment")
        background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
        links.new(direction.outputs["Generated"], self._turn.inputs["Vector"])
        links.new(self._turn.outputs["Vector"], self._texture.inputs["Vector"])
        links.new(self._texture.outputs["Color"], background.inputs["Color"])
        links.new(background.outputs["Background"], output.inputs["Surface"])

    def set(self, light: StageLight) -> None:
        """Replace the map and its rotation."""
        # Blender's map runs from the nadir up; its middle column looks along +x, and the next ones turn to -y.
        turned = np.roll(light.sky[::-1, ::-1], -light.sky.shape[1] // 2, axis=1)
        replace_image(self._texture, turned)
        self._turn.inputs["Rotation"].default_value = light.world_from_stage_rad.tolist()


def _set_vertices(mesh: Any, placed: MovedMesh) -> None:
    mesh.vertices.foreach_set("co", placed.vertices_m.ravel())
    if placed.map_uv is not None:
        corners = np.empty(len(mesh.loops), dtype=np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        mesh.uv_layers["map"].uv.foreach_set("vector", placed.map_uv[corners].ravel())
    mesh.update()
    if placed.normals is not None:
        mesh.normals_split_custom_set_from_vertices(placed.normals)


def _mesh_object(name: str, part: PartMesh) -> Any:
    mesh = bpy.data.meshes.new(name)
    count = len(part.faces)
    mesh.vertices.add(len(part.vertices_m))
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", part.faces.ravel())
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(count, part.smooth))
    if part.map_uv is not None:
        mesh.uv_layers.new(name="map")
    _set_vertices(mesh, MovedMesh(part.vertices_m, part.map_uv, part.normals))
    item = bpy.data.objects.new(name, mesh)
    item.pass_index = part.part_id
    # Moves shadow rays off coarse smooth meshes; these meshes are fine, and the Mitsuba engine does nothing similar.
    item.cycles.shadow_terminator_geometry_offset = 0.0
    return item


def _probe_material() -> Any:
    """A material that writes the normal of its face, and at which paths end."""
    material = bpy.data.materials.new("probe")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    # A material that neither emits nor reflects would count as a hole.
    output, shine = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeEmission")
    geometry, written = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeOutputAOV")
    written.aov_name = NORMAL_PASS
    links.new(shine.outputs["Emission"], output.inputs["Surface"])
    links.new(geometry.outputs["True Normal"], written.inputs["Color"])
    return material


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
    _carry(scene.carried, scene.camera, request.path)
    _set_output(target, request)
    _set_sampling(target, request, scene.device)
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


def _carry(objects: list[Any], camera: Any, path: CameraPath) -> None:
    """Let objects fly with the camera while it moves, from their places at mid-exposure."""
    count = len(path.positions_m)
    turned = mathutils.Quaternion(path.quaternions[count // 2].tolist()).to_matrix().to_4x4()
    stage_from_camera = mathutils.Matrix.Translation(path.positions_m[count // 2].tolist()) @ turned
    for item in objects:
        item.parent = camera if count > 1 else None
        item.matrix_parent_inverse = stage_from_camera.inverted()
        item.cycles.motion_steps = camera.cycles.motion_steps


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


def _set_sampling(scene: Any, request: PictureRequest, device: str) -> None:
    cycles = scene.cycles
    cycles.device = device
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
    compile_ = getattr(cycles, "osl_compile", None)  # missing from Debian's Blender, for one
    if compile_ is None or not compile_(str(text), str(result)):
        raise RuntimeError("this Blender was built without Open Shading Language, which real lenses need")
    return result.read_text(encoding="ascii")
