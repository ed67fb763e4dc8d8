"""The `[neighbours]` section of a recipe: a second hose and drogue in view."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel


class NeighbourRanges(FrozenModel):
    """Distribution of second drogues, of the scene's own kind, with hoses as `[hose]` has them.

    The second drogue hangs behind another tanker that flies ahead and beside, on the same heading. It is farther away
    than the one that is sought, and does not lie behind it in the image.

    Attributes:
        scene_fraction: share of scenes with a second drogue in view.
        distance_fraction: its distance along the optical axis over that of the drogue that is sought.
        same_tanker_fraction: share of these scenes in which its hose comes from another station of the first tanker, if
            that keeps it in view.
        station_m: distance of that station from the first hose, along the wing. [m]
    """

    scene_fraction: Fraction = 0.25
    distance_fraction: Range = Range(low=1.2, high=3.0)
    same_tanker_fraction: Fraction = 0.5
    station_m: Range = Range(low=3.0, high=12.0)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        # The sought one stays the nearest, so that it can be told.
        self.distance_fraction.within(1.15, 20, "distance_fraction")
        self.station_m.within(1.5, 60, "station_m")
        return self
