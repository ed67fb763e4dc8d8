"""What lies beyond the dark face around the markers, where the drogue is so far away that their edges see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.centroids.edge_profile import blurred_step
from nav.centroids.ellipses import Ellipses, plane_shapes
from nav.centroids.marker_signal import Array32
from nav.centroids.patches import PixelSet, edge_distances

# Fewer markers than this do not tell an affine map.
_LEAST_MARKERS = 3
# Pixels that see more of what lies beyond are left out: ribs, hose, hub and sky are not even. What the lens spreads
# from there over the others is fitted as if it were.
MOST_BEYOND = 0.5


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The face of the drogue by the places of the fitted markers on it.

    Attributes:
        places_m: (M, 2) of the markers in the rim plane, in the order of the discs. [m]
        edges_m: radii about the origin of the rim plane within which the face begins and ends. [m]
    """

    places_m: Array
    edges_m: tuple[float, float]

    def take(self, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Surroundings:
        """Those of some discs."""
        return Surroundings(self.places_m[index], self.edges_m)


def shares_beyond(around: Surroundings, discs: Ellipses, pixels: PixelSet, width_px: float) -> Array32 | None:
    """How much of each pixel's light comes from within the face's opening, and from beyond the rim.

    The face is where an affine map of the eye's own markers shows it, shifted so that the disc itself lies where it was
    found: perspective within the drogue moves the rim against a marker by hundredths of a pixel at such distances.

    Args:
        around: the face.
        discs: the markers, placed to a tenth of a pixel or so.
        pixels: of the discs.
        width_px: Gaussian width of edges.

    Returns:
        (N, 2, K), or None where an eye has too few markers to tell.
    """
    count = len(discs)
    middles, shapes = np.empty((count, 2)), np.empty((2, count, 2, 2))
    for eye in np.unique(discs.eyes):
        mine = np.flatnonzero(discs.eyes == eye)
        if len(mine) < _LEAST_MARKERS:
            return None
        design = np.column_stack([around.places_m[mine], np.ones(len(mine))])
        affine = np.linalg.lstsq(design, discs.centers_px[mine], rcond=None)[0].T
        if abs(np.linalg.det(affine[:, :2])) < np.finfo(float).eps:
            return None
        middles[mine] = discs.centers_px[mine] - around.places_m[mine] @ affine[:, :2].T - pixels.origins_px[mine]
        shapes[:, mine] = np.multiply.outer(around.edges_m, plane_shapes(affine[None, :, :2])[0])[:, None]
    x = pixels.x_px - middles[:, :1].astype(np.float32)
    y = pixels.y_px - middles[:, 1:].astype(np.float32)
    beyond_rim = share_outside(shapes[1], x, y, width_px)
    in_opening = 1 - share_outside(shapes[0], x, y, width_px)
    shares: Array32 = np.stack([in_opening, beyond_rim], axis=1)
    return shares


def share_outside(shapes_px: Array, x_px: Array32, y_px: Array32, width_px: float) -> Array32:
    """(N, K) how much of the light at places (N, K) comes from outside ellipses (N, 2, 2) about the origin."""
    distance = edge_distances(shapes_px, x_px, y_px)
    return blurred_step(distance * np.float32(-np.sqrt(0.5) / width_px))[0]
