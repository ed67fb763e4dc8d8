"""Tables and claims of the page as text, measured and published numbers in the same columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from droguekit.scoring.detection.detection_figures import published_name
from droguekit.scoring.detection.detection_report import best_detector
from droguekit.scoring.detection.detection_tables import PUBLISHED_DETECTORS, percent_text
from droguekit.scoring.report.html_page import RowGroup, Table
from droguekit.scoring.report.number_text import ABSENT, interval_text, millimetres, percent, three_digits
from droguekit.scoring.results.benchmark_result import MethodResult, PoseRow
from droguekit.scoring.results.detection_result import DetectionResult, DetectorResult
from geometry.se3 import Array
from studies.acceptance.rendered.sequence_pairs import LEAST_MARKERS
from studies.paper.docking_experiment import DockingData, frames_in_view, subset_scores
from studies.paper.paper_figures import published_row
from studies.paper.published_results import (
    ANGLE_LIMIT_DEG,
    DETECTION_FPS,
    DETECTION_MAP,
    DOCKING_OURS,
    OURS,
    PAPER,
    POSITION_LIMIT_M,
    TABLE_2,
    Contender,
)
from studies.paper.semi_physical import SemiPhysicalRun, StationErrors

_FALSE_POSES = "poses without a drogue"
_THRESHOLD_FROM = {
    "given": "as given to the command",
    "detector": "the detector's own",
    "val": "the best F1 on the split val",
    "scored images": "the best F1 on the scored images themselves, which flatters precision and recall",
}


class Claim(NamedTuple):
    """A line of the summary.

    Attributes:
        what: is claimed.
        published: by the paper, on its own data.
        ours, rebuilt: measured here, of our method and of the paper's as it is rebuilt here.
    """

    what: str
    published: str
    ours: str
    rebuilt: str


def table_1(result: DetectionResult) -> Table:
    """The paper's Table 1."""
    published = [
        [
            published_name(row.name),
            *(f"{100 * value:.4g} %" for value in (row.precision, row.recall, row.ap50)),
            f"{row.gflops:.1f}",
            three_digits(row.image_s),
        ]
        for row in PUBLISHED_DETECTORS
    ]
    return Table(
        "1",
        "Table 1. Detectors",
        ["precision", "recall", "mAP at 0.5", "GFLOPs", "s an image"],
        [
            RowGroup(
                f"measured here: {detection_source(result)}", [_detector_cells(*d) for d in result.detectors.items()]
            ),
            RowGroup("published, on other data; time on an Nvidia Xavier AGX", published, is_published=True),
        ],
        first=None,
        second="model",
        notes=[_threshold_note(name, detector) for name, detector in result.detectors.items()],
    )


def detection_source(result: DetectionResult) -> str:
    """On which images detectors were scored."""
    facts = result.dataset
    split = "all splits" if facts.split == "all" else f"split {facts.split}"
    return f"{facts.images} images of {facts.name}, {split}"


def table_2(runs: Sequence[SemiPhysicalRun]) -> Table:
    """The paper's Table 2: the largest mean of any station."""
    has_empty = any(errors.empty_pairs for run in runs for errors in run.methods.values())
    columns = ["X [mm]", "Y [mm]", "Z / distance, reading", "Z / distance, truth", "poses", "stations"]
    groups = [
        RowGroup(
            f"measured here, {run.markers} markers: {run.source}",
            [_station_cells(contender, run.methods[contender.method]) for contender in run.contenders],
        )
        for run in runs
    ]
    published = [
        [
            published_name(row.name),
            *(f"≤ {1e3 * row.x_m:g}", f"≤ {1e3 * row.y_m:g}", f"≤ {100 * row.z_fraction:.2f} %"),
            *(ABSENT, ABSENT, ABSENT, ABSENT),
        ]
        for row in TABLE_2
    ]
    groups.append(RowGroup("published, on other data", published, is_published=True))
    return Table(
        "2",
        "Table 2. Location error of the semi-physical experiment, worst station with a pose",
        columns if not has_empty else [*columns, _FALSE_POSES],
        groups if has_empty else [_without_last(group) for group in groups],
        first=None,
    )


