"""The numbers of a detector by cell, and the page that shows them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.types.records import PairRecord
from droguekit.scoring.detection.detection_figures import (
    MEASURES,
    bin_distance_m,
    curve_panel,
    distance_panel,
    is_timed,
    published_name,
    score_panel,
    size_panel,
    speed_panel,
)
from droguekit.scoring.detection.detection_report import (
    detection_facts,
    detection_picture,
    detection_sentences,
    worst_false_alarms,
    worst_misses,
    write_detection_report,
)
from droguekit.scoring.detection.detection_scores import DetectorOutput, ScoredDetections, score_detections
from droguekit.scoring.detection.detection_tables import (
    PUBLISHED_DETECTORS,
    SUMMARY_COLUMNS,
    SUMMARY_COLUMNS_MORE,
    detector_lines,
    percent_text,
    published_rows,
    summary_rows,
)
from droguekit.scoring.detection.detection_truth import DetectionTruth, ImageTruth, read_detection_truth
from droguekit.scoring.report.label_drawing import BOX_RGB, MARKER_RGB
from droguekit.scoring.report.number_text import ABSENT
from droguekit.scoring.results.detection_result import DetectedBox, DetectionResult, PairTimes
from geometry.stereo import EYES
from tests.support.parsed_page import ParsedPage

FALSE_BOX = (700.0, 40.0, 60.0, 60.0)


def corpus(scenes: int = 8, pairs: int = 40) -> DetectionTruth:
    """Pairs of two families and three splits; every tenth is empty."""
    images = []
    for frame in range(scenes * pairs):
        scene, empty = frame // pairs, frame % 10 == 0
        for eye in EYES:
            size = 30.0 + frame % pairs * 10
            images.append(
                ImageTruth(
                    frame_index=frame,
                    eye=eye,
                    scene_id=scene,
                    split=("train", "val", "test", "test")[scene % 4],
                    family=("clear", "low-light")[scene // 4],
                    distance_m=None if empty else 1400 / size,
                    box_xywh=None if empty else (100.0, 100.0, size, size),
                    ignored_xywh=None,
                    is_known_empty=empty,
                )
            )
    return DetectionTruth("corpus", "0" * 64, tuple(images))


def boxes_of(truth: DetectionTruth, missed: int = 0, false_score: float = 0.3) -> list[DetectedBox]:
    """Every drogue but every `missed`-th, and a false box in the left image of each empty pair."""
    boxes = []
    for k, image in enumerate(truth.images):
        if image.box_xywh is not None and not (missed and k % missed == 0):
            boxes.append(DetectedBox(image.image_id, image.box_xywh, 0.6 + 0.0001 * (k % 1000)))
        elif image.is_known_empty and image.eye == "left":
            boxes.append(DetectedBox(image.image_id, FALSE_BOX, false_score))
    return boxes


def test_cells_add_up_to_the_whole() -> None:
    truth = corpus()
    result = score_detections(truth, {"mine": DetectorOutput(boxes_of(truth, missed=9))}, "all").result.detectors[
        "mine"
    ]
    whole = result.overall
    for rows in (result.distances, result.families.values(), result.eyes.values(), result.splits.values()):
        assert sum(row.boxes for row in rows) == whole.boxes
    assert sum(row.images for row in result.eyes.values()) == whole.images == len(truth.images)
    recalled = sum((row.recall or 0) * row.boxes for row in result.distances)
    assert recalled / whole.boxes == pytest.approx(whole.recall)


def test_the_test_split_is_scored_by_default_with_a_threshold_from_val() -> None:
    truth = corpus()
    low = [box._replace(score=0.9 * box.score) if k % 2 else box for k, box in enumerate(boxes_of(truth))]
    scored = score_detections(truth, {"mine": DetectorOutput(low)})
    detector = scored.result.detectors["mine"]
    assert (scored.result.dataset.split, detector.threshold_from) == ("test", "val")
    val_ids = {image.image_id for image in truth.images if image.split == "val" and image.box_xywh is not None}
    # All drogues of val were found and score above every false box: the best threshold lies between them.
    assert detector.operating_threshold == pytest.approx(
        (min(box.score for box in low if box.image_id in val_ids) + 0.3) / 2
    )


def test_a_given_threshold_goes_before_the_detectors_own_and_that_before_val() -> None:
    truth = corpus()
    run = DetectorOutput(boxes_of(truth), PairTimes(wall_ms=10, cpu_ms=9, pairs=4), 0.25)
    own = score_detections(truth, {"mine": run}).result.detectors["mine"]
    given = score_detections(truth, {"mine": run}, threshold=0.65).result.detectors["mine"]
    assert (own.operating_threshold, own.threshold_from, given.threshold_from) == (0.25, "detector", "given")
    assert own.times == run.times
    assert given.false_alarms is not None and given.false_alarms.boxes == 0
    assert own.false_alarms is not None and own.false_alarms.boxes == own.false_alarms.frames_with_any == 16
    # One false box in each empty pair.
    assert own.false_alarms.boxes_per_600_frames == own.false_alarms.frames_with_any_per_600 == 600


def test_false_alarms_of_both_eyes_tell_no_more_than_those_of_one() -> None:
    truth = corpus()
    empty = [image for image in truth.images if image.is_known_empty and image.split == "test"]
    left = [DetectedBox(image.image_id, FALSE_BOX, 0.9) for image in empty[: len(empty) // 2] if image.eye == "left"]
    both = left + [box._replace(image_id=box.image_id + 1) for box in left]
    alarms = [
        score_detections(truth, {"mine": DetectorOutput(boxes)}, "test", 0.5).result.detectors["mine"].false_alarms
        for boxes in (left, both)
    ]
    assert alarms[0] is not None and alarms[1] is not None
    assert alarms[1].boxes == 2 * alarms[0].boxes
    # Wilson's for a half of n = 16 pairs is 0.5 -+ z / (2 sqrt(n + z^2)), z = 1.959964.
    half = 1.959964 / (2 * np.sqrt(16 + 1.959964**2))
    for each in alarms:
        assert each is not None and each.frames_with_any_per_600 == 300
        assert each.interval_per_600_frames == pytest.approx((600 * (0.5 - half), 600 * (0.5 + half)), rel=1e-6)


def test_rows_with_little_behind_them_say_so() -> None:
    truth = corpus()
    detector = score_detections(truth, {"mine": DetectorOutput(boxes_of(truth))}, "all").result.detectors["mine"]
    assert detector.overall.note is None
    assert detector.families["clear"].note == "fewer than 300 boxes, fewer than 5 scenes"


def test_what_cannot_be_scored_is_said() -> None:
    truth = corpus()
    with pytest.raises(
        ValueError, match=r"--split: the dataset has no pairs of 'best'; it has test, train, val, or take all"
    ):
        score_detections(truth, {"mine": DetectorOutput([])}, "best")
    empty = replace(truth, images=tuple(image for image in truth.images if image.is_known_empty))
    with pytest.raises(ValueError, match="no image of the split 'test' shows a drogue that must be found"):
        score_detections(empty, {"mine": DetectorOutput([])})


def test_a_detector_that_finds_nothing_has_a_result_and_figures() -> None:
    truth = corpus(pairs=10)
    scored = score_detections(truth, {"blind": DetectorOutput([])})
    detector = scored.result.detectors["blind"]
    assert (detector.overall.ap, detector.overall.recall, detector.overall.precision) == (0.0, 0.0, None)
    assert detector.best_f1 is None
    matches = scored.evaluations["blind"].matches(scored.images)
    for panel in (curve_panel({"blind": matches}), score_panel("blind", 0, matches, 0.5)):
        ElementTree.fromstring(panel)
    assert len(worst_misses(matches, 0.5)) == 8


def test_json_comes_back_without_loss() -> None:
    truth = corpus(pairs=10)
    result = score_detections(truth, {"mine": DetectorOutput(boxes_of(truth))}).result
    assert DetectionResult.model_validate_json(result.to_json()) == result


def test_bins_stand_at_the_mean_distance_of_their_images() -> None:
    """The last bin has no end, and where its images are nobody can tell from its edges."""
    truth = corpus(pairs=10)
    far = [replace(image, distance_m=None if image.distance_m is None else 80.0) for image in truth.images]
    scored = score_detections(DetectionTruth("far", "0" * 64, tuple(far)), {"mine": DetectorOutput([])}, "all")
    (row,) = scored.result.detectors["mine"].distances
    assert (row.low_m, row.high_m) == (40.0, None)
    assert bin_distance_m(row, scored.images) == pytest.approx(80.0)
    two = [replace(far[k], distance_m=distance_m) for k, distance_m in enumerate((41.0, 82.0))]
    assert bin_distance_m(row, [*two, replace(far[2], distance_m=3.0)]) == pytest.approx((41.0 * 82.0) ** 0.5)


def test_a_detector_without_boxes_and_a_single_scene_are_told_in_words() -> None:
    truth = corpus(scenes=1, pairs=10)
    result = score_detections(truth, {"mine": DetectorOutput([])}, "all").result
    told = " ".join(detection_sentences(result, "mine"))
    assert "drogues of 1 scene to be found" in told
    assert "it finds 0.00 % of the drogues, and reports no box." in told and ABSENT not in told
    assert ("Drogues that count neither way", "none") in detection_facts(result)


def test_panels_are_wellformed_and_their_ids_differ() -> None:
    truth = corpus(pairs=10)
    scored = score_detections(
        truth, {"a<b $x": DetectorOutput(boxes_of(truth)), "c": DetectorOutput(boxes_of(truth, missed=3))}
    )
    matches = {name: evaluation.matches(scored.images) for name, evaluation in scored.evaluations.items()}
    assert not is_timed(scored.result)
    panels = [speed_panel(timed(scored).result)]
    panels += [distance_panel(scored, measure) for measure in MEASURES]
    panels += [
        curve_panel(matches),
        score_panel("a<b $x", 0, matches["a<b $x"], 0.5),
        size_panel("c", 1, matches["c"], 0.5),
    ]
    seen: set[str] = set()
    for panel in panels:
        ids = {element.get("id") for element in ElementTree.fromstring(panel).iter()} - {None}
        assert not ids & seen
        seen |= {name for name in ids if name is not None}


def timed(scored: ScoredDetections) -> ScoredDetections:
    """As if the first detector, a network, had been run just now."""
    detectors = dict(scored.result.detectors)
    name = next(iter(detectors))
    run = {"times": PairTimes(wall_ms=25, cpu_ms=25, pairs=4), "parameters": 3_011_043, "gflops_per_image": 6.1}
    detectors[name] = detectors[name].model_copy(update=run)
    return scored._replace(result=scored.result.model_copy(update={"detectors": detectors}))


def test_speed_is_shown_beside_that_of_all_published_detectors() -> None:
    truth = corpus(pairs=10)
    scored = timed(score_detections(truth, {"mine": DetectorOutput(boxes_of(truth)), "file": DetectorOutput([])}))
    panel = speed_panel(scored.result)
    for row in PUBLISHED_DETECTORS:
        assert panel.count(f">{published_name(row.name)}<") == 1
    assert "hollow: published, other data" in panel
    mine, untimed = summary_rows(scored.result)
    assert (mine[8], mine[9], mine[10]) == ("3.01", "6.10", "12.5")
    assert untimed[8:11] == ["–"] * 3
    columns = 1 + len(SUMMARY_COLUMNS) + len(SUMMARY_COLUMNS_MORE)
    assert {len(row) for row in [mine, *published_rows()]} == {columns}


def test_misses_come_by_size_and_false_alarms_by_score() -> None:
    truth = corpus(pairs=10)
    boxes = [
        box._replace(score=box.score / (1 + k)) for k, box in enumerate(boxes_of(truth, missed=4, false_score=0.9))
    ]
    scored = score_detections(truth, {"mine": DetectorOutput(boxes)}, "all")
    matches = scored.evaluations["mine"].matches(scored.images)
    widths = [shown.image.box_xywh[2] for shown in worst_misses(matches, 0.0) if shown.image.box_xywh is not None]
    scores = [shown.box.score for shown in worst_false_alarms(matches, 0.0) if shown.box is not None]
    assert widths == sorted(widths, reverse=True) and len(widths) == 8
    assert scores == sorted(scores, reverse=True) and len(scores) == 8


def test_a_box_is_drawn_where_it_was_found() -> None:
    grey = np.full((960, 1280, 3), 90, np.uint8)
    # Half as large as the image: no inset. The tile is 400 px wide, 0.3125 of the image.
    tile = detection_picture(grey, [((320.0, 240.0, 640.0, 480.0), BOX_RGB), (None, MARKER_RGB)], None)
    touched = np.argwhere((tile != 90).any(axis=2))
    # Lines are a pixel wide and antialiased: the outermost touched pixels lie within a pixel of the box's edges.
    np.testing.assert_allclose(touched.min(axis=0), [75, 100], atol=1)
    np.testing.assert_allclose(touched.max(axis=0), [225, 300], atol=1)


def test_a_small_box_is_shown_enlarged_in_the_corner_away_from_it() -> None:
    grey = np.full((960, 1280, 3), 90, np.uint8)
    cv2.rectangle(grey, (1000, 700), (1039, 739), (200, 20, 20), -1)
    box = (1000.0, 700.0, 40.0, 40.0)
    tile = detection_picture(grey, [(box, BOX_RGB)], box)
    inset = tile[:114, :114]
    red = (inset[..., 0] > 150) & (inset[..., 1] < 60)
    # 40 px of 1.25 * 1.2 * 40 px shown on 114: two thirds of each side, but for the box's line.
    assert 0.55 < np.sqrt(red.mean()) < 0.7


def test_percentages_never_say_all_where_one_is_missing() -> None:
    assert [percent_text(value) for value in (1.0, 0.99999, 0.5, 0.0, None)] == [
        "100.00 %",
        "99.99 %",
        "50.00 %",
        "0.00 %",
        "–",
    ]


def scored_dataset(folder: Path) -> ScoredDetections:
    truth = read_detection_truth(folder)
    good = [DetectedBox(image.image_id, image.box_xywh, 0.9) for image in truth.images if image.box_xywh is not None]
    poor = [*good[:-5], DetectedBox(truth.images[-1].image_id, FALSE_BOX, 0.95)]
    return score_detections(truth, {"good": DetectorOutput(good), "<i>poor</i>": DetectorOutput(poor)}, "all")


def test_the_page_needs_nothing_from_outside_and_names_the_published_rows(
    dataset: tuple[Path, list[PairRecord]], tmp_path: Path
) -> None:
    folder, _ = dataset
    write_detection_report(folder, timed(scored_dataset(folder)), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    page = ParsedPage(text)
    assert all(reference.startswith(("#", "data:image/jpeg;base64,")) for reference in page.references)
    assert "script" not in page.tags and "<i>poor" not in text
    without_pictures = re.sub(r"data:image/jpeg;base64,[\w+/=]+", "", text)
    assert not re.search(r"https?:|//[a-z]|@import|url\((?!#)", without_pictures)
    published = text[text.index("published, other data") :]
    assert "ours-l" in published and "98.23 %" in published
    assert "Hollow marks are published" in text
    # One family with its four pictures; the better detector misses nothing and raises no false alarm.
    assert page.tags.count("img") == 4


def test_lines_for_a_terminal(dataset: tuple[Path, list[PairRecord]]) -> None:
    lines = list(detector_lines(scored_dataset(dataset[0]).result))
    assert len(lines) == 3
    assert lines[1].startswith("good ") and "100.00 %" in lines[1] and "0 in 1 empty frames" in lines[1]
    assert "1 in 1 empty frames" in lines[2]
