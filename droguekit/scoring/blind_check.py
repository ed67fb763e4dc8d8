"""Estimates without a true pose: do they agree with their own measurements, and with boxes? Numbers and page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.blind import BlindDataset, BlindIndex, read_blind_index
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER
from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.reader import read_sought_drogue
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from datasets_manifest.types.records import PixelBox
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from drogue_models.untrusted_files import parse_json
from droguekit.scoring.poses.centroid_errors import feature_places
from droguekit.scoring.poses.cramer_rao import feature_points
from droguekit.scoring.poses.pose_errors import estimates_by_method
from droguekit.scoring.report.html_page import RowGroup, Table, page_template
from droguekit.scoring.report.label_drawing import Tile, display_picture, evenly_spaced, label_picture, tile_of
from droguekit.scoring.report.number_text import percent, plain_number, three_digits
from droguekit.scoring.results.pose_result import ResultModel
from geometry.boxes import intersection_over_union
from geometry.circles import disc_image_centers, disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig

# Enough corners that the box around the rim is right to a hundredth of its width.
_RIM_POINTS = 64
# Nearer than this to the plane of the eyes, a point has no image. [m]
_LEAST_DEPTH_M = 1e-6


class BlindFacts(ResultModel):
    """The dataset that was checked."""

    name: str
    pairs: int


class BlindRow(ResultModel):
    """One method.

    Attributes:
        n, fixes, fix_fraction: pairs, and those of them with a pose.
        residual_rms_px: of the centroids that the poses were computed from, each coordinate; without those of poses
            that are not wholly in front of the cameras, which are in no box either; None without any. [px]
        boxes: views of pairs with a pose that have a box.
        middle_in_box_fraction: share of these whose box holds the middle of the rim; None without any.
        rim_box_iou_median: intersection over union of the box and the one around the rim; None without any.
    """

    n: int
    fixes: int
    fix_fraction: float
    residual_rms_px: float | None
    boxes: int
    middle_in_box_fraction: float | None
    rim_box_iou_median: float | None


class BlindCheck(ResultModel):
    """The result for a dataset without true poses."""

    schema_version: Literal[1] = Field(default=1, alias="schema")
    truth: Literal["none"] = "none"
    dataset: BlindFacts
    code_version: str
    methods: dict[str, BlindRow]

    def to_json(self) -> str:
        """The text of the file."""
        return json.dumps(self.model_dump(mode="json", by_alias=True), indent=1, allow_nan=False) + "\n"


class BlindScene(NamedTuple):
    """The known data of a pair: cameras, drogue, and the box of each view that has one."""

    rig: StereoRig
    drogue: DrogueParameters
    boxes: Mapping[Eye, PixelBox]


def check_blind(dataset: Location, estimates: Path, faults: PairFaults | None = None) -> BlindCheck:
    """Check every method of a file of estimates on a dataset without truth.

    Args:
        dataset: the dataset's folder.
        estimates: of any number of methods.
        faults: count damaged pairs, which are left out; without, such a pair is an error.

    Raises:
        ValueError: the dataset, all of its pairs or the file cannot be read, or the file names pairs or features that
            the dataset lacks.
    """
    index = read_blind_index(dataset)
    methods = estimates_by_method(read_estimates(estimates), index.frames, str(estimates))
    scenes = blind_scenes(dataset, index, faults)
    if not scenes and faults is not None:
        raise ValueError(f"{dataset}: no pair can be read, so there is nothing to check: {faults.line()}")
    return BlindCheck(
        dataset=BlindFacts(name=index.name, pairs=len(index.frames)),
        code_version=version("droguekit"),
        methods={
            name: _row({i: estimate for i, estimate in found.items() if i in scenes}, scenes, estimates)
            for name, found in methods.items()
        },
    )


def blind_scenes(dataset: Location, index: BlindIndex, faults: PairFaults | None = None) -> dict[int, BlindScene]:
    """The known data of each pair; of whole ones only where `faults` counts the others.

    Raises:
        ValueError: a pair or the boxes cannot be read; names the file.
    """
    boxes, frames = _read_boxes(dataset), FrameStore(dataset)

    def sought(frame: int) -> DrogueParameters:
        return read_sought_drogue(frames, frame, index.drogue) if index.drogues_differ else index.drogue

    scenes = {}
    for frame in index.frames:
        drogue = read_or_note(frame, sought, faults)
        if drogue is None:
            continue
        given = {eye: boxes[2 * frame + view + 1] for view, eye in enumerate(EYES) if 2 * frame + view + 1 in boxes}
        scenes[frame] = BlindScene(index.rig, drogue, given)
    return scenes


def marker_images_px(scene: BlindScene, left_from_drogue: RigidTransform, eye: Eye) -> Array:
    """(M, 2) where a pose puts the markers' centroids, then the hub's if there is one, in the delivered image. [px]"""
    centers, radii = feature_points(marker_layout(scene.drogue))
    return disc_image_centers(scene.rig, left_from_drogue, centers, radii, eye)


def rim_box_px(scene: BlindScene, left_from_drogue: RigidTransform, eye: Eye) -> PixelBox:
    """The box around the rim in the delivered image, where a pose puts it."""
    outline = disc_outline(left_from_drogue, np.zeros(3), scene.drogue.rim_radius_m, _RIM_POINTS)
    places = scene.rig.image(outline, eye)
    low, high = places.min(axis=0), places.max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1]))


def _is_in_front(scene: BlindScene, left_from_drogue: RigidTransform) -> bool:
    """Whether the rim and all features lie in front of the cameras, which have their images only there."""
    centers, radii = feature_points(marker_layout(scene.drogue))
    centers, radii = np.vstack([centers, np.zeros(3)]), np.append(radii, scene.drogue.rim_radius_m)
    depths_m = disc_outline(left_from_drogue, centers, radii, _RIM_POINTS)[..., 2]
    return bool((depths_m > _LEAST_DEPTH_M).all())


def _row(estimates: Mapping[int, Estimate], scenes: Mapping[int, BlindScene], source: Path) -> BlindRow:
    fixes = {frame: e for frame, e in estimates.items() if isinstance(e, PoseEstimate)}
    residuals, inside, overlaps = list[float](), list[bool](), list[float]()
    for frame, estimate in fixes.items():
        scene, pose = scenes[frame], estimate.left_from_drogue
        in_front = _is_in_front(scene, pose)
        residuals += _residuals_px(estimate, scene, source) if in_front else []
        for eye, given in scene.boxes.items():
            rim = rim_box_px(scene, pose, eye) if in_front else None
            inside.append(rim is not None and _holds_center(given, rim))
            overlaps.append(0.0 if rim is None else float(intersection_over_union(given, rim)))
    return BlindRow(
        n=len(scenes),
        fixes=len(fixes),
        fix_fraction=len(fixes) / len(scenes),
        residual_rms_px=float(np.sqrt(np.mean(np.square(residuals)))) if residuals else None,
        boxes=len(inside),
        middle_in_box_fraction=float(np.mean(inside)) if inside else None,
        rim_box_iou_median=float(np.median(overlaps)) if overlaps else None,
    )


def _residuals_px(estimate: PoseEstimate, scene: BlindScene, source: Path) -> Iterator[float]:
    """Measured minus expected, both coordinates of every feature that the pose was computed from."""
    layout = marker_layout(scene.drogue)
    for eye in EYES:
        used = [feature for feature in estimate.features if feature.eye == eye and feature.used]
        try:
            places = feature_places(layout, used)
        except ValueError as error:
            where = f"{source}: method {estimate.method!r}: frame {estimate.frame_index}"
            raise ValueError(f"{where}: {error}") from error
        expected = marker_images_px(scene, estimate.left_from_drogue, eye)
        for feature, place in zip(used, places, strict=True):
            yield from (np.array(feature.center_px) - expected[place]).tolist()


def _holds_center(box: PixelBox, rim: PixelBox) -> bool:
    x, y = rim[0] + rim[2] / 2, rim[1] + rim[3] / 2
    return box[0] <= x <= box[0] + box[2] and box[1] <= y <= box[1] + box[3]


def _read_boxes(dataset: Location) -> dict[int, PixelBox]:
    """Boxes by image id, in pixel-centre coordinates; none where the dataset has no annotations."""
    storage, name = open_storage(dataset), f"{ANNOTATIONS_FOLDER}/all.json"
    if not storage.exists(name):
        return {}
    try:
        table = parse_json(storage.read(name))
        boxes = {}
        for annotation in table["annotations"]:
            x, y, width, height = (float(number) for number in annotation["bbox"])
            # COCO counts from the image's corner.
            boxes[int(annotation["image_id"])] = (x - 0.5, y - 0.5, width, height)
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"{storage.where(name)}: holds no COCO boxes that can be read: {error}") from error
    return boxes


COLUMNS = ("pose found", "residual [px]", "views with a box", "middle in box", "overlap")
_MOST_TILES = 12


def row_cells(check: BlindCheck, method: str) -> list[str]:
    """A method's numbers as text, in the order of `COLUMNS`."""
    row = check.methods[method]
    return [
        percent(row.fix_fraction),
        three_digits(row.residual_rms_px),
        str(row.boxes),
        percent(row.middle_in_box_fraction),
        three_digits(row.rim_box_iou_median),
    ]