def docking_table(docking: DockingData, anchor: str) -> Table:
    """Errors of every contender over all docking runs, with what the paper prints of its own."""
    columns = ["pose found", "mean [mm]", "95 % interval", "p99 [mm]", "largest X, Y, Z [mm]"]
    columns += ["pitch, yaw p99 [deg]", "published mean [mm]", _FALSE_POSES]
    scores = docking.result.methods
    groups = [RowGroup("all pairs", [_docking_cells(c, scores[c.method]) for c in docking.contenders])]
    frames = frames_in_view(docking.records)
    if 0 < len(frames) < len(docking.records):
        title = f"the {len(frames)} pairs of which both eyes see at least {LEAST_MARKERS} markers and the hub"
        groups.append(RowGroup(title, [_chosen_cells(docking, contender, frames) for contender in docking.contenders]))
    if not any(method.empty_frames.n for method in scores.values()):
        columns, groups = columns[:-1], [_without_last(group) for group in groups]
    title = f"Position error over {len(docking.records)} pairs of {docking.source}"
    return Table(anchor, title, columns, groups, first=None)


def worst_station(values: Array) -> float | None:
    """The largest mean; None where no station has one."""
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def fraction_text(fraction: float | None) -> str:
    """A fraction in percent with three digits."""
    return ABSENT if fraction is None else f"{three_digits(100 * fraction)} %"


def _detector_cells(name: str, detector: DetectorResult) -> list[str]:
    row, times = detector.overall, detector.times
    return [
        name,
        *map(percent_text, (row.precision, row.recall, row.ap50)),
        ABSENT if detector.gflops_per_image is None else three_digits(detector.gflops_per_image),
        ABSENT if times is None else three_digits(times.wall_ms / 2000),
    ]


def _threshold_note(name: str, detector: DetectorResult) -> str:
    sentence = (
        f"{name}: precision and recall are of boxes that score at least {three_digits(detector.operating_threshold)}"
    )
    remark = "" if detector.overall.note is None else f" ({detector.overall.note})"
    return f"{sentence}, {_THRESHOLD_FROM[detector.threshold_from]}{remark}."


def _without_last(group: RowGroup) -> RowGroup:
    return RowGroup(group.label, [row[:-1] for row in group.rows], group.is_published)


def _station_cells(contender: Contender, errors: StationErrors) -> list[str]:
    return [
        contender.label,
        *(millimetres(worst_station(values)) for values in (errors.x_m, errors.y_m)),
        *(fraction_text(worst_station(values)) for values in (errors.z_fraction, errors.z_true_fraction)),
        f"{errors.poses} of {errors.pairs}",
        errors.stations_text,
        count_text(errors.false_poses, errors.empty_pairs),
    ]


def count_text(count: int, total: int) -> str:
    """A count of a total; absent where the total is 0."""
    return f"{count} of {total}" if total else ABSENT


def _docking_cells(contender: Contender, method: MethodResult) -> list[str]:
    published, row, empty = contender.published, method.overall, method.empty_frames
    return [
        contender.label,
        percent(row.fix_fraction),
        millimetres(row.position_mean_m),
        # Without sequences, single pairs count as independent, and a filter's are not.
        ABSENT if contender.is_filtered else interval_text(row.intervals.get("position_mean_m"), 1e3),
        millimetres(row.position_p99_m),
        ", ".join(map(millimetres, (row.x_max_m, row.y_max_m, row.z_max_m))),
        ", ".join(map(three_digits, (row.pitch_p99_deg, row.yaw_p99_deg))),
        ABSENT if published is None else f"{1e3 * published.position_mean_m:.1f} ({published.name})",
        count_text(empty.false_fixes, empty.n),
    ]


def _chosen_cells(docking: DockingData, contender: Contender, frames: Sequence[int]) -> list[str]:
    scores = subset_scores(docking.pose_errors(contender.method), frames, docking.sequence_of_frame)
    largest = [None] * 3 if scores.largest_m is None else scores.largest_m.tolist()
    angles = [None] * 2 if scores.angles_p99_deg is None else scores.angles_p99_deg.tolist()
    return [
        contender.label,
        percent(scores.fix_fraction),
        millimetres(scores.mean_m),
        ABSENT if contender.is_filtered else interval_text(scores.interval_m, 1e3),
        millimetres(scores.p99_m),
        ", ".join(map(millimetres, largest)),
        ", ".join(map(three_digits, angles)),
        ABSENT,
        ABSENT,
    ]


