"""Rigs from the files of `cv2.FileStorage`: stereo calibrations in one file or two, and ORB-SLAM's settings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from datasets_manifest.calibration.camera_info import CameraInfo, rig_of_camera_info
from datasets_manifest.calibration.stereo_calibration import (
    calibrated_lens,
    camera_of_matrix,
    distortion_of_coefficients,
    finite_matrix,
    image_size,
    nearest_rotation,
    rig_of_cameras,
    rig_of_rectification,
)
from drogue_models.untrusted_files import read_text
from geometry.distortion import Lens
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig

# Names of OpenCV's samples first, then those of the arguments of its functions and other common ones.
_NAMES = {
    "M1": ("M1", "cameraMatrix1", "K1", "CM1"),
    "D1": ("D1", "distCoeffs1"),
    "M2": ("M2", "cameraMatrix2", "K2", "CM2"),
    "D2": ("D2", "distCoeffs2"),
    **{name: (name,) for name in ("R", "T", "R1", "R2", "P1", "P2")},
}
_RECTIFICATION = ("R1", "R2", "P1", "P2")
_POSE = ("R", "T")
_ORB_SLAM_KEY = "LEFT.K"

# A calibration opens a bracket or a tag for each of some dozen matrices, and for each view where it holds the points; a
# matrix has four keys. OpenCV's reader takes time with the square of the keys.
_MOST_OPENED, _MOST_KEYS = 2000, 8000
_XML_TAG = re.compile(r"<[\w]")
# OpenCV's reader of XML takes time with the square of the numbers in one element: two seconds for so many. Two hundred
# points in sixty views are 24,000 numbers.
_MOST_NUMBERS = 25_000
# What OpenCV's parsers say ends with the line of the text and the reason.
_PARSER_SAYS = re.compile(r"\((?P<line>\d+)\): (?P<reason>[^\n]+)\s*$")
# Their word for a text that ends within a list or a table.
_ENDED_EARLY = "Abort at parse time"
# Lists within lists of YAML without brackets are opened by dashes or spaces at the beginning of a line.
_DEEP_BLOCK = re.compile(r"^[ \t?:-]{400}", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class _Entry:
    """A value and the name by which errors call it."""

    name: str
    value: Any


def read_opencv_storage(
    paths: Sequence[Path], unit_m: float = 1.0, size_px: tuple[int, int] | None = None
) -> tuple[StereoRig, bool]:
    """The rig of OpenCV's YAML, XML or JSON files.

    Args:
        paths: one file with everything, or intrinsics and extrinsics as OpenCV's sample `stereo_calib` writes them: M1,
            D1, M2, D2, and R, T or R1, R2, P1, P2 or both, image_width and image_height; or settings of ORB-SLAM with
            LEFT.K and so on.
        unit_m: the unit of T and P2, which is that of the calibration board's squares. [m]
        size_px: (width, height) of the images, where the files do not hold it.

    Returns:
        The rig, and whether the files give its rectification.

    Raises:
        ValueError: a file cannot be read, or something is missing, impossible or contradicts; names file and key.
    """
    return rig_of_tables([_storage_table(path) for path in paths], paths, unit_m, size_px)


def is_table_of_matrices(table: Mapping[str, Any]) -> bool:
    """Whether a plain YAML table has OpenCV's names, as lists of numbers."""
    return any(one in table for spellings in _NAMES.values() for one in spellings)


def rig_of_tables(
    tables: Sequence[Mapping[str, Any]],
    paths: Sequence[Path],
    unit_m: float = 1.0,
    size_px: tuple[int, int] | None = None,
) -> tuple[StereoRig, bool]:
    """The rig of plain tables with OpenCV's names; arguments, result and errors as of `read_opencv_storage`."""
    entries = _merged(tables, paths)
    if _ORB_SLAM_KEY in entries:
        left_info, right_info = (_orb_slam_camera(entries, side, paths) for side in ("LEFT", "RIGHT"))
        return rig_of_camera_info(left_info, right_info, unit_m), True
    found: dict[str, _Entry] = {}
    for name, spellings in _NAMES.items():
        present = [entries[one] for one in spellings if one in entries]
        if len(present) > 1:
            raise ValueError(f"{present[1].name}: stands beside {present[0].name}, and means the same; leave one out")
        if present:
            found[name] = present[0]
    place = " and ".join(map(str, paths))
    lacks = [name for name in ("M1", "D1", "M2", "D2") if name not in found]
    rectification = [name for name in _RECTIFICATION if name in found]
    pose = [name for name in _POSE if name in found]
    if rectification and len(rectification) < len(_RECTIFICATION):
        raise ValueError(f"{place}: has {', '.join(rectification)} alone; give R1, R2, P1 and P2, or none of them")
    if not rectification or pose:
        lacks += [name for name in _POSE if name not in found]
    if lacks:
        raise ValueError(f"{place}: lacks {', '.join(lacks)}, as OpenCV's stereo calibration names them")
    size_px = _size_px(entries, size_px, place)
    right_from_left = None
    if pose:
        shift_m = finite_matrix(found["T"].value, (3, 1), found["T"].name).reshape(3) * unit_m
        right_from_left = RigidTransform(nearest_rotation(found["R"].value, found["R"].name), shift_m)
    left, right = (_lens(found, number, size_px) for number in (1, 2))
    if rectification:
        projections, names = (
            tuple(getattr(found[name], field) for name in ("P1", "P2")) for field in ("value", "name")
        )
        return rig_of_rectification((left, right), projections, names, unit_m, right_from_left), True
    assert right_from_left is not None
    return rig_of_cameras(left, right, right_from_left, found["T"].name), False


