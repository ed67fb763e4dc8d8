"""Latency of a stereo pair in several detectors, measured in turns, so that other load affects all of them equally."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from datasets_manifest.types.images import StereoImages
from nav.detector.detector import Detector

_WARM_UP_ROUNDS = 3
_PERCENTILES = (50.0, 90.0, 99.0)
# Boxes besides the best one cost little, and the threshold is the same for all detectors.
_MIN_SCORE = 0.25


class PairLatency(NamedTuple):
    """Latency of one detector. [ms]

    Attributes:
        wall_ms, cpu_ms: percentiles 50, 90 and 99; CPU time is that of all threads.
        mean_cpu_ms: mean CPU time.
        ratio: median over rounds of its CPU time divided by that of the first detector.
    """

    wall_ms: tuple[float, float, float]
    cpu_ms: tuple[float, float, float]
    mean_cpu_ms: float
    ratio: float


def measure_latency(
    detectors: Mapping[str, Detector],
    pairs: Sequence[StereoImages],
    rounds: int,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, PairLatency]:
    """Measure the latency of all detectors on the same pairs; each round has a random order of its own.

    Args:
        detectors: by name; ratios are to the first.
        pairs: full-size images; the time from these to boxes is measured.
        rounds: number of measured rounds, after a few rounds of warm-up.
        advance: called after each measured round.

    Returns:
        By name, in the order of `detectors`.

    Raises:
        ValueError: no detector, no pair or no round.
    """
    if not detectors or not pairs or rounds < 1:
        raise ValueError(f"rounds: needs detectors, pairs and a round, got {len(detectors)}, {len(pairs)}, {rounds}")
    names = list(detectors)
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for number in range(-_WARM_UP_ROUNDS, rounds):
        images = pairs[number % len(pairs)]
        for name in _shuffled(names, number + _WARM_UP_ROUNDS):
            wall_s, cpu_s = time.perf_counter(), time.process_time()
            detectors[name].candidates(images, _MIN_SCORE)
            wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
            if number >= 0:
                spent[name].append((1e3 * wall_s, 1e3 * cpu_s))
        if number >= 0:
            advance()
    table = {name: np.array(times) for name, times in spent.items()}
    return {name: _latency(table[name], table[names[0]]) for name in names}


def _shuffled(names: Sequence[str], number: int) -> list[str]:
    """A random order for each round, so that no detector always runs with the caches of the same predecessor."""
    order = np.random.Generator(np.random.Philox(key=number)).permutation(len(names))
    return [names[k] for k in order.tolist()]


def _latency(
    times_ms: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    first_ms: np.ndarray[tuple[int, int], np.dtype[np.float64]],
) -> PairLatency:
    wall, cpu = (tuple(np.percentile(times_ms[:, k], _PERCENTILES).tolist()) for k in (0, 1))
    # A coarse clock may measure zero for a fast detector.
    ratio = float(np.median(times_ms[:, 1] / np.maximum(first_ms[:, 1], 1e-6)))
    return PairLatency(wall, cpu, float(times_ms[:, 1].mean()), ratio)
