"""Ellipses in a pair of images, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Outlines of discs, or of one edge of annuli, in both images.

    Attributes:
        eyes: (M,) 0 for the left image, 1 for the right.
        centers_px: (M, 2) centres.
        shapes_px: (M, 2, 2) symmetric and positive: the outline is `center + shape @ (cos a, sin a)`.
    """

    eyes: NDArray[np.int64]
    centers_px: Array
    shapes_px: Array

    def __post_init__(self) -> None:
        count = len(self.eyes)
        if self.centers_px.shape != (count, 2) or not np.isfinite(self.centers_px).all():
            raise ValueError(f"centers_px: must be ({count}, 2) finite numbers, got {self.centers_px.shape}")
        if self.shapes_px.shape != (count, 2, 2) or not np.isfinite(self.shapes_px).all():
            raise ValueError(f"shapes_px: must be ({count}, 2, 2) finite numbers, got {self.shapes_px.shape}")
        if not are_positive(self.shapes_px).all():
            raise ValueError("shapes_px: must be positive, got a semi-axis of zero or less")

    def __len__(self) -> int:
        return len(self.eyes)

    @cached_property
    def radii_px(self) -> Array:
        """(M,) radii of the circles of the same area. [px]"""
        return shape_radii(self.shapes_px)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Ellipses:
        """Some of them."""
        return Ellipses(self.eyes[index], self.centers_px[index], self.shapes_px[index])


def are_positive(shapes_px: Array) -> NDArray[np.bool_]:
    """(M,) whether symmetric matrices (M, 2, 2) have two semi-axes above zero."""
    positive: NDArray[np.bool_] = (_determinants(shapes_px) > 0) & (shapes_px[:, 0, 0] + shapes_px[:, 1, 1] > 0)
    return positive


def circles(eyes: ArrayLike, centers_px: ArrayLike, radii_px: ArrayLike) -> Ellipses:
    """Circles of (M,) radii about (M, 2) centres, as from regions of known area."""
    shapes = np.asarray(radii_px, dtype=np.float64)[:, None, None] * np.eye(2)
    return Ellipses(np.asarray(eyes, dtype=np.int64), np.asarray(centers_px, dtype=np.float64), shapes)


def outline_shapes(offsets: Array) -> Array:
    """Shapes of ellipses from their outlines.

    Args:
        offsets: (M, K, 2) points of an affine image of a circle, evenly spaced on that circle, minus their mean. [px]

    Returns:
        (M, 2, 2). The second moment of such points is half the squared shape. [px]
    """
    return _square_roots(2 * np.einsum("mki,mkj->mij", offsets, offsets) / offsets.shape[1])


def moment_shapes(second_moments_px2: Array) -> Array:
    """Shapes of evenly filled ellipses from their (M, 2, 2) second moments: four times the moment is the square."""
    return _square_roots(4 * second_moments_px2)


def plane_shapes(maps: Array) -> Array:
    """Shapes of the images of the unit circle under (M, 2, 2) linear maps."""
    return _square_roots(maps @ np.swapaxes(maps, 1, 2))


def shape_radii(shapes_px: Array) -> Array:
    """(M,) radii of the circles of the same area as ellipses of (M, 2, 2) shapes. [px]"""
    radii: Array = np.sqrt(np.abs(_determinants(shapes_px)))
    return radii


def shape_inverses(shapes_px: Array) -> Array:
    """Inverses of (M, 2, 2) symmetric matrices, in closed form: LAPACK takes ten times as long for so small ones."""
    adjugates = np.empty_like(shapes_px)
    adjugates[:, 0, 0], adjugates[:, 1, 1] = shapes_px[:, 1, 1], shapes_px[:, 0, 0]
    adjugates[:, 0, 1] = adjugates[:, 1, 0] = -shapes_px[:, 0, 1]
    inverses: Array = adjugates / _determinants(shapes_px)[:, None, None]
    return inverses


def _determinants(matrices: Array) -> Array:
    determinants: Array = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]
    return determinants


def _square_roots(squares: Array) -> Array:
    """Square roots of (M, 2, 2) symmetric matrices without negative eigenvalues, in closed form."""
    root_of_determinant = np.sqrt(np.maximum(_determinants(squares), 0))[:, None, None]
    trace = (squares[:, 0, 0] + squares[:, 1, 1])[:, None, None]
    scale = np.sqrt(np.maximum(trace + 2 * root_of_determinant, np.finfo(np.float64).tiny))
    roots: Array = (squares + root_of_determinant * np.eye(2)) / scale
    return roots
