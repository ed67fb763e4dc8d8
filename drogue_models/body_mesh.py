"""A user's mesh of the drogue's body: read, compared with its hash, and checked before anything is made with it."""

from __future__ import annotations

import hashlib
import io

import numpy as np
import trimesh

from drogue_models.parameters import BodyMesh

# A drogue's body; anything else was most likely drawn in millimetres or inches.
SMALLEST_M, LARGEST_M = 0.05, 10.0
# float32 files round a front at z = 0 by this much for bodies of a few metres.
_FRONT_TOLERANCE_M = 1e-6


def load_body_mesh(body: BodyMesh) -> trimesh.Trimesh:
    """The body in the drogue frame: metres, z from the mouth to the hose, nothing before z = 0.

    Raises:
        ValueError: the file is missing, is not the one the drogue was loaded with, cannot be read as a mesh, or is not
            a closed body of a sane size behind the rim plane.
    """
    file = body.file
    try:
        data = file.read_bytes()
    except OSError as error:
        raise ValueError(
            f"body_mesh: {file} cannot be read: {error.strerror}; a drogue from a dataset looks for its mesh in the "
            "working directory"
        ) from error
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != body.sha256:
        raise ValueError(
            f"body_mesh: {file} has changed since the drogue was loaded; restore the file with sha256 {body.sha256}, "
            f"got {sha256}"
        )
    mesh = _parse(data, file.suffix.lower().removeprefix("."), str(file))
    fault = _fault(mesh)
    if fault:
        raise ValueError(f"body_mesh: {file} {fault}")
    return mesh


def _parse(data: bytes, file_type: str, name: str) -> trimesh.Trimesh:
    readable = sorted(trimesh.available_formats())
    if file_type not in readable:
        raise ValueError(f"body_mesh: {name} is of a kind that cannot be read; use one of {', '.join(readable)}")
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=file_type, process=False)
    except Exception as error:  # each of trimesh's readers fails in its own way
        raise ValueError(f"body_mesh: {name} cannot be read as {file_type}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"body_mesh: {name} holds no triangles; export one mesh of triangles")
    return mesh


def _fault(mesh: trimesh.Trimesh) -> str | None:
    """Why the mesh cannot be used and what to do, or None."""
    if not np.isfinite(mesh.vertices).all():
        return "has vertices that are not finite; export it again"
    # Formats with normals or texture repeat the vertices along their seams.
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    low, high = mesh.bounds
    size_m = float((high - low).max())
    if not SMALLEST_M <= size_m <= LARGEST_M:
        return f"must be {SMALLEST_M:g} to {LARGEST_M:g} m in size, with coordinates in metres, got {size_m:g}"
    if low[2] < -_FRONT_TOLERANCE_M:
        return f"must lie behind the rim plane (z >= 0, z from the mouth to the hose), got z down to {low[2]:g} m"
    if not mesh.is_watertight:
        return "must be closed (watertight); close its holes and export it again"
    if not mesh.is_winding_consistent or mesh.volume <= 0:
        return "must have its normals outwards everywhere; recalculate them and export it again"
    return None
