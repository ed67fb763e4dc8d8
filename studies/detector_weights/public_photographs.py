"""Photographs without a drogue, from packages that Debian publishes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from datasets_manifest.importers.image_files import IMAGE_SUFFIXES
from datasets_manifest.importers.photographs import shown_photograph

LARGEST_SIDE_PX = 1600
# Icons and thumbnails are no photographs.
_SMALLEST_SIDE_PX = 400
_SMALLEST_FILE_BYTES = 40_000
# Debian 12 has these; versions are told, because a picture that another version drops changes the training.
TRAINING_PACKAGES = (
    "gnome-backgrounds",
    "lxqt-themes",
    "mate-backgrounds",
    "plasma-workspace-wallpapers",
    "ukui-wallpapers",
)
# What no training sees.
TEST_PACKAGES = ("lomiri-wallpapers-16.04", "lomiri-wallpapers-20.04", "opencv-doc")
# In the examples of OpenCV only these are photographs of the world as it is; the others are drawings, targets and maps.
_OPENCV_PHOTOGRAPHS = [
    "HappyFish",
    "aero1",
    "aero3",
    "aloeL",
    "apple",
    "baboon",
    "basketball1",
    "board",
    "building",
    "cards",
    "chicky_512",
    "ela_original",
    "fruits",
    "graf1",
    "home",
    "leuvenA",
    "licenseplate_motion",
    "messi5",
    "orange",
    "rubberwhale1",
    "smarties",
    "squirrel_cls",
    "stuff",
]


def fetch_photographs(folder: Path, packages: tuple[str, ...]) -> None:
    """Photographs of Debian's packages in a folder, as JPEG of at most 1600 px; nothing where the folder is complete.

    Of pictures that a package has at several sizes the largest is taken, so none comes twice.

    Args:
        folder: is made; `packages.txt` in it tells which versions it holds, and is written last.
        packages: names of packages.

    Raises:
        OSError: a package cannot be fetched or unpacked; names it.
    """
    listing = folder / "packages.txt"
    if listing.is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    versions = []
    for package in packages:
        with tempfile.TemporaryDirectory(prefix="photographs-") as place:
            # As root, apt fetches as another user, who cannot write to our folder.
            _run(["apt-get", "--option", "APT::Sandbox::User=root", "download", package], Path(place), package)
            archive = next(iter(Path(place).glob("*.deb")))
            versions.append(archive.stem)
            unpack_photographs(archive, folder / package)
    listing.write_text("\n".join(versions) + "\n", encoding="utf-8")


def unpack_photographs(archive: Path, folder: Path) -> None:
    """Write the photographs of a Debian package as JPEG of at most 1600 px.

    Pictures with transparent places are left out: they are drawings and themes, not photographs.

    Args:
        archive: the `.deb` file.
        folder: is made anew.

    Raises:
        OSError: the package cannot be unpacked, or a picture not be written.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory(prefix="photographs-") as place:
        _run(["dpkg-deb", "--extract", str(archive.resolve()), place], Path(place), archive.name)
        for title, path in sorted(_photograph_titles(Path(place)).items()):
            picture = shown_photograph(path)
            if _is_transparent(path) or min(picture.shape[:2]) < _SMALLEST_SIDE_PX:
                continue
            scale = min(LARGEST_SIDE_PX / max(picture.shape[:2]), 1.0)
            size_px = (round(scale * picture.shape[1]), round(scale * picture.shape[0]))
            reduced = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA)
            ordered = reduced if reduced.ndim == 2 else np.ascontiguousarray(reduced[..., ::-1])
            if not cv2.imwrite(str(folder / f"{title}.jpg"), ordered, [cv2.IMWRITE_JPEG_QUALITY, 95]):
                raise OSError(f"{folder / title}.jpg: cannot be written")


def _run(command: list[str], place: Path, package: str) -> None:
    try:
        ended = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise OSError(f"{command[0]} is not installed; photographs come from packages of Debian 12") from error
    if ended.returncode != 0:
        reason = ended.stderr.strip().splitlines()[-1:] or ["no message"]
        raise OSError(f"{package}: {command[0]} ended with {ended.returncode}: {reason[0]}")


def _is_transparent(path: Path) -> bool:
    with Image.open(path) as picture:
        lowest = picture.convert("RGBA").getchannel("A").getextrema()[0] if picture.has_transparency_data else 255
    return lowest != 255


def _photograph_titles(unpacked: Path) -> dict[str, Path]:
    """The largest file of each title."""
    largest: dict[str, Path] = {}
    for place, _, files in os.walk(unpacked):
        for path in (Path(place) / name for name in files):
            if path.suffix.lower() not in IMAGE_SUFFIXES or path.is_symlink():
                continue
            parents = [part for part in path.relative_to(unpacked).parts[:-1] if part != "images"]
            if "opencv-doc" in parents and (parents[-1] != "data" or path.stem not in _OPENCV_PHOTOGRAPHS):
                continue
            # Plasma names each picture by its size, in a folder that names the picture.
            title = "-".join(parents[-2:]) if re.fullmatch(r"\d+x\d+", path.stem) else path.stem
            size = path.stat().st_size
            if size > _SMALLEST_FILE_BYTES and (title not in largest or size > largest[title].stat().st_size):
                largest[title] = path
    return largest
