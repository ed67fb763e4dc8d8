"""Writes imported stereo pairs as a dataset without truth, optionally with hand-drawn boxes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, Protocol

import numpy as np

from datasets_manifest.atomic import new_folder
from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.importers.coco_boxes import DrawnBoxes
from datasets_manifest.recipe.rigs import SENSORS
from datasets_manifest.storage.blind import BlindIndex
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.layout import (
    ANNOTATIONS_FOLDER,
    BLIND_FILE,
    CALIBRATION_FOLDER,
    FRAMES_FOLDER,
    RECORD_FILE,
    frame_folder,
    image_file,
    mosaic_file,
)
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.images import Pixels, PixelValues
from datasets_manifest.types.records import PixelBox
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, StereoRig

# Images of more than 8 bits are stored with this many.
_KEPT_BITS: Final = 12

_DEEPEST_BITS = 16


@dataclass(frozen=True, eq=False)
class ImportedPair:
    """One stereo pair from a user's camera.

    Attributes:
        names: of the left and the right image in the source.
        time_s: the source's time stamp, nominally of mid-exposure. [s]
        left, right: (H, W, 3) red, green, blue, or (H, W) grey.
        left_mosaic, right_mosaic: (H, W) raw RGGB mosaic of a Bayer sensor, else None.
        turned_count: images that were turned as their EXIF orientation says.
        values: what the source says of the pixel values, or None.
    """

    names: tuple[str, str]
    time_s: float
    left: Pixels
    right: Pixels
    left_mosaic: Pixels | None = None
    right_mosaic: Pixels | None = None
    turned_count: int = 0
    values: PixelValues | None = None


class ImportedPairs(Protocol):
    """A source of stereo pairs in the order of time.

    Attributes:
        count: number of pairs.
        left_out: images that cannot be imported, with the reason, a line each.
        remarks: what was understood without being said, a line each.
    """

    count: int
    left_out: tuple[str, ...]
    remarks: tuple[str, ...]

    def __iter__(self) -> Iterator[ImportedPair]:
        """The pairs, each read on demand.

        Raises:
            ValueError: a pair cannot be read; names it.
        """
        ...


@dataclass(frozen=True)
class ImportSettings:
    """What the images themselves do not say.

    Attributes:
        name: of the dataset.
        rig: the cameras.
        drogue: the drogue to look for.
        encoding: of the pixel values; by default what the source says, else `gamma` for 8 bits and `linear` for more.
        black_level_dn: pixel value without light, in the source; by default what the source says, else 0. [DN]
        bits: significant bits of images with more than 8; by default what the source says, else as many as the first
            pair needs.
        exposure_s: exposure time where the source does not say it; 0 where it is unknown. [s]
        boxes: around the drogue.
    """

    name: str
    rig: StereoRig
    drogue: DrogueParameters
    encoding: Literal["linear", "gamma"] | None = None
    black_level_dn: float | None = None
    bits: int | None = None
    exposure_s: float = 0.0
    boxes: DrawnBoxes | None = None


@dataclass(frozen=True)
class ImportSummary:
    """What was written.

    Attributes:
        box_count: boxes whose image was found.
        remarks: what was understood without being said, a line each.
    """

    box_count: int
    remarks: tuple[str, ...]


def write_imported(
    source: ImportedPairs, settings: ImportSettings, out: Path, advance: Callable[[], None]
) -> ImportSummary:
    """Write the pairs of a source as a dataset without truth.

    Args:
        source: the pairs.
        settings: rig, drogue and meaning of the pixel values.
        out: the dataset's folder; must not exist yet, or be empty.
        advance: called after each pair.

    Raises:
        ValueError: an image that cannot be read, or of another size, depth or colour than rig and first pair; pairs
            that are not in the order of time, or before 0; or settings that contradict what the source says.
        OSError: it cannot be written; nothing is left behind.
    """
    depth: PixelDepth | None = None
    meant = settings
    time_s, turned_count = -math.inf, 0
    names: list[tuple[str, str]] = []
    box_count = 0
    with new_folder(out) as folder:
        for frame_index, pair in enumerate(source):
            if pair.time_s < 0:
                raise ValueError(
                    f"{pair.names[0]}: its time must be at least 0, got {pair.time_s} s; shift the times of the source"
                )
            if not pair.time_s > time_s:
                raise ValueError(f"{pair.names[0]}: its time of {pair.time_s} s must be later than the pair's before")
            meant, encoding = _as_said(settings, pair), meant.encoding
            depth = depth or PixelDepth(pair, meant.bits)
            if frame_index and meant.encoding != encoding:
                raise ValueError(f"{pair.names[0]}: at {pair.time_s} s must have the encoding of the first pair")
            time_s, turned_count = pair.time_s, turned_count + pair.turned_count
            target = frame_folder(folder, frame_index)
            target.mkdir(parents=True)
            for name, pixels in _stored_images(pair, depth, settings.rig).items():
                (target / name).write_bytes(encode_png(pixels))
            _write(target / RECORD_FILE, _record(pair, meant, depth.kept_level_dn(meant.black_level_dn or 0.0)))
            names.append(pair.names)
            advance()
        assert depth is not None  # a source without pairs was refused
        _write(folder / BLIND_FILE, _index(meant, depth, source.count).model_dump(mode="json"))
        for name, text in calibration_files(settings.rig).items():
            (folder / CALIBRATION_FOLDER).mkdir(exist_ok=True)
            (folder / CALIBRATION_FOLDER / name).write_text(text, encoding="utf-8")
        if settings.boxes is not None:
            table = _coco_table(settings.boxes, names, settings.rig)
            box_count = len(table["annotations"])
            (folder / ANNOTATIONS_FOLDER).mkdir()
            _write(folder / ANNOTATIONS_FOLDER / "all.json", table)
    remarks = [*source.remarks, _pixel_value_line(settings, meant, depth)]
    if turned_count:
        remarks.append(f"orientation: {turned_count} images are turned as their EXIF says, as cv2.imread turns them")
    return ImportSummary(box_count, tuple(remarks))


def _as_said(settings: ImportSettings, pair: ImportedPair) -> ImportSettings:
    """The settings with what the source says of a pair's pixel values.

    Raises:
        ValueError: the two contradict each other.
    """
    said = pair.values
    if said is None:
        return settings
    for option, given, value in (
        ("--encoding", settings.encoding, said.encoding),
        ("--black-level", settings.black_level_dn, said.black_level_dn),
        ("--bits", settings.bits, said.bits),
    ):
        if given not in (None, value):
            raise ValueError(f"{option}: the source says {value}, got {given}; leave the option out")
    bits = said.bits if said.bits > 8 else None
    return replace(
        settings, encoding=said.encoding, black_level_dn=said.black_level_dn, bits=bits, exposure_s=said.exposure_s
    )


def _pixel_value_line(settings: ImportSettings, meant: ImportSettings, depth: PixelDepth) -> str:
    """What the pixel values were taken for."""
    black_dn = meant.black_level_dn or 0.0
    line = f"pixel values: {depth.bits} bits, {depth.encoding(meant.encoding)}, black level {black_dn:g} DN"
    if meant is not settings:
        return f"{line}, as the source says"
    options = {"--encoding": meant.encoding, "--black-level": meant.black_level_dn}
    if depth.output_bits != 8:
        options["--bits"] = meant.bits
    unsaid = [option for option, value in options.items() if value is None]
    return f"{line}; assumed, without {', '.join(unsaid)}" if unsaid else line


def _stored_images(pair: ImportedPair, depth: PixelDepth, rig: StereoRig) -> dict[str, Pixels]:
    """A pair's images by file name, with the depth in which they are stored."""
    first, second = pair.names
    mosaics = [(mosaic_file("left"), first, pair.left_mosaic), (mosaic_file("right"), second, pair.right_mosaic)]
    found = [(file, name, mosaic) for file, name, mosaic in mosaics if mosaic is not None]
    if len(found) != (len(mosaics) if depth.color == "bayer" else 0):
        raise ValueError(f"{first}: at {pair.time_s} s must have the depth and colours of the first pair")
    images = [(image_file("left"), first, pair.left), (image_file("right"), second, pair.right)]
    return {
        **{file: depth.checked(mosaic, name, rig, is_mosaic=True) for file, name, mosaic in found},
        **{file: depth.checked(image, name, rig) for file, name, image in images},
    }


