"""COCO annotation files: all pairs in one, and one for each split. Both eyes are images of their own.

COCO counts pixels from the corner of the image: boxes and keypoints stand 0.5 px higher than in the records. Masks are
compressed run lengths.
"""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER, FRAMES_FOLDER, image_file, parts_file
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, Storage, join, open_storage
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord, PixelBox, PixelPoint
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.part_masks import DroguePixels, MaskPixels
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import ImageBits, export_image
from labelgen.export.keypoints import (
    CORNER_FROM_CENTER_PX,
    clockwise_order,
    keypoint_count,
    log_absent_keypoints,
    log_cut_labels,
    symmetric_orders,
    view_keypoints,
    view_of,
)
from labelgen.label_errors import confirmed_px, label_errors

DROGUE, MARKER, HUB = 1, 2, 3
"""Ids of the categories."""

NAMESPACE = "droguekit"

# Ids of markers and hubs: the feature's number in the upper bits, the image's id in the lower ones. Many programs keep
# ids in signed integers of 32 bits; with at most 33 features these are below 34 * 2^25 < 2^31. Drogues beside the
# sought one come after them.
_FEATURE_ID_STEP = 2**25
_FIRST_NEIGHBOUR = 40

IMAGES_FOLDER = "images"

# COCO's OKS is exp(-d^2 / (2 area (2 sigma)^2)). Ours falls to exp(-1/2) where d is half a marker's radius, 0.025 m,
# of a disc of the drogue's radius, whose area is pi (0.33 m)^2: sigma = 0.025 / (sqrt(pi) 0.33) / 2.
KEYPOINT_SIGMA = 0.0214
"""COCO's `kpt_oks_sigmas` for every keypoint of a drogue."""


def write_annotations(dataset: Location, out: Location) -> list[Location]:
    """Write the files that every dataset has under `annotations`: drogues alone.

    Arguments, result and errors as those of `write_coco`; `out` may be a URL too.
    """
    return [join(out, name) for name in _write(dataset, out, ExportLog(), with_features=False)]


def write_coco(dataset: Location, out: Path, log: ExportLog, image_bits: ImageBits | None = None) -> list[Path]:
    """Write one file for all pairs and one for each split that has pairs: drogues, markers and hubs.

    With images the folder has COCO's own layout, which datumaro, CVAT and torchvision read: `annotations/all.json` and
    `annotations/person_keypoints_SPLIT.json`, and `images/SPLIT/000123_left.png`. Names of images count from `images`
    in the file of all pairs, and from `images/SPLIT` in that of a split. Without, `all.json` and `SPLIT.json` name the
    dataset's own files.

    Args:
        dataset: the dataset's folder.
        out: with images a new folder; else a folder in which files of these names are replaced.
        log: counts what the format cannot hold.
        image_bits: writes images of at most so many bits; None writes none.

    Returns:
        The file of all pairs, then those of the splits; with images the folder alone.

    Raises:
        ValueError: the dataset cannot be read; names the file.
        OSError: a file cannot be written; an existing one stays as it was.
    """
    if image_bits is None:
        return [out / name for name in _write(dataset, out, log, with_features=True)]
    with new_folder(out) as folder:
        place = folder / ANNOTATIONS_FOLDER
        place.mkdir()
        _write(dataset, place, log, with_features=True, images=ImageCopies(folder / IMAGES_FOLDER, image_bits))
    return [out]


@dataclass(frozen=True)
class ImageCopies:
    """Where images are copied to, and with how many bits at most."""

    folder: Path
    bits: ImageBits


def read_part_ids(source: Dataset, record: PairRecord, eye: Eye) -> NDArray[np.uint8] | None:
    """(H, W) part ids of a view, or None where its record lists none.

    Raises:
        ValueError: they are on record but cannot be read; names the file.
    """
    return source.part_ids(record.frame_index, eye) if parts_file(eye) in record.file_sha256 else None


