"""COCO annotation files: all pairs in one, and one for each split. Both eyes are images of their own."""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.layout import parts_file
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, Storage, join, open_storage
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from geometry.stereo import EYES, Eye
from labelgen.export.coco_entries import coco_annotation, coco_features, coco_header, coco_image
from labelgen.export.export_log import ExportLog
from labelgen.export.keypoints import count_absent_keypoints, count_cuts, keypoint_count, view_keypoints, view_of


def write_annotations(dataset: Location, out: Location) -> list[Location]:
    """Write the files that every dataset has under `annotations`: drogues alone.

    Arguments, result and errors as those of `write_coco`; `out` may be a URL too.
    """
    return [join(out, name) for name in _write(dataset, out, ExportLog(), with_features=False)]


def write_coco(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write `all.json` and one file for each split that has pairs: drogues, markers and hubs.

    Args:
        dataset: the dataset's folder.
        out: folder to write into; files of these names are replaced.
        log: is told what is left out.

    Returns:
        The files, `all.json` first.

    Raises:
        ValueError: the dataset cannot be read; names the file.
        OSError: a file cannot be written. It is then left as it was before.
    """
    return [out / name for name in _write(dataset, out, log, with_features=True)]


def read_part_ids(source: Dataset, record: PairRecord, eye: Eye) -> NDArray[np.uint8] | None:
    """(H, W) the part ids of a view, or None where its record knows of none.

    Raises:
        ValueError: they are on record but cannot be read; names the file.
    """
    return source.part_ids(record.frame_index, eye) if parts_file(eye) in record.file_sha256 else None


def _write(dataset: Location, out: Location, log: ExportLog, with_features: bool) -> list[str]:
    """Write the files, and return their names in `out`."""
    source, target = Dataset(dataset), open_storage(out)
    splits = source.manifest.split_of_frame()
    names = ["all", *(split for split in ("train", "val", "test") if split in splits.values())]
    header = canonical_json(coco_header(source.manifest, with_features))
    count = keypoint_count(source.manifest)
    with ExitStack() as stack:
        writers = {name: _CocoFile(stack, target, f"{name}.json", header) for name in names}
        for record in log.records(source):
            split = splits[record.frame_index]
            for eye in EYES:
                part_id = read_part_ids(source, record, eye)
                drogue = coco_annotation(record, eye, part_id, count)
                annotations = [] if drogue is None else [drogue]
                if with_features and part_id is not None:
                    annotations += coco_features(record, eye, part_id, count)
                image = coco_image(record, eye, split)
                for name in ("all", split):
                    writers[name].add(image, annotations)
                _tell(log, record, eye, annotations)
        for writer in writers.values():
            writer.finish()
    return [f"{name}.json" for name in names]


def _tell(log: ExportLog, record: PairRecord, eye: Eye, annotations: list[dict[str, Any]]) -> None:
    """Count what the annotations of a view lack."""
    count_cuts(log, record, eye)
    if not annotations:
        return
    view = view_of(record, eye)
    count_absent_keypoints(log, view_keypoints(view, record.frame.rig.camera, 0), len(view.markers))
    if "segmentation" not in annotations[0]:
        log.lost("views without masks, markers and hub: the dataset has no part ids of them")
        return
    features = len(view.markers) + (view.hub is not None)
    log.lost("markers and hubs of which no pixel is seen: without a label", features - len(annotations) + 1)


class _CocoFile:
    """One file that grows entry by entry: images go straight to it, annotations wait in a spool on disk."""

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
