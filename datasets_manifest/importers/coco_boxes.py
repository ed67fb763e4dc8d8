"""Hand-drawn boxes around the drogue, from COCO files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from datasets_manifest.types.records import PixelBox

VIEW_FOLDERS = (("left", "right"), ("cam0", "cam1"), ("image_0", "image_1"), ("image_2", "image_3"), ("L", "R"))
"""Names of the two folders of a dataset with a folder a view, in the order in which they are looked for."""


def image_key(path: PurePath) -> str:
    """An image's file name, preceded by its folder where there is a folder for each view."""
    is_view = any(path.parent.name in names for names in VIEW_FOLDERS)
    return f"{path.parent.name}/{path.name}" if is_view else path.name


def read_boxes(path: Path) -> Mapping[str, list[PixelBox]]:
    """Hand-drawn boxes from a COCO file, by `image_key`, in pixel-centre coordinates.

    Raises:
        ValueError: it cannot be read or is not a COCO file; names it.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        names = {_number(image["id"]): image_key(PurePosixPath(str(image["file_name"]))) for image in table["images"]}
        boxes: dict[str, list[PixelBox]] = {}
        for annotation in table["annotations"]:
            boxes.setdefault(names[_number(annotation["image_id"])], []).append(_box(annotation["bbox"]))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: is not a COCO file of boxes: {type(error).__name__} {error}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from error
    return boxes


def boxes_of_pair(
    boxes: Mapping[str, list[PixelBox]], names: tuple[str, str], width_px: int
) -> tuple[PixelBox | None, PixelBox | None]:
    """The boxes of the left and the right view.

    Args:
        boxes: as `read_boxes` gives them.
        names: of the left and the right image; equal where one image holds both views side by side.
        width_px: of one view.

    Raises:
        ValueError: a view with two boxes, though one drogue is looked for.
    """
    if names[0] == names[1]:
        both = boxes.get(names[0], [])
        left = [box for box in both if box[0] + box[2] / 2 < width_px - 0.5]
        views = [left, [(x - width_px, y, w, h) for x, y, w, h in both if (x, y, w, h) not in left]]
    else:
        views = [boxes.get(name, []) for name in names]
    for name, found in zip(names, views, strict=True):
        if len(found) > 1:
            raise ValueError(f"boxes: {name} has {len(found)} in one view, and one drogue is looked for")
    first, second = (found[0] if found else None for found in views)
    return first, second


def _number(value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"ids must be whole numbers, got {value!r}")
    return value


def _box(value: Any) -> PixelBox:
    """A COCO box in pixel-centre coordinates; COCO's origin is half a pixel before the first pixel's centre."""
    x, y, width, height = (float(number) for number in value)
    if not (abs(x) < 1e6 and abs(y) < 1e6 and 0 < width < 1e6 and 0 < height < 1e6):
        raise ValueError(f"a bbox must be x, y, width, height in pixels, got {value}")
    return (x - 0.5, y - 0.5, width, height)
