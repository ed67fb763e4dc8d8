"""Stereo pairs in a folder of image files: finds them and their times by names, and reads them."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Final

from datasets_manifest.importers.image_files import IMAGE_SUFFIXES, read_image
from datasets_manifest.importers.imported_dataset import ImportedPair
from datasets_manifest.importers.stamp_pairs import match_stamps
from drogue_models.untrusted_files import MOST_BYTES, read_text
from geometry.stereo import EYES

# Folders of the left and the right view in small letters, besides those that say left and right.
_VIEW_FOLDERS: Final = (
    ("l", "r"),
    ("cam0", "cam1"),
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("image_00", "image_01"),
    ("image_02", "image_03"),
    ("infra1", "infra2"),
)
# A name says left or right at its beginning or its end.
_SIDE = re.compile(
    r"^(?:(?P<first>left|right|l[-_. ]|r[-_. ])[-_. ]?)?(?P<rest>.*?)(?:[-_. ]?(?P<last>left|right|[-_. ][lr]))?$",
    re.I | re.S,
)
# Zeros before a whole number; those of a decimal fraction count.
_PADDING = re.compile(r"(?<![\d.])0+(?=\d)")
# A time stamp since 1970 by its number of digits, which a counter does not reach.
_STAMP = re.compile(r"(?<![\d.])(?:([1-9]\d{18})|([1-9]\d{15})|([1-9]\d{12})|([1-9]\d{9})\.(\d{1,9}))(?![\d.])")
_STAMP_UNITS_NS = (1, 10**3, 10**6)
_NANOSECONDS = 10**9
# KITTI's list of times has a line a picture; its odometry's has seconds.
_TIME_LISTS = ("timestamps.txt", "times.txt")
_DEEPEST_FOLDER = 3
_RATE_HZ: Final = 25.0


@dataclass(frozen=True)
class FolderPairs:
    """The pairs of a folder, in the order of time.

    Attributes:
        pairs: left and right file; the same file where one image holds both views side by side.
        times_s: of the pairs. [s]
        times_from: what says them, for a message.
        left_out: files that belong to no pair, with the reason, a line each.
    """

    pairs: Sequence[tuple[Path, Path]]
    times_s: Sequence[float]
    times_from: str
    left_out: Sequence[str]

    @property
    def is_side_by_side(self) -> bool:
        """Whether one image holds both views."""
        left, right = self.pairs[0]
        return left == right


def find_pairs(
    folder: Path, rate_hz: float | None = None, names: tuple[str, str] | None = None, tolerance_ns: int = 0
) -> FolderPairs:
    """The stereo pairs in a folder.

    Args:
        folder: with a folder for each view, or with files whose names say left and right, or with images of both views
            side by side.
        rate_hz: pairs per second; None for the time stamps in their names or a list of KITTI's, else 25. [Hz]
        names: of the two views' folders; None to find them by their names.
        tolerance_ns: by how much the time stamps in the names of a pair may differ. [ns]

    Raises:
        ValueError: no such folder, no pairs in it, several ways to pair its files, or a tolerance where there are no
            stamps of two images.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder of images")
    views = _given_folders(folder, names) if names is not None else _view_folders(folder)
    if views is not None:
        found = [{path: _rest_of_view(_stem(path), eye) for path in images(view)} for eye, view in enumerate(views)]
        others = [path for path in images(folder) if folder not in views]
        where = " and ".join(str(view) for view in views)
    else:
        sides = {path: _side(_stem(path)) for path in images(folder)}
        found = [{path: rest for path, (side, rest) in sides.items() if side == eye} for eye in range(len(EYES))]
        others = [path for path, (side, _) in sides.items() if side is None]
        where = str(folder)
    if not any(found):
        if views is not None or not others:
            raise ValueError(f"{where}: holds no images ({', '.join(IMAGE_SUFFIXES)}), nor left/ and right/ with them")
        if tolerance_ns:
            raise ValueError(f"{where}: --stamp-tolerance-ms pairs two images, and each of these holds both views")
        return _with_times([(path, path) for path in others], {path: _stem(path) for path in others}, rate_hz)
    for eye, view in zip(EYES, found, strict=True):
        if not view:
            raise ValueError(f"{where}: has no images of the {eye} view, and {sum(map(len, found))} of the other")
    pairs = _matched(where, (found[0], found[1]), tolerance_ns)
    found_pairs = _with_times(pairs, {**found[0], **found[1]}, rate_hz)
    beside = [f"{path}: is neither of the left nor of the right view" for path in others]
    return replace(found_pairs, left_out=[*found_pairs.left_out, *beside])