def docking_claims(docking: DockingData) -> list[Claim]:
    """Of the view simulation."""
    methods = [docking.result.methods.get(name) for name in (OURS, PAPER)]
    rows = [None if method is None else method.overall for method in methods]
    limit = f"within ±{1e3 * POSITION_LIMIT_M:g} mm"
    claims = [
        Claim("pose found", ABSENT, *(ABSENT if row is None else percent(row.fix_fraction) for row in rows)),
        Claim("mean position error", f"{1e3 * DOCKING_OURS.position_mean_m:.1f} mm", *(_mean(row) for row in rows)),
        Claim("largest error in X, Y, Z", limit, *(_largest(row) for row in rows)),
        Claim("99 % of pitch, yaw", f"within ±{ANGLE_LIMIT_DEG:g}°", *(_angles(row) for row in rows)),
    ]
    if any(method is not None and method.empty_frames.n for method in methods):
        counts = (ABSENT if m is None else count_text(m.empty_frames.false_fixes, m.empty_frames.n) for m in methods)
        claims.insert(1, Claim("poses without a drogue", ABSENT, *counts))
    return [claim._replace(what=f"docking ({docking.source}): {claim.what}") for claim in claims]


def semi_physical_claims(runs: Sequence[SemiPhysicalRun]) -> Iterator[Claim]:
    """Of the bench experiment, where the paper prints numbers for as many markers."""
    for run in runs:
        published = published_row(run.markers)
        if published is None:
            continue
        errors = [run.methods.get(name) for name in (OURS, PAPER)]
        what = f"bench, {run.markers} markers ({run.source}), worst station"
        yield Claim(
            f"{what}: X, Y",
            f"≤ {1e3 * published.x_m:g}, {1e3 * published.y_m:g} mm",
            *map(_across, errors),
        )
        yield Claim(
            f"{what}: Z over distance, against the reading (the truth)",
            f"≤ {100 * published.z_fraction:.2f} %",
            *map(_depth, errors),
        )


def detection_claims(result: DetectionResult) -> list[Claim]:
    """Of the detector with the highest AP."""
    name = best_detector(result)
    detector = result.detectors[name]
    what = f"detection ({name} here, {detection_source(result)})"
    speed = ABSENT
    if detector.times is not None:
        speed = (
            f"{three_digits(2000 / detector.times.wall_ms)} images a second, on the machine that made the scores (not "
            "named in the file)"
        )
    return [
        Claim(f"{what}: mAP at overlap 0.5", percent_text(DETECTION_MAP), percent_text(detector.overall.ap50), ABSENT),
        Claim(f"{what}: speed", f"{DETECTION_FPS:g} images a second, Xavier AGX", speed, ABSENT),
    ]


def _across(errors: StationErrors | None) -> str:
    if errors is None:
        return ABSENT
    sizes = ", ".join(millimetres(worst_station(values)) for values in (errors.x_m, errors.y_m))
    return f"{sizes} mm{_of_stations(errors)}"


def _depth(errors: StationErrors | None) -> str:
    if errors is None:
        return ABSENT
    reading, true = (fraction_text(worst_station(values)) for values in (errors.z_fraction, errors.z_true_fraction))
    return f"{reading} ({true}){_of_stations(errors)}"


def _of_stations(errors: StationErrors) -> str:
    """Number of poses and stations behind a worst station."""
    return f"; poses in {errors.poses} of {errors.pairs} pairs, at {errors.stations_text} stations"


def _mean(row: PoseRow | None) -> str:
    if row is None or row.position_mean_m is None:
        return ABSENT
    return f"{millimetres(row.position_mean_m)} mm ({interval_text(row.intervals.get('position_mean_m'), 1e3)})"


def _largest(row: PoseRow | None) -> str:
    if row is None or row.x_max_m is None:
        return ABSENT
    return f"{', '.join(map(millimetres, (row.x_max_m, row.y_max_m, row.z_max_m)))} mm"


def _angles(row: PoseRow | None) -> str:
    if row is None or row.pitch_p99_deg is None:
        return ABSENT
    return f"within {three_digits(row.pitch_p99_deg)}°, {three_digits(row.yaw_p99_deg)}°"
