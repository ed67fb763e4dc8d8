"""What stands in a COCO file: the header, and the entries of an image, its drogue, the markers and the hub.

COCO counts pixels from the corner of the image: boxes and keypoints stand 0.5 px higher than in the records.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.layout import FRAMES_FOLDER, image_file, parts_file
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.types.records import FeatureView, PairRecord, PixelBox, PixelPoint
from drogue_models.parts import Part, marker_id
from geometry.stereo import EYES, Eye
from labelgen.export.keypoints import (
    CORNER_FROM_CENTER_PX,
    clockwise_order,
    equal_orders,
    keypoint_count,
    view_keypoints,
    view_of,
)
from labelgen.export.run_lengths import DroguePixels

DROGUE, MARKER, HUB = 1, 2, 3
"""Ids of the categories."""
NAMESPACE = "droguekit"
# Ids of markers and hubs: the feature's number in the upper bits, the image's id in the lower ones.
_FEATURE_ID_STEP = 2**32
# COCO's OKS is exp(-d^2 / (2 area (2 sigma)^2)). Ours falls to exp(-1/2) where d is half a marker's radius, 0.025 m,
# of a disc of the drogue's radius, whose area is pi (0.33 m)^2: sigma = 0.025 / (sqrt(pi) 0.33) / 2.
KEYPOINT_SIGMA = 0.0214
"""COCO's `kpt_oks_sigmas` for every keypoint of a drogue."""


def coco_image_id(frame_index: int, eye: Eye) -> int:
    """Id of an image, the same in every file and after any merge; it is the drogue's annotation's id too."""
    return 2 * frame_index + EYES.index(eye) + 1


def coco_header(manifest: Manifest, with_features: bool) -> dict[str, Any]:
    """The file's `info`, `licenses` and `categories`.

    Args:
        manifest: of the dataset.
        with_features: markers and hub are annotated too.
    """
    count = keypoint_count(manifest)
    drogue = {
        "id": DROGUE,
        "name": "drogue",
        "supercategory": "refuelling",
        "keypoints": [f"marker_{index}" for index in range(count)],
        "skeleton": [[index + 1, (index + 1) % count + 1] for index in range(count)],
    }
    features = [
        {"id": MARKER, "name": "marker", "supercategory": "refuelling"},
        {"id": HUB, "name": "hub", "supercategory": "refuelling"},
    ]
    return {
        "info": {
            "description": f"droguekit dataset {manifest.name}: stereo pairs of a refuelling drogue",
            "version": str(manifest.schema_version),
            NAMESPACE: {
                "dataset_sha256": manifest.dataset_sha256,
                "pixels": "bbox and keypoints count from the image's corner: pixel centres are at 0.5",
                "keypoints": "images of the markers' 3-D centres, in the drogue's own order",
                "keypoint_flags": "0 outside the image or no such marker, 1 less than half visible, 2 visible",
                "kpt_oks_sigmas": [KEYPOINT_SIGMA] * count,
                "transforms": manifest.conventions["transforms"],
            },
        },
        "licenses": [
            {"id": 1, "name": manifest.data_licence, "url": f"https://spdx.org/licenses/{manifest.data_licence}"}
        ],
        "categories": [drogue, *(features if with_features else [])],
    }


def coco_image(record: PairRecord, eye: Eye, split: str) -> dict[str, Any]:
    """The entry of one eye's image."""
    camera = record.frame.rig.camera
    other: Eye = "right" if eye == "left" else "left"
    return {
        "id": coco_image_id(record.frame_index, eye),
        "file_name": f"{FRAMES_FOLDER}/{record.frame_index:06d}/{image_file(eye)}",
        "width": camera.width_px,
        "height": camera.height_px,
        "license": 1,
        NAMESPACE: {
            "frame_index": record.frame_index,
            "view": eye,
            "stereo_image_id": coco_image_id(record.frame_index, other),
            "scene_id": record.scene_id,
            "sequence_id": record.sequence_id,
            "split": split,
            "time_s": record.time_s,
            "conditions": record.conditions.model_dump(mode="json"),
        },
    }


