"""Checks of a whole dataset: files, hashes, calibration, labels against pixels, annotations against records."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.calibration.calibration_files import (
    OPENCV_STEREO_FILE,
    calibration_files,
    opencv_stereo_matrices,
)
from datasets_manifest.storage.frame_store import (
    FrameStore,
    index_of_archive,
    read_pairs_per_tar,
    read_shard_index,
    shard_numbers,
)
from datasets_manifest.storage.image_codecs import decode_png
from datasets_manifest.storage.layout import (
    BLIND_FILE,
    CALIBRATION_FOLDER,
    MANIFEST_FILE,
    RECORD_FILE,
    parts_file,
    shard_file,
    shard_index_file,
)
from datasets_manifest.storage.manifest import FrameEntry, Manifest, count_pairs
from datasets_manifest.storage.mesh_copies import mesh_copy_faults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, Storage, open_storage
from datasets_manifest.storage.writer import leftovers
from datasets_manifest.types.records import PairRecord
from drogue_models.frozen_model import FrozenModel
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import drogue_part_ids
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.part_pixels import FeaturePixels, parts_mask
from labelgen.validation.file_checks import CocoFiles, bag_faults, bag_files, passes_faults
from labelgen.validation.label_checks import (
    box_faults,
    check_boxes,
    check_empty,
    check_neighbours,
    check_unoccluded_marker,
    named_features,
    projection_faults,
)

# The files hold 16 digits.
_CALIBRATION_TOLERANCE = 1e-14


class Check(FrozenModel):
    """The result of one kind of check.

    Attributes:
        name: of the check.
        count: how often it was made.
        faults: a line each.
    """

    name: str
    count: int
    faults: tuple[str, ...]


class ValidationReport(FrozenModel):
    """The result of a validation.

    Attributes:
        pairs: number of pairs in the manifest.
        checks: in the order in which they were made.
    """

    pairs: int
    checks: tuple[Check, ...]

    @property
    def faults(self) -> list[str]:
        """All faults, a line each."""
        return [fault for check in self.checks for fault in check.faults]

    @property
    def passed(self) -> bool:
        """Whether there are no faults."""
        return not self.faults

    def fault_lines(self, most: int = 100) -> list[str]:
        """Up to `most` faults of each check, a line each, and how many more it has."""
        lines: list[str] = []
        for check in self.checks:
            lines += check.faults[:most]
            if len(check.faults) > most:
                lines.append(f"{check.name}: {len(check.faults) - most} more faults")
        return lines

    def table(self) -> str:
        """The checks with their counts, a line each."""
        rows = [f"{check.name:<34}{check.count:>9}{len(check.faults):>9}" for check in self.checks]
        return "\n".join([f"{'check':<34}{'checked':>9}{'faults':>9}", *rows])


class _Tally:
    """Counts and faults by check."""

    def __init__(self) -> None:
        self._counts: defaultdict[str, int] = defaultdict(int)
        self._faults: defaultdict[str, list[str]] = defaultdict(list)

    def add(self, name: str, faults: Sequence[str]) -> None:
        """Add the faults of one check."""
        self._counts[name] += 1
        self._faults[name] += faults

    def report(self, pairs: int) -> ValidationReport:
        """The report so far."""
        checks = (
            Check(name=name, count=count, faults=tuple(self._faults[name])) for name, count in self._counts.items()
        )
        return ValidationReport(pairs=pairs, checks=tuple(checks))


def validate_dataset(path: Location) -> ValidationReport:
    """Make all checks of a dataset that need no rendering.

    Args:
        path: location of the dataset.

    Returns:
        All checks with their faults; damaged files are faults, not exceptions.

    Raises:
        ValueError: there is no such folder, a dataset that never had labels, or a URL that cannot be used.
        OSError: a location that cannot be reached.
    """
    storage = open_storage(path)
    if not storage.root_exists():
        raise ValueError(f"{path}: there is no such dataset folder")
    if storage.exists(BLIND_FILE) and not storage.exists(MANIFEST_FILE):
        raise ValueError(f"{path}: is a blind or imported dataset, which has no labels to check")
    tally = _Tally()
    try:
        dataset = Dataset(path)
    except ValueError as error:
        tally.add("manifest", [str(error)])
        return tally.report(pairs=0)
    manifest = dataset.manifest
    tally.add("manifest", _count_faults(manifest))
    tally.add("drops", _drop_faults(manifest))
    tally.add("split", _split_faults(manifest))
    tally.add("calibration", calibration_faults(path, manifest.recipe.rig))
    if any(drogue.body_mesh is not None for drogue in manifest.recipe.drogues):
        tally.add("meshes", mesh_copy_faults(path, manifest.recipe))
    tally.add("leftovers", [f"{entry}: was left by a run that was killed" for entry in leftovers(path)])
    for name, found in shard_faults(storage):
        tally.add(name, found)
    try:
        for frame_index in sorted({*dataset.frames.indices()} - {*dataset.frame_indices}):
            tally.add("frames on disk", [f"{dataset.frames.where(frame_index)}: is not in the manifest"])
    except ValueError as error:
        tally.add("frames on disk", [str(error)])
    bags = bag_files(path)
    if bags:
        tally.add("bags", bag_faults(dataset, bags))
    coco = CocoFiles(path, manifest)
    for fault in coco.faults():
        tally.add("annotation files", [fault])
    for entry in manifest.frames:
        _check_frame(dataset, entry, coco, tally)
    return tally.report(len(manifest.frames))


def calibration_faults(dataset: Location, rig: StereoRig) -> list[str]:
    """Faults of the calibration files; all but OpenCV's may be missing."""
    storage, faults = open_storage(dataset), []
    for name, text in calibration_files(rig).items():
        path = storage.where(f"{CALIBRATION_FOLDER}/{name}")
        try:
            found = storage.read(f"{CALIBRATION_FOLDER}/{name}")
        except FileNotFoundError:
            if name == OPENCV_STEREO_FILE:
                faults.append(f"{path}: is missing")
            continue
        except OSError as error:
            faults.append(f"{path}: cannot be read: {error.strerror}")
            continue
        if found != text.encode():
            faults.append(f"{path}: is not that of the manifest's rig")
        elif name == OPENCV_STEREO_FILE:
            # Only a file that is known to be undamaged reaches OpenCV's parser.
            faults += _opencv_faults(path, text, rig)
    return faults


