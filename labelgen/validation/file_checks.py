"""A dataset's bags, COCO files and passes against its records; mcap, pycocotools and OpenEXR read what is encoded."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, BinaryIO

import numpy as np
import pycocotools.mask
from numpy.typing import NDArray

from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices
from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER, passes_file
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import Part, drogue_part_ids
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.coco import DROGUE, coco_image_id, coco_neighbours
from labelgen.export.keypoints import keypoint_count, view_of
from labelgen.part_pixels import FeaturePixels, drogue_mask
from labelgen.validation.coco_index import CocoIndex
from labelgen.validation.label_checks import check_feature_pixels, named_features

# Numbers that went through float64 and one product.
_TOLERANCE = 1e-12


def bag_files(dataset: Location) -> list[str]:
    """Names of the bags' files below a dataset, sorted; links are not followed."""
    return open_storage(dataset).files_ending(".mcap")


def bag_faults(dataset: Dataset, names: list[str]) -> list[str]:
    """Faults of the bags: unpaired images, missing pairs, another calibration than the dataset's.

    Args:
        dataset: from which they were exported.
        names: of all bag files.
    """
    storage = open_storage(dataset.path)
    paths = {name: storage.where(name) for name in names}
    try:
        import mcap.reader  # noqa: F401
        import mcap_ros2.decoder  # noqa: F401
    except ModuleNotFoundError as error:
        return [
            f"{path}: cannot be checked, for {error.name} is missing: pip install mcap-ros2-support"
            for path in paths.values()
        ]
    faults, pairs = [], 0
    for name, path in paths.items():
        try:
            with storage.open(name) as stream:
                stamps, infos = _contents(stream)
        # Any error that the library raises on a damaged bag.
        except Exception as error:
            faults.append(f"{path}: is damaged: {' '.join(str(error).split()) or type(error).__name__}")
            continue
        left, right = (stamps[f"/stereo/{eye}/image_raw"] for eye in EYES)
        pairs += len(left)
        if left != right or len(set(left)) < len(left):
            faults.append(
                f"{path}: {len(left)} left and {len(right)} right images, which must come in pairs of one time"
            )
        faults += [f"{path}: {fault}" for fault in _calibration_faults(dataset, infos)]
    if not faults and pairs != len(dataset.frame_indices):
        where = paths[names[0]].rpartition("/")[0]
        faults.append(f"{where}: bags hold {pairs} pairs, the dataset {len(dataset.frame_indices)}")
    return faults


