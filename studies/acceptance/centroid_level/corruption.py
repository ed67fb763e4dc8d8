"""Markers whose centres are measured wrongly by several pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from geometry.se3 import Array

LEAST_PX, MOST_PX = 3.0, 10.0


@dataclass(frozen=True)
class Corruption:
    """What is wrong.

    Attributes:
        markers: how many markers, drawn for each frame.
        where: in one drawn eye, in both eyes by different shifts, or in one eye along its rows only.
    """

    markers: int
    where: Literal["one eye", "both eyes", "u only"] = "one eye"

    def __str__(self) -> str:
        return "clean" if self.markers == 0 else f"{self.markers} bad, {self.where}"


CLEAN = Corruption(0)


def draw_shifts(rng: np.random.Generator, corruption: Corruption, count: int, markers: int) -> Array:
    """Shifts of the measured centres.

    Args:
        rng: the stream.
        corruption: what is wrong.
        count: how many frames.
        markers: of the drogue.

    Returns:
        (count, 2, markers, 2) of 3 to 10 px in drawn directions, zero elsewhere. [px]

    Raises:
        ValueError: more bad markers than there are.
    """
    if not 0 <= corruption.markers <= markers:
        raise ValueError(f"corruption: must be of at most {markers} markers, got {corruption.markers}")
    size = LEAST_PX + (MOST_PX - LEAST_PX) * rng.random((count, 2, markers))
    angle = 2 * np.pi * rng.random((count, 2, markers))
    if corruption.where == "u only":
        angle = np.where(angle < np.pi, 0.0, np.pi)
    shifts = size[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    chosen = rng.random((count, markers)).argsort(axis=1) < corruption.markers
    eyes = np.ones((count, 2), dtype=np.bool_)
    if corruption.where != "both eyes":
        eyes = np.arange(2) == rng.integers(0, 2, count)[:, None]
    shifted: Array = shifts * (chosen[:, None, :] & eyes[:, :, None])[..., None]
    return shifted
