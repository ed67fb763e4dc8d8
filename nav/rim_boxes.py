"""Where a pose lets the drogue's rim be seen."""

from __future__ import annotations

import numpy as np

from geometry.circles import disc_outline
from geometry.se3 import RigidTransform
from geometry.stereo import Eye, StereoRig
from nav.detector.interface import Detection, StereoDetection

_OUTLINE_POINTS = 32
# Of a drogue of which the image shows less, too few markers are left.
_LEAST_SHARE_IN_IMAGE = 0.5
# A box smaller than this on an image is none.
_LEAST_SIDE_PX = 3.0

Box = tuple[float, float, float, float]


def rim_boxes(rig: StereoRig, rim_radius_m: float, left_from_drogue: RigidTransform) -> StereoDetection:
    """Boxes around the rim in both images; None for an eye that sees less than half of it."""
    outline_m = disc_outline(left_from_drogue, np.zeros(3), rim_radius_m, _OUTLINE_POINTS)
    if not outline_m[:, 2].min() > 0:
        return StereoDetection(None, None)
    return StereoDetection(_detection(rig, outline_m, "left"), _detection(rig, outline_m, "right"))


def _detection(
    rig: StereoRig, outline_m: np.ndarray[tuple[int, ...], np.dtype[np.float64]], eye: Eye
) -> Detection | None:
    points_px = rig.image(outline_m, eye)
    (left, top), (right, bottom) = points_px.min(axis=0).tolist(), points_px.max(axis=0).tolist()
    box = (left, top, right - left, bottom - top)
    size_px = (rig.camera.width_px, rig.camera.height_px)
    inside = overlap_px2(box, (-0.5, -0.5, *size_px))
    # Far outside a lens's view its polynomial may end in no number, of which neither holds.
    is_seen = min(box[2:]) >= _LEAST_SIDE_PX and inside >= _LEAST_SHARE_IN_IMAGE * box[2] * box[3]
    return Detection(box, 1.0) if is_seen else None


def overlap_px2(one: Box, other: Box) -> float:
    """Area that two boxes share. [px^2]"""
    width = min(one[0] + one[2], other[0] + other[2]) - max(one[0], other[0])
    height = min(one[1] + one[3], other[1] + other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)


def overlap_fraction(one: Box, other: Box) -> float:
    """Intersection over union of two boxes."""
    shared = overlap_px2(one, other)
    union = one[2] * one[3] + other[2] * other[3] - shared
    return shared / union if union > 0 else 0.0
