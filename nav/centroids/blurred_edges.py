"""Intensities of blurred elliptic edges and their derivatives, pixel by pixel, in compiled loops.

An edge at the inward distance D has the share `S = (1 + erf(D / (sqrt2 s))) / 2` of light from within, with
`D = (1 - q) / |grad q|` and `q = |L (x - c)|`, L the inverse shape. Each inner loop reads and writes few arrays and
calls nothing that cannot be vectorised: only then does the compiler process many pixels at once. All numbers are single
precision; a literal without `_F` would make them double.

Source of the error function: M. Abramowitz and I. Stegun, Handbook of Mathematical Functions, 7.1.26.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.ellipses import shape_inverses
from nav.numerics.compiled import Array32, compiled, float_of_bits
from nav.numerics.levenberg_marquardt import add_row, multiply_rows

# Indices into the parameter vectors. The ellipse comes first: centre x, y; elements xx, yy, xy of the inverse shape.
ELLIPSE_PARAMETER_COUNT = 5
DISC_WIDTH, DISC_BACKGROUND, DISC_LEVEL = (
    ELLIPSE_PARAMETER_COUNT,
    ELLIPSE_PARAMETER_COUNT + 1,
    ELLIPSE_PARAMETER_COUNT + 2,
)
# Parameters that every disc has; slopes of the light outside and inside and levels of other backgrounds may follow.
DISC_FIXED_COUNT = DISC_LEVEL + 1

ANNULUS_OUTER = slice(0, ELLIPSE_PARAMETER_COUNT)
ANNULUS_INNER = slice(ELLIPSE_PARAMETER_COUNT, 2 * ELLIPSE_PARAMETER_COUNT)
ANNULUS_CENTERS = np.array([0, 1, ELLIPSE_PARAMETER_COUNT, ELLIPSE_PARAMETER_COUNT + 1])
ANNULUS_WIDTH, ANNULUS_BACKGROUND, ANNULUS_HOLE = (2 * ELLIPSE_PARAMETER_COUNT + i for i in range(3))
# Light beyond the annulus's surroundings: a constant and the first two orders of the azimuth.
ANNULUS_SURROUND, ANNULUS_SURROUND_COUNT = ANNULUS_HOLE + 1, 5
# Light on the annulus by the azimuth, the constant first.
ANNULUS_AMPLITUDE = ANNULUS_SURROUND + ANNULUS_SURROUND_COUNT

_F = np.float32
_ONE, _HALF = _F(1), _F(0.5)
# Keeps the distance finite in the middle of the ellipse, where it has no gradient.
_TINY = _F(1e-12)
# Of Abramowitz and Stegun's rational form of the error function (7.1.26), the coefficients halved.
_ERF_P = _F(0.3275911)
_ERF_HALVES = tuple(_F(a / 2) for a in (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429))
_ERF_1, _ERF_2, _ERF_3, _ERF_4, _ERF_5 = _ERF_HALVES
# Largest z^2: beyond it S is 0 or 1 in single precision, and exp(-z^2) adds nothing to any sum. Without the limit it
# and its products become denormal numbers further out, which take a processor a hundred times as long.
_FAR = _F(36)
# exp(r) for |r| <= ln(2) / 2 is its Taylor polynomial of sixth order to 1.2e-7; ln(2) in two parts, of which
# multiples of the first are exact.
_LOG2_E, _LN_2_HIGH, _LN_2_LOW = _F(1 / np.log(2)), _F(0.693359375), _F(np.log(2) - 0.693359375)
_TAYLOR_2, _TAYLOR_3, _TAYLOR_4, _TAYLOR_5, _TAYLOR_6 = (_F(1 / f) for f in (2, 6, 24, 120, 720))
_EXPONENT_BIAS, _FRACTION_BITS = np.int32(127), np.int32(23)
_SQRT_HALF, _BELL_PEAK = np.sqrt(0.5), 1 / np.sqrt(2 * np.pi)


@compiled
def _exp_minus(exponent: np.float32) -> np.float32:
    """exp(-t) for t from 0 to 87."""
    power = np.int32(exponent * _LOG2_E + _HALF)
    r = _F(power) * _LN_2_HIGH - exponent
    r += _F(power) * _LN_2_LOW
    tail = _TAYLOR_3 + r * (_TAYLOR_4 + r * (_TAYLOR_5 + r * _TAYLOR_6))
    value = _ONE + (r + r * r * (_TAYLOR_2 + r * tail))
    scaled: np.float32 = value * float_of_bits((_EXPONENT_BIAS - power) << _FRACTION_BITS)
    return scaled


@compiled
def blurred_steps(z: Array32, scale: np.float32, step: Array32, bell: Array32) -> None:
    """Fill `(1 + erf(s z)) / 2` and `exp(-(s z)^2)` for numbers in a row."""
    for k in range(len(z)):
        at = z[k] * scale
        square = at * at
        near = square < _FAR
        own_bell = _exp_minus(square if near else _FAR)
        own_bell = own_bell if near else _F(0)
        t = _ONE / (abs(at) * _ERF_P + _ONE)
        tail = t * (_ERF_1 + t * (_ERF_2 + t * (_ERF_3 + t * (_ERF_4 + t * _ERF_5)))) * own_bell
        half = _HALF - tail
        step[k] = _HALF + (half if at > _F(0) else -half)
        bell[k] = own_bell


@compiled
def _place(
    x: Array32,
    y: Array32,
    ellipse: tuple[np.float32, np.float32, np.float32, np.float32, np.float32],
    distance: Array32,
    by_q: Array32,
    by_gradient: Array32,
) -> None:
    """Fill the inward distances of a row, and the terms that their derivatives need."""
    cx, cy, a, c, b = ellipse
    tiny = _TINY * (a * a + c * c)
    for k in range(len(x)):
        dx, dy = x[k] - cx, y[k] - cy
        w0, w1 = a * dx + b * dy, b * dx + c * dy
        q = np.sqrt(w0 * w0 + w1 * w1 + _TINY)
        m0, m1 = a * w0 + b * w1, b * w0 + c * w1
        # |grad q| = |m| / q with m = L L (x - c); its derivative needs p = L m.
        inverse = _ONE / np.sqrt(m0 * m0 + m1 * m1 + tiny)
        rest = _ONE - q
        inwards = q * rest * inverse
        distance[k] = inwards
        by_q[k] = (rest - q) * inverse / q
        by_gradient[k] = inwards * inverse * inverse


@compiled
def _slopes_by_center(
    x: Array32,
    y: Array32,
    ellipse: tuple[np.float32, np.float32, np.float32, np.float32, np.float32],
    by_q: Array32,
    by_gradient: Array32,
    steepness: Array32,
    slopes: Array32,
) -> None:
    cx, cy, a, c, b = ellipse
    by_x, by_y = slopes[0], slopes[1]
    for k in range(len(x)):
        dx, dy = x[k] - cx, y[k] - cy
        w0, w1 = a * dx + b * dy, b * dx + c * dy
        h0, h1 = by_gradient[k] * (a * w0 + b * w1), by_gradient[k] * (b * w0 + c * w1)
        g0 = by_q[k] * w0 - (a * h0 + b * h1)
        g1 = by_q[k] * w1 - (b * h0 + c * h1)
        by_x[k] = -steepness[k] * (a * g0 + b * g1)
        by_y[k] = -steepness[k] * (b * g0 + c * g1)


# Repeats the terms above: with five rows to fill in one loop the compiler would not vectorise it.
@compiled
def _slopes_by_shape(
    x: Array32,
    y: Array32,
    ellipse: tuple[np.float32, np.float32, np.float32, np.float32, np.float32],
    by_q: Array32,
    by_gradient: Array32,
    steepness: Array32,
    slopes: Array32,
) -> None:
    cx, cy, a, c, b = ellipse
    by_xx, by_yy, by_xy = slopes[2], slopes[3], slopes[4]
    for k in range(len(x)):
        dx, dy = x[k] - cx, y[k] - cy
        w0, w1 = a * dx + b * dy, b * dx + c * dy
        h0, h1 = by_gradient[k] * (a * w0 + b * w1), by_gradient[k] * (b * w0 + c * w1)
        g0 = by_q[k] * w0 - (a * h0 + b * h1)
        g1 = by_q[k] * w1 - (b * h0 + c * h1)
        by_xx[k] = steepness[k] * (g0 * dx - h0 * w0)
        by_yy[k] = steepness[k] * (g1 * dy - h1 * w1)
        by_xy[k] = steepness[k] * (g0 * dy + g1 * dx - h0 * w1 - h1 * w0)


@compiled
def _shade(x: Array32, y: Array32, slope: Array32, share: Array32, light: Array32, rows: Array32) -> None:
    """Add a plane's slope of light to a row, and fill the derivatives by the slope."""
    by_x, by_y = slope[0], slope[1]
    for k in range(len(x)):
        light[k] += by_x * x[k] + by_y * y[k]
    multiply_rows(x, share, _ONE, rows[0])
    multiply_rows(y, share, _ONE, rows[1])


