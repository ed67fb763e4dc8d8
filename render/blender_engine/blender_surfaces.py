"""Blender's materials: matt, even or with a map, with a sheen, or shining. Imported only in Blender's own process."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from render.blender_engine.messages import Look


class Surface:
    """The surface of one thing.

    Attributes:
        material: Blender's.
    """

    def __init__(self, name: str, has_map: bool) -> None:
        self.material = bpy.data.materials.new(name)
        # Lamps count where a path meets them, as in the other engine.
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

    def set(self, look: Look, unit_cd_m2: float) -> None:
        """Give the surface a look."""
        if self._map is not None:
            replace_image(self._map, look.reflectance)
        else:
            self._diffuse.inputs["Color"].default_value = (*look.reflectance.tolist(), 1.0)
        fraction, roughness = look.sheen or (0.0, 1.0)
        self._sheen.inputs["Fac"].default_value = fraction
        # Blender's roughness is the root of the distribution's width.
        self._facets.inputs["Roughness"].default_value = roughness**0.5
        strength = float(look.emission_cd_m2.max())
        color = look.emission_cd_m2 / strength if strength > 0 else np.zeros(3)
        self._emission.inputs["Color"].default_value = (*color.tolist(), 1.0)
        self._emission.inputs["Strength"].default_value = strength / unit_cd_m2


def replace_image(node: Any, rgb: NDArray[np.floating[Any]]) -> None:
    """Give an image node a new image.

    Args:
        node: shows it.
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
