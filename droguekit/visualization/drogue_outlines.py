"""The circles of a drogue that show its pose in an image: rim, opening, markers, hub."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from drogue_models.parameters import DrogueParameters
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig

# Circles nearer to the camera's plane than this are not drawn. [m]
NEAREST_M = 0.05
# The chords of a rim of 700 px diameter are then at most 0.4 px off, less than the line width.
RIM_POINTS, MARKER_POINTS = 96, 32


class Ring(NamedTuple):
    """A circle perpendicular to the drogue's axis, in the drogue frame. [m]"""

    kind: Literal["rim", "opening", "marker", "hub"]
    center_m: tuple[float, float, float]
    radius_m: float
    points: int


def drogue_rings(drogue: DrogueParameters) -> tuple[Ring, ...]:
    """The circles of a drogue, large ones first."""
    middle = (0.0, 0.0, 0.0)
    rings = [
        Ring("rim", middle, drogue.rim_radius_m, RIM_POINTS),
        Ring("opening", middle, drogue.opening_radius_m, RIM_POINTS),
    ]
    rings += [Ring("marker", center, drogue.marker_radius_m, MARKER_POINTS) for center in drogue.marker_centers_m]
    if drogue.hub is not None:
        center = (0.0, 0.0, drogue.hub.depth_m)
        radii = (drogue.hub.outer_radius_m, drogue.hub.inner_radius_m)
        rings += [Ring("hub", center, radius_m, MARKER_POINTS) for radius_m in radii]
    return tuple(rings)


def ring_images(rings: tuple[Ring, ...], pose: RigidTransform, rig: StereoRig, eye: Eye) -> list[Array]:
    """Project circles into the image of an eye, with lens distortion.

    Args:
        rings: of the drogue.
        pose: `left_from_drogue`.
        rig: the cameras.
        eye: which image.

    Returns:
        (M, 2) corners of a closed line for each ring, in order [px], without rings that reach behind the camera.
    """
    outlines = [disc_outline(pose, ring.center_m, ring.radius_m, ring.points) for ring in rings]
    shown = [outline for outline in outlines if outline[:, 2].min() > NEAREST_M]
    return [np.asarray(rig.image(outline, eye)) for outline in shown]
