"""A lens's distortion of many points, forwards with its derivatives and backwards, as compiled loops."""

from __future__ import annotations

import numpy as np

from geometry.compiled_loops import compiled, inlined
from geometry.se3 import Array

_MAX_STEPS = 60
# 2e-10 px at a focal length of 2000 px.
_TOLERANCE = 1e-13
# Near enough for Newton's method to go on without care; closer to the solution rounding moves the error up and down.
_NEARLY = 1e-9
# Steps of the way from the axis to a solution, where the way is followed.
_FOLLOWED_STEPS = 64


@compiled
def distort_points(ideal: Array, coefficients: Array, tilt: Array) -> Array:
    """(N, 6) distorted x and y, and the entries xx, xy, yx, yy of the Jacobian, of (N, 2) ideal points.

    Args:
        ideal: in the image plane at unit distance.
        coefficients: (14,) in OpenCV's order; the last two, the angles of the tilt, are not read.
        tilt: (3, 3) homography from the plane across the axis to the sensor's.
    """
    found = np.empty((len(ideal), 6))
    for n in range(len(ideal)):
        found[n] = _distorted(ideal[n, 0], ideal[n, 1], coefficients, tilt)
    return found


@compiled
def undistort_points(wanted: Array, coefficients: Array, tilt: Array) -> tuple[Array, bool]:
    """(N, 2) ideal points of (N, 2) distorted ones by Newton's method with halved steps, and whether all were found.

    Args: see `distort_points`.
    """
    found = np.empty_like(wanted)
    for n in range(len(wanted)):
        x, y, is_found = _undistorted(wanted[n, 0], wanted[n, 1], coefficients, tilt)
        if not is_found:
            return found, False
        found[n, 0], found[n, 1] = x, y
    return found, True


@compiled
def _undistorted(wanted_x: float, wanted_y: float, coefficients: Array, tilt: Array) -> tuple[float, float, bool]:
    # Steps go from `last` along `step`: the first from the axis, where no lens folds, to the distorted point.
    last_x, last_y, step_x, step_y = 0.0, 0.0, wanted_x, wanted_y
    last_size = max(abs(wanted_x), abs(wanted_y))
    for _ in range(_MAX_STEPS):
        x, y = last_x + step_x, last_y + step_y
        seen_x, seen_y, j_xx, j_xy, j_yx, j_yy = _distorted(x, y, coefficients, tilt)
        error_x, error_y = wanted_x - seen_x, wanted_y - seen_y
        size = max(abs(error_x), abs(error_y))
        if size < _TOLERANCE:
            # A first step across two folds may have come to another branch of the polynomial.
            if x * wanted_x + y * wanted_y < 0.0 or _folds_on_the_way(x, y, coefficients, tilt):
                return _followed_from_axis(wanted_x, wanted_y, coefficients, tilt)
            return x, y, True
        determinant = j_xx * j_yy - j_xy * j_yx
        if determinant > 0.0 and (size < last_size or size < _NEARLY):
            last_x, last_y, last_size = x, y, size
            step_x = (j_yy * error_x - j_xy * error_y) / determinant
            step_y = (j_xx * error_y - j_yx * error_x) / determinant
        else:
            # A step across a fold, or one that leads away, is halved.
            step_x, step_y = step_x / 2.0, step_y / 2.0
    return 0.0, 0.0, False


@compiled
def _folds_on_the_way(x: float, y: float, coefficients: Array, tilt: Array) -> bool:
    """Whether a fold lies on quarters of the way from the axis to an ideal point."""
    for quarter in range(1, 4):
        share = 0.25 * quarter
        _, _, j_xx, j_xy, j_yx, j_yy = _distorted(share * x, share * y, coefficients, tilt)
        if not j_xx * j_yy - j_xy * j_yx > 0.0:
            return True
    return False


@compiled
def _followed_from_axis(
    wanted_x: float, wanted_y: float, coefficients: Array, tilt: Array
) -> tuple[float, float, bool]:
    """The ideal point followed from the axis in small steps, and whether the way met no fold."""
    x, y = 0.0, 0.0
    for step in range(1, _FOLLOWED_STEPS + 1):
        share = step / _FOLLOWED_STEPS
        for _ in range(_MAX_STEPS):
            seen_x, seen_y, j_xx, j_xy, j_yx, j_yy = _distorted(x, y, coefficients, tilt)
            error_x, error_y = share * wanted_x - seen_x, share * wanted_y - seen_y
            determinant = j_xx * j_yy - j_xy * j_yx
            if not determinant > 0.0:
                return x, y, False
            if max(abs(error_x), abs(error_y)) < _TOLERANCE:
                break
            x += (j_yy * error_x - j_xy * error_y) / determinant
            y += (j_xx * error_y - j_yx * error_x) / determinant
        else:
            return x, y, False
    return x, y, True


@inlined
def _distorted(x: float, y: float, coefficients: Array, tilt: Array) -> tuple[float, float, float, float, float, float]:
    """Distorted x and y of an ideal point, and the entries xx, xy, yx, yy of the Jacobian.

    Source: OpenCV's documentation of `calib3d`, "Detailed Description".
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = coefficients[:12]
    r2 = x * x + y * y
    denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    # Derivatives by the square of the distance from the axis.
    slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    slope = (slope - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / denominator
    prism_x, prism_y = s1 + 2.0 * s2 * r2, s3 + 2.0 * s4 * r2
    seen_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + s2 * r2)
    seen_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + s4 * r2)
    cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    j_xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x
    j_xy = cross + 2.0 * y * prism_x
    j_yx = cross + 2.0 * x * prism_y
    j_yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y
    w = tilt[2, 0] * seen_x + tilt[2, 1] * seen_y + tilt[2, 2]
    u = (tilt[0, 0] * seen_x + tilt[0, 1] * seen_y + tilt[0, 2]) / w
    v = (tilt[1, 0] * seen_x + tilt[1, 1] * seen_y + tilt[1, 2]) / w
    u_x, u_y = (tilt[0, 0] - u * tilt[2, 0]) / w, (tilt[0, 1] - u * tilt[2, 1]) / w
    v_x, v_y = (tilt[1, 0] - v * tilt[2, 0]) / w, (tilt[1, 1] - v * tilt[2, 1]) / w
    return u, v, u_x * j_xx + u_y * j_yx, u_x * j_xy + u_y * j_yy, v_x * j_xx + v_y * j_yx, v_x * j_xy + v_y * j_yy
