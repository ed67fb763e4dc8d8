"""Projection of the markers for many poses at once, triangulation, and attitudes from an axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.circles import ellipse_center_points
from geometry.se3 import Array, angles_from_axis
from geometry.stereo import EYES, StereoRig
from nav.pose.pose_method import Observation


def points_in_eyes(rig: StereoRig, centers_m: Array, rotations: Array, translations_m: Array) -> Array:
    """Marker centres in each eye's own frame.

    Args:
        rig: the stereo rig.
        centers_m: (N, 3) in the drogue frame.
        rotations: (S, 3, 3) `left_from_drogue`.
        translations_m: (S, 3).

    Returns:
        (S, 2, N, 3). [m]
    """
    points = np.einsum("sij,nj->sni", rotations, centers_m) + translations_m[:, None]
    offsets = np.stack([rig.eye_offset_m(eye) for eye in EYES])
    eyes: Array = points[:, None] - offsets[:, None]
    return eyes


def project_markers(rig: StereoRig, layout: MarkerLayout, rotations: Array, translations_m: Array) -> Array:
    """(S, 2, N, 2) centres of the markers' image ellipses in both eyes; arguments as for `points_in_eyes`. [px]"""
    points = points_in_eyes(rig, layout.centers_m, rotations, translations_m)
    normals = np.broadcast_to(rotations[:, None, None, :, 2], points.shape)
    return rig.camera.project(ellipse_center_points(points, normals, layout.radius_m))


def triangulate_markers(observation: Observation) -> tuple[NDArray[np.int64], Array]:
    """Indices (K,) of the markers that both eyes measured, and their positions (K, 3) in the left camera frame. [m]"""
    index = np.flatnonzero(observation.paired)
    left, right = observation.pixels_px[:, index]
    return index, observation.rig.triangulate(left, right)


def plane_normal(points_m: Array) -> Array:
    """(3,) normal with positive z of the total-least-squares plane through (K, 3) points (the seed paper's eq. 9)."""
    normal: Array = np.linalg.svd(points_m - points_m.mean(axis=0))[2][2]
    return normal if normal[2] >= 0 else -normal


def rotations_from_axes(axes: Array) -> Array:
    """(S, 3, 3) attitudes with roll zero and each of (S, 3) unit vectors as z axis."""
    pitch, yaw = angles_from_axis(axes)
    x = np.stack([np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)], axis=-1)
    y = np.stack([np.sin(yaw) * np.sin(pitch), np.cos(pitch), np.cos(yaw) * np.sin(pitch)], axis=-1)
    return np.stack([x, y, axes], axis=-1)


def align_roll(unrolled: Array, points_m: Array, origins_m: Array, centers_m: Array) -> Array:
    """Roll attitudes about their axis so that the markers point in the directions of the triangulated points.

    Args:
        unrolled: (S, 3, 3) attitudes.
        points_m: (K, 3) triangulated markers.
        origins_m: (S, 3) positions of the drogue.
        centers_m: (K, 3) the same markers in the drogue frame.

    Returns:
        (S, 3, 3) attitudes; roll is the angle of `sum q_i conj(m_i)` over in-plane complex coordinates.
    """
    in_plane = np.einsum("ski,sij->skj", points_m - origins_m[:, None], unrolled)
    turn = ((in_plane[..., 0] + 1j * in_plane[..., 1]) * (centers_m[:, 0] - 1j * centers_m[:, 1])).sum(axis=1)
    roll = np.angle(turn)
    rolled = unrolled.copy()
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    rolled[:, :, 0] = cos * unrolled[:, :, 0] + sin * unrolled[:, :, 1]
    rolled[:, :, 1] = cos * unrolled[:, :, 1] - sin * unrolled[:, :, 0]
    return rolled


def paired_mask(observation: Observation) -> NDArray[np.bool_]:
    """(2, N) mask of the measurements of markers that both eyes measured."""
    return np.stack([observation.paired, observation.paired])


def left_mask(observation: Observation) -> NDArray[np.bool_]:
    """(2, N) mask of the left eye's measurements."""
    return np.stack([observation.seen[0], np.zeros(observation.layout.count, dtype=bool)])
