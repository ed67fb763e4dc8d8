"""What a detector finds in a user's own photographs, and which of them are unlike what it was trained on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.importers.coco_boxes import read_boxes
from datasets_manifest.importers.photographs import find_photographs, shown_photograph
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PixelBox
from droguekit.assurance.picture_looks import KnownLooks, known_looks, measure_looks
from droguekit.batch.progress import ProgressReport
from droguekit.scoring.detection.detection_metrics import AT_50, Evaluation
from droguekit.scoring.detection.detection_truth import ImageTruth
from droguekit.scoring.results.detection_result import (
    DROGUE_CATEGORY,
    DetectedBox,
    center_box,
    clipped_box,
    corner_box,
    image_id_of,
)
from droguekit.scoring.results.pose_result import ResultModel
from nav.detector.detector_registry import open_network
from nav.detector.onnx_detector import OnnxDetector

_LEAST_SCORE = 0.001


class FoundBox(ResultModel):
    """A box of the detector whose score reaches its threshold.

    Attributes:
        box_xywh_px: low corner and size in pixel-centre coordinates. [px]
        score: 0 to 1.
        is_true: whether it overlaps a drawn box by half, as the best one; None where nobody said what is there.
    """

    box_xywh_px: PixelBox
    score: float
    is_true: bool | None


class PhotographResult(ResultModel):
    """One photograph.

    Attributes:
        name: of its file, from the folder.
        width_px, height_px: as it is shown. [px]
        found: boxes, best first.
        drawn: boxes that somebody drew; None where the file of boxes does not name the picture. [px]
        misses: drawn boxes that no found one overlaps by half.
        family: of the known picture that looks most like it; None without known ones.
        looks_distance: see `Likeness.distance`.
        difference: see `Likeness.difference`.
    """

    name: str
    width_px: int
    height_px: int
    found: tuple[FoundBox, ...]
    drawn: tuple[PixelBox, ...] | None
    misses: int
    family: str | None
    looks_distance: float | None
    difference: str | None

    @property
    def false_alarms(self) -> int:
        """Found boxes that are known to show no drogue."""
        return sum(box.is_true is False for box in self.found)

    @property
    def hits(self) -> int:
        """Found boxes that are known to show a drogue."""
        return sum(box.is_true is True for box in self.found)


class PhotographCheck(ResultModel):
    """All photographs of a folder.

    Attributes:
        detector: its name.
        score_threshold: from which a box counts.
        photographs: in the order of their names.
        ap50: COCO's average precision at an overlap of 0.5 on those with drawn boxes; None without such boxes.
        known: name of the dataset whose looks are known, or None.
        unreadable: files that are no pictures, with the reason.
    """

    detector: str
    score_threshold: float
    photographs: tuple[PhotographResult, ...]
    ap50: float | None
    known: str | None
    unreadable: tuple[str, ...]

    @property
    def judged(self) -> tuple[PhotographResult, ...]:
        """Those of which is known what they show."""
        return tuple(one for one in self.photographs if one.drawn is not None)

    @property
    def uncovered(self) -> tuple[PhotographResult, ...]:
        """Those that look like none of the known pictures."""
        return tuple(one for one in self.photographs if one.difference is not None)

    @property
    def fault(self) -> str | None:
        """Files that could not be read, in one line; None for none."""
        if not self.unreadable:
            return None
        count = len(self.unreadable)
        return f"{count} of {count + len(self.photographs)} pictures cannot be read, first {self.unreadable[0]}"


@dataclass(frozen=True, eq=False)
class _Seen:
    """A photograph and the boxes in it, before they are judged."""

    name: str
    size_px: tuple[int, int]
    looks: NDArray[np.float64]
    boxes: tuple[tuple[PixelBox, float], ...]


def check_photographs(
    folder: Path,
    detector: str,
    report: ProgressReport,
    *,
    boxes: Path | None = None,
    category: str | None = None,
    known: Location | None = None,
    least_score: float | None = None,
) -> PhotographCheck:
    """Look for drogues in all photographs of a folder, score them where boxes were drawn, and compare their looks.

    Args:
        folder: of the photographs, each of any size.
        detector: a shipped network, or a file `*.onnx`, either with `@HEIGHTxWIDTH` behind it or not.
        report: is told of the progress.
        boxes: COCO file of boxes that somebody drew; pictures that it names without a box show no drogue.
        category: of the boxes; None for drogue.
        known: dataset whose pictures are compared by their looks, or None.
        least_score: from which a box counts; None for the network's own threshold.

    Raises:
        ValueError: no pictures, a file that cannot be used, a detector that is no network, or a score outside 0 to 1.
    """
    if least_score is not None and not 0 <= least_score <= 1:
        raise ValueError(f"--least-score: must be from 0 to 1, got {least_score:g}")
    if category is not None and boxes is None:
        raise ValueError("--box-category: needs --boxes")
    paths = find_photographs(folder)
    drawn_boxes = None if boxes is None else read_boxes(boxes, category)
    network = open_network(detector)
    if network is None:
        raise ValueError(
            "--detector: must be a network that ships with droguekit or a file *.onnx, also with @HEIGHTxWIDTH behind "
            f"it, got {detector!r}"
        )
    looks = None if known is None else known_looks(Dataset(known), report)
    seen, unreadable = _seen(folder, paths, network, report)
    drawn = {}
    if drawn_boxes is not None and seen:
        drawn = drawn_boxes.of_images([one.name for one in seen], [one.size_px for one in seen])
    threshold = network.metadata.score_threshold if least_score is None else least_score
    ap50, judged = _judged(seen, drawn, threshold)
    photographs = tuple(_result(one, judged[place], drawn.get(place), looks) for place, one in enumerate(seen))
    return PhotographCheck(
        detector=network.name,
        score_threshold=threshold,
        photographs=photographs,
        ap50=ap50,
        known=None if known is None else Dataset(known).manifest.name,
        unreadable=tuple(unreadable),
    )


def _seen(
    folder: Path, paths: Sequence[Path], network: OnnxDetector, report: ProgressReport
) -> tuple[list[_Seen], list[str]]:
    """The photographs with what the network finds, and those that cannot be read."""
    seen, unreadable = list[_Seen](), list[str]()
    report.begin("photographs", len(paths))
    try:
        for path in paths:
            try:
                picture = shown_photograph(path)
            except ValueError as error:
                unreadable.append(str(error))
            else:
                height, width = picture.shape[:2]
                found = network.candidates_in_picture(picture, _LEAST_SCORE)
                clipped = ((clipped_box(corner_box(one.box_xywh_px), (width, height)), one.score) for one in found)
                boxes = tuple((center_box(box), score) for box, score in clipped if box is not None)
                seen.append(_Seen(path.relative_to(folder).as_posix(), (width, height), measure_looks(picture), boxes))
            report.advance()
    finally:
        report.end()
    return seen, unreadable


def _judged(
    seen: Sequence[_Seen], drawn: dict[int, tuple[PixelBox, ...]], threshold: float
) -> tuple[float | None, list[tuple[FoundBox, ...]]]:
    """Average precision at an overlap of 0.5 in percent, and the boxes of each photograph from the threshold on."""
    images = [_truth(place, boxes) for place, boxes in drawn.items()]
    detected = [
        DetectedBox(image_id_of(place, "left"), corner_box(box), score)
        for place, one in enumerate(seen)
        if place in drawn
        for box, score in one.boxes
    ]
    found: list[list[FoundBox]] = [[] for _ in seen]
    ap50 = None
    if images:
        evaluation = Evaluation(images, detected)
        matches, precision = evaluation.matches(images), evaluation.average_precision(images).ap50
        ap50 = None if precision is None else 100.0 * precision
        places = list(drawn)
        for image, score, is_true, box in zip(
            matches.image.tolist(), matches.score.tolist(), matches.is_true[AT_50].tolist(), matches.box, strict=True
        ):
            if score >= threshold:
                shown = FoundBox(box_xywh_px=center_box(box.box_xywh), score=score, is_true=is_true)
                found[places[image]].append(shown)
    for place, one in enumerate(seen):
        if place not in drawn:
            found[place] = [
                FoundBox(box_xywh_px=box, score=score, is_true=None) for box, score in one.boxes if score >= threshold
            ]
    return ap50, [tuple(boxes) for boxes in found]


def _truth(place: int, boxes: tuple[PixelBox, ...]) -> ImageTruth:
    corner = [corner_box(box) for box in boxes]
    return ImageTruth(
        frame_index=place,
        eye="left",
        scene_id=place,
        split="test",
        family="",
        distance_m=None,
        box_xywh=corner[0] if corner else None,
        ignored_xywh=None,
        is_known_empty=not corner,
        others_xywh=tuple(corner[1:]),
    )


def _result(
    one: _Seen, found: tuple[FoundBox, ...], drawn: tuple[PixelBox, ...] | None, known: KnownLooks | None
) -> PhotographResult:
    likeness = None if known is None else known.likeness(one.looks)
    width_px, height_px = one.size_px
    return PhotographResult(
        name=one.name,
        width_px=width_px,
        height_px=height_px,
        found=found,
        drawn=drawn,
        misses=0 if drawn is None else len(drawn) - sum(box.is_true is True for box in found),
        family=None if likeness is None else likeness.family,
        looks_distance=None if likeness is None else likeness.distance,
        difference=None if likeness is None else likeness.difference,
    )


def coco_table(found: PhotographCheck) -> dict[str, Any]:
    """The found boxes as a COCO file with images, as annotation tools read it; scores are beside the boxes."""
    images, annotations = list[dict[str, Any]](), list[dict[str, Any]]()
    for number, one in enumerate(found.photographs, start=1):
        images.append({"id": number, "file_name": one.name, "width": one.width_px, "height": one.height_px})
        for box in one.found:
            corner = [round(value, 2) for value in corner_box(box.box_xywh_px)]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": number,
                    "category_id": DROGUE_CATEGORY,
                    "bbox": corner,
                    "area": round(corner[2] * corner[3], 2),
                    "iscrowd": 0,
                    "score": round(box.score, 6),
                }
            )
    categories = [{"id": DROGUE_CATEGORY, "name": "drogue"}]
    return {"images": images, "annotations": annotations, "categories": categories}


def check_lines(found: PhotographCheck) -> Iterator[str]:
    """What was found, in lines for a terminal."""
    count = len(found.photographs)
    with_boxes = sum(bool(one.found) for one in found.photographs)
    yield f"{found.detector}, threshold {found.score_threshold:.3f}: boxes in {with_boxes} of {count} photographs"
    judged = found.judged
    if judged:
        drawn = sum(len(one.drawn or ()) for one in judged)
        hits, alarms = (sum(getattr(one, name) for one in judged) for name in ("hits", "false_alarms"))
        precision = "" if found.ap50 is None else f", AP50 {found.ap50:.1f}"
        yield (
            f"{len(judged)} with drawn boxes: {hits} of {drawn} drogues found, {drawn - hits} missed, "
            f"{alarms} false alarms{precision}"
        )
    if found.known is not None:
        families = Counter(one.family for one in found.photographs if one.difference is None)
        near = ", ".join(f"{name} {number}" for name, number in families.most_common()) or "none"
        yield f"looks near pictures of {found.known}: {count - len(found.uncovered)} of {count} ({near})"
        words = Counter(one.difference for one in found.uncovered)
        for word, number in words.most_common():
            yield f"  not covered, {number}: {word}"
