"""Closed forms of the accuracy limits of an even ring of markers that faces the cameras.

They agree with the numeric Cramer-Rao bound to the order of (ring radius / distance)^2, and show what it depends on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from scipy.stats import norm


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
        """Tilt about one axis from the sideways shift of a hub against the ring, which knows the sign. [rad/px]

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
    return float(norm.sf(tilt / tilt_scale))
