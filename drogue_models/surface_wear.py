"""How worn all surfaces of a drogue are; which marks each part shows follows from the drogue's kind."""

from __future__ import annotations

from pydantic import Field

from drogue_models.frozen_model import FrozenModel


class SurfaceWear(FrozenModel):
    """Wear of a drogue in use; every share is 0 for none and 1 for the most that is seen in service.

    Attributes:
        seed: of all patterns.
        soot: dark film of exhaust and dust in clouds and streaks.
        oil: streaks of hydraulic fluid and fuel from the coupling along the flow.
        edge_wear: paint rubbed through to bare metal along edges and where probes touch.
        fading: bleached, chalky paint in clouds.
        stitching: contrast of seams and stitches of fabric, of rivets and screws of metal.
        tape: strips of worn tape around struts and tubes.
    """

    seed: int = Field(ge=0, lt=2**31)
    soot: float = Field(default=0.3, ge=0, le=1)
    oil: float = Field(default=0.2, ge=0, le=1)
    edge_wear: float = Field(default=0.3, ge=0, le=1)
    fading: float = Field(default=0.3, ge=0, le=1)
    stitching: float = Field(default=0.5, ge=0, le=1)
    tape: float = Field(default=0.0, ge=0, le=1)