def read_calibration_text(path: Path) -> str:
    """The text of a calibration file, nested so little that no parser overflows its stack.

    Raises:
        OSError: it is no regular file, or too large.
        ValueError: it is not UTF-8, nested too deep, or holds too many keys or numbers.
    """
    text = read_text(path)
    # An upper limit of the depth, which is the same in YAML, XML and JSON.
    opened = max(text.count("["), text.count("{"), len(_XML_TAG.findall(text)))
    if opened > _MOST_OPENED or _DEEP_BLOCK.search(text):
        raise ValueError(f"{path}: is nested too deep for a calibration")
    if text.count(":") > _MOST_KEYS:
        raise ValueError(f"{path}: has more than {_MOST_KEYS} keys, too many for a calibration")
    if text.lstrip("\ufeff \t\r\n").startswith("<") and any(
        len(part) > 2 * _MOST_NUMBERS and len(part.split()) > _MOST_NUMBERS for part in text.split("<")
    ):
        raise ValueError(f"{path}: has an element of more than {_MOST_NUMBERS} numbers, too many for a calibration")
    return text


def _storage_table(path: Path) -> dict[str, Any]:
    """All entries of a file of `cv2.FileStorage`: arrays, numbers, texts, or lists of numbers."""
    text = read_calibration_text(path)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        keys = storage.root().keys()
        return {key: _value(storage.getNode(key)) for key in keys}
    except (cv2.error, SystemError, OverflowError, ValueError) as error:
        raise ValueError(f"{path}: is not an OpenCV storage file: {_parser_fault(error)}; write it anew") from error


def _parser_fault(error: Exception) -> str:
    """The reason for which OpenCV could not read a text, without the names of its source files and functions."""
    # OpenCV's own error is the cause of one by Python that says nothing.
    said = _PARSER_SAYS.search(str(error.__cause__ or error))
    if said is None:
        return "it holds no table of names and values that OpenCV reads"
    reason = said["reason"].strip().rstrip("!.'")
    return f"line {said['line']}: {'it ends too early' if reason == _ENDED_EARLY else reason}"


def _merged(tables: Sequence[Mapping[str, Any]], paths: Sequence[Path]) -> dict[str, _Entry]:
    """The entries of all tables.

    Raises:
        ValueError: two differ in an entry.
    """
    entries: dict[str, _Entry] = {}
    for table, path in zip(tables, paths, strict=True):
        for key, value in table.items():
            entry = _Entry(f"{path}: {key}", value)
            if key in entries and not _are_equal(entries[key].value, value):
                raise ValueError(f"{entry.name}: differs from {entries[key].name}")
            entries[key] = entry
    return entries


def _are_equal(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return not isinstance(one, np.ndarray) and not isinstance(other, np.ndarray) and bool(one == other)


def _value(node: Any) -> Any:
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_value(node.at(place)) for place in range(node.size())]
    if not node.isMap():
        return None
    try:
        return node.mat()
    except cv2.error:
        return None  # a table that is no matrix, such as the board's description


def _size_px(entries: dict[str, _Entry], given_px: tuple[int, int] | None, place: str) -> tuple[int, int]:
    sides = [entries[key].value if key in entries else None for key in ("image_width", "image_height")]
    for key in ("imageSize", "image_size"):
        if key in entries and isinstance(entries[key].value, list) and len(entries[key].value) == 2:
            sides = entries[key].value
    found_px = image_size(*sides)
    if found_px is None and given_px is None:
        raise ValueError(
            f"{place}: lacks image_width or image_height; add them, or give --image-size WIDTHxHEIGHT (width_px and "
            "height_px of a recipe's rig)"
        )
    if found_px is not None and given_px is not None and found_px != given_px:
        raise ValueError(f"{place}: is for images of {found_px[0]}x{found_px[1]} px, not {given_px[0]}x{given_px[1]}")
    return found_px or given_px  # type: ignore[return-value]


def _lens(found: dict[str, _Entry], number: int, size_px: tuple[int, int]) -> Lens:
    matrix, coefficients, turn = (found.get(f"{name}{number}") for name in "MDR")
    assert matrix is not None and coefficients is not None
    rotation: Array = np.eye(3) if turn is None else nearest_rotation(turn.value, turn.name)
    return calibrated_lens(
        camera_of_matrix(matrix.value, size_px, matrix.name),
        distortion_of_coefficients(coefficients.value, coefficients.name),
        rotation,
        coefficients.name,
    )


def _orb_slam_camera(entries: dict[str, _Entry], side: str, paths: Sequence[Path]) -> CameraInfo:
    place = " and ".join(map(str, paths))
    keys = [f"{side}.{name}" for name in ("width", "height", "D", "K", "R", "P")]
    lacks = [key for key in keys if key not in entries]
    if lacks:
        raise ValueError(f"{place}: lacks {', '.join(lacks)}, as ORB-SLAM names them")
    width, height, *matrices = (entries[key].value for key in keys)
    size_px = image_size(width, height)
    if size_px is None:
        raise ValueError(f"{place}: {side}.width and {side}.height must be the size of the images")
    return CameraInfo(f"{place}: {side}", size_px, "", *matrices)
