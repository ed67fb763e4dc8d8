"""The user's cache folder, and arrays that are kept there until the code that made them changes."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import open_bytes_atomic

Arrays = dict[str, NDArray[Any]]


def user_cache_folder() -> Path:
    """Where processes keep what takes long to find out or to make; it may be deleted at any time.

    `$XDG_CACHE_HOME/droguekit`, else `~/.cache/droguekit`, or a folder that can neither be read nor written for a user
    without a home, as in containers.
    """
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        folder = Path(os.devnull)
    return folder / "droguekit"


def kept_arrays(name: str, sources: Iterable[str], make: Callable[[], Mapping[str, NDArray[Any]]]) -> Arrays:
    """Arrays from the user's cache, or made and then kept there.

    A file that is damaged, or of other code, is made anew. Where nothing can be written nothing is kept.

    Args:
        name: of the arrays' file.
        sources: files of all code that the arrays follow from.
        make: makes the arrays.
    """
    folder = user_cache_folder() / "arrays"
    path = folder / f"{name}-{_digest(tuple(sources))}.npz"
    # Zip files carry checksums of their members, which are compared as they are read; a damaged one may raise anything.
    with suppress(Exception), path.open("rb") as stream, np.load(stream, allow_pickle=False) as kept:
        return {key: kept[key] for key in kept.files}
    made = dict(make())
    with suppress(OSError):
        with open_bytes_atomic(path) as file:
            np.savez(file, **made)
        # Of earlier code, and of processes that were killed; one that is still writing keeps nothing.
        for other in {*folder.glob(f"{name}-*"), *folder.glob(f".{name}-*")} - {path}:
            other.unlink()
    return made


@cache
def _digest(sources: tuple[str, ...]) -> str:
    """Hash of files and of the libraries that compute with arrays."""
    texts = [f"{np.__version__} {cv2.__version__}".encode(), *(Path(source).read_bytes() for source in sources)]
    return hashlib.sha256(b"".join(hashlib.sha256(text).digest() for text in texts)).hexdigest()[:16]
