"""What scoring needs of a record, as arrays: pose, cameras, and where every feature stands in both images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.records import FeatureView, PairRecord, ViewRecord
from drogue_models.marker_layout import MarkerLayout, marker_layout
from droguekit.benchmark.poses.bounds import stereo_jacobian
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig

# The centroid of a feature that is cut off is not the centre of its ellipse: it is neither scored nor counted in the
# bound. A few hidden pixels at the edge (our choice: a tenth) still leave it a measurement of that centre.
VISIBLE_FRACTION = 0.9


@dataclass(frozen=True, eq=False)
class DrogueTruth:
    """The drogue of one pair.

    Features are in one order everywhere: the markers, then the hub where there is one. The first axis of the images is
    the eye, left before right.

    Attributes:
        left_from_drogue: pose at mid-exposure.
        rig: the cameras.
        layout: the drogue's features.
        centers_px: (2, M, 2) centres of the image ellipses. [px]
        visible: (2, M) whether the feature lies in the image and is visible.
        sequence_id: of the sequence that the pair belongs to, or None for a single one.
        rangefinder_reading_m: what a rangefinder says of the distance, or None without one. [m]
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
        """(2, M, 2, 7) see `bounds.stereo_jacobian`."""
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
        centers_px=np.array([[feature.center_ellipse_px for feature in features] for features in eyes]),
        visible=np.array(
            [[f.in_image and f.visible_fraction >= VISIBLE_FRACTION for f in features] for features in eyes]
        ),
        sequence_id=record.sequence_id,
        rangefinder_reading_m=record.frame.rangefinder_reading_m,
    )


def _features(view: ViewRecord) -> tuple[FeatureView, ...]:
    return view.markers if view.hub is None else (*view.markers, view.hub)
