"""A second hose and drogue in view, which navigation does not seek."""

from __future__ import annotations

from pydantic import Field

from datasets_manifest.types.appearance import DrogueCondition
from datasets_manifest.types.field_types import Points3, Transform
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import DrogueParameters
from drogue_models.surroundings.hose_look import HoseLook


class OtherDrogue(FrozenModel):
    """Another hose and drogue; during the exposure it moves with the drogue that is sought.

    Attributes:
        drogue: its dimensions and paint.
        condition: of its surfaces, or None when it is as new.
        left_from_drogue: pose at mid-exposure.
        hose_nodes_left_m: (K, 3) centre line of its hose from coupling to exit in the left camera. [m]
        hose_look: paint of its hose, or None for the drogue's structural paint.
        left_from_tanker: pose of the second tanker, of the first one's type, that its hose comes from; None where it
            comes from the first one.
    """

    drogue: DrogueParameters
    condition: DrogueCondition | None = None
    left_from_drogue: Transform
    hose_nodes_left_m: Points3
    hose_look: HoseLook | None = None
    left_from_tanker: Transform | None = Field(default=None, exclude_if=lambda pose: pose is None)
