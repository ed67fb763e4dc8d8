"""Boxes of the drogue in pixel-centre coordinates: of all of it, and of what is visible."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from datasets_manifest.types.records import PixelBox
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import drogue_part_ids
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig
from labelgen.part_pixels import is_one_of


@lru_cache(maxsize=8)
def drogue_hull_m(drogue: DrogueParameters) -> Array:
    """(V, 3) corners of the convex hull of rim, face, canopy, ribs, coupling, hub and markers, drogue frame. [m]

    A perspective image's extent is reached at corners of the hull, so nothing else has to be projected.
    """
    meshes = drogue_meshes(drogue)
    wanted = [np.asarray(meshes[part].vertices) for part in drogue_part_ids(drogue.marker_count) if part in meshes]
    vertices = np.concatenate(wanted).astype(np.float64)
    hull: Array = vertices[ConvexHull(vertices).vertices]
    hull.flags.writeable = False
    return hull


def full_box(drogue: DrogueParameters, rig: StereoRig, left_from_drogue: RigidTransform, eye: Eye) -> PixelBox:
    """Box around the image of the whole drogue, neither clipped by the frame nor occluded. [px]

    Raises:
        ValueError: part of the drogue is not in front of the camera.
    """
    points = left_from_drogue.apply(drogue_hull_m(drogue))
    if points[:, 2].min() <= 0:
        raise ValueError(
            f"left_from_drogue: all of the drogue must be in front of the camera, got {points[:, 2].min():g} m"
        )
    image = rig.image(points, eye)
    low, high = image.min(axis=0), image.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def visible_mask(part_id: NDArray[np.uint8], marker_count: int) -> NDArray[np.bool_]:
    """(H, W) whether a pixel centre sees a part that belongs to the drogue's box."""
    return is_one_of(part_id, drogue_part_ids(marker_count))


def visible_box(mask: NDArray[np.bool_]) -> PixelBox | None:
    """Box around the pixels of a mask, their whole areas included, or None for an empty one. [px]"""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if columns.size == 0:
        return None
    u_low, u_high, v_low, v_high = (int(end) for end in (columns[0], columns[-1], rows[0], rows[-1]))
    return u_low - 0.5, v_low - 0.5, float(u_high - u_low + 1), float(v_high - v_low + 1)


def leaves_image(box: PixelBox, camera: PinholeCamera) -> bool:
    """Whether a box is not wholly on the image."""
    u, v, width, height = box
    return bool(u < -0.5 or v < -0.5 or u + width > camera.width_px - 0.5 or v + height > camera.height_px - 0.5)
