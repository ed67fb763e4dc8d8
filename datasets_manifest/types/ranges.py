"""A range that something is drawn from."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel

Fraction = Annotated[float, Field(ge=0, le=1)]


class Range(FrozenModel):
    """A uniform draw between `low` and `high`; equal ends give a constant. In TOML also `[low, high]` or a number."""

    low: float
    high: float

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, value: object) -> object:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return {"low": value, "high": value}
        if isinstance(value, list | tuple) and len(value) == 2:
            return {"low": value[0], "high": value[1]}
        return value

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low end {self.low:g} is above high end {self.high:g}")
        return self

    def within(self, low: float, high: float, name: str) -> None:
        """Check that the whole range lies in [low, high].

        Raises:
            ValueError: it does not.
        """
        if not (low <= self.low and self.high <= high):
            raise ValueError(f"{name}: must lie in [{low:g}, {high:g}], got [{self.low:g}, {self.high:g}]")
