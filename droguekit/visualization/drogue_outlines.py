"""The circles of a drogue by which a pose can be seen in an image: rim, opening, markers, hub."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from drogue_models.parameters import DrogueParameters
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig

# Nearer than this to an eye's plane nothing can be drawn. [m]
NEAREST_M = 0.05
# The chord of a rim of 700 px diameter then leaves it by 0.4 px, less than the line is wide.
RIM_POINTS, MARKER_POINTS = 96, 32


class Ring(NamedTuple):
    """A circle across the drogue's axis, in the drogue frame. [m]"""

    kind: Literal["rim", "opening", "marker", "hub"]
    center_m: tuple[float, float, float]
    radius_m: float
    points: int


def drogue_rings(drogue: DrogueParameters) -> tuple[Ring, ...]:
    """The circles of a drogue, large ones first."""
    middle = (0.0, 0.0, 0.0)
    rings = [
        Ring("rim", middle, drogue.rim_radius_m, RIM_POINTS),
        Ring("opening", middle, drogue.face_inner_radius_m, RIM_POINTS),
    ]
    rings += [Ring("marker", (x, y, 0.0), drogue.marker_radius_m, MARKER_POINTS) for x, y in drogue.marker_positions_m]
    if drogue.hub is not None:
        center = (0.0, 0.0, drogue.hub.depth_m)
        radii = (drogue.hub.outer_radius_m, drogue.hub.inner_radius_m)
        rings += [Ring("hub", center, radius_m, MARKER_POINTS) for radius_m in radii]
    return tuple(rings)


def ring_images(rings: tuple[Ring, ...], pose: RigidTransform, rig: StereoRig, eye: Eye) -> list[Array]:
    """Where the delivered image of an eye shows them.

    Args:
        rings: of the drogue.
        pose: `left_from_drogue`.
        rig: the cameras.
        eye: which image.

    Returns:
        (M, 2) corners of a closed line for each ring, in order [px]; rings that reach behind the eye are left out.
    """
    outlines = [disc_outline(pose, ring.center_m, ring.radius_m, ring.points) for ring in rings]
    shown = [outline for outline in outlines if outline[:, 2].min() > NEAREST_M]
    return [np.asarray(rig.image(outline, eye)) for outline in shown]
