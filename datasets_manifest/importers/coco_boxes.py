"""Hand-drawn boxes around the drogue, from COCO files of annotation tools.

Names of images are matched by whole parts of their paths, from the end: `flight/left/1.png` in the file is `left/1.png`
of a folder. Backslashes are slashes. Label Studio puts eight hexadecimal digits and a hyphen before the names of files
that were uploaded.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from datasets_manifest.types.records import PixelBox
from drogue_models.untrusted_files import MOST_BYTES, parse_json, read_text

_DROGUE = "drogue"

_UPLOADED = re.compile(r"[0-9a-f]{8}-(.+)")


@dataclass(frozen=True)
class DrawnBox:
    """One box of a file.

    Attributes:
        image_name: `file_name` of its image.
        size_px: (width, height) that the file gives for the image, or None. [px]
        box: x, y, width, height in pixel-centre coordinates. [px]
    """

    image_name: str
    size_px: tuple[int, int] | None
    box: PixelBox


@dataclass(frozen=True)
class DrawnBoxes:
    """The boxes of a file, around the drogue alone.

    Attributes:
        path: of the file.
        boxes: in the file's order.
        image_names: `file_name` of all images of the file, those without a box too.
    """

    path: Path
    boxes: tuple[DrawnBox, ...]
    image_names: tuple[str, ...] = ()

    def of_images(self, names: Sequence[str], sizes_px: Sequence[tuple[int, int]]) -> dict[int, tuple[PixelBox, ...]]:
        """The boxes on single images, by place among them; empty for an image that the file names without a box.

        Args:
            names: of the images.
            sizes_px: (width, height) of each. [px]

        Raises:
            ValueError: a name that fits several images, a box outside its image or drawn on another size, or none of
                the file's images is among these.
        """
        index = _NameIndex([(name, name) for name in names])
        found: dict[int, tuple[PixelBox, ...]] = {}
        for name in self.image_names:
            place = index.find(name, self.path)
            if place is not None:
                found[place[0]] = ()
        for drawn in self.boxes:
            place = index.find(drawn.image_name, self.path)
            if place is None:
                continue
            size_px = sizes_px[place[0]]
            if drawn.size_px not in (None, size_px):
                raise ValueError(
                    f"{self.path}: {drawn.image_name} was {_size(drawn.size_px)} px when its box was drawn, and is "
                    f"{_size(size_px)} px; draw on the pictures as they are"
                )
            self._check_overlap(drawn, size_px)
            found[place[0]] = (*found.get(place[0], ()), drawn.box)
        if not found and (self.image_names or self.boxes):
            first = (self.image_names or (self.boxes[0].image_name,))[0]
            raise ValueError(
                f"{self.path}: none of its images is among these: it names {first}, and they are {names[0]} and so on"
            )
        return found

    def of_views(
        self, names: Sequence[tuple[str, str]], view_size_px: tuple[int, int]
    ) -> dict[tuple[int, int], PixelBox]:
        """The boxes by pair and view (0 left, 1 right).

        Args:
            names: of the left and the right image of every pair; equal where one image holds both views side by side.
            view_size_px: (width, height) of one view. [px]

        Raises:
            ValueError: an image that fits several views or has another size, a box outside its image, two boxes in a
                view, or none of the boxes belongs to these images.
        """
        index = _NameIndex(names)
        found: dict[tuple[int, int], PixelBox] = {}
        for drawn in self.boxes:
            place = index.find(drawn.image_name, self.path)
            if place is None:
                continue
            pair, view = place
            width_px, height_px = view_size_px
            x, y, width, height = drawn.box
            is_side_by_side = names[pair][0] == names[pair][1]
            size_px = (2 * width_px, height_px) if is_side_by_side else view_size_px
            if drawn.size_px not in (None, size_px):
                raise ValueError(
                    f"{self.path}: {drawn.image_name} was {_size(drawn.size_px)} px when its box was drawn, and the "
                    f"image is {_size(size_px)} px; draw on images of the calibrated size"
                )
            self._check_overlap(drawn, size_px)
            if is_side_by_side:
                view = int(x + width / 2 >= width_px - 0.5)
                x -= view * width_px
            if (pair, view) in found:
                raise ValueError(
                    f"{self.path}: {drawn.image_name} has two boxes in one view, and one drogue is looked for"
                )
            found[pair, view] = (x, y, width, height)
        if self.boxes and not found:
            raise ValueError(
                f"{self.path}: none of its {len(self.boxes)} boxes belongs to these images: it names "
                f"{self.boxes[0].image_name}, and the images are {names[0][0]} and so on"
            )
        return found

    def _check_overlap(self, drawn: DrawnBox, size_px: tuple[int, int]) -> None:
        x, y, width, height = drawn.box
        width_px, height_px = size_px
        if not (-0.5 - width < x < width_px - 0.5 and -0.5 - height < y < height_px - 0.5):
            raise ValueError(
                f"{self.path}: {drawn.image_name}: the box {x + 0.5:g}, {y + 0.5:g}, {width:g}, {height:g} lies "
                f"outside its image of {_size(size_px)} px"
            )


class _NameIndex:
    """Finds the view that a file name of a COCO file means."""

    def __init__(self, names: Sequence[tuple[str, str]]) -> None:
        self._by_file: dict[str, list[tuple[tuple[str, ...], tuple[int, int]]]] = {}
        self._by_upload: dict[str, list[tuple[tuple[str, ...], tuple[int, int]]]] = {}
        for pair, (left, right) in enumerate(names):
            for view, name in enumerate((left,) if left == right else (left, right)):
                parts = _parts(name)
                entry = parts, (pair, view)
                self._by_file.setdefault(parts[-1], []).append(entry)
                self._by_upload.setdefault(_as_uploaded(parts[-1]), []).append(entry)

    def find(self, name: str, path: Path) -> tuple[int, int] | None:
        """Pair and view, or None where no image fits.

        Raises:
            ValueError: several fit.
        """
        asked = _parts(name)
        fitting = [entry for entry in self._by_file.get(asked[-1], []) if _is_end_of_either(entry[0], asked)]
        uploaded = _UPLOADED.fullmatch(asked[-1])
        if not fitting and uploaded is not None:
            fitting = self._by_upload.get(uploaded[1], [])
        # The whole name of an image means that image, though others end in the same.
        fitting = [entry for entry in fitting if entry[0] == asked] or fitting
        if len(fitting) > 1:
            first, second = ("/".join(parts) for parts, _ in fitting[:2])
            raise ValueError(
                f"{path}: {name} may be {first} or {second}; give each file_name its folder, as in {first}"
            )
        return fitting[0][1] if fitting else None


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path; those of Windows and of Label Studio's local files (`...?d=left/1.png`) too.

    Letters with accents are in one form of Unicode, as macOS writes another one than other systems.
    """
    path = unicodedata.normalize("NFC", unquote(name.partition("?d=")[2]) if "?d=" in name else name)
    return tuple(part for part in path.replace("\\", "/").split("/") if part not in ("", ".", "..")) or (name,)


