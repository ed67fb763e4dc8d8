"""Pictures of what a detector did: found by family and distance, the worst misses, the worst false alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PixelBox
from droguekit.benchmark.detection.detection_matching import AT_50, Matches
from droguekit.benchmark.detection.detection_truth import ImageTruth
from droguekit.benchmark.report.label_drawing import (
    BOX_RGB,
    MARKER_RGB,
    Picture,
    Rgb,
    display_picture,
    draw_box,
    resized,
)
from droguekit.benchmark.report.label_thumbnails import (
    ENLARGE_BELOW,
    TILE_WIDTH_PX,
    Tile,
    enlarged_surroundings,
    put_in_far_corner,
    spread,
    tile_of,
)
from droguekit.benchmark.report.number_text import plain_number
from droguekit.benchmark.results.detection_boxes import FoundBox, center_box

_FOUND_OF_A_FAMILY = 4
_MOST_FAULTS = 8


class PictureGroup(NamedTuple):
    """Pictures under one heading, with their captions."""

    title: str
    tiles: list[tuple[Tile, str]]


class Shown(NamedTuple):
    """An image to be shown.

    Attributes:
        image: with its true box.
        box: that is drawn in besides, None where nothing was found.
        is_miss: the box is the best one of an image whose drogue was not found.
    """

    image: ImageTruth
    box: FoundBox | None
    is_miss: bool = False


def detection_pictures(dataset: Location, matches: Matches, threshold: float) -> list[PictureGroup]:
    """Groups of pictures; those without any are left out.

    Args:
        dataset: the dataset's folder or URL.
        matches: of one detector.
        threshold: from which score a box counts.

    Raises:
        ValueError: an image cannot be read; names the file.
    """
    found = found_images(matches, threshold)
    chosen = [
        *((f"Found: {family}", shown) for family, shown in _by_family(found)),
        ("Worst misses", worst_misses(matches, threshold)),
        ("Worst false alarms", worst_false_alarms(matches, threshold)),
    ]
    source = BlindDataset(dataset)
    return [PictureGroup(title, [_tile(source, one) for one in shown]) for title, shown in chosen if shown]


def found_images(matches: Matches, threshold: float) -> list[Shown]:
    """Drogues that were found, in the order of the images."""
    right = matches.is_true[AT_50] & (matches.score >= threshold)
    places = sorted(np.flatnonzero(right).tolist(), key=lambda k: int(matches.image[k]))
    return [Shown(matches.images[matches.image[k]], matches.box[k]) for k in places]


def worst_misses(matches: Matches, threshold: float) -> list[Shown]:
    """Drogues that were not found, the largest first, each with the best box of its image if there is one."""
    missed = np.flatnonzero(matches.has_drogue & (matches.found_scores() < threshold)).tolist()
    missed.sort(key=lambda k: -_area(matches.images[k].box_xywh))
    best = {int(image): box for image, box in zip(matches.image[::-1], matches.box[::-1], strict=True)}
    return [Shown(matches.images[k], best.get(k), is_miss=True) for k in missed[:_MOST_FAULTS]]


def worst_false_alarms(matches: Matches, threshold: float) -> list[Shown]:
    """Boxes that are no drogue, the highest score first."""
    wrong = np.flatnonzero(~matches.is_true[AT_50] & (matches.score >= threshold))
    return [Shown(matches.images[matches.image[k]], matches.box[k]) for k in wrong[:_MOST_FAULTS].tolist()]


def _by_family(found: Sequence[Shown]) -> list[tuple[str, list[Shown]]]:
    """A few of each family, spread over distance, near ones first."""
    families = []
    for family in sorted({shown.image.family for shown in found}):
        members = sorted(
            (shown for shown in found if shown.image.family == family), key=lambda shown: shown.image.distance_m or 0.0
        )
        families.append((family, [members[k] for k in spread(len(members), _FOUND_OF_A_FAMILY)]))
    return families


def _area(box: PixelBox | None) -> float:
    return 0.0 if box is None else box[2] * box[3]


def _tile(source: BlindDataset, shown: Shown) -> tuple[Tile, str]:
    images = source.pair(shown.image.frame_index).images
    if shown.image.eye == "right":
        images = replace(images, left=images.right, right=images.left)
    true, found = shown.image.box_xywh, None if shown.box is None else shown.box.box_xywh
    enlarged = true if shown.is_miss else found
    picture = detection_picture(display_picture(images), [(true, BOX_RGB), (found, MARKER_RGB)], enlarged)
    return tile_of(shown.image.frame_index, shown.image.distance_m or 0.0, picture), _caption(shown)


def detection_picture(
    picture: Picture, boxes: Sequence[tuple[PixelBox | None, Rgb]], enlarged: PixelBox | None
) -> Picture:
    """A small copy of an image with boxes drawn in.

    Args:
        picture: (H, W, 3) the image.
        boxes: each with its colour, counted from the image's corner; None draws nothing. [px]
        enlarged: the one whose surroundings are shown once more in a corner if it is small, or None. [px]
    """
    tile, scale = resized(picture, TILE_WIDTH_PX)
    drawn = [(center_box(box), color) for box, color in boxes if box is not None]
    for box, color in drawn:
        draw_box(tile, box, scale, color=color)
    if enlarged is not None and max(enlarged[2] / picture.shape[1], enlarged[3] / picture.shape[0]) < ENLARGE_BELOW:
        x, y, width, height = center_box(enlarged)
        # A little wider, so that a box stands apart from the inset's frame.
        wide = (x - 0.1 * width, y - 0.1 * height, 1.2 * width, 1.2 * height)
        inset, larger, corner = enlarged_surroundings(picture, wide, tile.shape[0])
        for box, color in drawn:
            draw_box(inset, box, larger, corner, color)
        put_in_far_corner(tile, inset, (x + width / 2) / picture.shape[1], (y + height / 2) / picture.shape[0])
    return tile


def _caption(shown: Shown) -> str:
    image, box, is_miss = shown
    parts = [f"Frame {image.frame_index} {image.eye}, {image.family}"]
    parts.append(f"{plain_number(image.distance_m)} m" if image.distance_m is not None else "no drogue")
    if box is None:
        parts.append("nothing found")
    else:
        parts.append(f"the best box scores {box.score:.2f}" if is_miss else f"score {box.score:.2f}")
    return ", ".join(parts)
