"""Motion blur of outlines: the motion during the exposure, and the model of moving outlines.

The intensity of a moving outline is the mean over the positions along its path. The path is straight and the speed
constant within an exposure, so the measured position is that at mid-exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.centroids.blurred_edges import DISC_WIDTH, ELLIPSE_PARAMETER_COUNT, blurred_step, edge_widths
from nav.centroids.ellipses import Ellipses
from nav.centroids.outline_pixels import OutlinePixels, edge_distances
from nav.centroids.pixel_response import reduced_equations, solve_shared
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, NormalEquations, add_rows

# The fit of a still edge follows shorter motions, and noise hides them. [px]
_LEAST_TRAVEL_PX = 1.0
_LEAST_SIGMA = 5.0
# Largest step along the path: at this step Gaussian edges of a pixel's box and a lens still sum to an even blur. [px]
_STEP_PX = 1.0
# Longest motion for which the margin around outlines is enough (`nav.centroids.marker_signal`). [px]
_MOST_TRAVEL_PX = 30.0
# Variance of a uniform distribution of unit length.
_BOX_VARIANCE = 1 / 12
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class ImageMotion:
    """Motion of outlines on the images while the shutter is open; its sign is not determined.

    The outlines of an eye move together, and may rotate and grow about their middle.

    Attributes:
        middles_px: (2, 2) middles of the eyes' outlines. [px]
        means_px: (2, 2) displacements of the middles. [px]
        turns: (2, 2) growth and rotation over the exposure. [1, rad]
    """

    middles_px: Array
    means_px: Array
    turns: Array

    def of(self, outlines: Ellipses) -> Array:
        """(N, 3) motions of outlines: displacements along x and y [px], and relative growth."""
        x, y = (outlines.centers_px - self.middles_px[outlines.eyes]).T
        growth, turn = self.turns[outlines.eyes].T
        along_x, along_y = self.means_px[outlines.eyes].T
        motions: Array = np.stack([along_x + growth * x - turn * y, along_y + turn * x + growth * y, growth], axis=1)
        return motions

    def spread_px(self, outlines: Ellipses) -> float:
        """Largest distance by which the motion spreads an edge to either side. [px]"""
        return float(np.hypot(*self.of(outlines)[:, :2].T).max(initial=0.0)) / 2


def motion_steps(motions: Array) -> tuple[Array, Array]:
    """(T, N, 3) steps of motions (N, 3) from mid-exposure, and (T,) their shares of the motion."""
    longest_px = float(np.hypot(*motions[:, :2].T).max(initial=0.0))
    count = max(1, int(np.ceil(longest_px / _STEP_PX)))
    shares = (np.arange(count) + 0.5) / count - 0.5
    return np.multiply.outer(shares, motions), shares


def share_outside(shapes_px: Array, x_px: Array32, y_px: Array32, width_px: float) -> Array32:
    """(N, K) share of the light at (N, K) that comes from outside ellipses (N, 2, 2) about the origin."""
    distance = edge_distances(shapes_px, x_px, y_px)
    return blurred_step(distance * np.float32(-np.sqrt(0.5) / width_px))[0]


def blurred_share_outside(
    shapes_px: Array, x_px: Array32, y_px: Array32, width_px: float, motions: Array | None
) -> Array32:
    """As `share_outside`, of ellipses that move by (N, 3), or stand still where that is None."""
    if motions is None:
        return share_outside(shapes_px, x_px, y_px, width_px)
    steps = motion_steps(motions)[0].astype(np.float32)[..., None]
    total = np.zeros_like(x_px)
    for along_x, along_y, growth in steps.transpose(0, 2, 1, 3):
        scale = 1 - growth
        total += share_outside(shapes_px, scale * (x_px - along_x), scale * (y_px - along_y), width_px)
    return total / np.float32(len(steps))


def motion_blurred(model: Model, motions: Array, ellipses: tuple[int, ...]) -> Model:
    """The model of moving outlines, from one of still outlines.

    Args:
        model: of still outlines.
        motions: (N, 3) motions.
        ellipses: indices at which the parameters of each outline's ellipses begin.
    """
    steps = motion_steps(motions)[0]

    def moved(parameters: Array) -> tuple[Array32, Array32]:
        total, slopes = model(_moved_by(parameters, steps[0], ellipses))
        for step in steps[1:]:
            picture, jacobian = model(_moved_by(parameters, step, ellipses))
            total += picture
            slopes += jacobian
        scale = np.float32(1 / len(steps))
        return total * scale, slopes * scale

    return moved


def _moved_by(parameters: Array, step: Array, ellipses: tuple[int, ...]) -> Array:
    """Parameters (N, P) of outlines after a step (N, 3)."""
    there = parameters.copy()
    for first in ellipses:
        there[:, first : first + 2] += step[:, :2]
        # Elements of the inverse shape.
        there[:, first + 2 : first + ELLIPSE_PARAMETER_COUNT] *= 1 - step[:, 2:]
    return there


def detect_motion(fit: Minimum, pixels: OutlinePixels, discs: Ellipses) -> ImageMotion | None:
    """Estimate the motion from the residuals of a fit of still outlines; None where the outlines stood still.

    Motion blurs an edge along its direction and not across it, so the residuals vary with twice the azimuth. To first
    order they give length and direction of the motion, of long motions three quarters of the length.

    Args:
        fit: of the discs.
        pixels: of them.
        discs: where they are, roughly.
    """
    x, y = pixels.x_px - fit.parameters[:, :1], pixels.y_px - fit.parameters[:, 1:2]
    x, y = x.astype(np.float32), y.astype(np.float32)
    # Cosine and sine of twice the azimuth, without the angle itself.
    square = x * x + y * y + np.finfo(np.float32).tiny
    by_variance = fit.jacobian[:, DISC_WIDTH] / (2 * edge_widths(fit.parameters[:, DISC_WIDTH])[:, None] * square)
    shapes = np.stack([by_variance * (x * x - y * y), by_variance * (2 * x * y)], axis=1)
    normal, gradient = reduced_equations(fit, shapes, pixels.present)
    freedom = np.maximum(pixels.present.sum() - fit.parameters.size, 1)
    noise_dn2 = float((fit.residuals**2 * pixels.present).sum() / freedom)
    all_normal = normal.sum(axis=0)
    across, along = solve_shared(all_normal, gradient.sum(axis=0))
    variance, direction = np.hypot(across, along), np.arctan2(along, across) / 2
    length_px = np.sqrt(variance / _BOX_VARIANCE)
    sigma = np.sqrt(noise_dn2 / np.maximum(np.diag(all_normal).min(), np.finfo(np.float32).tiny))
    if not (_LEAST_TRAVEL_PX < length_px < _MOST_TRAVEL_PX and variance > _LEAST_SIGMA * sigma):
        return None
    middles = np.zeros((2, 2))
    for eye in np.unique(discs.eyes):
        middles[eye] = discs.centers_px[discs.eyes == eye].mean(axis=0)
    # Both eyes see the same motion, but for the change of distance.
    way = length_px * np.array([np.cos(direction), np.sin(direction)])
    return ImageMotion(middles, np.tile(way, (2, 1)), np.zeros((2, 2)))


def fit_motion(
    model: Model, pixels: OutlinePixels, start: Array, motion: ImageMotion, discs: Ellipses
) -> ImageMotion | None:
    """Refine the motion and the discs together by Gauss-Newton steps; None where the steps diverge.

    Args:
        model: of still discs.
        pixels: of them.
        start: (N, P) parameters.
        motion: roughly.
        discs: where they are, roughly.
    """
    arms_px = discs.centers_px - motion.middles_px[discs.eyes]
    size_px = max(float(np.abs(arms_px).max()), 1.0)
    x, y = (arms_px / size_px).astype(np.float32).T[:, :, None]
    parameters = start
    for _ in range(_ROUNDS):
        fit, by_motion = _evaluate_moving(model, pixels, parameters, motion.of(discs))
        by_x, by_y = by_motion[:, 0], by_motion[:, 1]
        shared = np.stack([by_x, by_y, x * by_x + y * by_y, x * by_y - y * by_x], axis=1)
        normal, gradient = reduced_equations(fit, shared, pixels.present)
        steps = np.zeros((2, 4))
        for eye in np.unique(discs.eyes):
            mine = discs.eyes == eye
            steps[eye] = solve_shared(normal[mine].sum(axis=0), gradient[mine].sum(axis=0))
        left = fit.residuals.copy()
        add_rows(np.ascontiguousarray(shared), (-steps[discs.eyes]).astype(np.float32), left)
        parameters = fit.after_linear_step(left, pixels.present).parameters
        motion = ImageMotion(motion.middles_px, motion.means_px + steps[:, :2], motion.turns + steps[:, 2:] / size_px)
        # NaN counts as diverged.
        if not np.hypot(*motion.of(discs)[:, :2].T).max() < _MOST_TRAVEL_PX:
            return None
    return motion


def _evaluate_moving(model: Model, pixels: OutlinePixels, parameters: Array, motions: Array) -> tuple[Minimum, Array32]:
    """The fit of moving discs at given parameters, and (N, 2, K) derivatives by the displacements along x and y."""
    values, jacobian = np.zeros_like(pixels.values), None
    by_way = np.zeros((len(parameters), 2, pixels.values.shape[1]), np.float32)
    for step, share in zip(*motion_steps(motions), strict=True):
        picture, slopes = model(_moved_by(parameters, step, (0,)))
        values += picture
        by_way += np.float32(share) * slopes[:, :2]
        jacobian = slopes if jacobian is None else jacobian + slopes
    assert jacobian is not None
    scale = np.float32(1 / len(motion_steps(motions)[1]))
    jacobian *= scale
    residuals = pixels.values - scale * values
    normal = NormalEquations(jacobian, residuals, pixels.present)
    return Minimum(parameters, residuals, jacobian, normal), scale * by_way
