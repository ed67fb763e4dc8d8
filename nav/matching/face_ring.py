"""Finds a drogue by its face where lamps of a pixel or less can hardly be told from peaks of the sky beside it.

The face around the markers is a ring of one level before the sky. Its picture and that of the lamps on it follow from
one affine map. The map is fitted to all pixels at once: first by the face, then by every roll that the layout's
symmetry leaves, then by both together. So the light of all lamps counts as one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from datasets_manifest.types.images import Pixels
from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array

DROWNED_RADIUS_PX = 0.8
"""Smaller lamps on a narrow face hardly stand out of the sky beside it. [px]"""
# Spread of the light by lens and pixels. [px]
_SIGMA_PX = 0.58
# Parts of the drogue's radius that are compared: the coupling is somewhere in the opening, and the sky is even nearby.
_INNERMOST, _OUTERMOST = 0.75, 1.45
_STEPS, _SMALL_STEP_PX = 12, 0.003
_LARGEST_STEP_PX = 1.5
# Turns that are tried lie this far apart on the ring of lamps. [px]
_TURN_STEP_PX = 0.5
# All lamps together, in standard deviations: turns of the picture of a face without lamps reach five.
_LEAST_STRENGTH = 8.0
# The face's contrast must explain most of what the sky does not.
_LEAST_EXPLAINED = 0.7
_STRONGEST_TILT_COSINE = 0.35
_MOST_SCALED = 1.6
# A map that shrinks the rim to less shows nothing. [px]
_LEAST_RIM_RADIUS_PX = 4.0
# Faces are searched at these diameters of the rim; larger ones show their lamps.
_SMALLEST_RIM_PX, _LARGEST_RIM_PX, _RIM_STEP = 14.0, 64.0, 1.15
_LEAST_CORRELATION, _MOST_PLACES = 0.5, 4
_HALF_SIZE_FROM_PX = 30.0


@dataclass(frozen=True, eq=False)
class FaceRing:
    """A face with its lamps in one image.

    Attributes:
        affine: (2, 3) map from the rim plane [m] to pixels.
        strength: of the light of all lamps above the face's, in standard deviations.
        explained: share of the picture's variance beside the sky's that the face explains.
    """

    affine: Array
    strength: float
    explained: float


def has_narrow_face(layout: MarkerLayout) -> bool:
    """Whether the markers lie on a flat face with an opening."""
    return layout.count > 1 and layout.is_flat and 0 < layout.face_inner_radius_m < layout.face_outer_radius_m


def fit_face_ring(channel: Pixels, layout: MarkerLayout, center_px: Array, scale_px_per_m: float) -> FaceRing | None:
    """The face and the lamps around a place, or None where there is none.

    Args:
        channel: (H, W) light of the markers' colour.
        layout: with a narrow face.
        center_px: (2,) where the face is, right to a tenth of its diameter.
        scale_px_per_m: its size, right to a fifth.
    """
    reach_px = _OUTERMOST * layout.face_outer_radius_m * scale_px_per_m + 2
    left, top = np.maximum(np.floor(center_px - reach_px), 0).astype(int)
    right, bottom = np.ceil(center_px + reach_px).astype(int) + 1
    part = channel[top:bottom, left:right].astype(np.float64)
    if min(part.shape) < reach_px:
        return None
    y, x = (each.astype(np.float64) for each in np.indices(part.shape))
    affine = np.column_stack([scale_px_per_m * np.eye(2), center_px - (left, top)])
    radius_m = _radii_m(affine, x, y)[0]
    outer_m = layout.face_outer_radius_m
    chosen = (radius_m > _INNERMOST * layout.face_inner_radius_m) & (radius_m < _OUTERMOST * outer_m)
    picture = _Picture(part[chosen], x[chosen], y[chosen], layout)
    if np.ptp(picture.values) == 0:
        return None  # an even picture, such as the colour of a grey camera's, leaves no equation to solve
    affine = _descend(picture, affine, with_lamps=False)
    turns = _turns(layout, affine)
    misfits = [picture.misfit(_turned(affine, turn), with_lamps=True)[0] for turn in turns]
    affine = _descend(picture, _turned(affine, turns[int(np.argmin(misfits))]), with_lamps=True)
    if not _is_plausible(affine, scale_px_per_m):
        return None
    rest, amounts, deviation = picture.misfit(affine, with_lamps=True)
    sky = picture.misfit(None, with_lamps=False)[0]
    strength, explained = float(amounts[-1]) / deviation, 1 - rest / max(sky, float(np.finfo(float).tiny))
    if not (strength > _LEAST_STRENGTH and explained > _LEAST_EXPLAINED):
        return None
    affine[:, 2] += (left, top)
    return FaceRing(affine, float(strength), float(explained))


def find_face_ring(channel: Pixels, layout: MarkerLayout) -> FaceRing | None:
    """The face and the lamps anywhere in an image, or None.

    Args:
        channel: (H, W) light of the markers' colour.
        layout: with a narrow face.
    """
    found = (fit_face_ring(channel, layout, *place) for place in _likely_places(channel, layout))
    return max((each for each in found if each is not None), key=lambda each: each.strength, default=None)


def _likely_places(channel: Pixels, layout: MarkerLayout) -> Iterator[tuple[Array, float]]:
    """Centres [px] and scales [px/m] at which the image correlates best with the picture of a face."""
    whole = channel.astype(np.float32)
    half = cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    places: list[tuple[float, float, float, float]] = []
    rim_px = _SMALLEST_RIM_PX
    while rim_px < min(_LARGEST_RIM_PX, min(channel.shape) / 2):
        shrunk = 2 if rim_px >= _HALF_SIZE_FROM_PX else 1
        image = half if shrunk == 2 else whole
        scale = rim_px / (2 * layout.face_outer_radius_m) / shrunk
        reach = int(np.ceil(1.15 * rim_px / 2 / shrunk)) + 1
        y, x = (each.astype(np.float64) - reach for each in np.indices((2 * reach + 1, 2 * reach + 1)))
        template = -_face_share(np.array([[scale, 0.0, 0.0], [0.0, scale, 0.0]]), x, y, layout)
        alike = np.abs(cv2.matchTemplate(image, template.astype(np.float32), cv2.TM_CCOEFF_NORMED))
        near = max(3, reach) | 1
        best = np.argwhere((alike == cv2.dilate(alike, np.ones((near, near), np.uint8))) & (alike > _LEAST_CORRELATION))
        places += [
            (
                float(alike[row, column]),
                shrunk * (column + reach + 0.5) - 0.5,
                shrunk * (row + reach + 0.5) - 0.5,
                rim_px,
            )
            for row, column in best
        ]
        rim_px *= _RIM_STEP
    for _, x_px, y_px, rim in sorted(places, reverse=True)[:_MOST_PLACES]:
        yield np.array([x_px, y_px]), rim / (2 * layout.face_outer_radius_m)


@dataclass(frozen=True, eq=False)
class _Picture:
    """Pixels around a face.

    Attributes:
        values: (K,) light. [DN]
        x, y: (K,) places. [px]
        layout: of the markers.
    """

    values: Array
    x: Array
    y: Array
    layout: MarkerLayout

    def misfit(self, affine: Array | None, with_lamps: bool) -> tuple[float, Array, float]:
        """Sum of squares of the residuals, amounts of light, and the standard deviation of the last one.

        Args:
            affine: (2, 3) map; None for the sky alone.
            with_lamps: or the face alone.
        """
        residuals, amounts, last = self.residuals(affine, with_lamps)
        rest = float(residuals @ residuals)
        variance = rest / max(len(residuals) - len(amounts) - 6, 1)
        return rest, amounts, float(np.sqrt(variance * last))

    def residuals(self, affine: Array | None, with_lamps: bool) -> tuple[Array, Array, float]:
        """(K,) residuals of the best amounts of light, these, and the last one's variance for unit noise."""
        terms = [np.ones_like(self.x), self.x - self.x.mean(), self.y - self.y.mean()]
        if affine is not None:
            terms.append(_face_share(affine, self.x, self.y, self.layout))
            if with_lamps:
                terms.append(_lamp_light(affine, self.x, self.y, self.layout))
        basis = np.stack(terms, axis=1)
        normal = basis.T @ basis + 1e-9 * np.eye(basis.shape[1])
        amounts = np.linalg.solve(normal, basis.T @ self.values)
        return self.values - basis @ amounts, amounts, float(np.linalg.inv(normal)[-1, -1])


