"""The hose as a tube along its centre line."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from drogue_models.solids import loft
from geometry.se3 import Array

RINGS_PER_SEGMENT = 6
SECTIONS = 32
END_FRACTION = 0.005


def hose_mesh(nodes_m: ArrayLike, radius_m: float) -> trimesh.Trimesh:
    """A closed tube along a smooth curve through nodes.

    Vertices and faces depend on the number of nodes only, so that a renderer can move the vertices of a loaded mesh.

    Args:
        nodes_m: (K, 3) centre line, K >= 2, no node twice in a row. [m]
        radius_m: > 0. [m]

    Raises:
        ValueError: nodes of another shape, or two equal neighbours.
    """
    nodes = np.asarray(nodes_m, dtype=np.float64)
    if nodes.ndim != 2 or nodes.shape[0] < 2 or nodes.shape[1] != 3:
        raise ValueError(f"nodes_m: must have shape (K, 3) with K >= 2, got {nodes.shape}")
    if not radius_m > 0:
        raise ValueError(f"radius_m: must be positive, got {radius_m}")
    chord_m = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    if not chord_m.min() > 0:
        raise ValueError("nodes_m: must be finite and neighbours must differ")
    knots = np.concatenate([[0.0], np.cumsum(chord_m)])
    curve = CubicSpline(knots, nodes, bc_type="natural")
    between = np.arange(RINGS_PER_SEGMENT) / RINGS_PER_SEGMENT
    inner = (knots[:-1, None] + chord_m[:, None] * between).ravel()[1:]
    # A ring close to either end keeps the cap's direction out of the tube's interpolated normals.
    ends_m = END_FRACTION * chord_m[[0, -1]]
    at = np.concatenate([[0.0, ends_m[0]], inner, [knots[-1] - ends_m[1], knots[-1]]])
    tangents = curve(at, 1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side, up = _carried_frame(tangents)
    angle = 2 * np.pi * np.arange(SECTIONS) / SECTIONS
    around = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * up[:, None]
    return loft(curve(at)[:, None] + radius_m * around)


def _carried_frame(tangents: Array) -> tuple[Array, Array]:
    """Two (S, 3) unit vectors across the curve that turn with it as little as they can, `side x up = tangent`."""
    side = np.empty_like(tangents)
    seed = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    for index, tangent in enumerate(tangents):
        across = seed - (seed @ tangent) * tangent
        seed = side[index] = across / np.linalg.norm(across)
    return side, np.cross(tangents, side)
