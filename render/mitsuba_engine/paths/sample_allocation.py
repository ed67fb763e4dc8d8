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

from render.compositing import Compositor
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import MOST_LANES, FrameRays
from render.mitsuba_engine.render_noise import DUPLICATE_EVERY, SensorNoise
from render.mitsuba_engine.trace_request import DROGUE_PARTS, OPEN_TO_SKY

PILOT_COUNT = 9
"""Pilot rays per pixel, which tell how many rays the pixel takes."""
LEAST_COUNT, _MOST_COUNT = 16, 2048
# Mean square error of n samples of these sequences at edges, over the variance of one sample times n^-1.5.
_ERROR_OF_ONE = 0.7
# Weight of the squared error beside the drogue: a picture without speckles needs less than a drogue without noise.
_WEIGHT_BESIDE = 0.25
# Share of the edges' mean variance that is added to every pixel's, for what its rays did not show. At 37 m one pixel of
# 2,000 had a twentieth of bright sky that its nine pilot rays and those around all missed; it took 16 rays and made up
# three fifths of the squared error.
_UNSEEN = 0.01


def counts_by_variance(
    variance: NDArray[np.float64], judged: NDArray[np.bool_], allowed: float, most: float
) -> NDArray[np.int64]:
    """How many samples each pixel takes, for the least mean square error at their total number.

    The error of stratified samples of an edge falls with their number to the power of -3/4. The sum of the squares
    v n^-1.5 at a given sum of the n is least for n in proportion to v^0.4.

    Args:
        variance: (P,) of one sample of each pixel.
        judged: (P,) in which pixels the error counts.
        allowed: sum of the mean square errors of those pixels, if `most` suffices for it.
        most: samples per pixel, on average over all.

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


class StratifiedSamples:
    """Places and moments of samples whose number differs from pixel to pixel; one kernel serves all numbers.

    Places are the first two dimensions of the Sobol sequence and moments the third, with their bits flipped at random
    for each pixel. Any power of two of them is stratified in every division of a pixel into that many equal rectangles.

    Source: I. M. Sobol', USSR Computational Mathematics and Mathematical Physics 7 (1967), 86,
    doi:10.1016/0041-5553(67)90144-9.
    """

    def __init__(self, rays: FrameRays, pixel: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Take (P,) flat indices, and how many samples each pixel takes: multiples of `LEAST_COUNT`."""
        self._counts, self._first = counts, np.cumsum(counts) - counts
        row = jit_array(mi.UInt32, np.repeat(np.arange(len(pixel), dtype=np.uint32), counts))

        def of_row(values: NDArray[np.generic]) -> mi.UInt32:
            return dr.gather(mi.UInt32, jit_array(mi.UInt32, values), row)

        index = dr.arange(mi.UInt32, int(counts.sum())) - of_row(self._first)
        flips = rays.random_bits(3, len(pixel))
        self.pixel = of_row(pixel)
        self.place = mi.Point2f(
            _unit_interval(dr.brev(index) ^ of_row(flips[0])),
            _unit_interval(_sobol(index, (1,)) ^ of_row(flips[1])),
        )
        self.moment = _unit_interval(_sobol(index, (1, 3)) ^ of_row(flips[2]))

    def means(self, channels: list[mi.Float]) -> NDArray[np.float32]:
        """(P, len(channels)) means over the samples of each pixel."""
        # Without this evaluation every sum would trace the rays again.
        dr.eval(channels)
        first = self._first // LEAST_COUNT
        sums = [np.add.reduceat(np.array(dr.block_sum(channel, LEAST_COUNT)), first) for channel in channels]
        means: NDArray[np.float32] = np.stack(sums, axis=-1) / self._counts[:, None].astype(np.float32)
        return means


def chunks_by_count(pixel: NDArray[np.int64], counts: NDArray[np.int64]) -> Iterator[tuple[NDArray, NDArray]]:  # type: ignore[type-arg]
    """Pixels and their counts of samples, in chunks of about `MOST_LANES` samples."""
    launch = np.cumsum(counts) // MOST_LANES
    for rows in np.split(np.arange(len(pixel)), np.flatnonzero(np.diff(launch)) + 1):
        if len(rows):
            yield pixel[rows], counts[rows]


