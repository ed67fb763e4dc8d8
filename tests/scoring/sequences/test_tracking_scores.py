"""Boxes in sequences: losses, recoveries, and whether detector or tracker made a box."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import poisson

from datasets_manifest.types.estimates import Estimate, NoFix, Region
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.confidence_intervals import rate_interval
from droguekit.scoring.pose_benchmark import score_sequences
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.report.sequence_report import sequence_sentences
from droguekit.scoring.results.detection_result import DetectedBox, corner_box, image_id_of
from droguekit.scoring.sequences.sequence_truth import TrueSequence, true_sequences, true_state
from droguekit.scoring.sequences.tracking_scores import reacquisition, score_detected_boxes, score_regions
from geometry.stereo import EYES

SEEN, HIDDEN, PARTLY, DAZZLED = "seen", "hidden", "partly", "dazzled"


def sequences_of(records: list[PairRecord]) -> tuple[TrueSequence, ...]:
    return true_sequences([true_state(record) for record in records])


def answers_of(records: list[PairRecord], lost: tuple[int, ...] = (), stage_s: float = 0.01) -> dict[int, Estimate]:
    """The true boxes as regions, every tenth from the detector; none in the pairs that are `lost`."""
    answers: dict[int, Estimate] = {}
    for k, record in enumerate(records):
        regions = []
        for eye, view in zip(EYES, (record.views.left, record.views.right), strict=True):
            if k not in lost and view.box_visible_xywh_px is not None:
                source = "detector" if k % 10 == 0 else "flow"
                regions.append(Region(eye=eye, box_xywh_px=view.box_visible_xywh_px, source=source, score=0.9))
        answers[record.frame_index] = NoFix(
            frame_index=record.frame_index,
            method="m",
            reason="none was asked for",
            regions=tuple(regions),
            stage_s={"detect": stage_s * (1 + k % 10), "pose": 0.001},
        )
    return answers


@pytest.mark.parametrize(
    ("visibilities", "answers", "expected"),
    [
        # Never hidden: there is nothing to find again.
        ([SEEN] * 4, [0, 0, 1, 1], (0, 0, 0, None, None)),
        # Back at place 2, answered at once, and one frame later.
        ([SEEN, HIDDEN, SEEN, SEEN], [1, 0, 1, 1], (1, 1, 1, 0, 0)),
        ([SEEN, HIDDEN, SEEN, SEEN], [1, 0, 0, 1], (1, 1, 1, 1, 1)),
        # The delay counts from the first frame that shows enough, not from the first glimpse.
        ([SEEN, HIDDEN, PARTLY, PARTLY, SEEN, SEEN], [1, 0, 0, 0, 0, 1], (1, 1, 1, 1, 1)),
        # An answer while it is partly seen is at least as good.
        ([SEEN, HIDDEN, PARTLY, SEEN], [1, 0, 1, 1], (1, 1, 1, 0, 0)),
        # Four frames are not within three.
        ([SEEN, HIDDEN] + [SEEN] * 5, [1, 0, 0, 0, 0, 0, 1], (1, 1, 0, 4, 4)),
        # Hidden again, or over, before an answer came.
        ([HIDDEN, SEEN, HIDDEN, SEEN, SEEN], [0] * 5, (2, 0, 0, None, None)),
        # Beside the sun it may be lost.
        ([SEEN, DAZZLED, SEEN, SEEN, SEEN], [1, 0, 0, 0, 1], (1, 1, 1, 2, 2)),
        # Never lost there, it does not come again.
        ([SEEN, DAZZLED, DAZZLED, SEEN, SEEN], [1, 1, 1, 1, 1], (0, 0, 0, None, None)),
        # Lost for a moment there.
        ([SEEN, DAZZLED, DAZZLED, SEEN, SEEN], [1, 0, 1, 1, 1], (1, 1, 1, 0, 0)),
        # Out of hiding into the sun, and found only beyond it.
        ([HIDDEN, DAZZLED, SEEN], [0, 1, 1], (1, 1, 1, 0, 0)),
        # Found again beside the sun, or lost there once more.
        ([HIDDEN, SEEN, DAZZLED, SEEN], [0, 0, 1, 1], (1, 1, 1, 1, 1)),
        ([HIDDEN, SEEN, DAZZLED, SEEN], [0, 0, 0, 1], (2, 1, 1, 0, 0)),
    ],
)
def test_delays_after_reappearing(visibilities: list[str], answers: list[int], expected: tuple[object, ...]) -> None:
    row = reacquisition([(visibilities, [bool(answer) for answer in answers])])
    assert (row.n, row.found, row.within_3, row.median_frames, row.max_frames) == expected


def test_the_true_boxes_have_perfect_scores_in_both_eyes(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 30)
    result = score_regions(sequences_of(records), answers_of(records))
    for row in (result.both, *result.eyes.values()):
        assert row.overlap is not None and row.losses is not None
        assert (row.overlap.auc, row.overlap.precision) == (pytest.approx(20 / 21), 1)
        assert (row.losses.count, row.losses.lost_fraction, row.reacquisition.n) == (0, 0, 0)
        # One sequence cannot tell how much sequences differ.
        assert row.overlap.auc_interval is None
    assert result.both.overlap is not None and result.both.overlap.n == 60
    # 30 pairs at 25 Hz.
    assert result.both.losses is not None and result.both.losses.minutes == pytest.approx(30 / 25 / 60)


def test_losses_are_counted_where_they_begin(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 40, hidden=(20, 21, 22))
    # Two stretches of it in plain sight; 19 is lost and stays so while it is hidden; 23 and 24 are late to find it.
    answers = answers_of(records, lost=(5, 6, 7, 12, 19, 23, 24))
    result = score_regions(sequences_of(records), answers)
    left = result.eyes["left"]
    assert left.losses is not None and left.overlap is not None
    assert left.losses.count == 3
    assert left.losses.lost_fraction == pytest.approx(7 / 37)
    assert left.losses.per_minute == pytest.approx(3 / (37 / 25 / 60))
    assert (left.reacquisition.n, left.reacquisition.max_frames) == (1, 2)
    assert (left.hidden, left.hidden_with_box) == (3, 0)
    assert left.overlap.n == 37
    # Without a box, nothing overlaps.
    assert left.overlap.mean_overlap == pytest.approx(30 / 37)


def test_a_box_that_hardly_overlaps_is_lost_and_one_on_nothing_is_counted(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 20, hidden=(10,))
    answers = answers_of(records)
    x, y, w, h = records[4].views.left.box_visible_xywh_px
    aside = Region(eye="left", box_xywh_px=(x + 0.85 * w, y, w, h), source="flow", score=0.5)
    answers[4] = answers[4].model_copy(update={"regions": (aside,)})
    answers[10] = answers[10].model_copy(update={"regions": (aside,)})
    result = score_regions(sequences_of(records), answers)
    left, right = result.eyes["left"], result.eyes["right"]
    assert left.losses is not None and right.losses is not None
    # The overlap is 0.15 over 1.85, less than a tenth; the right eye has no box in that pair.
    assert (left.losses.count, right.losses.count) == (1, 1)
    assert (left.hidden_with_box, right.hidden_with_box, result.both.hidden_with_box) == (1, 0, 1)


def test_only_the_part_on_the_image_counts(build: SimpleNamespace) -> None:
    """A tracker may know more of a drogue at the edge than the visible pixels do."""
    record = build.sequence(lambda t: build.pose(1.7, 0.0, 6.0), 2)
    width = record[0].views.left.box_full_xywh_px[2]
    edge = 1280 - 0.5
    view = record[0].views.left
    x, y, _, h = view.box_full_xywh_px
    assert x < edge < x + width
    clipped = view.model_copy(update={"box_visible_xywh_px": (x, y, edge - x, h), "truncated": True})
    records = [r.model_copy(update={"views": r.views.model_copy(update={"left": clipped})}) for r in record]
    whole = Region(eye="left", box_xywh_px=view.box_full_xywh_px, source="flow", score=1)
    answers = {k: NoFix(frame_index=k, method="m", reason="none", regions=(whole,)) for k in (0, 1)}
    result = score_regions(sequences_of(records), answers)
    assert result.eyes["left"].overlap is not None
    # Boxes are clipped in thousandths of a pixel at the most.
    assert result.eyes["left"].overlap.mean_overlap == pytest.approx(1, abs=1e-4)


def test_half_seen_drogues_count_neither_way(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 10)
    view = records[3].views.left
    x, y, w, h = view.box_full_xywh_px
    little = view.model_copy(update={"box_visible_xywh_px": (x, y, 0.3 * w, h)})
    records[3] = records[3].model_copy(update={"views": records[3].views.model_copy(update={"left": little})})
    result = score_regions(sequences_of(records), answers_of(records, lost=(3,)))
    left, right = result.eyes["left"], result.eyes["right"]
    assert left.overlap is not None and left.losses is not None and right.losses is not None
    assert (left.overlap.n, left.losses.count, right.losses.count) == (9, 0, 1)


def test_beside_the_sun_no_answer_is_wrong(build: SimpleNamespace) -> None:
    """Neither a loss, nor a box on a hidden drogue; but it has to be found again."""
    records = build.sequence(build.swinging, 12)
    for k in (4, 5, 6):
        frame = records[k].frame.model_copy(update={"loss": "glare"})
        records[k] = records[k].model_copy(update={"frame": frame})
    sequences = sequences_of(records)
    assert [one.visibility for one in sequences[0].states[3:8]] == [SEEN, DAZZLED, DAZZLED, DAZZLED, SEEN]
    for lost, delay in (((), None), ((4, 6), 0), ((5, 6, 7, 8), 2)):
        result = score_regions(sequences, answers_of(records, lost=lost))
        assert result.both.losses is not None and result.both.overlap is not None
        assert (result.both.losses.count, result.both.hidden, result.both.overlap.n) == (0, 0, 18)
        again = result.both.reacquisition
        assert (again.n, again.max_frames) == (2 if lost else 0, delay)


def test_sources_have_their_own_boxes_and_times(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 40)
    answers = answers_of(records, stage_s=0.01)
    result = score_regions(sequences_of(records), answers)
    assert set(result.sources) == {"detector", "flow"}
    detector, flow = result.sources["detector"], result.sources["flow"]
    assert detector.overlap is not None and flow.overlap is not None
    assert (detector.pairs, detector.overlap.n, flow.pairs, flow.overlap.n) == (4, 8, 36, 72)
    times = [1e3 * (0.01 * (1 + k % 10) + 0.001) for k in range(40) if k % 10]
    assert flow.frame_ms == pytest.approx(np.median(times))
    assert flow.frame_p95_ms == pytest.approx(np.percentile(times, 95))
    assert (detector.box_ms, detector.frame_ms) == (pytest.approx(10), pytest.approx(11))


def test_waiting_is_no_work_and_following_is(build: SimpleNamespace) -> None:
    """All stages of a tracked pair in real time, milliseconds that tell them apart."""
    stages_ms = {"read": 512, "wait": 256, "detect": 1, "track": 2, "correct": 4, "handover": 128}
    stages_ms |= {"centroids": 8, "pose": 16, "filter": 32}
    records = build.sequence(build.swinging, 10)
    answers = {
        k: answer.model_copy(update={"stage_s": {stage: 1e-3 * ms for stage, ms in stages_ms.items()}})
        for k, answer in answers_of(records).items()
    }
    flow = score_regions(sequences_of(records), answers).sources["flow"]
    assert flow.box_ms == pytest.approx(7)
    assert (flow.frame_ms, flow.frame_p95_ms) == (pytest.approx(63), pytest.approx(63))
    only = {k: answer.model_copy(update={"stage_s": {"read": 0.5}}) for k, answer in answers.items()}
    flow = score_regions(sequences_of(records), only).sources["flow"]
    assert (flow.box_ms, flow.frame_ms) == (None, None)


def test_both_eyes_lose_what_one_of_them_loses_most(build: SimpleNamespace) -> None:
    """Both lose the drogue twice together, and the right eye once more alone."""
    records = build.sequence(build.swinging, 30)
    answers = answers_of(records, lost=(5, 6, 15))
    answers[25] = answers[25].model_copy(update={"regions": answers[25].regions[:1]})
    result = score_regions(sequences_of(records), answers)
    left, right = result.eyes["left"].losses, result.eyes["right"].losses
    assert left is not None and right is not None
    assert (left.count, right.count) == (2, 3)
    assert result.both.losses == right
    # Three losses in 30 pairs at 25 Hz, and no more time than one eye has.
    assert right.per_minute_interval == pytest.approx(rate_interval(3, 30 / 25 / 60))


def test_a_file_of_the_same_boxes_has_the_same_scores(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 20, hidden=(8, 9))
    answers = answers_of(records, lost=(3, 10))
    boxes = [
        DetectedBox(image_id_of(index, region.eye), corner_box(region.box_xywh_px), region.score)
        for index, answer in answers.items()
        for region in answer.regions
    ]
    sequences = sequences_of(records)
    by_regions = score_regions(sequences, answers)
    # A worse box of an image, and one below the threshold in an image without any, change nothing.
    noise = [
        DetectedBox(image_id_of(0, "left"), (5, 5, 9, 9), 0.6),
        DetectedBox(image_id_of(3, "left"), (5, 5, 9, 9), 0.2),
    ]
    by_file = score_detected_boxes(sequences, [*noise, *boxes], 0.5)
    assert by_file is not None
    assert (by_file.both, by_file.eyes) == (by_regions.both, by_regions.eyes)
    assert by_file.sources == {}
    assert score_detected_boxes((), boxes, 0.5) is None


def test_intervals_are_of_whole_sequences(build: SimpleNamespace) -> None:
    records = [r for s in range(6) for r in build.sequence(build.swinging, 10, sequence_id=s)]
    # Sequences differ: number s has lost its first s pairs.
    lost = tuple(10 * s + k for s in range(6) for k in range(s))
    result = score_regions(sequences_of(records), answers_of(records, lost=lost))
    assert result.both.overlap is not None
    low, high = result.both.overlap.precision_interval or (0.0, 0.0)
    values = 1 - np.arange(6) / 10
    assert result.both.overlap.precision == pytest.approx(values.mean())
    # Student's interval of six values: 97.5 % lie below 2.5706 at five degrees of freedom; no share is above 1.
    assert low == pytest.approx(values.mean() - 2.5706 * values.std(ddof=1) / np.sqrt(6), abs=1e-5)
    assert values.mean() < high <= 1


def test_the_ends_of_a_rate_leave_one_in_forty_on_each_side() -> None:
    low, high = rate_interval(4, 2.0)
    assert poisson.sf(3, 2 * low) == pytest.approx(0.025)
    assert poisson.cdf(4, 2 * high) == pytest.approx(0.025)
    assert rate_interval(0, 2.0) == (0.0, pytest.approx(-np.log(0.025) / 2))


def test_a_method_without_regions_has_failed_where_another_has_some(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 3)
    answers = answers_of(records)
    plain = {k: answer.model_copy(update={"regions": ()}) for k, answer in answers.items()}
    drogues = {record.frame_index: drogue_truth(record) for record in records}
    both = score_sequences(sequences_of(records), drogues, {"some": answers, "none": plain})
    assert both is not None
    tracking = both.methods["none"].tracking
    assert tracking is not None and tracking.both.overlap is not None and tracking.both.losses is not None
    assert (tracking.both.overlap.n, tracking.both.overlap.auc, tracking.both.overlap.center_rms_px) == (6, 0, None)
    assert (tracking.both.losses.count, tracking.both.losses.lost_fraction, tracking.sources) == (0, 1, {})
    assert "none: no box in any image that shows the drogue." in sequence_sentences(both)
    assert score_sequences(sequences_of(records), drogues, {"none": plain}) is None
