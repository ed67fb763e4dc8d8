"""Frames drawn at random: poses by the protocol's law, corrupted markers, toleranced drogues and cameras.

The estimator knows the nominal drogue and rig, and the tolerances that are stated to it. The text of `Corruption` and
`Tolerances` is part of the key of the random streams: renamed classes or fields would draw other frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from drogue_models.marker_layout import MarkerLayout
from geometry.circles import ellipse_center_points
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig
from nav.pose.pose_method import StatedTolerances

# The protocol: pitch and yaw within 10 degrees, roll within half of the spacing of eight markers.
TILT_DEG = 10.0
ROLL_DEG = 22.5


@dataclass(frozen=True, eq=False)
class Poses:
    """Many `left_from_drogue`.

    Attributes:
        rotations: (n, 3, 3).
        translations_m: (n, 3).
    """

    rotations: Array
    translations_m: Array


@dataclass(frozen=True, eq=False)
class RightEyeErrors:
    """Error of the right camera's calibration in each draw.

    Attributes:
        yaw_rad: (n,) turn about the vertical axis, to the right.
        cx_px: (n,) shift of the principal point.
    """

    yaw_rad: Array
    cx_px: Array


def draw_poses(
    rng: np.random.Generator, rig: StereoRig, rim_radius_m: float, distance_m: tuple[float, float], count: int
) -> Poses:
    """Poses uniform in distance, attitude, and place in the common field of view.

    Args:
        rng: the stream.
        rig: the cameras.
        rim_radius_m: of the drogue, which both eyes see completely. [m]
        distance_m: nearest and farthest.
        count: how many.

    Raises:
        ValueError: so near that the drogue does not fit into both views.
    """
    low, high = distance_m
    if low < rig.nearest_full_view_m(rim_radius_m):
        raise ValueError(f"distance: the whole drogue does not fit into both views at {low:g} m")
    unit = rng.random((count, 6))
    depths = low + (high - low) * unit[:, 0]
    fields = np.array([rig.common_field_m(float(depth), rim_radius_m) for depth in depths], dtype=np.float64)
    x = fields[:, 0] + unit[:, 1] * (fields[:, 1] - fields[:, 0])
    y = fields[:, 2] + unit[:, 2] * (fields[:, 3] - fields[:, 2])
    angles = (2 * unit[:, 3:] - 1) * np.array([TILT_DEG, TILT_DEG, ROLL_DEG])
    rotations = Rotation.from_euler("YXZ", angles, degrees=True).as_matrix()
    return Poses(rotations, np.stack([x, y, depths], axis=-1))


def ellipse_centers_px(
    rig: StereoRig, poses: Poses, centers_m: Array, radii_m: Array, right: RightEyeErrors | None = None
) -> Array:
    """Centres of the image ellipses of discs that face along the drogue's axis.

    Args:
        rig: the cameras.
        poses: of the drogue.
        centers_m: (F, 3) or (n, F, 3) centres in the drogue frame.
        radii_m: (F,).
        right: errors of the right camera against `rig`; None for none.

    Returns:
        (n, 2, F, 2) left before right. [px]
    """
    points = np.einsum(
        "nij,...nfj->nfi", poses.rotations, np.broadcast_to(centers_m, (len(poses.rotations), *centers_m.shape[-2:]))
    )
    points = points + poses.translations_m[:, None]
    axes = np.broadcast_to(poses.rotations[:, None, :, 2], points.shape)
    images = []
    for eye in EYES:
        seen, normals = points - rig.eye_offset_m(eye), axes
        if right is not None and eye == "right":
            turn = Rotation.from_rotvec(np.outer(-right.yaw_rad, [0.0, 1.0, 0.0])).as_matrix()
            seen, normals = np.einsum("nij,nfj->nfi", turn, seen), np.einsum("nij,nfj->nfi", turn, normals)
        pixels = rig.camera.project(ellipse_center_points(seen, normals, radii_m))
        if right is not None and eye == "right":
            pixels = pixels + np.stack([right.cx_px, np.zeros_like(right.cx_px)], axis=-1)[:, None]
        images.append(pixels)
    return np.stack(images, axis=1)


LEAST_PX, MOST_PX = 3.0, 10.0


@dataclass(frozen=True)
class Corruption:
    """Markers whose centres are measured wrongly by several pixels.

    Attributes:
        markers: how many; which ones is drawn for each frame.
        where: in one eye that is drawn, in both eyes by different shifts, or in one eye along its rows only.
    """

    markers: int
    where: Literal["one eye", "both eyes", "u only"] = "one eye"

    def __str__(self) -> str:
        return "clean" if self.markers == 0 else f"{self.markers} bad, {self.where}"


CLEAN = Corruption(0)


def draw_shifts(rng: np.random.Generator, corruption: Corruption, count: int, markers: int) -> Array:
    """Shifts of the measured centres.

    Args:
        rng: the stream.
        corruption: number and place of the bad markers.
        count: how many frames.
        markers: of the drogue.

    Returns:
        (count, 2, markers, 2) of 3 to 10 px in drawn directions, zero elsewhere. [px]

    Raises:
        ValueError: more bad markers than there are.
    """
    if not 0 <= corruption.markers <= markers:
        raise ValueError(f"corruption: must be of at most {markers} markers, got {corruption.markers}")
    size = LEAST_PX + (MOST_PX - LEAST_PX) * rng.random((count, 2, markers))
    angle = 2 * np.pi * rng.random((count, 2, markers))
    if corruption.where == "u only":
        angle = np.where(angle < np.pi, 0.0, np.pi)
    shifts = size[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    chosen = rng.random((count, markers)).argsort(axis=1) < corruption.markers
    eyes = np.ones((count, 2), dtype=np.bool_)
    if corruption.where != "both eyes":
        eyes = np.arange(2) == rng.integers(0, 2, count)[:, None]
    shifted: Array = shifts * (chosen[:, None, :] & eyes[:, :, None])[..., None]
    return shifted


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of each draw about the nominal value; the ellipticity is the same in every draw.

    Attributes:
        ring_radius_m: of the marker circle.
        placement_m: of every marker along each axis.
        ellipticity: difference of the ring's axes over their mean, along a drawn direction.
        hub_lateral_m: of the hub's centre along both axes across the drogue's.
        right_yaw_deg: of the right camera.
        right_cx_px: of the right camera's principal point.
    """

    ring_radius_m: float = 0.0
    placement_m: float = 0.0
    ellipticity: float = 0.0
    hub_lateral_m: float = 0.0
    right_yaw_deg: float = 0.0
    right_cx_px: float = 0.0