def _descend(picture: _Picture, affine: Array, with_lamps: bool) -> Array:
    """The map after steps of Gauss and Newton, damped as by Levenberg and Marquardt."""
    reach_m = picture.layout.face_outer_radius_m
    # One unit of each number moves the rim by a pixel.
    units = np.array([[1 / reach_m, 1 / reach_m, 1.0]] * 2).ravel()
    residuals = picture.residuals(affine, with_lamps)[0]
    damping = 1e-3
    for _ in range(_STEPS):
        small = 1e-3
        moved = affine.ravel() + small * np.diag(units)
        jacobian = np.stack([picture.residuals(each.reshape(2, 3), with_lamps)[0] for each in moved], axis=1)
        jacobian = (jacobian - residuals[:, None]) / small
        normal = jacobian.T @ jacobian
        normal += np.diag(damping * np.diag(normal) + 1e-9 * np.trace(normal))
        step = -np.linalg.solve(normal, jacobian.T @ residuals)
        step *= min(1.0, _LARGEST_STEP_PX / max(float(np.abs(step).max()), 1e-12))
        trial = affine + (step * units).reshape(2, 3)
        new = picture.residuals(trial, with_lamps)[0] if _shows(trial, reach_m) else residuals
        if new @ new < residuals @ residuals:
            affine, residuals, damping = trial, new, damping / 4
            if np.abs(step).max() < _SMALL_STEP_PX:
                break
        else:
            damping *= 10
    return affine


