"""A file of estimates that has every line as soon as it is written, whatever ends the run."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

from datasets_manifest.atomic import is_stream, try_lock

if TYPE_CHECKING:
    from datasets_manifest.types.estimates import Estimate

PART_SUFFIX = ".part"
"""Of the name under which estimates that replace an older file are kept until all are there."""


class EstimateFile:
    """Estimates line by line, each on the disk before the next one is computed, and no half line."""

    def __init__(self, path: Path) -> None:
        """Create a writer.

        Args:
            path: a new file, or one that is replaced once all estimates are there; until then they are in a file of the
                same name with `.part` behind it. A pipe or a device is written to directly.
        """
        self._path, self._lines, self._size = path, 0, 0
        replaces = path.is_file() and not is_stream(path)
        self._part = path.with_name(path.name + PART_SUFFIX) if replaces else path

    def __enter__(self) -> Self:
        """Open the file.

        Raises:
            ValueError: another process writes it.
            OSError: it cannot be written.
        """
        with ExitStack() as opened:
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                if self._part != self._path:
                    self._claim(opened.enter_context(self._path.open("rb")))
                # Without a buffer, nothing is lost when the process dies.
                self._file: Any = opened.enter_context(self._part.open("ab", buffering=0))
                if not is_stream(self._part):
                    self._claim(self._file)
                    self._file.truncate(0)
            except OSError as error:
                raise OSError(error.errno, f"{self._path}: cannot be written: {error.strerror}") from error
            self._opened = opened.pop_all()
        return self

    def _claim(self, file: BinaryIO) -> None:
        """Refuse a file that another run writes: it would lose its estimates."""
        with suppress(OSError):  # a file system without locks
            if not try_lock(file):
                raise ValueError(f"{self._path}: another run is writing it; wait for its end, or name another file")

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        with self._opened:  # no other run may take the file until it has its name
            if kind is not None and not self._lines:
                self.remove()
            elif kind is None and self._part != self._path:
                try:
                    self._part.replace(self._path)
                except OSError as error:
                    text = f"{self._path}: cannot be replaced: {error.strerror}; the estimates are in {self._part}"
                    raise OSError(error.errno, text) from error

    def write(self, estimate: Estimate) -> None:
        """Append a line.

        Raises:
            OSError: it cannot be written; the lines before it are whole.
        """
        line = memoryview(estimate.model_dump_json().encode() + b"\n")
        written = 0
        try:
            while written < len(line):
                written += self._file.write(line[written:])
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._size)
            place = "" if self._part == self._path else f" in {self._part}"
            text = f"{self._path}: cannot be written: {error.strerror}"
            text += f"; the {self._lines} estimates before are kept{place}"
            raise OSError(error.errno, text) from error
        self._lines += 1
        self._size += written

    def remove(self) -> None:
        """Delete a file in which there is nothing yet."""
        if self._part.is_file():
            self._part.unlink()
