"""The base class of all types with a JSON or TOML form, and the physical quantities that many of them hold."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema

Metres = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Reflectance = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
ReflectanceRgb = tuple[Reflectance, Reflectance, Reflectance]
"""Diffuse reflectance in linear Rec. 709 red, green, blue."""


def _fail_fast(schema: Any) -> None:
    """Let the lists of a schema end at their first wrong item: a megabyte has place for a million errors of 1 kB."""
    if isinstance(schema, dict):
        if schema.get("type") in ("list", "set", "frozenset") or "variadic_item_index" in schema:
            schema["fail_fast"] = True
        for key, inner in schema.items():
            if key not in ("metadata", "default"):
                _fail_fast(inner)
    elif isinstance(schema, list):
        for inner in schema:
            _fail_fast(inner)


class FrozenModel(BaseModel):
    """An immutable value that is validated when it is made and rejects unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """The schema, in which a list ends at its first wrong item."""
        schema = handler(source)
        _fail_fast(schema)
        return schema