def _shows(affine: Array, rim_radius_m: float) -> bool:
    """Whether a map keeps the picture's orientation and shows the rim."""
    return bool(np.linalg.det(affine[:, :2]) > (_LEAST_RIM_RADIUS_PX / rim_radius_m) ** 2)


def _turns(layout: MarkerLayout, affine: Array) -> Array:
    """Rolls that give different pictures, half a pixel apart on the ring of lamps. [rad]"""
    ring_px = float(np.hypot(*layout.centers_m[:, :2].T).max() * np.sqrt(abs(np.linalg.det(affine[:, :2]))))
    whole = 2 * np.pi / layout.symmetry_order
    return np.linspace(0, whole, max(4, int(np.ceil(whole * ring_px / _TURN_STEP_PX))), endpoint=False)


def _turned(affine: Array, angle: float) -> Array:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([affine[:, :2] @ turn, affine[:, 2]])


def _is_plausible(affine: Array, scale_px_per_m: float) -> bool:
    largest, smallest = np.linalg.svd(affine[:, :2], compute_uv=False)
    return bool(
        smallest > _STRONGEST_TILT_COSINE * largest
        and scale_px_per_m / _MOST_SCALED < largest < scale_px_per_m * _MOST_SCALED
    )


def _radii_m(affine: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Distances of pixels from the origin of the rim plane [m], and how fast they grow [m/px]."""
    inverse = np.linalg.inv(affine[:, :2])
    u = inverse[0, 0] * (x - affine[0, 2]) + inverse[0, 1] * (y - affine[1, 2])
    v = inverse[1, 0] * (x - affine[0, 2]) + inverse[1, 1] * (y - affine[1, 2])
    radius = np.maximum(np.hypot(u, v), 1e-9)
    slope = np.hypot(inverse[0, 0] * u + inverse[1, 0] * v, inverse[0, 1] * u + inverse[1, 1] * v) / radius + 1e-12
    return radius, slope


def _face_share(affine: Array, x: Array, y: Array, layout: MarkerLayout) -> Array:
    """Share of each pixel's light that comes from within the edges of the face."""
    radius, slope = _radii_m(affine, x, y)
    blur = slope * _SIGMA_PX
    share: Array = ndtr((layout.face_outer_radius_m - radius) / blur) - ndtr(
        (layout.face_inner_radius_m - radius) / blur
    )
    return share


def _lamp_light(affine: Array, x: Array, y: Array, layout: MarkerLayout) -> Array:
    """Light of all lamps in each pixel, as shares of a lamp that fills it."""
    places = layout.centers_m[:, :2] @ affine[:, :2].T + affine[:, 2]
    radius_px = layout.radius_m * np.sqrt(abs(np.linalg.det(affine[:, :2])))
    variance = _SIGMA_PX**2 + radius_px**2 / 4
    squares = (x[:, None] - places[:, 0]) ** 2 + (y[:, None] - places[:, 1]) ** 2
    light: Array = np.exp(-squares / (2 * variance)).sum(axis=1) * radius_px**2 / (2 * variance)
    return light
