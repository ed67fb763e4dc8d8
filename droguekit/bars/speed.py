"""How long the estimators take on one thread (bar 16)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np

from drogue_models.marker_layout import marker_layout
from drogue_models.presets import load_drogue
from droguekit.bars.corruption import Corruption, draw_shifts
from droguekit.bars.drawn_poses import cell_generator, draw_poses, ellipse_centers_px
from droguekit.bars.one_thread import one_thread
from droguekit.bars.protocol import DOCKING_RANGE_M
from droguekit.bars.reporter import Reporter
from droguekit.bars.solvers import Measured, observations, solve
from droguekit.bars.table import BarRow, at_most
from droguekit.benchmark.bounds import feature_points
from geometry.stereo import paper_rig
from nav.pose.registry import pose_method

_SIGMA_PX = 0.1
_SINGLE_FRAMES, _BATCH_FRAMES = 100, 1000


def bars_speed(out: Path, seed: int, draws: int | None, report: Reporter) -> list[BarRow]:
    """Time single, batched and robust adjustment on one thread.

    Args:
        out: not used; nothing is kept, for another time of day is another measurement.
        seed: of the drawn frames.
        draws: frames for single calls, 100 when None.
        report: hears how it goes.
    """
    del out
    count = _SINGLE_FRAMES if draws is None else draws
    good = _measured(seed, max(count, _BATCH_FRAMES), Corruption(0))
    bad = _measured(seed, count, Corruption(2, "both eyes"))
    report.say("timing; leave the machine alone for a few seconds")
    with one_thread():
        hub = _single_ms("joint-hub", good, count)
        robust = _single_ms("joint-robust", bad, count)
        batched = _batched_ms("joint-hub", good)
    note = "no limit: it is the largest of all calls"
    return [
        at_most("16", "joint-hub, one frame, median [ms]", 5.0, (float(np.median(hub)),) * 2, count),
        at_most("16", "joint-hub, batched, a frame [ms]", 0.3, (batched, batched), len(good.markers_px)),
        at_most("16", "joint-robust, two bad markers, slowest [ms]", 60.0, (_slowest(robust),) * 2, count, note),
    ]


def _slowest(times_ms: list[float]) -> float:
    """The slowest call after the first tenth, which warms caches up."""
    return max(times_ms[len(times_ms) // 10 :])


def _batched_ms(method: str, measured: Measured) -> float:
    """Time a frame, when caches are warm."""
    solve(method, measured)
    started = perf_counter()
    solve(method, measured)
    return 1e3 * (perf_counter() - started) / len(measured.markers_px)


def _single_ms(method: str, measured: Measured, count: int) -> list[float]:
    solver: Callable[..., object] = pose_method(method)
    times = []
    for observation in observations(measured)[:count]:
        started = perf_counter()
        solver(observation)
        times.append(1e3 * (perf_counter() - started))
    return times


def _measured(seed: int, count: int, corruption: Corruption) -> Measured:
    rig, drogue = paper_rig(), load_drogue("red-8")
    layout = marker_layout(drogue)
    poses = draw_poses(cell_generator(seed, "speed", "poses"), rig, drogue.rim_radius_m, DOCKING_RANGE_M, count)
    pixels = ellipse_centers_px(rig, poses, *feature_points(layout))
    pixels = pixels + _SIGMA_PX * cell_generator(seed, "speed", "noise").standard_normal(pixels.shape)
    shifts = draw_shifts(cell_generator(seed, "speed", "shifts"), corruption, count, layout.count)
    markers = pixels[:, :, : layout.count] + shifts
    return Measured(rig, layout, markers, pixels[:, :, layout.count], _SIGMA_PX, _SIGMA_PX)
