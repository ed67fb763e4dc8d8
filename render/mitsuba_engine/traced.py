"""What a tracer hands back for one eye, which pixels it has to trace, and how that goes over the surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe import RenderSettings
from drogue_models.parts import FIRST_MARKER_ID, Part, drogue_part_ids
from geometry.stereo import Eye
from render.engine import EyeRadiance

# Next to the centre, a little farther each time and off any one line: for rays that slip through a seam at the centre.
ASIDE = ((0.501, 0.5007), (0.496, 0.503), (0.507, 0.489))
# Two float32 distances along one ray to one plane differ by a few roundings; hub and face are 0.25 m apart.
_SEAM_DEPTH_FRACTION = 1e-5


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

    def put_behind_air(self, extinction_per_m: float, air: NDArray[np.float64]) -> None:
        """Let the air between parts and camera take its share of their light and add its own, in place.

        A pixel on an edge has the depth of its nearest neighbour; the drogue's own depth matters little to the haze.

        Args:
            extinction_per_m: extinction coefficient. [1/m]
            air: (3,) radiance of endless air. [cd/m2]
        """
        nearest = cv2.erode(self.depth_m, np.ones((5, 5), dtype=np.uint8)).reshape(-1)[self.pixel]
        clear = np.exp(-extinction_per_m * np.where(np.isfinite(nearest), nearest, 0.0))[:, None]
        through = self.radiance_cd_m2 * clear + self.coverage[:, None] * (1.0 - clear) * air
        self.radiance_cd_m2 = through.astype(np.float32)

    def over(self, behind: NDArray[np.float32]) -> EyeRadiance:
        """The traced pixels over the surroundings `behind` (H, W, 3)."""
        radiance = behind.copy()
        flat = radiance.reshape(-1, 3)
        flat[self.pixel] = self.radiance_cd_m2 + (1.0 - self.coverage)[:, None] * flat[self.pixel]
        coverage = np.zeros(behind.shape[:2], dtype=np.float32)
        coverage.reshape(-1)[self.pixel] = self.coverage
        return EyeRadiance(radiance, coverage, self.part_id, self.depth_m, self.normal, self.amodal_px)


@dataclass(frozen=True, eq=False)
class Traced:
    """Both eyes of one frame."""

    eyes: dict[Eye, TracedEye]
    monte_carlo_noise_fraction: float
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


def settings_by_plan(settings: RenderSettings) -> tuple[tuple[int, int], tuple[int, int]]:
    """Samples a pixel, and longest path, for the drogue and for what hangs around it.

    Hose and tanker are convex enough for light straight from sky, sun and ground.
    """
    return (settings.samples_per_px, settings.surround_samples_per_px), (settings.max_depth, 2)


def inside_one_part(part_id: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) pixels whose eight neighbours see the same part: what spreads there is noise and no edge."""
    kernel = np.ones((3, 3), dtype=np.uint8)
    alone: NDArray[np.bool_] = (cv2.erode(part_id, kernel) == cv2.dilate(part_id, kernel)) & (part_id > 0)
    return alone


def pixels_to_trace(
    ids: list[NDArray[np.uint8]], margin_px: int, marker_count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat indices of the pixels that may see the drogue, and of the others that may see hose or tanker.

    Args:
        ids: (H, W) part ids of pixel centres, at one or more times of the exposure.
        margin_px: how far beyond those a part may reach into other pixels.
        marker_count: number of markers.
    """
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    belongs = np.zeros(256, dtype=np.uint8)
    belongs[drogue_part_ids(marker_count)] = 1
    drogue = np.zeros(ids[0].shape, dtype=np.uint8)
    covered = np.zeros(ids[0].shape, dtype=np.uint8)
    for part_id in ids:
        drogue |= belongs[part_id]
        covered |= (part_id != Part.SKY).astype(np.uint8)
    drogue = cv2.dilate(drogue, kernel)
    covered = cv2.dilate(covered, kernel)
    return np.flatnonzero(drogue), np.flatnonzero(covered & ~drogue & 1)
