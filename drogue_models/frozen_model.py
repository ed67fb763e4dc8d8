"""The base class of all types with a JSON or TOML form, and the physical quantities that many of them hold."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Metres = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Reflectance = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
ReflectanceRgb = tuple[Reflectance, Reflectance, Reflectance]
"""Diffuse reflectance in linear Rec. 709 red, green, blue."""


class FrozenModel(BaseModel):
    """An immutable value that is validated when it is made and rejects unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
