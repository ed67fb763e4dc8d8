"""What a tracer is given and returns for both eyes, and which pixels it has to trace."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import (
    INSTANCE_STEP,
    MAX_MARKERS,
    MAX_NEIGHBOURS,
    SURROUNDING_PARTS,
    Part,
    drogue_part_ids,
    marker_id,
)
from geometry.stereo import Eye
from render.compositing import TracedEye, inside_one_part
from scenes.environment_radiance import EnvironmentRadiance

# Places near the pixel centre, each a little farther away and on no common line: for rays that leak through a seam
# between two triangles exactly at the centre.
OFF_CENTER = ((0.501, 0.5007), (0.496, 0.503), (0.507, 0.489))


def parts_table(parts: Iterable[int]) -> NDArray[np.uint8]:
    """(256,) 1 at the given part ids, 0 elsewhere."""
    table = np.zeros(256, dtype=np.uint8)
    table[list(parts)] = 1
    return table


_INSTANCES = range(MAX_NEIGHBOURS + 1)
# Drogues beside the sought one are sampled like it.
DROGUE_PARTS = parts_table(part for instance in _INSTANCES for part in drogue_part_ids(MAX_MARKERS, instance))
_MARKERS = parts_table(marker_id(index) for index in range(MAX_MARKERS))
_DEEP_PARTS = (Part.COUPLING, Part.HUB)
_DEEP = parts_table(INSTANCE_STEP * instance + part for instance in _INSTANCES for part in _DEEP_PARTS)
# Parts from which most of the sky is visible.
OPEN_TO_SKY = parts_table(
    INSTANCE_STEP * instance + part
    for instance in _INSTANCES
    for part in {*drogue_part_ids(MAX_MARKERS), *SURROUNDING_PARTS} - {Part.CANOPY, Part.RIBS, *_DEEP_PARTS}
)


def parts_in(part_id: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) where an image of part ids shows one of the parts that a (256,) table marks."""
    # Two to three times as fast as indexing; so is a search for True compared with one for non-zero numbers.
    marked: NDArray[np.bool_] = cv2.LUT(part_id, table) > 0
    return marked


def leaked_rays(
    part_id: NDArray[np.uint8], normals: NDArray[np.float32], towards: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which rays hit a surface that no ray can reach, because they passed exactly between two triangles.

    All parts are closed, so a surface that faces away from the camera was hit from inside. A marker fills its pocket up
    to the front, so a hit on its side wall came from within the face. A ray that grazes an edge may hit the part when
    it is traced among other rays and miss it when it is traced alone: its normal is then 0.

    Args:
        part_id: (...,) part that each ray hit.
        normals: (..., 3) outward normal there, in the drogue frame.
        towards: (..., 3) direction of the ray, of any length, in the drogue frame.
    """
    inside: NDArray[np.bool_] = (normals * towards).sum(axis=-1) >= 0
    on_wall = (_MARKERS[part_id] > 0) & (normals[..., 2] > -0.5)
    return (part_id > 0) & (inside | on_wall)


@dataclass(frozen=True, eq=False)
class TraceRequest:
    """What a tracer is given.

    Attributes:
        frame: has a drogue or other objects.
        settings: samples and depths.
        ambient: radiance of the environment, which lights them.
        background: (H, W, 3) by eye, what it sees of the environment. [cd/m2]
    """

    frame: FrameSpec
    settings: RenderSettings
    ambient: EnvironmentRadiance
    background: dict[Eye, NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class TraceResult:
    """Both eyes of one frame.

    Attributes:
        eyes: passes and traced pixels.
        duplicates: the same passes with some pixels of the drogue, traced a second time with other samples.
        duplicate_error: (A, 3) by eye, known errors of radiance that those pixels share with their first tracing.
            [cd/m2]
        stage_s: CPU seconds by stage. [s]
    """

    eyes: dict[Eye, TracedEye]
    duplicates: dict[Eye, TracedEye]
    duplicate_error: dict[Eye, NDArray[np.float32]]
    stage_s: dict[str, float]


CONTEXT_DEPTH = 2
"""Longest path for hose, tanker and other objects: convex enough for direct light from sky, sun and ground."""


@dataclass(frozen=True, eq=False)
class SamplingPlan:
    """Flat indices of the pixels to trace, by how many samples they need; no pixel is in two groups.

    Attributes:
        open: inside markers, face and rim, from which hardly any light is hidden.
        sheltered: inside canopy and ribs, which light reaches by reflection.
        deep: inside hub and coupling: few and dark, at the bottom of the basket.
        deep_edges: other pixels of hub and coupling.
        edges: other pixels of the drogue, where parts, shadows or dirt may meet.
        context: pixels that see no drogue, but may see other objects.
    """

    open: NDArray[np.int64]
    sheltered: NDArray[np.int64]
    deep: NDArray[np.int64]
    deep_edges: NDArray[np.int64]
    edges: NDArray[np.int64]
    context: NDArray[np.int64]


def plan_pixels(
    ids: list[NDArray[np.uint8]],
    sunlit: list[NDArray[np.bool_]],
    margin_px: int,
    uneven: Iterable[int],
    narrow: NDArray[np.uint8] | None = None,
) -> SamplingPlan:
    """Which pixels to trace.

    Args:
        ids: (H, W) part ids at the pixel centres, at one or more times of the exposure.
        sunlit: (H, W) whether the drogue's surface there sees the sun, at the same times.
        margin_px: how far a part may extend beyond those centres into other pixels.
        uneven: ids of parts whose paint has edges of its own anywhere.
        narrow: (H, W) ids of parts that may pass between the pixel centres.
    """
    even = (parts_table(uneven) == 0).astype(np.uint8)
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    drogue, covered = (np.zeros(ids[0].shape, dtype=np.bool_) for _ in range(2))
    inside = np.ones(ids[0].shape, dtype=np.bool_)
    for part_id, in_sun in zip(ids, sunlit, strict=True):
        drogue |= parts_in(part_id, DROGUE_PARTS)
        covered |= part_id != Part.SKY
        # A part's sunlit and shadowed surfaces count as two.
        inside &= inside_one_part((2 * part_id.astype(np.uint16) + in_sun).astype(np.uint16), margin_px) & parts_in(
            part_id, even
        )
    if narrow is not None:
        drogue |= parts_in(narrow, DROGUE_PARTS)
        covered |= narrow != Part.SKY
    belongs, reached = (cv2.dilate(seen.view(np.uint8), kernel) > 0 for seen in (drogue, covered))
    of_open, of_deep = (parts_in(ids[0], table) for table in (OPEN_TO_SKY, _DEEP))
    within, edges = belongs & inside, belongs & ~inside
    return SamplingPlan(
        open=np.flatnonzero(within & of_open),
        sheltered=np.flatnonzero(within & ~of_open & ~of_deep),
        deep=np.flatnonzero(within & of_deep),
        deep_edges=np.flatnonzero(edges & of_deep),
        edges=np.flatnonzero(edges & ~of_deep),
        context=np.flatnonzero(reached & ~belongs),
    )
