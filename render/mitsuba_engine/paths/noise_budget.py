"""How much a frame's edges and smoothed light may err for the noise that is aimed at, and what they err by so far."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from render.mitsuba_engine.paths.compositor import InPicture
from render.mitsuba_engine.paths.edge_samples import counts_by_variance
from render.mitsuba_engine.render_noise import TWICE_EVERY, SensorNoise
from render.mitsuba_engine.trace_request import IN_OPEN, OF_DROGUE

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
