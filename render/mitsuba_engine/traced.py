"""What a tracer hands back for one eye, which pixels it has to trace, and how that goes over the surroundings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import FIRST_MARKER_ID, MAX_MARKERS, SURROUNDING_PARTS, Part, drogue_part_ids
from geometry.stereo import Eye
from render.engine import EyeRadiance

# Next to the centre, a little farther each time and off any one line: for rays that slip through a seam at the centre.
ASIDE = ((0.501, 0.5007), (0.496, 0.503), (0.507, 0.489))
# Two float32 distances along one ray to one plane differ by a few roundings; hub and face are 0.25 m apart.
_SEAM_DEPTH_FRACTION = 1e-5


def _marked(parts: Iterable[int]) -> NDArray[np.uint8]:
    table = np.zeros(256, dtype=np.uint8)
    table[list(parts)] = 1
    return table


OF_DROGUE = _marked(drogue_part_ids(MAX_MARKERS))
_DEEP_PARTS = (Part.COUPLING, Part.HUB)
_DEEP = _marked(_DEEP_PARTS)
# Whether most of the sky is seen from a part, by its id.
IN_OPEN = _marked({*drogue_part_ids(MAX_MARKERS), *SURROUNDING_PARTS} - {Part.CANOPY, Part.RIBS, *_DEEP_PARTS})


@dataclass(eq=False)
class TracedEye:
    """Passes of all pixel centres, and radiance of the traced pixels.

    Attributes:
        part_id, depth_m, normal, amodal_px: as in `EyeRadiance`.
        pixel: (P,) flat indices of the traced pixels.
        radiance_cd_m2: (P, 3) light from parts alone, already weighted by coverage. [cd/m2]
        coverage: (P,) share of the pixel that parts cover.
    """

    part_id: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    amodal_px: dict[int, int]
    pixel: NDArray[np.int64]
    radiance_cd_m2: NDArray[np.float32]
    coverage: NDArray[np.float32]

    def lit_by(self, pixel: NDArray[np.int64], light: NDArray[np.float32]) -> TracedEye:
        """The same passes with these pixels, and their (P, 4) radiance and coverage."""
        return replace(self, pixel=pixel, radiance_cd_m2=light[:, :3], coverage=light[:, 3])

    def put_behind_air(self, air: NDArray[np.float32], optical_depth_per_m: NDArray[np.float32]) -> None:
        """Let the air between parts and camera take its share of their light and add its own, in place.

        A pixel on an edge has the depth of its nearest neighbour; the drogue's own depth matters little to the haze.

        Args:
            air: (P, 3) radiance of endless air in the direction of each traced pixel. [cd/m2]
            optical_depth_per_m: (P,) optical depth per planar depth. [1/m]
        """
        nearest = cv2.erode(self.depth_m, np.ones((5, 5), dtype=np.uint8)).reshape(-1)[self.pixel]
        clear = np.exp(-optical_depth_per_m * np.where(np.isfinite(nearest), nearest, 0.0))[:, None]
        through = self.radiance_cd_m2 * clear + self.coverage[:, None] * (1.0 - clear) * air
        self.radiance_cd_m2 = through.astype(np.float32)

    def pixels_over(self, behind: NDArray[np.float32]) -> NDArray[np.float32]:
        """(P, 3) radiance of the traced pixels over the surroundings `behind` (H, W, 3)."""
        through: NDArray[np.float32] = (1.0 - self.coverage)[:, None] * behind.reshape(-1, 3)[self.pixel]
        return self.radiance_cd_m2 + through

    def over(self, behind: NDArray[np.float32]) -> EyeRadiance:
        """The traced pixels over the surroundings `behind` (H, W, 3)."""
        radiance = behind.copy()
        flat = radiance.reshape(-1, 3)
        flat[self.pixel] = self.pixels_over(behind)
        coverage = np.zeros(behind.shape[:2], dtype=np.float32)
        coverage.reshape(-1)[self.pixel] = self.coverage
        return EyeRadiance(radiance, coverage, self.part_id, self.depth_m, self.normal, self.amodal_px)


@dataclass(frozen=True, eq=False)
class Traced:
    """Both eyes of one frame.

    Attributes:
        eyes: what was traced.
        again: the same passes with some pixels of the drogue, traced a second time with other samples.
        stage_s: CPU seconds by stage. [s]
    """

    eyes: dict[Eye, TracedEye]
    again: dict[Eye, TracedEye]
    stage_s: dict[str, float]


def amodal_counts(
    part_id: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    alone_id: NDArray[np.uint8],
    alone_depth_m: NDArray[np.float32],
) -> dict[int, int]:
    """Pixel centres that each marker and the hub would cover if nothing stood before it.

    A ray along the seam between a feature and the part that it is set into may fall to either; both lie at one depth,
    and then the whole scene's verdict counts, so that an unoccluded feature has exactly as many as are seen of it.

    Args:
        part_id, depth_m: what the pixel centres see, and how far.
        alone_id, alone_depth_m: the same with markers and hub alone; of equal shape.
    """
    feature = (part_id >= FIRST_MARKER_ID) | (part_id == Part.HUB)
    with np.errstate(invalid="ignore"):
        one_depth = np.abs(depth_m - alone_depth_m) <= _SEAM_DEPTH_FRACTION * depth_m
    counts = np.bincount(np.where(feature | one_depth, part_id, alone_id).ravel(), minlength=256)
    return {part: int(counts[part]) for part in (int(Part.HUB), *range(FIRST_MARKER_ID, 256)) if counts[part]}


def inside_one_part(part_id: NDArray[np.uint8], reach_px: int = 1) -> NDArray[np.bool_]:
    """(H, W) pixels from which all within `reach_px` see the same part: what spreads there is noise and no edge."""
    kernel = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
    alone: NDArray[np.bool_] = (cv2.erode(part_id, kernel) == cv2.dilate(part_id, kernel)) & (part_id > 0)
    return alone


SURROUND_DEPTH = 2
"""Longest path for hose, tanker and bystanders: convex enough for light straight from sky, sun and ground."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Flat indices of the pixels to trace, by how many samples they need; no pixel is in two of them.

    Attributes:
        open: inside markers, face and rim, whose light is hardly hidden by anything.
        sheltered: inside canopy and ribs, that light reaches by way of others.
        deep: on hub and coupling, few and dark, at the bottom of the basket.
        edges: elsewhere, where parts or their shadows may meet.
        surround: what sees no drogue, but may see other things.
    """

    open: NDArray[np.int64]
    sheltered: NDArray[np.int64]
    deep: NDArray[np.int64]
    edges: NDArray[np.int64]
    surround: NDArray[np.int64]


def plan_pixels(ids: list[NDArray[np.uint8]], sunlit: list[NDArray[np.bool_]], margin_px: int) -> Plan:
    """Which pixels to trace.

    Args:
        ids: (H, W) part ids of pixel centres, at one or more times of the exposure.
        sunlit: (H, W) whether the drogue's surface there sees the sun, at the same times.
        margin_px: how far beyond those a part may reach into other pixels.
    """
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    drogue = np.zeros(ids[0].shape, dtype=np.uint8)
    covered = np.zeros(ids[0].shape, dtype=np.uint8)
    inside = np.ones(ids[0].shape, dtype=np.bool_)
    for part_id, in_sun in zip(ids, sunlit, strict=True):
        drogue |= OF_DROGUE[part_id]
        covered |= (part_id != Part.SKY).astype(np.uint8)
        # A part's sunlit and shadowed surfaces count as two.
        inside &= inside_one_part((2 * part_id + in_sun).astype(np.uint8), margin_px)
    belongs = cv2.dilate(drogue, kernel) > 0
    of_open, of_deep = IN_OPEN[ids[0]] > 0, _DEEP[ids[0]] > 0
    return Plan(
        open=np.flatnonzero(belongs & inside & of_open),
        sheltered=np.flatnonzero(belongs & inside & ~of_open & ~of_deep),
        deep=np.flatnonzero(belongs & of_deep),
        edges=np.flatnonzero(belongs & ~inside & ~of_deep),
        surround=np.flatnonzero((cv2.dilate(covered, kernel) > 0) & ~belongs),
    )
