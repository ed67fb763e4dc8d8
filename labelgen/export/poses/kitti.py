"""Stereo pairs as the KITTI object benchmark has them: `image_2` and `image_3` are the left and the right eye.

Boxes and `P2`, `P3` are in pixels counted from the centre of the top-left one; a box goes from the centre of its first
pixel to that of its last. A label's 3-D box is that around the whole drogue in the drogue's axes: length along the axis
from mouth to hose, width and height across. The format knows one angle, `rotation_y`; pitch and roll are left out.
Source: the readme of the KITTI object development kit (doi:10.1109/CVPR.2012.6248074).
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import new_folder
from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.appearance import DrogueCondition
from datasets_manifest.types.records import PairRecord, PixelBox
from drogue_models.parts import drogue_part_ids
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.export.annotations.coco import read_part_ids
from labelgen.export.export_log import ExportLog, require_pinholes
from labelgen.export.frame_files import export_measured_image
from labelgen.export.keypoints import log_cut_labels, view_of
from labelgen.part_pixels import drogue_hull_m, parts_mask
from labelgen.segmentation_masks import amodal_masks, union_of_masks

_NUMBER_OF_EYE: dict[Eye, int] = {"left": 2, "right": 3}
# KITTI defines its occlusion levels in words; our limits are these visible shares of the drogue's area.
_UNOCCLUDED_FRACTION, _PARTLY_FRACTION = 0.99, 0.5


def write_kitti(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write `training/{image_2,image_3,label_2,label_3,calib}` and the lists of the splits under `ImageSets`.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts what the format cannot hold.

    Returns:
        The folder.

    Raises:
        ValueError: the dataset cannot be read, its eyes are not rectified, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source = Dataset(dataset)
    rig, splits = source.manifest.recipe.rig, source.manifest.split_of_frame()
    require_pinholes(dataset, rig, "KITTI")
    calibration = kitti_calibration(rig)
    with new_folder(out) as folder, ExitStack() as stack:
        training, sets = folder / "training", folder / "ImageSets"
        for path in (training / "calib", sets, *(training / f"label_{number}" for number in (2, 3))):
            path.mkdir(parents=True)
        lists = {
            split: stack.enter_context((sets / f"{split}.txt").open("w", encoding="utf-8", newline="\n"))
            for split in sorted(set(splits.values()))
        }
        for record in log.records(source):
            log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
            name = f"{record.frame_index:06d}"
            lists[splits[record.frame_index]].write(f"{name}\n")
            _write_lines(training / "calib" / f"{name}.txt", calibration)
            for eye in EYES:
                number = _NUMBER_OF_EYE[eye]
                export_measured_image(
                    source, record.frame_index, eye, training / f"image_{number}" / f"{name}.png", log
                )
                label = kitti_label(record, eye, read_part_ids(source, record, eye))
                _write_lines(training / f"label_{number}" / f"{name}.txt", [] if label is None else [label])
                log_cut_labels(log, record, eye)
                log.lost("labels without pitch and roll, which KITTI does not know", int(label is not None))
    return [out]


def kitti_calibration(rig: StereoRig) -> list[str]:
    """Lines of a `calib` file; the rig has no laser scanner, so the left eye takes its place."""
    matrices = opencv_stereo_matrices(rig)
    still = np.hstack([np.eye(3), np.zeros((3, 1))])
    lines: dict[str, Array] = {
        "P0": matrices["P1"],
        "P1": matrices["P2"],
        "P2": matrices["P1"],
        "P3": matrices["P2"],
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": still,
        "Tr_imu_to_velo": still,
    }
    return [f"{name}: {' '.join(repr(float(number)) for number in matrix.ravel())}" for name, matrix in lines.items()]


def kitti_label(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None) -> str | None:
    """The line of one eye's drogue, or None where no pixel shows it; its location is in the left eye's axes.

    Args:
        record: the truth.
        eye: which image.
        part_id: (H, W) its part ids; without them the markers tell how much of the drogue is hidden.
    """
    view, drogue, pose = view_of(record, eye), record.frame.drogue, record.left_from_drogue
    box, full = view.box_visible_xywh_px, view.box_full_xywh_px
    if box is None or full is None or drogue is None or pose is None or record.yaw_deg is None:
        return None
    low, high = drogue_hull_m(drogue).min(axis=0), drogue_hull_m(drogue).max(axis=0)
    width_m, height_m, length_m = high - low
    middle = pose.apply((low + high) / 2)
    # KITTI's object points along x when its angle is 0 and turns about y, which is down: the hose, along z, is at -90.
    rotation_y = _wrapped(math.radians(record.yaw_deg) - math.pi / 2)
    seen_from = middle - record.frame.rig.eye_offset_m(eye)
    alpha = _wrapped(rotation_y - math.atan2(seen_from[0], seen_from[2]))
    numbers = (
        alpha,
        *(box[0] + 0.5, box[1] + 0.5, box[0] + box[2] - 0.5, box[1] + box[3] - 0.5),
        *(height_m, width_m, length_m),
        # The middle of the lower face.
        *(middle[0], middle[1] + height_m / 2, middle[2]),
        rotation_y,
    )
    truncated = _outside_fraction(full, record.frame.rig.camera)
    return (
        f"drogue {truncated!r} {_occlusion(record, eye, part_id)} {' '.join(repr(float(number)) for number in numbers)}"
    )


def _outside_fraction(box: PixelBox, camera: PinholeCamera) -> float:
    """Share of a box's area that is not on the image."""
    u, v, width, height = box
    on_u = min(u + width, camera.width_px - 0.5) - max(u, -0.5)
    on_v = min(v + height, camera.height_px - 0.5) - max(v, -0.5)
    return 1.0 - max(on_u, 0.0) * max(on_v, 0.0) / (width * height) if width * height > 0 else 0.0


def _occlusion(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None) -> int:
    """KITTI's level by what is on the image: 0 fully visible, 1 partly, 2 largely occluded, 3 unknown."""
    visible = _marker_fraction(record, eye) if part_id is None else _visible_fraction(record, eye, part_id)
    if visible is None:
        return 3
    return 0 if visible >= _UNOCCLUDED_FRACTION else 1 if visible >= _PARTLY_FRACTION else 2


def _visible_fraction(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> float:
    """Share of the drogue's pixels on the image that nothing hides."""
    assert record.frame.drogue is not None
    parts = tuple(drogue_part_ids(record.frame.drogue.marker_count))
    whole = union_of_masks(amodal_masks(record, eye, part_id), parts, part_id.shape)
    return np.count_nonzero(parts_mask(part_id, parts)) / max(np.count_nonzero(whole), 1)


def _marker_fraction(record: PairRecord, eye: Eye) -> float | None:
    """Mean visible share of the markers that are on the drogue and on the image; None where there are none."""
    condition = record.frame.condition or DrogueCondition()
    seen = [
        marker.visible_fraction
        for index, marker in enumerate(view_of(record, eye).markers)
        if marker.in_image and not condition.of_marker(index).missing
    ]
    return sum(seen) / len(seen) if seen else None


def _wrapped(angle_rad: float) -> float:
    """The angle in [-pi, pi). [rad]"""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")