def _contents(stream: BinaryIO) -> tuple[dict[str, list[int]], dict[str, Any]]:
    """Times of all messages by topic [ns], and the first CameraInfo of each topic."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    stamps: defaultdict[str, list[int]] = defaultdict(list)
    infos: dict[str, Any] = {}
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    for _, channel, raw, message in reader.iter_decoded_messages():
        stamps[channel.topic].append(raw.log_time)
        if channel.topic.endswith("/camera_info"):
            infos.setdefault(channel.topic, message)
    return stamps, infos


def _calibration_faults(dataset: Dataset, infos: dict[str, Any]) -> list[str]:
    want, faults = opencv_stereo_matrices(dataset.manifest.recipe.rig), []
    for number, eye in enumerate(EYES, start=1):
        info = infos.get(f"/stereo/{eye}/camera_info")
        if info is None:
            faults.append(f"has no CameraInfo of the {eye} eye")
            continue
        for name, given in (("M", info.k), ("D", info.d), ("R", info.r), ("P", info.p)):
            exact = want[f"{name}{number}"].ravel()
            found = np.asarray(given, dtype=np.float64)
            if found.shape != exact.shape or not np.allclose(found, exact, rtol=_TOLERANCE, atol=_TOLERANCE):
                faults.append(f"CameraInfo of the {eye} eye: {name}{number} is not that of the dataset's rig")
    return faults


# COCO's boxes and keypoints are the records' numbers plus a half, rounded at most once.
_TOLERANCE_PX = 1e-9


class CocoFiles:
    """`all.json` and the file of every split that has pairs."""

    def __init__(self, dataset: Location, manifest: Manifest) -> None:
        """Read all files; those that cannot be read become faults."""
        self._faults: list[str] = []
        self._manifest = manifest
        self._storage = open_storage(dataset)
        self._path = self._storage.where(f"{ANNOTATIONS_FOLDER}/all.json")
        self._splits = {coco_image_id(entry.frame_index, eye): entry.split for entry in manifest.frames for eye in EYES}
        self._all = self._load("all", np.array(list(self._splits), dtype=np.int64))
        for split in sorted({*self._splits.values()}):
            ids = [image_id for image_id, own in self._splits.items() if own == split]
            part = self._load(split, np.array(ids, dtype=np.int64))
            if part is not None and self._all is not None and part.digests != {split: self._all.digests.get(split)}:
                path = self._storage.where(f"{ANNOTATIONS_FOLDER}/{split}.json")
                self._faults.append(f"{path}: differs from all.json")

    def faults(self) -> list[str]:
        """Faults of the files as a whole."""
        return self._faults

    def annotation_faults(self, record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> list[str]:
        """Faults of the annotation of one image in `all.json`."""
        image_id = coco_image_id(record.frame_index, eye)
        if self._all is None or not self._all.has_image(image_id):
            return []
        view = view_of(record, eye)
        where = f"{self._path}: image {image_id}"
        try:
            annotations = self._all.annotations_of(image_id)
            wanted = coco_neighbours(record, eye, part_id, keypoint_count(self._manifest))
        except (OSError, ValueError) as error:
            return [f"{where}: {error}"]
        others = [entry for entry in annotations if entry.get("id") in {other["id"] for other in wanted}]
        # As JSON, in which numbers of both are the same.
        if canonical_json(others) != canonical_json(wanted):
            return [f"{where}: the annotations of drogues beside the sought one differ from the record and part ids"]
        for index, other in enumerate(record.frame.neighbours):
            mask = drogue_mask(part_id, other.drogue.marker_count, index + 1)
            if mask.any() and not any(_is_mask(entry.get("segmentation"), mask) for entry in others):
                return [f"{where}: no segmentation is that of neighbours[{index}] in the part ids"]
        annotations = [entry for entry in annotations if entry not in others]
        if view.box_visible_xywh_px is None:
            return [f"{where}: has annotations, no drogue is visible"] if annotations else []
        if [annotation.get("category_id") for annotation in annotations] != [DROGUE]:
            return [f"{where}: must have one annotation, of the drogue, has {len(annotations)}"]
        annotation = annotations[0]
        try:
            faults = _annotation_faults(annotation, record, eye)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            return [f"{where}: annotation is invalid: {type(error).__name__} {error}"]
        if not _is_mask(annotation.get("segmentation"), np.isin(part_id, drogue_part_ids(len(view.markers)))):
            faults.append("segmentation: differs from the part ids")
        return [f"{where}: {fault}" for fault in faults]

    def _load(self, name: str, ids: NDArray[np.int64]) -> CocoIndex | None:
        inside = f"{ANNOTATIONS_FOLDER}/{name}.json"
        path = self._storage.where(inside)
        try:
            index = CocoIndex(self._storage, inside, self._splits.get)
        except FileNotFoundError:
            self._faults.append(f"{path}: is missing")
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            reason = f"has no {error}" if isinstance(error, KeyError) else str(error)
            self._faults.append(f"{path}: is truncated or not a COCO file: {reason}")
            return None
        if not np.array_equal(index.image_ids, np.unique(ids)):
            self._faults.append(f"{path}: has {len(index.image_ids)} images, its pairs have {len(ids)}")
        if index.categories.count((DROGUE, "drogue")) != 1:
            self._faults.append(f"{path}: categories: must have the drogue once, with the id {DROGUE}")
        if 0 in index.annotation_ids or len(np.unique(index.annotation_ids)) != len(index.annotation_ids):
            self._faults.append(f"{path}: annotation ids must be unique and above 0")
        return index


def _is_mask(segmentation: Any, mask: NDArray[np.bool_]) -> bool:
    """Whether a run-length encoding is that of an (H, W) mask.

    It is compared encoded: decoders trust the sizes and runs in a file, and may write beyond their memory.
    """
    if not isinstance(segmentation, dict) or segmentation.get("size") != list(mask.shape):
        return False
    runs = segmentation.get("counts")
    if isinstance(runs, list):
        if not all(type(run) is int and 0 <= run <= mask.size for run in runs) or sum(runs) != mask.size:
            return False
        runs = pycocotools.mask.frPyObjects(segmentation, *mask.shape)["counts"].decode("ascii")
    return bool(runs == pycocotools.mask.encode(np.asfortranarray(mask, dtype=np.uint8))["counts"].decode("ascii"))


def _annotation_faults(annotation: dict[str, Any], record: PairRecord, eye: Eye) -> list[str]:
    view = view_of(record, eye)
    faults = []
    box = np.array(view.box_visible_xywh_px) + np.array([0.5, 0.5, 0.0, 0.0])
    if np.abs(np.array(annotation["bbox"]) - box).max() > _TOLERANCE_PX:
        faults.append(f"bbox: is {annotation['bbox']}, the record gives {box.tolist()}")
    if annotation["area"] != view.visible_drogue_px:
        faults.append(f"area: is {annotation['area']}, the record gives {view.visible_drogue_px}")
    points = np.array(annotation["keypoints"], dtype=np.float64).reshape(-1, 3)
    shown = points[:, 2] > 0
    if len(points) < len(view.markers) or shown[len(view.markers) :].any():
        return [*faults, f"keypoints: {len(points)} do not fit the record's {len(view.markers)} markers"]
    centers = np.zeros((len(points), 2))
    centers[: len(view.markers)] = np.reshape([marker.center_proj_px for marker in view.markers], (-1, 2)) + 0.5
    if np.abs(points[shown, :2] - centers[shown]).max(initial=0.0) > _TOLERANCE_PX or points[~shown].any():
        faults.append("keypoints: differ from the record's markers")
    if annotation["num_keypoints"] != int(shown.sum()):
        faults.append(f"num_keypoints: is {annotation['num_keypoints']}, {int(shown.sum())} are labelled")
    return faults


# A unit vector in float32, turned by a rotation in float32.
_UNIT_TOLERANCE = 1e-5

Plane = NDArray[np.float32]


def passes_faults(dataset: Dataset, record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> list[str] | None:
    """Faults of the passes of one eye, or None where the pair has none.

    Args:
        dataset: that holds the pair.
        record: of the pair; its hashes must have been checked, as changed files must not reach the decoder.
        eye: which eye.
        part_id: (H, W) part ids of the PNG file.
    """
    name = passes_file(eye)
    if name not in record.file_sha256:
        return None
    try:
        data = dataset.frames.read(record.frame_index, name)
        planes = read_passes(data, name, record.frame.rig.camera)
    except ValueError as error:
        return [str(error)]
    faults = []
    if not np.array_equal(planes["id.X"], part_id.astype(np.float32)):
        count = int(np.count_nonzero(planes["id.X"] != part_id))
        faults.append(f"id.X: {count} pixels differ from the part ids")
    if not all(np.isfinite(planes[channel]).all() and (planes[channel] >= 0).all() for channel in "RGB"):
        faults.append("R, G, B: must be finite and not negative")
    return [
        f"{name}: {fault}"
        for fault in [
            *faults,
            *_surface_faults(planes, part_id),
            *_feature_faults(record, eye, planes["depth.Z"], part_id),
        ]
    ]


def _surface_faults(planes: dict[str, Plane], part_id: NDArray[np.uint8]) -> list[str]:
    """Faults of depth and normals, of surfaces and of the sky."""
    faults = []
    depth, sky = planes["depth.Z"], part_id == Part.SKY
    if not np.isposinf(depth[sky]).all() or not (np.isfinite(depth[~sky]) & (depth[~sky] > 0)).all():
        faults.append("depth.Z: must be infinite for the sky and finite and above 0 elsewhere")
    length = np.sqrt(sum(planes[f"normal.{axis}"].astype(np.float64) ** 2 for axis in "XYZ"))
    if np.abs(length - ~sky).max(initial=0.0) > _UNIT_TOLERANCE:
        faults.append("normal: must be 0 for the sky and of length 1 elsewhere")
    return faults


def _feature_faults(record: PairRecord, eye: Eye, depth_m: Plane, part_id: NDArray[np.uint8]) -> list[str]:
    """Faults of markers and hub against the planes that follow from the pose."""
    pose, drogue = record.left_from_drogue, record.frame.drogue
    if pose is None or drogue is None:
        return []
    layout, pixels = marker_layout(drogue), FeaturePixels(part_id)
    return [
        f"{name}: {fault}"
        for name, _, disc in named_features(record, layout, pose, eye)
        for fault in check_feature_pixels(disc, layout.hub_inner_radius_m if name == "hub" else 0.0, depth_m, pixels)
    ]
