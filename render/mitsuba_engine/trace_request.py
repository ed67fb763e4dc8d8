"""What a tracer is asked for and hands back for both eyes, and which pixels it has to trace."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import MAX_MARKERS, SURROUNDING_PARTS, Part, drogue_part_ids, marker_id
from geometry.stereo import Eye
from render.compositing import TracedEye, inside_one_part
from scenes.environment_radiance import Surroundings

# Next to the centre, a little farther each time and off any one line: for rays that slip through a seam at the centre.
ASIDE = ((0.501, 0.5007), (0.496, 0.503), (0.507, 0.489))


def _marked(parts: Iterable[int]) -> NDArray[np.uint8]:
    table = np.zeros(256, dtype=np.uint8)
    table[list(parts)] = 1
    return table


OF_DROGUE = _marked(drogue_part_ids(MAX_MARKERS))
_MARKERS = _marked(marker_id(index) for index in range(MAX_MARKERS))
_DEEP_PARTS = (Part.COUPLING, Part.HUB)
_DEEP = _marked(_DEEP_PARTS)
# Whether most of the sky is seen from a part, by its id.
IN_OPEN = _marked({*drogue_part_ids(MAX_MARKERS), *SURROUNDING_PARTS} - {Part.CANOPY, Part.RIBS, *_DEEP_PARTS})


def parts_in(part_id: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) where an image of part ids shows those that a table marks."""
    # Two to three times as quick as indexing, and so are searches for what is true in place of what is not 0.
    marked: NDArray[np.bool_] = cv2.LUT(part_id, table) > 0
    return marked


def slipped_through(
    part_id: NDArray[np.uint8], normals: NDArray[np.float32], towards: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which rays met what no ray can see, having passed exactly between two triangles.

    All parts are closed, so a surface that looks away from the camera is seen from inside. A marker fills its pocket
    up to the front, so its wall is seen from within the face. A ray that grazes an edge may have met the part in other
    company, but nothing alone: its normal is 0.

    Args:
        part_id: (...,) part that each ray met.
        normals: (..., 3) outward normal there, in the drogue frame.
        towards: (..., 3) direction of the ray, of any length, in the drogue frame.
    """
    inside: NDArray[np.bool_] = (normals * towards).sum(axis=-1) >= 0
    on_wall = (_MARKERS[part_id] > 0) & (normals[..., 2] > -0.5)
    return (part_id > 0) & (inside | on_wall)


@dataclass(frozen=True, eq=False)
class ToTrace:
    """What a tracer is asked for.

    Attributes:
        frame: with a drogue or bystanders.
        settings: how.
        around: what lights them.
        behind: (H, W, 3) what each eye sees of it. [cd/m2]
    """

    frame: FrameSpec
    settings: RenderSettings
    around: Surroundings
    behind: dict[Eye, NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class Traced:
    """Both eyes of one frame.

    Attributes:
        eyes: what was traced.
        again: the same passes with some pixels of the drogue, traced a second time with other samples.
        error_again: (A, 3) by eye, known errors of the radiance of those that both share. [cd/m2]
        stage_s: CPU seconds by stage. [s]
    """

    eyes: dict[Eye, TracedEye]
    again: dict[Eye, TracedEye]
    error_again: dict[Eye, NDArray[np.float32]]
    stage_s: dict[str, float]


SURROUND_DEPTH = 2
"""Longest path for hose, tanker and bystanders: convex enough for light straight from sky, sun and ground."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Flat indices of the pixels to trace, by how many samples they need; no pixel is in two of them.

    Attributes:
        open: inside markers, face and rim, whose light is hardly hidden by anything.
        sheltered: inside canopy and ribs, that light reaches by way of others.
        deep: inside hub and coupling, few and dark, at the bottom of the basket.
        deep_edges: elsewhere on these.
        edges: elsewhere, where parts or their shadows or dirt may meet.
        surround: what sees no drogue, but may see other things.
    """

    open: NDArray[np.int64]
    sheltered: NDArray[np.int64]
    deep: NDArray[np.int64]
    deep_edges: NDArray[np.int64]
    edges: NDArray[np.int64]
    surround: NDArray[np.int64]


def plan_pixels(
    ids: list[NDArray[np.uint8]], sunlit: list[NDArray[np.bool_]], margin_px: int, uneven: Iterable[int]
) -> Plan:
    """Which pixels to trace.

    Args:
        ids: (H, W) part ids of pixel centres, at one or more times of the exposure.
        sunlit: (H, W) whether the drogue's surface there sees the sun, at the same times.
        margin_px: how far beyond those a part may reach into other pixels.
        uneven: ids of parts whose paint has edges of its own anywhere.
    """
    even = (_marked(uneven) == 0).astype(np.uint8)
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    drogue, covered = (np.zeros(ids[0].shape, dtype=np.bool_) for _ in range(2))
    inside = np.ones(ids[0].shape, dtype=np.bool_)
    for part_id, in_sun in zip(ids, sunlit, strict=True):
        drogue |= parts_in(part_id, OF_DROGUE)
        covered |= part_id != Part.SKY
        # A part's sunlit and shadowed surfaces count as two.
        inside &= inside_one_part((2 * part_id + in_sun).astype(np.uint8), margin_px) & parts_in(part_id, even)
    belongs, reached = (cv2.dilate(seen.view(np.uint8), kernel) > 0 for seen in (drogue, covered))
    of_open, of_deep = (parts_in(ids[0], table) for table in (IN_OPEN, _DEEP))
    within, edges = belongs & inside, belongs & ~inside
    return Plan(
        open=np.flatnonzero(within & of_open),
        sheltered=np.flatnonzero(within & ~of_open & ~of_deep),
        deep=np.flatnonzero(within & of_deep),
        deep_edges=np.flatnonzero(edges & of_deep),
        edges=np.flatnonzero(edges & ~of_deep),
        surround=np.flatnonzero(reached & ~belongs),
    )
