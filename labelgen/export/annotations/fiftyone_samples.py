"""Datasets as FiftyOne reads them: groups of a left and a right image with detections and keypoints.

`metadata.json` and `samples.json` are FiftyOne's own serialization without a version, of which its importer
`FiftyOneDataset` infers the fields. Lengths are shares of the image's width and height, counted from its corner. Masks
are compressed arrays of the boxes' pixels, as FiftyOne stores them.

Source: FiftyOne's documentation of `FiftyOneDataset`, grouped datasets and instance masks.
"""

from __future__ import annotations

import base64
import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from labelgen.export.annotations.annotated_views import AnnotatedObject, AnnotatedView, annotated_views
from labelgen.export.annotations.part_masks import MaskPixels
from labelgen.export.export_log import ExportLog

DATA_FOLDER = "data"


def write_fiftyone(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write images and samples.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts what the format cannot hold.

    Returns:
        The folder.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source = Dataset(dataset)
    manifest = source.manifest
    about = {
        "media_type": "group",
        "info": {
            "name": manifest.name,
            "dataset_sha256": manifest.dataset_sha256,
            "licence": manifest.data_licence,
            "transforms": manifest.conventions["transforms"],
        },
    }
    with new_folder(out) as folder:
        (folder / "metadata.json").write_text(canonical_json(about) + "\n", encoding="utf-8", newline="\n")
        with (folder / "samples.json").open("w", encoding="utf-8", newline="\n") as stream:
            stream.write('{"samples":[')
            for number, view in enumerate(annotated_views(source, folder / DATA_FOLDER, log)):
                stream.write((",\n" if number else "\n") + canonical_json(_sample(view)))
            stream.write("\n]}\n")
    return [out]


def _sample(view: AnnotatedView) -> dict[str, Any]:
    record = view.record
    pose = record.left_from_drogue
    return {
        "filepath": f"{DATA_FOLDER}/{view.file_name}",
        "tags": [view.split],
        "_media_type": "image",
        "group": {"_cls": "Group", "_id": {"$oid": f"{record.frame_index:024x}"}, "name": view.eye},
        "frame_index": record.frame_index,
        "scene_id": record.scene_id,
        "time_s": record.time_s,
        "left_from_drogue": None if pose is None else pose.as_matrix().tolist(),
        "objects": {"_cls": "Detections", "detections": [_detection(view, one) for one in view.objects]},
        "keypoints": {"_cls": "Keypoints", "keypoints": [_keypoints(view)] if view.keypoints else []},
    }


def _detection(view: AnnotatedView, one: AnnotatedObject) -> dict[str, Any]:
    (width, height), (x, y, box_width, box_height) = view.size_px, one.box
    return {
        "_cls": "Detection",
        "label": one.label,
        "bounding_box": [x / width, y / height, box_width / width, box_height / height],
        "marker_index": one.marker_index,
        "visible_fraction": one.visible_fraction,
        **({"sought": one.instance == 0} if view.record.frame.neighbours else {}),
        "tags": [],
        "mask": None if one.pixels is None else {"$binary": {"base64": _mask(one.pixels), "subType": "00"}},
    }


def _mask(pixels: MaskPixels) -> str:
    """The array of a mask within its box, as FiftyOne serializes arrays."""
    stream = io.BytesIO()
    np.save(stream, pixels.crop()[2], allow_pickle=False)
    return base64.b64encode(zlib.compress(stream.getvalue())).decode("ascii")


def _keypoints(view: AnnotatedView) -> dict[str, Any]:
    """The markers on the image; lists beside the points say which they are and whether they are hidden."""
    width, height = view.size_px
    shown = [(index, point) for index, point in enumerate(view.keypoints) if point.flag]
    return {
        "_cls": "Keypoint",
        "label": "drogue",
        "points": [[point.x / width, point.y / height] for _, point in shown],
        "marker_index": [index for index, _ in shown],
        "flag": [point.flag for _, point in shown],
        "tags": [],
    }
