"""COCO annotation files: all pairs in one, and one for each split. Both eyes are images of their own.

COCO counts pixels from the corner of the image: boxes and keypoints stand 0.5 px higher than in the records.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from datasets_manifest.atomic import open_text_atomic
from datasets_manifest.layout import FRAMES_FOLDER, image_file
from datasets_manifest.manifest import Manifest
from datasets_manifest.reader import Dataset
from datasets_manifest.records import PairRecord, PixelBox, ViewRecord
from datasets_manifest.writer import canonical_json
from geometry.stereo import EYES, Eye
from labelgen.boxes import visible_mask

CATEGORY_ID = 1
NAMESPACE = "droguekit"
# A marker counts as visible from half of its pixels on.
_VISIBLE_FROM_FRACTION = 0.5
_CORNER_FROM_CENTER_PX = 0.5


def coco_image_id(frame_index: int, eye: Eye) -> int:
    """Id of an image, the same in every file and after any merge."""
    return 2 * frame_index + EYES.index(eye) + 1


def write_coco(dataset: Path, out: Path) -> list[Path]:
    """Write `all.json` and one file for each split that has pairs.

    Only one pair is in memory at a time; the same dataset gives the same bytes.

    Args:
        dataset: the dataset's folder.
        out: folder to write into.

    Returns:
        The files, `all.json` first.

    Raises:
        ValueError: the dataset cannot be read; names the file.
        OSError: a file cannot be written. It is then left as it was before.
    """
    source = Dataset(dataset)
    splits = source.manifest.split_of_frame()
    names = ["all", *(split for split in ("train", "val", "test") if split in splits.values())]
    with ExitStack() as stack:
        writers = {name: _CocoFile(stack, out / f"{name}.json", source.manifest) for name in names}
        for frame_index in source.frame_indices:
            record = source.record(frame_index)
            split = splits[frame_index]
            for eye in EYES:
                image = coco_image(record, eye, split)
                annotation = coco_annotation(record, eye, source.part_ids(frame_index, eye))
                if annotation is not None:
                    # COCO wants as many keypoints of every drogue as the category has.
                    missing = most_markers(source.manifest) * 3 - len(annotation["keypoints"])
                    annotation["keypoints"] += [0.0] * missing
                for name in ("all", split):
                    writers[name].add(image, annotation)
        for writer in writers.values():
            writer.finish()
    return [out / f"{name}.json" for name in names]


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


def coco_annotation(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> dict[str, Any] | None:
    """The entry of the drogue in one eye's image, or None where no pixel shows it.

    Args:
        record: the truth.
        eye: which image.
        part_id: (H, W) its part ids.
    """
    view = record.views.left if eye == "left" else record.views.right
    if view.box_visible_xywh_px is None or view.box_full_xywh_px is None or record.left_from_drogue is None:
        return None
    keypoints = _keypoints(record, view)
    mask = visible_mask(part_id, len(view.markers))
    run_lengths = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    image_id = coco_image_id(record.frame_index, eye)
    return {
        # One drogue an image: the image's id is as unique and as stable.
        "id": image_id,
        "image_id": image_id,
        "category_id": CATEGORY_ID,
        "iscrowd": 0,
        "bbox": _corner_box(view.box_visible_xywh_px),
        "area": view.visible_drogue_px,
        "segmentation": {"size": list(mask.shape), "counts": run_lengths["counts"].decode("ascii")},
        "keypoints": keypoints,
        "num_keypoints": sum(1 for flag in keypoints[2::3] if flag > 0),
        NAMESPACE: {
            "bbox_full": _corner_box(view.box_full_xywh_px),
            "truncated": view.truncated,
            "keypoint_order_in_image": clockwise_order(view),
            "visible_fraction": [marker.visible_fraction for marker in view.markers],
            "left_from_drogue": record.left_from_drogue.as_matrix().tolist(),
            "eye_offset_m": record.frame.rig.eye_offset_m(eye).tolist(),
            "pitch_deg": record.pitch_deg,
            "yaw_deg": record.yaw_deg,
            "roll_deg": record.roll_deg,
            "roll_modulo_deg": record.roll_modulo_deg,
        },
    }


def clockwise_order(view: ViewRecord) -> list[int]:
    """Indices of the markers as they stand in the image: the one nearest the top first, then clockwise.

    Even rings look the same after a turn by one marker; this order does not depend on which is which.
    """
    centers = np.array([marker.center_proj_px for marker in view.markers])
    right, down = (centers - centers.mean(axis=0)).T
    from_top = np.arctan2(right, -down)
    first = int(np.argmin(np.abs(from_top)))
    return [int(index) for index in np.argsort((from_top - from_top[first]) % (2 * np.pi), kind="stable")]


def most_markers(manifest: Manifest) -> int:
    """Number of markers of the drogue that has most of them."""
    recipe = manifest.recipe
    return max([recipe.drogue.marker_count, *(variant.drogue.marker_count for variant in recipe.variants)])


def coco_header(manifest: Manifest) -> dict[str, Any]:
    """The file's `info`, `licenses` and `categories`."""
    count = most_markers(manifest)
    return {
        "info": {
            "description": f"droguekit dataset {manifest.name}: stereo pairs of a refuelling drogue",
            "version": str(manifest.schema_version),
            NAMESPACE: {
                "dataset_sha256": manifest.dataset_sha256,
                "pixels": "bbox and keypoints count from the image's corner: pixel centres are at 0.5",
                "keypoints": "images of the markers' 3-D centres, in the drogue's own order",
                "keypoint_flags": "0 outside the image, 1 less than half visible, 2 visible",
                "transforms": manifest.conventions["transforms"],
            },
        },
        "licenses": [
            {"id": 1, "name": manifest.data_licence, "url": f"https://spdx.org/licenses/{manifest.data_licence}"}
        ],
        "categories": [
            {
                "id": CATEGORY_ID,
                "name": "drogue",
                "supercategory": "refuelling",
                "keypoints": [f"marker_{index}" for index in range(count)],
                "skeleton": [[index + 1, (index + 1) % count + 1] for index in range(count)],
            }
        ],
    }


