"""Turns about the axis that map the body of a drogue onto itself."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from drogue_models.bodies import BasketBody, ConeBody
from drogue_models.drogue_families.user_meshes import load_body_mesh
from drogue_models.parameters import DrogueParameters

# Tried on a user's mesh; one of more sections is told by the largest of their divisors below.
_MOST_TURNS = 96
_MESH_TOLERANCE_M = 1e-4


def body_symmetry_order(drogue: DrogueParameters) -> int:
    """Number of turns that map shape and stripes onto themselves, markers and wear apart; 0 where every turn does.

    Raises:
        ValueError: the user's body mesh is missing, changed, or not fit for use.
    """
    if drogue.body_mesh is not None:
        return _mesh_symmetry_order(drogue)
    body, counts = drogue.body, [drogue.rib_count]
    if body is not None:
        if isinstance(body, ConeBody):
            counts = [body.window_count]
        elif isinstance(body, BasketBody) and body.canopy.style == "segmented":
            counts.append(body.canopy.segment_count)
        counts += [body.coupling.roller_count, body.coupling.bolt_count]
        if body.lamps is not None:
            counts.append(body.lamps.count)
        if body.stripes is not None and not body.stripes.across:
            counts.append(body.stripes.count)
    return math.gcd(*counts)


def _mesh_symmetry_order(drogue: DrogueParameters) -> int:
    vertices_m = np.asarray(load_body_mesh(drogue).vertices)
    places, tree = vertices_m[:, 0] + 1j * vertices_m[:, 1], cKDTree(vertices_m)
    for order in range(_MOST_TURNS, 1, -1):
        turned = places * np.exp(2j * np.pi / order)
        gaps_m, _ = tree.query(
            np.column_stack([turned.real, turned.imag, vertices_m[:, 2]]), distance_upper_bound=2 * _MESH_TOLERANCE_M
        )
        if gaps_m.max() <= _MESH_TOLERANCE_M:
            return order
    return 1
