"""Distance, attitude and position of the drogue, so that both eyes see all of it, and places of things around it."""

from __future__ import annotations

import numpy as np

from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.recipe.recipe import Recipe
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, RigidTransform, rotation_from_angles
from geometry.stereo import EYES, StereoRig
from scenes.environment_sampling import sample_uniform

_MOST_TRIES = 1000
_OUTLINE_POINTS = 72
# The rim polygon of 72 points lies within 0.1 % of the circle; the margin covers that and the lens blur.
_MARGIN_PX = 1.5


def outline_points_m(drogue: DrogueParameters) -> Array:
    """(M, 3) points in the drogue frame around all that must be in view: rim, bulging body and back end. [m]"""
    angle = 2 * np.pi * np.arange(_OUTLINE_POINTS) / _OUTLINE_POINTS
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(_OUTLINE_POINTS)], axis=-1)
    back_m = drogue.hub_depth_m + drogue.coupling_length_m
    circles_m = [
        (drogue.rim_radius_m, 0.0),
        (drogue.rim_radius_m, 2 * drogue.rim_tube_radius_m),
        (drogue.coupling_radius_m, back_m),
        *drogue.bulges_m,
    ]
    return np.concatenate([ring * radius_m + np.array([0.0, 0.0, z_m]) for radius_m, z_m in circles_m])


def origin_bounds_m(rig: StereoRig, points_m: Array, depth_m: float) -> tuple[float, float, float, float] | None:
    """Limits of the drogue's origin at one depth.

    Args:
        rig: the stereo rig.
        points_m: (M, 3) points around the origin, in camera axes. [m]
        depth_m: Z of the origin. [m]

    Returns:
        (x_low, x_high, y_low, y_high) within which both eyes see every point [m], or None if there are none.
    """
    c = rig.camera
    z = depth_m + points_m[:, 2]
    if z.min() <= 0:
        return None
    margin_px = _MARGIN_PX + rig.largest_shift_px()
    left = (margin_px - 0.5 - c.cx_px) / c.fx_px * z - points_m[:, 0]
    right = (c.width_px - 0.5 - margin_px - c.cx_px) / c.fx_px * z - points_m[:, 0]
    up = (margin_px - 0.5 - c.cy_px) / c.fy_px * z - points_m[:, 1]
    down = (c.height_px - 0.5 - margin_px - c.cy_px) / c.fy_px * z - points_m[:, 1]
    x_low, x_high, y_low, y_high = left.max() + rig.baseline_m, right.min(), up.max(), down.min()
    return None if x_low > x_high or y_low > y_high else (float(x_low), float(x_high), float(y_low), float(y_high))


def sample_pose(
    rng: np.random.Generator, recipe: Recipe, points_m: Array, depth_m: float, *, shows_front: bool = False
) -> RigidTransform:
    """Pose in the left camera at one depth: attitude from the recipe's ranges, position uniform in the common view.

    An attitude that does not fit into both views at this depth is drawn again, and one that shows a back where it must
    not.

    Args:
        rng: of the frame.
        recipe: gives rig and ranges.
        points_m: (M, 3) points around all that must be in view, in its own frame. [m]
        depth_m: Z of that frame's origin. [m]
        shows_front: whether the origin's plane must show both eyes the side that z points away from.

    Raises:
        ValueError: no attitude within the ranges fits.
    """
    for _ in range(_MOST_TRIES):
        pitch, yaw, roll = np.radians(
            [
                sample_uniform(rng, limits)
                for limits in (recipe.pose.pitch_deg, recipe.pose.yaw_deg, recipe.pose.roll_deg)
            ]
        )
        rotation = rotation_from_angles(pitch, yaw, roll)
        bounds = origin_bounds_m(recipe.rig, points_m @ rotation.T, depth_m)
        place = rng.random(2)
        if bounds is None:
            continue
        x_low, x_high, y_low, y_high = bounds
        if recipe.pose.on_axis:
            origin_m = np.array([recipe.rig.baseline_m / 2, 0.0, depth_m])
            if not (x_low <= origin_m[0] <= x_high and y_low <= origin_m[1] <= y_high):
                continue
        else:
            x_m, y_m = x_low + place[0] * (x_high - x_low), y_low + place[1] * (y_high - y_low)
            origin_m = np.array([x_m, y_m, depth_m])
        if shows_front and any((origin_m - recipe.rig.eye_offset_m(eye)) @ rotation[:, 2] <= 0 for eye in EYES):
            continue
        return RigidTransform(rotation, origin_m)
    raise ValueError(
        f"pose: at {depth_m:g} m no attitude within the recipe's ranges keeps all in both views; "
        "widen pitch_deg and yaw_deg towards 0 or move away"
    )


def sample_distance_m(rng: np.random.Generator, law: DistanceLaw, frame_index: int) -> float:
    """Distance of the rim centre along the optical axis. [m]

    Frames take the stations in turn, so that any prefix of a dataset covers all of them.
    """
    if law.stations_m is not None:
        return law.stations_m[frame_index % len(law.stations_m)]
    return distance_at(law, rng.random())


def distance_at(law: DistanceLaw, share: float) -> float:
    """Distance at a share from 0 to 1, which, drawn evenly, gives the law between its two ends. [m]"""
    assert law.low_m is not None and law.high_m is not None
    low_m, high_m = law.low_m, law.high_m
    if law.edges_m is not None and law.weights is not None:
        ends = np.concatenate([[0.0], np.cumsum(law.weights) / sum(law.weights)])
        place = min(int(np.searchsorted(ends, share, side="right")), len(law.weights)) - 1
        low_m, high_m = law.edges_m[place], law.edges_m[place + 1]
        share = float((share - ends[place]) / max(ends[place + 1] - ends[place], 1e-300))
    if law.law == "uniform":
        return float(low_m + share * (high_m - low_m))
    if law.law == "log-uniform":
        return float(low_m * (high_m / low_m) ** share)
    # Uniform in inverse distance, to which the size in the image is proportional.
    return float(1.0 / (1.0 / high_m + share * (1.0 / low_m - 1.0 / high_m)))


def sample_point_in_view(rng: np.random.Generator, rig: StereoRig, depth_m: float) -> Array:
    """(3,) a point in view of the left eye, or just outside. [m]"""
    camera = rig.camera
    u, v = rng.uniform(-0.05, 1.05, 2) * (camera.width_px, camera.height_px)
    return np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0]) * depth_m


def rotation_with_z(direction: Array) -> Array:
    """A rotation whose third column is a (3,) unit vector."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=-1)


def rotation_with_z_and_up(direction: Array, up: Array) -> Array:
    """A rotation whose third column is a (3,) unit vector and whose second is as near to a (3,) `up` as can be."""
    across = np.cross(up, direction)
    if np.linalg.norm(across) < 1e-6:
        return rotation_with_z(direction)
    x = across / np.linalg.norm(across)
    return np.stack([x, np.cross(direction, x), direction], axis=-1)
