"""Known positions and whitened image measurements of a drogue's features, for many frames at once.

Whitening matrices turn the pixel residuals of a feature in both eyes into independent ones of unit variance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig
from nav.pose.pose_method import EXACT, Observation, StatedTolerances


@dataclass(frozen=True, eq=False)
class Features:
    """Features of B frames in E eyes: F are the N markers and, where it is used, the hub's inner and outer edge.

    Attributes:
        camera: of every eye.
        eye_x_m: (E,) positions of the eyes along x of the left camera.
        points_m: (F, 3) centres in the drogue frame.
        radii_m: (F,) of the disc or edge.
        is_marker: (F,).
        shifts_m: (G, F, 3) displacements of the centres by one standard deviation of each departure from the nominal
            drogue that several features share.
        disparity_sigma_px: standard deviation of the second eye's columns; where above 0 it is one more departure,
            after those.
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
        """The features of some frames, in that order; a frame may be repeated."""
        coupling = None if self.coupling is None else self.coupling[:, frames]
        return replace(self, measured=self.measured[:, frames], coupling=coupling)

    def without(self, mask: NDArray[np.bool_]) -> Features:
        """The same frames without the features of a mask, (B, F) or (F,), in all eyes."""
        coupling = None if self.coupling is None else np.where(mask, 0.0, self.coupling)
        return replace(self, measured=np.where(mask[..., None, :], 0.0, self.measured), coupling=coupling)