def coco_annotation(
    record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None, count: int
) -> dict[str, Any] | None:
    """The entry of the drogue in one eye's image, or None where no pixel shows it.

    Args:
        record: the truth.
        eye: which image.
        part_id: (H, W) its part ids; without them the entry has no `segmentation`.
        count: of keypoints.

    Raises:
        ValueError: the part ids show no drogue where the record does.
    """
    view, drogue = view_of(record, eye), record.frame.drogue
    box = view.box_visible_xywh_px
    if box is None or view.box_full_xywh_px is None or record.left_from_drogue is None or drogue is None:
        return None
    points = view_keypoints(view, record.frame.rig.camera, count)
    image_id = coco_image_id(record.frame_index, eye)
    mask = {} if part_id is None else {"segmentation": _drogue_mask(record, eye, part_id)}
    return {
        # One drogue an image: the image's id is as unique and as stable.
        "id": image_id,
        "image_id": image_id,
        "category_id": DROGUE,
        "iscrowd": 0,
        "bbox": _corner_box(box),
        "area": view.visible_drogue_px,
        **mask,
        "keypoints": [number for point in points for number in point],
        "num_keypoints": sum(point.flag > 0 for point in points),
        NAMESPACE: {
            "bbox_full": _corner_box(view.box_full_xywh_px),
            "truncated": view.truncated,
            "drogue": drogue.name,
            "keypoint_order_in_image": clockwise_order(view),
            "equal_keypoint_orders": equal_orders(drogue),
            "visible_fraction": [marker.visible_fraction for marker in view.markers],
            "left_from_drogue": record.left_from_drogue.as_matrix().tolist(),
            "eye_offset_m": record.frame.rig.eye_offset_m(eye).tolist(),
            "pitch_deg": record.pitch_deg,
            "yaw_deg": record.yaw_deg,
            "roll_deg": record.roll_deg,
            "roll_modulo_deg": record.roll_modulo_deg,
        },
    }


def coco_features(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8], count: int) -> list[dict[str, Any]]:
    """The entries of hub and markers in one eye's image, without those of which no pixel is seen.

    Arguments as those of `coco_annotation`. The entries have `count` absent keypoints, so that COCO's evaluation of
    keypoints, which asks every annotation for them, passes them over.
    """
    view = view_of(record, eye)
    if view.box_visible_xywh_px is None:
        return []
    pixels = _drogue_pixels(record, eye, part_id)
    hub = [] if view.hub is None else [(HUB, int(Part.HUB), 1, view.hub)]
    markers = [(MARKER, marker_id(index), 2 + index, marker) for index, marker in enumerate(view.markers)]
    image_id = coco_image_id(record.frame_index, eye)
    entries = []
    feature: FeatureView
    for category, part, number, feature in [*hub, *markers]:
        seen = pixels.feature(part)
        if not len(seen):
            continue
        entries.append(
            {
                "id": number * _FEATURE_ID_STEP + image_id,
                "image_id": image_id,
                "category_id": category,
                "iscrowd": 0,
                "bbox": seen.corner_box(),
                "area": len(seen),
                "segmentation": seen.segmentation(),
                "keypoints": [0] * (3 * count),
                "num_keypoints": 0,
                NAMESPACE: {
                    "drogue_annotation_id": image_id,
                    "marker_index": None if category == HUB else number - 2,
                    "center_proj": _corner_point(feature.center_proj_px),
                    "center_ellipse": _corner_point(feature.center_ellipse_px),
                    "visible_fraction": feature.visible_fraction,
                    "in_image": feature.in_image,
                    "signal_to_noise": feature.signal_to_noise,
                },
            }
        )
    return entries


def _drogue_mask(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> dict[str, Any]:
    """Run lengths of the drogue's pixels.

    Raises:
        ValueError: there are none, where the record has a box around some.
    """
    pixels = _drogue_pixels(record, eye, part_id).drogue()
    if not len(pixels):
        path = f"{FRAMES_FOLDER}/{record.frame_index:06d}/{parts_file(eye)}"
        raise ValueError(f"{path}: no pixel is the drogue's in the visible box of the record; run droguekit validate")
    return pixels.segmentation()


def _drogue_pixels(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> DroguePixels:
    view = view_of(record, eye)
    assert view.box_visible_xywh_px is not None
    return DroguePixels(part_id, view.box_visible_xywh_px, len(view.markers))


def _corner_point(point: PixelPoint) -> list[float]:
    return [point[0] + CORNER_FROM_CENTER_PX, point[1] + CORNER_FROM_CENTER_PX]


def _corner_box(box: PixelBox) -> list[float]:
    return [*_corner_point((box[0], box[1])), box[2], box[3]]