@compiled
def _mix(dark: Array32, bright: Array32, inside: Array32, bell: Array32, peak: np.float32, picture: Array32) -> None:
    """The picture of a row; the bell becomes the picture's slope by the distance."""
    for k in range(len(dark)):
        contrast = bright[k] - dark[k]
        picture[k] = dark[k] + contrast * inside[k]
        bell[k] *= contrast * peak


@compiled
def draw_discs(
    parameters: Array32,
    widths: Array32,
    slopes: tuple[bool, bool],
    x: Array32,
    y: Array32,
    further: Array32,
    picture: Array32,
    jacobian: Array32,
) -> None:
    """Fill intensities and derivatives of N discs; see `nav.centroids.discs.disc_model`.

    Args:
        parameters: (N, P), the `DISC_` indices; then slopes where the light has any, and levels of other backgrounds.
        widths: (N,) of the edges, see `edge_widths`.
        slopes: whether the light outside has a slope, and whether the light inside has one.
        x, y: (N, K).
        further: (N, E, K) shares of other backgrounds.
        picture: (N, K).
        jacobian: (N, P, K).
    """
    by_q, by_gradient, bell = np.empty_like(x[0]), np.empty_like(x[0]), np.empty_like(x[0])
    distance, dark, bright = np.empty_like(x[0]), np.empty_like(x[0]), np.empty_like(x[0])
    for n in range(len(x)):
        own, rows, xs, ys, width = parameters[n], jacobian[n], x[n], y[n], widths[n]
        ellipse = (own[0], own[1], own[2], own[3], own[4])
        outside, inside, at = rows[DISC_BACKGROUND], rows[DISC_LEVEL], DISC_FIXED_COUNT
        _place(xs, ys, ellipse, distance, by_q, by_gradient)
        blurred_steps(distance, _F(_SQRT_HALF) / width, inside, bell)
        for k in range(len(xs)):
            outside[k] = _ONE - inside[k]
        dark[:], bright[:] = own[DISC_BACKGROUND], own[DISC_LEVEL]
        if slopes[0]:
            _shade(xs, ys, own[at : at + 2], outside, dark, rows[at : at + 2])
            at += 2
        if slopes[1]:
            _shade(xs, ys, own[at : at + 2], inside, bright, rows[at : at + 2])
            at += 2
        _mix(dark, bright, inside, bell, _F(_BELL_PEAK) / width, picture[n])
        _slopes_by_center(xs, ys, ellipse, by_q, by_gradient, bell, rows)
        _slopes_by_shape(xs, ys, ellipse, by_q, by_gradient, bell, rows)
        multiply_rows(bell, distance, -_ONE / width, rows[DISC_WIDTH])
        for other in range(further.shape[1]):
            rows[at + other] = further[n, other]
            add_row(further[n, other], own[at + other], picture[n])


