"""What annotation tools get of a view: image, boxes, masks and keypoints, in pixels from the image's corner."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.coco import (
    coco_annotation,
    drogue_pixels,
    log_missing_labels,
    neighbour_pixels,
    read_part_ids,
)
from labelgen.export.annotations.part_masks import MaskPixels
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import export_image
from labelgen.export.keypoints import CORNER_FROM_CENTER_PX, Keypoint, view_keypoints, view_of

IMAGES_FOLDER = "images"

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class AnnotatedObject:
    """The drogue, one of its markers, or its hub.

    Attributes:
        label: which of them.
        marker_index: of a marker.
        box: x, y, width, height of the visible pixels. [px]
        pixels: its mask; None where the dataset has no part ids.
        center: projection of a feature's centre, None for the drogue. [px]
        visible_fraction: of a feature's area, None for the drogue.
        instance: 0 for the drogue that is sought and its features, 1 for the first drogue beside it.
    """

    label: Literal["drogue", "marker", "hub"]
    marker_index: int | None
    box: Box
    pixels: MaskPixels | None
    center: tuple[float, float] | None = None
    visible_fraction: float | None = None
    instance: int = 0


@dataclass(frozen=True, eq=False)
class AnnotatedView:
    """One eye's image with what is on it.

    Attributes:
        record: of its pair.
        eye: which one.
        split: of its pair.
        file_name: of the image below the folder of images.
        size_px: (width, height). [px]
        objects: the drogue first, then hub and markers, then drogues beside it; those of which a pixel is seen.
        keypoints: of the sought drogue's markers in its own order; empty where no pixel shows it.
    """

    record: PairRecord
    eye: Eye
    split: str
    file_name: str
    size_px: tuple[int, int]
    objects: tuple[AnnotatedObject, ...]
    keypoints: tuple[Keypoint, ...]


def annotated_views(source: Dataset, images: Path, log: ExportLog) -> Iterator[AnnotatedView]:
    """All views of a dataset; writes their images, with 8 bits, into a folder.

    Raises:
        ValueError: a record, image or part ids that cannot be read; names the file.
        OSError: an image cannot be written.
    """
    splits = source.manifest.split_of_frame()
    for record in log.records(source):
        camera = record.frame.rig.camera
        for eye in EYES:
            split = splits[record.frame_index]
            file_name = f"{split}/{record.frame_index:06d}_{eye}.png"
            export_image(source, record.frame_index, eye, images / file_name, log)
            part_id = read_part_ids(source, record, eye)
            objects = _objects(record, eye, part_id, log)
            points = view_keypoints(view_of(record, eye), camera, 0) if objects else []
            objects += _other_drogues(record, eye, part_id)
            size_px = camera.width_px, camera.height_px
            yield AnnotatedView(record, eye, split, file_name, size_px, tuple(objects), tuple(points))


def annotated_objects(source: Dataset, record: PairRecord, eye: Eye, log: ExportLog) -> list[AnnotatedObject]:
    """What is seen on a view: the drogue first, then hub and markers; the log counts what is not.

    Raises:
        ValueError: part ids that cannot be read; names the file.
    """
    return _objects(record, eye, read_part_ids(source, record, eye), log)


def _other_drogues(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None) -> list[AnnotatedObject]:
    objects = []
    for index, seen in enumerate(view_of(record, eye).neighbours):
        box = seen.box_visible_xywh_px
        if box is not None:
            corner = box[0] + CORNER_FROM_CENTER_PX, box[1] + CORNER_FROM_CENTER_PX
            pixels = None if part_id is None else neighbour_pixels(record, index, box, part_id)
            objects.append(AnnotatedObject("drogue", None, (*corner, box[2], box[3]), pixels, instance=index + 1))
    return objects


def _objects(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None, log: ExportLog) -> list[AnnotatedObject]:
    drogue = coco_annotation(record, eye, part_id, 0)
    if drogue is None:
        log_missing_labels(log, record, eye, None)
        return []
    x, y, width, height = drogue["bbox"]
    if part_id is None:
        log_missing_labels(log, record, eye, 0)
        return [AnnotatedObject("drogue", None, (x, y, width, height), None)]
    masks = drogue_pixels(record, eye, part_id)
    objects = [AnnotatedObject("drogue", None, (x, y, width, height), masks.drogue())]
    for seen in masks.features(view_of(record, eye)):
        u, v = seen.feature.center_proj_px
        left, top, box_width, box_height = seen.pixels.corner_box()
        objects.append(
            AnnotatedObject(
                label="hub" if seen.marker_index is None else "marker",
                marker_index=seen.marker_index,
                box=(left, top, box_width, box_height),
                pixels=seen.pixels,
                center=(u + CORNER_FROM_CENTER_PX, v + CORNER_FROM_CENTER_PX),
                visible_fraction=seen.feature.visible_fraction,
            )
        )
    log_missing_labels(log, record, eye, len(objects))
    return objects
