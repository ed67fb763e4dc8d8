"""What the page shows of each pair: a row of the catalogue, its labels as numbers, and its pictures."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2

from datasets_manifest.atomic import write_bytes_unsynced
from datasets_manifest.storage.blind import BlindDataset, read_blind_index
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import BLIND_FILE, image_file
from datasets_manifest.storage.manifest import FrameEntry
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.estimates import Estimate, PoseEstimate
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import FeatureView, PairRecord, PixelBox, ViewRecord
from drogue_models.parameters import DrogueParameters
from droguekit.scoring.poses.pose_errors import pose_error
from droguekit.scoring.report.label_drawing import Picture, display_picture, resized
from droguekit.scoring.report.number_text import plain_number
from droguekit.visualization.drogue_outlines import Ring, drogue_rings
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, StereoRig

# Our choice: night, dusk, a dull day's shade and a bright sky, by the luminance behind the drogue. [cd/m2]
LIGHTS = ("below 1 cd/m²", "1 to 100 cd/m²", "100 to 3000 cd/m²", "from 3000 cd/m²")
LIGHT_EDGES_CD_M2 = (1.0, 100.0, 3000.0)
PICTURE_KINDS = ("small", "left", "right")
_SMALL_WIDTH_PX = 240
_QUALITY, _SMALL_QUALITY = 85, 78
# A thousandth of a pixel is far below what a screen shows, and a page of thousands of pairs half as large.
_PX_DIGITS, _POSE_DIGITS = 3, 9
# The marker "end of image". Source: ITU-T T.81, B.1.1.3.
_JPEG_END = b"\xff\xd9"


def light_of(luminance_cd_m2: float) -> str:
    """The class of light that a background's luminance belongs to, one of `LIGHTS`. [cd/m2]"""
    return LIGHTS[sum(luminance_cd_m2 >= edge for edge in LIGHT_EDGES_CD_M2)]


def search_text(record: PairRecord, split: str) -> str:
    """Text that the page searches for a pair."""
    frame, sky = record.frame, record.frame.environment
    words = [record.conditions.family, split, f"scene {record.scene_id}", record.engine, sky.ground]
    words += [cloud.kind for cloud in sky.clouds]
    words += [kind for kind, there in (("mist", sky.mist), ("moon", sky.moon), ("map", sky.map)) if there is not None]
    words += [object_.kind for object_ in frame.bystanders]
    words += ["no drogue" if frame.drogue is None else frame.drogue.name]
    words += [] if frame.board is None else ["board"]
    return " ".join(words).lower()


def conditions_table(record: PairRecord, split: str) -> list[tuple[str, str]]:
    """Rows of name and value, the most important first."""
    frame, conditions = record.frame, record.conditions
    rows = [("Distance", "no drogue" if conditions.distance_m is None else f"{plain_number(conditions.distance_m)} m")]
    if record.pitch_deg is not None and record.yaw_deg is not None and record.roll_deg is not None:
        angles = (record.pitch_deg, record.yaw_deg, record.roll_deg)
        rows.append(("Pitch, yaw, roll", ", ".join(f"{plain_number(angle)}°" for angle in angles)))
    if frame.drogue is not None:
        rows.append(("Drogue", f"{frame.drogue.name}, {frame.drogue.marker_count} markers"))
    rows.append(("Family", conditions.family))
    rows.append(("Split, scene", f"{split}, {record.scene_id}"))
    if record.sequence_id is not None:
        rows.append(("Sequence, time", f"{record.sequence_id}, {record.time_s:.3f} s"))
    rows.append(("Background", f"{plain_number(conditions.background_luminance_cd_m2)} cd/m²"))
    rows += _sky(frame.environment, conditions.sun_elevation_deg)
    exposure = frame.exposure
    rows.append(
        ("Exposure", f"{plain_number(1e3 * exposure.time_s)} ms, f/{exposure.f_number:g}, gain {exposure.gain:g}")
    )
    rows += _objects(frame)
    noise = conditions.monte_carlo_noise_fraction
    rows.append(("Noise of the renderer", f"{plain_number(100 * noise)} % of the luminance"))
    rows.append(("Made by", record.engine_version))
    return rows


