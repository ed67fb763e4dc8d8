"""What a frame's target looks like besides its dimensions: the state of its surfaces, and what else is in the air."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from datasets_manifest.types.json_types import Transform
from drogue_models.bystanders import BystanderShape
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import ReflectanceRgb


class SurfaceCondition(FrozenModel):
    """How one marker, or the hub, has aged.

    Attributes:
        missing: it has come off; the dark face shows in its place.
        reflectance_fraction: what age has left of the paint's reflectance.
        dirt_fraction: share of its area under dirt.
        dirt_seed: of the pattern of the dirt.
        lamp_fraction: what a self-lit marker still gives of its luminance; 0 has failed.
    """

    missing: bool = False
    reflectance_fraction: float = Field(default=1.0, ge=0, le=1)
    dirt_fraction: float = Field(default=0.0, ge=0, le=1)
    dirt_seed: int = Field(default=0, ge=0)
    lamp_fraction: float = Field(default=1.0, ge=0, le=1)

    @property
    def is_clean(self) -> bool:
        """Whether it reflects and shines evenly over its area."""
        return self.dirt_fraction == 0 or self.missing


AS_NEW = SurfaceCondition()


class DrogueCondition(FrozenModel):
    """State of a drogue in one frame; navigation is never told.

    Attributes:
        markers: in the drogue's order; empty when all are as new.
        hub: of the hub annulus.
        body_reflectance_fraction: what age has left of (below 1) or soot and bleaching have done to face, canopy, ribs,
            coupling and hose (above 1).
    """

    markers: tuple[SurfaceCondition, ...] = ()
    hub: SurfaceCondition = AS_NEW
    body_reflectance_fraction: float = Field(default=1.0, ge=0.1, le=3)

    def of_marker(self, index: int) -> SurfaceCondition:
        """State of one marker."""
        return self.markers[index] if self.markers else AS_NEW


class Bystander(FrozenModel):
    """Something else that stands in the picture; it moves with the drogue while the shutter is open.

    Attributes:
        kind: `probe` of the receiver, `obstacle` close to the cameras, or `distractor`: one may take it for a drogue.
        shape: what it looks like, in its own frame.
        left_from_object: pose at mid-exposure.
        reflectance_rgb: diffuse reflectance in linear Rec. 709.
    """

    kind: Literal["probe", "obstacle", "distractor"]
    shape: BystanderShape
    left_from_object: Transform
    reflectance_rgb: ReflectanceRgb
