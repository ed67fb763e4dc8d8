"""Light of parts as the picture shows it: behind the air before them and over the surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.stereo import EYES, Eye
from render.background import air_before
from render.compositing import TracedEye


@dataclass(frozen=True, eq=False)
class InPicture:
    """Both eyes of one frame; flat indices of the right eye come after all of the left.

    Attributes:
        frame: with its air.
        eyes: passes at mid-exposure.
        behind: (H, W, 3) surroundings of each eye. [cd/m2]
    """

    frame: FrameSpec
    eyes: dict[Eye, TracedEye]
    behind: dict[Eye, NDArray[np.float32]]

    def radiance(
        self, pixel: NDArray[np.int64], light: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(P, S, 3) radiance in the picture, and (P, 1) the share that the air leaves of parts' light.

        Args:
            pixel: (P,) flat indices.
            light: (P, S, 4) radiance and coverage of parts alone, by some samples of each pixel.
        """
        shown, clear = np.empty((*light.shape[:2], 3), dtype=np.float32), np.empty((len(pixel), 1), dtype=np.float32)
        for eye, (own, own_pixel) in zip(EYES, self.by_eye(pixel), strict=True):
            air, optical_depth_per_m = air_before(self.frame, own_pixel)
            clear[own] = self.eyes[eye].clear_share(own_pixel, optical_depth_per_m)
            behind = self.behind[eye].reshape(-1, 3)[own_pixel]
            # What a sample shows if it meets a part, less what it shows if it meets none.
            of_part = (1.0 - clear[own]) * air - behind
            shown[own] = light[own, :, :3] * clear[own, None] + light[own, :, 3:] * of_part[:, None] + behind[:, None]
        return shown, clear

    def shows(self, parts: NDArray[np.uint8], pixel: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(P,) whether the pixels' centres see one of the parts that a table by part id marks."""
        shows = np.zeros(len(pixel), dtype=np.bool_)
        for eye, (own, own_pixel) in zip(EYES, self.by_eye(pixel), strict=True):
            shows[own] = parts[self.eyes[eye].part_id.reshape(-1)[own_pixel]] > 0
        return shows

    def by_eye(self, pixel: NDArray[np.int64]) -> list[tuple[NDArray[np.bool_], NDArray[np.int64]]]:
        """For each eye (P,) which pixels are its own, and their indices in it."""
        size = self.eyes[EYES[0]].part_id.size
        return [(pixel // size == index, pixel[pixel // size == index] - index * size) for index in range(len(EYES))]