@compiled
def draw_annuli(
    parameters: Array32,
    widths: Array32,
    x: Array32,
    y: Array32,
    turns: Array32,
    beyond: Array32,
    picture: Array32,
    jacobian: Array32,
) -> None:
    """Fill intensities and derivatives of N annuli; see `nav.centroids.annuli.annulus_model`.

    Args:
        parameters: (N, P), the `ANNULUS_` indices.
        widths: (N,) of the edges, see `edge_widths`.
        x, y: (N, K).
        turns: (N, T, K) functions of the azimuth.
        beyond: (N, K).
        picture: (N, K).
        jacobian: (N, P, K).
    """
    by_q, by_gradient, light = np.empty_like(x[0]), np.empty_like(x[0]), np.empty_like(x[0])
    to_outer, to_inner, up, down = (np.empty_like(x[0]), np.empty_like(x[0]), np.empty_like(x[0]), np.empty_like(x[0]))
    for n in range(len(x)):
        own, rows, xs, ys, width = parameters[n], jacobian[n], x[n], y[n], widths[n]
        outside, in_hole = rows[ANNULUS_BACKGROUND], rows[ANNULUS_HOLE]
        between = rows[ANNULUS_AMPLITUDE]
        background, hole = own[ANNULUS_BACKGROUND], own[ANNULUS_HOLE]
        outer, inner = (own[0], own[1], own[2], own[3], own[4]), (own[5], own[6], own[7], own[8], own[9])
        light[:] = _F(0)
        for turn in range(turns.shape[1]):
            add_row(turns[n, turn], own[ANNULUS_AMPLITUDE + turn], light)
        # The derivatives need the terms of `_place`, so one edge follows the other; `between` holds the outer edge's
        # share until the inner edge's is known.
        _place(xs, ys, outer, to_outer, by_q, by_gradient)
        blurred_steps(to_outer, _F(_SQRT_HALF) / width, between, up)
        peak = _F(_BELL_PEAK) / width
        for k in range(len(xs)):
            up[k] *= peak * (light[k] - background)
        _slopes_by_center(xs, ys, outer, by_q, by_gradient, up, rows)
        _slopes_by_shape(xs, ys, outer, by_q, by_gradient, up, rows)
        _place(xs, ys, inner, to_inner, by_q, by_gradient)
        blurred_steps(to_inner, _F(_SQRT_HALF) / width, in_hole, down)
        for k in range(len(xs)):
            down[k] *= peak * (hole - light[k])
        _slopes_by_center(xs, ys, inner, by_q, by_gradient, down, rows[ELLIPSE_PARAMETER_COUNT:])
        _slopes_by_shape(xs, ys, inner, by_q, by_gradient, down, rows[ELLIPSE_PARAMETER_COUNT:])
        by_width = rows[ANNULUS_WIDTH]
        for k in range(len(xs)):
            by_width[k] = -(up[k] * to_outer[k] + down[k] * to_inner[k]) / width
        for k in range(len(xs)):
            outside[k] = _ONE - between[k]
            between[k] -= in_hole[k]
        for k in range(len(xs)):
            picture[n, k] = background * outside[k] + light[k] * between[k] + hole * in_hole[k]
        for turn in range(ANNULUS_SURROUND_COUNT):
            place = ANNULUS_SURROUND + turn
            multiply_rows(turns[n, turn], beyond[n], _ONE, rows[place])
            add_row(rows[place], own[place], picture[n])
        # The first function is one, so its row is `between` itself, from which the others follow.
        for turn in range(1, turns.shape[1]):
            multiply_rows(turns[n, turn], between, _ONE, rows[ANNULUS_AMPLITUDE + turn])