AS_BUILT = Tolerances()
RING_ONLY = Tolerances(ring_radius_m=0.5e-3)
TOLERANCED = Tolerances(0.5e-3, 0.3e-3, 0.002, 1e-3, 0.005, 0.05)


def stated_tolerances(tolerances: Tolerances, rig: StereoRig) -> StatedTolerances:
    """The same tolerances as a user would state them to an estimator."""
    yaw_px = rig.camera.fx_px * float(np.radians(tolerances.right_yaw_deg))
    return StatedTolerances(
        ring_radius_m=tolerances.ring_radius_m,
        ellipticity=tolerances.ellipticity,
        placement_m=tolerances.placement_m,
        hub_lateral_m=tolerances.hub_lateral_m,
        disparity_px=float(np.hypot(yaw_px, tolerances.right_cx_px)),
    )


@dataclass(frozen=True, eq=False)
class TrueFeatures:
    """True feature centres and camera errors of each draw.

    Attributes:
        centers_m: (n, F, 3) markers, then the hub where there is one.
        right: departures of the right camera.
    """

    centers_m: Array
    right: RightEyeErrors


def draw_features(rng: np.random.Generator, layout: MarkerLayout, tolerances: Tolerances, count: int) -> TrueFeatures:
    """True features of `count` drogues and cameras.

    Args:
        rng: the stream.
        layout: the nominal drogue, its markers on one circle.
        tolerances: of drogue and cameras.
        count: how many draws.

    Raises:
        ValueError: markers that lie on no circle.
    """
    if layout.ring_radius_m is None:
        raise ValueError("drogue: its markers must lie on one circle to have a tolerance of the radius")
    radius = 1 + tolerances.ring_radius_m / layout.ring_radius_m * rng.standard_normal(count)
    direction = np.pi * rng.random(count)
    long_axis = np.stack([np.cos(direction), np.sin(direction), np.zeros(count)], axis=-1)
    nominal = layout.centers_m
    along = nominal @ long_axis.T
    stretched = nominal + tolerances.ellipticity * (along.T[..., None] * long_axis[:, None] - nominal / 2)
    placed = tolerances.placement_m * rng.standard_normal((count, layout.count, 3))
    markers = radius[:, None, None] * stretched + placed
    lateral = tolerances.hub_lateral_m * rng.standard_normal((count, 1, 3)) * np.array([1.0, 1.0, 0.0])
    if layout.hub_center_m is not None:
        markers = np.concatenate([markers, layout.hub_center_m + lateral], axis=1)
    yaw, shift = rng.standard_normal((2, count))
    right = RightEyeErrors(np.radians(tolerances.right_yaw_deg) * yaw, tolerances.right_cx_px * shift)
    return TrueFeatures(markers, right)
