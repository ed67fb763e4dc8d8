"""Monte-Carlo noise of the renderer, measured on pixels rendered twice, and how many rays reach the noise aimed at.

An edge between surfaces of similar brightness needs few rays, one between bright and dark needs many. Pilot rays, which
enter no result, tell them apart, so that no mean depends on how its own samples came out. `NoiseBudget` compares the
noise of edges and of denoised light with the noise that is aimed at.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from render.camera.sensor import mono_weights
from render.compositing import Compositor
from render.mitsuba_engine.trace_request import DROGUE_PARTS, OPEN_TO_SKY
from scenes.sky.photometry import REC709_LUMINANCE

# One pixel in so many is rendered twice: a sixteenth more work, and some dozens of pairs on the smallest drogue.
DUPLICATE_EVERY = 16
PILOT_COUNT = 9
"""Pilot rays per pixel, which tell how many rays the pixel takes."""
LEAST_COUNT, MOST_COUNT = 16, 2048
"""Fewest and most rays of a pixel with an edge."""
# Mean square error of n samples of these sequences at edges, over the variance of one sample times n^-1.5.
_ERROR_OF_ONE = 0.7
# Weight of the squared error beside the drogue: a picture without speckles needs less than a drogue without noise.
_WEIGHT_BESIDE = 0.25
# Share of the edges' mean variance that is added to every pixel's, for what its rays did not show. At 37 m one pixel of
# 2,000 had a twentieth of bright sky that its nine pilot rays and those around all missed; it took 16 rays and made up
# three fifths of the squared error.
_UNSEEN = 0.01


@dataclass(frozen=True)
class MonteCarloNoise:
    """Noise of the renderer on pixels of the drogue.

    Attributes:
        fraction: root mean square error of luminance over root mean square luminance.
        over_sensor: root mean square error of the sensor's electrons over the standard deviation of shot and read
            noise, both behind the lens.
    """

    fraction: float
    over_sensor: float


NO_NOISE = MonteCarloNoise(fraction=0.0, over_sensor=0.0)
"""Noise of an image without a drogue, and of an engine without sampling."""


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """How the sensor of a frame responds to light and to its errors.

    Attributes:
        weights: (3, C) weights of the three bands in each of the sensor's channels.
        per_cd_m2: electrons per luminance. [e- m2/cd]
        read_noise_e: standard deviation of the read noise. [e-]
        left_by_lens: share of independent errors of neighbouring pixels that is left behind the lens.
    """

    weights: NDArray[np.float64]
    per_cd_m2: float
    read_noise_e: float
    left_by_lens: float

    @classmethod
    def of(cls, frame: FrameSpec) -> SensorNoise:
        """The noise of a frame's sensor at its exposure."""
        sensor = frame.sensor
        left_by_lens = 1.0
        if sensor.psf_sigma_px > 0:
            reach = int(np.ceil(4 * sensor.psf_sigma_px))
            # The root of the kernel's energy, once for the rows and once for the columns.
            left_by_lens = float(np.sum(cv2.getGaussianKernel(2 * reach + 1, sensor.psf_sigma_px) ** 2))
        weights = mono_weights(frame.band_nm).T if frame.is_monochrome else np.eye(3)
        return cls(
            weights=weights,
            per_cd_m2=sensor.electrons_per_cd_m2(frame.exposure),
            read_noise_e=sensor.read_noise_e,
            left_by_lens=left_by_lens,
        )

    def variance(self, mean: NDArray[np.float64]) -> float:
        """Variance of shot and read noise for (P, 3) light on average. [cd2/m4]"""
        electrons = float(np.mean(np.maximum(mean @ self.weights, 0.0))) * self.per_cd_m2
        return (electrons + self.read_noise_e**2) / self.per_cd_m2**2


def measure_noise(
    frame: FrameSpec, first: NDArray[np.float32], second: NDArray[np.float32], shared: NDArray[np.float32]
) -> MonteCarloNoise:
    """Noise of one estimate of pixels, from two independent ones.

    The lens averages over neighbours, which leaves a known share of independent errors, and all of an error that
    neighbours have in common.

    Args:
        frame: gives sensor and exposure.
        first, second: (P, 3) estimates of the same pixels, independent apart from the shared error. [cd/m2]
        shared: (P, 3) known error that both estimates and the neighbouring pixels have in common. [cd/m2]
    """
    if not len(first):
        return NO_NOISE
    # float64: squares of 1e-5 of daylight matter in the sums.
    error, mean = (first - second).astype(np.float64) / np.sqrt(2), (first + second).astype(np.float64) / 2
    luminance = [values @ REC709_LUMINANCE for values in (error, shared, mean)]
    fraction = np.sqrt(np.sum(luminance[0] ** 2 + luminance[1] ** 2) / max(np.sum(luminance[2] ** 2), 1e-30))
    sensor = SensorNoise.of(frame)
    behind_lens = np.mean((sensor.left_by_lens * error @ sensor.weights) ** 2 + (shared @ sensor.weights) ** 2)
    return MonteCarloNoise(fraction=float(fraction), over_sensor=float(np.sqrt(behind_lens / sensor.variance(mean))))


class NoiseBudget:
    """Noise that is aimed at on the pixels whose centres see the drogue, and noise so far, as the image shows it.

    Attributes:
        aim: mean square error that is aimed at. [cd2/m4]
        light_error: (G,) mean square error by the denoised light on each group of parts. A caller that lessens the
            error updates it. [cd2/m4]
    """

    def __init__(
        self,
        compositor: Compositor,
        edges: tuple[NDArray[np.int64], NDArray[np.float32]],
        interior: tuple[NDArray[np.int64], NDArray[np.float32]],
        noise_over_sensor: float,
        group_of_part: NDArray[np.uint8] = OPEN_TO_SKY,
    ) -> None:
        """Evaluate pilot rays.

        Args:
            compositor: shows light behind the air and over the background.
            edges: (P,) flat indices of pixels with edges, and (P, S, 7) radiance, coverage and error of the denoised
                light by S single rays through each.
            interior: (Q,) flat indices of the other pixels that are traced twice, and (Q, 7) the same of each.
            noise_over_sensor: noise of the renderer that is aimed at, over the noise of the sensor.
            group_of_part: (256,) groups by part id: usually 0 where the sky is hidden and 1 in the open.
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
        seen = compositor.part_ids(np.concatenate([edge_pixel, interior_pixel]))
        errors_by_group = np.bincount(group_of_part[seen], weights=squared, minlength=int(group_of_part.max()) + 1)
        self.light_error: NDArray[np.float64] = errors_by_group.astype(np.float64)
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
    powers: NDArray[np.int64] = 2 ** np.rint(np.log2(np.clip(counts, LEAST_COUNT, MOST_COUNT))).astype(np.int64)
    return powers