class PixelDepth:
    """Colour and depth of all images, taken from the first pair."""

    def __init__(self, pair: ImportedPair, bits: int | None) -> None:
        image = pair.left
        self.color: Literal["rgb", "bayer", "mono"] = "rgb" if image.ndim == 3 else "mono"
        if pair.left_mosaic is not None:
            self.color = "bayer"
        self._dtype = image.dtype
        self.output_bits: Literal[8, 12] = 8 if image.dtype == np.uint8 else _KEPT_BITS
        if bits is not None and self.output_bits == 8:
            raise ValueError(f"{pair.names[0]}: has 8 bits; leave the number of bits out")
        is_deep = max(int(pair.left.max()), int(pair.right.max())) >= 2**_KEPT_BITS
        self.bits = 8 if self.output_bits == 8 else bits or (_DEEPEST_BITS if is_deep else _KEPT_BITS)

    def encoding(self, given: Literal["linear", "gamma"] | None) -> Literal["linear", "gamma"]:
        """The encoding of the pixel values; unless it is given, `gamma` for 8 bits and `linear` for more."""
        return given or ("gamma" if self.output_bits == 8 else "linear")

    def kept_level_dn(self, level_dn: float) -> float:
        """A pixel value of the source as a pixel value of the stored images.

        Raises:
            ValueError: outside the range of the images.
        """
        kept = level_dn if self.output_bits == 8 else level_dn * 2.0 ** (_KEPT_BITS - self.bits)
        if not 0 <= kept < 2**self.output_bits - 1:
            raise ValueError(f"black level: must be below the images' largest number, got {level_dn:g}")
        return kept

    def checked(self, image: Pixels, name: str, rig: StereoRig, is_mosaic: bool = False) -> Pixels:
        """The image with the depth in which it is stored.

        Args:
            image: of a view, or its raw mosaic.
            name: of the image, for errors.
            rig: gives the size.
            is_mosaic: whether it is the mosaic, which has one channel.

        Raises:
            ValueError: of another size than the rig's, or of another depth or colour than the first pair.
        """
        size = (rig.camera.width_px, rig.camera.height_px)
        if (image.shape[1], image.shape[0]) != size:
            raise ValueError(
                f"{name}: must be {size[0]}x{size[1]} px as calibrated, got {image.shape[1]}x{image.shape[0]}"
            )
        if image.dtype != self._dtype or (image.ndim == 3) != (self.color != "mono" and not is_mosaic):
            raise ValueError(f"{name}: must have the depth and colours of the first pair")
        if self.output_bits == 8:
            return image
        if int(image.max()) >= 2**self.bits:
            raise ValueError(f"{name}: has values beyond {self.bits} bits; say by --bits how many the camera has")
        shift = self.bits - _KEPT_BITS
        return np.asarray(image >> shift if shift >= 0 else image << -shift, dtype=np.uint16)


