"""Matching, curves and intervals against pycocotools used as its own documentation says, and against closed forms."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from datasets_manifest.types.records import PixelBox
from droguekit.scoring.detection.detection_metrics import (
    AT_50,
    RECALLS,
    Evaluation,
    Matches,
    average_precision_interval,
    best_f1,
    operating_point,
    precision_recall,
    resampled_precision,
)
from droguekit.scoring.detection.detection_truth import ImageTruth
from droguekit.scoring.results.detection_result import DetectedBox
from geometry.stereo import EYES
from nav.training.evaluation import best_threshold

BOX: PixelBox = (100.0, 100.0, 40.0, 30.0)


def image(frame: int, scene: int = 0, eye: int = 0, box: PixelBox | None = BOX) -> ImageTruth:
    return ImageTruth(
        frame_index=frame,
        eye=EYES[eye],
        scene_id=scene,
        split="test",
        family="clear",
        distance_m=None if box is None else 10.0,
        box_xywh=box,
        ignored_xywh=None,
        is_known_empty=box is None,
    )


def found(where: ImageTruth, score: float, box: PixelBox = BOX) -> DetectedBox:
    return DetectedBox(where.image_id, box, score)


def random_corpus(rng: np.random.Generator, frames: int = 60) -> tuple[list[ImageTruth], list[DetectedBox]]:
    """Drogues with boxes that are more or less right, misses, doubles, false alarms; no two scores are equal."""
    images, boxes = [], []
    for frame in range(frames):
        for eye in range(2):
            x, y, size = rng.uniform(0, 800), rng.uniform(0, 600), rng.uniform(20, 300)
            box = None if frame % 7 == 0 else (float(x), float(y), float(size), float(0.9 * size))
            images.append(image(frame, scene=frame // 6, eye=eye, box=box))
            for _ in range(rng.integers(0, 3) if box is not None else 0):
                shift = rng.normal(0, 0.08 * size, 4)
                boxes.append(DetectedBox(images[-1].image_id, tuple(np.add(box, shift).tolist()), float(rng.uniform())))
            for _ in range(rng.poisson(0.4)):
                low = rng.uniform(0, 800, 2).tolist()
                boxes.append(DetectedBox(images[-1].image_id, (low[0], low[1], 50.0, 50.0), float(rng.uniform(0, 0.6))))
    return images, boxes


def judged(images: list[ImageTruth], boxes: list[DetectedBox], folder: Path) -> COCOeval:
    """The same by pycocotools from files, with none of our code."""
    truth = {
        "images": [{"id": each.image_id} for each in images],
        "categories": [{"id": 1, "name": "drogue"}],
        "annotations": [
            {
                "id": each.image_id,
                "image_id": each.image_id,
                "category_id": 1,
                "iscrowd": 0,
                "bbox": list(each.box_xywh),
                "area": each.box_xywh[2] * each.box_xywh[3],
            }
            for each in images
            if each.box_xywh is not None
        ],
    }
    known = {each.image_id for each in images}
    results = [
        {"image_id": box.image_id, "category_id": 1, "bbox": list(box.box_xywh), "score": box.score}
        for box in boxes
        if box.image_id in known
    ]
    (folder / "truth.json").write_text(json.dumps(truth))
    (folder / "results.json").write_text(json.dumps(results))
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(folder / "truth.json"))
        judge = COCOeval(coco, coco.loadRes(str(folder / "results.json")), "bbox")
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    return judge


def test_average_precision_is_that_of_pycocotools_over_all_images_and_over_some(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    images, boxes = random_corpus(rng)
    evaluation = Evaluation(images, boxes)
    for some in (images, images[::2], images[30:60], images):
        expected = judged(some, boxes, tmp_path).stats[:3]
        # The same sums in the same order.
        np.testing.assert_allclose(evaluation.average_precision(some), expected, rtol=1e-12)


def test_our_curve_is_that_of_pycocotools(rng: np.random.Generator, tmp_path: Path) -> None:
    images, boxes = random_corpus(rng)
    matches = Evaluation(images, boxes).matches(images)
    expected = judged(images, boxes, tmp_path).eval["precision"][0, :, 0, 0, -1]
    curve = precision_recall(matches)
    # The highest precision at each of its recalls or more; 0 where that recall is not reached.
    envelope = np.append(np.maximum.accumulate(curve.precision[::-1])[::-1], 0.0)
    # It adds eps to the denominators of precisions, 2e-16 of a box.
    np.testing.assert_allclose(envelope[np.searchsorted(curve.recall, RECALLS)], expected, atol=1e-12)


def test_half_of_the_drogues_without_a_false_box_make_51_of_101_recalls() -> None:
    images = [image(frame) for frame in range(10)]
    evaluation = Evaluation(images, [found(each, 0.9) for each in images[:5]])
    # Recalls 0 to 0.5 in steps of 0.01 are reached, with precision 1 but for pycocotools' eps.
    np.testing.assert_allclose(evaluation.average_precision(images), [51 / 101] * 3, rtol=1e-12)


def test_overlap_decides_at_which_thresholds_a_box_counts() -> None:
    images = [image(0)]
    # Moved sideways by a fifth of its width, a box has the overlap 0.8 / 1.2 = 0.667: right at 0.5 to 0.65.
    evaluation = Evaluation(images, [found(images[0], 0.9, (108.0, 100.0, 40.0, 30.0))])
    np.testing.assert_allclose(evaluation.average_precision(images), [0.4, 1.0, 0.0], atol=1e-12)


def test_without_boxes_precision_is_zero_and_without_drogues_there_is_none() -> None:
    images = [image(0), image(1, box=None)]
    assert Evaluation(images, []).average_precision(images) == (0.0, 0.0, 0.0)
    assert Evaluation(images, []).average_precision(images[1:]) == (None, None, None)


def test_of_two_boxes_on_a_drogue_the_better_scored_one_is_right() -> None:
    images = [image(0)]
    matches = Evaluation(images, [found(images[0], 0.6), found(images[0], 0.8)]).matches(images)
    assert matches.score.tolist() == [0.8, 0.6]
    assert matches.is_true[AT_50].tolist() == [True, False]


def test_boxes_on_an_ignored_drogue_count_neither_way_and_others_beside_it_do() -> None:
    ignored = replace(image(0, box=None), ignored_xywh=BOX, is_known_empty=False)
    inside = found(ignored, 0.9)
    # Two fifths of its area lie in the ignored box, less than half.
    beside = found(ignored, 0.8, (124.0, 100.0, 40.0, 30.0))
    matches = Evaluation([ignored], [inside, beside]).matches([ignored])
    assert [box.score for box in matches.box] == [0.8]


def test_a_drogue_before_an_ignored_one_is_found_by_its_own_box() -> None:
    small = (110.0, 110.0, 12.0, 12.0)
    scene = replace(image(0, box=small), ignored_others_xywh=(BOX,))
    matches = Evaluation([scene], [found(scene, 0.9, small), found(scene, 0.7)]).matches([scene])
    assert matches.is_true[AT_50].tolist() == [True]


def test_best_f1_is_the_best_of_all_thresholds(rng: np.random.Generator) -> None:
    images, boxes = random_corpus(rng)
    matches = Evaluation(images, boxes).matches(images)
    best = best_f1(matches)
    assert best is not None and best.f1 is not None
    every = [operating_point(matches, float(score)).f1 or 0.0 for score in matches.score]
    assert best.f1 == pytest.approx(max(every), rel=1e-12)
    assert best.f1 == pytest.approx(2 / (1 / (best.precision or 1) + 1 / (best.recall or 1)), rel=1e-12)
    assert best.threshold not in matches.score


def test_a_training_chooses_a_threshold_that_is_as_good_but_for_chance(rng: np.random.Generator) -> None:
    images = [image(frame) for frame in range(40)]
    boxes = [
        found(each, float(rng.uniform()), BOX if rng.uniform() < 0.7 else (500.0, 500.0, 40.0, 30.0)) for each in images
    ]
    matches = Evaluation(images, boxes).matches(images)
    best = best_f1(matches)
    answers = [(np.array([box.box_xywh]), np.array([box.score])) for box in boxes]
    chosen = operating_point(matches, best_threshold([np.array([BOX])] * len(images), answers, 0.5))
    # Of two dozen wrong or missing ones five more or fewer are chance, a hundredth of F1 each.
    assert best is not None and best.f1 is not None and chosen.f1 is not None
    assert best.f1 - 0.08 < chosen.f1 <= best.f1


@pytest.mark.parametrize(
    ("scores", "threshold"), [((0.8, 0.6, 0.2), 0.4), ((0.8, 0.6), 0.3), ((-2.0, -3.0), -3.0), ((0.5, -3.0), -3.0)]
)
def test_the_best_threshold_lies_midway_below_the_last_box_that_counts(
    scores: tuple[float, ...], threshold: float
) -> None:
    images = [image(frame) for frame in range(2)]
    # The third box is a second one on a drogue that was found.
    boxes = [found(images[min(k, 1)], score) for k, score in enumerate(scores)]
    best = best_f1(Evaluation(images, boxes).matches(images))
    assert best is not None and best.threshold == pytest.approx(threshold) and best.f1 == 1.0


def test_boxes_of_equal_score_pass_a_threshold_together() -> None:
    images = [image(0), image(1)]
    boxes = [found(images[0], 0.5), found(images[1], 0.5, (500.0, 500.0, 40.0, 30.0))]
    curve = precision_recall(Evaluation(images, boxes).matches(images))
    assert (curve.threshold.tolist(), curve.precision.tolist(), curve.recall.tolist()) == ([0.5], [0.5], [0.5])


def test_resampled_scenes_are_as_good_as_copies_of_their_images(rng: np.random.Generator) -> None:
    images, boxes = random_corpus(rng, frames=30)
    matches = Evaluation(images, boxes).matches(images)
    times = np.array([[1, 1, 1, 1, 1], [2, 0, 3, 0, 0], [0, 1, 0, 0, 4]])
    expected = []
    for row in times:
        copies, copied = [], []
        for each in images:
            for copy in range(row[each.scene_id]):
                twin = replace(each, frame_index=each.frame_index + 1000 * copy)
                copies.append(twin)
                copied += [box._replace(image_id=twin.image_id) for box in boxes if box.image_id == each.image_id]
        expected.append(Evaluation(copies, copied).average_precision(copies).ap50)
    # Copies have equal scores, and pycocotools looks between two of them too, where precision differs by
    # less than one box in those before it.
    np.testing.assert_allclose(resampled_precision(matches, AT_50, times), expected, atol=0.02)
    assert resampled_precision(matches, AT_50, times[:1])[0] == pytest.approx(expected[0], abs=1e-12)


def dense_resampled_precision(matches: Matches, times: np.ndarray) -> np.ndarray:
    """The same from tables of every scene and every box."""
    scenes, scene = np.unique([each.scene_id for each in matches.images], return_inverse=True)
    true = matches.is_true[AT_50]
    drawn = times[:, scene[matches.image]]
    hits, boxes = np.cumsum(drawn * true, axis=1), np.cumsum(drawn, axis=1)
    drogues = times @ np.array([np.sum(matches.has_drogue[scene == k]) for k in range(len(scenes))])
    values = []
    for k in range(len(times)):
        precision = np.divide(hits[k], boxes[k], out=np.zeros(len(true)), where=boxes[k] > 0)[true]
        envelope = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
        values.append(envelope[np.searchsorted(hits[k][true] / drogues[k], RECALLS)].mean())
    return np.array(values)


def test_sparse_tables_give_what_dense_ones_do(rng: np.random.Generator) -> None:
    images, boxes = random_corpus(rng)
    matches = Evaluation(images, boxes).matches(images)
    times = rng.multinomial(10, np.full(10, 0.1), 50)
    expected = dense_resampled_precision(matches, times)
    # Whole numbers but for the last division.
    np.testing.assert_allclose(resampled_precision(matches, AT_50, times), expected, rtol=1e-12)


def test_scenes_that_are_all_alike_say_nothing_of_how_well_precision_is_known() -> None:
    images = [image(frame, scene=frame // 5) for frame in range(20)]
    boxes = [found(each, 0.9 - 0.01 * each.frame_index) for each in images if each.frame_index % 5 < 4]
    evaluation = Evaluation(images, boxes)
    matches = evaluation.matches(images)
    # Four of five drogues found in every scene and no false box: recalls 0 to 0.8.
    times = np.array([[1, 1, 1, 1], [4, 0, 0, 0], [0, 1, 0, 3]])
    np.testing.assert_allclose(resampled_precision(matches, AT_50, times), 81 / 101, rtol=1e-12)
    assert average_precision_interval(matches, (AT_50,), "test") is None


def test_an_interval_needs_two_scenes_and_holds_the_value(rng: np.random.Generator) -> None:
    images, boxes = random_corpus(rng)
    evaluation = Evaluation(images, boxes)
    alone = [each for each in images if each.scene_id == 1]
    assert average_precision_interval(evaluation.matches(alone), (AT_50,), "test") is None
    interval = average_precision_interval(evaluation.matches(images), (AT_50,), "test")
    assert interval is not None
    assert interval[0] < (evaluation.average_precision(images).ap50 or 0.0) < interval[1]
