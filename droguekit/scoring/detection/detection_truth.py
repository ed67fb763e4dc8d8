"""The boxes that a detector should find in every image of a dataset.

The box to be found goes around the drogue's visible pixels. A drogue of which too little is seen is *ignored*: neither
finding nor missing it counts; and so is one beside the sought drogue that looks very small. `scored_boxes` leaves out
the boxes on such a drogue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from datasets_manifest.storage.blind import read_blind_index
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.records import PairRecord, PixelBox
from droguekit.scoring.blind_check import blind_scenes
from droguekit.scoring.poses.drogue_truth import LEAST_SEEN_FRACTION, seen_fraction
from droguekit.scoring.results.detection_result import DetectedBox, clipped_box, corner_box, image_id_of
from droguekit.scoring.sequences.sequence_truth import TrueSequence, true_sequences, true_state
from geometry.boxes import intersection_over_union
from geometry.stereo import EYES, Eye

# A box of which at least this share lies in an ignored drogue's box belongs to it, unless it overlaps one that is to be
# found by as much: COCO's rules for crowds at IoU 0.5.
_LEAST_SHARE_INSIDE = _LEAST_OVERLAP = 0.5
# Longer side of another tanker's drogue over the image's height. The seed paper's camera sees 0.037 of it at 40 m, the
# farthest that a drogue is sought.
_LEAST_OTHER_SIDE_FRACTION = 0.025


@dataclass(frozen=True)
class ImageTruth:
    """One image.

    Boxes count from the image's corner, as in COCO files.

    Attributes:
        frame_index, eye: which image.
        scene_id, split, family: groups that it belongs to; the bootstrap draws whole scenes.
        distance_m: Z of the rim's centre in the left camera; None without a drogue, or where it is unknown. [m]
        box_xywh: to be found; None where there is nothing to find. [px]
        ignored_xywh: full box, clipped to the image, of a drogue that counts neither way. [px]
        is_known_empty: the truth says that there is no drogue in the pair.
        others_xywh: boxes of drogues beside the sought one, to be found too. [px]
        ignored_others_xywh: as `ignored_xywh`, of those. [px]
    """

    frame_index: int
    eye: Eye
    scene_id: int
    split: str
    family: str
    distance_m: float | None
    box_xywh: PixelBox | None
    ignored_xywh: PixelBox | None
    is_known_empty: bool
    others_xywh: tuple[PixelBox, ...] = ()
    ignored_others_xywh: tuple[PixelBox, ...] = ()

    @property
    def image_id(self) -> int:
        """As in the COCO files of the dataset."""
        return image_id_of(self.frame_index, self.eye)


@dataclass(frozen=True)
class DetectionTruth:
    """A dataset as detectors are scored on it.

    Attributes:
        name, sha256: of the dataset; an imported one has no hash.
        images: left before right of every pair.
        sequences: the same pairs as they follow each other, where they do.
    """

    name: str
    sha256: str | None
    images: tuple[ImageTruth, ...]
    sequences: tuple[TrueSequence, ...] = ()


def read_detection_truth(dataset: Location, faults: PairFaults | None = None) -> DetectionTruth:
    """What is to be found in a dataset: from its records, or from the boxes that came with imported images.

    Args:
        dataset: its folder or URL.
        faults: count pairs whose record is damaged, which are then left out; without, such a pair is an error.

    Raises:
        ValueError: no such dataset, a record that cannot be read, or an imported dataset without boxes.
    """
    if open_storage(dataset).exists(BLIND_FILE):
        return _given_truth(dataset)
    source = Dataset(dataset)
    camera = source.manifest.recipe.rig.camera
    size_px = (camera.width_px, camera.height_px)
    splits = source.manifest.split_of_frame()
    images, states = [], []
    for record in source.records(faults):
        images += [image_truth(record, eye, splits[record.frame_index], size_px) for eye in EYES]
        states.append(true_state(record))
    manifest = source.manifest
    return DetectionTruth(manifest.name, manifest.dataset_sha256, tuple(images), true_sequences(states))


def image_truth(record: PairRecord, eye: Eye, split: str, size_px: tuple[int, int]) -> ImageTruth:
    """What is to be found in one image of a pair.

    Args:
        record: of the pair.
        eye: which image.
        split: that the pair belongs to.
        size_px: (width, height) of the image.
    """
    view = record.views.left if eye == "left" else record.views.right
    box = ignored = None
    if view.box_full_xywh_px is not None:
        if view.box_visible_xywh_px is not None and seen_fraction(record, eye) >= LEAST_SEEN_FRACTION:
            box = corner_box(view.box_visible_xywh_px)
        else:
            ignored = clipped_box(corner_box(view.box_full_xywh_px), size_px)
    others, ignored_others = [], []
    for other in view.neighbours:
        full, visible = other.box_full_xywh_px, other.box_visible_xywh_px
        is_seen = visible is not None and visible[2] * visible[3] >= LEAST_SEEN_FRACTION * full[2] * full[3]
        if visible is not None and is_seen and max(full[2:]) >= _LEAST_OTHER_SIDE_FRACTION * size_px[1]:
            others.append(corner_box(visible))
        elif (clipped := clipped_box(corner_box(full), size_px)) is not None:
            ignored_others.append(clipped)
    return ImageTruth(
        frame_index=record.frame_index,
        eye=eye,
        scene_id=record.scene_id,
        split=split,
        family=record.conditions.family,
        distance_m=record.conditions.distance_m,
        box_xywh=box,
        ignored_xywh=ignored,
        is_known_empty=record.left_from_drogue is None,
        others_xywh=tuple(others),
        ignored_others_xywh=tuple(ignored_others),
    )


def scored_boxes(images: Sequence[ImageTruth], found: Sequence[DetectedBox]) -> list[DetectedBox]:
    """Those boxes on the given images that count: not on others, nor on an ignored drogue."""
    by_id = {image.image_id: image for image in images}
    return [box for box in found if box.image_id in by_id and not _is_ignored(box, by_id[box.image_id])]


def _is_ignored(box: DetectedBox, image: ImageTruth) -> bool:
    """Whether at least half of a box lies in the box of an ignored drogue, and it is on none that is to be found."""
    regions = (
        image.ignored_others_xywh if image.ignored_xywh is None else (image.ignored_xywh, *image.ignored_others_xywh)
    )
    if not any(_lies_in(box.box_xywh, region) for region in regions):
        return False
    sought = image.others_xywh if image.box_xywh is None else (image.box_xywh, *image.others_xywh)
    return not any(intersection_over_union(box.box_xywh, each) >= _LEAST_OVERLAP for each in sought)


def _lies_in(box_xywh: PixelBox, region: PixelBox) -> bool:
    """Whether at least half of a box lies in a region."""
    x, y, width, height = box_xywh
    common_x = min(x + width, region[0] + region[2]) - max(x, region[0])
    common_y = min(y + height, region[1] + region[3]) - max(y, region[1])
    return max(common_x, 0.0) * max(common_y, 0.0) >= _LEAST_SHARE_INSIDE * width * height


def _given_truth(dataset: Location) -> DetectionTruth:
    """Boxes that came with imported images; an image without one may show a drogue, so it is left out."""
    index = read_blind_index(dataset)
    images = [
        ImageTruth(
            frame_index=frame,
            eye=eye,
            # Scenes are unknown, so every pair counts as one.
            scene_id=frame,
            split="all",
            family="imported",
            distance_m=None,
            box_xywh=corner_box(box_px),
            ignored_xywh=None,
            is_known_empty=False,
        )
        for frame, scene in blind_scenes(dataset, index).items()
        for eye, box_px in scene.boxes.items()
    ]
    if not images:
        raise ValueError(f"{dataset}: has no boxes to compare with; import it with --boxes")
    return DetectionTruth(index.name, None, tuple(images))