def _write(
    dataset: Location, out: Location, log: ExportLog, with_features: bool, images: ImageCopies | None = None
) -> list[str]:
    """Write the files, and return their names in `out`."""
    source, target = Dataset(dataset), open_storage(out)
    splits = source.manifest.split_of_frame()
    own = "" if images is None else "person_keypoints_"
    files = {"all": "all.json"}
    files |= {split: f"{own}{split}.json" for split in ("train", "val", "test") if split in splits.values()}
    header = canonical_json(coco_header(source.manifest, with_features))
    count = keypoint_count(source.manifest)
    sensor = source.manifest.recipe.sensor
    with ExitStack() as stack:
        writers = {name: _CocoFile(stack, target, file, header) for name, file in files.items()}
        for record in log.records(source):
            split = splits[record.frame_index]
            for eye in EYES:
                part_id = read_part_ids(source, record, eye)
                drogue = coco_annotation(record, eye, part_id, count)
                annotations = [] if drogue is None else [drogue]
                if with_features and part_id is not None:
                    annotations += coco_features(record, eye, part_id, count)
                _add_error_limits(annotations, record, eye, part_id if with_features else None)
                objects = len(annotations)
                annotations += coco_neighbours(record, eye, part_id, count)
                image = coco_image(record, eye, split)
                for name in ("all", split):
                    own_name = image if images is None else {**image, "file_name": _copy_name(record, eye, split, name)}
                    writers[name].add(own_name, annotations)
                if images is not None:
                    copy = images.folder / _copy_name(record, eye, split, "all")
                    export_image(source, record.frame_index, eye, copy, log, images.bits)
                elif sensor.output_bits > 8:
                    log.lost(
                        f"images of {sensor.output_bits} bits in 16, nearly black to programs for 8: add --images for "
                        "copies"
                    )
                elif sensor.encoding == "linear":
                    log.remark("the named images are linear, dark to viewers: add --images for copies on sRGB's curve")
                masked = None if drogue is None else objects if part_id is not None else 0
                log_missing_labels(log, record, eye, masked)
        for writer in writers.values():
            writer.finish()
    # Of an older export: with its images beside those of this one, two datasets would be one.
    for name in (f"{own}{split}.json" for split in ("train", "val", "test") if split not in files):
        if target.exists(name) and b"droguekit dataset " in target.read(name, 0, 65_536):
            target.delete(name)
            log.remark(f"{name} of an older export is removed: the dataset has no pairs of that split")
    return list(files.values())


def _copy_name(record: PairRecord, eye: Eye, split: str, file: str) -> str:
    """Name of a copied image, in the file of all pairs from the folder of all images."""
    name = f"{record.frame_index:06d}_{eye}.png"
    return f"{split}/{name}" if file == "all" else name


def log_missing_labels(log: ExportLog, record: PairRecord, eye: Eye, objects: int | None) -> None:
    """Log what the annotations of a view lack.

    Args:
        log: counts it.
        record: the truth.
        eye: which view.
        objects: number of annotated objects with masks, the drogue among them; 0 where the drogue has none, and None
            where nothing is annotated.
    """
    log_cut_labels(log, record, eye)
    if objects is None:
        return
    view = view_of(record, eye)
    log_absent_keypoints(log, view_keypoints(view, record.frame.rig.camera, 0), len(view.markers))
    if objects == 0:
        log.lost("views without masks, markers and hub: the dataset has no part ids of them")
        return
    features = len(view.markers) + (view.hub is not None)
    log.lost("markers and hubs of which no pixel is seen: without a label", features - objects + 1)


class _CocoFile:
    """A COCO file, written entry by entry: images directly, annotations by way of a temporary file."""

    def __init__(self, stack: ExitStack, target: Storage, name: str, header: str) -> None:
        self._stream: IO[str] = stack.enter_context(target.write_text(name))
        self._annotations: IO[str] = stack.enter_context(target.spool(""))
        self._stream.write(header.removesuffix("}") + ',"images":[')
        self._images = 0
        self._annotated = 0

    def add(self, image: dict[str, Any], annotations: list[dict[str, Any]]) -> None:
        """Append one image and what is on it."""
        self._stream.write((",\n" if self._images else "\n") + canonical_json(image))
        self._images += 1
        for annotation in annotations:
            self._annotations.write((",\n" if self._annotated else "\n") + canonical_json(annotation))
            self._annotated += 1

    def finish(self) -> None:
        """Append the annotations and close the JSON."""
        self._stream.write('\n],"annotations":[')
        self._annotations.seek(0)
        shutil.copyfileobj(self._annotations, self._stream)
        self._stream.write("\n]}\n")


