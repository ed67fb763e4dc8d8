"""Pieces of ground that rays see, and periodic textures averaged over them without aliasing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from geometry.bilinear_sampling import sample_bilinear

Field = NDArray[np.float32]
_SMALLEST_LEVEL_PX = 8
# The finest levels store square roots in eight bits: detail hides the steps, in a quarter of the memory.
_BYTE_LEVELS = 2
FARTHEST_M = 4e5  # beyond this distance haze hides everything
# A piece seen at a grazing angle is elongated; it is averaged over at most so many points along its length.
_MOST_PLACES = 5
_NARROWEST_RAD = 1e-5
EARTH_M = 6.371e6
_LEAST_SINE = 0.002


def power_noise(seed: int, stream: str, size_px: int, slope: float, cycles: float) -> Field:
    """(size, size) periodic Gaussian texture of unit variance, rough at all scales.

    Args:
        seed, stream: keys of the random stream.
        size_px: width and height; a power of two.
        slope: exponent of the fall of the amplitude spectrum above its peak.
        cycles: number of the largest blobs in one repeat.
    """
    frequency = _frequencies(size_px)
    return _noise_of_spectrum(seed, stream, np.where(frequency > 0, (frequency**2 + cycles**2) ** (-slope / 2), 0.0))


def smooth_noise(seed: int, stream: str, size_px: int, cycles: float) -> Field:
    """(size, size) periodic Gaussian texture of unit variance with a single scale; arguments as in `power_noise`."""
    frequency = _frequencies(size_px) / cycles
    return _noise_of_spectrum(seed, stream, frequency * np.exp(-frequency * frequency))


def _frequencies(size_px: int) -> NDArray[np.float64]:
    """(size, size / 2 + 1) frequencies in cycles per repeat."""
    down, across = np.fft.fftfreq(size_px), np.fft.rfftfreq(size_px)
    result: NDArray[np.float64] = np.hypot(down[:, None], across[None, :]) * float(size_px)
    return result


def _noise_of_spectrum(seed: int, stream: str, amplitude: NDArray[np.float64]) -> Field:
    size_px = amplitude.shape[0]
    white = frame_generator(seed, 0, stream).standard_normal((size_px, size_px))
    noise = np.fft.irfft2(np.fft.rfft2(white) * amplitude, s=(size_px, size_px))
    result: Field = (noise / noise.std()).astype(np.float32)
    return result


class MipTile:
    """A periodic texture with mipmap levels of half, a quarter... its size.

    Args:
        texels: (N, N, C) values, C up to 4, N a power of two; not negative when `coded`.
        texel_m: size of a texel. [m]
        coded: store the finest levels as square roots in eight bits; for reflectances up to 1.
    """

    def __init__(self, texels: Field, texel_m: float, coded: bool = False) -> None:
        self._texel_m = texel_m
        self._levels: list[NDArray[np.float32] | NDArray[np.uint8]] = []
        level = texels
        while True:
            keep = coded and len(self._levels) < _BYTE_LEVELS
            self._levels.append(np.rint(255 * np.sqrt(np.clip(level, 0, 1))).astype(np.uint8) if keep else level)
            if level.shape[0] <= _SMALLEST_LEVEL_PX:
                break
            level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        self.mean: NDArray[np.float64] = texels.mean(axis=(0, 1), dtype=np.float64)
        self.most = float(texels[..., 0].max())

    def sample(self, x_m: Field, y_m: Field, footprint_m: Field) -> Field:
        """Values averaged approximately over the footprint.

        Args:
            x_m, y_m: (H, W) positions. [m]
            footprint_m: (H, W) width to average over. [m]

        Returns:
            (H, W, C) values.
        """
        top = len(self._levels) - 1
        height = np.clip(np.log2(np.maximum(footprint_m, 1e-3) / np.float32(self._texel_m)), 0, top).astype(np.float32)
        first = int(height.min())
        last = min(top, int(np.ceil(height.max())))
        # remap wraps only by its border mode and has 16-bit coordinates: reduce to one repeat first.
        size, per_m = np.float32(self._levels[0].shape[0]), np.float32(1.0 / self._texel_m)
        u, v = x_m * per_m, y_m * per_m
        u -= np.floor(u / size) * size
        v -= np.floor(v / size) * size
        if first == last:
            return self._at_level(first, u, v)
        total: Field | None = None
        for level in range(first, last + 1):
            weight = np.maximum(1.0 - np.abs(height - np.float32(level)), np.float32(0.0))
            part = self._at_level(level, u, v)
            part *= weight[..., None]
            total = part if total is None else total + part
        assert total is not None
        return total

    def _at_level(self, level: int, u: Field, v: Field) -> Field:
        """(H, W, C) values of one level at positions in texels of the finest level, within one repeat."""
        picture = self._levels[level]
        scale, half = np.float32(0.5**level), np.float32(0.5)
        seen = sample_bilinear(picture, u * scale - half, v * scale - half, cv2.BORDER_WRAP)
        seen = seen.reshape(*u.shape, -1)
        if picture.dtype == np.uint8:
            root: Field = seen.astype(np.float32)
            root *= np.float32(1 / 255)
            root *= root
            return root
        return np.asarray(seen, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class GroundView:
    """Pieces of ground that rays see, all of shape (H, W).

    Attributes:
        x_m, y_m: their centres, east and north of the ground's origin. [m]
        away_x, away_y: unit vector along the ground, away from the camera.
        sine: of the angle between ray and ground.
        across_m, along_m: their width, and their length away from the camera. [m]
        places: number of points to average over along the length.
    """

    x_m: Field
    y_m: Field
    away_x: Field
    away_y: Field
    sine: Field
    across_m: Field
    along_m: Field
    places: int

    def average(self, *tiles: MipTile, axes: Axes | None = None) -> list[Field]:
        """Means of ground textures over each piece.

        Args:
            tiles: the textures.
            axes: of the textures; None for those of the world.

        Returns:
            (H, W, C) values of each.
        """
        u, v, du, dv = self.x_m, self.y_m, self.away_x, self.away_y
        if axes is not None:
            u, v = axes.turned(u, v)
            du, dv = axes.turned(du, dv)
            u, v = u + axes.shift_u_m, v + axes.shift_v_m
        width_m = np.maximum(self.across_m, self.along_m / np.float32(self.places))
        totals: list[Field] = []
        for place in range(self.places):
            step_m = np.float32((place + 0.5) / self.places - 0.5) * self.along_m
            at = u + step_m * du, v + step_m * dv
            for index, tile in enumerate(tiles):
                part = tile.sample(*at, width_m)
                if place == 0:
                    totals.append(part)
                else:
                    totals[index] += part
        return [total / np.float32(self.places) for total in totals]


@dataclass(frozen=True, eq=False)
class Axes:
    """Axes of a texture on the ground: turned, some places mirrored, and shifted.

    Attributes:
        cosine, sine: of the angle from east towards north to the texture's columns.
        flip: (H, W) 1, or -1 where its rows are mirrored.
        shift_u_m, shift_v_m: (H, W) shift along columns and rows. [m]
    """

    cosine: np.float32
    sine: np.float32
    flip: Field
    shift_u_m: Field
    shift_v_m: Field

    def turned(self, x: Field, y: Field) -> tuple[Field, Field]:
        """(H, W) components along columns and rows of vectors east and north."""
        return self.cosine * x + self.sine * y, self.flip * (self.cosine * y - self.sine * x)


def pixel_angle_rad(directions: NDArray[np.float32]) -> float:
    """Angle between neighbours in an (H, W, 3) image of unit directions, in the middle of it. [rad]"""
    row, column = directions.shape[0] // 2, directions.shape[1] // 2
    middle = directions[row, column].astype(np.float64)
    beside = [
        directions[y, x].astype(np.float64) for y, x in ((row - 1, column), (row, column - 1)) if y >= 0 and x >= 0
    ]
    return max([float(np.linalg.norm(middle - other)) for other in beside] + [_NARROWEST_RAD])


def ground_view(
    directions: NDArray[np.float32],
    altitude_m: float,
    angle_rad: float,
    offset_m: tuple[float, float] = (0.0, 0.0),
    is_round: bool = False,
) -> GroundView:
    """The ground along rays; rays that miss it see its farthest edge.

    Args:
        directions: (H, W, 3) unit vectors in world axes.
        altitude_m: of the camera. [m]
        angle_rad: between neighbouring rays. [rad]
        offset_m: of the camera, east and north of the ground's origin. [m]
        is_round: whether the ground curves as the Earth does, instead of going on level.
    """
    if is_round:
        distance_m, sine = _round_ground(directions[..., 2], altitude_m)
    else:
        sine = np.maximum(-directions[..., 2], np.float32(altitude_m / FARTHEST_M))
        distance_m = np.float32(altitude_m) / sine
    return view_at(directions, distance_m, sine, angle_rad, offset_m)


def view_at(
    directions: NDArray[np.float32], distance_m: Field, sine: Field, angle_rad: float, offset_m: tuple[float, float]
) -> GroundView:
    """Pieces of ground at (H, W) distances [m] along rays that meet them at (H, W) sines; rest as in `ground_view`."""
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


def _round_ground(up: Field, altitude_m: float) -> tuple[Field, Field]:
    """Distance to a round Earth along rays [m], and sine of the angle at which they meet it; at most to the horizon."""
    radius_m = EARTH_M + altitude_m
    falls_m = -up.astype(np.float64) * radius_m
    square = altitude_m * (2.0 * EARTH_M + altitude_m)
    root = np.sqrt(np.maximum(falls_m * falls_m - square, 0.0))
    distance_m = np.minimum(square / np.maximum(falls_m + root, 1.0), np.sqrt(square))
    # The cosine theorem at the place where the ray ends.
    sine = np.maximum((square - distance_m * distance_m) / (2.0 * EARTH_M * distance_m), _LEAST_SINE)
    return distance_m.astype(np.float32), sine.astype(np.float32)