def has_images(folder: Path) -> bool:
    """Whether there are images in the folder, or in folders of views in it."""
    return bool(images(folder)) or any(images(path) for path in folder.iterdir() if path.is_dir())


def images(folder: Path) -> list[Path]:
    """The image files in a folder, whole or not, without those whose names begin with a dot, as macOS adds them."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and not path.is_dir()
    )


def _matched(where: str, views: tuple[dict[Path, str], dict[Path, str]], tolerance_ns: int) -> list[tuple[Path, Path]]:
    """Pairs of the files of both views, by the rest of their names or by the time stamps in them."""
    first, second = (_stamps(view.values()) for view in views)
    if not tolerance_ns:
        left, right = _by_key(views)
        pairs = [(left[key], right[key]) for key in left if key in right]
    elif first is None or second is None:
        raise ValueError(f"{where}: --stamp-tolerance-ms needs a time stamp in the name of every image")
    else:
        by_stamp = [dict(zip(times, view, strict=True)) for times, view in zip((first, second), views, strict=True)]
        for eye, paths, view in zip(EYES, by_stamp, views, strict=True):
            if len(paths) < len(view):
                raise ValueError(f"{where}: two images of the {eye} view have one time stamp")
        matches = match_stamps(by_stamp[0], by_stamp[1], tolerance_ns, where)
        pairs = [(by_stamp[0][left_ns], by_stamp[1][right_ns]) for left_ns, right_ns in matches]
    if not pairs:
        names = " and ".join(f"{path.parent.name}/{path.name}" for path in map(min, views))
        hint = "" if first is None or second is None else "; --stamp-tolerance-ms lets time stamps differ"
        raise ValueError(f"{where}: no names of left and right images match, such as {names}{hint}")
    return pairs


def _by_key(views: tuple[dict[Path, str], dict[Path, str]]) -> tuple[dict[str, Path], dict[str, Path]]:
    """The files by what the names of a pair have in common: without padding of numbers, where that is unambiguous."""
    plain = tuple({path: _PADDING.sub("", rest) for path, rest in view.items()} for view in views)
    if all(len(set(view.values())) == len(view) for view in plain):
        views = (plain[0], plain[1])
    found: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
    for view, by_key in zip(views, found, strict=True):
        for path, key in view.items():
            if key in by_key:
                raise ValueError(f"{path}: and {by_key[key].name} are the same view's; keep one of them")
            by_key[key] = path
    return found


def _given_folders(folder: Path, names: tuple[str, str]) -> tuple[Path, Path]:
    first, second = (_given_folder(folder, name) for name in names)
    return _image_folder(first), _image_folder(second)


def _given_folder(folder: Path, name: str) -> Path:
    """A folder in the source, whether its name is absolute or not; a link in the source may lead out of it.

    Raises:
        ValueError: there is no such folder, or it lies elsewhere.
    """
    path = folder / name
    if not path.is_dir():
        raise ValueError(f"--folders: {path} is not a folder")
    if Path(name).is_absolute() or ".." in Path(name).parts:
        top, place = folder.resolve(), path.resolve()
        if not place.is_relative_to(top):
            raise ValueError(f"--folders: must lie in {folder}, got {name}")
        return folder / place.relative_to(top)
    return path


def _view_folders(folder: Path, depth: int = 0) -> tuple[Path, Path] | None:
    """The folders of the left and the right view, in this folder or in the only one below it that has them.

    Raises:
        ValueError: several pairs of such folders, or only one of the two.
    """
    below = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    by_name: dict[str, list[Path]] = {}
    for path in below:
        by_name.setdefault(path.name.lower(), []).append(path)
    found: list[tuple[Path, Path]] = []
    lonely: list[str] = []
    for names in dict.fromkeys([*_VIEW_FOLDERS, *_said_sides(by_name)]):
        left, right = (by_name.get(name, []) for name in names)
        found += [(_image_folder(first), _image_folder(second)) for first, second in product(left, right)]
        if bool(left) != bool(right):
            lonely.append(f"{(left or right)[0].name}/ but no {names[bool(left)]}/")
    full = [views for views in found if any(map(images, views))]
    found = full if full or images(folder) else found[:1]
    if len(found) > 1:
        listed = " and ".join(f"{left.relative_to(folder)},{right.relative_to(folder)}" for left, right in found)
        raise ValueError(f"{folder}: has several pairs of folders; choose one by --folders from {listed}")
    if found:
        return found[0]
    if images(folder) or depth == _DEEPEST_FOLDER:
        return None
    deeper = [views for path in below if (views := _view_folders(path, depth + 1)) is not None]
    if len(deeper) > 1:
        raise ValueError(
            f"{folder}: has several recordings, such as {deeper[0][0]} and {deeper[1][0]}; import them one by one"
        )
    if lonely and not deeper:
        raise ValueError(f"{folder}: has {lonely[0]}; choose the two by --folders LEFT,RIGHT")
    return deeper[0] if deeper else None


def _said_sides(names: Iterable[str]) -> list[tuple[str, str]]:
    """The pairs of names that would be equal but for left and right, for each name that says one of them."""
    pairs = []
    for name in names:
        for side, other in (("left", "right"), ("right", "left")):
            if side in name:
                pair = (name, name.replace(side, other))
                pairs.append(pair if side == "left" else (pair[1], pair[0]))
    return pairs


def _image_folder(view: Path) -> Path:
    """A view's folder, or the only folder in it, such as EuRoC's and KITTI's `data`, where that has the images."""
    if images(view):
        return view
    below = [path for path in view.iterdir() if path.is_dir() and not path.name.startswith(".") and images(path)]
    return below[0] if len(below) == 1 else view


