"""Stereo pairs in a folder of image files: two files a pair, or both views side by side in one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from datasets_manifest.importers.coco_boxes import VIEW_FOLDERS, image_key
from datasets_manifest.importers.imported_dataset import ImportedPair
from datasets_manifest.types.images import Pixels

_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
# A file's name says left or right at its beginning or its end.
_SIDE = re.compile(
    r"^(?:(?P<first>left|right|l[-_. ]|r[-_. ])[-_. ]?)?(?P<rest>.*?)(?:[-_. ]?(?P<last>left|right|[-_. ][lr]))?$", re.I
)


class ImageFolder:
    """The pairs of a folder.

    Attributes:
        count: number of pairs.
        left_out: files without a partner.
    """

    def __init__(self, folder: Path, width_px: int, rate_hz: float) -> None:
        """List the pairs of a folder; images are read later.

        Args:
            folder: with `left/` and `right/` (or names like them), files whose names differ in `left` and `right`, or
                images of twice the calibration's width.
            width_px: of one view.
            rate_hz: pairs per second, from which their times follow. [Hz]

        Raises:
            ValueError: no such folder, or no pairs in it.
        """
        if not folder.is_dir():
            raise ValueError(f"{folder}: there is no such folder of images")
        pairs, self.left_out = _pairs(folder)
        self._width_px, self._rate_hz = width_px, rate_hz
        self._is_side_by_side = not pairs
        if not pairs:
            pairs = [(path, path) for path in _images(folder)]
            self.left_out = ()
        if not pairs:
            raise ValueError(f"{folder}: holds no images ({', '.join(_SUFFIXES)}), nor left/ and right/ with them")
        self._pairs = pairs
        self.count = len(pairs)

    def __iter__(self) -> Iterator[ImportedPair]:
        for place, (left, right) in enumerate(self._pairs):
            time_s = place / self._rate_hz
            if self._is_side_by_side:
                both = read_image(left)
                if both.shape[1] != 2 * self._width_px:
                    raise ValueError(
                        f"{left}: must be two views of {self._width_px} px side by side, or have a partner named "
                        f"left or right, got a width of {both.shape[1]} px"
                    )
                yield ImportedPair((left.name, left.name), time_s, both[:, : self._width_px], both[:, self._width_px :])
            else:
                yield ImportedPair((image_key(left), image_key(right)), time_s, read_image(left), read_image(right))


def read_image(path: Path) -> Pixels:
    """An image file as (H, W, 3) RGB or (H, W) grey, with its stored depth.

    Raises:
        ValueError: it cannot be read, or is not of 8 or 16 bits; names the file.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except (OSError, cv2.error) as error:
        raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())[:200]}") from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: is truncated, or not an image of 8 or 16 bits")
    if image.ndim == 2:
        return np.asarray(image)
    if image.shape[2] not in (3, 4):
        raise ValueError(f"{path}: must have one, three or four channels, got {image.shape[2]}")
    return np.ascontiguousarray(image[:, :, 2::-1])


def _images(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file())


def _pairs(folder: Path) -> tuple[list[tuple[Path, Path]], tuple[str, ...]]:
    """Pairs of two files, in the order of their names, and files without a partner."""
    views: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
    for names in VIEW_FOLDERS:
        if all((folder / name).is_dir() for name in names):
            for view, name in zip(views, names, strict=True):
                for path in _images(folder / name):
                    _add(view, path.stem, path)
            break
    else:
        for path in _images(folder):
            side, rest = _side(path.stem)
            if side is not None:
                _add(views[side], rest, path)
    left, right = views
    both = sorted(left.keys() & right.keys(), key=_in_number_order)
    alone = [view[key] for view in views for key in sorted(view.keys() - set(both))]
    return [(left[key], right[key]) for key in both], tuple(f"{path}: has no partner" for path in alone)


def _add(view: dict[str, Path], key: str, path: Path) -> None:
    if key in view:
        raise ValueError(f"{path}: and {view[key].name} are the same view's; keep one of them")
    view[key] = path


def _side(stem: str) -> tuple[int | None, str]:
    """0 for a left view's name, 1 for a right one's, None for neither; and the rest of the name."""
    found = _SIDE.match(stem)
    assert found is not None
    word = found["first"] or found["last"]
    if word is None:
        return None, stem
    return int(word.strip("-_. ").lower().startswith("r")), found["rest"]


def _in_number_order(name: str) -> list[tuple[int, int | str]]:
    """Sort key by which image 10 comes after image 9."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name)]
