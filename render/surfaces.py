"""What the surfaces of a frame reflect and emit: each part's paint with its ageing, dirt and lamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.appearance import AS_NEW, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import FIRST_MARKER_ID, SURROUNDING_PARTS, Part, part_reflectance_rgb
from scenes.sky.photometry import REC709_LUMINANCE

DIRT_MAP_PX = 64
# Soot, hydraulic fluid and road dust: dark and nearly grey (our choice).
DIRT_RGB = (0.055, 0.050, 0.045)
_BLOTCH_PX = 5.0
_EDGE_PX = 1.2
SMOOTH_PARTS = (Part.RIM, Part.HOSE, Part.TANKER, Part.PROBE, Part.OBSTACLE, Part.DISTRACTOR)
"""Parts with interpolated normals, whose meshes need creases at sharp edges; other parts have flat faces."""


def surface_condition(frame: FrameSpec, part_id: int) -> SurfaceCondition:
    """State of a marker or the hub; all other parts age together, see `clean_reflectance_rgb`."""
    if frame.condition is None:
        return AS_NEW
    if part_id == Part.HUB:
        return frame.condition.hub
    return frame.condition.of_marker(part_id - FIRST_MARKER_ID) if part_id >= FIRST_MARKER_ID else AS_NEW


def clean_reflectance_rgb(frame: FrameSpec, part_id: int) -> NDArray[np.float64]:
    """(3,) diffuse reflectance of a part of the drogue, the hose or the tanker, without its dirt.

    Raises:
        ValueError: the frame has no such part.
    """
    if frame.drogue is None:
        raise ValueError("drogue: the frame has none")
    paint = np.array(part_reflectance_rgb(frame.drogue, part_id))
    if part_id == Part.HUB or part_id >= FIRST_MARKER_ID:
        return paint * surface_condition(frame, part_id).reflectance_fraction
    worn = frame.condition is not None and (part_id == Part.HOSE or part_id not in SURROUNDING_PARTS)
    fraction = frame.condition.body_reflectance_fraction if worn and frame.condition is not None else 1.0
    return np.minimum(paint * fraction, 1.0)


def reflectance_map(frame: FrameSpec, part_id: int) -> NDArray[np.float32]:
    """(64, 64, 3) reflectance with dirt over the square around a marker or the hub; row 0 is the low y end."""
    condition = surface_condition(frame, part_id)
    dirt = dirt_map(condition.dirt_seed, condition.dirt_fraction)[..., None]
    paint = clean_reflectance_rgb(frame, part_id)
    result: NDArray[np.float32] = (paint * (1.0 - dirt) + np.array(DIRT_RGB) * dirt).astype(np.float32)
    return result


def mean_reflectance_rgb(frame: FrameSpec, part_id: int) -> NDArray[np.float64]:
    """(3,) diffuse reflectance of a part, with its dirt spread evenly."""
    dirt = surface_condition(frame, part_id).dirt_fraction
    mean: NDArray[np.float64] = clean_reflectance_rgb(frame, part_id) * (1.0 - dirt) + np.array(DIRT_RGB) * dirt
    return mean


def lamp_radiance_rgb(frame: FrameSpec, part_id: int) -> NDArray[np.float64]:
    """(3,) radiance that a marker emits, 0 for all other parts. [cd/m2]"""
    if frame.drogue is None or part_id < FIRST_MARKER_ID or frame.drogue.marker_luminance_cd_m2 == 0:
        return np.zeros(3)
    color = np.array(frame.drogue.marker_emission_rgb)
    luminance = frame.drogue.marker_luminance_cd_m2 * surface_condition(frame, part_id).lamp_fraction
    radiance: NDArray[np.float64] = luminance * color / (color @ REC709_LUMINANCE)
    return radiance


def missing_parts(frame: FrameSpec) -> set[int]:
    """Part ids of the markers, and possibly the hub, that have come off."""
    return {part for part in _features(frame) if surface_condition(frame, part).missing}


def dirty_parts(frame: FrameSpec) -> set[int]:
    """Part ids of the markers, and possibly the hub, that have dirt."""
    return {part for part in _features(frame) if not surface_condition(frame, part).is_clean}


def _features(frame: FrameSpec) -> list[int]:
    """Part ids of hub and markers of a drogue whose condition is not as new."""
    if frame.drogue is None or frame.condition is None:
        return []
    return [int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + frame.drogue.marker_count)]


def dirt_map(seed: int, dirt_fraction: float) -> NDArray[np.float32]:
    """Where dirt covers the square around a disc.

    Args:
        seed: of the pattern.
        dirt_fraction: share of the square that is covered.

    Returns:
        (64, 64) share of each texel under dirt, 0 to 1; row 0 is the low y end of the square.
    """
    noise = frame_generator(seed, 0, "dirt").standard_normal((DIRT_MAP_PX, DIRT_MAP_PX))
    smooth = gaussian_filter(noise, _BLOTCH_PX, mode="wrap")
    covered = (smooth >= np.quantile(smooth, 1.0 - dirt_fraction)).astype(np.float64)
    if dirt_fraction <= 0:
        covered[:] = 0.0
    softened: NDArray[np.float32] = gaussian_filter(covered, _EDGE_PX, mode="wrap").astype(np.float32)
    return softened