# Sides of the pixel and its neighbours, from its middle. [px]
_SIDE_0, _SIDE_1, _SIDE_2, _SIDE_3 = _F(-1.5), _F(-0.5), _F(0.5), _F(1.5)
# Least sine of the angle between edge and image axis: the closed form divides by it.
_LEAST_SINE = _F(0.05)
# A pixel sees the edge where its share of light from within lies between these.
_SEEN_LOW, _SEEN_HIGH = _F(1e-3), _F(1 - 1e-3)


@compiled
def _half_square(inwards: np.float32) -> np.float32:
    positive = max(inwards, _F(0))
    return positive * positive


@compiled
def _boxes_along(inwards: np.float32, down: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """First differences between the upper and lower sides of three boxes above each other."""
    s0, s1 = _half_square(inwards + _SIDE_0 * down), _half_square(inwards + _SIDE_1 * down)
    s2, s3 = _half_square(inwards + _SIDE_2 * down), _half_square(inwards + _SIDE_3 * down)
    return s1 - s0, s2 - s1, s3 - s2


@compiled
def _add_box_row(
    x: Array32,
    y: Array32,
    ellipse: tuple[np.float32, np.float32, np.float32, np.float32, np.float32],
    present: Array32,
    inside: Array32,
    steps: Array32,
    pictures: Array32,
) -> None:
    cx, cy, a, c, b = ellipse
    own, beside, corners = pictures[0], pictures[1], pictures[2]
    for k in range(len(x)):
        dx, dy = x[k] - cx, y[k] - cy
        w0, w1 = a * dx + b * dy, b * dx + c * dy
        q = np.sqrt(w0 * w0 + w1 * w1 + _TINY)
        m0, m1 = a * w0 + b * w1, b * w0 + c * w1
        slope = np.sqrt(m0 * m0 + m1 * m1) + _TINY
        across, down = max(abs(m0) / slope, _LEAST_SINE), max(abs(m1) / slope, _LEAST_SINE)
        inwards = (_ONE - q) * q / slope
        l0, l1, l2 = _boxes_along(inwards + _SIDE_0 * across, down)
        m_0, m_1, m_2 = _boxes_along(inwards + _SIDE_1 * across, down)
        n0, n1, n2 = _boxes_along(inwards + _SIDE_2 * across, down)
        r0, r1, r2 = _boxes_along(inwards + _SIDE_3 * across, down)
        area = _HALF / (across * down)
        seen = (inside[k] > _SEEN_LOW) & (inside[k] < _SEEN_HIGH) & (present[k] > _F(0))
        step = steps[k]
        middle = (n1 - m_1) * area - inside[k]
        sides = ((m_1 - l1) + (r1 - n1) + (n0 - m_0) + (n2 - m_2)) * (area / _F(4)) - inside[k]
        ends = ((m_0 - l0) + (r0 - n0) + (m_2 - l2) + (r2 - n2)) * (area / _F(4)) - inside[k]
        own[k] += step * middle if seen else _F(0)
        beside[k] += step * sides if seen else _F(0)
        corners[k] += step * ends if seen else _F(0)


@compiled
def add_box_responses(
    ellipses: Array32,
    x: Array32,
    y: Array32,
    present: Array32,
    inside: Array32,
    steps: Array32,
    pictures: Array32,
) -> None:
    """Add (N, 3, K) differences of box responses from a Gaussian edge, see `nav.centroids.pixel_response`."""
    for n in range(len(x)):
        e = ellipses[n]
        _add_box_row(x[n], y[n], (e[0], e[1], e[2], e[3], e[4]), present[n], inside[n], steps[n], pictures[n])


# Initial width of the fit: the pixel's box (1/12 px^2) and a Gaussian blur of lens and sensor of 0.5 px. [px]
START_WIDTH_PX = float(np.sqrt(0.25 + 1 / 12))
# A narrower edge lies within one pixel, and its width has no effect. [px]
_SMALLEST_WIDTH_PX = 0.2


def edge_widths(width_px: Array) -> Array32:
    """(N,) widths that the model uses; a width far below a pixel has no effect and is raised to a limit. [px]"""
    return np.maximum(width_px, _SMALLEST_WIDTH_PX).astype(np.float32)


def blurred_step(z: Array32) -> tuple[Array32, Array32]:
    """`(1 + erf(z)) / 2` to 2.5e-7, rounding of single precision included, and `exp(-z^2)`, zero below 2.4e-16.

    The step is symmetric.

    Source: M. Abramowitz and I. Stegun, Handbook of Mathematical Functions, 7.1.26.
    """
    z = np.ascontiguousarray(z)
    step, bell = np.empty_like(z), np.empty_like(z)
    blurred_steps(z.ravel(), np.float32(1), step.ravel(), bell.ravel())
    return step, bell


def ellipse_parameters(offsets_px: Array, shapes_px: Array) -> Array:
    """(N, 5) parameters of ellipses with centres (N, 2) and shapes (N, 2, 2)."""
    inverse = shape_inverses(shapes_px)
    return np.column_stack([offsets_px, inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 0, 1]])


def parameter_shapes(ellipse: Array) -> Array:
    """(N, 2, 2) shapes of ellipses with parameters (N, 5)."""
    return shape_inverses(np.stack([ellipse[:, [2, 4]], ellipse[:, [4, 3]]], axis=1))
