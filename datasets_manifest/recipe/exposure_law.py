"""The `[exposure]` section of a recipe."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.types.ranges import Range
from drogue_models.frozen_model import FrozenModel


class ExposureLaw(FrozenModel):
    """How the exposure is set: by the meter, first with the time, then, when that is at its limit, with the gain.

    Attributes:
        time_s: fixed exposure time; without it the meter chooses within `auto_time_s`. [s]
        auto_gain: what the meter may amplify by; a single number is a fixed gain.
        auto_meter: what the meter looks at: `view`, the brighter of the view's mean and a white plate that faces the
            camera; or `plate`, the plate alone, as one that looks at the drogue and not at the sky behind it.
        auto_level_fraction: where the meter puts that, as a share of the full well, or at other gains of what fills the
            converter.
    """

    time_s: float | None = Field(default=None, gt=0, le=1)
    auto_time_s: Range = Range(low=20e-6, high=20e-3)
    auto_gain: Range = Range(low=1, high=1)
    auto_meter: Literal["view", "plate"] = Field(default="view", exclude_if=lambda meter: meter == "view")
    auto_level_fraction: float = Field(default=0.7, gt=0, le=2)
    f_number: float = Field(default=2.8, ge=0.5, le=64)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.auto_time_s.within(1e-6, 1, "auto_time_s")
        self.auto_gain.within(0.1, 64, "auto_gain")
        return self
