"""Both engines over all paired frames, and what that adds up to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from render.engine import RenderEngine
from studies.engine_agreement.measures import FrameAgreement, PlateIlluminance, compare
from studies.engine_agreement.navigation_agreement import PairedErrors, mean_differences, size_ratios
from studies.engine_agreement.paired_frames import PairedFrame, RenderedFrame, render_both

# The bars of the agreement: see docs/explanation/blender.md.
MOST_CENTROID_RMS_PX = 0.02
LEAST_DROGUE_IOU = 0.995
IOU_FROM_M = 5.0
MOST_RIB_DISTANCE_PX = 1.0
MOST_PLATE_ERROR = 0.005
MOST_PART_ERROR = 0.02
PARTS_WITH_A_BAR = ("markers", "rim", "canopy", "hose")


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """One frame by both engines: pictures and cost of either, and what differs."""

    paired: PairedFrame
    one: RenderedFrame
    other: RenderedFrame
    agreement: FrameAgreement


def compare_frame(paired: PairedFrame, one: RenderEngine, other: RenderEngine) -> ComparedFrame:
    """Render a frame by both engines and compare."""
    first, second = render_both(paired, one), render_both(paired, other)
    return ComparedFrame(paired, first, second, compare(paired.frame, first, second))


@dataclass(frozen=True)
class Requirement:
    """A figure, and the most or least that it may be."""

    name: str
    value: float
    limit: float
    at_least: bool = False

    @property
    def reached(self) -> bool:
        """Whether the figure keeps to its limit."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def frame_bars(frames: Sequence[FrameAgreement], distances_m: Sequence[float]) -> list[Requirement]:
    """What the engines are held to, over all frames.

    Args:
        frames: agreement of each.
        distances_m: of each frame's drogue. [m]
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
    for part in PARTS_WITH_A_BAR:
        if part in ratios:
            result.append(Requirement(f"{part}, difference of mean luminance", abs(ratios[part] - 1), MOST_PART_ERROR))
    return result


@dataclass(frozen=True)
class CentroidOffset:
    """Whether one engine's markers lie to a side of the other's: second less first, mean and standard error. [px]"""

    n: int
    mean_px: tuple[float, float]
    error_px: tuple[float, float]


def centroid_offset(frames: Sequence[FrameAgreement]) -> CentroidOffset | None:
    """Over all markers of all frames; None with fewer than two."""
    centroids = np.concatenate([frame.centroids_px for frame in frames])
    apart = centroids[:, 2] - centroids[:, 1]
    if len(apart) < 2:
        return None
    errors = apart.std(axis=0, ddof=1) / np.sqrt(len(apart))
    return CentroidOffset(
        len(apart), (float(apart[:, 0].mean()), float(apart[:, 1].mean())), (float(errors[0]), float(errors[1]))
    )


def plate_bars(plates: Sequence[PlateIlluminance]) -> list[Requirement]:
    """What the engines are held to by light on white plates."""
    # numpy's maximum keeps what is not a number, so that a plate without light misses the bar.
    worst = float(np.max([abs(plate.ratio - 1) for plate in plates]))
    return [Requirement("white plates, largest difference", worst, MOST_PLATE_ERROR)]


def navigation_bars(stations: Sequence[PairedErrors]) -> list[Requirement]:
    """Whether navigation errs alike: equal sizes and equal means lie within the intervals of what was measured."""
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
    """Mean luminance of each part by the second engine over that by the first, frames weighted by their pixels."""
    names = sorted({name for frame in frames for name in frame.part_sums})
    ratios = {}
    for name in names:
        rows = [frame.part_sums[name] for frame in frames if frame.part_sums.get(name, (0, 0.0, 0.0))[1] > 0]
        if not rows:
            continue
        ratios[name] = float(np.average([other / one for _, one, other in rows], weights=[count for count, *_ in rows]))
    return ratios


def _rms(values: NDArray[np.float64]) -> float:
    """Root mean square; of nothing it is infinite, as nothing was shown."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("inf")
