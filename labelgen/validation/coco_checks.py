"""Checks a dataset's COCO files, read with pycocotools, against its records."""

from __future__ import annotations

import contextlib
import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools.coco import COCO

from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.records import PairRecord
from drogue_models.parts import drogue_part_ids
from geometry.stereo import EYES, Eye
from labelgen.export.coco import DROGUE, coco_image_id
from labelgen.export.keypoints import view_of

# COCO's boxes and keypoints are the records' numbers plus a half, rounded at most once.
_TOLERANCE_PX = 1e-9


class CocoFiles:
    """`all.json` and the file of every split that has pairs, in memory."""

    def __init__(self, dataset: Location, manifest: Manifest) -> None:
        """Read all files; those that cannot be read become faults."""
        self._faults: list[str] = []
        self._storage = open_storage(dataset)
        self._path = self._storage.where(f"{ANNOTATIONS_FOLDER}/all.json")
        wanted: dict[str, set[int]] = {"all": set()}
        for entry in manifest.frames:
            ids = {coco_image_id(entry.frame_index, eye) for eye in EYES}
            wanted["all"] |= ids
            wanted.setdefault(entry.split, set()).update(ids)
        self._all = self._load("all", wanted.pop("all"))
        for split, ids in sorted(wanted.items()):
            part = self._load(split, ids)
            if part is not None and self._all is not None:
                self._check_part(split, part)

    def faults(self) -> list[str]:
        """Faults of the files as a whole."""
        return self._faults

    def annotation_faults(self, record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> list[str]:
        """Faults of the annotation of one image in `all.json`."""
        image_id = coco_image_id(record.frame_index, eye)
        if self._all is None or image_id not in self._all.imgs:
            return []
        view = view_of(record, eye)
        where = f"{self._path}: image {image_id}"
        annotations = self._all.imgToAnns[image_id]
        if view.box_visible_xywh_px is None:
            return [f"{where}: has annotations, no drogue is visible"] if annotations else []
        if [annotation.get("category_id") for annotation in annotations] != [DROGUE]:
            return [f"{where}: must have one annotation, of the drogue, has {len(annotations)}"]
        annotation = annotations[0]
        try:
            faults = _annotation_faults(annotation, record, eye)
            mask = self._all.annToMask(annotation).astype(bool)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            return [f"{where}: annotation is invalid: {type(error).__name__} {error}"]
        if not np.array_equal(mask, np.isin(part_id, drogue_part_ids(len(view.markers)))):
            faults.append("segmentation: differs from the part ids")
        return [f"{where}: {fault}" for fault in faults]

    def _load(self, name: str, ids: set[int]) -> COCO | None:
        inside = f"{ANNOTATIONS_FOLDER}/{name}.json"
        path = self._storage.where(inside)
        try:
            with self._storage.local_copy(inside) as file:
                json.loads(file.read_bytes())
                # pycocotools reports its progress on standard output.
                with contextlib.redirect_stdout(io.StringIO()):
                    coco = COCO(str(file))
        except FileNotFoundError:
            self._faults.append(f"{path}: is missing")
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError, AssertionError) as error:
            self._faults.append(f"{path}: is truncated or not a COCO file: {error}")
            return None
        if set(coco.imgs) != ids:
            self._faults.append(f"{path}: has {len(coco.imgs)} images, its pairs have {len(ids)}")
        if 0 in coco.anns or len(coco.anns) != len(coco.dataset["annotations"]):
            self._faults.append(f"{path}: annotation ids must be unique and above 0")
        return coco

    def _check_part(self, split: str, part: COCO) -> None:
        """Check that a split's file agrees with `all.json`."""
        assert self._all is not None
        whole: dict[int, Any] = self._all.imgs
        same = all(whole.get(key) == image for key, image in part.imgs.items())
        same = same and all(self._all.anns.get(key) == annotation for key, annotation in part.anns.items())
        same = same and len(part.anns) == sum(len(self._all.imgToAnns[key]) for key in part.imgs if key in whole)
        if not same:
            path = self._storage.where(f"{ANNOTATIONS_FOLDER}/{split}.json")
            self._faults.append(f"{path}: differs from all.json")


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
    centers[: len(view.markers)] = np.array([marker.center_proj_px for marker in view.markers]) + 0.5
    if np.abs(points[shown, :2] - centers[shown]).max(initial=0.0) > _TOLERANCE_PX or points[~shown].any():
        faults.append("keypoints: differ from the record's markers")
    if annotation["num_keypoints"] != int(shown.sum()):
        faults.append(f"num_keypoints: is {annotation['num_keypoints']}, {int(shown.sum())} are labelled")
    return faults
