"""What stands in the JSON file of a detector benchmark."""

from __future__ import annotations

import json
from typing import Literal

from pydantic import Field

from droguekit.benchmark.results.result_parts import ResultModel
from droguekit.benchmark.results.tracking_result import Tracking
from droguekit.benchmark.statistics import Interval


class DetectionDataset(ResultModel):
    """What was scored on.

    Attributes:
        sha256: null for an imported dataset.
        split: whose images the rows are of, `all` for every one.
        images, boxes: in that split, and how many drogues are to be found in them.
        ignored: drogues of which too little is seen, see `least_seen_fraction`.
        empty_frames: pairs without a drogue in that split.
    """

    name: str
    sha256: str | None
    split: str
    images: int
    boxes: int
    ignored: int
    empty_frames: int


class DetectionRow(ResultModel):
    """A detector on some images.

    Attributes:
        images, boxes, scenes: images, drogues to be found, and scenes that show one.
        ap, ap50, ap75: average precision over overlaps 0.5 to 0.95, and at two of them; null without drogues.
        ap_interval: of `ap`; the overall row alone has one.
        ap50_interval: null with fewer than two scenes, or where all resamples of scenes are alike.
        precision, recall: at overlap 0.5, of boxes with at least the operating threshold; null without any.
        recall_interval: Wilson's, which takes images as independent.
        note: why the row says little, or null.
    """

    images: int
    boxes: int
    scenes: int
    ap: float | None
    ap50: float | None
    ap75: float | None
    ap_interval: Interval | None = None
    ap50_interval: Interval | None
    precision: float | None
    recall: float | None
    recall_interval: Interval | None
    note: str | None


class DistanceRow(DetectionRow):
    """The images of pairs whose drogue stands from `low_m` to below `high_m`; null has no limit. [m]"""

    low_m: float
    high_m: float | None


class BestF1(ResultModel):
    """Where the harmonic mean of precision and recall is highest on the scored images."""

    threshold: float
    precision: float
    recall: float
    f1: float


class FalseAlarms(ResultModel):
    """Boxes in pairs without a drogue, at the operating threshold.

    Attributes:
        frames: such pairs.
        boxes: found in them, both images together.
        frames_with_any: pairs with at least one.
        boxes_per_600_frames: the rate of boxes, scaled.
        frames_with_any_per_600, interval_per_600_frames: the share of pairs with at least one, scaled, and Wilson's
            interval of it: boxes of one pair are not independent.
    """

    frames: int
    boxes: int
    frames_with_any: int
    boxes_per_600_frames: float
    frames_with_any_per_600: float
    interval_per_600_frames: Interval


class PairTimes(ResultModel):
    """Median times of finding the drogue in a pair, images already read. [ms]"""

    wall_ms: float
    cpu_ms: float
    pairs: int


class DetectorResult(ResultModel):
    """One detector.

    Attributes:
        operating_threshold: score from which boxes count in precision, recall and false alarms.
        threshold_from: `given`; `detector`, its own; `val`, the best F1 on the dataset's val split; `scored images`, on
            these themselves.
        best_f1: null where no box is right.
        false_alarms: null without empty pairs.
        distances, families, eyes: of the same images as `overall`.
        splits: each over its own images, whatever `dataset.split` says.
        times: where the detector was run for this result.
        parameters: weights and biases of the network's layers, counted where `gflops_per_image` is.
        gflops_per_image: multiplications and additions of the network for one image, in 10^9; null where there is none,
            or where only its boxes are known, or where an operation cannot be counted.
        sequences: its best box of each image of the scored split that passes the threshold, as a tracker's; left out
            without sequences.
    """

    operating_threshold: float
    threshold_from: Literal["given", "detector", "val", "scored images"]
    overall: DetectionRow
    best_f1: BestF1 | None
    false_alarms: FalseAlarms | None
    distances: tuple[DistanceRow, ...]
    families: dict[str, DetectionRow]
    eyes: dict[str, DetectionRow]
    splits: dict[str, DetectionRow]
    times: PairTimes | None = None
    parameters: int | None = None
    gflops_per_image: float | None = None
    sequences: Tracking | None = Field(default=None, exclude_if=lambda tracking: tracking is None)


class DetectionResult(ResultModel):
    """The whole file.

    Attributes:
        least_seen_fraction: drogues seen less than that are ignored.
    """

    schema_version: Literal[1] = Field(default=1, alias="schema")
    kind: Literal["detections"] = "detections"
    dataset: DetectionDataset
    code_version: str
    confidence: float
    least_seen_fraction: float
    detectors: dict[str, DetectorResult]

    def to_json(self) -> str:
        """The text of the file."""
        return json.dumps(self.model_dump(mode="json", by_alias=True), indent=1, allow_nan=False) + "\n"
