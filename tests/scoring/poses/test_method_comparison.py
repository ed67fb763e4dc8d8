from __future__ import annotations

import numpy as np
import pytest

from droguekit.scoring.confidence_intervals import ratio_intervals
from droguekit.scoring.poses.method_scores import PairGroups, compare_methods
from droguekit.scoring.poses.pose_errors import PoseError
from droguekit.scoring.poses.reference import DistanceBin


def error(position_m: float, angle_deg: float = 1.0) -> PoseError:
    return PoseError(np.array([position_m, 0, 0, 0.6 * angle_deg, 0.8 * angle_deg]), position_m)


def groups(count: int, sequence: dict[int, int] | None = None) -> PairGroups:
    """The first half near, the second half far."""
    near = {i: int(i >= count / 2) for i in range(count)}
    return PairGroups([DistanceBin(1, 2), DistanceBin(2, 4)], near, {i: (sequence or {}).get(i) for i in range(count)})


def test_ratios_are_of_means_over_common_frames() -> None:
    errors = {
        "a": {0: error(1.0), 1: error(3.0), 2: error(100.0)},
        "b": {0: error(4.0, 2.0), 1: error(4.0, 6.0), 3: error(500.0)},
    }
    (pair,) = compare_methods(errors, ["b"], groups(4))
    assert (pair.method, pair.against, pair.overall.n, pair.overall.blocks) == ("a", "b", 2, 2)
    assert pair.overall.position == pytest.approx(0.5)
    assert pair.overall.attitude == pytest.approx(0.25)
    assert [(row.n, row.low_m, row.high_m) for row in pair.bins] == [(2, 1, 2), (0, 2, 4)]
    assert pair.bins[1].position is None
    assert pair.bins[1].position_interval is None


def test_every_method_is_compared_with_every_standard_once() -> None:
    errors = {name: {0: error(1.0), 1: error(2.0)} for name in ("a", "b", "c")}
    pairs = compare_methods(errors, ["a", "b", "a"], groups(2))
    assert [(pair.method, pair.against) for pair in pairs] == [("b", "a"), ("c", "a"), ("a", "b"), ("c", "b")]
    assert pairs[0].overall.position_interval == (1.0, 1.0)


def test_a_perfect_standard_has_no_ratio() -> None:
    errors = {"a": {0: error(1.0), 1: error(1.0)}, "truth": {0: error(0.0, 0.0), 1: error(0.0, 0.0)}}
    (pair,) = compare_methods(errors, ["truth"], groups(2))
    assert (pair.overall.position, pair.overall.position_interval) == (None, None)


def test_common_difficulty_cancels(rng: np.random.Generator) -> None:
    """Pairs that are a thousand times harder than others widen no interval of a ratio that is the same in all."""
    scale = np.geomspace(1e-3, 1, 40)
    errors = {
        "a": {i: error(float(0.5 * s * rng.uniform(0.98, 1.02))) for i, s in enumerate(scale)},
        "b": {i: error(float(s)) for i, s in enumerate(scale)},
    }
    low, high = compare_methods(errors, ["b"], groups(40))[0].overall.position_interval
    assert 0.49 <= low <= 0.5 * 1.01
    assert high - low < 0.02


def test_intervals_cover_the_true_ratio(rng: np.random.Generator) -> None:
    hits, trials = 0, 200
    for trial in range(trials):
        below = rng.exponential(1, (60, 1))
        above = 0.5 * below * rng.uniform(0.5, 1.5, (60, 1))
        ((low, high),) = ratio_intervals(above, below, range(60), f"trial {trial}")
        hits += low <= 0.5 <= high
    # The percentile bootstrap of 60 values covers 92 to 95 %; four standard errors of 200 trials are 6 %.
    assert hits / trials > 0.86


def test_frames_of_a_sequence_are_drawn_together(rng: np.random.Generator) -> None:
    """Ten sequences of 50 equal frames know no more than ten frames do."""
    level = rng.uniform(0.5, 1.5, 10)
    frames = np.repeat(level, 50)[:, None]
    single = ratio_intervals(frames, np.ones((500, 1)), range(500), "single")[0]
    blocks = ratio_intervals(frames, np.ones((500, 1)), np.repeat(np.arange(10), 50).tolist(), "blocks")[0]
    ten = ratio_intervals(level[:, None], np.ones((10, 1)), range(10), "blocks")[0]
    assert blocks == pytest.approx(ten, rel=1e-9)
    # sqrt(50) = 7 in theory; each end is known to some percent.
    assert 5 < (blocks[1] - blocks[0]) / (single[1] - single[0]) < 9


def test_one_sequence_has_no_interval() -> None:
    errors = {name: {i: error(1.0 + i) for i in range(6)} for name in ("a", "b")}
    (pair,) = compare_methods(errors, ["b"], groups(6, dict.fromkeys(range(6), 0)))
    assert pair.overall.blocks == 1
    assert pair.overall.position == 1.0
    assert pair.overall.position_interval is None
