"""The view that every renderer draws, its noise on the drogue, and the samples that reach a given noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import Recipe, RenderSettings, load_recipe
from datasets_manifest.types.frame import FrameSpec
from scenes.sampler import sample_frame

# Noise measured on a few hundred pixels is itself known to a few percent.
_CLOSE_ENOUGH = 0.1
_MOST_ATTEMPTS = 5
STATIONS_M = (2.0, 5.0, 10.0, 20.0, 40.0)
# Margin around the drogue for the denoiser.
_MARGIN_PX = 32
_RECIPE = "daylight-10m"
# Enough different scenes that nothing cached from one frame serves the next.
SCENES = 8


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of a renderer's pictures with a number of samples.

    Attributes:
        samples: paths per pixel.
        noise: root mean square error of luminance over its mean, on the drogue's pixels.
        noise_inside: the same without pixels at edges between parts.
        mean_cd_m2: mean luminance of the drogue's pixels. [cd/m2]
        is_carried_on: extrapolated from fewer samples by the law of independent samples.
    """

    samples: int
    noise: float
    noise_inside: float
    mean_cd_m2: float
    is_carried_on: bool = False

    def with_samples(self, samples: int) -> NoiseEstimate:
        """Extrapolation to so many samples: errors fall with their square root."""
        down = float(np.sqrt(samples / self.samples))
        return NoiseEstimate(
            samples=samples,
            noise=self.noise / down,
            noise_inside=self.noise_inside / down,
            mean_cd_m2=self.mean_cd_m2,
            is_carried_on=True,
        )


@dataclass(frozen=True)
class RenderCost:
    """CPU time of a whole pair.

    Attributes:
        cpu_s: user and system time. [s]
        is_least: a lower bound, measured with fewer samples than needed.
    """

    cpu_s: float
    is_least: bool = False


def relative_noise(
    first: NDArray[np.floating[Any]], second: NDArray[np.floating[Any]], mask: NDArray[np.bool_]
) -> float:
    """Root mean square error of one of two equally noisy pictures over their mean, on the pixels of a mask."""
    one, other = first[mask].astype(np.float64), second[mask].astype(np.float64)
    return float(np.sqrt(np.mean(np.square(one - other)) / 2) / np.mean((one + other) / 2))


def noise_of(
    samples: int,
    pictures: tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]],
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]],
) -> NoiseEstimate:
    """Noise from two pictures with different seeds, on the drogue's pixels and inside its parts."""
    one, other = pictures
    drogue, inside = masks
    mean = float((one[drogue].mean(dtype=np.float64) + other[drogue].mean(dtype=np.float64)) / 2)
    return NoiseEstimate(
        samples=samples,
        noise=relative_noise(one, other, drogue),
        noise_inside=relative_noise(one, other, inside),
        mean_cd_m2=mean,
    )


def samples_for(measured: NoiseEstimate, noise: float) -> int:
    """Samples that reach a noise if it falls with their square root."""
    # Rounding of the square must not add a sample.
    return max(1, int(np.ceil(measured.samples * (measured.noise / noise) ** 2 - 1e-6)))


def reach_noise(measure: Callable[[int], NoiseEstimate], noise: float, pilot: int, most_samples: int) -> NoiseEstimate:
    """Samples that give a noise, found by the square-root law and verified.

    Args:
        measure: renders with at least so many samples.
        noise: to be reached.
        pilot: samples of the first attempt.
        most_samples: of an attempt; beyond these the law extrapolates.

    Returns:
        The attempt whose noise is nearest, by ratio; a single sample may give less noise than asked for.
    """
    tried: dict[int, NoiseEstimate] = {}
    samples = pilot
    while len(tried) < _MOST_ATTEMPTS and samples not in tried:
        tried[samples] = measure(samples)
        best = min(tried.values(), key=lambda each: abs(np.log(each.noise / noise)))
        if abs(best.noise / noise - 1) <= _CLOSE_ENOUGH:
            return best
        samples = min(samples_for(best, noise), most_samples)
    return best.with_samples(samples_for(best, noise)) if best.noise > noise else best


@dataclass(frozen=True, eq=False)
class MeasuredView:
    """The view that every renderer draws.

    Attributes:
        frame: has a drogue, at rest on a clear day.
        settings: default settings.
        drogue: (H, W) pixels of the left eye whose centres see the drogue.
        inside: those of them whose neighbours all see the same part.
    """

    frame: FrameSpec
    settings: RenderSettings
    drogue: NDArray[np.bool_]
    inside: NDArray[np.bool_]

    @property
    def crop(self) -> tuple[int, int, int, int]:
        """(left, top, width, height) of the part of the left eye that holds the drogue. [px]"""
        rows, columns = (np.flatnonzero(self.drogue.any(axis=axis)) for axis in (1, 0))
        top, left = max(int(rows[0]) - _MARGIN_PX, 0), max(int(columns[0]) - _MARGIN_PX, 0)
        height, width = self.drogue.shape
        right, bottom = min(int(columns[-1]) + _MARGIN_PX, width - 1), min(int(rows[-1]) + _MARGIN_PX, height - 1)
        return left, top, right - left + 1, bottom - top + 1

    @property
    def masks(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The drogue's pixels and those inside its parts, of the crop."""
        left, top, width, height = self.crop
        within = slice(top, top + height), slice(left, left + width)
        return self.drogue[within], self.inside[within]


def recipe_at(distance_m: float, seed: int) -> Recipe:
    """The recipe with every drogue at one distance. [m]"""
    recipe = load_recipe(_RECIPE, seed).recipe
    changes = {
        "frames": {"count": SCENES, "scenes": SCENES, "empty_fraction": 0.0},
        "distance": {"law": "stations", "stations_m": (distance_m,)},
    }
    return Recipe.model_validate({**recipe.model_dump(), **changes})


def with_seed_offset(frame: FrameSpec, by: int) -> FrameSpec:
    """The same frame with other samples and other sensor noise."""
    return frame.model_copy(update={"seed": frame.seed + by})


def frame_at(distance_m: float, seed: int, index: int = 0) -> FrameSpec:
    """A frame at one distance. [m]"""
    return sample_frame(recipe_at(distance_m, seed), index)