def _record(pair: ImportedPair, settings: ImportSettings, black_level_dn: float) -> dict[str, Any]:
    """The parts of a pair's record that are no truth."""
    return {
        "time_s": pair.time_s,
        "image_black_level_dn": black_level_dn,
        "frame": {"exposure": {"time_s": settings.exposure_s}},
    }


def _index(settings: ImportSettings, depth: PixelDepth, count: int) -> BlindIndex:
    """The blind index; electrons and noise are those of a usual sensor, as the real ones are unknown."""
    usual = SENSORS["rgb-ideal"].model_dump()
    encoding = depth.encoding(settings.encoding)
    sensor = Sensor.model_validate(
        {**usual, "name": "imported", "color": depth.color, "output_bits": depth.output_bits, "encoding": encoding}
    )
    return BlindIndex(
        name=settings.name,
        rig=settings.rig,
        sensor=sensor,
        drogue=settings.drogue,
        drogues_differ=False,
        frames=tuple(range(count)),
    )


def _coco_table(drawn: DrawnBoxes, names: list[tuple[str, str]], rig: StereoRig) -> dict[str, Any]:
    """All views of the dataset, and the boxes of those that have one."""
    boxes = drawn.of_views(names, (rig.camera.width_px, rig.camera.height_px))
    places = [(pair, view) for pair in range(len(names)) for view in range(len(EYES))]
    return {
        "images": [_coco_image(2 * pair + view + 1, pair, view, rig) for pair, view in places],
        "annotations": [
            _coco_box(2 * pair + view + 1, boxes[pair, view]) for pair, view in places if (pair, view) in boxes
        ],
        "categories": [{"id": 1, "name": "drogue", "supercategory": "target"}],
    }


def _coco_image(image_id: int, frame_index: int, view: int, rig: StereoRig) -> dict[str, Any]:
    path = f"{FRAMES_FOLDER}/{frame_index:06d}/{image_file(EYES[view])}"
    return {"id": image_id, "file_name": path, "width": rig.camera.width_px, "height": rig.camera.height_px}


def _coco_box(image_id: int, box: PixelBox) -> dict[str, Any]:
    """COCO entry of a box; COCO's origin is the corner of the image."""
    x, y, width, height = box
    return {
        "id": image_id,
        "image_id": image_id,
        "category_id": 1,
        "bbox": [x + 0.5, y + 0.5, width, height],
        "area": width * height,
        "iscrowd": 0,
    }


def _write(path: Path, table: dict[str, Any]) -> None:
    path.write_text(canonical_json(table) + "\n", encoding="utf-8", newline="\n")