def _stem(path: Path) -> str:
    """The name without its suffix; macOS writes letters with accents in another form of Unicode than other systems."""
    return unicodedata.normalize("NFC", path.stem)


def _rest_of_view(stem: str, eye: int) -> str:
    """The name of a file in the folder of a view, without the word that says the view."""
    side, rest = _side(stem)
    return rest if side == eye else stem


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


def _with_times(pairs: list[tuple[Path, Path]], rests: dict[Path, str], rate_hz: float | None) -> FolderPairs:
    """The pairs in the order of their times, where something says them, else in the order of their names.

    Args:
        pairs: as their names say.
        rests: of all files of the views: their names without the word that says the view. Without times each has its
            place in the order, those without a partner too: a camera had lost their partners.
        rate_hz: pairs per second, or None. [Hz]

    Raises:
        ValueError: no pair's files are there, or a list of times that does not fit.
    """
    faults = {path: fault for path in rests if (fault := _file_fault(path)) is not None}
    whole = [pair for pair in pairs if faults.keys().isdisjoint(pair)]
    if not whole:
        path = next(path for path in pairs[0] if path in faults)
        raise ValueError(f"{path}: {faults[path]}; no pair of these images is whole")
    used = {path for pair in whole for path in pair}
    left_out = [f"{path}: {faults.get(path, 'has no partner')}" for path in rests if path not in used]
    if rate_hz is None:
        names = [rests[left] for left, _ in whole]
        times_ns, source = _stamps(names), "the time stamps in the names"
        if times_ns is None:
            times_ns, source = _listed_times(whole[0][0].parent, names)
        if times_ns is not None:
            order = sorted(range(len(whole)), key=times_ns.__getitem__)
            times_s = [1e-9 * times_ns[place] for place in order]
            return FolderPairs([whole[place] for place in order], times_s, source, left_out)
        rate_hz, source = _RATE_HZ, f"{_RATE_HZ:g} pairs a second; assumed, without --rate"
    else:
        source = f"{rate_hz:g} pairs a second (--rate)"
    alone = rests.keys() - {path for pair in pairs for path in pair}
    every = sorted([*pairs, *((path, path) for path in alone)], key=lambda pair: _in_number_order(rests[pair[0]]))
    places = [place for place, pair in enumerate(every) if used.issuperset(pair)]
    ordered, times_s = [every[place] for place in places], [place / rate_hz for place in places]
    return FolderPairs(ordered, times_s, source, left_out)


