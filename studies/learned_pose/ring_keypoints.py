"""Keypoints of a ring of equal markers: their order in an image, and the observation that they make.

Equal markers have no names. Keypoints are therefore counted clockwise from the top of the image, about the middle of
the ring, and the marker of the drogue that a keypoint belongs to is known up to a cyclic shift. A shift turns a regular
ring onto itself: it changes the roll of a pose, and neither its position nor its axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig
from nav.pose.pose_method import Observation

# A circle has three unknowns.
_LEAST_FOR_CIRCLE = 3


@dataclass(frozen=True, eq=False)
class EyeKeypoints:
    """Keypoints of one image.

    Attributes:
        points_px: (K, 2) centres of the markers' ellipses, in any order; K may be 0. [px]
        sigma_px: standard deviation of a coordinate. [px]
    """

    points_px: Array
    sigma_px: float

    def __post_init__(self) -> None:
        points = np.array(self.points_px, dtype=np.float64).reshape(-1, 2)
        if not (np.isfinite(points).all() and self.sigma_px > 0):
            raise ValueError(f"keypoints: must be finite with a positive deviation, got {points}, {self.sigma_px}")
        points.flags.writeable = False
        object.__setattr__(self, "points_px", points)


def ring_center(points_px: Array) -> Array:
    """(2,) centre of the circle with the smallest algebraic distances to (K, 2) points, K >= 3. [px]

    Unlike the mean it stays where it is when markers are missing or found twice.

    Source: I. Kasa, IEEE Trans. Instrum. Meas. 25 (1976), doi:10.1109/TIM.1976.6312298.
    """
    middle = points_px.mean(axis=0)
    arms = points_px - middle
    design = np.column_stack([2 * arms, np.ones(len(arms))])
    solution = np.linalg.lstsq(design, (arms**2).sum(axis=1), rcond=None)[0]
    center: Array = middle + solution[:2]
    return center


def angles_from_top(points_px: Array) -> Array:
    """(K,) angles of (K, 2) points about their circle's centre in [0, 2 pi), clockwise in the image from the top."""
    x, y = (points_px - ring_center(points_px)).T
    angles: Array = np.mod(np.arctan2(x, -y), 2 * np.pi)
    return angles


def clockwise_from_top(points_px: Array) -> NDArray[np.intp]:
    """(K,) indices that sort (K, 2) points clockwise from the top of the image."""
    return np.argsort(angles_from_top(points_px), kind="stable")


def ring_slots(points_px: Array, count: int, near_rad: float | None = None) -> tuple[NDArray[np.intp], float]:
    """Places of points in a regular ring, whatever their order and however many are missing or found twice.

    Args:
        points_px: (K, 2), K >= 3.
        count: number of places of the ring.
        near_rad: the ring's phase in another image, from which this one's differs by less than half a step; None for
            the one in the first step from the top.

    Returns:
        (K,) places from 0 to `count` - 1, clockwise, and the phase: the angle of place 0.
    """
    step = 2 * np.pi / count
    angles = angles_from_top(points_px)
    # The mean over a circle on which all places of the ring are one.
    phase = float(np.angle(np.exp(1j * count * angles).mean())) / count
    phase += step * (np.ceil(-phase / step) if near_rad is None else np.round((near_rad - phase) / step))
    slots: NDArray[np.intp] = np.mod(np.round((angles - phase) / step).astype(np.intp), count)
    return slots, phase


def ring_observation(rig: StereoRig, layout: MarkerLayout, eyes: tuple[EyeKeypoints, EyeKeypoints]) -> Observation:
    """The observation of a stereo pair for the pose methods.

    Args:
        rig: the cameras.
        layout: a drogue with a regular ring of markers.
        eyes: keypoints of the left and the right eye. An eye with fewer than three counts as blind; points at the same
            place of the ring count as one, in their mean.

    Raises:
        ValueError: a drogue whose markers are no regular ring in one plane.
    """
    if not layout.is_flat or layout.count < _LEAST_FOR_CIRCLE or layout.symmetry_order != layout.count:
        raise ValueError(f"layout: must be a regular ring of markers, got a symmetry of order {layout.symmetry_order}")
    marker_of_slot = clockwise_from_top(layout.centers_m[:, :2])
    pixels = np.full((len(EYES), layout.count, 2), np.nan)
    cov = np.full((len(EYES), layout.count, 2, 2), np.nan)
    phase: float | None = None
    for eye, found in enumerate(eyes):
        if len(found.points_px) < _LEAST_FOR_CIRCLE:
            continue
        slots, phase = ring_slots(found.points_px, layout.count, phase)
        for slot in np.unique(slots):
            marker = marker_of_slot[slot]
            pixels[eye, marker] = found.points_px[slots == slot].mean(axis=0)
            cov[eye, marker] = found.sigma_px**2 * np.eye(2)
    return Observation(rig, layout, pixels, cov)
