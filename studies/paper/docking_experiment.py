"""A docking dataset with estimates: scores of all pairs or of those in view, and one run over its image number.

Pictures show the frames with the largest errors of a method: its measurements, its pose and the truth.
"""

from __future__ import annotations

import html
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate
from datasets_manifest.types.records import PairRecord, PixelBox
from drogue_models.marker_layout import MarkerLayout, marker_layout
from droguekit.scoring.confidence_intervals import Interval, mean_interval
from droguekit.scoring.pose_benchmark import score_methods
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.poses.method_scores import block_of_pair
from droguekit.scoring.poses.pose_errors import pose_error
from droguekit.scoring.report.label_drawing import Picture, display_picture, jpeg_uri
from droguekit.scoring.report.number_text import plain_number, three_digits
from droguekit.scoring.results.benchmark_result import BenchmarkResult, DatasetFacts
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig
from studies.acceptance.rendered.sequence_pairs import shows_enough
from studies.paper.paper_inputs import ExperimentData, read_estimates_file

WORST_COUNT = 10

# What is shown around the drogue, as a share of its box, and the picture's largest side.
_MARGIN = 1.35
_MOST_PX = 480
_OUTLINE_POINTS = 48

# On a photograph, the same in light and dark pages; docs/how-to/report-beside-the-paper.md names them.
TRUE_COLOR, ESTIMATED_COLOR, CENTROID_COLOR, BOX_COLOR = "#00e5ff", "#ff9100", "#ffffff", "#ffdd33"
_EDGE_COLOR = "#000000"


@dataclass(frozen=True, eq=False)
class DockingRun:
    """One sequence over its image number.

    Attributes:
        sequence_id: of the dataset, None where pairs belong to none.
        numbers: (N,) image number of the pairs that show a drogue, 0 at the first pair of the sequence.
        truth: (N, 3) X, Y, Z in the left camera. [m]
        errors: (N, 5) estimate minus truth by method, X, Y, Z in the left camera [m], pitch and yaw of the axis [deg];
            NaN where it gave no pose.
    """

    sequence_id: int | None
    numbers: NDArray[np.int64]
    truth: Array
    errors: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class DockingData(ExperimentData):
    """A docking dataset with estimates and their scores.

    Attributes:
        records: of every pair that shows a drogue, by frame.
        first_frames: first pair of every sequence, whether it shows a drogue or not; None means no sequence.
        result: scores of the contenders.
    """

    records: Mapping[int, PairRecord]
    first_frames: Mapping[int | None, int]
    result: BenchmarkResult

    @property
    def methods(self) -> Mapping[str, Mapping[int, Estimate]]:
        """The contenders' estimates by method and frame."""
        return self.file.methods

    def pose_errors(self, method: str) -> dict[int, Array]:
        """(5,) estimate minus truth by frame, where the method gave a pose of a drogue."""
        return {
            index: pose_error(estimate.left_from_drogue, _pose(self.records[index])).components
            for index, estimate in self.methods[method].items()
            if isinstance(estimate, PoseEstimate) and index in self.records
        }

    @property
    def sequence_of_frame(self) -> dict[int, int | None]:
        """The sequence of every pair that shows a drogue, None where it belongs to none."""
        return {index: record.sequence_id for index, record in self.records.items()}

    def sequences(self) -> list[int | None]:
        """Ids of the sequences, ascending; only None where pairs belong to none."""
        ids = set(self.sequence_of_frame.values())
        return sorted(ids, key=lambda number: (number is None, number or 0))

    def run(self, sequence_id: int | None) -> DockingRun:
        """One sequence.

        Raises:
            ValueError: the dataset has no such sequence.
        """
        indices = [index for index, record in self.records.items() if record.sequence_id == sequence_id]
        if not indices:
            known = [str(number) for number in self.sequences() if number is not None]
            rule = f"must be one of {', '.join(known)}" if known else "must be left out, for there are no sequences"
            raise ValueError(f"--docking-sequence: {rule} in {self.source}, got {sequence_id}")
        errors = {}
        for contender in self.contenders:
            found = self.pose_errors(contender.method)
            nothing = np.full(5, np.nan)
            errors[contender.method] = np.array([found.get(index, nothing) for index in indices])
        truth = np.array([_pose(self.records[index]).translation_m for index in indices])
        return DockingRun(sequence_id, np.array(indices) - self.first_frames[sequence_id], truth, errors)


