"""Tiers C, D and speed, at the level of centroids: noise, flips, covariances, tolerances, bad markers, run times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy.stats import norm

from datasets_manifest.random_streams import seeded_generator
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import RING_RADIUS_M, load_drogue
from droguekit.batch.progress import ProgressReport
from droguekit.numerical_threads import one_thread
from droguekit.scoring.confidence_intervals import CONFIDENCE, rms_upper_limit
from droguekit.scoring.poses.cramer_rao import FacingRing, feature_points
from geometry.stereo import paper_rig
from nav.pair_measurement import PairMeasurement
from nav.pair_navigator import PairNavigator
from nav.pose.joint import joint
from nav.pose.method_registry import pose_method
from nav.pose.pose_method import Observation, Solution
from studies.acceptance.acceptance_table import (
    AcceptanceRow,
    ValueWithLimit,
    at_most,
    between,
    nees_limits,
    paired_ratio_limit,
    paired_rms_ratio_limit,
    worst,
)
from studies.acceptance.centroid_level.drawn_frames import (
    AS_BUILT,
    CLEAN,
    RING_ONLY,
    TOLERANCED,
    Corruption,
    Tolerances,
    draw_poses,
    draw_shifts,
    ellipse_centers_px,
    stated_tolerances,
)
from studies.acceptance.centroid_level.monte_carlo import (
    BATCHED_DRAWS,
    DOCKING_RANGE_M,
    FLIP_DRAWS,
    MARKER_COUNTS,
    ORDER_DRAWS,
    ROBUST_ORDER_DRAWS,
    SIGMAS_PX,
    SINGLE_DRAWS,
    STATIONS_M,
    Cell,
    CellResult,
    run_cells,
)
from studies.acceptance.centroid_level.solvers import MeasuredFrames, observations, solve

# Where the ring's radius outweighs all else, knowing of it or not changes nothing: the ratio is 1, and its limit above.
_NEVER_WORSE = 1.01

Results = Mapping[Cell, CellResult]


def measure_tier_c(out: Path, seed: int, draws: int | None, report: ProgressReport) -> list[AcceptanceRow]:
    """Tier C, criteria 5, 6, 7, 9 and 10: noise, flips, covariances and tolerances.

    Cells that are finished already are not run again.

    Args:
        out: keeps finished cells.
        seed: of the draws.
        draws: frames a cell, the protocol's when None.
        report: of progress.

    Raises:
        ValueError: a seed or number out of range, or a folder with other content.
        OSError: the folder cannot be written.
    """
    count = draws or BATCHED_DRAWS
    ring, hub = as_built_cells("joint", seed, draws or FLIP_DRAWS), as_built_cells("joint-hub", seed, count)
    every, ring_only = (toleranced_cells(tolerances, seed, count) for tolerances in (TOLERANCED, RING_ONLY))
    results = run_cells([*ring, *hub, *every, *ring_only], out, report)
    return [
        *_nrms_rows("5", "X, Y, Z NRMS, hub, as built", slice(0, 3), (1.08, 1.20), {c: results[c] for c in hub}),
        *_nrms_rows("6", "pitch, yaw NRMS, hub, as built", slice(3, 5), (1.10, 1.25), {c: results[c] for c in hub}),
        *_without_hub_rows({c: results[c] for c in ring}),
        _nees_row("NEES/dof, joint-hub, as built, all cells", [results[c] for c in hub]),
        _nees_row("NEES/dof, joint-hub, all tolerances", [results[c] for c in every]),
        _predicted_row("Z RMSE / prediction, all tolerances, worst cell", {c: results[c] for c in every}),
        _predicted_row("Z RMSE / prediction, ring radius only, worst cell", {c: results[c] for c in ring_only}),
        _never_worse_row({c: results[c] for c in every}),
    ]


def as_built_cells(method: str, seed: int, draws: int) -> list[Cell]:
    """All stations, noises and numbers of markers."""
    return [
        Cell(method, markers, (station, station), sigma, draws, seed, tolerances=AS_BUILT)
        for markers in MARKER_COUNTS
        for sigma in SIGMAS_PX
        for station in STATIONS_M
    ]


def toleranced_cells(tolerances: Tolerances, seed: int, draws: int) -> list[Cell]:
    """Eight markers at all stations and noises; the tolerances are stated to the method."""
    stated = stated_tolerances(tolerances, paper_rig())
    return [
        Cell("joint-hub", 8, (station, station), sigma, draws, seed, tolerances=tolerances, stated=stated)
        for sigma in SIGMAS_PX
        for station in STATIONS_M
    ]


def _nrms_rows(
    bar: str, quantity: str, part: slice, bars: tuple[float, float], results: Results
) -> list[AcceptanceRow]:
    """The worst component, pooled over all cells and in the worst cell."""
    values = np.array([result.nrms[part] for result in results.values()])
    counts = np.array([result.n for result in results.values()])
    pooled = float(np.sqrt(counts @ values**2 / counts.sum()).max())
    n = int(counts.sum())
    cells = [
        (_name(cell), value, rms_upper_limit(value, result.n))
        for cell, result in results.items()
        for value in np.array(result.nrms)[part].tolist()
    ]
    where, value, limit = worst(cells)
    return [
        at_most(bar, f"{quantity}, pooled", bars[0], (pooled, rms_upper_limit(pooled, n)), n),
        at_most(bar, f"{quantity}, worst cell", bars[1], (value, limit), int(counts.min()), where),
    ]


def _without_hub_rows(results: Results) -> list[AcceptanceRow]:
    """Attitude where the tilt is clear, and how often it is mirrored elsewhere."""
    clear = [(cell, r) for cell, r in results.items() if r.clear_nrms is not None and r.clear_n]
    rows = []
    if clear:
        counts = np.array([r.clear_n for _, r in clear])
        values = np.array([r.clear_nrms for _, r in clear])
        pooled, n = float(np.sqrt((counts @ values**2) / counts.sum()).max()), int(counts.sum())
        quantity = "pitch, yaw NRMS, no hub, tilt > 3 s0, pooled"
        rows.append(at_most("7", quantity, 1.20, (pooled, rms_upper_limit(pooled, n)), n))
    flips = [(_name(cell), *_flip_gap(result)) for cell, result in results.items()]
    where, gap, limit = worst(flips)
    fewest = min(result.n for result in results.values())
    rows.append(at_most("7", "|flip rate - Q(T/s0)|, worst cell", 0.02, (gap, limit), fewest, where))
    return rows


def _flip_gap(result: CellResult) -> ValueWithLimit:
    """Distance of the flip rate from the law; its limit counts the binomial error of the rate under the law."""
    gap = abs(result.flips / result.n - result.flip_law)
    error = np.sqrt(result.flip_law * (1 - result.flip_law) / result.n)
    return gap, gap + float(norm.ppf(CONFIDENCE) * error)


def _nees_row(quantity: str, results: list[CellResult]) -> AcceptanceRow:
    counts = np.array([result.nees_n for result in results])
    values = np.array([result.nees or 0.0 for result in results])
    freedom = 5 * int(counts.sum())
    return between(
        "9", quantity, (0.85, 1.20), nees_limits(5 * float(counts @ values) / freedom, freedom), freedom // 5
    )


def _predicted_row(quantity: str, results: Results) -> AcceptanceRow:
    rig = paper_rig()
    rows = []
    for cell, result in results.items():
        ring = FacingRing(rig.camera.fx_px, rig.baseline_m, RING_RADIUS_M, cell.markers, cell.distance_m[0])
        stated = cell.stated
        scale = stated.ring_radius_m / RING_RADIUS_M
        predicted = ring.toleranced_depth_m(cell.sigma_px, scale, stated.disparity_px, stated.placement_m)
        ratio = result.z_rms_m / predicted
        rows.append((_name(cell), ratio, rms_upper_limit(ratio, result.n)))
    where, ratio, limit = worst(rows)
    return at_most("10", quantity, 1.20, (ratio, limit), next(iter(results.values())).n, where)


def _never_worse_row(results: Results) -> AcceptanceRow:
    """Z errors of the method with stated tolerances over the better of stereo alone and itself without them."""
    rows = []
    for cell, result in results.items():
        assert result.untold is not None
        best = min(result.stereo, result.untold, key=lambda rival: rival.z_rms_m)
        limited = paired_rms_ratio_limit(result.z_rms_m, best.z_rms_m, best.correlation, result.n)
        rows.append((_name(cell), *limited))
    where, ratio, limit = worst(rows)
    quantity = "Z RMSE / the better of stereo mean and fixed ring, all tolerances, worst cell"
    return at_most("10", quantity, _NEVER_WORSE, (ratio, limit), next(iter(results.values())).n, where)


def _name(cell: Cell) -> str:
    low, high = cell.distance_m
    place = f"{low:g} m" if low == high else f"{low:g} to {high:g} m"
    return f"{cell.markers} markers, {cell.sigma_px:g} px, {place}"


CellMaker = Callable[[str, int, float, Corruption], Cell]

# Centroid noise at which robust methods are compared with themselves on clean markers.
_SIGMA_PX = 0.1
# The seed paper's order of 5, 7 and 8 markers shows from this noise on.
_ORDER_SIGMAS_PX = tuple(sigma for sigma in SIGMAS_PX if sigma >= 0.1)
_ONE_EYE = Corruption(1, "one eye")
_BAD = {
    count: (Corruption(count, "one eye"), Corruption(count, "both eyes"), Corruption(count, "u only"))
    for count in (1, 2)
}


def measure_tier_d(out: Path, seed: int, draws: int | None, report: ProgressReport) -> list[AcceptanceRow]:
    """Tier D, criteria 11 and 12: some markers measured wrongly.

    Arguments and errors as `measure_tier_c`.
    """

    def robust(method: str, markers: int, sigma_px: float, corruption: Corruption) -> Cell:
        return Cell(method, markers, DOCKING_RANGE_M, sigma_px, draws or SINGLE_DRAWS, seed, corruption)

    def ordered(method: str, markers: int, sigma_px: float, corruption: Corruption) -> Cell:
        many = ROBUST_ORDER_DRAWS if method == "joint-robust" else ORDER_DRAWS
        return replace(robust(method, markers, sigma_px, corruption), draws=draws or many)

    planned = [
        robust("joint-robust", markers, _SIGMA_PX, corruption)
        for markers in MARKER_COUNTS
        for corruption in (CLEAN, *_BAD[1], *(_BAD[2] if markers > 5 else ()))
    ]
    planned += [ordered("paper", markers, sigma, _ONE_EYE) for sigma in _ORDER_SIGMAS_PX for markers in MARKER_COUNTS]
    planned += [ordered("joint-robust", markers, sigma, _ONE_EYE) for sigma in SIGMAS_PX for markers in MARKER_COUNTS]
    planned += [ordered("paper-literal", 8, sigma, _ONE_EYE) for sigma in _ORDER_SIGMAS_PX]
    results = run_cells(planned, out, report)
    return [
        _against_clean((7, 8), 1, 1.25, robust, results),
        _against_clean((7, 8), 2, 1.5, robust, results),
        _against_clean((5,), 1, 1.5, robust, results),
        _order("paper", _ORDER_SIGMAS_PX, ordered, results),
        _order("joint-robust", SIGMAS_PX, ordered, results),
        _literal(ordered, results),
    ]


def _against_clean(counts: tuple[int, ...], bad: int, bar: float, cell: CellMaker, results: Results) -> AcceptanceRow:
    """Mean position error of the robust method with bad markers over that with good ones, worst case."""
    rows = []
    for markers in counts:
        clean = results[cell("joint-robust", markers, _SIGMA_PX, CLEAN)]
        for corruption in _BAD[bad]:
            bad_result = results[cell("joint-robust", markers, _SIGMA_PX, corruption)]
            rows.append((f"{markers} markers, {corruption}", *mean_ratio(bad_result, clean)))
    where, ratio, limit = worst(rows)
    names = " or ".join(map(str, counts))
    quantity = f"joint-robust, {names} markers, {bad} bad: mean position error / clean"
    return at_most("11", quantity, bar, (ratio, limit), _n(results), where)


def _order(method: str, sigmas_px: tuple[float, ...], cell: CellMaker, results: Results) -> AcceptanceRow:
    """Eight markers better than seven, seven better than five, with one bad marker."""
    rows = []
    for sigma in sigmas_px:
        few, some, many = (results[cell(method, markers, sigma, _ONE_EYE)] for markers in MARKER_COUNTS)
        rows.append((f"8 against 7, {sigma:g} px", *mean_ratio(many, some)))
        rows.append((f"7 against 5, {sigma:g} px", *mean_ratio(some, few)))
    where, ratio, limit = worst(rows)
    quantity = f"{method}, 1 bad in one eye: mean position error, more markers / fewer"
    return at_most("12", quantity, 1.0, (ratio, limit), few.n, where)


def _literal(cell: CellMaker, results: Results) -> AcceptanceRow:
    """Mean error of `paper` over that of `paper-literal`: below 1 where the literal reading is no better."""
    rows = [
        (
            f"{sigma:g} px",
            *mean_ratio(results[cell("paper", 8, sigma, _ONE_EYE)], results[cell("paper-literal", 8, sigma, _ONE_EYE)]),
        )
        for sigma in _ORDER_SIGMAS_PX
    ]
    where, ratio, limit = worst(rows)
    quantity = "paper / paper-literal, 8 markers, 1 bad in one eye: mean position error"
    return at_most("12", quantity, 1.0, (ratio, limit), _n(results), where)


def mean_ratio(above: CellResult, below: CellResult) -> ValueWithLimit:
    """Ratio of mean position errors in the same poses, with its upper limit."""
    return paired_ratio_limit(above.position_sums_m, below.position_sums_m)


def _n(results: Results) -> int:
    return min(result.n for result in results.values())


_TIMED_SIGMA_PX = 0.1
_SINGLE_FRAMES, _BATCH_FRAMES = 100, 1000
_MOST_CENTROIDS_MS = {10.0: 8.0, 2.0: 40.0}
_REPEATS = 5


def measure_speed(dataset: Path, seed: int, draws: int | None, report: ProgressReport) -> list[AcceptanceRow]:
    """Time the centroids, and single, batched and robust adjustment, with libraries on one thread.

    Args:
        dataset: pairs at the distances that centroids are timed at, among others.
        seed: of the drawn frames.
        draws: frames for single calls, 100 when None.
        report: of progress.
    """
    count = _SINGLE_FRAMES if draws is None else draws
    good = _measured(seed, max(count, _BATCH_FRAMES), Corruption(0))
    bad = _measured(seed, count, Corruption(2, "both eyes"))
    report.say("timing: please run nothing else for a few seconds")
    with one_thread():
        hub = _single_ms("joint-hub", good, count)
        robust = _single_ms("joint-robust", bad, count)
        batched = _batched_ms("joint-hub", good)
        centroids = {z_m: _centroids_ms(dataset, z_m) for z_m in _MOST_CENTROIDS_MS}
    note = "no limit: it is the largest of all calls"
    placed = "with the hub; the pose that says where it is seen is left out"
    return [
        *(
            at_most("16", f"centroids of both eyes, {z_m:g} m, median [ms]", most, (median,) * 2, pairs, placed)
            for (z_m, most), (median, pairs) in zip(_MOST_CENTROIDS_MS.items(), centroids.values(), strict=True)
        ),
        at_most("16", "joint-hub, one frame, median [ms]", 5.0, (float(np.median(hub)),) * 2, count),
        at_most("16", "joint-hub, batched, a frame [ms]", 0.3, (batched, batched), len(good.markers_px)),
        at_most("16", "joint-robust, two bad markers, slowest [ms]", 60.0, (_slowest(robust),) * 2, count, note),
    ]


def _centroids_ms(dataset: Path, z_m: float) -> tuple[float, int]:
    """Median over the pairs at a distance of the edge fits' time, the shortest of some for each; and their number."""
    truth, blind = Dataset(dataset), BlindDataset(dataset)
    at = [index for index in truth.frame_indices if truth.record(index).conditions.distance_m == z_m]
    times = []
    for pair in map(blind.pair, at):
        navigator = PairNavigator(pair.rig, pair.drogue)
        rough = navigator.observe(pair.images).with_rough()
        if not isinstance(rough.rough, Solution):
            continue
        times.append(min(_edges_ms(navigator, pair.images, rough) for _ in range(_REPEATS)))
    if not times:
        raise ValueError(f"{dataset}: in no pair at {z_m:g} m are there markers; delete it, and it is made again")
    return float(np.median(times)), len(times)