def _corner_box(box: PixelBox) -> list[float]:
    return [box[0] + _CORNER_FROM_CENTER_PX, box[1] + _CORNER_FROM_CENTER_PX, box[2], box[3]]


def _keypoints(record: PairRecord, view: ViewRecord) -> list[float]:
    """x, y and flag of all markers in the drogue's order."""
    flat: list[float] = []
    for marker in view.markers:
        u, v = marker.center_proj_px
        if not record.frame.rig.camera.contains(marker.center_proj_px):
            flat += [0.0, 0.0, 0]
            continue
        flag = 2 if marker.visible_fraction >= _VISIBLE_FROM_FRACTION else 1
        flat += [u + _CORNER_FROM_CENTER_PX, v + _CORNER_FROM_CENTER_PX, flag]
    return flat


def _spool(folder: Path) -> IO[str]:
    """A file without a name on the disk of `folder`, not in memory as /tmp is on many machines."""
    return tempfile.TemporaryFile("w+", encoding="utf-8", newline="\n", dir=folder)


class _CocoFile:
    """One file that grows entry by entry: images go straight to it, annotations wait in a spool on disk."""

    def __init__(self, stack: ExitStack, path: Path, manifest: Manifest) -> None:
        self._stream: IO[str] = stack.enter_context(open_text_atomic(path))
        self._annotations: IO[str] = stack.enter_context(_spool(path.parent))
        self._stream.write(canonical_json(coco_header(manifest)).removesuffix("}") + ',"images":[')
        self._images = 0
        self._annotated = 0

    def add(self, image: dict[str, Any], annotation: dict[str, Any] | None) -> None:
        """Append one image and what is on it."""
        self._stream.write((",\n" if self._images else "\n") + canonical_json(image))
        self._images += 1
        if annotation is not None:
            self._annotations.write((",\n" if self._annotated else "\n") + canonical_json(annotation))
            self._annotated += 1

    def finish(self) -> None:
        """Append the annotations and close the JSON."""
        self._stream.write('\n],"annotations":[')
        self._annotations.seek(0)
        shutil.copyfileobj(self._annotations, self._stream)
        self._stream.write("\n]}\n")