@dataclass(frozen=True, eq=False)
class SubsetScores:
    """A method over some pairs; errors are over those with a pose, and None without any.

    Attributes:
        fix_fraction: pairs with a pose.
        mean_m, interval_m, p99_m: of the length of the position error. [m]
        largest_m: (3,) in X, Y, Z. [m]
        angles_p99_deg: (2,) of pitch and yaw. [deg]
    """

    fix_fraction: float
    mean_m: float | None = None
    interval_m: Interval | None = None
    p99_m: float | None = None
    largest_m: Array | None = None
    angles_p99_deg: Array | None = None


def read_docking(dataset: Location, estimates: Path, faults: PairFaults | None = None) -> DockingData:
    """Read and score a dataset with its estimates; damaged pairs are left out where `faults` counts them.

    Raises:
        ValueError: dataset or file cannot be read, do not belong together, or hold none of the contenders.
    """
    data = Dataset(dataset)
    file = read_estimates_file(estimates, data.frame_indices)
    records = {record.frame_index: record for record in data.records(faults)}
    first_frames: dict[int | None, int] = {}
    for index, record in records.items():
        first_frames.setdefault(record.sequence_id, index)
    manifest = data.manifest
    facts = DatasetFacts(name=manifest.name, sha256=manifest.dataset_sha256, pairs=len(records))
    result = score_methods(facts, {index: drogue_truth(record) for index, record in records.items()}, file.methods)
    shown = {index: record for index, record in records.items() if record.left_from_drogue is not None}
    return DockingData(data, file, shown, first_frames, result)


def subset_scores(
    errors: Mapping[int, Array], frames: Sequence[int], sequences: Mapping[int, int | None]
) -> SubsetScores:
    """Scores over some pairs, of which there is at least one.

    Args:
        errors: (5,) X, Y, Z [m], pitch, yaw [deg] by frame, where there is a pose.
        frames: which pairs count.
        sequences: of every frame, None where it belongs to none; whole sequences are the independent samples.
    """
    found = [index for index in frames if index in errors]
    if not found:
        return SubsetScores(0.0)
    rows = np.array([errors[index] for index in found])
    blocks = [block_of_pair(index, sequences[index]) for index in found]
    lengths = np.linalg.norm(rows[:, :3], axis=1)
    sizes = np.abs(rows)
    return SubsetScores(
        fix_fraction=len(rows) / len(frames),
        mean_m=float(lengths.mean()),
        interval_m=mean_interval(lengths, blocks, (0.0, math.inf)),
        p99_m=float(np.percentile(lengths, 99.0)),
        largest_m=sizes[:, :3].max(axis=0),
        angles_p99_deg=np.percentile(sizes[:, 3:], 99.0, axis=0),
    )


def frames_in_view(records: Mapping[int, PairRecord]) -> list[int]:
    """Pairs of which both eyes see at least four markers and the hub, whether or not the sun stands beside it."""
    truths = {index: drogue_truth(record) for index, record in records.items()}
    return [index for index, truth in truths.items() if truth is not None and shows_enough(truth)]


def _pose(record: PairRecord) -> RigidTransform:
    if record.left_from_drogue is None:
        raise ValueError(f"frame {record.frame_index}: shows no drogue")
    return record.left_from_drogue


@dataclass(frozen=True)
class WorstFrame:
    """One picture.

    Attributes:
        frame_index: of the pair.
        svg: the left image around the drogue with its overlay.
        caption: distance and errors in words.
    """

    frame_index: int
    svg: str
    caption: str


def worst_frames(docking: DockingData, method: str) -> list[WorstFrame]:
    """The poses of a method that are farthest from the truth, the worst first.

    Raises:
        ValueError: an image cannot be read; names the file.
    """
    errors = docking.pose_errors(method)
    ranked = sorted(errors, key=lambda index: (-float(np.linalg.norm(errors[index][:3])), index))
    frames = []
    for rank, index in enumerate(ranked[:WORST_COUNT]):
        estimate, record = docking.methods[method][index], docking.records[index]
        if isinstance(estimate, PoseEstimate):
            frames.append(_frame(docking.dataset, record, estimate, errors[index], rank))
    return frames


