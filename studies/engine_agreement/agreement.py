"""Requirements on the agreement of two engines, over all paired frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from render.engine import RenderEngine
from studies.engine_agreement.measures import FrameAgreement, PlateIlluminance, compare_renderings
from studies.engine_agreement.navigation_agreement import PairedErrors, mean_differences, size_ratios
from studies.engine_agreement.paired_frames import PairedFrame, RenderedFrame, render_plain_and_lit

# The criteria of the agreement, which README.md lists.
MOST_CENTROID_RMS_PX = 0.02
LEAST_DROGUE_IOU = 0.995
IOU_FROM_M = 5.0
MOST_RIB_DISTANCE_PX = 1.0
MOST_PLATE_ERROR = 0.005
MOST_PART_ERROR = 0.02
REQUIRED_PARTS = ("markers", "rim", "canopy", "hose")


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """One frame by both engines: renderings, costs and differences."""

    paired: PairedFrame
    one: RenderedFrame
    other: RenderedFrame
    agreement: FrameAgreement


def compare_frame(paired: PairedFrame, one: RenderEngine, other: RenderEngine) -> ComparedFrame:
    """Render a frame by both engines and compare."""
    first, second = render_plain_and_lit(paired, one), render_plain_and_lit(paired, other)
    agreement = compare_renderings(paired.frame, first, second)
    return ComparedFrame(paired=paired, one=first, other=second, agreement=agreement)


@dataclass(frozen=True)
class Requirement:
    """A figure and its limit: the most, or the least, that it may be."""

    name: str
    value: float
    limit: float
    at_least: bool = False

    @property
    def reached(self) -> bool:
        """Whether the figure is within its limit."""
        return bool(self.value >= self.limit if self.at_least else self.value <= self.limit)


def frame_requirements(frames: Sequence[FrameAgreement], distances_m: Sequence[float]) -> list[Requirement]:
    """Requirements on all frames together.

    Args:
        frames: agreement of each frame.
        distances_m: distance of each frame's drogue. [m]
    """
    centroids = np.concatenate([frame.centroids_px for frame in frames])
    label, one, other = np.moveaxis(centroids, 1, 0)
    result = [
        Requirement("centroids between the engines, rms [px]", _rms(one - other), MOST_CENTROID_RMS_PX),
        Requirement("centroids, first engine and labels, rms [px]", _rms(one - label), MOST_CENTROID_RMS_PX),
        Requirement("centroids, second engine and labels, rms [px]", _rms(other - label), MOST_CENTROID_RMS_PX),
    ]
    near = [frame.drogue_iou for frame, d in zip(frames, distances_m, strict=True) if d <= IOU_FROM_M]
    if near:
        result.append(Requirement("drogue masks up to 5 m, least overlap", min(near), LEAST_DROGUE_IOU, at_least=True))
    ribs = max(frame.rib_distance_px for frame in frames)
    result.append(Requirement("ribs, farthest boundary [px]", ribs, MOST_RIB_DISTANCE_PX))
    ratios = part_ratios(frames)
    for part in REQUIRED_PARTS:
        if part in ratios:
            result.append(Requirement(f"{part}, difference of mean luminance", abs(ratios[part] - 1), MOST_PART_ERROR))
    return result


@dataclass(frozen=True)
class CentroidOffset:
    """Systematic offset of the second engine's markers from the first's: mean and standard error. [px]"""

    n: int
    mean_px: tuple[float, float]
    error_px: tuple[float, float]


def centroid_offset(frames: Sequence[FrameAgreement]) -> CentroidOffset | None:
    """The offset over all markers of all frames; None with fewer than two markers."""
    centroids = np.concatenate([frame.centroids_px for frame in frames])
    apart = centroids[:, 2] - centroids[:, 1]
    if len(apart) < 2:
        return None
    errors = apart.std(axis=0, ddof=1) / np.sqrt(len(apart))
    return CentroidOffset(
        n=len(apart),
        mean_px=(float(apart[:, 0].mean()), float(apart[:, 1].mean())),
        error_px=(float(errors[0]), float(errors[1])),
    )


def plate_requirements(plates: Sequence[PlateIlluminance]) -> list[Requirement]:
    """Requirements on the illuminance of white plates."""
    # NumPy's maximum keeps NaN, so that a plate without light misses the requirement.
    worst = float(np.max([abs(plate.ratio - 1) for plate in plates]))
    return [Requirement("white plates, largest difference", worst, MOST_PLATE_ERROR)]


def navigation_requirements(stations: Sequence[PairedErrors]) -> list[Requirement]:
    """Requirements on navigation: equal error sizes and equal mean errors lie within the measured intervals."""
    sizes = [
        Requirement(f"{row.of} errors, equal sizes outside their interval by", row.outside, 0.0)
        for row in size_ratios(stations)
    ]
    means = [
        Requirement(f"{row.of} error, mean difference [own rms]", abs(row.mean), row.reach)
        for row in mean_differences(stations)
    ]
    return sizes + means


def part_ratios(frames: Sequence[FrameAgreement]) -> dict[str, float]:
    """Mean luminance of each part by the second engine over that by the first, weighted by the frames' pixels."""
    names = sorted({name for frame in frames for name in frame.part_sums})
    ratios = {}
    for name in names:
        rows = [frame.part_sums[name] for frame in frames if frame.part_sums.get(name, (0, 0.0, 0.0))[1] > 0]
        if not rows:
            continue
        ratios[name] = float(np.average([other / one for _, one, other in rows], weights=[count for count, *_ in rows]))
    return ratios


def _rms(values: NDArray[np.float64]) -> float:
    """Root mean square; infinite without values, because nothing was measured."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("inf")