def _file_fault(path: Path) -> str | None:
    """Why an image cannot be read, or None for a regular file."""
    if path.is_file():
        return None
    return "is no regular file" if path.exists() else "is a link to a file that is missing; fetch it"


def _stamps(names: Iterable[str]) -> list[int] | None:
    """The time stamps in names, or None where one has none or several, or two have different forms. [ns]"""
    times, forms = [], set()
    for name in names:
        found = list(_STAMP.finditer(name))
        if len(found) != 1:
            return None
        *whole, seconds, fraction = found[0].groups()
        form = next((place for place, digits in enumerate(whole) if digits), len(whole))
        forms.add(form)
        if seconds is not None:
            times.append(int(seconds) * _NANOSECONDS + int(fraction.ljust(9, "0")))
        else:
            times.append(int(whole[form]) * _STAMP_UNITS_NS[form])
    return times if len(forms) == 1 else None


def _listed_times(folder: Path, names: list[str]) -> tuple[list[int] | None, str]:
    """Times from KITTI's list beside the images or above them, whose lines belong to the files numbered from 0."""
    for path in (above / name for above in (folder, folder.parent) for name in _TIME_LISTS):
        if not path.is_file():
            continue
        try:
            lines = read_text(path, MOST_BYTES).split("\n")
            while lines and not lines[-1].strip():
                lines.pop()
            times_ns = [_line_time(line.strip()) for line in lines]
            other = next((name for name in names if not name.isdecimal()), None)
            if other is not None:
                raise ValueError(f"{other!r} has no such number")
            return [times_ns[int(name)] for name in names], str(path)
        except (OSError, ValueError, IndexError, OverflowError) as error:
            raise ValueError(
                f"{path}: must list a time a line for the files numbered from 0 (--rate ignores it): {error}"
            ) from error
    return None, ""


def _line_time(line: str) -> int:
    """`2011-09-26 13:02:25.964389445` or seconds, in ns."""
    day, is_date, clock = line.partition(" ")
    if not is_date:
        return round(float(line) * _NANOSECONDS)
    clock, _, fraction = clock.partition(".")
    whole = datetime.strptime(f"{day} {clock}", "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return int(whole.timestamp()) * _NANOSECONDS + int(fraction.ljust(9, "0")[:9])


class ImageFolder:
    """The pairs of a folder; images are read on demand.

    Attributes:
        count: number of pairs.
        left_out: files that belong to no pair.
        remarks: what was understood.
    """

    def __init__(self, folder: Path, found: FolderPairs, width_px: int) -> None:
        """Take the pairs.

        Args:
            folder: all of it; the images' names are paths in it.
            found: the files.
            width_px: of one view.
        """
        self._folder, self._found, self._width_px = folder, found, width_px
        self.count = len(found.pairs)
        self.left_out: tuple[str, ...] = tuple(found.left_out)
        self.remarks: tuple[str, ...] = (f"times: {found.times_from}",)

    def __iter__(self) -> Iterator[ImportedPair]:
        for (left, right), time_s in zip(self._found.pairs, self._found.times_s, strict=True):
            if self._found.is_side_by_side:
                both, is_turned = read_image(left)
                if both.shape[1] != 2 * self._width_px:
                    raise ValueError(
                        f"{left}: must be two views of {self._width_px} px side by side, or have a partner named "
                        f"left or right, got a width of {both.shape[1]} px"
                    )
                views = both[:, : self._width_px], both[:, self._width_px :]
                yield ImportedPair((self._name(left), self._name(left)), time_s, *views, turned_count=int(is_turned))
            else:
                (first, is_turned), (second, is_other_turned) = read_image(left), read_image(right)
                names = (self._name(left), self._name(right))
                yield ImportedPair(names, time_s, first, second, turned_count=is_turned + is_other_turned)

    def _name(self, path: Path) -> str:
        return path.relative_to(self._folder).as_posix()
