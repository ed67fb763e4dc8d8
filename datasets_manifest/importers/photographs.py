"""Single pictures of any camera and size, in a folder of a user's own."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.importers.image_files import IMAGE_SUFFIXES, read_photograph

# Pictures of more bits are shown with the brightest thousandth of them white.
_WHITE_QUANTILE = 0.999


def find_photographs(folder: Path) -> list[Path]:
    """Image files in a folder and the folders in it, sorted; names that begin with a dot are skipped.

    Links to folders are not followed.

    Raises:
        ValueError: there is no such folder, no picture in it, a folder that cannot be read, or a picture whose name is
            not UTF-8, which no file of results could hold.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: is no folder of pictures")
    found = []
    for place, folders, files in os.walk(folder, onerror=_refuse_folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        suffixes = {name: Path(name).suffix.lower() for name in files if not name.startswith(".")}
        found += [Path(place) / name for name, suffix in suffixes.items() if suffix in IMAGE_SUFFIXES]
    if not found:
        raise ValueError(f"{folder}: has no pictures; {', '.join(IMAGE_SUFFIXES)} are read")
    for path in found:
        try:
            str(path.relative_to(folder)).encode()
        except UnicodeEncodeError:
            shown = os.fsencode(path).decode("utf-8", "backslashreplace")
            raise ValueError(f"{shown}: has a name that is not UTF-8; rename it") from None
    return sorted(found)


def _refuse_folder(error: OSError) -> None:
    raise ValueError(f"{error.filename}: cannot be read: {error.strerror or error}") from error


def shown_photograph(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) or (H, W) uint8 picture of a file, upright, for screens.

    Raises:
        ValueError: it cannot be read; names the file.
    """
    pixels = read_photograph(path)
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, dtype=np.uint8)
    white = max(float(np.quantile(pixels, _WHITE_QUANTILE)), 1.0)
    shown: NDArray[np.uint8] = np.minimum(np.rint(pixels * (255.0 / white)), 255.0).astype(np.uint8)
    return shown
