"""Both engines over all paired frames, and what that adds up to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from droguekit.engine_agreement.measures import FrameAgreement, compare
from droguekit.engine_agreement.paired_frames import PairedFrame, Rendered, render_both
from droguekit.engine_agreement.plates import PlateLight
from render.engine import RenderEngine

# The bars of the agreement: see docs/blender.md.
MOST_CENTROID_RMS_PX = 0.02
LEAST_DROGUE_IOU = 0.995
IOU_FROM_M = 5.0
MOST_RIB_DISTANCE_PX = 1.0
MOST_PLATE_ERROR = 0.005
MOST_PART_ERROR = 0.02
PARTS_WITH_A_BAR = ("markers", "rim", "canopy", "hose")


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """One frame by both engines: pictures, cost and noise of either, and what differs."""

    paired: PairedFrame
    one: Rendered
    other: Rendered
    agreement: FrameAgreement

    @property
    def cost_ratio(self) -> float:
        """CPU time of the other engine over the first one's at equal noise."""
        noise = self.other.plain.monte_carlo_noise_fraction / self.one.plain.monte_carlo_noise_fraction
        return self.other.cpu_s / self.one.cpu_s * noise**2


def compared_frames(frames: Sequence[PairedFrame], one: RenderEngine, other: RenderEngine) -> Iterator[ComparedFrame]:
    """Render every frame by both engines and compare."""
    for paired in frames:
        first, second = render_both(paired, one), render_both(paired, other)
        yield ComparedFrame(paired, first, second, compare(paired.frame, first, second))


@dataclass(frozen=True)
class Bar:
    """A figure, and the most or least that it may be."""

    name: str
    value: float
    limit: float
    at_least: bool = False

    @property
    def reached(self) -> bool:
        """Whether the figure keeps to its limit."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def bars(frames: Sequence[FrameAgreement], distances_m: Sequence[float], plates: Sequence[PlateLight]) -> list[Bar]:
    """What the engines are held to, over all frames.

    Args:
        frames: agreement of each.
        distances_m: of each frame's drogue. [m]
        plates: light on white plates.
    """
    centroids = np.concatenate([frame.centroids_px for frame in frames])
    label, one, other = np.moveaxis(centroids, 1, 0)
    result = [
        Bar("centroids between the engines, rms [px]", _rms(one - other), MOST_CENTROID_RMS_PX),
        Bar("centroids, first engine and labels, rms [px]", _rms(one - label), MOST_CENTROID_RMS_PX),
        Bar("centroids, second engine and labels, rms [px]", _rms(other - label), MOST_CENTROID_RMS_PX),
    ]
    near = [frame.drogue_iou for frame, d in zip(frames, distances_m, strict=True) if d <= IOU_FROM_M]
    if near:
        result.append(Bar("drogue masks up to 5 m, least overlap", min(near), LEAST_DROGUE_IOU, at_least=True))
    ribs = max(frame.rib_distance_px for frame in frames)
    result.append(Bar("ribs, farthest boundary [px]", ribs, MOST_RIB_DISTANCE_PX))
    if plates:
        worst = max(abs(plate.ratio - 1) for plate in plates)
        result.append(Bar("white plates, largest difference", worst, MOST_PLATE_ERROR))
    ratios = part_ratios(frames)
    for part in PARTS_WITH_A_BAR:
        if part in ratios:
            result.append(Bar(f"{part}, difference of mean luminance", abs(ratios[part] - 1), MOST_PART_ERROR))
    return result


def part_ratios(frames: Sequence[FrameAgreement]) -> dict[str, float]:
    """Mean luminance of each part by the second engine over that by the first, frames weighted by their pixels."""
    names = sorted({name for frame in frames for name in frame.part_sums})
    ratios = {}
    for name in names:
        rows = [frame.part_sums[name] for frame in frames if name in frame.part_sums]
        ratios[name] = float(np.average([other / one for _, one, other in rows], weights=[count for count, *_ in rows]))
    return ratios


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0
