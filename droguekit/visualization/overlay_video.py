"""A video of a dataset's left images with labels, the estimates of a method and their errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, read_estimates
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord, PixelBox, PixelPoint
from drogue_models.parameters import DrogueParameters
from droguekit.scoring.poses.pose_errors import estimates_by_method, pose_error
from droguekit.scoring.report.label_drawing import (
    Picture,
    Rgb,
    display_picture,
    draw_box,
    draw_crosses,
    resized,
)
from droguekit.scoring.report.number_text import millimetres, three_digits
from droguekit.visualization.drogue_outlines import drogue_rings, ring_images
from droguekit.visualization.video_file import WrittenVideo, check_video, evenly, write_pairs
from geometry.se3 import Array, RigidTransform

TRUE_RGB: Rgb = (80, 255, 100)
ESTIMATE_RGB: Rgb = (255, 138, 31)
CENTROID_RGB: Rgb = (255, 255, 255)
_TEXT_RGB: Rgb = (235, 238, 242)
_SOFT_RGB: Rgb = (150, 158, 168)
_PAPER = 24
_WHOLE_WIDTH_PX, _BAR_PX = 800, 64
# Characters of a method's name that leave room for its numbers.
_MOST_NAME = 32
# Side of the close-up over that of the drogue's box.
_MARGIN = 1.35
_SMALLEST_PX = 32.0
# Points farther out than so many image widths are not drawn.
_FARTHEST_WIDTHS = 8.0
# OpenCV gets coordinates in 1/16 px.
_SHIFT = 4


def read_estimates_of_method(path: Path, dataset: Dataset, method: str | None) -> tuple[str, Mapping[int, Estimate]]:
    """One method's estimates by frame.

    Args:
        path: the file of estimates.
        dataset: of the estimates.
        method: its name, or None where the file has only one.

    Raises:
        ValueError: the file cannot be used, does not have the method, or has several and none was named.
    """
    methods = estimates_by_method(read_estimates(path), dataset.frame_indices, str(path))
    if method is None and len(methods) > 1:
        raise ValueError(f"--method: {path} has several methods; name one of {', '.join(methods)}")
    name = next(iter(methods)) if method is None else method
    if name not in methods:
        raise ValueError(f"--method: {path} holds {', '.join(methods)}, got {name}")
    return name, methods[name]


def write_overlay_video(
    dataset: Dataset, path: Path, count: int, sequence_id: int | None, estimates: tuple[str, Mapping[int, Estimate]]
) -> WrittenVideo:
    """Draw pairs of a dataset, spread evenly, and write them in the order of time.

    Args:
        dataset: of the pairs.
        path: ends in .mp4 or .gif; appears when it is complete.
        count: pairs at most.
        sequence_id: only pairs of this sequence, or None for all.
        estimates: a method's name and its estimates by frame; an empty name shows the truth alone.

    Raises:
        ValueError: no such pairs, or one that cannot be read.
        OSError: it cannot be written.
    """
    check_video("--overlay", path, count)
    fitting = [
        index
        for index in dataset.frame_indices
        if sequence_id is None or dataset.record(index).sequence_id == sequence_id
    ]
    if not fitting:
        which = "" if sequence_id is None else f" of sequence {sequence_id}"
        raise ValueError(f"{dataset.path}: holds no pairs{which} to show")
    records = [dataset.record(index) for index in evenly(fitting, count)]
    method, of_method = estimates

    def draw(record: PairRecord) -> Picture:
        drogue = dataset.sought_drogue(record)
        index = record.frame_index
        return draw_overlay(record, dataset.images(index), drogue, method, of_method.get(index))

    return write_pairs(path, map(draw, records), records)


class _Overlay(NamedTuple):
    """What is drawn over the left image. [px]"""

    box: PixelBox | None
    true: list[Array]
    estimated: list[Array]
    centers: list[PixelPoint]


def draw_overlay(
    record: PairRecord, images: StereoImages, drogue: DrogueParameters, method: str, estimate: Estimate | None
) -> Picture:
    """(H, W, 3) the left image, the drogue enlarged beside it, and lines of numbers above.

    Boxes are yellow, the true outline is green; an estimate's outline is orange, its measured centres white.

    Args:
        record: the pair's truth.
        images: its images.
        drogue: that is or would be in view.
        method: whose estimate is drawn; empty for the truth alone.
        estimate: of the pair, or None.
    """
    lines = _lines(record, drogue, estimate)
    picture = display_picture(images)
    whole, scale = resized(picture, _WHOLE_WIDTH_PX)
    # Video codecs need even sizes.
    height = whole.shape[0] // 2 * 2
    whole = whole[:height]
    _draw(whole, lines, scale, (-0.5, -0.5))
    close = np.full((height, height, 3), _PAPER, dtype=np.uint8)
    around = _region_of_interest(record, lines)
    if around is not None:
        close, larger, corner = _close_up(picture, around, height)
        _draw(close, lines, larger, corner)
    bar = _caption_bar(record, method, estimate, whole.shape[1] + height)
    return np.concatenate([bar, np.concatenate([whole, close], axis=1)])


def _lines(record: PairRecord, drogue: DrogueParameters, estimate: Estimate | None) -> _Overlay:
    rig, rings = record.frame.rig, drogue_rings(drogue)
    # An estimate may be anywhere, and OpenCV's fixed-point coordinates overflow far outside the picture.
    most_px = _FARTHEST_WIDTHS * rig.camera.width_px

    def outlines(pose: RigidTransform | None) -> list[Array]:
        images = [] if pose is None else ring_images(rings, pose, rig, "left")
        return [image for image in images if np.abs(image).max() < most_px]

    found = [f.center_px for f in estimate.features if f.eye == "left"] if estimate is not None else []
    return _Overlay(
        record.views.left.box_visible_xywh_px,
        outlines(record.left_from_drogue),
        outlines(estimate.left_from_drogue if isinstance(estimate, PoseEstimate) else None),
        [center for center in found if max(map(abs, center)) < most_px],
    )


def _draw(tile: Picture, lines: _Overlay, scale: float, corner: PixelPoint) -> None:
    """Draw the overlay into the left image, or into a part of it that starts at `corner`."""
    if lines.box is not None:
        draw_box(tile, lines.box, scale, corner)
    for outlines, color in ((lines.true, TRUE_RGB), (lines.estimated, ESTIMATE_RGB)):
        fixed = [np.rint(((outline - corner) * scale - 0.5) * 2**_SHIFT).astype(np.int32) for outline in outlines]
        cv2.polylines(tile, fixed, True, color, 1, cv2.LINE_AA, _SHIFT)
    draw_crosses(tile, lines.centers, scale, corner, CENTROID_RGB)


def _region_of_interest(record: PairRecord, lines: _Overlay) -> PixelBox | None:
    """The box of the close-up: around the drogue, else around an estimate, else None."""
    box = lines.box or record.views.left.box_full_xywh_px
    if box is None and lines.estimated:
        low, high = lines.estimated[0].min(axis=0), lines.estimated[0].max(axis=0)
        box = (float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1]))
    return box


def _close_up(picture: Picture, box: PixelBox, side: int) -> tuple[Picture, float, PixelPoint]:
    """A square picture around a box, its scale, and the top left corner of its area in the image. [px]"""
    reach = max(_SMALLEST_PX, _MARGIN * max(box[2], box[3]))
    scale = side / reach
    corner = (box[0] + box[2] / 2 - reach / 2, box[1] + box[3] / 2 - reach / 2)
    # OpenCV's warp does not average pixels when it shrinks a picture, so it is resized first.
    source = picture if scale >= 1 else resized(picture, max(1, round(scale * picture.shape[1])))[0]
    step = [got / had / scale for got, had in zip(source.shape[1::-1], picture.shape[1::-1], strict=True)]
    warp = np.array([[step[0], 0, 0.0], [0, step[1], 0.0]])
    # Maps pixel centres of the close-up to those of the source, whose corner is half a pixel before the first centre.
    warp[:, 2] = [(low + 0.5) * scale * each + 0.5 * each - 0.5 for low, each in zip(corner, step, strict=True)]
    flags = cv2.INTER_NEAREST if scale > 1 else cv2.INTER_LINEAR
    part = cv2.warpAffine(source, warp, (side, side), flags=flags | cv2.WARP_INVERSE_MAP)
    return np.asarray(part, dtype=np.uint8), scale, corner


def _caption_bar(record: PairRecord, method: str, estimate: Estimate | None, width: int) -> Picture:
    bar = np.full((_BAR_PX, width, 3), _PAPER, dtype=np.uint8)
    distance_m = record.conditions.distance_m
    where = "no drogue" if distance_m is None else f"drogue at {distance_m:.2f} m"
    # Pairs outside sequences have no meaningful time.
    when = "" if record.sequence_id is None else f", sequence {record.sequence_id}, {record.time_s:.2f} s"
    _write(bar, f"frame {record.frame_index}{when}: {where}", (14, 26), _TEXT_RGB)
    _write(bar, "true", (14, 52), TRUE_RGB)
    if method:
        shown = method if len(method) <= _MOST_NAME else f"{method[: _MOST_NAME - 3]}..."
        _write(bar, f"{shown}: {_error_text(record, estimate)}", (72, 52), ESTIMATE_RGB)
        _write(bar, "+ measured centres, left eye", (width - 290, 26), _SOFT_RGB)
    return bar


def _error_text(record: PairRecord, estimate: Estimate | None) -> str:
    if estimate is None:
        return "no estimate of this pair"
    if isinstance(estimate, NoFix):
        return f"no fix, {estimate.reason}"[:110]
    if record.left_from_drogue is None:
        return "a fix, but there is no drogue"
    error = pose_error(estimate.left_from_drogue, record.left_from_drogue)
    x_mm, y_mm, z_mm = map(_signed, 1e3 * error.components[:3])
    pitch_deg, yaw_deg = map(_signed, error.components[3:])
    size = f"{millimetres(error.position_m)} mm off (x {x_mm}, y {y_mm}, z {z_mm})"
    return f"{size}, pitch {pitch_deg} deg, yaw {yaw_deg} deg"


def _signed(value: float) -> str:
    """Three significant digits behind a sign that OpenCV's fonts have."""
    return ("-" if value < 0 else "+") + three_digits(abs(value))


def _write(bar: Picture, text: str, place: tuple[int, int], color: Rgb) -> None:
    # OpenCV's fonts have only ASCII.
    shown = text.encode("ascii", "replace").decode("ascii")
    cv2.putText(bar, shown, place, cv2.FONT_HERSHEY_SIMPLEX, 0.56, color, 1, cv2.LINE_AA)
