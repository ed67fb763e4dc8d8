"""How many rays each pixel with an edge takes, and where in the pixel they go.

An edge between surfaces of similar brightness needs few rays, one between bright and dark needs many. Pilot rays, which
enter no result, tell them apart, so that no mean depends on how its own samples came out. `NoiseBudget` compares the
noise of edges and of denoised light with the noise that is aimed at.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from render.compositing import InPicture
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import MOST_LANES, FrameRays
from render.mitsuba_engine.render_noise import TWICE_EVERY, SensorNoise
from render.mitsuba_engine.trace_request import IN_OPEN, OF_DROGUE

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


# Share of the edges' mean variance that pixels have beyond what their rays show. At 37 m one of 2,000 had a twentieth
# of bright sky that its nine rays and those around all missed, took 16 rays and was three fifths of the squared error.
_UNSEEN = 0.01


class NoiseBudget:
    """Of what is stated as a frame's noise: means over the pixels whose centres see the drogue, in the picture.

    Attributes:
        aim: mean square error that is aimed at. [cd2/m4]
        of_light: (2,) what of it is the smoothed light's where the sky is hidden, and in the open (`IN_OPEN`); whoever
            lessens that says so here. [cd2/m4]
    """

    def __init__(
        self,
        picture: InPicture,
        edges: tuple[NDArray[np.int64], NDArray[np.float32]],
        inside: tuple[NDArray[np.int64], NDArray[np.float32]],
        noise_over_sensor: float,
    ) -> None:
        """Look at rays beforehand.

        Args:
            picture: what the pixels are of.
            edges: (P,) flat indices of those on edges, and (P, S, 7) what single rays through them find: radiance,
                coverage and error of the smoothed light.
            inside: (Q,) every so many of the others, as many as are rendered twice, and (Q, 7) the same of each.
            noise_over_sensor: the renderer's noise that is aimed at over the sensor's.
        """
        sensor = SensorNoise.of(picture.frame)
        samples, clear = picture.radiance(edges[0], edges[1][..., :4])
        samples_inside, clear_inside = picture.radiance(inside[0], inside[1][:, None, :4])
        # Of a drogue that no centre sees, all that may see it counts.
        self._judged = picture.shows(OF_DROGUE, edges[0])
        self._judged |= not (self._judged.any() or len(inside[0]))
        weight = np.concatenate([self._judged.astype(float), np.full(len(inside[0]), float(TWICE_EVERY))])
        mean = np.average(np.concatenate([samples.mean(axis=1), samples_inside[:, 0]]), axis=0, weights=weight)
        errors = np.concatenate([clear * edges[1][..., 4:].mean(axis=1), clear_inside * inside[1][:, 4:]])
        self.aim = noise_over_sensor**2 * sensor.variance(mean[None])
        squared = np.mean((errors @ sensor.weights) ** 2, axis=-1) * weight / weight.sum()
        in_open = np.concatenate([picture.shows(IN_OPEN, edges[0]), picture.shows(IN_OPEN, inside[0])])
        self.of_light: NDArray[np.float64] = np.bincount(in_open, weights=squared, minlength=2).astype(np.float64)
        variance = np.var(samples @ sensor.weights, axis=1, ddof=1).mean(axis=-1)
        # Few rays miss what is small, which those of the pixels around may have met.
        around = np.empty(len(variance))
        for own, own_pixel in picture.by_eye(edges[0]):
            around[own] = _around(own_pixel, variance[own], picture.frame.rig.camera.width_px)
        self._variance = (variance + around) / 2
        if self._judged.any():
            # What none of them met may be there all the same.
            self._variance += _UNSEEN * np.mean(variance[self._judged])
        # The lens averages over neighbours, whose rays err independently.
        self._per_pixel = sensor.left_by_lens**2 / weight.sum()
        self._share_of_edges = len(edges[0]) / (len(edges[0]) + TWICE_EVERY * len(inside[0]))

    def edge_counts(self, most: float) -> NDArray[np.int64]:
        """(P,) how many rays edges take, with `most` a pixel on average of a drogue that is all edges."""
        allowed = max(self.aim - self.of_light.sum(), self.aim / 4) / self._per_pixel
        # Stratified rays err by their number to the power of 3/4: the error over all of the drogue stays the same.
        return counts_by_variance(self._variance, self._judged, allowed, most * self._share_of_edges ** (2 / 3))


def _around(pixel: NDArray[np.int64], values: NDArray[np.float64], width_px: int) -> NDArray[np.float64]:
    """(P,) means over each pixel of one eye and those of its eight neighbours that are among the pixels."""
    if not len(pixel):
        return values
    row, column = np.divmod(pixel, width_px)
    place = row - row.min(), column - column.min()
    window = np.zeros((2, place[0].max() + 1, place[1].max() + 1))
    window[(0, *place)], window[(1, *place)] = values, 1.0
    total, number = (
        cv2.boxFilter(plane, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)[place] for plane in window
    )
    # Running sums leave roundings of what they have passed.
    mean: NDArray[np.float64] = np.maximum(total, 0.0) / np.rint(number)
    return mean
