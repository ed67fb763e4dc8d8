"""The detector benchmark as one HTML page that needs nothing from outside: no network, no script, no other file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PixelBox
from droguekit.scoring.detection.detection_figures import (
    MEASURES,
    curve_panel,
    distance_panel,
    is_timed,
    score_panel,
    size_panel,
    speed_panel,
)
from droguekit.scoring.detection.detection_metrics import AT_50, Matches
from droguekit.scoring.detection.detection_scores import LEAST_BOXES, LEAST_SCENES, ScoredDetections
from droguekit.scoring.detection.detection_tables import (
    cell_tables,
    percent_text,
    summary_table,
)
from droguekit.scoring.detection.detection_truth import ImageTruth
from droguekit.scoring.report.figures import legend_key, method_styles
from droguekit.scoring.report.html_page import page_template
from droguekit.scoring.report.label_drawing import (
    BOX_RGB,
    ENLARGE_BELOW,
    MARKER_RGB,
    TILE_WIDTH_PX,
    Picture,
    Rgb,
    Tile,
    display_picture,
    draw_box,
    enlarged_surroundings,
    evenly_spaced,
    put_in_far_corner,
    resized,
    tile_of,
)
from droguekit.scoring.report.number_text import plain_number
from droguekit.scoring.report.sequence_report import tracking_part
from droguekit.scoring.results.detection_result import DetectedBox, DetectionResult, center_box

_FOUND_OF_A_FAMILY = 4
_MOST_FAULTS = 8


class PictureGroup(NamedTuple):
    """Pictures under one heading, with their captions."""

    title: str
    tiles: list[tuple[Tile, str]]


class PicturedImage(NamedTuple):
    """An image for the page.

    Attributes:
        image: with its true box.
        box: found box to draw, None where nothing was found.
        is_miss: the box is the best one of an image whose drogue was not found.
    """

    image: ImageTruth
    box: DetectedBox | None
    is_miss: bool = False


def write_detection_report(
    dataset: Location, scored: ScoredDetections, out_html: Path, faults: PairFaults | None = None
) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        dataset: the dataset's folder or URL, for pictures.
        scored: the result of `score_detections`.
        out_html: where to write.
        faults: count pairs whose picture cannot be shown; without, such a pair is an error.

    Raises:
        ValueError: an image cannot be read.
        OSError: the page cannot be written.
    """
    result = scored.result
    matches = {name: evaluation.matches(scored.images) for name, evaluation in scored.evaluations.items()}
    thresholds = {name: detector.operating_threshold for name, detector in result.detectors.items()}
    best = best_detector(result)
    styles = method_styles(list(matches))
    histograms = [
        Markup(panel(name, number, matches[name], thresholds[name]))
        for number, name in enumerate(matches)
        for panel in (score_panel, size_panel)
    ]
    page = page_template("detection_report.html.j2").render(
        result=result,
        sentences=detection_sentences(result, best),
        facts=detection_facts(result),
        summary=summary_table(result),
        tables=cell_tables(result),
        legend=[(name, Markup(legend_key(style))) for name, style in styles.items()],
        distance_panels=[Markup(distance_panel(scored, measure)) for measure in MEASURES if _has_distances(result)],
        curve=Markup(curve_panel(matches)),
        speed=Markup(speed_panel(result)) if is_timed(result) else None,
        histograms=histograms,
        tracking=tracking_part(
            {name: d.sequences for name, d in result.detectors.items() if d.sequences is not None}, "detector", styles
        ),
        pictured=best,
        pictures=detection_pictures(dataset, matches[best], thresholds[best], faults),
        least=(LEAST_BOXES, LEAST_SCENES),
    )
    write_text_atomic(out_html, page)


def best_detector(result: DetectionResult) -> str:
    """The name of the one with the highest AP, the first among equals."""
    return max(result.detectors, key=lambda name: result.detectors[name].overall.ap or 0.0)


def detection_sentences(result: DetectionResult, name: str) -> list[str]:
    """The result in sentences."""
    data, detector = result.dataset, result.detectors[name]
    row, alarms = detector.overall, detector.false_alarms
    images = (
        f"{data.images} images of {data.name}"
        if data.split == "all"
        else f"the {data.images} images of split {data.split}"
    )
    chosen = {
        "given": "which was given",
        "detector": "which is its own threshold",
        "val": "which is the best one on split val",
        "scored images": "which is the best one on these same images",
    }
    scenes = "1 scene" if row.scenes == 1 else f"{row.scenes} scenes"
    sentences = [
        f"On {images}, with {data.boxes} drogues of {scenes} to be found, "
        f"{name} reaches an AP50 of {percent_text(row.ap50)} and an AP of {percent_text(row.ap)}.",
        f"With a score of {plain_number(detector.operating_threshold)} or more, {chosen[detector.threshold_from]}, "
        f"it finds {percent_text(row.recall)} of the drogues, and "
        + ("reports no box." if row.precision is None else f"{percent_text(row.precision)} of its boxes are right."),
    ]
    if alarms is not None:
        sentences.append(f"In {alarms.frames} pairs without a drogue it sees {alarms.boxes}.")
    return sentences


