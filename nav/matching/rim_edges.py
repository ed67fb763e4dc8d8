"""Measures the outer edge of a drogue's rim in one image, where markers are too small or there are none.

The rim's image is an ellipse. It is found among the edges along rays from the middle of the drogue's box, and then
fitted to the pixels around it, from coarse to fine. Every sector has levels of its own: the background, the rim's tube
and what lies behind it. So struts, folds and a sky of two halves move no edge; what is left is an edge point for every
sector, with the standard deviation that its pixels allow.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from datasets_manifest.types.images import StereoImages
from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig
from nav.matching.marker_channel import brightness
from nav.pose.pose_method import RimEdges

LEAST_RADIUS_PX = 7.0
"""Rims that are smaller have too few pixels. [px]"""
# Part of the box's half width around which the rim is searched, and steps along each ray.
_LOW, _HIGH, _RAYS, _RAY_STEPS = 0.72, 1.3, 180, 96
_PEAKS = 4
_LEAST_PEAK_SIGMAS = 4.0
# Middles and radii that are tried, in shares of the half width.
_MIDDLES = np.linspace(-0.24, 0.24, 17)
_RADIUS_BIN = 0.025
# Circles with this share of the best one's votes are the rim as well; the outermost counts.
_ALMOST_BEST = 0.8
_LEAST_VOTES = 0.4
# Tolerances of the ellipse around edges along rays, in shares of its radius.
_TOLERANCES = (0.06, 0.03, 0.02)
# Blurs under which the ellipse is fitted, and those of lens and pixels that are tried at last. [px]
_COARSE_BLURS_PX, _OWN_BLURS_PX = (2.0, 1.0), (0.45, 0.52, 0.58, 0.65, 0.75, 0.87, 1.0, 1.2, 1.4)
_USUAL_BLUR_PX = 0.58
_STEPS = 5
# Pixels on both sides of the edge, beside those that the blur reaches; and length of a sector. [px]
_REACH_PX, _SECTOR_PX = 3.5, 6.0
_LARGEST_SHIFT_PX = 1.5
_FEWEST_PIXELS, _MOST_CLIPPED = 12, 0.2
# Depth at which the light inside the edge counts. [px]
_INSIDE_PX = 2.5
# Of the sectors that are seen, these many may be less dark than the darkness that is told.
_DARKNESS_QUANTILE = 0.2
# Edge points with a larger deviation are not seen. [px]
_LARGEST_SIGMA_PX = 0.5
# Tukey's biweight: sectors whose edge lies this many robust deviations off the ellipse do not move it.
_OUTLIER_SIGMAS, _OUTLIER_FLOOR_PX = 4.5, 0.05
# Of the levels of background, tube, inside and shading: holds the tube's to that behind it.
_TIE = np.array([[0.0, 0, 0, 0], [0, 1, -1, 0], [0, -1, 1, 0], [0, 0, 0, 0]])
# Standard deviations of the light on the tube's flank, and of the tube against what is behind it, over the contrast.
_SHADING, _NO_FLANK, _NO_SHADING = 0.15, 1e-6, 1e12
_TUBE_CONTRAST = 0.3
_PAIRS = tuple(combinations_with_replacement(range(4), 2))
# Levels and the edge's place.
_PARAMETERS = 5


@dataclass(frozen=True, eq=False)
class _Ellipse:
    """Points `center + shape (cos, sin)`.

    Attributes:
        center_px: (2,).
        shape_px: (2, 2) symmetric.
    """

    center_px: Array
    shape_px: Array

    @property
    def radius_px(self) -> float:
        return float(np.sqrt(abs(np.linalg.det(self.shape_px))))

    def normals(self, angle: Array) -> Array:
        """(K, 2) unit vectors outwards."""
        outwards = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ np.linalg.inv(self.shape_px)
        unit: Array = outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)
        return unit

    def points(self, angle: Array) -> Array:
        """(K, 2) points. [px]"""
        points: Array = self.center_px + np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ self.shape_px
        return points

    def depths_and_angles(self, points_px: Array) -> tuple[Array, Array]:
        """Distances (K,) of points inside of the ellipse, negative outside [px], and their angles (K,). [rad]"""
        inverse = np.linalg.inv(self.shape_px)
        units = (points_px - self.center_px) @ inverse
        radius = np.maximum(np.hypot(units[..., 0], units[..., 1]), 1e-9)
        slope = np.linalg.norm(units @ inverse, axis=-1) / radius
        return (1 - radius) / slope, np.arctan2(units[..., 1], units[..., 0])

    def moved(self, step: Array) -> _Ellipse:
        """The ellipse with (5,) added to centre, and to shape's xx, yy and xy. [px]"""
        return _Ellipse(self.center_px + step[:2], self.shape_px + np.array([[step[2], step[4]], [step[4], step[3]]]))