def _is_end_of_either(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    shared = min(len(one), len(other))
    return one[-shared:] == other[-shared:]


def _as_uploaded(file: str) -> str:
    """A file's name as Label Studio stores it (Django's `get_valid_name`)."""
    return re.sub(r"[^-\w.]", "", file.strip().replace(" ", "_"))


def _size(size_px: tuple[int, int] | None) -> str:
    return "unknown" if size_px is None else f"{size_px[0]}x{size_px[1]}"


def read_boxes(path: Path, category: str | None = None) -> DrawnBoxes:
    """Hand-drawn boxes of one category of a COCO file.

    Args:
        path: of the file.
        category: its name; None for the one named drogue. A file without categories has boxes of the drogue alone.

    Raises:
        ValueError: it cannot be read, is not a COCO file, has no such category, or an annotation is no upright box;
            names the file, and the annotation.
    """
    try:
        table = parse_json(read_text(path, MOST_BYTES), with_nan=True)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error
    try:
        boxes = tuple(_drawn_boxes(table, category))
        return DrawnBoxes(path, boxes, tuple(str(image["file_name"]) for image in table["images"]))
    except (KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"{path}: is not a COCO file of boxes: {type(error).__name__} {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _drawn_boxes(table: dict[str, Any], category: str | None) -> list[DrawnBox]:
    images = {_number(image["id"]): image for image in table["images"]}
    if len(images) < len(table["images"]):
        raise ValueError("images: two have the same id")
    categories = table.get("categories", [])
    wanted, known = _category_id(categories, category), {one["id"] for one in categories}
    boxes: list[DrawnBox] = []
    for annotation in table["annotations"]:
        name = f"annotation {annotation.get('id', len(boxes))}"
        if wanted is not None and annotation.get("category_id") not in known:
            raise ValueError(f"{name}: no category has its category_id {annotation.get('category_id')}")
        if wanted is not None and annotation["category_id"] != wanted:
            continue
        image = images.get(_number(annotation.get("image_id")))
        if image is None:
            raise ValueError(f"{name}: no image has its image_id {annotation['image_id']}")
        size = image.get("width"), image.get("height")
        size_px = size if all(type(number) is int and number > 0 for number in size) else None
        file = str(image["file_name"])
        boxes.append(DrawnBox(file, size_px, _box(annotation, f"{name} on {file}")))
    return boxes


def _category_id(categories: list[dict[str, Any]], asked: str | None) -> int | None:
    """Id of the category with the drogue's boxes; None for a file without categories."""
    if not categories and asked is None:
        return None
    ids = [_number(one["id"]) for one in categories if str(one["name"]).strip().lower() == (asked or _DROGUE).lower()]
    if len(ids) != 1:
        names = ", ".join(str(one["name"]) for one in categories) or "none"
        raise ValueError(
            f"categories: {len(ids) or 'none'} named {asked or _DROGUE}; choose by --box-category from {names}"
        )
    return ids[0]


def _number(value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"ids must be whole numbers, got {value!r}")
    return value


def _box(annotation: dict[str, Any], name: str) -> PixelBox:
    """A COCO box in pixel-centre coordinates; COCO's origin is half a pixel before the first pixel's centre."""
    value = annotation.get("bbox")
    try:
        x, y, width, height = (float(number) for number in value)  # type: ignore[union-attr]
        is_box = abs(x) < 1e6 and abs(y) < 1e6 and 0 < width < 1e6 and 0 < height < 1e6
    except (TypeError, ValueError):
        is_box = False
    if not is_box:
        raise ValueError(f"{name}: its bbox must be x, y, width, height in pixels, got {value}")
    attributes = annotation.get("attributes")
    turn_deg = attributes.get("rotation", 0) if isinstance(attributes, dict) else 0
    if not isinstance(turn_deg, (int, float)) or not math.isclose(turn_deg % 360, 0, abs_tol=1e-9):
        raise ValueError(f"{name}: its box is turned by {turn_deg} degrees; draw it upright")
    return (x - 0.5, y - 0.5, width, height)