def coco_image_id(frame_index: int, eye: Eye) -> int:
    """Id of an image, and of its drogue's annotation; the same in every file and after any merge."""
    return 2 * frame_index + EYES.index(eye) + 1


def coco_feature_id(image_id: int, marker_index: int | None) -> int:
    """Id of the annotation of a marker, or of the hub where the index is None, on an image."""
    return (1 if marker_index is None else 2 + marker_index) * _FEATURE_ID_STEP + image_id


def coco_header(manifest: Manifest, with_features: bool) -> dict[str, Any]:
    """The file's `info`, `licenses` and `categories`.

    Args:
        manifest: of the dataset.
        with_features: markers and hub are annotated too.
    """
    count = keypoint_count(manifest)
    names = [f"marker_{index}" for index in range(count)]
    drogue = {
        "id": DROGUE,
        "name": "drogue",
        "supercategory": "refuelling",
        "keypoints": names,
        "skeleton": [[index + 1, (index + 1) % count + 1] for index in range(count)],
    }
    # Readers of keypoints want both lists of every category, and all annotations have absent keypoints of these names.
    features = [
        {"id": id_, "name": name, "supercategory": "refuelling", "keypoints": names, "skeleton": []}
        for id_, name in ((MARKER, "marker"), (HUB, "hub"))
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
        # With one drogue in an image, the image's id identifies it too.
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
            **({"sought": True} if record.frame.neighbours else {}),
            "drogue": drogue.name,
            "keypoint_order_in_image": clockwise_order(view),
            "equal_keypoint_orders": symmetric_orders(drogue),
            "visible_fraction": [marker.visible_fraction for marker in view.markers],
            "left_from_drogue": record.left_from_drogue.as_matrix().tolist(),
            "eye_offset_m": record.frame.rig.eye_offset_m(eye).tolist(),
            "pitch_deg": record.pitch_deg,
            "yaw_deg": record.yaw_deg,
            "roll_deg": record.roll_deg,
            "roll_modulo_deg": record.roll_modulo_deg,
        },
    }


def _add_error_limits(
    annotations: list[dict[str, Any]], record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None
) -> None:
    """Add limits of errors to the entries of one eye's drogue, and of its markers and hub where part ids are given."""
    limits = label_errors(record, eye) if annotations else None
    if limits is None:
        return
    confirmed = () if part_id is None else confirmed_px(record, eye, part_id)
    for entry in annotations:
        own = entry[NAMESPACE]
        if entry["category_id"] == DROGUE:
            own["bbox_error_px"] = list(limits.box_visible_px)
            own["bbox_full_error_px"] = list(limits.box_full_px)
            own["center_error_px"] = list(limits.markers_px)
        elif entry["category_id"] == HUB:
            own["center_error_px"] = limits.hub_px
        else:
            index = own["marker_index"]
            own["center_error_px"], own["center_confirmed_px"] = limits.markers_px[index], confirmed[index]


