"""Datasets as ultralytics reads them: `data.yaml`, `images/SPLIT` and `labels/SPLIT`, both eyes as images of their own.

A label file has one row for each object: `class cx cy w h`, and for poses `x y flag` of each keypoint. All lengths are
shares of the image's width and height, counted from its corner. A file without rows is an image without a drogue.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PairRecord
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.coco import (
    HUB,
    MARKER,
    coco_annotation,
    coco_features,
    coco_neighbours,
    read_part_ids,
)
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import export_image
from labelgen.export.keypoints import (
    ABSENT,
    clockwise_order,
    keypoint_count,
    log_absent_keypoints,
    log_cut_labels,
    mirrored_order,
    view_keypoints,
    view_of,
)

_CLASSES = ("drogue", "marker", "hub")
_CLASS_OF_CATEGORY = {MARKER: 1, HUB: 2}

Rows = Callable[[PairRecord, Eye], list[list[float]]]


def write_yolo(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write boxes and keypoints, the keypoints in the drogue's own order.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts what the format cannot hold.

    Returns:
        `data.yaml`, which names the rest.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    return _write_pose(dataset, out, log, in_image_order=False)


def write_yolo_image_order(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write boxes and keypoints, beginning with the keypoint nearest the top and then clockwise.

    On an evenly spaced ring a network cannot identify the first marker, but it can learn this order. Arguments, result
    and errors as those of `write_yolo`.
    """
    return _write_pose(dataset, out, log, in_image_order=True)


def write_yolo_detect(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write visible boxes of drogues, markers and hubs. Arguments, result and errors as those of `write_yolo`."""
    source = Dataset(dataset)

    def rows(record: PairRecord, eye: Eye) -> list[list[float]]:
        part_id = read_part_ids(source, record, eye)
        drogue = coco_annotation(record, eye, None, 0)
        others = [[0, *_shares(entry["bbox"], record)] for entry in coco_neighbours(record, eye, None, 0)]
        if drogue is None:
            return others
        if part_id is None:
            log.lost("views without boxes of markers and hub: the dataset has no part ids of them")
            return [[0, *_shares(drogue["bbox"], record)], *others]
        features = coco_features(record, eye, part_id, 0)
        return [
            [0, *_shares(drogue["bbox"], record)],
            *([_CLASS_OF_CATEGORY[entry["category_id"]], *_shares(entry["bbox"], record)] for entry in features),
            *others,
        ]

    return _write(source, out, log, rows, ())


def _write_pose(dataset: Location, out: Path, log: ExportLog, in_image_order: bool) -> list[Path]:
    source = Dataset(dataset)
    count = keypoint_count(source.manifest)

    def rows(record: PairRecord, eye: Eye) -> list[list[float]]:
        view, camera = view_of(record, eye), record.frame.rig.camera
        drogue = coco_annotation(record, eye, None, 0)
        absent = [0.0] * (3 * count)
        others = [[0, *_shares(entry["bbox"], record), *absent] for entry in coco_neighbours(record, eye, None, 0)]
        if drogue is None:
            return others
        points = view_keypoints(view, camera, count)
        log_absent_keypoints(log, points, len(view.markers))
        if in_image_order:
            points = [points[index] for index in clockwise_order(view)] + [ABSENT] * (count - len(view.markers))
        shares = [(point.x / camera.width_px, point.y / camera.height_px, point.flag) for point in points]
        return [[0, *_shares(drogue["bbox"], record), *(number for share in shares for number in share)], *others]

    drogues = sorted(source.manifest.recipe.drogues, key=lambda drogue: -drogue.marker_count)
    flip, *others = (flip_indices(drogue, count, in_image_order) for drogue in drogues)
    if flip is None or any(other != flip for other in others):
        log.lost("values of flip_idx that do not fit all drogues: train with fliplr=0")
    return _write(source, out, log, rows, (f"kpt_shape: [{count}, 3]", f"flip_idx: {flip or list(range(count))}"))


def _write(source: Dataset, out: Path, log: ExportLog, rows: Rows, lines: tuple[str, ...]) -> list[Path]:
    split_of_frame = source.manifest.split_of_frame()
    # Not those of the manifest: all pairs of a split may be damaged.
    splits: set[str] = set()
    with new_folder(out) as folder:
        for record in log.records(source):
            split = split_of_frame[record.frame_index]
            splits.add(split)
            for eye in EYES:
                place = f"{split}/{record.frame_index:06d}_{eye}"
                export_image(source, record.frame_index, eye, folder / "images" / f"{place}.png", log)
                label = folder / "labels" / f"{place}.txt"
                label.parent.mkdir(parents=True, exist_ok=True)
                text = "".join(" ".join(map(repr, row)) + "\n" for row in rows(record, eye))
                label.write_text(text, encoding="utf-8", newline="\n")
                log_cut_labels(log, record, eye)
        names = _CLASSES[:1] if lines else _CLASSES
        yaml = [
            f"# droguekit dataset {source.manifest.name}, sha256 {source.manifest.dataset_sha256}",
            "# An empty path is the folder of this file.",
            'path: ""',
            *_split_lines(splits, log),
            *lines,
            "names:",
            *(f"  {number}: {name}" for number, name in enumerate(names)),
        ]
        (folder / "data.yaml").write_text("\n".join(yaml) + "\n", encoding="utf-8", newline="\n")
    return [out / "data.yaml"]


def _split_lines(splits: set[str], log: ExportLog) -> list[str]:
    """The folders of the splits; ultralytics needs the first two, even if there are no pairs of them."""
    lines = []
    for split in ("train", "val", "test"):
        if split in splits:
            lines.append(f"{split}: images/{split}")
        elif split != "test" and splits:
            other = next(name for name in ("train", "val", "test") if name in splits)
            lines.append(f"{split}: images/{other}  # there are no pairs for {split}")
            log.lost(f"splits without pairs: data.yaml names images/{other} for {split}")
    return lines


def flip_indices(drogue: DrogueParameters, count: int, in_image_order: bool) -> list[int] | None:
    """The keypoint that takes the place of each one in a mirrored image; None where markers have no mirror axis.

    Args:
        drogue: whose keypoints.
        count: of keypoints, absent ones among them.
        in_image_order: whether they begin at the top and go clockwise, or have the drogue's own order.
    """
    markers = drogue.marker_count
    order = tuple(-index % markers for index in range(markers)) if in_image_order else mirrored_order(drogue)
    return None if order is None else [*order, *range(markers, count)]


def _shares(box: list[float], record: PairRecord) -> list[float]:
    """Centre and size of a box with the image's corner as origin, as shares of the image."""
    camera = record.frame.rig.camera
    x, y, width, height = box
    return [
        (x + width / 2) / camera.width_px,
        (y + height / 2) / camera.height_px,
        width / camera.width_px,
        height / camera.height_px,
    ]
