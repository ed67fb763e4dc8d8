"""Wrong input ends a study with one line and the exit code of droguekit's commands, without a traceback."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from droguekit.cli.main import WRONG_INPUT, explain
from droguekit.output_streams import printable


@contextmanager
def wrong_input_ends(study: str) -> Iterator[None]:
    """End the program where an expected error comes: wrong options, or files that are missing, damaged or not writable.

    Args:
        study: name in front of the line.

    Raises:
        SystemExit: with `WRONG_INPUT`, for a ValueError or an OSError.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        print(f"{study}: error: {printable(explain(error))}", file=sys.stderr)
        raise SystemExit(WRONG_INPUT) from error
