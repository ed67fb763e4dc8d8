"""Which cases of a dataset are solved: poses near the truth, and drogues that a detector finds."""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.batch.progress import PlainProgress, ProgressReport
from droguekit.scoring.detection.detection_metrics import Evaluation, best_f1
from droguekit.scoring.detection.detection_truth import ImageTruth, image_truth
from droguekit.scoring.poses.pose_errors import estimates_by_method
from droguekit.scoring.results.detection_result import image_id_of, read_detections
from geometry.stereo import EYES

SolvedCases = dict[int, dict[str, tuple[int, int]]]
"""By frame and by the name of a method or of a file of detections: solved cases, and all."""


def solved_cases(
    source: Dataset,
    most_position_error_fraction: float,
    see_record: Callable[[PairRecord], None],
    estimates: Path | None = None,
    detections: Sequence[Path] = (),
    report: ProgressReport | None = None,
) -> tuple[tuple[str, ...], SolvedCases]:
    """Solved cases of each pair, and all names in them.

    A pose is solved where its position is wrong by at most a fraction of the distance; a pair without an estimate is
    not. A box is solved where the detector's box overlaps it by half, from the score on that gives the best F1 on the
    whole dataset. Pairs without a drogue are no cases.

    Args:
        source: with its truth.
        most_position_error_fraction: of the distance.
        see_record: is given every record on the way.
        estimates: file of poses.
        detections: files of COCO results.
        report: is told of the progress, or None.

    Raises:
        ValueError: a record or file that cannot be read or was changed, or two sources of one name.
    """
    read = None if estimates is None else read_estimates(estimates)
    methods = {} if read is None else estimates_by_method(read, source.frame_indices, str(estimates))
    names = (*methods, *(path.stem for path in detections))
    for path in detections:
        if path.stem in methods:
            raise ValueError(f"--detections: {path.stem!r} is also a method's name; rename the file")
        if names.count(path.stem) > 1:
            raise ValueError(f"--detections: two are named {path.stem!r}; rename a file")
    camera, splits = source.manifest.recipe.rig.camera, source.manifest.split_of_frame()
    solved: SolvedCases = defaultdict(dict)
    images: list[ImageTruth] = []
    shown = PlainProgress(io.StringIO()) if report is None else report
    shown.begin("pairs", len(source.frame_indices))
    try:
        for index in source.frame_indices:
            record = source.unchanged_record(index)
            see_record(record)
            for name, answers in methods.items():
                if record.left_from_drogue is not None:
                    answer = answers.get(index)
                    solved[index][name] = int(_is_near(answer, record, most_position_error_fraction)), 1
            if detections:
                size_px = (camera.width_px, camera.height_px)
                images += [image_truth(record, eye, splits[index], size_px) for eye in EYES]
            shown.advance()
    finally:
        shown.end()
    image_ids = frozenset(image_id_of(index, eye) for index in source.frame_indices for eye in EYES)
    for path in detections:
        for index, share in _found_boxes(images, path, image_ids).items():
            solved[index][path.stem] = share
    return names, solved


def _is_near(answer: Estimate | None, record: PairRecord, most_fraction: float) -> bool:
    if not isinstance(answer, PoseEstimate) or record.left_from_drogue is None:
        return False
    truth_m = record.left_from_drogue.translation_m
    error_m = float(np.linalg.norm(answer.left_from_drogue.translation_m - truth_m))
    return error_m <= most_fraction * float(np.linalg.norm(truth_m))


def _found_boxes(images: Sequence[ImageTruth], path: Path, image_ids: frozenset[int]) -> dict[int, tuple[int, int]]:
    """By frame: in how many of its images the sought drogue is found, and in how many it is to be found."""
    matches = Evaluation(images, read_detections(path, image_ids)).matches(images)
    best = best_f1(matches)
    is_found = matches.found_scores() >= (math.inf if best is None else best.threshold)
    shares: dict[int, tuple[int, int]] = {}
    for image, is_shown, found in zip(matches.images, matches.has_drogue, is_found, strict=True):
        if is_shown:
            hits, count = shares.get(image.frame_index, (0, 0))
            shares[image.frame_index] = hits + int(found), count + 1
    return shares
