"""The paper's claims beside what was measured here, one line each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from droguekit.benchmark.detection.detection_report import best_detector
from droguekit.benchmark.detection.detection_tables import share
from droguekit.benchmark.report.number_text import ABSENT, interval_text, millimetres, percent, three_digits
from droguekit.benchmark.results.benchmark_result import Row
from droguekit.benchmark.results.detection_result import DetectionResult
from studies.paper.contenders import OURS, PAPER
from studies.paper.docking_run import DockingData
from studies.paper.page_tables import count_text, detection_source, fraction_text, worst_station
from studies.paper.published import (
    ANGLE_LIMIT_DEG,
    DETECTION_FPS,
    DETECTION_MAP,
    DOCKING_OURS,
    POSITION_LIMIT_M,
)
from studies.paper.semi_physical import SemiPhysicalRun, StationErrors
from studies.paper.station_figures import published_row


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
        Claim(f"{what}: mAP at overlap 0.5", share(DETECTION_MAP), share(detector.overall.ap50), ABSENT),
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
    """What the worst one is the worst of."""
    return f"; poses in {errors.poses} of {errors.pairs} pairs, at {errors.stations_text} stations"


def _mean(row: Row | None) -> str:
    if row is None or row.position_mean_m is None:
        return ABSENT
    return f"{millimetres(row.position_mean_m)} mm ({interval_text(row.intervals.get('position_mean_m'), 1e3)})"


def _largest(row: Row | None) -> str:
    if row is None or row.x_max_m is None:
        return ABSENT
    return f"{', '.join(map(millimetres, (row.x_max_m, row.y_max_m, row.z_max_m)))} mm"


def _angles(row: Row | None) -> str:
    if row is None or row.pitch_p99_deg is None:
        return ABSENT
    return f"within {three_digits(row.pitch_p99_deg)}°, {three_digits(row.yaw_p99_deg)}°"
