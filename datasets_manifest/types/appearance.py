"""What a frame shows besides a new drogue: aged surfaces, obstacles, or a calibration board in its place."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from datasets_manifest.types.field_types import Transform
from drogue_models.frozen_model import FrozenModel, Reflectance, ReflectanceRgb
from drogue_models.obstacles import ObstacleShape
from drogue_models.surface_looks import SurfaceWear
from geometry.se3 import Array


class SurfaceCondition(FrozenModel):
    """How one marker, or the hub, has aged.

    Attributes:
        missing: it has come off; the dark face shows in its place.
        reflectance_fraction: share of the new paint's reflectance that is left.
        dirt_fraction: share of its area under dirt.
        dirt_seed: seed of the dirt's pattern.
        lamp_fraction: share of a self-lit marker's luminance that is left; 0 for a failed lamp.
    """

    missing: bool = False
    reflectance_fraction: float = Field(default=1.0, ge=0, le=1)
    dirt_fraction: float = Field(default=0.0, ge=0, le=1)
    dirt_seed: int = Field(default=0, ge=0)
    lamp_fraction: float = Field(default=1.0, ge=0, le=1)

    @property
    def is_clean(self) -> bool:
        """Whether it reflects and shines evenly over its area."""
        return self.dirt_fraction == 0 or self.missing


AS_NEW = SurfaceCondition()


class DrogueCondition(FrozenModel):
    """Condition of a drogue's surfaces in one frame; navigation never sees it.

    Attributes:
        markers: in the drogue's order; empty when all are as new.
        hub: of the hub annulus.
        body_reflectance_fraction: factor on the reflectance of face, canopy, ribs, coupling and hose: below 1 for soot,
            above 1 for bleaching.
        wear: what makes paint, cloth and metal of all parts uneven, or None for even paint.
    """

    markers: tuple[SurfaceCondition, ...] = ()
    hub: SurfaceCondition = AS_NEW
    body_reflectance_fraction: float = Field(default=1.0, ge=0.1, le=3)
    # Left out where there is none, so that the hashes of other datasets stay those of earlier versions.
    wear: SurfaceWear | None = Field(default=None, exclude_if=lambda wear: wear is None)

    def of_marker(self, index: int) -> SurfaceCondition:
        """Condition of one marker."""
        return self.markers[index] if self.markers else AS_NEW


class Obstacle(FrozenModel):
    """A body in the picture that is neither drogue, hose nor tanker.

    During the exposure `probe` and `obstacle` keep their places before the camera, and a `distractor` that beside the
    drogue.

    Attributes:
        kind: `probe` of the receiver, `obstacle` close to the cameras, or `distractor` that resembles a drogue.
        shape: dimensions, in its own frame.
        left_from_object: pose at mid-exposure.
        reflectance_rgb: diffuse reflectance of its main paint in linear Rec. 709.
        luminance_cd_m2: of a lamp, in the colour of its paint. [cd/m2]
    """

    kind: Literal["probe", "obstacle", "distractor"]
    shape: ObstacleShape
    left_from_object: Transform
    reflectance_rgb: ReflectanceRgb
    luminance_cd_m2: float = Field(default=0.0, ge=0, le=1e6, exclude_if=lambda luminance: luminance == 0)


class CalibrationBoard(FrozenModel):
    """A checkerboard printed on a flat white plate.

    Board frame: origin in the middle of the squares, x along a row, y down a column, z into the plate. The square in
    the low corner of x and y is black.

    Attributes:
        columns, rows: squares, not corners. One count must be even and the other odd, so that the board looks
            different after half a turn.
        square_m: side of a square. [m]
        margin_m: width of the white rim around the squares. [m]
        white_reflectance, black_reflectance: diffuse, the same for all colours. Office paper reflects 0.8 and toner
            0.04 in the visible.
    """

    columns: int = Field(default=11, ge=4, le=60)
    rows: int = Field(default=8, ge=4, le=60)
    square_m: float = Field(default=0.06, gt=0, le=10)
    margin_m: float = Field(default=0.04, ge=0, le=10)
    white_reflectance: Reflectance = 0.8
    black_reflectance: Reflectance = 0.04

    @model_validator(mode="after")
    def _one_way_up(self) -> Self:
        if (self.columns + self.rows) % 2 == 0:
            raise ValueError(f"columns, rows: one must be even and the other odd, got {self.columns} and {self.rows}")
        return self

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the plate. [m]"""
        return (
            self.columns * self.square_m + 2 * self.margin_m,
            self.rows * self.square_m + 2 * self.margin_m,
        )

    def grid_m(self) -> Array:
        """(rows + 1, columns + 1, 3) corners of all squares in the board frame. [m]"""
        x = (np.arange(self.columns + 1) - self.columns / 2) * self.square_m
        y = (np.arange(self.rows + 1) - self.rows / 2) * self.square_m
        return np.stack([*np.meshgrid(x, y), np.zeros((self.rows + 1, self.columns + 1))], axis=-1)

    def corners_m(self) -> Array:
        """((rows - 1) (columns - 1), 3) inner corners, row by row, in the board frame, which detectors find. [m]"""
        return self.grid_m()[1:-1, 1:-1].reshape(-1, 3)

    def outline_m(self) -> Array:
        """(4, 3) corners of the plate in the board frame, around it. [m]"""
        around = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        outline: Array = around * (self.size_m[0] / 2, self.size_m[1] / 2, 0.0)
        return outline


class PlacedBoard(FrozenModel):
    """A board in a frame; it does not move during the exposure.

    Attributes:
        shape: its dimensions.
        left_from_board: its pose.
    """

    shape: CalibrationBoard
    left_from_board: Transform
