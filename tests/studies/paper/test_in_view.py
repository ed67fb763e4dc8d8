"""Scores over the pairs in which a pose can be asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord
from studies.paper.docking_experiment import frames_in_view, subset_scores


@pytest.fixture(scope="module")
def record(docking: Path) -> PairRecord:
    return Dataset(docking).record(0)


def changed(record: PairRecord, hidden_markers: int = 0, **hub: object) -> PairRecord:
    """The pair with markers of the right eye covered, or another hub there."""
    view = record.views.right
    markers = tuple(
        marker.model_copy(update={"visible_fraction": 0.85}) if k < hidden_markers else marker
        for k, marker in enumerate(view.markers)
    )
    assert view.hub is not None
    right = view.model_copy(update={"markers": markers, "hub": view.hub.model_copy(update=hub)})
    return record.model_copy(update={"views": record.views.model_copy(update={"right": right})})


def test_pairs_are_chosen_by_what_both_eyes_see(record: PairRecord) -> None:
    assert len(record.views.right.markers) == 8
    records = {
        0: record,
        1: changed(record, hidden_markers=4),
        2: changed(record, hidden_markers=5),
        3: changed(record, visible_fraction=0.5),
        4: changed(record, in_image=False),
    }
    assert frames_in_view(records) == [0, 1]


def test_scores_are_those_of_the_chosen_pairs() -> None:
    errors = {k: np.array([0.003 * (k + 1), 0.004 * (k + 1), 0.0, 0.1 * k, -0.2]) for k in range(4)}
    errors[9] = np.full(5, 100.0)
    scores = subset_scores(errors, [0, 1, 2, 3, 7], dict.fromkeys(range(8)))
    # 3, 4, 5: the lengths are 5, 10, 15 and 20 mm; pair 7 has no pose and pair 9 does not count.
    assert scores.mean_m == pytest.approx(0.0125)
    assert scores.fix_fraction == pytest.approx(0.8)
    # Student's interval of four values: 97.5 % lie below 3.18245 at three degrees of freedom.
    half_m = 3.18245 * np.std([0.005, 0.010, 0.015, 0.020], ddof=1) / 2
    assert scores.interval_m == pytest.approx((0.0125 - half_m, 0.0125 + half_m), rel=1e-5)
    assert scores.largest_m is not None and scores.angles_p99_deg is not None
    np.testing.assert_allclose(scores.largest_m, [0.012, 0.016, 0])
    assert scores.angles_p99_deg[1] == pytest.approx(0.2)


def test_pairs_of_a_flight_count_as_one_for_the_interval() -> None:
    lengths_m = [0.001, 0.001, 0.003, 0.003, 0.003]
    errors = {k: np.array([length, 0, 0, 0, 0]) for k, length in enumerate(lengths_m)}
    flights = {0: 1, 1: 1, 2: 2, 3: 2, 4: 2}
    scores = subset_scores(errors, range(5), flights)
    # Of two flights Student's factor is 12.7: nothing is known but that the length is not negative.
    assert scores.interval_m is not None and scores.interval_m[0] == 0.0 and scores.interval_m[1] > 0.01
    assert subset_scores(errors, [2, 3, 4], flights).interval_m is None


def test_without_a_pose_there_is_nothing_to_tell() -> None:
    scores = subset_scores({}, [1, 2], {1: None, 2: None})
    assert (scores.fix_fraction, scores.mean_m, scores.largest_m) == (0.0, None, None)