def failure_reasons(docking: DockingData, method: str) -> list[tuple[str, int]]:
    """Why a method gave no pose of a drogue, and how often; pairs that its file leaves out count too.

    Reasons that differ only in the number of regions of an image are one.
    """
    estimates = docking.methods[method]
    reasons: Counter[str] = Counter()
    for index in docking.records:
        estimate = estimates.get(index)
        if estimate is None:
            reasons["not in the file"] += 1
        elif isinstance(estimate, NoFix):
            reasons[re.sub(r"among \d+ regions", "among the regions", estimate.reason)] += 1
    return reasons.most_common()


def outlines_px(rig: StereoRig, layout: MarkerLayout, pose: RigidTransform) -> list[Array]:
    """(P, 2) edges of rim, markers and hub in the left image; none unless all lie before the camera. [px]"""
    discs = [(np.zeros(3), layout.face_outer_radius_m), *((center, layout.radius_m) for center in layout.centers_m)]
    if layout.hub_center_m is not None:
        radii = (layout.hub_inner_radius_m, layout.hub_outer_radius_m)
        discs += [(layout.hub_center_m, radius) for radius in radii]
    edges = [disc_outline(pose, center, radius, _OUTLINE_POINTS) for center, radius in discs if radius > 0]
    # Behind the camera, points would be mirrored into its image.
    return [rig.image(edge, "left") for edge in edges] if all((edge[:, 2] > 0).all() for edge in edges) else []


def clipped(outline: Array, low: Array, high: Array) -> Array:
    """(Q, 2) the part of a convex outline within a rectangle; empty where they do not meet.

    Args:
        outline: (P, 2) points in order around it.
        low, high: (2,) corners of the rectangle.

    Source: I. E. Sutherland, G. W. Hodgman, Commun. ACM 17 (1974) 32, doi:10.1145/360767.360802.
    """
    points = outline
    for axis, limit, sign in ((0, low[0], 1.0), (0, high[0], -1.0), (1, low[1], 1.0), (1, high[1], -1.0)):
        kept: list[Array] = []
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            before, after = sign * (start[axis] - limit), sign * (end[axis] - limit)
            if before >= 0:
                kept.append(start)
            if (before >= 0) != (after >= 0):
                kept.append(start + (end - start) * before / (before - after))
        points = np.array(kept).reshape(-1, 2)
    return points


def _frame(dataset: Dataset, record: PairRecord, estimate: PoseEstimate, error: Array, rank: int) -> WorstFrame:
    if record.left_from_drogue is None or record.frame.drogue is None:
        raise ValueError(f"frame {record.frame_index}: shows no drogue")
    layout, rig = marker_layout(record.frame.drogue), record.frame.rig
    true, found = (outlines_px(rig, layout, pose) for pose in (record.left_from_drogue, estimate.left_from_drogue))
    centroids = [rig.real_px(feature.center_px, "left") for feature in estimate.features if feature.eye == "left"]
    boxes = [region.box_xywh_px for region in estimate.regions if region.eye == "left"]
    window = _window(true, rig)
    picture = display_picture(dataset.images(record.frame_index))
    svg = _overlay(picture, window, (true, found), centroids, boxes, f"worst frame {rank + 1}: {record.frame_index}")
    size_mm = 1e3 * float(np.linalg.norm(error[:3]))
    x, y, z = (three_digits(1e3 * float(value)) for value in error[:3])
    caption = (
        f"Frame {record.frame_index}, {plain_number(float(record.left_from_drogue.translation_m[2]))} m: "
        f"{three_digits(size_mm)} mm off (X {x}, Y {y}, Z {z} mm), pitch {three_digits(error[3])}°, "
        f"yaw {three_digits(error[4])}°; {_apart_text(true, found)}."
    )
    return WorstFrame(record.frame_index, svg, caption)