def _sky(sky: Environment, sun_elevation_deg: float | None) -> list[tuple[str, str]]:
    sun = "none"
    if sun_elevation_deg is not None:
        sun = f"{plain_number(sun_elevation_deg)}° high, azimuth {plain_number(sky.sun_azimuth_deg)}°"
    rows = [("Sun", sun)]
    if sky.map is not None:
        rows.append(("Surroundings", "a picture of sky and ground"))
        return rows
    rows.append(("Visibility", f"{plain_number(sky.visibility_m / 1e3)} km"))
    rows.append(("Clouds", ", ".join(cloud.kind for cloud in sky.clouds) or "none"))
    if sky.mist is not None:
        rows.append(("Mist", "around the camera"))
    if sky.moon is not None:
        rows.append(("Moon", "in the sky"))
    rows.append(("Ground", f"{sky.ground}, {plain_number(sky.altitude_m)} m below"))
    return rows


def _objects(frame: FrameSpec) -> list[tuple[str, str]]:
    rows = []
    if frame.bystanders:
        rows.append(("Also in view", ", ".join(object_.kind for object_ in frame.bystanders)))
    if frame.board is not None:
        rows.append(("Board", "for calibration, in the drogue's place"))
    if frame.rangefinder_reading_m is not None:
        rows.append(("Rangefinder", f"{plain_number(frame.rangefinder_reading_m)} m"))
    return rows


@dataclass(frozen=True)
class PageEntry:
    """What the page shows of a pair.

    Attributes:
        row: values by column of the catalogue.
        labels: content of the pair's own file.
        rings: circles of the drogue that is or would be in view; many pairs share them.
        left_from_drogue: true pose, or None.
    """

    row: dict[str, Any]
    labels: dict[str, Any]
    rings: tuple[Ring, ...]
    left_from_drogue: RigidTransform | None


def page_entry(record: PairRecord, drogue: DrogueParameters, split: str, record_sha256: str) -> PageEntry:
    """What the page shows of a pair without estimates.

    Args:
        record: truth of the pair.
        drogue: that is or would be in view.
        split: of the pair.
        record_sha256: also identifies the pair's pixels.
    """
    rings = drogue_rings(drogue)
    conditions, distance_m = record.conditions, record.conditions.distance_m
    row = {
        "frame": record.frame_index,
        "distance_m": None if distance_m is None else round(distance_m, 4),
        "family": conditions.family,
        "split": split,
        "sequence": record.sequence_id,
        "light": light_of(conditions.background_luminance_cd_m2),
        "text": search_text(record, split),
        "picture": picture_stem(record.frame_index, record_sha256),
        "box_px": _box(record.views.left.box_visible_xywh_px),
    }
    labels = {
        "pose": _pose(record.left_from_drogue),
        "drogue": rings_name(rings),
        "left": _view(record.views.left),
        "right": _view(record.views.right),
        "conditions": conditions_table(record, split),
    }
    return PageEntry(row, labels, rings, record.left_from_drogue)


def page_entry_without_truth(frame_index: int, time_s: float, rings: tuple[Ring, ...], pixels_sha256: str) -> PageEntry:
    """What the page shows of a pair without truth.

    Args:
        frame_index: of the pair.
        time_s: mid-exposure. [s]
        rings: circles of the drogue.
        pixels_sha256: identifies the images.
    """
    nothing: dict[str, Any] = {"box_full_px": None, "box_visible_px": None, "markers": [], "hub": None}
    view = nothing | {"board_corners_px": []}
    row: dict[str, Any] = dict.fromkeys(("distance_m", "family", "split", "sequence", "light", "box_px"))
    row |= {"frame": frame_index, "text": "", "picture": picture_stem(frame_index, pixels_sha256)}
    labels = {"pose": None, "drogue": rings_name(rings), "left": view, "right": view}
    return PageEntry(row, labels | {"conditions": [("Time", f"{time_s:.3f} s")]}, rings, None)


def with_estimates(entry: PageEntry, estimates: Sequence[Estimate | None]) -> PageEntry:
    """The entry with estimates of the pair: one for each method, None where a method has none."""
    truth = entry.left_from_drogue
    described = [None if estimate is None else _describe_estimate(estimate, truth) for estimate in estimates]
    row = entry.row | {"estimates": [_in_short(one) for one in described]}
    return replace(entry, row=row, labels=entry.labels | {"estimates": [one for one in described if one]})


