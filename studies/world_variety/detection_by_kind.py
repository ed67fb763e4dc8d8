"""How well a detector finds drogues in a dataset, by their kind or by that of the tanker."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parameters import DrogueParameters
from droguekit.scoring.detection.detection_metrics import AT_50, Evaluation, operating_point
from droguekit.scoring.detection.detection_truth import ImageTruth, read_detection_truth
from droguekit.scoring.detection.detector_runner import LEAST_SCORE, DetectorRunner
from nav.detector.detector_registry import detector_factory


class KindScore(NamedTuple):
    """Scores on all images of one kind.

    Attributes:
        kind: as `drogue_kind` or `tanker_kind` names it, or `all`.
        images: number of images.
        drogues: number of drogues that count in them.
        ap: average precision, mean over overlaps from a half to 0.95; None without drogues.
        ap50: average precision at an overlap of a half; None without drogues.
        recall: at the detector's threshold; None without drogues.
        false_boxes: number of boxes from the threshold on that are on no drogue.
    """

    kind: str
    images: int
    drogues: int
    ap: float | None
    ap50: float | None
    recall: float | None
    false_boxes: int


def score_by_kind(dataset: Path, detector: str, kind_of: Callable[[FrameSpec], str]) -> Iterator[KindScore]:
    """Scores of a detector by the kind of frame, over all splits; the last is of all images.

    Args:
        dataset: its folder, with its truth.
        detector: name of one that ships, or an ONNX file.
        kind_of: such as `drogue_kind` or `tanker_kind`.

    Raises:
        ValueError: no such dataset or detector, a detector without a threshold, or a pair that cannot be read.
    """
    runner = DetectorRunner(dataset, detector_factory(detector))
    if runner.score_threshold is None:
        raise ValueError(f"{detector}: has no threshold of its own; name a network")
    truth = read_detection_truth(dataset)
    evaluation = Evaluation(truth.images, list(runner.boxes(LEAST_SCORE, lambda: None)))
    if (fault := runner.faults.line()) is not None:
        raise ValueError(fault)
    records = Dataset(dataset)
    kinds = {index: kind_of(records.record(index).frame) for index in records.frame_indices}
    images: dict[str, list[ImageTruth]] = defaultdict(list)
    for image in truth.images:
        images[kinds[image.frame_index]].append(image)
    for kind, some in [*sorted(images.items()), ("all", list(truth.images))]:
        matches = evaluation.matches(some)
        point = operating_point(matches, runner.score_threshold)
        false_boxes = int(((matches.score >= runner.score_threshold) & ~matches.is_true[AT_50]).sum())
        precision = evaluation.average_precision(some)
        yield KindScore(kind, len(some), matches.drogues, precision.ap, precision.ap50, point.recall, false_boxes)


def scores_side_by_side(scores: Mapping[str, Sequence[KindScore]]) -> Iterator[str]:
    """Lines of a Markdown table, a row for each kind of drogue.

    Args:
        scores: by a column's heading; all of the same kinds, in the same order.
    """
    heads = "".join(f" {name}: AP50, recall | false boxes |" for name in scores)
    yield f"| drogue | images | drogues |{heads}"
    yield f"|---|---|---|{'---|---|' * len(scores)}"
    for rows in zip(*scores.values(), strict=True):
        cells = "".join(f" {percent(row.ap50)}, {percent(row.recall)} | {row.false_boxes} |" for row in rows)
        yield f"| {rows[0].kind} | {rows[0].images} | {rows[0].drogues} |{cells}"


def percent(share: float | None) -> str:
    """A share as text; a dash where it is not known."""
    return "-" if share is None else f"{100 * share:.1f} %"


def drogue_kind(frame: FrameSpec) -> str:
    """Family of the sought drogue's body, or `ring`, and whether it has markers; `empty` without one."""
    return "empty" if frame.drogue is None else body_kind(frame.drogue)


def body_kind(drogue: DrogueParameters) -> str:
    """Family of a drogue's body, or `ring`, and whether it has markers."""
    family = "ring" if drogue.body is None else drogue.body.family
    return family if drogue.marker_count else f"{family}, no markers"


def tanker_kind(frame: FrameSpec) -> str:
    """Type of the frame's tanker, in the picture or not; `wing` for the plain wing with a pod, or `no tanker`."""
    if frame.left_from_tanker is None:
        return "no tanker"
    return "wing" if frame.tanker is None else frame.tanker.type
