"""The three Blender scenes of a stage (everything lit, everything for the passes, features alone) and their materials.

The stage stands still; camera, sun and sky move around it. Only Blender's own process imports this module.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from render.blender_engine.messages import (
    FEATURES,
    LIGHT,
    NORMAL_PASS,
    PASSES,
    FrameSetup,
    PartMesh,
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
        if self._map is not None:
            replace_image(self._map, appearance.reflectance)
        else:
            self._diffuse.inputs["Color"].default_value = (*appearance.reflectance.tolist(), 1.0)
        fraction, roughness = appearance.sheen or (0.0, 1.0)
        self._sheen.inputs["Fac"].default_value = fraction
        # Blender's roughness is the root of the distribution's width.
        self._facets.inputs["Roughness"].default_value = roughness**0.5
        strength = float(appearance.emission_cd_m2.max())
        color = appearance.emission_cd_m2 / strength if strength > 0 else np.zeros(3)
        self._emission.inputs["Color"].default_value = (*color.tolist(), 1.0)
        self._emission.inputs["Strength"].default_value = strength / unit_cd_m2


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
    """

    def __init__(self) -> None:
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
        for name, vertices_m in setup.moved_m.items():
            mesh = self._objects[name].data
            mesh.vertices.foreach_set("co", vertices_m.ravel())
            mesh.update()
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
        for name, part in stage.features.items():
            self.scenes[FEATURES].collection.objects.link(_mesh_object(name, part))

    def _set_light(self, light: StageLight) -> None:
        self._sky.set(light)
        # A sun lamp shines along its own -z.
        towards, _ = Rotation.align_vectors([light.to_sun], [[0.0, 0.0, 1.0]])
        self._sun.rotation_quaternion = towards.as_quat(scalar_first=True)
        strength = float(light.sun.max())
        self._sun.data.energy = strength
        self._sun.data.color = (light.sun / strength).tolist() if strength > 0 else (0.0, 0.0, 0.0)


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
        angles = Rotation.from_matrix(light.world_from_stage).as_euler("xyz")
        self._turn.inputs["Rotation"].default_value = angles.tolist()


def _mesh_object(name: str, part: PartMesh) -> Any:
    mesh = bpy.data.meshes.new(name)
    count = len(part.faces)
    mesh.vertices.add(len(part.vertices_m))
    mesh.vertices.foreach_set("co", part.vertices_m.ravel())
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", part.faces.ravel())
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(count, part.smooth))
    if part.map_uv is not None:
        layer = mesh.uv_layers.new(name="map")
        layer.uv.foreach_set("vector", part.map_uv[part.faces.ravel()].ravel())
    mesh.update()
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
