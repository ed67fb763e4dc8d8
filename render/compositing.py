"""The traced pixels of an eye, composited behind the air and over the background."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP, Part
from geometry.stereo import EYES, Eye
from render.background import air_in_front
from render.engine import EyeRadiance

# Two float32 distances along one ray to one plane differ by a few roundings; hub and face are 0.25 m apart.
_SEAM_DEPTH_FRACTION = 1e-5
# Beyond these distances from a pixel whose centre sees nothing, the nearest depth is searched in the whole image.
_NEAREST_PX = (1, 2)
# Farther by this optical depth, a part that borders on a pixel counts in it.
_EDGE_OPTICAL_DEPTH = 0.05


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

    @classmethod
    def untraced(
        cls,
        part_id: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
        normal: NDArray[np.float32],
        amodal_px: dict[int, int],
    ) -> TracedEye:
        """Passes alone, no pixel traced yet."""
        return cls(
            part_id=part_id,
            depth_m=depth_m,
            normal=normal,
            amodal_px=amodal_px,
            pixel=np.zeros(0, dtype=np.int64),
            radiance_cd_m2=np.zeros((0, 3), dtype=np.float32),
            coverage=np.zeros(0, dtype=np.float32),
        )

    @classmethod
    def empty(cls, height_px: int, width_px: int) -> TracedEye:
        """Passes of an eye that sees nothing but the sky."""
        shape = (height_px, width_px)
        return cls.untraced(
            part_id=np.zeros(shape, dtype=np.uint8),
            depth_m=np.full(shape, np.inf, dtype=np.float32),
            normal=np.zeros((*shape, 3), dtype=np.float32),
            amodal_px={},
        )

    def with_light(self, pixel: NDArray[np.int64], light: NDArray[np.float32]) -> TracedEye:
        """The same passes with these pixels, and their (P, 4) radiance and coverage."""
        return replace(self, pixel=pixel, radiance_cd_m2=light[:, :3], coverage=light[:, 3])

    def apply_air(self, air: NDArray[np.float32], optical_depth_per_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Attenuate the light of parts by the air in front of them and add the air's own light, in place.

        Each pixel has the depth of what its centre sees. Where the centre misses, on an edge, the depth is that of the
        parts nearest to it in the image.

        Args:
            air: (P, 3) radiance of infinitely deep air in the direction of each traced pixel. [cd/m2]
            optical_depth_per_m: (P,) optical depth per planar depth. [1/m]

        Returns:
            (P, 1) the share of the parts' light that the air transmits.
        """
        clear = self.air_transmittance(self.pixel, optical_depth_per_m)
        self.radiance_cd_m2 = self.radiance_cd_m2 * clear + self.coverage[:, None] * (1.0 - clear) * air
        return clear

    def air_transmittance(
        self, pixel: NDArray[np.int64], optical_depth_per_m: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """(P, 1) share of the light of parts that the air in front of pixels transmits; see `apply_air`."""
        if not len(pixel):
            return np.zeros((0, 1), dtype=np.float32)
        depth_m = nearest_depth_m(self.depth_m, pixel)
        share: NDArray[np.float32] = np.exp(-optical_depth_per_m * depth_m)
        return share[:, None]

    def limit_edges(self, optical_depth_per_m: NDArray[np.float32]) -> None:
        """Keep near edges, in place and after `apply_air`, within what the pixels around them show.

        A pixel whose centre sees a near part may also show a farther one, whose light has then passed too little air:
        in mist it is too dark. A mixture lies between its parts.

        Args:
            optical_depth_per_m: as in `apply_air`.
        """
        seen_m = np.where(np.isfinite(self.depth_m), self.depth_m, np.float32(0.0))
        farther_m = cv2.dilate(seen_m, np.ones((3, 3), dtype=np.uint8)) - seen_m
        near = farther_m.reshape(-1)[self.pixel] * optical_depth_per_m > _EDGE_OPTICAL_DEPTH
        near &= self.part_id.reshape(-1)[self.pixel] > 0
        if not near.any():
            return
        around = np.ones((5, 5), dtype=np.uint8)
        whole = ~near & (self.coverage > 0)
        covered = self.coverage[near, None]
        for channel in range(3):
            least = np.full(self.depth_m.shape, np.inf, dtype=np.float32)
            level = self.radiance_cd_m2[whole, channel] / self.coverage[whole]
            least.reshape(-1)[self.pixel[whole]] = level
            most = np.where(np.isfinite(least), least, np.float32(-np.inf))
            low = cv2.erode(least, around, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
            high = cv2.dilate(most, around, borderType=cv2.BORDER_CONSTANT, borderValue=-np.inf)
            low, high = (bound.reshape(-1)[self.pixel[near]] for bound in (low, high))
            own = self.radiance_cd_m2[near, channel]
            limited = np.clip(own, low * covered[:, 0], high * covered[:, 0])
            self.radiance_cd_m2[near, channel] = np.where(np.isfinite(low), limited, own)

    def composited_pixels(self, background: NDArray[np.float32]) -> NDArray[np.float32]:
        """(P, 3) radiance of the traced pixels over a (H, W, 3) background. [cd/m2]"""
        through: NDArray[np.float32] = (1.0 - self.coverage)[:, None] * background.reshape(-1, 3)[self.pixel]
        return self.radiance_cd_m2 + through

    def composite_over(self, background: NDArray[np.float32]) -> EyeRadiance:
        """The whole image: traced pixels over a (H, W, 3) background. [cd/m2]"""
        radiance = background.copy()
        flat = radiance.reshape(-1, 3)
        flat[self.pixel] = self.composited_pixels(background)
        coverage = np.zeros(background.shape[:2], dtype=np.float32)
        coverage.reshape(-1)[self.pixel] = self.coverage
        return EyeRadiance(
            radiance_cd_m2=radiance,
            coverage=coverage,
            part_id=self.part_id,
            depth_m=self.depth_m,
            normal=self.normal,
            amodal_px=self.amodal_px,
        )


def nearest_depth_m(depth_m: NDArray[np.float32], pixel: NDArray[np.int64]) -> NDArray[np.float32]:
    """Depth at pixels, and where a centre sees nothing, that of what is nearest to it in the image.

    The depth of a pixel does not depend on which others are asked for.

    Args:
        depth_m: (H, W) planar depth, infinite where nothing is seen. [m]
        pixel: (P,) flat indices.

    Returns:
        (P,) depths, 0 in an image that shows nothing. [m]
    """
    found = depth_m.reshape(-1)[pixel]
    width = depth_m.shape[1]
    missed = np.flatnonzero(~np.isfinite(found))
    for reach_px in _NEAREST_PX if missed.size else ():
        rows = pixel[missed] // width
        first, end = max(int(rows.min()) - reach_px, 0), int(rows.max()) + reach_px + 1
        square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
        # By default OpenCV pads the image with finite numbers.
        eroded = cv2.erode(depth_m[first:end], square, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
        found[missed] = eroded.reshape(-1)[pixel[missed] - first * width]
        missed = missed[~np.isfinite(found[missed])]
        if not missed.size:
            break
    if missed.size:
        found[missed] = _depth_of_nearest(depth_m, *np.divmod(pixel[missed], width))
    return found


def _depth_of_nearest(
    depth_m: NDArray[np.float32], row: NDArray[np.int64], column: NDArray[np.int64]
) -> NDArray[np.float32]:
    """(P,) depths of what is nearest in the image to pixels that see nothing, however far away; 0 in an empty image."""
    seen = np.isfinite(depth_m)
    if not seen.any():
        return np.zeros(len(row), dtype=np.float32)
    # A window that holds all that is seen and asked for; often it is a small part of the image.
    of_seen = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    (top, bottom), (left, right) = (
        (min(places[0], asked.min()), max(places[-1], asked.max()) + 1)
        for places, asked in zip(of_seen, (row, column), strict=True)
    )
    part, depth_m = seen[top:bottom, left:right], depth_m[top:bottom, left:right]
    empty = (~part).astype(np.uint8)
    _, label = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    depth_of_label = np.zeros(int(label.max()) + 1, dtype=np.float32)
    depth_of_label[label[part]] = depth_m[part]
    nearest: NDArray[np.float32] = depth_of_label[label[row - top, column - left]]
    return nearest


def amodal_counts(
    part_id: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    alone_id: NDArray[np.uint8],
    alone_depth_m: NDArray[np.float32],
) -> dict[int, int]:
    """Number of pixel centres that each marker and the hub would cover if nothing but another of them occluded it.

    `render.hidden_features.add_hidden_centers` adds those that another one hides.

    A ray along the seam between a feature and the part that surrounds it may hit either. Both lie at one depth;
    then the hit in the whole scene counts, so that an unoccluded feature has as many amodal as visible pixels.

    Args:
        part_id, depth_m: what the pixel centres see, and its depth.
        alone_id, alone_depth_m: the same with markers and hub alone; of equal shape.
    """
    feature = ((part_id >= FIRST_MARKER_ID) & (part_id < INSTANCE_STEP)) | (part_id == Part.HUB)
    with np.errstate(invalid="ignore"):
        one_depth = np.abs(depth_m - alone_depth_m) <= _SEAM_DEPTH_FRACTION * depth_m
    counts = np.bincount(np.where(feature | one_depth, part_id, alone_id).ravel(), minlength=256)
    return {part: int(counts[part]) for part in (int(Part.HUB), *range(FIRST_MARKER_ID, INSTANCE_STEP)) if counts[part]}


def inside_one_part(part_id: NDArray[np.uint8] | NDArray[np.uint16], reach_px: int = 1) -> NDArray[np.bool_]:
    """(H, W) pixels around which all within `reach_px` see the same part: differences there are noise, not edges."""
    kernel = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
    alone: NDArray[np.bool_] = (cv2.erode(part_id, kernel) == cv2.dilate(part_id, kernel)) & (part_id > 0)
    return alone


@dataclass(frozen=True, eq=False)
class Compositor:
    """Composites samples of both eyes of one frame; flat indices of the right eye come after all of the left's.

    Attributes:
        frame: gives the air.
        eyes: passes at mid-exposure.
        background: (H, W, 3) by eye. [cd/m2]
    """

    frame: FrameSpec
    eyes: dict[Eye, TracedEye]
    background: dict[Eye, NDArray[np.float32]]

    def radiance(
        self, pixel: NDArray[np.int64], light: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Radiance of samples behind the air and over the background.

        Args:
            pixel: (P,) flat indices.
            light: (P, S, 4) radiance and coverage of parts alone, for S samples of each pixel.

        Returns:
            (P, S, 3) radiance [cd/m2], and (P, 1) share of the parts' light that the air transmits.
        """
        shown, clear = np.empty((*light.shape[:2], 3), dtype=np.float32), np.empty((len(pixel), 1), dtype=np.float32)
        for eye, (own, own_pixel) in zip(EYES, self.by_eye(pixel), strict=True):
            air, optical_depth_per_m = air_in_front(self.frame, eye, own_pixel)
            clear[own] = self.eyes[eye].air_transmittance(own_pixel, optical_depth_per_m)
            behind = self.background[eye].reshape(-1, 3)[own_pixel]
            # What a sample shows if it hits a part, less what it shows if it misses.
            of_part = (1.0 - clear[own]) * air - behind
            shown[own] = light[own, :, :3] * clear[own, None] + light[own, :, 3:] * of_part[:, None] + behind[:, None]
        return shown, clear

    def shows(self, parts: NDArray[np.uint8], pixel: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(P,) whether the pixels' centres see one of the parts that a (256,) table by part id marks."""
        shows: NDArray[np.bool_] = parts[self.part_ids(pixel)] > 0
        return shows

    def part_ids(self, pixel: NDArray[np.int64]) -> NDArray[np.uint8]:
        """(P,) what the pixels' centres see."""
        seen = np.zeros(len(pixel), dtype=np.uint8)
        for eye, (own, own_pixel) in zip(EYES, self.by_eye(pixel), strict=True):
            seen[own] = self.eyes[eye].part_id.reshape(-1)[own_pixel]
        return seen

    def by_eye(self, pixel: NDArray[np.int64]) -> list[tuple[NDArray[np.bool_], NDArray[np.int64]]]:
        """For each eye, (P,) which pixels are its own, and their flat indices in its image."""
        size = self.eyes[EYES[0]].part_id.size
        return [(pixel // size == index, pixel[pixel // size == index] - index * size) for index in range(len(EYES))]
