"""How long centroids and estimators take on one thread (criterion 16)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np

from datasets_manifest.random_streams import seeded_generator
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import load_drogue
from droguekit.batch.progress import ProgressReport
from droguekit.numerical_threads import one_thread
from droguekit.scoring.poses.cramer_rao import feature_points
from geometry.stereo import paper_rig
from nav.pair_measurement import PairMeasurement
from nav.pair_navigator import PairNavigator
from nav.pose.joint import joint
from nav.pose.method_registry import pose_method
from nav.pose.pose_method import Observation, Solution
from studies.acceptance.acceptance_table import AcceptanceRow, at_most
from studies.acceptance.centroid_level.drawn_frames import Corruption, draw_poses, draw_shifts, ellipse_centers_px
from studies.acceptance.centroid_level.monte_carlo import DOCKING_RANGE_M
from studies.acceptance.centroid_level.solvers import MeasuredFrames, observations, solve

_SIGMA_PX = 0.1
_SINGLE_FRAMES, _BATCH_FRAMES = 100, 1000
_MOST_CENTROIDS_MS = {10.0: 8.0, 2.0: 40.0}
_REPEATS = 5


def measure_speed(dataset: Path, seed: int, draws: int | None, report: ProgressReport) -> list[AcceptanceRow]:
    """Time the centroids, and single, batched and robust adjustment, on one thread.

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
    pixels = pixels + _SIGMA_PX * seeded_generator(seed, "speed", "noise").standard_normal(pixels.shape)
    shifts = draw_shifts(seeded_generator(seed, "speed", "shifts"), corruption, count, layout.count)
    markers = pixels[:, :, : layout.count] + shifts
    return MeasuredFrames(rig, layout, markers, pixels[:, :, layout.count], _SIGMA_PX, _SIGMA_PX)
