"""Standard output and error as they may be: closed, a pipe that nobody reads any more, a full disk, a terminal.

A command does its work whatever becomes of its output, and its exit code keeps its meaning. Only results that cannot be
written are an error.
"""

from __future__ import annotations

import io
import os
import sys
from typing import Any, TextIO

_STANDARD_INPUT, _STANDARD_OUTPUT, _STANDARD_ERROR = 0, 1, 2
# Terminals obey control characters: C0 but tab and line feed, DEL, C1; and those that turn the direction of text.
_OBEYED = [*range(0x20), *range(0x7F, 0xA0), 0x2028, 0x2029, *range(0x202A, 0x202F), *range(0x2066, 0x206A)]
_SHOWN = {code: ascii(chr(code))[1:-1] for code in _OBEYED if chr(code) not in "\t\n"}


def printable(text: str) -> str:
    """A text with the characters that a terminal would obey escaped, as Python does it in source code."""
    return text.translate(_SHOWN)


class _Descriptor(io.FileIO):
    """A standard stream; what cannot be written is dropped, after one error where the stream is for results."""

    def __init__(self, descriptor: int, name: str, holds_results: bool) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self._name, self._holds_results, self._is_lost = name, holds_results, False

    def write(self, data: Any, /) -> int:
        """Write, or drop.

        Raises:
            OSError: results cannot be written, such as to a full disk; names the stream.
        """
        if not self._is_lost:
            try:
                return super().write(data)
            except OSError as error:
                self._is_lost = True
                # A reader such as `head` has seen what it wanted.
                if self._holds_results and not isinstance(error, BrokenPipeError):
                    raise OSError(error.errno, error.strerror, self._name) from error
        return memoryview(data).nbytes


class _PlainText(io.TextIOWrapper):
    """Text without control characters: names and messages may come from anybody's files."""

    def __init__(self, descriptor: _Descriptor, encoding: str, line_buffering: bool) -> None:
        # A name that is not UTF-8 has characters without an encoding.
        options: Any = {"encoding": encoding, "errors": "backslashreplace", "line_buffering": line_buffering}
        super().__init__(io.BufferedWriter(descriptor), **options)
        self.unfiltered = io.TextIOWrapper(self.buffer, **options)

    def write(self, text: str, /) -> int:
        """Write it in its printable form."""
        return super().write(printable(text))


def guard_standard_streams() -> None:
    """Let this process write to its standard output and error in whatever state they are."""
    for descriptor in (_STANDARD_INPUT, _STANDARD_OUTPUT, _STANDARD_ERROR):
        try:
            os.fstat(descriptor)
        except OSError:
            # Otherwise the next file that is opened would take the descriptor, and with it what libraries print.
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != descriptor:
                os.dup2(opened, descriptor)
                os.close(opened)
    sys.stdin = sys.stdin or os.fdopen(_STANDARD_INPUT)
    out, err = sys.stdout, sys.stderr
    results = _Descriptor(_STANDARD_OUTPUT, "standard output", holds_results=True)
    sys.stdout = _PlainText(results, out.encoding if out is not None else "utf-8", os.isatty(_STANDARD_OUTPUT))
    remarks = _Descriptor(_STANDARD_ERROR, "standard error", holds_results=False)
    sys.stderr = _PlainText(remarks, err.encoding if err is not None else "utf-8", line_buffering=True)


def terminal_stream() -> TextIO:
    """Standard error for a program that moves the terminal's cursor, such as a progress bar."""
    return sys.stderr.unfiltered if isinstance(sys.stderr, _PlainText) else sys.stderr
