"""How much of the drogue an image shows."""

from __future__ import annotations

import numpy as np

from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from geometry.stereo import Eye

LEAST_SEEN_FRACTION = 0.5
"""A drogue of which a smaller share is seen is neither to be found nor missed (our choice)."""

# The pixel centres next to a marker's own, from its nearest. [px]
_AROUND = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)


def seen_fraction(record: PairRecord, eye: Eye) -> float:
    """How much of the drogue an image shows: the lesser of two shares, 0 where nothing is seen.

    They are the visible box's area over the full one's, which falls where the image's edge cuts the drogue off, and the
    mean visible fraction of the markers, which falls where something stands before it too. Where the markers on the
    image are so small that no pixel centre lies in any, they tell nothing, and only the first share counts.
    """
    view = record.views.left if eye == "left" else record.views.right
    full, visible = view.box_full_xywh_px, view.box_visible_xywh_px
    if full is None or visible is None:
        return 0.0
    share = visible[2] * visible[3] / (full[2] * full[3])
    fractions = [marker.visible_fraction for marker in view.markers]
    if not fractions or not (any(fractions) or _covers_pixels(record, eye)):
        return share
    return min(share, float(np.mean(fractions)))


def _covers_pixels(record: PairRecord, eye: Eye) -> bool:
    """Whether a pixel centre lies in a marker, whatever stands before it; also where no marker is on the image."""
    view = record.views.left if eye == "left" else record.views.right
    pose, drogue, rig = record.left_from_drogue, record.frame.drogue, record.frame.rig
    on_image = [marker.in_image for marker in view.markers]
    if pose is None or drogue is None or not any(on_image):
        return True
    layout = marker_layout(drogue)
    centers_px = np.array([marker.center_ellipse_px for marker in view.markers])[on_image]
    centers_m = (pose.apply(layout.centers_m) - rig.eye_offset_m(eye))[on_image]
    rays = rig.rays(np.rint(centers_px)[:, None] + _AROUND, eye)
    # Where the rays through the pixels meet the plane of their marker.
    normal = pose.rotation[:, 2]
    points_m = rays * ((centers_m @ normal)[:, None] / (rays @ normal))[..., None]
    return bool((np.linalg.norm(points_m - centers_m[:, None], axis=-1) <= layout.radius_m).any())
