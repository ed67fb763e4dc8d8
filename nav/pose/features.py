"""Known places and measured images of a drogue's features, for many frames at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig
from nav.pose.pose_method import Observation
from nav.pose.stated_tolerances import EXACT, StatedTolerances
from nav.pose.whitening import whiten, whiten_displaced


@dataclass(frozen=True, eq=False)
class Features:
    """B frames, E eyes and F features: the N markers, and after them the hub's inner and outer edge where it is used.

    Attributes:
        camera: of every eye.
        eye_x_m: (E,) places of the eyes along x of the left camera.
        points_m: (F, 3) centres in the drogue frame.
        radii_m: (F,) of the disc or edge.
        is_marker: (F,).
        shifts_m: (G, F, 3) displacements of the centres by one standard deviation of each departure from the nominal
            drogue that several features share.
        disparity_sigma_px: standard deviation of the second eye's columns; a departure too, after those, where above 0.
        measured: (5, B, E, F) horizontal and vertical pixel, and the entries `a, b, c` of the whitening matrix
            `[[a, 0], [b, c]]`; all zero where a feature was not measured.
        coupling: (4, B, F) matrices by which the first eye's whitened residuals add to the second's; None for none.
    """

    camera: PinholeCamera
    eye_x_m: Array
    points_m: Array
    radii_m: Array
    is_marker: NDArray[np.bool_]
    shifts_m: Array
    disparity_sigma_px: float
    measured: Array
    coupling: Array | None = None

    @property
    def frames(self) -> int:
        """Number of frames B."""
        return int(self.measured.shape[1])

    @property
    def departures(self) -> int:
        """Number of unknown departures from the nominal drogue and rig."""
        return len(self.shifts_m) + (self.disparity_sigma_px > 0)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(B, E, F) which features were measured."""
        seen: NDArray[np.bool_] = self.measured[2] > 0
        return seen

    def take(self, frames: NDArray[np.int64] | slice) -> Features:
        """The features of some frames, in that order; a frame may appear often."""
        coupling = None if self.coupling is None else self.coupling[:, frames]
        return replace(self, measured=self.measured[:, frames], coupling=coupling)

    def without(self, mask: NDArray[np.bool_]) -> Features:
        """The same frames without the features of `mask`, (B, F) or (F,), in any eye."""
        coupling = None if self.coupling is None else np.where(mask, 0.0, self.coupling)
        return replace(self, measured=np.where(mask[..., None, :], 0.0, self.measured), coupling=coupling)


def stack_features(
    rig: StereoRig, layout: MarkerLayout, pixels_px: Array, cov_px2: Array, tolerances: StatedTolerances = EXACT
) -> Features:
    """Features of many frames from plain arrays.

    Args:
        rig: the stereo rig.
        layout: the drogue's markers and hub.
        pixels_px: (B, E, F, 2) with E = 1 (left eye) or 2 and F = N, or N + 2 with the hub's inner and outer edge; nan
            where nothing was measured.
        cov_px2: their covariances, (B, E, F, 2, 2) or what broadcasts to it.
        tolerances: of drogue and rig.

    Raises:
        ValueError: an array of another shape, or a tolerance of markers that lie on no circle.
    """
    with_hub = pixels_px.shape[2:3] == (layout.count + 2,) and layout.hub_center_m is not None
    count = layout.count + 2 * with_hub
    if pixels_px.ndim != 4 or pixels_px.shape[1] not in (1, 2) or pixels_px.shape[2:] != (count, 2):
        raise ValueError(f"pixels_px: must have shape (B, 1 or 2, {count}, 2), got {pixels_px.shape}")
    points, radii = layout.centers_m, np.full(layout.count, layout.radius_m)
    if with_hub and layout.hub_center_m is not None:
        points = np.vstack([points, layout.hub_center_m, layout.hub_center_m])
        radii = np.append(radii, [layout.hub_inner_radius_m, layout.hub_outer_radius_m])
    is_marker = np.arange(count) < layout.count
    features = Features(
        rig.camera,
        np.array([rig.eye_offset_m(eye)[0] for eye in EYES[: pixels_px.shape[1]]]),
        points,
        radii,
        is_marker,
        _shifts(layout, points, is_marker, tolerances),
        tolerances.disparity_px if pixels_px.shape[1] == 2 else 0.0,
        whiten(pixels_px, cov_px2),
    )
    if tolerances.placement_m == 0:
        return features
    displacement = np.where(is_marker, tolerances.placement_m, 0.0)
    measured, coupling = whiten_displaced(rig.camera, features.measured, _depths(features), displacement)
    return replace(features, measured=measured, coupling=coupling)


