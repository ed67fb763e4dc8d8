"""Weighted means over neighbours on the same surface, by their places and normals in space, whichever eye sees them.

Struts, ribbons and folds are a few pixels wide in an image, so that few neighbours there show the same surface. In
space the centres of both eyes lie among each other. Each spreads its value over the corners of the simplex that holds
its place and normal, in a lattice of six dimensions, and takes its mean from them: a piecewise linear kernel at a cost
that depends neither on its width nor on the scale of the image.

Source: the splatting and slicing of A. Adams, J. Baek and M. A. Davis, Fast high-dimensional filtering using the
permutohedral lattice, Computer Graphics Forum 29 (2010), 753, doi:10.1111/j.1467-8659.2009.01645.x, here in the
simplices of a cubic lattice, without its blur.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from geometry.se3 import Array

# Step of the lattice along the normals' axes: neighbours count up to about 25 degrees.
_NORMAL_STEP = 0.4
# The kernel is longest along the lattice's diagonal. Turned, that is along no axis of a drogue or of its parts.
_TURN = Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix()


class SurfaceCells:
    """Means over neighbours of points on surfaces."""

    def __init__(
        self,
        part: NDArray[np.uint32],
        point: NDArray[np.float32],
        normal: NDArray[np.float32],
        step_m: NDArray[np.float32],
    ) -> None:
        """Find the neighbours.

        Args:
            part: (P,) part ids; points of different parts are no neighbours.
            point: (P, 3) [m]
            normal: (P, 3) of length 1.
            step_m: (P,) of the lattice, equal for all points of a part: some twice the kernel's standard deviation. [m]
        """
        place = np.concatenate([point @ _TURN / step_m[:, None], normal @ _TURN.T / _NORMAL_STEP], axis=1)
        place -= place.min(axis=0)
        cell = place.astype(np.int64)
        order = np.argsort(cell - place, axis=1)
        # Corners are passed in the order of the largest fractions; a corner's weight is what they fall by.
        sorted_fractions = np.take_along_axis(place - cell, order, axis=1)
        weights = -np.diff(sorted_fractions, axis=1, prepend=1.0, append=0.0)
        size = cell.max(axis=0) + 2
        stride = np.cumprod([1, *size[:-1]])
        first = cell @ stride + part.astype(np.int64) * np.prod(size)
        corners = np.cumsum(np.column_stack([first, stride[order]]), axis=1)
        found, column = np.unique(corners.ravel(), return_inverse=True)
        rows = np.arange(0, weights.size + 1, weights.shape[1])
        self._spread = csr_matrix((weights.ravel(), column, rows), shape=(len(place), len(found)))

    def means(self, values: NDArray[np.float32], weights: NDArray[np.int64]) -> Array:
        """(P, C) means over neighbours of (P, C) values with (P,) weights of more than 0."""
        totals = self._spread.T @ np.column_stack([values * weights[:, None], weights])
        result = self._spread @ totals
        means: Array = result[:, :-1] / result[:, -1:]
        return means