def stack_features(
    rig: StereoRig, layout: MarkerLayout, pixels_px: Array, cov_px2: Array, tolerances: StatedTolerances = EXACT
) -> Features:
    """Features of many frames from arrays of measurements.

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
        camera=rig.camera,
        eye_x_m=np.array([rig.eye_offset_m(eye)[0] for eye in EYES[: pixels_px.shape[1]]]),
        points_m=points,
        radii_m=radii,
        is_marker=is_marker,
        shifts_m=_departure_shifts(layout, points, is_marker, tolerances),
        disparity_sigma_px=tolerances.disparity_px if pixels_px.shape[1] == 2 else 0.0,
        measured=whiten(pixels_px, cov_px2),
    )
    if tolerances.placement_m == 0:
        return features
    displacement = np.where(is_marker, tolerances.placement_m, 0.0)
    measured, coupling = whiten_with_displacement(
        rig.camera, features.measured, _approximate_depths(features), displacement
    )
    return replace(features, measured=measured, coupling=coupling)


def observed_features(observation: Observation, with_hub: bool) -> Features:
    """Features of one stereo pair."""
    pixels, cov = observation.pixels_px, observation.cov_px2
    if with_hub and observation.hub_seen.any():
        assert observation.hub_px is not None
        assert observation.hub_cov_px2 is not None
        pixels = np.concatenate([pixels, observation.hub_px], axis=1)
        cov = np.concatenate([cov, observation.hub_cov_px2], axis=1)
    return stack_features(observation.rig, observation.layout, pixels[None], cov[None], observation.tolerances)


def left_features(observation: Observation) -> Features:
    """Markers of the left eye only."""
    pixels, cov = observation.pixels_px[None, :1], observation.cov_px2[None, :1]
    return stack_features(observation.rig, observation.layout, pixels, cov, observation.tolerances)


def _departure_shifts(
    layout: MarkerLayout, points_m: Array, is_marker: NDArray[np.bool_], tolerances: StatedTolerances
) -> Array:
    """(G, F, 3) see `Features`. [m]"""
    if tolerances.ring_radius_m > 0 and layout.ring_radius_m is None:
        raise ValueError("ring_radius_m: the markers lie on no circle about the origin, leave its tolerance 0")
    ring, hub = points_m * is_marker[:, None], (~is_marker).astype(np.float64)
    x, y, none = ring[:, 0], ring[:, 1], np.zeros(len(ring))
    shifts: list[Array] = []
    if layout.ring_radius_m is not None and tolerances.ring_radius_m > 0:
        shifts.append(tolerances.ring_radius_m / layout.ring_radius_m * ring)
    # Longer by e along the direction d, shorter across it: e / 2 (x cos 2d + y sin 2d, x sin 2d - y cos 2d). Over
    # all directions, both e cos 2d and e sin 2d have a standard deviation of e / sqrt 2.
    stretch = tolerances.ellipticity / np.sqrt(8)
    if stretch > 0:
        shifts += [stretch * np.column_stack([x, -y, none]), stretch * np.column_stack([y, x, none])]
    if tolerances.hub_lateral_m > 0 and hub.any():
        across = tolerances.hub_lateral_m * hub
        shifts += [np.column_stack([across, none, none]), np.column_stack([none, across, none])]
    return np.array(shifts).reshape(-1, len(points_m), 3)


def _approximate_depths(features: Features) -> Array:
    """(B,) depths from the markers' spread in the images; infinite without markers. [m]

    A tilt of 10 degrees adds 0.8 %.
    """
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


def whiten(pixels_px: Array, cov_px2: Array) -> Array:
    """Pixels, and for each the whitening matrix `[[a, 0], [b, c]]` of its own covariance.

    Args:
        pixels_px: (B, E, F, 2), nan where nothing was measured.
        cov_px2: (B, E, F, 2, 2) or what broadcasts to it.

    Returns:
        (5, B, E, F) horizontal and vertical pixel, a, b, c; all zero where nothing was measured, or where the
        covariance is not positive.
    """
    cov = np.broadcast_to(cov_px2, (*pixels_px.shape, 2))
    # Missing measurements are nan and fail these comparisons, so the roots below are of finite numbers only.
    seen = np.isfinite(pixels_px).all(axis=-1) & (cov[..., 0, 0] > 0)
    a, b, c = _whitening_factors(cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1], seen)
    measured: Array = np.where(c > 0, np.stack([pixels_px[..., 0], pixels_px[..., 1], a, b, c]), 0.0)
    return measured


def whiten_with_displacement(
    camera: PinholeCamera, measured: Array, depths_m: Array, displacement_m: Array
) -> tuple[Array, Array]:
    """Whiten features that also have random displacements from their nominal positions, the same in both eyes.

    Args:
        camera: of both eyes.
        measured: as from `whiten`, of one eye or two.
        depths_m: (B,) of the drogue.
        displacement_m: (F,) standard deviation along each axis.

    Returns:
        `measured` with new matrices, and (4, B, F) entries, by rows, of the matrices `X`. `X @ r` with the first eye's
        whitened residuals `r` must be added to the second eye's; `X` is zero with one eye.

    Source: block Cholesky factor of the covariance of the feature's four coordinates.
    """
    u, v = measured[:2]
    slopes = np.stack([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px])
    scale = displacement_m / depths_m[:, None]
    out, coupling = measured.copy(), np.zeros((4, *scale.shape))
    first = _add_covariance(measured[2:, :, 0], _shared_covariance(camera, scale, slopes[:, :, 0], slopes[:, :, 0]))
    out[2:, :, 0] = first
    if u.shape[1] == 1:
        return out, coupling
    # M = K L^T with K the covariance of the second eye with the first and L the first's whitening matrix.
    (uu, uv), (vu, vv) = _shared_covariance(camera, scale, slopes[:, :, 1], slopes[:, :, 0])
    l_a, l_b, l_c = first
    m = [[uu * l_a, uu * l_b + uv * l_c], [vu * l_a, vu * l_b + vv * l_c]]
    own = _shared_covariance(camera, scale, slopes[:, :, 1], slopes[:, :, 1])
    rest = [[own[i][j] - m[i][0] * m[j][0] - m[i][1] * m[j][1] for j in range(2)] for i in range(2)]
    second = _add_covariance(measured[2:, :, 1], rest)
    out[2:, :, 1] = second
    r_a, r_b, r_c = second
    coupling[0], coupling[1] = -r_a * m[0][0], -r_a * m[0][1]
    coupling[2], coupling[3] = -(r_b * m[0][0] + r_c * m[1][0]), -(r_b * m[0][1] + r_c * m[1][1])
    return out, coupling


def _shared_covariance(camera: PinholeCamera, scale: Array, row: Array, column: Array) -> list[list[Array]]:
    """Covariance of two images of one random displacement: 2x2 entries (B, F) of `scale^2 T T^T`. [px^2]

    A displacement `d` at depth z moves an image by `f / z (d_x - d_z x / z)`, and likewise in y.
    """
    fx, fy = scale * camera.fx_px, scale * camera.fy_px
    return [
        [fx * fx * (1 + row[0] * column[0]), fx * fy * row[0] * column[1]],
        [fx * fy * row[1] * column[0], fy * fy * (1 + row[1] * column[1])],
    ]


def _add_covariance(factors: Array, more: list[list[Array]]) -> Array:
    """(3, B, F) entries a, b, c of the whitening matrix of the sum of two covariances; the first by its own entries."""
    a, b, c = factors
    seen = c > 0
    safe_a, safe_c = np.where(seen, a, 1.0), np.where(seen, c, 1.0)
    # [[a, 0], [b, c]]^-1 = [[1 / a, 0], [-b / (a c), 1 / c]] is the covariance's lower factor.
    p, q, r = 1 / safe_a, -np.where(seen, b, 0.0) / (safe_a * safe_c), 1 / safe_c
    return _whitening_factors(p * p + more[0][0], p * q + more[0][1], q * q + r * r + more[1][1], seen)


def _whitening_factors(first: Array, across: Array, second: Array, seen: NDArray[np.bool_]) -> Array:
    """Entries a, b, c of the whitening matrices of covariances `[[first, across], [across, second]]`, else zero."""
    first = np.where(seen, first, 1.0)
    across = np.where(seen, across, 0.0)
    rest = np.where(seen, second, 1.0) - across**2 / first
    seen = seen & (rest > 0)
    a = 1 / np.sqrt(first)
    c = 1 / np.sqrt(np.where(seen, rest, 1.0))
    factors: Array = np.where(seen, np.stack([a, -across / first * c, c]), 0.0)
    return factors
