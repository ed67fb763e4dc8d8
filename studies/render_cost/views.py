"""What is rendered: one clear-day frame a distance, at rest, and which of its pixels count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import Recipe, RenderSettings, load_recipe
from datasets_manifest.types.frame import FrameSpec
from scenes.sampler import sample_frame

STATIONS_M = (2.0, 5.0, 10.0, 20.0, 40.0)
# What a denoiser may look at beyond the drogue.
_MARGIN_PX = 32
_RECIPE = "daylight-10m"
# Enough for scenes that differ, so that nothing kept from one frame serves the next.
SCENES = 8


@dataclass(frozen=True, eq=False)
class View:
    """What every renderer draws.

    Attributes:
        frame: a drogue in its surroundings.
        settings: those that a recipe has by default.
        drogue: (H, W) pixels of the left eye whose centres see the drogue.
        inside: those of them around which all pixels see the same part.
    """

    frame: FrameSpec
    settings: RenderSettings
    drogue: NDArray[np.bool_]
    inside: NDArray[np.bool_]

    @property
    def crop(self) -> tuple[int, int, int, int]:
        """(left, top, width, height) of the part of the left eye that holds the drogue. [px]"""
        rows, columns = (np.flatnonzero(self.drogue.any(axis=axis)) for axis in (1, 0))
        top, left = max(int(rows[0]) - _MARGIN_PX, 0), max(int(columns[0]) - _MARGIN_PX, 0)
        height, width = self.drogue.shape
        right, bottom = min(int(columns[-1]) + _MARGIN_PX, width - 1), min(int(rows[-1]) + _MARGIN_PX, height - 1)
        return left, top, right - left + 1, bottom - top + 1

    @property
    def masks(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The drogue's pixels and those inside its parts, of the crop."""
        left, top, width, height = self.crop
        within = slice(top, top + height), slice(left, left + width)
        return self.drogue[within], self.inside[within]


def recipe_at(distance_m: float, seed: int) -> Recipe:
    """The recipe with every drogue at one distance. [m]"""
    recipe, _ = load_recipe(_RECIPE, seed)
    changes = {
        "frames": {"count": SCENES, "scenes": SCENES, "empty_fraction": 0.0},
        "distance": {"law": "stations", "stations_m": (distance_m,)},
    }
    return Recipe.model_validate({**recipe.model_dump(), **changes})


def reseeded(frame: FrameSpec, by: int) -> FrameSpec:
    """The same frame with other samples and other noise of the sensor."""
    return frame.model_copy(update={"seed": frame.seed + by})


def frame_at(distance_m: float, seed: int, index: int = 0) -> FrameSpec:
    """A frame at one distance. [m]"""
    return sample_frame(recipe_at(distance_m, seed), index)
