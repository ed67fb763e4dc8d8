"""The laser rangefinder that a bench experiment takes for the truth, with its errors."""

from __future__ import annotations

from pydantic import Field

from drogue_models.frozen_model import FrozenModel


class Rangefinder(FrozenModel):
    """A rangefinder beside the left camera that measures the distance of the rim centre along the optical axis.

    A reading is the distance, plus an offset, plus noise, rounded. The defaults are those of a hand-held meter for
    building sites, whose data sheets give +-2 mm at two standard deviations (ISO 16331-1) and a last digit of 1 mm; the
    offset is our assumption for a zero mark set by hand.

    Attributes:
        offset_m: largest distance, either way, between the rangefinder's zero and the camera's; drawn once a dataset.
            [m]
        noise_m: standard deviation of a reading. [m]
        resolution_m: step of its last digit, 0 for none. [m]
    """

    offset_m: float = Field(default=0.003, ge=0, le=1)
    noise_m: float = Field(default=0.001, ge=0, le=1)
    resolution_m: float = Field(default=0.001, ge=0, le=1)
