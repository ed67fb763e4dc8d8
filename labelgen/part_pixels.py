"""Which pixels of an eye see which part, and boxes around the drogue."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from datasets_manifest.types.records import PixelBox
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, MAX_MARKERS, Part, drogue_part_ids
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig

Indices = NDArray[np.int64]

_FEATURES = (int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + MAX_MARKERS))


def parts_mask(part_id: NDArray[np.uint8], parts: tuple[int, ...] | list[int]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel centre sees one of the given parts."""
    table = np.zeros(256, dtype=np.uint8)
    table[list(parts)] = 1
    mask: NDArray[np.bool_] = cv2.LUT(part_id, table).view(np.bool_)
    return mask


class FeaturePixels:
    """Pixels of markers and hub in one eye's image, found in one pass over it."""

    def __init__(self, part_id: NDArray[np.uint8]) -> None:
        found = cv2.findNonZero(parts_mask(part_id, _FEATURES).view(np.uint8))
        places = np.zeros((0, 2), dtype=np.int64) if found is None else found.reshape(-1, 2).astype(np.int64)
        parts = part_id[places[:, 1], places[:, 0]]
        order = np.argsort(parts, kind="stable")
        self._places = places[order]
        self._ends = np.searchsorted(parts[order], np.arange(257))

    def count(self, part: int) -> int:
        """Number of pixel centres that see a feature."""
        return int(self._ends[part + 1] - self._ends[part])

    def indices(self, part: int) -> tuple[Indices, Indices]:
        """Rows and columns of the pixel centres that see a feature, row by row."""
        places = self._places[self._ends[part] : self._ends[part + 1]]
        return places[:, 1], places[:, 0]


# A recipe may have a drogue for each of hundreds of scenes, and visits them in turn; a hull takes some kilobytes.
@lru_cache(maxsize=1024)
def drogue_hull_m(drogue: DrogueParameters) -> Array:
    """(V, 3) corners of the convex hull of rim, face, canopy, ribs, coupling, hub and markers, drogue frame. [m]

    The extent of a perspective image is reached at corners of the hull, so only these have to be projected.
    """
    meshes = drogue_meshes(drogue)
    wanted = [np.asarray(meshes[part].vertices) for part in drogue_part_ids(drogue.marker_count) if part in meshes]
    vertices = np.concatenate(wanted).astype(np.float64)
    hull: Array = vertices[ConvexHull(vertices).vertices]
    hull.flags.writeable = False
    return hull


def drogue_box(drogue: DrogueParameters, rig: StereoRig, left_from_drogue: RigidTransform, eye: Eye) -> PixelBox:
    """Box around the image of the whole drogue, neither clipped by the frame nor occluded. [px]

    Behind a lens it ends with the lens's field (`StereoRig.image`).

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


def drogue_mask(part_id: NDArray[np.uint8], marker_count: int, instance: int = 0) -> NDArray[np.bool_]:
    """(H, W) whether a pixel centre sees a part of a drogue, as its box covers it; see `drogue_part_ids`."""
    return parts_mask(part_id, drogue_part_ids(marker_count, instance))


def mask_box(mask: NDArray[np.bool_]) -> PixelBox | None:
    """Box around the areas of a mask's pixels, or None for an empty mask. [px]"""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if columns.size == 0:
        return None
    u_low, u_high, v_low, v_high = (int(end) for end in (columns[0], columns[-1], rows[0], rows[-1]))
    return u_low - 0.5, v_low - 0.5, float(u_high - u_low + 1), float(v_high - v_low + 1)


def is_truncated(box: PixelBox, camera: PinholeCamera) -> bool:
    """Whether a box reaches beyond the image."""
    u, v, width, height = box
    return bool(u < -0.5 or v < -0.5 or u + width > camera.width_px - 0.5 or v + height > camera.height_px - 0.5)