def _in_short(described: dict[str, Any] | None) -> float | str | None:
    """Position error [mm], or `fix` without truth, or `no fix`; None without an estimate."""
    if described is None:
        return None
    if described["pose"] is None:
        return "no fix"
    # Without truth there is no error.
    return "fix" if described["error"] is None else float(described["error"][0])


def rings_name(rings: tuple[Ring, ...]) -> str:
    """A drogue's key in the catalogue."""
    return hashlib.sha256(repr(rings).encode()).hexdigest()[:12]


def picture_stem(frame_index: int, record_sha256: str) -> str:
    """Start of the names of a pair's pictures, which changes with its pixels."""
    return f"{frame_index:06d}-{record_sha256[:12]}"


def picture_files(folder: Path, stem: str) -> list[Path]:
    """Paths of a pair's pictures, in the order of `PICTURE_KINDS`."""
    return [folder / f"{stem}-{kind}.jpg" for kind in PICTURE_KINDS]


def is_whole_picture(path: Path) -> bool:
    """Whether a JPEG file exists and has its end, which a power failure may have cost it."""
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, size - len(_JPEG_END)))
            return stream.read() == _JPEG_END
    except OSError:
        return False


def write_pictures(files: Sequence[Path], images: StereoImages) -> None:
    """Write a pair's pictures in the sRGB curve.

    Raises:
        OSError: one cannot be written; names it.
    """
    left, right = display_picture(images), display_picture(replace(images, left=images.right, right=images.left))
    small, _ = resized(left, min(_SMALL_WIDTH_PX, left.shape[1]))
    for path, picture, quality in zip(files, (small, left, right), (_SMALL_QUALITY, _QUALITY, _QUALITY), strict=True):
        write_bytes_unsynced(path, _jpeg(picture, quality))


def _jpeg(picture: Picture, quality: int) -> bytes:
    # Full colour resolution keeps small red markers from bleeding into their dark face.
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    _, data = cv2.imencode(".jpg", picture[..., ::-1], options)
    return data.tobytes()


def _describe_estimate(estimate: Estimate, truth: RigidTransform | None) -> dict[str, Any]:
    pose = estimate.left_from_drogue if isinstance(estimate, PoseEstimate) else None
    error = None if pose is None or truth is None else pose_error(pose, truth)
    return {
        "method": estimate.method,
        "pose": _pose(pose),
        "reason": None if isinstance(estimate, PoseEstimate) else estimate.reason,
        # Position [mm], pitch and yaw [deg].
        "error": error and [_significant(1e3 * error.position_m), *map(_significant, error.components[3:])],
        "centroids": [
            [f.eye, str(f.index), *(round(c, _PX_DIGITS) for c in f.center_px), f.used] for f in estimate.features
        ],
    }


def _significant(value: float) -> float:
    """Five significant digits: an error may be of micrometres, and the page shows three."""
    return float(f"{value:.5g}")


def _pose(pose: RigidTransform | None) -> list[float] | None:
    """(12,) the upper three rows of the matrix."""
    return None if pose is None else [round(value, _POSE_DIGITS) for value in pose.as_matrix()[:3].ravel().tolist()]


def _view(view: ViewRecord) -> dict[str, Any]:
    return {
        "box_full_px": _box(view.box_full_xywh_px),
        "box_visible_px": _box(view.box_visible_xywh_px),
        "markers": [_feature(marker) for marker in view.markers],
        "hub": None if view.hub is None else _feature(view.hub),
        "board_corners_px": [[round(c, _PX_DIGITS) for c in corner] for corner in view.board_corners_px],
    }


def _feature(feature: FeatureView) -> list[float]:
    """x, y [px], visible fraction, signal-to-noise."""
    x_px, y_px = (round(c, _PX_DIGITS) for c in feature.center_ellipse_px)
    return [x_px, y_px, round(feature.visible_fraction, 3), round(feature.signal_to_noise, 1)]


def _box(box: PixelBox | None) -> list[float] | None:
    return None if box is None else [round(side, _PX_DIGITS) for side in box]