@dataclass(frozen=True, eq=False)
class _Sectors:
    """Edges in the sectors of an ellipse.

    Attributes:
        angles: (S,) their middles. [rad]
        shifts_px: (S,) of the edge outwards from the ellipse.
        sigma_px: (S,) infinite where there is no edge.
        darkness: (S,) share of the background's light that is missing inside the edge; negative where it is brighter.
        misfit: sum of squares of what the levels leave over the square of the contrast, median of the sectors.
    """

    angles: Array
    shifts_px: Array
    sigma_px: Array
    darkness: Array
    misfit: float

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(S,)"""
        seen: NDArray[np.bool_] = self.sigma_px < _LARGEST_SIGMA_PX
        return seen


def measure_rim(
    images: StereoImages, rig: StereoRig, boxes: dict[Eye, tuple[float, float, float, float]], tube_fraction: float
) -> RimEdges:
    """The rim's edge in the images of a pair.

    Args:
        images: the pair.
        rig: its lenses move the points to the ideal images.
        boxes: x, y, width, height around the drogue in either eye, right to a seventh of its width. [px]
        tube_fraction: diameter of the rim's tube over the rim's radius.
    """
    pictures = {eye: _picture(images, eye, box) for eye, box in boxes.items()}
    ellipses = {
        eye: _coarse_ellipse(*picture, tube_fraction) for eye, picture in pictures.items() if picture is not None
    }
    starts = {eye: ellipse for eye, ellipse in ellipses.items() if ellipse is not None}
    found: dict[Eye, tuple[_Ellipse, _Sectors]] = {}
    blur_px = _own_blur_px(pictures, starts, tube_fraction)
    for eye, start in starts.items():
        picture = pictures[eye]
        assert picture is not None
        light, clipped, corner = picture[:3]
        fitted = _fit(light, clipped, start, tube_fraction, blur_px)
        if fitted is not None and fitted.radius_px >= LEAST_RADIUS_PX:
            sectors = _sectors(light, clipped, fitted, tube_fraction, blur_px, 3)
            found[eye] = _Ellipse(fitted.center_px + corner, fitted.shape_px), sectors
    eyes, points, normals, sigmas, shares, darkness = [], [], [], [], [0.0, 0.0], [0.0, 0.0]
    for index, eye in enumerate(EYES):
        measured = found.get(eye)
        if measured is None:
            continue
        ellipse, sectors = measured
        seen = sectors.seen
        shares[index] = float(seen.mean())
        darkness[index] = float(np.quantile(sectors.darkness[seen], _DARKNESS_QUANTILE)) if seen.any() else 0.0
        angle = sectors.angles[seen]
        normal = ellipse.normals(angle)
        place = ellipse.points(angle) + sectors.shifts_px[seen, None] * normal
        place, normal, stretch = _to_ideal(rig, eye, place, normal)
        eyes.append(np.full(len(place), index))
        points.append(place)
        normals.append(normal)
        sigmas.append(sectors.sigma_px[seen] * stretch)
    if not eyes:
        return RimEdges(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), (0.0, 0.0), (0.0, 0.0))
    return RimEdges(
        np.concatenate(eyes),
        np.concatenate(points),
        np.concatenate(normals),
        np.concatenate(sigmas),
        (shares[0], shares[1]),
        (darkness[0], darkness[1]),
    )


def _to_ideal(rig: StereoRig, eye: Eye, points_px: Array, normals: Array) -> tuple[Array, Array, Array]:
    """Points, normals and the stretch of lengths along them, moved to the ideal image."""
    if rig.lenses is None or len(points_px) == 0:
        return points_px, normals, np.ones(len(points_px))
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    ideal = rig.ideal_px(points_px, eye)
    tangent = rig.ideal_px(points_px + along / 2, eye) - rig.ideal_px(points_px - along / 2, eye)
    moved = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    across = rig.ideal_px(points_px + normals / 2, eye) - rig.ideal_px(points_px - normals / 2, eye)
    return ideal, moved, np.abs((across * moved).sum(axis=1))


# Light of the part of an image around a box, which of it is clipped, and its first pixel; then the box's middle in that
# part, and half of its width.
_Picture = tuple[NDArray[np.float32], NDArray[np.bool_], Array, Array, float]


def _picture(images: StereoImages, eye: Eye, box: tuple[float, float, float, float]) -> _Picture | None:
    x, y, width, height = box
    middle, half_px = np.array([x + width / 2, y + height / 2]), max(width, height) / 2
    columns, rows = images.size_px
    reach_px = _HIGH * 1.25 * half_px + 6
    left, top = (int(max(np.floor(place - reach_px), 0)) for place in middle)
    right, bottom = (int(np.ceil(place + reach_px)) + 1 for place in middle)
    window = (left, top, min(right, columns), min(bottom, rows))
    if half_px < LEAST_RADIUS_PX or window[2] - left < half_px or window[3] - top < half_px:
        return None
    light, clipped = brightness(images, eye, window)
    corner = np.array([left, top], dtype=np.float64)
    return light, clipped, corner, middle - corner, half_px


def _coarse_ellipse(
    light: NDArray[np.float32],
    clipped: NDArray[np.bool_],
    corner: Array,
    middle: Array,
    half_px: float,
    tube_fraction: float,
) -> _Ellipse | None:
    """The rim's ellipse in a part of an image, right to a fraction of a pixel."""
    ellipse = _find(light, middle, half_px)
    for blur_px in _COARSE_BLURS_PX:
        if ellipse is not None:
            smooth = cv2.GaussianBlur(light, (0, 0), blur_px)
            ellipse = _fit(smooth, clipped, ellipse, tube_fraction, float(np.hypot(blur_px, _USUAL_BLUR_PX)))
    return ellipse if ellipse is None else _fit(light, clipped, ellipse, tube_fraction, _USUAL_BLUR_PX)


