"""How many rays each pixel with an edge takes, and through which places in it they go.

An edge between things of like brightness needs few rays, and one between bright and dark many. Which it is shows in a
few rays that serve for nothing else, so that no mean depends on how its own samples came out.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import MOST_LANES, FrameRays

PILOT_COUNT = 9
"""Rays a pixel that tell how many it takes."""
LEAST_COUNT, _MOST_COUNT = 16, 2048
# Mean square error of n samples of these sequences on edges: this much of one sample's variance times n^-1.5.
_ERROR_OF_ONE = 0.7
# Of the squared error where it does not count: a picture without speckles needs less than a drogue without noise.
_WEIGHT_BESIDE = 0.25


def counts_by_variance(
    variance: NDArray[np.float64], judged: NDArray[np.bool_], allowed: float, most: float
) -> NDArray[np.int64]:
    """How many samples pixels take, for the least mean square error that so many samples can have.

    The error of stratified samples of an edge goes with their number to the power of -3/4. The least sum of the squares
    v n^-1.5 at a given sum of the n has n in proportion to v^0.4.

    Args:
        variance: (P,) of one sample of each pixel.
        judged: (P,) in which pixels the error counts.
        allowed: sum of the mean square errors of those, if `most` suffices for it.
        most: samples a pixel, on average over all.

    Returns:
        (P,) powers of two.
    """
    need = (np.where(judged, 1.0, _WEIGHT_BESIDE) * variance) ** 0.4
    if not need[judged].any():
        return np.full(len(variance), LEAST_COUNT)
    wanted = (_ERROR_OF_ONE * need[judged].sum() / allowed) ** (2 / 3)
    counts = need * min(wanted, most / need.mean())
    powers: NDArray[np.int64] = 2 ** np.rint(np.log2(np.clip(counts, LEAST_COUNT, _MOST_COUNT))).astype(np.int64)
    return powers


class PlacedSamples:
    """Places and moments of samples that differ in number from pixel to pixel: one kernel serves all numbers.

    Places are the first two numbers of Sobol's sequence and moments the third, with their bits flipped at random for
    each pixel: any power of two of them is stratified in every way that a pixel can be cut into equal rectangles of
    that number.

    Source: I. M. Sobol', USSR Computational Mathematics and Mathematical Physics 7 (1967), 86,
    doi:10.1016/0041-5553(67)90144-9.
    """

    def __init__(self, rays: FrameRays, pixel: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """With (P,) flat indices, and how many samples each takes: multiples of `LEAST_COUNT`."""
        self._counts, self._first = counts, np.cumsum(counts) - counts
        row = jit_array(mi.UInt32, np.repeat(np.arange(len(pixel), dtype=np.uint32), counts))

        def of_row(values: NDArray[np.generic]) -> mi.UInt32:
            return dr.gather(mi.UInt32, jit_array(mi.UInt32, values), row)

        index = dr.arange(mi.UInt32, int(counts.sum())) - of_row(self._first)
        flips = rays.bits(3, len(pixel))
        self.pixel = of_row(pixel)
        self.place = mi.Point2f(
            _unit_interval(dr.brev(index) ^ of_row(flips[0])),
            _unit_interval(_sobol(index, (1,)) ^ of_row(flips[1])),
        )
        self.moment = _unit_interval(_sobol(index, (1, 3)) ^ of_row(flips[2]))

    def means(self, channels: list[mi.Float]) -> NDArray[np.float32]:
        """(P, len(channels)) means over the samples of each pixel."""
        # Without this every sum would trace the rays again.
        dr.eval(channels)
        first = self._first // LEAST_COUNT
        sums = [np.add.reduceat(np.array(dr.block_sum(channel, LEAST_COUNT)), first) for channel in channels]
        means: NDArray[np.float32] = np.stack(sums, axis=-1) / self._counts[:, None].astype(np.float32)
        return means


def in_parts(pixel: NDArray[np.int64], counts: NDArray[np.int64]) -> Iterator[tuple[NDArray, NDArray]]:  # type: ignore[type-arg]
    """Pixels and their counts in as many pieces as launches need."""
    launch = np.cumsum(counts) // MOST_LANES
    for part in np.split(np.arange(len(pixel)), np.flatnonzero(np.diff(launch)) + 1):
        if len(part):
            yield pixel[part], counts[part]


def _sobol(index: mi.UInt32, initial: tuple[int, ...]) -> mi.UInt32:
    """One of the numbers of Sobol's sequence as 32 bits behind the point, for indices below `_MOST_COUNT`.

    Args:
        index: places in the sequence.
        initial: first numbers of its recurrence, as many as its polynomial of coefficients 1 has degrees.
    """
    numbers = list(initial)
    bits = mi.UInt32(0)
    for place in range(_MOST_COUNT.bit_length() - 1):
        if place >= len(initial):
            degree = len(initial)
            number = numbers[-degree] << degree ^ numbers[-degree]
            for back in range(1, degree):
                number ^= numbers[-back] << back
            numbers.append(number)
        direction = numbers[place] << 31 - place
        bits ^= dr.select((index & (1 << place)) != 0, mi.UInt32(direction), 0)
    return bits


def _unit_interval(bits: mi.UInt32) -> mi.Float:
    """32 bits behind the point as a number from 0 to below 1."""
    return mi.Float(bits >> 8) * mi.Float(2.0**-24)