def observed_features(observation: Observation, with_hub: bool) -> Features:
    """The features of one stereo pair."""
    pixels, cov = observation.pixels_px, observation.cov_px2
    if with_hub and observation.hub_seen.any():
        assert observation.hub_px is not None
        assert observation.hub_cov_px2 is not None
        pixels = np.concatenate([pixels, observation.hub_px], axis=1)
        cov = np.concatenate([cov, observation.hub_cov_px2], axis=1)
    return stack_features(observation.rig, observation.layout, pixels[None], cov[None], observation.tolerances)


def left_features(observation: Observation) -> Features:
    """The markers of the left eye alone."""
    pixels, cov = observation.pixels_px[None, :1], observation.cov_px2[None, :1]
    return stack_features(observation.rig, observation.layout, pixels, cov, observation.tolerances)


def _shifts(layout: MarkerLayout, points_m: Array, is_marker: NDArray[np.bool_], tolerances: StatedTolerances) -> Array:
    """(G, F, 3) see `Features`. [m]"""
    if tolerances.ring_radius_m > 0 and layout.ring_radius_m is None:
        raise ValueError("ring_radius_m: the markers lie on no circle about the origin, leave its tolerance 0")
    ring, hub = points_m * is_marker[:, None], (~is_marker).astype(np.float64)
    x, y, none = ring[:, 0], ring[:, 1], np.zeros(len(ring))
    shifts: list[Array] = []
    if layout.ring_radius_m is not None and tolerances.ring_radius_m > 0:
        shifts.append(tolerances.ring_radius_m / layout.ring_radius_m * ring)
    # Longer by e along the direction d, shorter across: e / 2 (x cos 2d + y sin 2d, x sin 2d - y cos 2d). Over all
    # directions, both e cos 2d and e sin 2d have a standard deviation of e / sqrt 2.
    stretch = tolerances.ellipticity / np.sqrt(8)
    if stretch > 0:
        shifts += [stretch * np.column_stack([x, -y, none]), stretch * np.column_stack([y, x, none])]
    if tolerances.hub_lateral_m > 0 and hub.any():
        across = tolerances.hub_lateral_m * hub
        shifts += [np.column_stack([across, none, none]), np.column_stack([none, across, none])]
    return np.array(shifts).reshape(-1, len(points_m), 3)


def _depths(features: Features) -> Array:
    """(B,) depths by the markers' spread in all images; a tilt of 10 degrees adds 0.8 %, infinite without any. [m]"""
    seen = features.seen[..., features.is_marker].astype(np.float64)
    total = np.maximum(seen.sum(axis=2, keepdims=True), 1)

    def spread(values: Array) -> Array:
        mean = (seen * values).sum(axis=2, keepdims=True) / total
        summed: Array = (seen * (values - mean) ** 2).sum(axis=(1, 2))
        return summed

    x, y = features.points_m[features.is_marker, :2].T
    u, v = features.measured[:2][..., features.is_marker]
    slopes2 = spread(u / features.camera.fx_px) + spread(v / features.camera.fy_px)
    depths: Array = np.sqrt((spread(x) + spread(y)) / np.where(slopes2 > 0, slopes2, 1.0))
    return np.where((slopes2 > 0) & (depths > 0), depths, np.inf)