def _sobol(index: mi.UInt32, initial: tuple[int, ...]) -> mi.UInt32:
    """One dimension of the Sobol sequence as 32-bit binary fractions, for indices below `_MOST_COUNT`.

    Args:
        index: positions in the sequence.
        initial: first numbers of its recurrence, as many as the degree of its polynomial, whose coefficients are 1.
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
    """A 32-bit binary fraction as a number in [0, 1)."""
    return mi.Float(bits >> 8) * mi.Float(2.0**-24)


class NoiseBudget:
    """Noise that is aimed at on the pixels whose centres see the drogue, and noise so far, as the image shows it.

    Attributes:
        aim: mean square error that is aimed at. [cd2/m4]
        light_error: (2,) mean square error by the denoised light, where the sky is hidden and in the open
            (`OPEN_TO_SKY`). A caller that lessens the error updates it. [cd2/m4]
    """

    def __init__(
        self,
        compositor: Compositor,
        edges: tuple[NDArray[np.int64], NDArray[np.float32]],
        interior: tuple[NDArray[np.int64], NDArray[np.float32]],
        noise_over_sensor: float,
    ) -> None:
        """Evaluate pilot rays.

        Args:
            compositor: shows light behind the air and over the background.
            edges: (P,) flat indices of pixels with edges, and (P, S, 7) radiance, coverage and error of the denoised
                light by S single rays through each.
            interior: (Q,) flat indices of the other pixels that are traced twice, and (Q, 7) the same of each.
            noise_over_sensor: noise of the renderer that is aimed at, over the noise of the sensor.
        """
        edge_pixel, edge_rays = edges
        interior_pixel, interior_light = interior
        sensor = SensorNoise.of(compositor.frame)
        samples, clear = compositor.radiance(edge_pixel, edge_rays[..., :4])
        interior_samples, interior_clear = compositor.radiance(interior_pixel, interior_light[:, None, :4])
        # If no centre sees the drogue, all pixels count that may show it.
        self._judged = compositor.shows(DROGUE_PARTS, edge_pixel)
        self._judged |= not (self._judged.any() or len(interior_pixel))
        weight = np.concatenate([self._judged.astype(float), np.full(len(interior_pixel), float(DUPLICATE_EVERY))])
        mean = np.average(np.concatenate([samples.mean(axis=1), interior_samples[:, 0]]), axis=0, weights=weight)
        errors = np.concatenate([clear * edge_rays[..., 4:].mean(axis=1), interior_clear * interior_light[:, 4:]])
        self.aim = noise_over_sensor**2 * sensor.variance(mean[None])
        squared = np.mean((errors @ sensor.weights) ** 2, axis=-1) * weight / weight.sum()
        is_open = np.concatenate([compositor.shows(OPEN_TO_SKY, pixel) for pixel in (edge_pixel, interior_pixel)])
        self.light_error: NDArray[np.float64] = np.bincount(is_open, weights=squared, minlength=2).astype(np.float64)
        variance = np.var(samples @ sensor.weights, axis=1, ddof=1).mean(axis=-1)
        # A few rays miss small things, which those of neighbouring pixels may have hit.
        nearby = np.empty(len(variance))
        for own, own_pixel in compositor.by_eye(edge_pixel):
            nearby[own] = _neighbourhood_means(own_pixel, variance[own], compositor.frame.rig.camera.width_px)
        self._variance = (variance + nearby) / 2
        if self._judged.any():
            self._variance += _UNSEEN * np.mean(variance[self._judged])
        # The lens averages over neighbours, whose errors are independent.
        self._per_pixel = sensor.left_by_lens**2 / weight.sum()
        self._share_of_edges = len(edge_pixel) / (len(edge_pixel) + DUPLICATE_EVERY * len(interior_pixel))

    def edge_counts(self, most: float) -> NDArray[np.int64]:
        """(P,) rays through each pixel with an edge; a drogue that is all edges takes `most` per pixel on average."""
        allowed = max(self.aim - self.light_error.sum(), self.aim / 4) / self._per_pixel
        # The error of stratified rays falls with their number to the power of 3/4: so its mean over the drogue stays
        # the same when only some of its pixels have edges.
        return counts_by_variance(self._variance, self._judged, allowed, most * self._share_of_edges ** (2 / 3))


def _neighbourhood_means(pixel: NDArray[np.int64], values: NDArray[np.float64], width_px: int) -> NDArray[np.float64]:
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
    # Running sums leave rounding errors behind.
    mean: NDArray[np.float64] = np.maximum(total, 0.0) / np.rint(number)
    return mean
