"""Where the file of a user's mesh is found: in an open dataset, or where the drogue names it."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable

from drogue_models.parameters import BodyMesh
from drogue_models.untrusted_files import read_regular

# Readers of the files that open datasets hold, by hash: what a hash names is the same wherever it is read. Of several
# copies the last opened is tried first, and one that is gone or damaged hides no other.
_stored_meshes: dict[str, deque[Callable[[], bytes]]] = {}
_MOST_COPIES = 16


def offer_body_mesh(sha256: str, read: Callable[[], bytes]) -> None:
    """Let drogues that name a mesh by its hash take it from a copy, wherever their own file is.

    Args:
        sha256: of the file.
        read: its contents; raises OSError where the copy is gone.
    """
    _stored_meshes.setdefault(sha256, deque(maxlen=_MOST_COPIES)).appendleft(read)


def body_mesh_data(body: BodyMesh) -> bytes:
    """Contents of a mesh's file: of a dataset's copy, or of the file that the drogue names.

    Raises:
        ValueError: there is neither, or the file has another hash than when the drogue was loaded.
    """
    for read in _stored_meshes.get(body.sha256, ()):
        try:
            data = read()
        except OSError:
            continue
        if hashlib.sha256(data).hexdigest() == body.sha256:
            return data
    try:
        data = read_regular(body.file)
    except OSError as error:
        raise ValueError(
            f"body_mesh: {body.file} cannot be read: {error.strerror}; a drogue from a dataset looks for its mesh in "
            "the dataset's meshes, then in the working directory"
        ) from error
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != body.sha256:
        raise ValueError(
            f"body_mesh: {body.file} has changed since the drogue was loaded; restore the file with sha256 "
            f"{body.sha256}, got {sha256}"
        )
    return data
