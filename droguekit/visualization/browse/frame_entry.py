"""One pair of the page: a row of the catalogue, its labels as numbers, and its pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from datasets_manifest.atomic import write_bytes_atomic
from datasets_manifest.types.estimates import Estimate, PoseEstimate
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import FeatureView, PairRecord, PixelBox, ViewRecord
from drogue_models.parameters import DrogueParameters
from droguekit.benchmark.poses.pose_errors import pose_error
from droguekit.benchmark.report.label_drawing import Picture, display_picture, resized
from droguekit.visualization.browse.conditions import conditions_table, light_of, search_text
from droguekit.visualization.browse.drogue_rings import Ring, drogue_rings
from geometry.se3 import RigidTransform

PICTURE_KINDS = ("small", "left", "right")
_SMALL_WIDTH_PX = 240
_QUALITY, _SMALL_QUALITY = 85, 78
# A thousandth of a pixel is far below what a screen shows, and a page of thousands of pairs half as large.
_PX_DIGITS, _POSE_DIGITS = 3, 9


@dataclass(frozen=True)
class FrameEntry:
    """What the page says of one pair.

    Attributes:
        row: its values by column of the catalogue.
        labels: numbers of its own file.
        rings: of the drogue that is there or looked for, which many pairs share.
        left_from_drogue: its true pose, or None.
    """

    row: dict[str, Any]
    labels: dict[str, Any]
    rings: tuple[Ring, ...]
    left_from_drogue: RigidTransform | None


def frame_entry(record: PairRecord, drogue: DrogueParameters, split: str, record_sha256: str) -> FrameEntry:
    """What the page says of a pair, but for estimates.

    Args:
        record: its truth.
        drogue: that is there or looked for.
        split: of the dataset that it belongs to.
        record_sha256: stands for the pair's pixels too.
    """
    rings = drogue_rings(drogue)
    conditions, distance_m = record.conditions, record.conditions.distance_m
    row = {
        "frame": record.frame_index,
        "distance_m": None if distance_m is None else round(distance_m, 4),
        "family": conditions.family,
        "split": split,
        "sequence": record.sequence_id,
        "light": light_of(conditions.background_luminance_cd_m2),
        "text": search_text(record, split),
        "picture": picture_stem(record.frame_index, record_sha256),
        "box_px": _box(record.views.left.box_visible_xywh_px),
    }
    labels = {
        "pose": _pose(record.left_from_drogue),
        "drogue": rings_name(rings),
        "left": _view(record.views.left),
        "right": _view(record.views.right),
        "conditions": conditions_table(record, split),
    }
    return FrameEntry(row, labels, rings, record.left_from_drogue)


def blind_entry(frame_index: int, time_s: float, rings: tuple[Ring, ...], pixels_sha256: str) -> FrameEntry:
    """What the page says of a pair without truth.

    Args:
        frame_index: place in the dataset.
        time_s: mid-exposure. [s]
        rings: of the drogue that is looked for.
        pixels_sha256: stands for its images.
    """
    nothing: dict[str, Any] = {"box_full_px": None, "box_visible_px": None, "markers": [], "hub": None}
    view = nothing | {"board_corners_px": []}
    row: dict[str, Any] = dict.fromkeys(("distance_m", "family", "split", "sequence", "light", "box_px"))
    row |= {"frame": frame_index, "text": "", "picture": picture_stem(frame_index, pixels_sha256)}
    labels = {"pose": None, "drogue": rings_name(rings), "left": view, "right": view}
    return FrameEntry(row, labels | {"conditions": [("Time", f"{time_s:.3f} s")]}, rings, None)


def with_answers(entry: FrameEntry, estimates: Sequence[Estimate | None]) -> FrameEntry:
    """The same with what estimators said of the pair: one estimate a method, None where it said nothing."""
    truth = entry.left_from_drogue
    answers = [None if estimate is None else _answer(estimate, truth) for estimate in estimates]
    row = entry.row | {"answers": [_in_short(answer) for answer in answers]}
    return replace(entry, row=row, labels=entry.labels | {"answers": [answer for answer in answers if answer]})


def _in_short(answer: dict[str, Any] | None) -> float | str | None:
    """The error of position [mm], or what there is instead; None where nothing was said."""
    if answer is None:
        return None
    if answer["pose"] is None:
        return "no fix"
    # There is no truth to compare it with.
    return "fix" if answer["error"] is None else float(answer["error"][0])


def rings_name(rings: tuple[Ring, ...]) -> str:
    """What pairs call a drogue by."""
    return hashlib.sha256(repr(rings).encode()).hexdigest()[:12]


def picture_stem(frame_index: int, record_sha256: str) -> str:
    """How the names of a pair's pictures begin: other pixels have another name."""
    return f"{frame_index:06d}-{record_sha256[:12]}"