def _own_blur_px(pictures: dict[Eye, _Picture | None], starts: dict[Eye, _Ellipse], tube_fraction: float) -> float:
    """The blur of lens and pixels by most sectors, the same in both eyes."""
    misfits = np.zeros(len(_OWN_BLURS_PX))
    for eye, start in starts.items():
        picture = pictures[eye]
        assert picture is not None
        # A lit flank looks like blur, so it has no say here.
        tried = [_sectors(*picture[:2], start, tube_fraction, blur_px, 3, _NO_FLANK) for blur_px in _OWN_BLURS_PX]
        misfits += [each.misfit for each in tried]
    return _OWN_BLURS_PX[int(np.argmin(misfits))]


def _find(light: NDArray[np.float32], middle: Array, half_px: float) -> _Ellipse | None:
    """The outermost ellipse that most edges along rays from the middle lie on."""
    smooth = cv2.GaussianBlur(light, (0, 0), max(1.0, 0.02 * half_px))
    angle = 2 * np.pi * np.arange(_RAYS) / _RAYS
    radius = np.linspace(0.8 * _LOW, 1.2 * _HIGH, _RAY_STEPS) * half_px
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    places = (middle + radius[:, None, None] * rays).astype(np.float32)
    profiles = cv2.remap(smooth, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    steep = np.abs(np.gradient(profiles, axis=0))
    inside = ((places >= 1) & (places <= np.array(light.shape[::-1]) - 2)).all(axis=-1)
    steep[~inside] = 0
    noise = 1.48 * float(np.median(steep[inside])) if inside.any() else 0.0
    peak = np.zeros_like(steep, dtype=bool)
    peak[1:-1] = (steep[1:-1] >= steep[:-2]) & (steep[1:-1] > steep[2:]) & (steep[1:-1] > _LEAST_PEAK_SIGMAS * noise)
    weakest = -np.sort(-np.where(peak, steep, 0), axis=0)[_PEAKS - 1]
    step, ray = np.nonzero(peak & (steep >= weakest))
    if len(step) < _RAYS // 4:
        return None
    edges = places[step, ray].astype(np.float64)
    return _outermost(edges, ray, middle, half_px)


def _outermost(edges: Array, ray: NDArray[np.int64], middle: Array, half_px: float) -> _Ellipse | None:
    x, y = np.meshgrid(_MIDDLES, _MIDDLES)
    middles = middle + half_px * np.stack([x.ravel(), y.ravel()], axis=-1)
    away = np.linalg.norm(edges[None] - middles[:, None], axis=-1) / half_px
    count = int(np.ceil((_HIGH - _LOW) / _RADIUS_BIN))
    bins = np.floor((away - _LOW) / _RADIUS_BIN).astype(np.int64)
    ok = (bins >= 0) & (bins < count)
    cell = np.arange(len(middles))[:, None] * count + bins
    # Each ray has one vote for a circle.
    once = np.unique(cell[ok] * _RAYS + np.broadcast_to(ray, cell.shape)[ok])
    votes = np.bincount(once // _RAYS, minlength=len(middles) * count).reshape(len(middles), count)
    pairs = votes[:, :-1] + votes[:, 1:]
    if pairs.max() < _LEAST_VOTES * _RAYS:
        return None
    place, radius = np.nonzero(pairs >= _ALMOST_BEST * pairs.max())
    outermost = radius == radius.max()
    best = np.flatnonzero(outermost)[int(np.argmax(pairs[place, radius][outermost]))]
    scale_px = half_px * (_LOW + (radius[best] + 1) * _RADIUS_BIN)
    ellipse = _Ellipse(middles[place[best]], scale_px * np.eye(2))
    for tolerance in _TOLERANCES:
        depth, _ = ellipse.depths_and_angles(edges)
        near = np.abs(depth) < max(tolerance * ellipse.radius_px, 1.0)
        if len(np.unique(ray[near])) < _RAYS // 4:
            return None
        fitted = _ellipse_through(edges[near])
        if fitted is None:
            return None
        ellipse = fitted
    return ellipse


def _ellipse_through(points_px: Array) -> _Ellipse | None:
    """The ellipse nearest to points, by OpenCV's direct fit."""
    (x, y), (width, height), turn_deg = cv2.fitEllipseDirect(points_px.astype(np.float32)[:, None])
    if not (np.isfinite([x, y, width, height, turn_deg]).all() and 0.3 * width < height < 3.4 * width and width > 0):
        return None
    turn = np.radians(turn_deg)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return _Ellipse(np.array([x, y]), axes @ np.diag([width / 2, height / 2]) @ axes.T)


def _fit(
    light: NDArray[np.float32], clipped: NDArray[np.bool_], start: _Ellipse, tube_fraction: float, blur_px: float
) -> _Ellipse | None:
    """The ellipse through the edges of most sectors."""
    ellipse = start
    for _ in range(_STEPS):
        sectors = _sectors(light, clipped, ellipse, tube_fraction, blur_px, 1)
        seen = sectors.seen
        if seen.sum() < 8:
            return None
        angle, shift = sectors.angles[seen], sectors.shifts_px[seen]
        normal = ellipse.normals(angle)
        c, s = np.cos(angle), np.sin(angle)
        slopes = np.column_stack([normal, normal[:, 0] * c, normal[:, 1] * s, normal[:, 0] * s + normal[:, 1] * c])
        step, weights = np.zeros(5), 1 / (sectors.sigma_px[seen] ** 2 + _OUTLIER_FLOOR_PX**2)
        for _ in range(4):
            rest = shift - slopes @ step
            spread = max(1.48 * float(np.median(np.abs(rest))), _OUTLIER_FLOOR_PX)
            trusted = np.maximum(1 - (rest / (_OUTLIER_SIGMAS * spread)) ** 2, 0.0) ** 2 * weights
            normal_matrix = slopes.T @ (trusted[:, None] * slopes) + 1e-6 * np.eye(5)
            step = np.linalg.solve(normal_matrix, slopes.T @ (trusted * shift))
        moved = ellipse.moved(step)
        axes = np.linalg.eigvalsh(moved.shape_px)
        if not (np.isfinite(axes).all() and axes[0] > 0.3 * axes[1] and axes[0] > LEAST_RADIUS_PX / 2):
            return None
        ellipse = moved
        if np.abs(step).max() < 0.005:
            break
    return ellipse


def _sectors(
    light: NDArray[np.float32],
    clipped: NDArray[np.bool_],
    ellipse: _Ellipse,
    tube_fraction: float,
    blur_px: float,
    steps: int,
    shading: float = _SHADING,
) -> _Sectors:
    """The edge in every sector, by steps of Gauss and Newton from the ellipse."""
    tube_px = tube_fraction * ellipse.radius_px
    reach_px = _REACH_PX + 2 * blur_px
    count = max(24, round(2 * np.pi * ellipse.radius_px / _SECTOR_PX))
    x, y = _pixels_near(ellipse, reach_px, light.shape)
    depth, angle = ellipse.depths_and_angles(np.stack([x, y], axis=-1).astype(np.float64))
    chosen = (np.abs(depth) < reach_px) & (np.abs(depth) < ellipse.radius_px / 2)
    depth, x, y = depth[chosen], x[chosen], y[chosen]
    values, is_clipped = light[y, x].astype(np.float64), clipped[y, x]
    sector = np.floor(angle[chosen] / (2 * np.pi) * count).astype(np.int64) % count
    angles = 2 * np.pi * (np.arange(count) + 0.5) / count

    def total(products: Array) -> Array:
        sums: Array = np.bincount(sector, products, count).astype(np.float64)
        return sums

    pixels = total(np.ones(len(depth)))
    whole = 2 * reach_px * 2 * np.pi * ellipse.radius_px / count
    usable = (pixels > max(_FEWEST_PIXELS, 0.75 * whole)) & (total(is_clipped.astype(float)) < _MOST_CLIPPED * pixels)
    contrast2 = np.maximum(
        4 * (total(values**2) / np.maximum(pixels, 1) - (total(values) / np.maximum(pixels, 1)) ** 2), 1e-9
    )
    freedom = np.maximum(pixels - _PARAMETERS, 1)
    shifts, bend, misfit = np.zeros(count), np.ones(count), np.zeros(count)
    stiffness, tie = np.full(count, _NO_SHADING), np.ones(count)
    for step in range(steps + 1):
        at = depth + shifts[sector]
        model = _profiles(at, tube_px, blur_px)
        # Where the tube is too thin to tell, its level is that behind it; its shading is a share of the contrast.
        ridge = tie[:, None, None] * _TIE
        ridge[:, 3, 3] = stiffness
        normal = np.empty((count, 4, 4))
        for row, column in _PAIRS:
            normal[:, row, column] = normal[:, column, row] = total(model.levels[row] * model.levels[column])
        # Sectors without pixels, or all of one level, keep some solution.
        least = 1e-9 * (np.einsum("sii->s", (normal + ridge)[:, :3, :3]) + 1)
        inverse = np.linalg.inv(normal + ridge + least[:, None, None] * np.eye(4))
        levels = (inverse @ np.stack([total(a * values) for a in model.levels], -1)[..., None])[..., 0]
        rest = values - (levels[sector] * model.levels.T).sum(axis=1)
        slope = (levels[sector] * model.slopes.T).sum(axis=1)
        mixed = np.stack([total(a * slope) for a in model.levels], axis=-1)
        # What the ridge holds back is no residual of the pixels.
        pulled = np.stack([total(a * rest) for a in model.levels], -1) - np.einsum("sij,sj->si", ridge, levels)
        bend = np.maximum(total(slope * slope) - np.einsum("si,sij,sj->s", mixed, inverse, mixed), 1e-12)
        misfit = total(rest * rest)
        variance = misfit / freedom
        typical = float(np.median(variance[usable])) if usable.any() else 0.0
        variance = np.maximum(variance, typical)
        stiffness, tie = (np.maximum(variance, 1e-9) / (share**2 * contrast2) for share in (shading, _TUBE_CONTRAST))
        if step == 0:
            continue
        pull = total(slope * rest) - np.einsum("si,sij,sj->s", mixed, inverse, pulled)
        shifts = np.clip(shifts + pull / bend, -_LARGEST_SHIFT_PX - blur_px, _LARGEST_SHIFT_PX + blur_px)
    sigma = np.sqrt(variance / bend)
    typical_misfit = float(np.median((misfit / contrast2)[usable])) if usable.any() else np.inf
    is_edge = usable & np.isfinite(sigma) & (np.abs(shifts) < _LARGEST_SHIFT_PX + blur_px)
    inside = (levels * _profiles(np.full(count, _INSIDE_PX), tube_px, blur_px).levels.T).sum(axis=1)
    darkness = 1 - inside / np.maximum(levels[:, 0], 1e-9)
    return _Sectors(angles, shifts, np.where(is_edge, sigma, np.inf), darkness, typical_misfit)


def _pixels_near(
    ellipse: _Ellipse, reach_px: float, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows of all pixels within a distance of an ellipse, and of some beyond it."""
    # Steps of two thirds of a pixel both ways leave none out.
    longest_px = float(np.abs(np.linalg.eigvalsh(ellipse.shape_px)).max())
    angle = np.linspace(0, 2 * np.pi, int(np.ceil(1.5 * 2 * np.pi * (longest_px + reach_px))), endpoint=False)
    away = np.arange(-reach_px - 1, reach_px + 1.5, 2 / 3)
    places = ellipse.points(angle)[:, None] + away[:, None] * ellipse.normals(angle)[:, None]
    x, y = np.rint(places).astype(np.int64).reshape(-1, 2).T
    inside = (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    rows, columns = np.divmod(np.unique(y[inside] * shape[1] + x[inside]), shape[1])
    return columns, rows


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Light across the edge for unit levels of the background, the tube, what lies behind it, and the tube's shading.

    Attributes:
        levels: (4, P).
        slopes: (4, P) their derivatives by a shift of the edge outwards. [1/px]
    """

    levels: Array
    slopes: Array


def _profiles(depth_px: Array, tube_px: float, blur_px: float) -> _Profiles:
    """Blurred profiles at (P,) depths within the edge.

    A tube that light meets from the side is brightest at its edge and dark from its middle on.
    """
    half = tube_px / 2
    edge, middle, inner = ((depth_px - place) / blur_px for place in (0.0, half, tube_px))
    steps = [ndtr(place) for place in (edge, middle, inner)]
    bells = [np.exp(-(place**2) / 2) / (np.sqrt(2 * np.pi) * blur_px) for place in (edge, middle, inner)]
    # The integral of a blurred step.
    ramps = [
        blur_px * place * step + blur_px**2 * bell
        for place, step, bell in zip((edge, middle, inner), steps, bells, strict=True)
    ]
    shading = steps[0] - (ramps[0] - ramps[1]) / half
    shading_slope = bells[0] - (steps[0] - steps[1]) / half
    return _Profiles(
        np.stack([1 - steps[0], steps[0] - steps[2], steps[2], shading]),
        np.stack([-bells[0], bells[0] - bells[2], bells[2], shading_slope]),
    )
