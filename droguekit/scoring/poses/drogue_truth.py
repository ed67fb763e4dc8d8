"""What a record says of the drogue: pose, features in both images, and how much of it each image shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.records import FeatureView, PairRecord, ViewRecord
from drogue_models.marker_layout import MarkerLayout, marker_layout
from droguekit.scoring.poses.cramer_rao import stereo_jacobian
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig

# The centroid of a feature that is cut off is not the centre of its ellipse: it is neither scored nor counted in the
# bound. A few hidden pixels at the edge (our choice: a tenth) still leave it a measurement of that centre.
VISIBLE_FRACTION = 0.9


@dataclass(frozen=True, eq=False)
class DrogueTruth:
    """The true drogue of one pair.

    Features are in one order everywhere: the markers, then the hub where there is one. The first axis of the images is
    the eye, left before right.

    Attributes:
        left_from_drogue: pose at mid-exposure.
        rig: the cameras.
        layout: the drogue's features.
        centers_px: (2, M, 2) centres of the image ellipses. [px]
        visible: (2, M) whether the feature lies in the image and is visible.
        sequence_id: of the sequence that the pair belongs to, or None for a single one.
        rangefinder_reading_m: distance that a rangefinder reads, or None without one. [m]
    """

    left_from_drogue: RigidTransform
    rig: StereoRig
    layout: MarkerLayout
    centers_px: Array
    visible: NDArray[np.bool_]
    sequence_id: int | None = None
    rangefinder_reading_m: float | None = None

    @cached_property
    def jacobian(self) -> Array:
        """(2, M, 2, 7) see `cramer_rao.stereo_jacobian`."""
        return stereo_jacobian(self.rig, self.left_from_drogue, self.layout)

    @property
    def distance_m(self) -> float:
        """Z of the rim's centre in the left camera. [m]"""
        return float(self.left_from_drogue.translation_m[2])


_cached_layout = lru_cache(maxsize=64)(marker_layout)


def drogue_truth(record: PairRecord) -> DrogueTruth | None:
    """The drogue of a pair, or None where there is none.

    Raises:
        ValueError: the record's features are not those of its drogue.
    """
    drogue = record.frame.drogue
    if record.left_from_drogue is None or drogue is None:
        return None
    layout = _cached_layout(drogue)
    eyes = [_features(view) for view in (record.views.left, record.views.right)]
    expected = layout.count + (layout.hub_center_m is not None)
    for features in eyes:
        if len(features) != expected:
            raise ValueError(
                f"frame {record.frame_index}: views: must hold {expected} features like the drogue, got {len(features)}"
            )
    return DrogueTruth(
        left_from_drogue=record.left_from_drogue,
        rig=record.frame.rig,
        layout=layout,
        centers_px=np.array(
            [[feature.center_ellipse_px for feature in features] for features in eyes], dtype=np.float64
        ).reshape(2, expected, 2),
        visible=np.array(
            [[f.in_image and f.visible_fraction >= VISIBLE_FRACTION for f in features] for features in eyes], dtype=bool
        ).reshape(2, expected),
        sequence_id=record.sequence_id,
        rangefinder_reading_m=record.frame.rangefinder_reading_m,
    )


def _features(view: ViewRecord) -> tuple[FeatureView, ...]:
    return view.markers if view.hub is None else (*view.markers, view.hub)


LEAST_SEEN_FRACTION = 0.5
"""A drogue of which a smaller share is seen counts neither as found nor as missed (our choice)."""

# The pixel centres next to a marker's own, from its nearest. [px]
_AROUND = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)


def seen_fraction(record: PairRecord, eye: Eye) -> float:
    """How much of the drogue an image shows: the lesser of two shares, 0 where nothing is seen.

    They are the visible box's area over the full one's, which falls where the image's edge cuts the drogue off, and the
    mean visible fraction of the markers, which also falls where something hides it. Where the markers on the
    image are so small that no pixel centre lies in any, they say nothing, and only the first share counts.
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
    """Whether a pixel centre lies in a marker, hidden or not; also where no marker is on the image."""
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