def detection_pictures(
    dataset: Location, matches: Matches, threshold: float, faults: PairFaults | None = None
) -> list[PictureGroup]:
    """Groups of pictures; those without any are left out.

    Args:
        dataset: the dataset's folder or URL.
        matches: of one detector.
        threshold: from which score a box counts.
        faults: as for `write_detection_report`.

    Raises:
        ValueError: an image cannot be read, and nothing counts faults; names the file.
    """
    found = found_images(matches, threshold)
    chosen = [
        *((f"Found: {family}", shown) for family, shown in _by_family(found)),
        ("Worst misses", worst_misses(matches, threshold)),
        ("Worst false alarms", worst_false_alarms(matches, threshold)),
    ]
    source = BlindDataset(dataset)
    groups = ((title, [_tile(source, one, faults) for one in shown]) for title, shown in chosen)
    shown_groups = ((title, [tile for tile in tiles if tile is not None]) for title, tiles in groups)
    return [PictureGroup(title, tiles) for title, tiles in shown_groups if tiles]


def found_images(matches: Matches, threshold: float) -> list[PicturedImage]:
    """Drogues that were found, in the order of the images."""
    right = matches.is_true[AT_50] & (matches.score >= threshold)
    places = sorted(np.flatnonzero(right).tolist(), key=lambda k: int(matches.image[k]))
    return [PicturedImage(matches.images[matches.image[k]], matches.box[k]) for k in places]


def worst_misses(matches: Matches, threshold: float) -> list[PicturedImage]:
    """Drogues that were not found, the largest first, each with the best box of its image if there is one."""
    missed = np.flatnonzero(matches.has_drogue & (matches.found_scores() < threshold)).tolist()
    missed.sort(key=lambda k: -_area(matches.images[k].box_xywh))
    best = {int(image): box for image, box in zip(matches.image[::-1], matches.box[::-1], strict=True)}
    return [PicturedImage(matches.images[k], best.get(k), is_miss=True) for k in missed[:_MOST_FAULTS]]


def worst_false_alarms(matches: Matches, threshold: float) -> list[PicturedImage]:
    """Boxes that are no drogue, the highest score first."""
    wrong = np.flatnonzero(~matches.is_true[AT_50] & (matches.score >= threshold))
    return [PicturedImage(matches.images[matches.image[k]], matches.box[k]) for k in wrong[:_MOST_FAULTS].tolist()]


def _by_family(found: Sequence[PicturedImage]) -> list[tuple[str, list[PicturedImage]]]:
    """A few of each family, spread over distance, near ones first."""
    families = []
    for family in sorted({shown.image.family for shown in found}):
        members = sorted(
            (shown for shown in found if shown.image.family == family), key=lambda shown: shown.image.distance_m or 0.0
        )
        families.append((family, [members[k] for k in evenly_spaced(len(members), _FOUND_OF_A_FAMILY)]))
    return families


def _area(box: PixelBox | None) -> float:
    return 0.0 if box is None else box[2] * box[3]


def _tile(source: BlindDataset, shown: PicturedImage, faults: PairFaults | None) -> tuple[Tile, str] | None:
    pair = read_or_note(shown.image.frame_index, source.pair, faults)
    if pair is None:
        return None
    images = pair.images
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
        # A little wider, so that a box is apart from the inset's frame.
        wide = (x - 0.1 * width, y - 0.1 * height, 1.2 * width, 1.2 * height)
        inset, larger, corner = enlarged_surroundings(picture, wide, tile.shape[0])
        for box, color in drawn:
            draw_box(inset, box, larger, corner, color)
        put_in_far_corner(tile, inset, (x + width / 2) / picture.shape[1], (y + height / 2) / picture.shape[0])
    return tile


def _caption(shown: PicturedImage) -> str:
    image, box, is_miss = shown
    parts = [f"Frame {image.frame_index} {image.eye}, {image.family}"]
    parts.append(f"{plain_number(image.distance_m)} m" if image.distance_m is not None else "no drogue")
    if box is None:
        parts.append("nothing found")
    else:
        parts.append(f"the best box scores {box.score:.2f}" if is_miss else f"score {box.score:.2f}")
    return ", ".join(parts)


def _has_distances(result: DetectionResult) -> bool:
    return any(detector.distances for detector in result.detectors.values())


def detection_facts(result: DetectionResult) -> list[tuple[str, str]]:
    """Facts of the dataset and the thresholds, as pairs of a name and a value."""
    data = result.dataset
    thresholds = [
        f"{name} {plain_number(detector.operating_threshold)} ({detector.threshold_from})"
        for name, detector in result.detectors.items()
    ]
    return [
        ("Dataset", data.name),
        ("Content hash (SHA-256)", data.sha256 or "none, imported"),
        ("Split", data.split),
        ("Images", str(data.images)),
        ("Drogues to be found", str(data.boxes)),
        (
            "Drogues that count neither way",
            f"{data.ignored}, as less than {percent_text(result.least_seen_fraction)} of each is seen"
            if data.ignored
            else "none",
        ),
        ("Pairs without a drogue", str(data.empty_frames)),
        ("Operating thresholds", "; ".join(thresholds)),
    ]