def coco_neighbours(
    record: PairRecord, eye: Eye, part_id: NDArray[np.uint8] | None, count: int
) -> list[dict[str, Any]]:
    """The entries of the drogues beside the sought one in one eye's image, without those of which no pixel is seen.

    Arguments as those of `coco_annotation`. They are of the same category; their attribute `sought` is false, and all
    their keypoints are absent.

    Raises:
        ValueError: the frame's index is too large for ids of 32 bits, or the part ids show no pixel of one.
    """
    view, entries = view_of(record, eye), []
    for index, (seen, other) in enumerate(zip(view.neighbours, record.frame.neighbours, strict=True)):
        box = seen.box_visible_xywh_px
        if box is None:
            continue
        image_id = _small_image_id(record, eye)
        pixels = None if part_id is None else neighbour_pixels(record, index, box, part_id)
        entries.append(
            {
                "id": (_FIRST_NEIGHBOUR + index) * _FEATURE_ID_STEP + image_id,
                "image_id": image_id,
                "category_id": DROGUE,
                "iscrowd": 0,
                "bbox": _corner_box(box),
                "area": seen.visible_drogue_px,
                **({} if pixels is None else {"segmentation": pixels.segmentation()}),
                "keypoints": [0] * (3 * count),
                "num_keypoints": 0,
                NAMESPACE: {
                    "bbox_full": _corner_box(seen.box_full_xywh_px),
                    "truncated": seen.truncated,
                    "sought": False,
                    "drogue": other.drogue.name,
                    "rim_radius_m": other.drogue.rim_radius_m,
                    "left_from_drogue": other.left_from_drogue.as_matrix().tolist(),
                    "eye_offset_m": record.frame.rig.eye_offset_m(eye).tolist(),
                },
            }
        )
    return entries


def neighbour_pixels(record: PairRecord, index: int, box: PixelBox, part_id: NDArray[np.uint8]) -> MaskPixels:
    """Mask of a drogue beside the sought one, within its visible box in one eye's image.

    Raises:
        ValueError: there are no pixels of it.
    """
    pixels = DroguePixels(part_id, box, record.frame.neighbours[index].drogue.marker_count, index + 1).drogue()
    if not len(pixels):
        raise ValueError(
            f"frame {record.frame_index}: no pixel shows the drogue of neighbours[{index}] in its visible box; run "
            "droguekit validate"
        )
    return pixels


def _small_image_id(record: PairRecord, eye: Eye) -> int:
    """Id of an image, to which a feature's or a neighbour's number can be added.

    Raises:
        ValueError: it is too large for ids of 32 bits.
    """
    image_id = coco_image_id(record.frame_index, eye)
    if image_id >= _FEATURE_ID_STEP:
        raise ValueError(f"frame {record.frame_index}: must be below {_FEATURE_ID_STEP // 2 - 1} for COCO's ids")
    return image_id


def coco_features(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8], count: int) -> list[dict[str, Any]]:
    """The entries of hub and markers in one eye's image, without those of which no pixel is seen.

    Arguments as those of `coco_annotation`. The entries have `count` absent keypoints, so that COCO's evaluation of
    keypoints, which asks every annotation for them, passes them over.

    Raises:
        ValueError: the frame's index is too large for ids of 32 bits.
    """
    view = view_of(record, eye)
    if view.box_visible_xywh_px is None:
        return []
    image_id, entries = _small_image_id(record, eye), []
    for seen in drogue_pixels(record, eye, part_id).features(view):
        feature, index = seen.feature, seen.marker_index
        entries.append(
            {
                "id": coco_feature_id(image_id, index),
                "image_id": image_id,
                "category_id": HUB if index is None else MARKER,
                "iscrowd": 0,
                "bbox": seen.pixels.corner_box(),
                "area": len(seen.pixels),
                "segmentation": seen.pixels.segmentation(),
                "keypoints": [0] * (3 * count),
                "num_keypoints": 0,
                NAMESPACE: {
                    "drogue_annotation_id": image_id,
                    "marker_index": index,
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
    pixels = drogue_pixels(record, eye, part_id).drogue()
    if not len(pixels):
        path = f"{FRAMES_FOLDER}/{record.frame_index:06d}/{parts_file(eye)}"
        raise ValueError(f"{path}: no pixel shows the drogue in the visible box of the record; run droguekit validate")
    return pixels.segmentation()


def drogue_pixels(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> DroguePixels:
    """Masks of a view that shows the drogue."""
    view = view_of(record, eye)
    assert view.box_visible_xywh_px is not None
    return DroguePixels(part_id, view.box_visible_xywh_px, len(view.markers))


def _corner_point(point: PixelPoint) -> list[float]:
    return [point[0] + CORNER_FROM_CENTER_PX, point[1] + CORNER_FROM_CENTER_PX]


def _corner_box(box: PixelBox) -> list[float]:
    return [*_corner_point((box[0], box[1])), box[2], box[3]]
