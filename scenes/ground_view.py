"""Where rays meet the ground, and how large a piece of it each one sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scenes.mip_tile import Field, MipTile

FARTHEST_M = 4e5  # beyond this the haze has hidden everything
# A piece seen at a grazing angle is drawn out; it is averaged over at most so many places along its length.
_MOST_PLACES = 5
_NARROWEST_RAD = 1e-5


@dataclass(frozen=True, eq=False)
class GroundView:
    """Pieces of ground seen along rays, all of shape (H, W).

    Attributes:
        x_m, y_m: their middles, east and north of the place about which the ground is laid out. [m]
        away_x, away_y: unit vector along the ground, away from the camera.
        sine: of the angle between ray and ground.
        across_m, along_m: their width, and their length away from the camera. [m]
        places: how many to average over along the length.
    """

    x_m: Field
    y_m: Field
    away_x: Field
    away_y: Field
    sine: Field
    across_m: Field
    along_m: Field
    places: int

    def average(
        self, tile: MipTile, turn: tuple[Field, Field] | None = None, shift: tuple[Field, Field] | None = None
    ) -> Field:
        """What a picture of the ground shows in each piece.

        Args:
            tile: the picture.
            turn: (H, W) cosine and sine of how far it is turned, or None.
            shift: (H, W) by which it is moved along its own axes, or None. [m]

        Returns:
            (H, W, C) values.
        """
        u, v, du, dv = self.x_m, self.y_m, self.away_x, self.away_y
        if turn is not None:
            cosine, sine = turn
            u, v = cosine * u + sine * v, cosine * v - sine * u
            du, dv = cosine * du + sine * dv, cosine * dv - sine * du
        if shift is not None:
            u, v = u + shift[0], v + shift[1]
        width_m = np.maximum(self.across_m, self.along_m / np.float32(self.places))
        total: Field | None = None
        for place in range(self.places):
            step_m = np.float32((place + 0.5) / self.places - 0.5) * self.along_m
            part = tile.sample(u + step_m * du, v + step_m * dv, width_m)
            total = part if total is None else total + part
        assert total is not None
        return total / np.float32(self.places)


def pixel_angle_rad(directions: NDArray[np.float32]) -> float:
    """Angle between neighbours in an (H, W, 3) image of unit directions, in the middle of it. [rad]"""
    row, column = directions.shape[0] // 2, directions.shape[1] // 2
    middle = directions[row, column].astype(np.float64)
    beside = [
        directions[y, x].astype(np.float64) for y, x in ((row - 1, column), (row, column - 1)) if y >= 0 and x >= 0
    ]
    return max([float(np.linalg.norm(middle - other)) for other in beside] + [_NARROWEST_RAD])


def ground_view(
    directions: NDArray[np.float32], altitude_m: float, angle_rad: float, offset_m: tuple[float, float] = (0.0, 0.0)
) -> GroundView:
    """The ground along rays; those that miss it see its farthest rim.

    Args:
        directions: (H, W, 3) unit vectors in world axes.
        altitude_m: of the camera. [m]
        angle_rad: between neighbouring rays. [rad]
        offset_m: of the camera, east and north of the place about which the ground is laid out. [m]
    """
    sine = np.maximum(-directions[..., 2], np.float32(altitude_m / FARTHEST_M))
    distance_m = np.float32(altitude_m) / sine
    level = np.maximum(np.hypot(directions[..., 0], directions[..., 1]), np.float32(1e-6))
    across_m = distance_m * np.float32(angle_rad)
    stretch = 1.0 / float(sine.mean())
    return GroundView(
        x_m=directions[..., 0] * distance_m + np.float32(offset_m[0]),
        y_m=directions[..., 1] * distance_m + np.float32(offset_m[1]),
        away_x=directions[..., 0] / level,
        away_y=directions[..., 1] / level,
        sine=sine,
        across_m=across_m,
        along_m=across_m / sine,
        places=int(np.clip(np.ceil(stretch / 5.0), 1, _MOST_PLACES)),
    )