def picture_files(folder: Path, stem: str) -> list[Path]:
    """A pair's pictures, there or not, in the order of `PICTURE_KINDS`."""
    return [folder / f"{stem}-{kind}.jpg" for kind in PICTURE_KINDS]


def write_pictures(files: Sequence[Path], images: StereoImages) -> None:
    """Write a pair's pictures as a screen wants them.

    Raises:
        OSError: one cannot be written; names it.
    """
    left, right = display_picture(images), display_picture(replace(images, left=images.right, right=images.left))
    small, _ = resized(left, min(_SMALL_WIDTH_PX, left.shape[1]))
    for path, picture, quality in zip(files, (small, left, right), (_SMALL_QUALITY, _QUALITY, _QUALITY), strict=True):
        write_bytes_atomic(path, _jpeg(picture, quality))


def _jpeg(picture: Picture, quality: int) -> bytes:
    # Colour at full resolution: small red markers would bleed into their dark face.
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    _, data = cv2.imencode(".jpg", picture[..., ::-1], options)
    return data.tobytes()


def _answer(estimate: Estimate, truth: RigidTransform | None) -> dict[str, Any]:
    pose = estimate.left_from_drogue if isinstance(estimate, PoseEstimate) else None
    error = None if pose is None or truth is None else pose_error(pose, truth)
    return {
        "method": estimate.method,
        "pose": _pose(pose),
        "reason": None if isinstance(estimate, PoseEstimate) else estimate.reason,
        # Position [mm], pitch and yaw [deg].
        "error": error and [round(1e3 * error.position_m, 3), *(round(float(e), 4) for e in error.components[3:])],
        "centroids": [
            [f.eye, str(f.index), *(round(c, _PX_DIGITS) for c in f.center_px), f.used] for f in estimate.features
        ],
    }


def _pose(pose: RigidTransform | None) -> list[float] | None:
    """(12,) the upper three rows of the matrix."""
    return None if pose is None else [round(value, _POSE_DIGITS) for value in pose.as_matrix()[:3].ravel().tolist()]


def _view(view: ViewRecord) -> dict[str, Any]:
    return {
        "box_full_px": _box(view.box_full_xywh_px),
        "box_visible_px": _box(view.box_visible_xywh_px),
        "markers": [_feature(marker) for marker in view.markers],
        "hub": None if view.hub is None else _feature(view.hub),
        "board_corners_px": [[round(c, _PX_DIGITS) for c in corner] for corner in view.board_corners_px],
    }


def _feature(feature: FeatureView) -> list[float]:
    """x, y [px], visible fraction, signal-to-noise."""
    x_px, y_px = (round(c, _PX_DIGITS) for c in feature.center_ellipse_px)
    return [x_px, y_px, round(feature.visible_fraction, 3), round(feature.signal_to_noise, 1)]


def _box(box: PixelBox | None) -> list[float] | None:
    return None if box is None else [round(side, _PX_DIGITS) for side in box]
