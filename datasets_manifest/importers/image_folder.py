"""Stereo pairs of image files: two files a pair, or both views side by side in one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from datasets_manifest.importers.folder_layout import FolderPairs
from datasets_manifest.importers.image_files import read_image
from datasets_manifest.importers.imported_dataset import ImportedPair


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
