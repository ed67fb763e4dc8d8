"""The painted surface of any of a frame's bystanders."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.meshes import obstacle_mesh
from drogue_models.obstacles import COCKPIT_FORMS, PLAIN_FORMS, PROBE_FORMS, ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.solids import with_creases
from drogue_models.surroundings.cockpit import cockpit_surface
from drogue_models.surroundings.distractor_bodies import distractor_surface
from drogue_models.surroundings.probes import probe_surface


@lru_cache(maxsize=64)
def bystander_surface(
    shape: ObstacleShape, reflectance_rgb: ReflectanceRgb, luminance_cd_m2: float = 0.0
) -> PaintedMesh:
    """A bystander in its own axes; nobody may change it.

    Args:
        shape: its form and dimensions.
        reflectance_rgb: of its main paint; of a lamp its colour.
        luminance_cd_m2: of a lamp. [cd/m2]
    """
    if shape.form in PLAIN_FORMS:
        return PaintedMesh(mesh=with_creases(obstacle_mesh(shape)), reflectance=np.array(reflectance_rgb), smooth=True)
    if shape.form in PROBE_FORMS:
        return probe_surface(shape, reflectance_rgb)
    if shape.form in COCKPIT_FORMS:
        return cockpit_surface(shape, reflectance_rgb)
    return distractor_surface(shape, reflectance_rgb, luminance_cd_m2)
