"""Pieces of ground that rays see, and periodic textures averaged over them without aliasing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest import random_streams
from datasets_manifest.random_streams import frame_generator
from datasets_manifest.user_cache import kept_arrays
from geometry.compiled_loops import compiled, inlined

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


def kept_tile(name: str, source: str, make: Callable[[], MipTile]) -> MipTile:
    """A texture that is the same for all scenes: from the user's cache, or made and kept there.

    Args:
        name: of its file.
        source: file of the code that makes it, besides this one.
        make: makes it.
    """
    sources = (source, __file__, str(random_streams.__file__))
    return MipTile.from_arrays(kept_arrays(f"ground-{name}", sources, lambda: make().to_arrays()))


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    """The same array for reading, as one from a file is: loops are compiled for every type, and this is another."""
    values = values.view()
    values.flags.writeable = False
    return values


class MipTile:
    """A periodic texture with mipmap levels of half, a quarter... its size.

    Args:
        texels: (N, N, C) values, C up to 4, N a power of two; not negative when `coded`.
        texel_m: size of a texel. [m]
        coded: store the finest levels as square roots in eight bits; for reflectances up to 1.
    """

    def __init__(self, texels: Field, texel_m: float, coded: bool = False) -> None:
        self._texel_m, self._side, self._channels = float(texel_m), texels.shape[0], texels.shape[2]
        levels, level = [], texels
        while True:
            levels.append(level.ravel())
            if level.shape[0] <= _SMALLEST_LEVEL_PX:
                break
            smaller = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            level = smaller.reshape(*smaller.shape[:2], self._channels)
        self._top, self._byte_levels = len(levels) - 1, _BYTE_LEVELS if coded else 0
        roots = [np.rint(255 * np.sqrt(np.clip(level, 0, 1))).astype(np.uint8) for level in levels[: self._byte_levels]]
        self._roots = _read_only(np.concatenate([*roots, np.zeros(0, np.uint8)]))
        self._values = _read_only(np.concatenate([*levels[self._byte_levels :], np.zeros(0, np.float32)]))
        self.mean: NDArray[np.float64] = texels.mean(axis=(0, 1), dtype=np.float64)
        self.most = float(texels[..., 0].max())

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The texture whose `to_arrays` these are."""
        tile = cls.__new__(cls)
        tile._roots, tile._values, tile.mean = (
            _read_only(arrays["roots"]),
            _read_only(arrays["values"]),
            arrays["mean"],
        )
        tile._side, tile._channels, tile._top, tile._byte_levels = arrays["sizes"].tolist()
        tile._texel_m, tile.most = arrays["scales"].tolist()
        return tile

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All that the texture is, to be kept in a file."""
        return {
            "roots": self._roots,
            "values": self._values,
            "mean": self.mean,
            "sizes": np.array([self._side, self._channels, self._top, self._byte_levels]),
            "scales": np.array([self._texel_m, self.most]),
        }

    def sample(self, x_m: Field, y_m: Field, footprint_m: Field) -> Field:
        """Values averaged approximately over the footprint.

        Args:
            x_m, y_m: (H, W) positions. [m]
            footprint_m: (H, W) width to average over. [m]

        Returns:
            (H, W, C) values.
        """
        zero = np.zeros(1, np.float32)
        return self.sample_along((x_m, y_m), (zero, zero), footprint_m, 1)

    def sample_along(
        self, middle_m: tuple[Field, Field], along_m: tuple[Field, Field], width_m: Field, places: int
    ) -> Field:
        """Means of the values at places on lines.

        Args:
            middle_m: (H, W) x and y of the lines' middles. [m]
            along_m: x and y from end to end, (H, W), or (1,) where all are the same. [m]
            width_m: (H, W) width to average over at each place. [m]
            places: number of places on each line.

        Returns:
            (H, W, C) values.
        """
        shape = np.broadcast_shapes(middle_m[0].shape, width_m.shape)
        x_m, y_m, along_x_m, along_y_m, width_m = (
            _read_only(
                np.ascontiguousarray(part if part.size == 1 else np.broadcast_to(part, shape), np.float32).ravel()
            )
            for part in (*middle_m, *along_m, width_m)
        )
        total = np.zeros((int(np.prod(shape)), self._channels), dtype=np.float32)
        sizes, lines = (self._side, self._top, self._byte_levels), (x_m, y_m, along_x_m, along_y_m, width_m)
        channels = tuple(range(self._channels))
        _add_samples(self._roots, self._values, sizes, self._texel_m, lines, places, channels, total)
        return total.reshape(*shape, self._channels)


@inlined
def _add_level(
    texels: NDArray[np.uint8] | NDArray[np.float32],
    start: int,
    side: int,
    place: tuple[float, float],
    weight: float,
    channels: tuple[int, ...],
    sums: NDArray[np.float32],
    index: int,
) -> None:
    """Add to `sums[index]` what a level has at a place in its texels; bytes are roots of 255 times 255 the value."""
    across, down = np.floor(place[0]), np.floor(place[1])
    a, b = np.float32(place[0] - across), np.float32(place[1] - down)
    left, top, count = int(across) & (side - 1), int(down) & (side - 1), len(channels)
    right, below = (left + 1) & (side - 1), (top + 1) & (side - 1)
    top, below = start + top * side * count, start + below * side * count
    left, right = left * count, right * count
    for c in range(count):
        upper = texels[top + left + c] * (np.float32(1.0) - a) + texels[top + right + c] * a
        lower = texels[below + left + c] * (np.float32(1.0) - a) + texels[below + right + c] * a
        value = upper + b * (lower - upper)
        if texels.itemsize == 1:
            value *= np.float32(1.0 / 255.0)
            value *= value
        sums[index, c] += np.float32(weight) * value


@compiled
def _add_samples(
    roots: NDArray[np.uint8],
    values: NDArray[np.float32],
    sizes: tuple[int, int, int],
    texel_m: float,
    lines: tuple[Field, Field, Field, Field, Field],
    places: int,
    channels: tuple[int, ...],
    sums: Field,
) -> None:
    """Add the means at places on lines; see `MipTile.sample_along`.

    Args:
        roots, values: the levels one after the other: those of bytes, the others.
        sizes: of the finest level, number of the coarsest level, and how many levels are of bytes.
        texel_m: of the finest level. [m]
        lines: x and y of their middles, x and y from end to end, and width to average over: (N,), or (1,) where all are
            the same. [m]
        places: on each line.
        channels: 0 to C - 1. A tuple's length is known to the compiler, which then needs no loop over channels.
        sums: (N, C).
    """
    side, top, byte_levels = sizes
    x_m, y_m, along_x_m, along_y_m, width_m = lines
    count = len(channels)
    # Where each level begins among those of its kind, and its share of the finest one's side.
    starts, scales = np.zeros(top + 2, np.int64), np.ones(top + 2, np.float64)
    for number in range(1, top + 2):
        scales[number] = 0.5 * scales[number - 1]
        if number != byte_levels:
            starts[number] = starts[number - 1] + (side >> (number - 1)) * (side >> (number - 1)) * count
    steps = (np.arange(places) + 0.5) / places - 0.5
    finer, weights = 0, np.zeros(2, np.float64)
    for index in range(sums.shape[0]):
        if index == 0 or width_m.size > 1:
            level = min(max(np.log2(max(float(width_m[index]), 1e-3) / texel_m), 0.0), float(top))
            finer = int(level)
            weights[0], weights[1] = (1.0 - (level - finer)) / places, (level - finer) / places
        x, y = float(x_m[index if x_m.size > 1 else 0]), float(y_m[index if y_m.size > 1 else 0])
        along = index if along_x_m.size > 1 else 0
        for step in steps:
            u, v = (x + step * along_x_m[along]) / texel_m, (y + step * along_y_m[along]) / texel_m
            for coarser in range(2):
                number, weight = finer + coarser, weights[coarser]
                if weight <= 0.0:
                    continue
                at = u * scales[number] - 0.5, v * scales[number] - 0.5
                if number < byte_levels:
                    _add_level(roots, starts[number], side >> number, at, weight, channels, sums, index)
                else:
                    _add_level(values, starts[number], side >> number, at, weight, channels, sums, index)


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

    def scaled(self, factor: float) -> GroundView:
        """The same pieces in a unit of length that is `factor` times shorter, for textures that repeat sooner."""
        by = np.float32(factor)
        x_m, y_m, across_m, along_m = (by * part for part in (self.x_m, self.y_m, self.across_m, self.along_m))
        return replace(self, x_m=x_m, y_m=y_m, across_m=across_m, along_m=along_m)

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
        along_m = self.along_m * du, self.along_m * dv
        return [tile.sample_along((u, v), along_m, width_m, self.places) for tile in tiles]


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
