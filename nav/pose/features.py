"""Known places and measured images of a drogue's features, for many frames at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig
from nav.pose.interface import Observation


@dataclass(frozen=True, eq=False)
class Features:
    """B frames, E eyes and F features: the N markers, and after them the hub's inner and outer edge where it is used.

    Attributes:
        camera: of every eye.
        eye_x_m: (E,) places of the eyes along x of the left camera.
        points_m: (F, 3) centres in the drogue frame.
        radii_m: (F,) of the disc or edge.
        ring: (F,) 1 for features that move with the ring's radius, 0 for others.
        ring_sigma: standard deviation of the ring's radius as a share of it; 0 leaves the radius fixed.
        measured: (5, B, E, F) horizontal and vertical pixel, and the entries `a, b, c` of the whitening matrix
            `[[a, 0], [b, c]]`; all zero where a feature was not measured.
    """

    camera: PinholeCamera
    eye_x_m: Array
    points_m: Array
    radii_m: Array
    ring: Array
    ring_sigma: float
    measured: Array

    @property
    def frames(self) -> int:
        """Number of frames B."""
        return int(self.measured.shape[1])

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(B, E, F) which features were measured."""
        seen: NDArray[np.bool_] = self.measured[2] > 0
        return seen

    def take(self, frames: NDArray[np.int64] | slice) -> Features:
        """The features of some frames, in that order; a frame may appear often."""
        return replace(self, measured=self.measured[:, frames])

    def without(self, mask: NDArray[np.bool_]) -> Features:
        """The same frames without the measurements of `mask`, (B, E, F) or what broadcasts to it."""
        return replace(self, measured=np.where(mask, 0.0, self.measured))


def stack_features(
    rig: StereoRig, layout: MarkerLayout, pixels_px: Array, cov_px2: Array, ring_tolerance_m: float = 0.0
) -> Features:
    """Features of many frames from plain arrays.

    Args:
        rig: the stereo rig.
        layout: the drogue's markers and hub.
        pixels_px: (B, E, F, 2) with E = 1 (left eye) or 2 and F = N, or N + 2 with the hub's inner and outer edge; nan
            where nothing was measured.
        cov_px2: their covariances, (B, E, F, 2, 2) or what broadcasts to it.
        ring_tolerance_m: standard deviation of the ring's radius, 0 for a ring exactly as built.

    Raises:
        ValueError: an array of another shape, or a tolerance of markers that lie on no circle.
    """
    with_hub = pixels_px.shape[2:3] == (layout.count + 2,) and layout.hub_center_m is not None
    count = layout.count + 2 * with_hub
    if pixels_px.ndim != 4 or pixels_px.shape[1] not in (1, 2) or pixels_px.shape[2:] != (count, 2):
        raise ValueError(f"pixels_px: must have shape (B, 1 or 2, {count}, 2), got {pixels_px.shape}")
    if ring_tolerance_m > 0 and layout.ring_radius_m is None:
        raise ValueError("ring_tolerance_m: the markers lie on no circle about the origin, leave it 0")
    points, radii = layout.centers_m, np.full(layout.count, layout.radius_m)
    if with_hub and layout.hub_center_m is not None:
        points = np.vstack([points, layout.hub_center_m, layout.hub_center_m])
        radii = np.append(radii, [layout.hub_inner_radius_m, layout.hub_outer_radius_m])
    return Features(
        rig.camera,
        np.array([rig.eye_offset_m(eye)[0] for eye in EYES[: pixels_px.shape[1]]]),
        points,
        radii,
        (np.arange(count) < layout.count).astype(np.float64),
        ring_tolerance_m / layout.ring_radius_m if layout.ring_radius_m else 0.0,
        _measured(pixels_px, cov_px2),
    )


def observed_features(observation: Observation, with_hub: bool) -> Features:
    """The features of one stereo pair."""
    pixels, cov = observation.pixels_px, observation.cov_px2
    if with_hub and observation.hub_seen.any():
        assert observation.hub_px is not None
        assert observation.hub_cov_px2 is not None
        pixels = np.concatenate([pixels, observation.hub_px], axis=1)
        cov = np.concatenate([cov, observation.hub_cov_px2], axis=1)
    return stack_features(observation.rig, observation.layout, pixels[None], cov[None], observation.ring_tolerance_m)


def left_features(observation: Observation) -> Features:
    """The markers of the left eye alone."""
    return stack_features(
        observation.rig,
        observation.layout,
        observation.pixels_px[None, :1],
        observation.cov_px2[None, :1],
        observation.ring_tolerance_m,
    )


def _measured(pixels_px: Array, cov_px2: Array) -> Array:
    cov = np.broadcast_to(cov_px2, (*pixels_px.shape, 2))
    # Not measured is nan; comparisons with nan are false, so the roots below are taken of sound numbers only.
    first, across = cov[..., 0, 0], cov[..., 0, 1]
    seen = np.isfinite(pixels_px).all(axis=-1) & (first > 0)
    first = np.where(seen, first, 1.0)
    second = np.where(seen, cov[..., 1, 1], 1.0) - np.where(seen, across, 0.0) ** 2 / first
    seen &= second > 0
    a = 1 / np.sqrt(first)
    c = 1 / np.sqrt(np.where(seen, second, 1.0))
    b = -np.where(seen, across, 0.0) / first * c
    measured: Array = np.where(seen, np.stack([pixels_px[..., 0], pixels_px[..., 1], a, b, c]), 0.0)
    return measured