class PageFacts(NamedTuple):
    """The head of the page, and the cameras.

    Attributes:
        facts: sentences that describe the dataset.
        is_blind: whether it has no truth.
    """

    name: str
    facts: tuple[str, ...]
    rig: StereoRig
    is_blind: bool


class BrowsedPairs(Protocol):
    """A dataset's pairs by index; can be pickled for another process."""

    def facts(self) -> PageFacts:
        """The head of the page."""
        ...

    def frame_indices(self) -> tuple[int, ...]:
        """Indices of the pairs, ascending."""
        ...

    def entry(self, frame_index: int) -> PageEntry:
        """What the page shows of a pair; `ValueError` where it cannot be read."""
        ...

    def images(self, frame_index: int) -> StereoImages:
        """The images of a pair; `ValueError` where they cannot be read."""
        ...


def open_browsed_pairs(dataset: Location) -> BrowsedPairs:
    """The pairs of a dataset.

    Raises:
        ValueError: no dataset there, or one that cannot be trusted.
    """
    source: BrowsedPairs = (
        PairsWithoutTruth(dataset) if open_storage(dataset).exists(BLIND_FILE) else PairsWithTruth(dataset)
    )
    source.frame_indices()
    return source


class _ReopenedDataset:
    """A dataset that each process opens by itself when it needs it."""

    def __init__(self, dataset: Location) -> None:
        self._place = dataset

    def __getstate__(self) -> dict[str, Any]:
        return {"_place": self._place}


class PairsWithTruth(_ReopenedDataset):
    """Pairs with their truth."""

    @cached_property
    def _dataset(self) -> Dataset:
        return Dataset(self._place)

    @cached_property
    def _known(self) -> dict[int, FrameEntry]:
        return {entry.frame_index: entry for entry in self._dataset.manifest.frames}

    def facts(self) -> PageFacts:
        """From the manifest."""
        manifest = self._dataset.manifest
        counts = f"{manifest.counts.pairs} stereo pairs, {manifest.counts.empty} of them without a drogue."
        origin = f"Content hash {manifest.dataset_sha256}; data under {manifest.data_licence}."
        facts = tuple(filter(None, (manifest.recipe.description, counts, origin)))
        return PageFacts(manifest.name, facts, manifest.recipe.rig, False)

    def frame_indices(self) -> tuple[int, ...]:
        """Of the manifest."""
        return self._dataset.frame_indices

    def entry(self, frame_index: int) -> PageEntry:
        """From its record."""
        known, record = self._known[frame_index], self._dataset.record(frame_index)
        drogue = self._dataset.sought_drogue(record)
        return page_entry(record, drogue, known.split, known.record_sha256)

    def images(self, frame_index: int) -> StereoImages:
        """Decoded images, checked against the record, whose hash identifies them in the names of the pictures."""
        frames, hashes = self._dataset.frames, self._dataset.record(frame_index).file_sha256
        for name in map(image_file, EYES):
            if hashlib.sha256(frames.read(frame_index, name)).hexdigest() != hashes.get(name):
                where = frames.where(frame_index, name)
                raise ValueError(f"{where}: was changed: its hash differs from the recorded one")
        return self._dataset.images(frame_index)


class PairsWithoutTruth(_ReopenedDataset):
    """Pairs without truth."""

    @cached_property
    def _dataset(self) -> BlindDataset:
        return BlindDataset(self._place)

    @cached_property
    def _frames(self) -> FrameStore:
        return FrameStore(self._place)

    def facts(self) -> PageFacts:
        """From the index."""
        index = read_blind_index(self._place)
        return PageFacts(index.name, (f"{len(index.frames)} stereo pairs without truth.",), index.rig, True)

    def frame_indices(self) -> tuple[int, ...]:
        """Of the index."""
        return self._dataset.frame_indices

    def entry(self, frame_index: int) -> PageEntry:
        """From the pair's time and drogue; the hash of its images identifies them."""
        pixels = hashlib.sha256()
        for eye in EYES:
            pixels.update(self._frames.read(frame_index, image_file(eye)))
        pair = self._dataset.pair(frame_index)
        return page_entry_without_truth(frame_index, pair.images.time_s, drogue_rings(pair.drogue), pixels.hexdigest())

    def images(self, frame_index: int) -> StereoImages:
        """Decoded."""
        return self._dataset.pair(frame_index).images
