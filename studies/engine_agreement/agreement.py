"""Requirements on the agreement of two engines over all paired frames, and the report: lines, JSON, pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import write_text_atomic
from droguekit.scoring.confidence_intervals import root_mean_square
from render.engine import RenderEngine
from scenes.sky.photometry import luminance
from studies.engine_agreement.costs import CostComparison
from studies.engine_agreement.measures import FrameAgreement, PlateIlluminance, compare_renderings
from studies.engine_agreement.navigation_agreement import (
    PairedErrors,
    mean_differences,
    share_with_poses,
    size_ratios,
    station_rows,
)
from studies.engine_agreement.paired_frames import PairedFrame, RenderedFrame, render_plain_and_lit

# The criteria of the agreement, which README.md lists.
MOST_CENTROID_RMS_PX = 0.02
LEAST_DROGUE_IOU = 0.995
IOU_FROM_M = 5.0
MOST_RIB_DISTANCE_PX = 1.0
MOST_PLATE_ERROR = 0.005
MOST_PART_ERROR = 0.02
LEAST_POSE_SHARE = 0.95
# Sizes of errors are equivalent when the whole interval of their ratio lies in here (our choice, as for generic drugs).
EQUIVALENT_RATIOS = (0.8, 1.25)
# A pull of half the rms error makes it 12 % larger, half as much as the sizes may differ (our choice).
MOST_MEAN_DIFFERENCE = 0.5
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
    """Requirements on navigation: poses in nearly all pairs, and errors whose intervals show that they are equivalent.

    That equal errors lie within the intervals is not enough: fewer pairs have wider intervals.
    """
    share = share_with_poses(stations)
    poses = Requirement("poses, share of pairs with one by both engines", share, LEAST_POSE_SHARE, at_least=True)
    if not poses.reached:
        return [poses]
    low, high = EQUIVALENT_RATIOS
    sizes = [
        Requirement(f"{row.of} errors, interval of their ratio beyond {low:g} to {high:g} by", row.beyond(low, high), 0)
        for row in size_ratios(stations)
    ]
    means = [
        Requirement(
            f"{row.of} error, end of the interval of the mean difference [own rms]",
            abs(row.mean) + row.reach,
            MOST_MEAN_DIFFERENCE,
        )
        for row in mean_differences(stations)
    ]
    return [poses, *sizes, *means]


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
    return root_mean_square(values) if values.size else float("inf")


# A difference of a fortieth of the image's white reaches from middle grey to black or white.
_DIFFERENCE_SCALE = 40.0
_MARGIN_PX = 12


def frame_row(compared: ComparedFrame) -> dict[str, Any]:
    """The stored result of one frame."""
    return {
        "family": compared.paired.family,
        "distance_m": compared.paired.distance_m,
        "samples_per_px": compared.paired.settings.samples_per_px,
        "first_cpu_s": compared.one.cpu_s,
        "second_cpu_s": compared.other.cpu_s,
        "agreement": compared.agreement.row(),
    }


def frame_figures(row: dict[str, Any], agreement: FrameAgreement) -> dict[str, Any]:
    """The figures of one frame, without those of single markers."""
    label, one, other = np.moveaxis(agreement.centroids_px, 1, 0)
    return {name: value for name, value in row.items() if name != "agreement"} | {
        "markers": len(label),
        "centroid_rms_px": _rms_or_zero(one - other),
        "first_label_rms_px": _rms_or_zero(one - label),
        "second_label_rms_px": _rms_or_zero(other - label),
        "drogue_iou": agreement.drogue_iou,
        "rib_distance_px": agreement.rib_distance_px,
        "part_ratios": part_ratios([agreement]),
        "part_pixels": {name: sums[0] for name, sums in agreement.part_sums.items()},
    }


def frame_head() -> str:
    """The header over the lines of frames."""
    head = f"{'family':<26}{'m':>6}{'spp':>5}{'markers':>8}{'between':>9}{'1st-label':>10}{'2nd-label':>10}"
    return head + f"{'IoU':>9}{'ribs':>6}{'cpu 1st':>9}{'cpu 2nd':>9}  parts 2nd/1st"


def frame_line(figures: dict[str, Any]) -> str:
    """One line for a frame."""
    return (
        "{family:<26}{distance_m:6.3g}{samples_per_px:5d}{markers:8d}{centroid_rms_px:9.4f}{first_label_rms_px:10.4f}"
        "{second_label_rms_px:10.4f}{drogue_iou:9.5f}{rib_distance_px:6.2f}{first_cpu_s:9.2f}{second_cpu_s:9.2f}  "
    ).format(**figures) + " ".join(f"{name} {ratio:.3f}" for name, ratio in figures["part_ratios"].items())


def requirement_lines(bars: Sequence[Requirement]) -> list[str]:
    """One line per requirement."""
    return [
        f"{'reached' if bar.reached else 'MISSED ':<8} {bar.name}: {bar.value:.5f} "
        f"({'at least' if bar.at_least else 'at most'} {bar.limit:.4g})"
        for bar in bars
    ]


def offset_line(offset: CentroidOffset) -> str:
    """One line for the mean offset of the centroids."""
    (u, v), (error_u, error_v) = offset.mean_px, offset.error_px
    return (
        f"centroids, second engine less first: u {u:+.5f} +- {error_u:.5f} px, v {v:+.5f} +- {error_v:.5f} px, "
        f"mean and standard error of {offset.n}"
    )


def plate_line(plate: PlateIlluminance) -> str:
    """One line for a plate."""
    return (
        f"plate pitch {plate.pitch_deg:+.0f} yaw {plate.yaw_deg:+.0f} deg: {plate.one_lux:.0f} lx and "
        f"{plate.other_lux:.0f} lx, ratio {plate.ratio:.4f}; by integral {plate.integral_lux:.0f} lx"
    )


def cost_line(cost: CostComparison) -> str:
    """One line for the costs at a distance."""
    one, other = (
        f"{side.cpu_s:.2f} s at {side.samples} samples and noise {side.noise:.4f}" for side in (cost.one, cost.other)
    )
    return f"cost at {cost.distance_m:g} m: {one}; {other}" + ("" if cost.is_reached else ", not yet as quiet")


def navigation_lines(stations: Sequence[PairedErrors]) -> list[str]:
    """One line per distance, then the figures over all of them."""
    lines = []
    for row in station_rows(stations):
        sizes = " ".join(
            f"{name} {row['first_rms'][name]:.3g}/{row['second_rms'][name]:.3g}" for name in row["first_rms"]
        )
        lines.append(f"joint at {row['distance_m']:g} m, {row['fixes']} of {row['pairs']} pairs, rms 1st/2nd: {sizes}")
    for ratio in size_ratios(stations):
        low, high = ratio.interval or (float("nan"), float("nan"))
        lines.append(f"{ratio.of} errors 2nd/1st: {ratio.ratio:.3f} ({low:.3f} to {high:.3f}), {ratio.n} pairs")
    means = (f"{row.of} {row.mean:+.3f} +- {row.reach:.3f}" for row in mean_differences(stations))
    return [*lines, f"mean differences in own rms: {', '.join(means)}"]


def write_json(out: Path, tables: dict[str, Any], bars: Sequence[Requirement]) -> None:
    """All figures as `agreement.json`.

    Raises:
        OSError: it cannot be written.
    """
    # JSON has no infinity.
    rows = [{**vars(bar), "value": bar.value if math.isfinite(bar.value) else None} for bar in bars]
    reached = [{**row, "reached": bar.reached} for row, bar in zip(rows, bars, strict=True)]
    content = {"schema": 2, "bars": reached, **tables}
    write_text_atomic(out / "agreement.json", json.dumps(content, indent=1) + "\n")


def write_picture(path: Path, compared: ComparedFrame) -> None:
    """The left eye by both engines, and their difference: middle grey where there is none."""
    one, other = compared.one.plain.left, compared.other.plain.left
    rows, columns = np.nonzero((one.part_id > 0) | (other.part_id > 0))
    window = (slice(None), slice(None))
    if len(rows):
        window = (_span(rows, one.part_id.shape[0]), _span(columns, one.part_id.shape[1]))
    values = [luminance(eye.radiance_cd_m2[window]) for eye in (one, other)]
    white = float(np.percentile(values[0], 99.5)) or 1.0
    shown = [np.clip(value / white, 0.0, 1.0) ** (1 / 2.2) for value in values]
    shown.append(np.clip(0.5 + _DIFFERENCE_SCALE * (values[1] - values[0]) / white / 2, 0.0, 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), (np.concatenate(shown, axis=1) * 255).astype(np.uint8))


def _span(indices: NDArray[np.intp], size: int) -> slice:
    return slice(max(int(indices.min()) - _MARGIN_PX, 0), min(int(indices.max()) + _MARGIN_PX + 1, size))


def _rms_or_zero(values: NDArray[np.float64]) -> float:
    return root_mean_square(values) if values.size else 0.0
