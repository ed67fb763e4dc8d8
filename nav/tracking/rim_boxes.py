"""Image boxes around the drogue's rim in a pose."""

from __future__ import annotations

import numpy as np

from geometry.boxes import intersection_area
from geometry.circles import disc_outline
from geometry.se3 import RigidTransform
from geometry.stereo import Eye, StereoRig
from nav.detector.detector import Detection, StereoDetection

_OUTLINE_POINTS = 32
# With less of the box on the image, too few markers are left.
_SMALLEST_VISIBLE_SHARE = 0.5
# Smaller boxes are discarded.
_SMALLEST_SIDE_PX = 3.0


def rim_boxes(rig: StereoRig, rim_radius_m: float, left_from_drogue: RigidTransform) -> StereoDetection:
    """Boxes around the rim in both images; None for an eye whose image shows less than half of the box."""
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
    inside = intersection_area(box, (-0.5, -0.5, *size_px))
    # Far outside the field of view the lens polynomial may overflow to nan, for which both comparisons are false.
    is_visible = min(box[2:]) >= _SMALLEST_SIDE_PX and inside >= _SMALLEST_VISIBLE_SHARE * box[2] * box[3]
    return Detection(box, 1.0) if is_visible else None