def _opencv_faults(path: str, text: str, rig: StereoRig) -> list[str]:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    faults = []
    for name, want in opencv_stereo_matrices(rig).items():
        found = storage.getNode(name).mat()
        if (
            found is None
            or found.shape != want.shape
            or not np.allclose(found, want, rtol=_CALIBRATION_TOLERANCE, atol=1e-300)
        ):
            faults.append(f"{path}: {name}: OpenCV reads {None if found is None else found.tolist()}")
    return faults


def shard_faults(storage: Storage) -> Iterator[tuple[str, list[str]]]:
    """Faults of each tar file of a dataset, with the name of the check; empty for a dataset without tar files.

    That the files in them are those of the records is checked frame by frame.
    """
    try:
        pairs_per_tar = read_pairs_per_tar(storage)
    except ValueError as error:
        yield "tar files", [str(error)]
        return
    if pairs_per_tar is None:
        return
    for number in shard_numbers(storage):
        yield "tar files", _faults(storage, number, pairs_per_tar)


def _faults(storage: Storage, number: int, pairs_per_tar: int) -> list[str]:
    where = storage.where(shard_file(number))
    try:
        listed = read_shard_index(storage, number)
    except ValueError as error:
        return [str(error)]
    try:
        with storage.open(shard_file(number)) as stream:
            found = index_of_archive(stream)
    except ValueError as error:
        return [f"{where}: {error}"]
    except OSError as error:
        return [f"{where}: cannot be read: {error.strerror}"]
    faults = []
    if found != listed:
        faults.append(f"{storage.where(shard_index_file(number))}: is not the list of {where}, which was changed")
    stray = sorted(index for index in found.frames if index // pairs_per_tar != number)
    if stray:
        faults.append(f"{where}: frame {stray[0]} belongs to another tar file")
    return faults


def _check_frame(dataset: Dataset, entry: FrameEntry, coco: CocoFiles, tally: _Tally) -> None:
    folder = dataset.frames.where(entry.frame_index)
    file = dataset.frames.where(entry.frame_index, RECORD_FILE)
    try:
        record = dataset.record(entry.frame_index)
    except ValueError as error:
        tally.add("records", [str(error)])
        return
    tally.add("records", [f"{file}: {fault}" for fault in _entry_faults(record, entry)])
    changed = dataset.verify(entry.frame_index)
    tally.add("hashes", [*changed, *_stray_files(dataset.frames, record)])
    try:
        dataset.images(entry.frame_index)
        tally.add("images", [])
    except ValueError as error:
        tally.add("images", [str(error)])
    tally.add("projection and epipolar rows", [f"{folder}: {fault}" for fault in projection_faults(record)])
    tally.add("keypoints in boxes", [f"{folder}: {fault}" for fault in box_faults(record)])
    for eye in EYES:
        path = dataset.frames.where(entry.frame_index, parts_file(eye))
        part_id = _read_part_ids(dataset.frames, record, eye)
        if part_id is None:
            tally.add("part ids", [f"{path}: cannot be read as 8 bit grey of the rig's size"])
            continue
        tally.add("part ids", [])
        tally.add("labels against part ids", [f"{path}: {fault}" for fault in _label_faults(record, eye, part_id)])
        tally.add("annotations", coco.annotation_faults(record, eye, part_id))
        # Files that were changed are a fault already, and must not reach the decoder.
        found = passes_faults(dataset, record, eye, part_id) if not changed else None
        if found is not None:
            tally.add("depth and normals", [f"{folder}: {fault}" for fault in found])


def _count_faults(manifest: Manifest) -> list[str]:
    want = count_pairs(manifest.frames)
    return [] if manifest.counts == want else [f"manifest.json: counts are {manifest.counts}, the frames give {want}"]


def _drop_faults(manifest: Manifest) -> list[str]:
    """Frames that are listed twice, both made and dropped, or not in the recipe."""
    indices = [entry.frame_index for entry in manifest.frames]
    dropped = [drop.frame_index for drop in manifest.drops]
    count = manifest.recipe.frames.count
    faults = [f"manifest.json: frame {index} is both made and dropped" for index in sorted({*indices} & {*dropped})]
    if len({*indices}) < len(indices) or len({*dropped}) < len(dropped):
        faults.append("manifest.json: frames, drops: must name each frame once")
    beyond = sorted(index for index in {*indices, *dropped} if index >= count)
    if beyond:
        faults.append(f"manifest.json: frame {beyond[0]} is not among the recipe's {count}")
    if sum(manifest.engines.values()) != len(indices):
        faults.append(f"manifest.json: engines: give {sum(manifest.engines.values())} pairs, there are {len(indices)}")
    return faults


def _split_faults(manifest: Manifest) -> list[str]:
    splits: defaultdict[int, set[str]] = defaultdict(set)
    for entry in manifest.frames:
        splits[entry.scene_id].add(entry.split)
    return [
        f"manifest.json: scene {scene_id} is in more than one split: {', '.join(sorted(names))}"
        for scene_id, names in splits.items()
        if len(names) > 1
    ]


def _entry_faults(record: PairRecord, entry: FrameEntry) -> list[str]:
    faults = []
    if record.scene_id != entry.scene_id or (record.left_from_drogue is None) != entry.empty:
        faults.append("scene_id, left_from_drogue: differ from the manifest's entry")
    if record.frame.frame_index != record.frame_index or record.frame.scene_id != record.scene_id:
        faults.append("frame: belongs to another frame or scene")
    if (record.left_from_drogue is None) != (record.frame.drogue is None):
        faults.append("left_from_drogue: must be given exactly when the frame has a drogue")
    elif record.left_from_drogue is not None and record.frame.left_from_drogue is not None:
        difference = record.left_from_drogue.as_matrix() - record.frame.left_from_drogue.as_matrix()
        if np.abs(difference).max() > 0:
            faults.append("left_from_drogue: differs from the frame's")
    return faults


def _stray_files(frames: FrameStore, record: PairRecord) -> list[str]:
    known, index = {*record.file_sha256, RECORD_FILE}, record.frame_index
    return [f"{frames.where(index, name)}: is not on record" for name in frames.names(index) if name not in known]


def _label_faults(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> list[str]:
    view = record.views.left if eye == "left" else record.views.right
    pose, drogue = record.left_from_drogue, record.frame.drogue
    if pose is None or drogue is None:
        return check_empty(view, part_id)
    layout = marker_layout(drogue)
    faults = check_boxes(view, parts_mask(part_id, drogue_part_ids(layout.count)))
    faults += check_neighbours(record, view, part_id)
    pixels = FeaturePixels(part_id)
    if len(view.markers) != layout.count:
        return [*faults, f"markers: {len(view.markers)} are labelled, the drogue has {layout.count}"]
    for name, feature, disc in named_features(record, layout, pose, eye):
        if (feature.visible_fraction > 0) != (pixels.count(disc.part) > 0):
            faults.append(f"{name}: visible_fraction: is {feature.visible_fraction}, the part ids say otherwise")
        elif name != "hub" and feature.in_image and feature.visible_fraction == 1:
            faults += [f"{name}: {fault}" for fault in check_unoccluded_marker(feature, disc, part_id, pixels)]
    return faults


def _read_part_ids(frames: FrameStore, record: PairRecord, eye: Eye) -> NDArray[np.uint8] | None:
    """The part ids, or None where they are missing or wrong."""
    name = parts_file(eye)
    try:
        part_id = decode_png(frames.read(record.frame_index, name), name, record.frame.rig.camera)
    except ValueError:
        return None
    return cast(NDArray[np.uint8], part_id) if part_id.dtype == np.uint8 and part_id.ndim == 2 else None
