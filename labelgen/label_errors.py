"""How far labels may be off: limits from the record, and how closely its part ids confirm them.

Labels follow from the pose at mid-exposure in closed form, so that arithmetic alone leaves a millionth of a pixel. The
picture shows the whole exposure, over which a feature's path may bend and a box moves; and a box of visible pixels ends
where pixels do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.records import FeatureView, PairRecord, PixelBox
from drogue_models.marker_layout import marker_layout
from geometry.circles import disc_image_centers
from geometry.se3 import Array
from geometry.stereo import Eye
from labelgen.disc_images import DiscInEye, marker_discs
from labelgen.part_pixels import FeaturePixels, drogue_box

ARITHMETIC_PX = 1e-6
"""Projections in float64 agree far better, as `droguekit validate` checks with OpenCV's. [px]"""

# Root mean square distance between the centroid of the pixel centres in a disc and the disc's own centre is this times
# sqrt(a) / b for semi-axes a >= b in pixels: each of the boundary's 2 pi a pixels errs by a variance of 1/12 px^2 at a
# lever of a / sqrt 2, over an area of pi a b: sqrt(2 a / (12 pi b^2)).
LATTICE_RMS = float(np.sqrt(2.0 / (12.0 * np.pi)))

# The largest of 1e5 simulated discs was 2.9 rms; unlike a normal error, this one is bounded.
LATTICE_LIMIT_RMS = 4.0

Sides = tuple[float, float, float, float]


@dataclass(frozen=True)
class LabelErrors:
    """Limits on the errors of one eye's labels of the drogue, against a picture without noise.

    Attributes:
        markers_px: for every marker, of `center_ellipse_px` against the centroid of its light. [px]
        hub_px: of the hub's; None without a hub. [px]
        box_full_px: of the left, upper, right and lower side of `box_full_xywh_px`, against the drogue's extent at any
            time of the exposure. [px]
        box_visible_px: likewise of `box_visible_xywh_px`, against what is seen of the drogue. [px]
    """

    markers_px: tuple[float, ...]
    hub_px: float | None
    box_full_px: Sides
    box_visible_px: Sides


def label_errors(record: PairRecord, eye: Eye) -> LabelErrors | None:
    """Limits on the errors of one eye's labels, or None in a frame without a drogue.

    A centre that moves by a parabola during the exposure shines on average a sixth of its second difference from its
    place at mid-exposure; a steady move shifts nothing. Outer pixels of a drogue lie with their centres on it, so that
    its edge is less than a pixel beyond them and the box ends in the middle of that interval; parts that are thinner
    than a pixel may reach farther.

    Args:
        record: the truth.
        eye: which image.

    Raises:
        ValueError: part of the drogue is not in front of the camera while the shutter is open.
    """
    drogue, pose = record.frame.drogue, record.left_from_drogue
    if drogue is None or pose is None:
        return None
    rig, layout = record.frame.rig, marker_layout(drogue)
    view = record.views.left if eye == "left" else record.views.right
    ends = record.left_from_drogue_open or pose, record.left_from_drogue_close or pose
    centers_m, radii_m = layout.centers_m, np.full(layout.count, layout.radius_m)
    features: list[FeatureView] = list(view.markers)
    if layout.hub_center_m is not None and view.hub is not None:
        centers_m = np.vstack([centers_m, layout.hub_center_m])
        radii_m = np.append(radii_m, layout.hub_outer_radius_m)
        features.append(view.hub)
    bent = np.zeros(0)
    if features:
        middle = np.array([feature.center_ellipse_px for feature in features])
        begun, ended = (disc_image_centers(rig, at, centers_m, radii_m, eye) for at in ends)
        bent = np.linalg.norm(begun - 2.0 * middle + ended, axis=-1) / 6.0 + ARITHMETIC_PX
    moved = np.zeros(4)
    if view.box_full_xywh_px is not None:
        middle = _sides(view.box_full_xywh_px)
        moved = np.max([np.abs(_sides(drogue_box(drogue, rig, at, eye)) - middle) for at in ends], axis=0)
    full, visible = (moved + least for least in (ARITHMETIC_PX, 0.5))
    count = len(view.markers)
    hub = float(bent[count]) if len(features) > count else None
    return LabelErrors(tuple(bent[:count].tolist()), hub, _four(full), _four(visible))


def _sides(box: PixelBox) -> Array:
    """(4,) left, upper, right and lower side. [px]"""
    u, v, width, height = box
    return np.array([u, v, u + width, v + height])


def _four(sides: Array) -> Sides:
    left, upper, right, lower = sides.tolist()
    return left, upper, right, lower


def centroid_error(view: FeatureView, disc: DiscInEye, pixels: FeaturePixels) -> tuple[Array, float]:
    """Centroid of a marker's pixels less `center_ellipse_px`.

    Returns:
        (2,) error [px], and the root mean square length that the pixel lattice alone gives it [px].
    """
    longer, shorter = disc.semi_axes_px()
    rows, columns = pixels.indices(disc.part)
    error = np.array([columns.mean(), rows.mean()]) - np.array(view.center_ellipse_px)
    return error, LATTICE_RMS * float(np.sqrt(longer)) / shorter


def confirmed_px(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> tuple[float | None, ...]:
    """For every marker, the distance from its label within which the part ids confirm it. [px]

    It is the distance of the centroid of its pixels and the most that the pixel lattice can shift that; None where the
    marker is not wholly seen. Larger than the label's own error, for pixels tell no more.

    Args:
        record: the truth.
        eye: which image.
        part_id: (H, W) its part ids.
    """
    drogue, pose = record.frame.drogue, record.left_from_drogue
    if drogue is None or pose is None:
        return ()
    view = record.views.left if eye == "left" else record.views.right
    pixels = FeaturePixels(part_id)
    found: list[float | None] = []
    for marker, disc in zip(
        view.markers, marker_discs(marker_layout(drogue), record.frame.rig, pose, eye), strict=True
    ):
        if not marker.in_image or marker.visible_fraction < 1 or not pixels.count(disc.part):
            found.append(None)
            continue
        error, rms_px = centroid_error(marker, disc, pixels)
        found.append(float(np.hypot(*error)) + LATTICE_LIMIT_RMS * rms_px)
    return tuple(found)