def _apart_text(true: Sequence[Array], found: Sequence[Array]) -> str:
    if not found:
        return "the estimated drogue reaches behind the camera and is not drawn"
    if not true:
        return "the true drogue reaches behind the camera and is not drawn"
    # Of markers any may be the first; the rim has no first point, so its middle tells how far the models are apart.
    apart_px = float(np.linalg.norm(true[0].mean(axis=0) - found[0].mean(axis=0)))
    return f"in the image the rims' middles lie {three_digits(apart_px)} px apart"


def _window(true: Sequence[Array], rig: StereoRig) -> tuple[int, int, int, int]:
    """Low column and row, width and height of what is shown, within the image; all where no model is drawn. [px]"""
    limits = (rig.camera.width_px, rig.camera.height_px)
    if not true:
        return (0, 0, *limits)
    low, high = true[0].min(axis=0), true[0].max(axis=0)
    half = _MARGIN * float((high - low).max()) / 2
    # A drogue that is out of the picture leaves at least its edge.
    starts = [min(max(int(m - half), 0), n - 2) for m, n in zip((low + high) / 2, limits, strict=True)]
    ends = [max(min(int(m + half) + 1, n), s + 2) for m, n, s in zip((low + high) / 2, limits, starts, strict=True)]
    return starts[0], starts[1], ends[0] - starts[0], ends[1] - starts[1]


def _overlay(
    picture: Picture,
    window: tuple[int, int, int, int],
    outlines: tuple[Sequence[Array], Sequence[Array]],
    centroids: Sequence[Array],
    boxes: Sequence[PixelBox],
    label: str,
) -> str:
    """An `<svg>` of part of an image; one unit is a pixel, and lines keep their width however large it is shown."""
    x, y, width, height = window
    part = np.ascontiguousarray(picture[y : y + height, x : x + width])
    if max(width, height) > _MOST_PX:
        scale = _MOST_PX / max(width, height)
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    frame = f'x="{x - 0.5}" y="{y - 0.5}" width="{width}" height="{height}"'
    # A little more than the picture, so that edges along its border are not seen; far points would be huge numbers.
    low, high = (
        np.array([x, y]) - 0.1 * max(width, height),
        np.array([x + width, y + height]) + 0.1 * max(width, height),
    )
    true, found = ("".join(_closed(clipped(shape, low, high)) for shape in shapes) for shapes in outlines)
    arm = 0.018 * max(width, height)
    crosses = "".join(
        f"M{u - arm:.2f} {v:.2f}H{u + arm:.2f}M{u:.2f} {v - arm:.2f}V{v + arm:.2f}" for u, v in map(tuple, centroids)
    )
    rectangles = "".join(f"M{u:.2f} {v:.2f}h{w:.2f}v{h:.2f}h{-w:.2f}Z" for u, v, w, h in boxes)
    lines = [
        (true, TRUE_COLOR, ' stroke-width="2.2"'),
        (found, ESTIMATED_COLOR, ' stroke-width="2.2" stroke-dasharray="9 9"'),
        # Thin lines have a dark edge, or a bright sky would swallow them.
        (rectangles, _EDGE_COLOR, ' stroke-width="2.8" stroke-opacity="0.5"'),
        (rectangles, BOX_COLOR, ' stroke-width="1.4"'),
        (crosses, _EDGE_COLOR, ' stroke-width="2.6" stroke-opacity="0.5"'),
        (crosses, CENTROID_COLOR, ' stroke-width="1.2"'),
    ]
    paths = "".join(
        f'<path d="{path}" fill="none" stroke="{color}"{look} vector-effect="non-scaling-stroke"/>'
        for path, color, look in lines
        if path
    )
    return (
        f'<svg role="img" aria-label="{html.escape(label)}" viewBox="{x - 0.5} {y - 0.5} {width} {height}">'
        f'<image {frame} preserveAspectRatio="none" href="{jpeg_uri(part)}"/>{paths}</svg>'
    )


def _closed(outline: Array) -> str:
    if not len(outline):
        return ""
    points = "L".join(f"{u:.2f} {v:.2f}" for u, v in outline)
    return f"M{points}Z"