def _edges_ms(navigator: PairNavigator, images: StereoImages, rough: PairMeasurement) -> float:
    """Time of the edge fits of one pair, without that of the pose between the markers' and the hub's."""
    started = perf_counter()
    fine = navigator.refine(images, rough).observation
    refined = perf_counter()
    if isinstance(fine, Observation):
        joint(fine)
    return 1e3 * (2 * refined - started - perf_counter())


def _slowest(times_ms: list[float]) -> float:
    """The slowest call after the first tenth, which warms caches up."""
    return max(times_ms[len(times_ms) // 10 :])


def _batched_ms(method: str, measured: MeasuredFrames) -> float:
    """Time a frame, when caches are warm."""
    solve(method, measured)
    started = perf_counter()
    solve(method, measured)
    return 1e3 * (perf_counter() - started) / len(measured.markers_px)


def _single_ms(method: str, measured: MeasuredFrames, count: int) -> list[float]:
    solver: Callable[..., object] = pose_method(method)
    times = []
    for observation in observations(measured)[:count]:
        started = perf_counter()
        solver(observation)
        times.append(1e3 * (perf_counter() - started))
    return times


def _measured(seed: int, count: int, corruption: Corruption) -> MeasuredFrames:
    rig, drogue = paper_rig(), load_drogue("red-8")
    layout = marker_layout(drogue)
    poses = draw_poses(seeded_generator(seed, "speed", "poses"), rig, drogue.rim_radius_m, DOCKING_RANGE_M, count)
    pixels = ellipse_centers_px(rig, poses, *feature_points(layout))
    pixels = pixels + _TIMED_SIGMA_PX * seeded_generator(seed, "speed", "noise").standard_normal(pixels.shape)
    shifts = draw_shifts(seeded_generator(seed, "speed", "shifts"), corruption, count, layout.count)
    markers = pixels[:, :, : layout.count] + shifts
    return MeasuredFrames(rig, layout, markers, pixels[:, :, layout.count], _TIMED_SIGMA_PX, _TIMED_SIGMA_PX)
