"""Accuracy limits of poses: the numeric Cramer-Rao bound, and closed forms for a ring that faces the cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform, skew
from geometry.stereo import EYES, Eye, StereoRig

# Three points fix six unknowns; fewer leave a pose open.
_FEWEST_FEATURES = 3

# Of the information matrix with unit diagonal. One eye's view of a ring at 1000 m is at 1e9; beyond this, the
# rest of float64's 16 digits cannot separate an open pose from a determined one.
_LARGEST_CONDITION = 1e12


@dataclass(frozen=True)
class FeatureNoise:
    """Standard deviation of one coordinate of a measured centre, by the kind of feature. [px]"""

    marker_px: float
    hub_px: float

    def __post_init__(self) -> None:
        if not (self.marker_px > 0 and self.hub_px > 0):
            raise ValueError(f"noise: must be positive, got {self.marker_px} and {self.hub_px} px")

    def by_feature(self, layout: MarkerLayout) -> Array:
        """(M,) noise of every feature of a drogue. [px]"""
        hub = [] if layout.hub_center_m is None else [self.hub_px]
        return np.array([self.marker_px] * layout.count + hub)


UNIT_NOISE = FeatureNoise(1.0, 1.0)


def feature_points(layout: MarkerLayout) -> tuple[Array, Array]:
    """Centres and radii of a drogue's features: the markers, then the hub's outer edge.

    Returns:
        (M, 3) centres in the drogue frame, (M,) radii. [m]
    """
    radii = np.full(layout.count, layout.radius_m)
    if layout.hub_center_m is None:
        return layout.centers_m, radii
    return np.vstack([layout.centers_m, layout.hub_center_m]), np.append(radii, layout.hub_outer_radius_m)


def center_jacobian(rig: StereoRig, left_from_drogue: RigidTransform, layout: MarkerLayout, eye: Eye) -> Array:
    """Derivative of the features' centres in the delivered image by the pose and the size of the ring.

    Args:
        rig: the cameras.
        left_from_drogue: pose of the drogue.
        layout: its features.
        eye: which image.

    Returns:
        (M, 2, 7) derivative with respect to (dt [m], w [rad], s) with t' = t + dt, R' = exp([w]x) R, and the markers'
        places in the drogue scaled by 1 + s while the hub stays. [px/m, px/rad, px]

    Source: derivative of the ellipse centre `pi(t - (r^2 / t_z) (e_z - n_z n))` (see `geometry.circles`), times that
        of the lens there, where the eye has one.
    """
    centers, radii = feature_points(layout)
    arms = left_from_drogue.rotate(centers)
    t = arms + left_from_drogue.translation_m - rig.eye_offset_m(eye)
    n = left_from_drogue.rotation[:, 2]
    forward = np.array([0.0, 0.0, 1.0])
    by_scale = np.where(np.arange(len(t)) < layout.count, arms.T, 0.0).T
    d_center = np.concatenate([np.broadcast_to(np.eye(3), (len(t), 3, 3)), -skew(arms), by_scale[..., None]], axis=2)
    d_normal = np.concatenate([np.zeros((3, 3)), -skew(n), np.zeros((3, 1))], axis=1)
    shift = forward - n[2] * n
    d_shift = -(np.outer(n, d_normal[2]) + n[2] * d_normal)
    scale = (radii**2 / t[:, 2])[:, None]
    virtual = t - scale * shift
    d_scale = -(scale / t[:, 2:]) * d_center[:, 2]
    d_virtual = d_center - shift[:, None] * d_scale[:, None, :] - scale[:, None] * d_shift
    x, y, z = virtual[:, 0], virtual[:, 1], virtual[:, 2]
    d_project = np.zeros((len(t), 2, 3))
    d_project[:, 0, 0], d_project[:, 0, 2] = rig.camera.fx_px / z, -rig.camera.fx_px * x / z**2
    d_project[:, 1, 1], d_project[:, 1, 2] = rig.camera.fy_px / z, -rig.camera.fy_px * y / z**2
    jacobian: Array = rig.real_slopes(rig.camera.project(virtual), eye) @ d_project @ d_virtual
    return jacobian


def stereo_jacobian(rig: StereoRig, left_from_drogue: RigidTransform, layout: MarkerLayout) -> Array:
    """(2, M, 2, 7) `center_jacobian` of both eyes, left before right."""
    return np.stack([center_jacobian(rig, left_from_drogue, layout, eye) for eye in EYES])


def angles_jacobian(left_from_drogue: RigidTransform) -> Array:
    """(2, 3) derivative of pitch and yaw with respect to the rotation increment w. [rad/rad]"""
    nx, ny, nz = left_from_drogue.rotation[:, 2]
    across2 = nx**2 + nz**2
    d_pitch = np.array([nx * ny / np.sqrt(across2), -np.sqrt(across2), nz * ny / np.sqrt(across2)])
    d_yaw = np.array([nz, 0.0, -nx]) / across2
    jacobian: Array = np.stack([d_pitch, d_yaw]) @ -skew([nx, ny, nz])
    return jacobian


def pose_covariance(jacobian: Array, ring_scale_sd: float | None = None) -> Array | None:
    """Covariance of the pose from image points of unit noise.

    Args:
        jacobian: (K, 2, 7) of the points that are seen, each row over its noise.
        ring_scale_sd: how well the size of the ring is known, as a share of it; None where it is known exactly.

    Returns:
        (6, 6) inverse of the Fisher information [m, rad], or None where the points leave the pose open.

    Raises:
        ValueError: a scale that is not positive.
    """
    if ring_scale_sd is not None and not ring_scale_sd > 0:
        raise ValueError(f"ring_scale_sd: must be positive, or None for a drogue as built, got {ring_scale_sd}")
    if len(jacobian) < _FEWEST_FEATURES:
        return None
    rows = jacobian.reshape(-1, 7)
    information = rows.T @ rows
    if ring_scale_sd is None:
        return _inverse(information[:6, :6])
    information[6, 6] += ring_scale_sd**-2
    covariance = _inverse(information)
    return None if covariance is None else covariance[:6, :6]


def _inverse(information: Array) -> Array | None:
    """Inverse of a positive definite matrix, None of one that is singular within rounding."""
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return None
    scaled = information / np.outer(scale, scale)
    if np.linalg.cond(scaled) > _LARGEST_CONDITION:
        return None
    inverse: Array = np.linalg.inv(scaled) / np.outer(scale, scale)
    return inverse


def component_covariance(left_from_drogue: RigidTransform, covariance: Array) -> Array:
    """Covariance of the scored components, with roll marginalised.

    Args:
        left_from_drogue: pose to which the covariance belongs.
        covariance: (6, 6) of the pose in the tangent of `datasets_manifest.types.estimates`. [m, rad]

    Returns:
        (5, 5) of X, Y, Z [m], pitch and yaw [deg].
    """
    slope = np.zeros((5, 6))
    slope[:3, :3] = np.eye(3)
    slope[3:, 3:] = np.rad2deg(angles_jacobian(left_from_drogue))
    scored: Array = slope @ covariance @ slope.T
    return scored


def component_deviations(left_from_drogue: RigidTransform, covariance: Array) -> Array:
    """(5,) standard deviations of X, Y, Z [m], pitch and yaw [deg]; arguments as for `component_covariance`."""
    deviations: Array = np.sqrt(np.diag(component_covariance(left_from_drogue, covariance)))
    return deviations


def pose_bound(
    rig: StereoRig,
    left_from_drogue: RigidTransform,
    layout: MarkerLayout,
    visible: NDArray[np.bool_],
    noise: FeatureNoise = UNIT_NOISE,
    ring_scale_sd: float | None = None,
) -> Array | None:
    """Cramer-Rao bound of position and attitude.

    Args:
        rig: the cameras.
        left_from_drogue: true pose.
        layout: the drogue's features.
        visible: (2, M) which features the left and the right eye see; one eye, some of the markers or no hub are
            masks like any other.
        noise: of the centroids. The bound is proportional to it where the ring's size is known exactly.
        ring_scale_sd: see `pose_covariance`.

    Returns:
        (5,) standard deviations of X, Y, Z [m] and of pitch and yaw [deg], or None where the pose is open.
    """
    whitened = stereo_jacobian(rig, left_from_drogue, layout) / noise.by_feature(layout)[:, None, None]
    covariance = pose_covariance(whitened[visible], ring_scale_sd)
    return None if covariance is None else component_deviations(left_from_drogue, covariance)


def features_seen(
    layout: MarkerLayout, eyes: Sequence[Eye] = EYES, markers: Sequence[int] | None = None, hub: bool = True
) -> NDArray[np.bool_]:
    """The features that an estimator has, as a mask.

    Args:
        layout: the drogue's features.
        eyes: which eyes it looks through.
        markers: which markers it has, None for all.
        hub: whether it has the hub, where there is one.

    Returns:
        (2, M) for `pose_bound`.
    """
    features = np.zeros(len(feature_points(layout)[0]), dtype=np.bool_)
    features[list(range(layout.count) if markers is None else markers)] = True
    features[layout.count :] = hub
    return np.array([[eye in eyes] for eye in EYES]) & features


@dataclass(frozen=True)
class FacingRing:
    """An even ring of markers across the line of sight, seen by both eyes.

    Every limit is a standard deviation at a centroid noise of 1 px in each coordinate; it is proportional to the noise.

    Attributes:
        focal_px: focal length of both eyes. [px]
        baseline_m: distance of the eyes. [m]
        ring_radius_m: of the circle through the markers. [m]
        count: number of markers, three or more. Evenly spaced, or what follows does not hold.
        distance_m: Z of the ring. [m]

    Source: inverse Fisher information of 2 N image points to first order in radius and baseline over distance.
    """

    focal_px: float
    baseline_m: float
    ring_radius_m: float
    count: int
    distance_m: float

    def __post_init__(self) -> None:
        for name in ("focal_px", "baseline_m", "ring_radius_m", "distance_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: must be positive, got {getattr(self, name)}")
        if self.count < 3:
            raise ValueError(f"count: must be at least 3, got {self.count}")

    @property
    def stereo_depth_m(self) -> float:
        """Depth of the mean of the triangulated markers, without any knowledge of the ring. [m/px]"""
        return self.distance_m**2 / (self.focal_px * self.baseline_m) * math.sqrt(2 / self.count)

    @property
    def stereo_tilt_rad(self) -> float:
        """Tilt, about one axis, of the plane through the triangulated markers. [rad/px]"""
        reach = self.ring_radius_m * math.sqrt(self.count)
        return self.distance_m**2 / (self.focal_px * self.baseline_m) * 2 / reach

    @property
    def size_depth_m(self) -> float:
        """Depth from the known size of the ring in both images, without the disparity. [m/px]"""
        return self.distance_m**2 / (self.focal_px * self.ring_radius_m * math.sqrt(2 * self.count))

    @property
    def depth_m(self) -> float:
        """Depth from the known ring in both eyes: size and disparity together. [m/px]"""
        spread = 2 * self.count * self.ring_radius_m**2 + self.count * self.baseline_m**2 / 2
        return self.distance_m**2 / (self.focal_px * math.sqrt(spread))

    @property
    def tilt_rad(self) -> float:
        """Tilt about one axis from the known ring in both eyes, near zero tilt; the flip law's scale s0. [rad/px]"""
        spread = self.count * (self.ring_radius_m**2 / 2 + self.baseline_m**2 / 4)
        return self.distance_m**2 / (self.focal_px * self.ring_radius_m * math.sqrt(spread))

    def hub_tilt_rad(self, depth_m: float, noise_factor: float = 1.0) -> float:
        """Tilt about one axis from the sideways shift of a hub against the ring, which gives its sign too. [rad/px]

        Args:
            depth_m: of the hub behind the ring. [m]
            noise_factor: the hub's centroid noise over the markers'.
        """
        shift = math.sqrt((noise_factor**2 + 1 / self.count) / 2)
        return self.distance_m / (self.focal_px * depth_m) * shift

    def toleranced_depth_m(
        self, sigma_px: float, scale_sd: float, disparity_sd_px: float = 0.0, placement_sd_m: float = 0.0
    ) -> float:
        """Depth where drogue and rig are known within tolerances: stereo and size, each with its own weight. [m]

        Not proportional to the noise, and so not per pixel.

        Args:
            sigma_px: centroid noise, above zero. [px]
            scale_sd: standard deviation of the ring's radius over the radius.
            disparity_sd_px: of the disparity that all markers share. [px]
            placement_sd_m: of every marker along the ring's radius, which both eyes see alike. [m]
        """
        by_disparity = self.distance_m**2 / (self.focal_px * self.baseline_m) * disparity_sd_px
        by_stereo = math.hypot(sigma_px * self.stereo_depth_m, by_disparity)
        mean_radius = placement_sd_m / (self.ring_radius_m * math.sqrt(self.count))
        by_size = math.hypot(sigma_px * self.size_depth_m, self.distance_m * math.hypot(scale_sd, mean_radius))
        return 1 / math.hypot(1 / by_stereo, 1 / by_size)


def flip_probability(tilt: float, tilt_scale: float) -> float:
    """How often the mirrored tilt fits the markers better than the true one, without a hub.

    Args:
        tilt: true tilt against the line of sight, in the unit of `tilt_scale`.
        tilt_scale: `FacingRing.tilt_rad` times the centroid noise.

    Source: the two fits differ by the tilt's part along the axis, whose estimate is normal about the true value.
    """
    return float(ndtr(-tilt / tilt_scale))
