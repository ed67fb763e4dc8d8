"""The pose of a circle from its image ellipse, in closed form, and ellipses through points."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array


def conic_through(points: Array) -> Array | None:
    """(3, 3) symmetric matrix of the conic with the smallest algebraic distances to (K, 2) points, K >= 5.

    Returns:
        The conic with eigenvalues of signs + + -, or None where it is no ellipse.
    """
    mean = points.mean(axis=0)
    size = np.sqrt(((points - mean) ** 2).mean())
    if not size > 0:
        return None
    # Centred and scaled points keep the six columns of one size.
    x, y = ((points - mean) / size).T
    design = np.column_stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones_like(x)])
    a, b, c, d, e, f = np.linalg.svd(design)[2][5]
    to_unit = np.array([[1 / size, 0, -mean[0] / size], [0, 1 / size, -mean[1] / size], [0, 0, 1]])
    conic = to_unit.T @ np.array([[a, b, d], [b, c, e], [d, e, f]]) @ to_unit
    if a * c - b * b <= 0:
        return None
    values = np.linalg.eigvalsh(conic)
    if values[1] < 0:
        conic, values = -conic, -values[::-1]
    return conic if values[0] < 0 < values[1] else None


def circle_poses(conic: Array, radius_m: float) -> tuple[Array, Array]:
    """Both circles of a known radius whose image is an ellipse.

    Args:
        conic: (3, 3) in normalised image coordinates (rays with z = 1), with eigenvalues of signs + + -.
        radius_m: of the circle. [m]

    Returns:
        (2, 3) centres in front of the camera [m], (2, 3) unit normals with positive z.

    Source: eigenvalues l1 >= l2 > 0 > l3 with eigenvectors V; `a^2 = (l1 - l2) / (l1 - l3)`,
    `b^2 = (l2 - l3) / (l1 - l3)`; centre `z0 V (s a l3 / l2, 0, -b l1 / l2)`, normal `V (s a, 0, -b)`, s = +-1,
    `z0 = l2 r / sqrt(-l1 l3)`.
    """
    values, vectors = np.linalg.eigh(conic)
    (l3, l2, l1), v = values, vectors[:, ::-1]
    a, b = np.sqrt((l1 - l2) / (l1 - l3)), np.sqrt((l2 - l3) / (l1 - l3))
    z0 = l2 * radius_m / np.sqrt(-l1 * l3)
    sides = np.array([1.0, -1.0])
    zero = np.zeros(2)
    centers = z0 * np.stack([sides * a * l3 / l2, zero, np.full(2, -b * l1 / l2)], axis=-1) @ v.T
    normals = np.stack([sides * a, zero, np.full(2, -b)], axis=-1) @ v.T
    centers = np.where(centers[:, 2:] < 0, -centers, centers)
    return centers, np.where(normals[:, 2:] < 0, -normals, normals)