def write_blind_report(
    dataset: Location, estimates: Path, check: BlindCheck, out_html: Path, faults: PairFaults | None = None
) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Raises:
        ValueError: dataset or estimates cannot be read.
        OSError: the page cannot be written.
    """
    # The method with the most poses shows what was found; the first of the file among equals.
    shown_method = max(check.methods, key=lambda name: check.methods[name].fixes)
    rows = [[name, *row_cells(check, name)] for name in check.methods]
    page = page_template("blind_report.html.j2").render(
        check=check,
        table=Table("methods", "", list(COLUMNS), [RowGroup("", rows)], first=None),
        shown_method=shown_method,
        tiles=_tiles(dataset, estimates, shown_method, faults),
    )
    write_text_atomic(out_html, page)


def _tiles(dataset: Location, estimates: Path, method: str, faults: PairFaults | None) -> list[tuple[Tile, str]]:
    """Left images of some pairs with the pose of a method drawn in, and their captions."""
    index, source = read_blind_index(dataset), BlindDataset(dataset)
    scenes = blind_scenes(dataset, index, faults)
    poses = {
        e.frame_index: e.left_from_drogue
        for e in read_estimates(estimates)
        if e.method == method and isinstance(e, PoseEstimate)
    }
    frames = [index.frames[place] for place in evenly_spaced(len(index.frames), _MOST_TILES)]
    tiles = []
    for frame in frames:
        pair = read_or_note(frame, source.pair, faults)
        if pair is None or frame not in scenes:
            continue
        scene, pose = scenes[frame], poses.get(frame)
        box = scene.boxes.get("left")
        centers: list[tuple[float, float]] = []
        distance_m, caption = 0.0, f"Frame {frame}, no pose"
        if pose is not None and not _is_in_front(scene, pose):
            caption = f"Frame {frame}, pose not in front of the cameras"
        elif pose is not None:
            box = box or rim_box_px(scene, pose, "left")
            centers = [(float(x), float(y)) for x, y in marker_images_px(scene, pose, "left")]
            distance_m = float(pose.translation_m[2])
            caption = f"Frame {frame}, {plain_number(distance_m)} m"
        picture = label_picture(display_picture(pair.images), box, centers)
        tiles.append((tile_of(frame, distance_m, picture), caption))
    return tiles
