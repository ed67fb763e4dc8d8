"""Centres of discs of 0.3 to 3 px radius by fits of their blurred picture.

The edge model of `nav.centroids.disc_fit` needs pixels that lie within a disc. Here the disc's size is known from the
rough pose, and its place, its light and the light beside it are fitted, in every colour that the sensor measures and at
the sites where it does. The point spread is common to both images. The covariance is the inverse of the Fisher
information (the Cramer-Rao bound) at the noise that the residuals show, widened where a fit is worse than that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from datasets_manifest.types.images import StereoImages
from geometry.se3 import Array
from nav.centroids.centroid_uncertainty import NoiseModel, widen_for_nonlinearity
from nav.centroids.disc_coverage import SpreadDiscs, spread_discs, spread_ring_shares
from nav.centroids.disc_windows import DiscWindows, cut_windows
from nav.centroids.discs import DiscFits
from nav.centroids.ellipses import Ellipses, shape_inverses
from nav.centroids.face_background import FaceBackground
from nav.centroids.pixel_response import reduced_equations
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, evaluate, minimise

EDGELESS_RADIUS_PX = 1.5
"""Smaller discs have no pixels that show one side of their edge only, which the edge model needs. [px]"""
LARGEST_SMALL_RADIUS_PX = 3.0
"""Up to this radius, discs that the edge model does not fit are fitted here. [px]"""
# Pixels that get more of their light from beyond the face are left out, unless they get light of the disc.
_MOST_BEYOND, _OWN_PX = 0.5, 2.0
# Spread of the light by lens and pixels: the first guess, the limits, and the largest step between two fits. [px]
_FIRST_SIGMA_PX, _SIGMAS_PX, _LARGEST_SIGMA_STEP_PX = 0.5, (0.2, 2.0), 0.3
# Cells of a pixel: a lens that spreads light before the pixels collect it, and pixels that spread it afterwards.
_CELLS = (4, 1)
# Where a disc lies within one pixel of a sensor that spreads light afterwards, its image does not change with its
# place, and only the pixel is known: the standard deviation of a place that may be anywhere in most of it. [px]
_WITHIN_PIXEL_PX = 0.2
# A fit that states more rests on where it began: half of what is known before it.
_LARGEST_SIGMA_PX = 0.1
# Lamps of one drogue differ by this share of their light, and so does the light beside them. So many are compared; one
# with less of the usual light is hidden in part.
_LAMPS_DIFFER, _FACES_DIFFER, _LEAST_SPREAD_DN, _LEAST_ALIKE, _LEAST_LIGHT = 0.03, 0.1, 1.0, 4, 0.5
# Shorter images of a round face are no images of one; drogues tilt by some ten degrees.
_LEAST_ASPECT = 0.8
# The light of a neighbour over the own one; beyond, one of both is no lamp. An own light of fewer standard deviations
# may be noise.
_LARGEST_RATIO, _LEAST_STRENGTH = 3.0, 4.0
# Of a disc's light this share must lie in pixels that are used; clipped ones are not.
_LEAST_SHARE = 0.05
_LARGEST_MOVE_PX = 1.0
_LARGEST_CHI2 = 6.0
_QUANTISATION_DN2 = 1 / 12
# Median of the squares of normal residuals; squares above this many variances are not noise; the mean of the others.
_MEDIAN_OF_SQUARES, _ODD_SQUARE, _KEPT_SQUARE = 0.455, 12.0, 0.993
_NOISE_STEPS = 4
_LARGEST_LEVERAGE = np.float32(0.9)
_TURNS, _STEPS, _SMALL_STEP_PX = 3, 8, 0.002
# Smaller discs may lie within one pixel.
_FLAT_RADIUS_PX = 0.7
_GRID_PX = np.arange(-0.6, 0.61, 0.2)


@dataclass(frozen=True, eq=False)
class _Fit:
    """All discs, fitted by one kind of point spread.

    Attributes:
        minimum: parameters are the place from the window's middle, the light of each colour, and the light beside.
        sigma_px: of the spread.
        weights: (N, K + P) inverse variances, the last ones of the P parameters before the fit.
        pixels: K.
        share: (N,) of the disc's light in samples that are used.
        loss: twice the negative logarithm of the evidence (Laplace's approximation), to choose the kind of spread by.
        places_px: (N, 2) from the window's middle.
        cov_px2: (N, 2, 2) of the places.
    """

    minimum: Minimum
    sigma_px: float
    weights: Array32
    pixels: int
    share: Array
    loss: float
    places_px: Array
    cov_px2: Array


def fit_small_discs(images: StereoImages, discs: Ellipses, face: FaceBackground | None = None) -> DiscFits:
    """Fit every disc of both eyes by its blurred picture.

    Args:
        images: the pair.
        discs: outlines of known size, as if they faced the camera, with centres right to about half a pixel.
        face: the face that they lie on; None where there is none, and the light beside a disc is a plane.

    Returns:
        Centres with covariances, or reasons. Shapes are the given ones.
    """
    windows = cut_windows(images, discs)
    fit = min((_fit(windows, discs, face, cells) for cells in _CELLS), key=lambda fit: fit.loss)
    parameters, cov = fit.minimum.parameters, fit.minimum.covariance()
    chi2 = _chi2(fit)
    inflation = np.maximum(chi2, 1.0)
    colors = windows.classes.shape[1]
    light, light_cov = parameters[:, 2 : 2 + colors], cov[:, 2 : 2 + colors, 2 : 2 + colors]
    # The light of all colours together, against its own uncertainty.
    strength = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", light, np.linalg.pinv(light_cov), light), 0) / inflation)
    centers = windows.middles_px + fit.places_px
    moved = np.hypot(*(centers - discs.centers_px).T)
    center_cov = widen_for_nonlinearity(fit.cov_px2 * inflation[:, None, None])
    sigma_px = np.sqrt(np.einsum("nii->n", center_cov) / 2)
    tests = (
        (fit.share < _LEAST_SHARE, "cut by the edge of the image, or clipped: brighter than the sensor's range"),
        (~((strength > _LEAST_STRENGTH) & (light.sum(axis=1) > 0)), "no contrast"),
        (~(moved < _LARGEST_MOVE_PX) | ~np.isfinite(center_cov).all(axis=(1, 2)), "the fit left the disc"),
        (chi2 > _LARGEST_CHI2, "uneven: not the picture of a small disc"),
        ((discs.radii_px >= _FLAT_RADIUS_PX) & ~(sigma_px < _LARGEST_SIGMA_PX), "too faint to be placed"),
    )
    reasons = tuple(next((reason for failed, reason in tests if failed[i]), None) for i in range(len(discs)))
    good = np.array([reason is None for reason in reasons], dtype=np.bool_)
    background, used = parameters[:, 2 + colors], fit.weights[:, : fit.pixels]
    return DiscFits(
        ellipses=Ellipses(discs.eyes, np.where(good[:, None], centers, discs.centers_px), discs.shapes_px),
        cov_px2=center_cov,
        contrast_dn=light.max(axis=1),
        background_dn=background,
        edge_width_px=np.full(len(discs), np.hypot(fit.sigma_px, np.sqrt(1 / 12))),
        chi2_per_dof=chi2,
        inflation=inflation,
        reasons=reasons,
        noise=NoiseModel(float(1 / np.median(used[used > 0])), 0.0, 0.0),
    )


def _chi2(fit: _Fit) -> Array:
    """(N,) mean squares of the residuals over their variances."""
    weights, residuals = fit.weights[:, : fit.pixels], fit.minimum.residuals[:, : fit.pixels]
    freedom = np.maximum((weights > 0).sum(axis=1) - fit.minimum.parameters.shape[1], 1)
    mean: Array = (weights * residuals**2).sum(axis=1) / freedom
    return mean


def _fit(windows: DiscWindows, discs: Ellipses, face: FaceBackground | None, cells: int) -> _Fit:
    """Fit all discs by one kind of spread; its width, neighbours' light and the noise follow from the fits before."""
    centers, sigma_px, variances = discs.centers_px, _FIRST_SIGMA_PX, np.ones_like(windows.values)
    radii = _radii_px(discs, face)
    common, cov, amounts = None, None, None
    size = windows.values.shape[1]
    for turn in range(_TURNS):
        basis, chosen = _background_basis(windows, discs, centers, face, (sigma_px, cells))
        beside = _neighbours(windows, discs.eyes, radii, (centers, amounts), (sigma_px, cells))
        model = _disc_model(windows, radii, (beside, basis), (sigma_px, cells))
        places = _likely_places(discs, centers, cov, face) - windows.middles_px
        count = windows.classes.shape[1] * (1 + basis.shape[1])
        prior = (
            _Prior(places, *(np.zeros((len(discs), count)),) * 2)
            if common is None
            else replace(common, places_px=places)
        )
        weights = np.concatenate([windows.present * chosen / variances, prior.weights], axis=1)
        data, start = np.concatenate([windows.values, prior.means], axis=1), prior.places_px
        if cells == 1 and turn > 0 and discs.radii_px.min() < _FLAT_RADIUS_PX:
            start, _ = _places_on_grid(model, data, weights, prior, prior.places_px)
        minimum = minimise(
            model, data, weights, _with_light(model, data, weights, start, count), _STEPS, _SMALL_STEP_PX
        )
        if turn == _TURNS - 1:
            break
        kept = np.abs(minimum.parameters[:, :2] - prior.places_px).max(axis=1) < _LARGEST_MOVE_PX
        centers = np.where(kept[:, None], windows.middles_px + minimum.parameters[:, :2], discs.centers_px)
        cov = minimum.covariance()[:, :2, :2] if turn else None
        variances = _variances(windows, minimum, weights)
        sigma_px = _common_sigma(windows, radii, minimum, weights, (sigma_px, cells))
        amounts = minimum.parameters[:, 2 : 2 + windows.classes.shape[1]]
        squares, counted = weights[:, :size] * minimum.residuals[:, :size] ** 2, (weights[:, :size] > 0).sum(axis=1)
        misfit = squares.sum(axis=1) / np.maximum(counted, 1)
        common = _common_amounts(discs, minimum, prior, misfit, (face is not None, windows.classes.shape[1]))
    used = weights[:, :size]
    misfit = float((used * minimum.residuals[:, :size] ** 2).sum() - np.log(used[used > 0]).sum())
    # A spread by which all discs would happen to lie at the middles of pixels is less likely than one that leaves their
    # places open.
    loss = misfit - float(np.log(np.linalg.det(minimum.covariance()[:, :2, :2])).sum())
    light = windows.samples(_pictures(windows, radii, minimum.parameters, (sigma_px, cells)).light)
    share = (light * (used > 0)).sum(axis=1) / light.sum(axis=1)
    found_px, found_cov = minimum.parameters[:, :2], minimum.covariance()[:, :2, :2]
    if cells == 1 and discs.radii_px.min() < _FLAT_RADIUS_PX:
        on_grid = _places_on_grid(model, data, weights, prior, found_px)
        found_px, found_cov = _wider_places(found_px, found_cov, *on_grid)
    return _Fit(minimum, sigma_px, weights, size, share, loss, found_px, found_cov)


def _radii_px(discs: Ellipses, face: FaceBackground | None) -> Array:
    """(N, 2) radii of discs along rows and columns, of a face that may be tilted by what the places of all discs say.

    An ellipse that is neither along rows nor along columns has the widths and the area of the one that is taken.
    """
    round_ = np.repeat(discs.radii_px[:, None], 2, axis=1)
    maps = None if face is None else face.maps_px(discs.eyes, discs.centers_px)
    if maps is None:
        return round_
    along = np.hypot(maps[:, :2, 0], maps[:, :2, 1])
    # A lens squeezes the picture of a face that is not tilted too, and the shapes hold that already.
    longest, shortest = np.linalg.svd(shape_inverses(discs.shapes_px) @ maps[..., :2], compute_uv=False).T
    scale = np.sqrt(np.maximum(shortest / longest, _LEAST_ASPECT) / along.prod(axis=1))
    radii: Array = round_ * scale[:, None] * along
    return radii


@dataclass(frozen=True, eq=False)
class _Prior:
    """What is known of discs before their fit.

    Attributes:
        places_px: (N, 2) within `_WITHIN_PIXEL_PX`.
        amounts: (N, A) of light.
        information: (N, A) inverse variances of these, 0 where nothing is known.
    """

    places_px: Array
    amounts: Array
    information: Array

    @property
    def means(self) -> Array32:
        """(N, P) the likeliest parameters."""
        means: Array32 = np.concatenate([self.places_px, self.amounts], axis=1).astype(np.float32)
        return means

    @property
    def weights(self) -> Array32:
        """(N, P) inverse variances of the parameters."""
        place = np.full_like(self.places_px, _WITHIN_PIXEL_PX**-2)
        weights: Array32 = np.concatenate([place, self.information], axis=1).astype(np.float32)
        return weights


def _common_amounts(discs: Ellipses, minimum: Minimum, prior: _Prior, misfit: Array, kind: tuple[bool, int]) -> _Prior:
    """The light of all discs of an eye, and that of the face and beyond it, as known for each of them.

    All lamps of a drogue are alike. Whether a small one is bright or lies on fewer pixels shows in its own picture only
    weakly; in those of all it does. A lamp that is clearly darker is hidden, in part at least, and not like the others.

    Args:
        discs: of both eyes.
        minimum: of their fits.
        prior: of these.
        misfit: (N,) mean squares of the residuals over the variances that the fits were given.
        kind: whether they lie on a face, and the number of colours.
    """
    on_face, colors = kind
    amounts, information = prior.amounts.copy(), np.zeros_like(prior.information)
    shared = np.arange(prior.amounts.shape[1] if on_face else colors)
    spread = np.where(shared < colors, _LAMPS_DIFFER, _FACES_DIFFER)
    for eye in np.unique(discs.eyes):
        mine = np.flatnonzero(discs.eyes == eye)
        if len(mine) < _LEAST_ALIKE:
            continue
        found = minimum.parameters[mine][:, 2 + shared]
        known = np.zeros((len(mine), len(shared), len(shared)))
        known[:, range(len(shared)), range(len(shared))] = prior.information[mine][:, shared]
        own = np.linalg.inv(minimum.covariance()[mine][:, 2 + shared[:, None], 2 + shared])
        weighted = np.einsum("nij,nj->ni", own, found) - np.einsum("nij,nj->ni", known, prior.amounts[mine][:, shared])
        middle = np.median(found[:, :colors], axis=0)
        variance = np.einsum("nii->ni", minimum.covariance()[mine][:, 2 : 2 + colors, 2 : 2 + colors])
        deviation = np.sqrt(variance * misfit[mine, None])
        alike = (found[:, :colors] + 2 * deviation > _LEAST_LIGHT * middle).all(axis=1)
        if alike.sum() < _LEAST_ALIKE:
            continue
        mean = np.linalg.solve((own - known)[alike].sum(axis=0), weighted[alike].sum(axis=0))
        same = mine[alike]
        amounts[same[:, None], shared] = mean
        information[same[:, None], shared] = (spread * np.maximum(np.abs(mean), _LEAST_SPREAD_DN / spread)) ** -2
    return replace(prior, amounts=amounts, information=information)


def _likely_places(discs: Ellipses, centers_px: Array, cov_px2: Array | None, face: FaceBackground | None) -> Array:
    """(N, 2) places before the next fit: where they are, or for discs that may lie within a pixel, by all of an eye."""
    if face is None or cov_px2 is None or discs.radii_px.max() >= _FLAT_RADIUS_PX:
        return centers_px
    maps = face.maps_px(discs.eyes, centers_px, np.einsum("nii->ni", cov_px2))
    if maps is None:
        return centers_px
    places: Array = np.einsum("nij,nj->ni", maps[..., :2], face.places_m) + maps[..., 2]
    return places


def _with_light(model: Model, data: Array32, weights: Array32, places_px: Array, count: int) -> Minimum:
    """Discs at given places (N, 2) with the `count` amounts of light that fit best."""
    start = np.concatenate([places_px, np.zeros((len(places_px), count))], axis=1)
    # Without light nothing depends on the place but what is known of it before: with that at the places themselves the
    # first step is one of the light alone.
    here = data.copy()
    here[:, -count - 2 : -count] = places_px
    lit = minimise(model, here, weights, evaluate(model, here, weights, start), 1, np.inf)
    return evaluate(model, data, weights, lit.parameters)


def _places_on_grid(
    model: Model, data: Array32, weights: Array32, prior: _Prior, about_px: Array
) -> tuple[Array, Array]:
    """(N, 2) means and (N, 2, 2) covariances of the places on a grid about given ones, by their likelihood.

    The image of a disc that lies within one pixel does not show in which direction a better place lies.
    """
    offsets = np.stack(np.meshgrid(_GRID_PX, _GRID_PX), axis=-1).reshape(-1, 2)
    fits = (_with_light(model, data, weights, about_px + offset, prior.amounts.shape[1]) for offset in offsets)
    misfits = np.stack([(fit.residuals**2 * weights).sum(axis=1) for fit in fits])
    likelihood = np.exp((misfits.min(axis=0) - misfits) / 2)
    shares = (likelihood / likelihood.sum(axis=0)).T
    means = shares @ offsets
    away = offsets - means[:, None]
    return about_px + means, np.einsum("nk,nki,nkj->nij", shares, away, away)


def _wider_places(found_px: Array, found_cov: Array, means_px: Array, on_grid: Array) -> tuple[Array, Array]:
    """Places and covariances of fits, or those on a grid about them where these are the wider ones.

    At the edge of where the image does not change with the place, its slope there tells of one side only.
    """
    wide = (np.einsum("nii->ni", on_grid) > np.einsum("nii->ni", found_cov)).any(axis=1)
    places: Array = np.where(wide[:, None], means_px, found_px)
    return places, found_cov + np.where(wide[:, None, None], on_grid, 0.0)


def _pictures(windows: DiscWindows, radii_px: Array, parameters: Array, spread: tuple[float, int]) -> SpreadDiscs:
    sigma_px, cells = spread
    inside = np.clip(parameters[:, :2], -windows.half, windows.half)
    return spread_discs(inside, radii_px, np.full(len(radii_px), sigma_px), windows.half, cells)


def _disc_model(
    windows: DiscWindows, radii_px: Array, beside: tuple[Array32, Array32], spread: tuple[float, int]
) -> Model:
    """The picture of discs, and last their parameters, of which some is known before the fit.

    Args:
        windows: around the discs.
        radii_px: (N, 2) as in `spread_discs`.
        beside: (N, C, K) light of the neighbours and (N, B, K) pictures of the light of the background.
        spread: of the light.
    """
    classes, (neighbours, basis) = windows.classes, beside
    count, colors, size = classes.shape
    backgrounds = (classes[:, :, None] * basis[:, None]).reshape(count, -1, size)

    def model(parameters: Array) -> tuple[Array32, Array32]:
        pictures = _pictures(windows, radii_px, parameters, spread)
        light, by_x, by_y = (windows.samples(each) for each in (pictures.light, pictures.by_x, pictures.by_y))
        linear = np.concatenate([classes * light[:, None] + neighbours, backgrounds], axis=1)
        amounts = parameters[:, 2:].astype(np.float32)
        level = np.einsum("nc,nck->nk", amounts[:, :colors], classes)
        own = np.arange(parameters.shape[1])
        jacobian = np.zeros((count, len(own), size + len(own)), np.float32)
        jacobian[:, 0, :size], jacobian[:, 1, :size], jacobian[:, 2:, :size] = level * by_x, level * by_y, linear
        jacobian[:, own, size + own] = 1
        picture = np.einsum("np,npk->nk", amounts, linear)
        return np.concatenate([picture, parameters.astype(np.float32)], axis=1), jacobian

    return model


def _background_basis(
    windows: DiscWindows, discs: Ellipses, centers_px: Array, face: FaceBackground | None, spread: tuple[float, int]
) -> tuple[Array32, Array32]:
    """(N, B, K) pictures of the light beside the discs, and (N, K) 1 for the samples that they describe."""
    constant = np.ones_like(windows.values)[:, None]
    maps = None if face is None else face.maps_px(discs.eyes, centers_px)
    if face is None or maps is None:
        half = np.float32(windows.half)
        slopes = np.stack([windows.x_px / half, windows.y_px / half], axis=1)
        return np.concatenate([constant, slopes], axis=1), np.ones_like(windows.values)
    # Each disc lies where it was found: perspective moves the rim against a marker by hundredths of a pixel. Those that
    # may lie within one pixel are placed worse than by the map of all of them.
    moved = centers_px - np.einsum("nij,nj->ni", maps[..., :2], face.places_m)
    middles = np.where((discs.radii_px < _FLAT_RADIUS_PX)[:, None], maps[..., 2], moved) - windows.middles_px
    pictures = spread_ring_shares(middles, maps[..., :2], face.edges_m, spread[0], windows.half, spread[1])
    shares = np.stack([windows.samples(pictures[:, edge]) for edge in (0, 1)], axis=1)
    near = np.hypot(windows.x_px, windows.y_px) < discs.radii_px[:, None] + _OWN_PX
    chosen = near | (shares.sum(axis=1) < _MOST_BEYOND)
    return np.concatenate([constant, shares], axis=1), chosen.astype(np.float32)


def _variances(windows: DiscWindows, minimum: Minimum, weights: Array32) -> Array32:
    """(N, K) variances that grow with the light, by a robust line through the squared residuals. [DN^2]"""
    size = windows.values.shape[1]
    residuals = minimum.residuals[:, :size]
    levels = windows.values - residuals
    # The brightest pixels of a small disc draw the fit towards them.
    leverages = np.minimum(minimum.leverages(minimum.covariance(), weights)[:, :size], _LARGEST_LEVERAGE)
    used = weights[:, :size] > 0
    squares = (residuals**2 / (1 - leverages))[used].astype(np.float64)
    light = np.maximum(levels[used], 0.0).astype(np.float64)
    dark, growth = max(float(np.median(squares)) / _MEDIAN_OF_SQUARES, _QUANTISATION_DN2), 0.0
    for _ in range(_NOISE_STEPS):
        variance = dark + growth * light
        kept = squares < _ODD_SQUARE * variance
        root = 1 / variance[kept]
        design = np.stack([root, light[kept] * root], axis=1)
        (dark, growth), _ = nnls(design, squares[kept] * root / _KEPT_SQUARE)
        dark = max(dark, _QUANTISATION_DN2)
    variances: Array32 = np.float32(dark) + np.float32(growth) * np.maximum(levels, 0)
    return variances


def _common_sigma(
    windows: DiscWindows, radii_px: Array, minimum: Minimum, weights: Array32, spread: tuple[float, int]
) -> float:
    """The spread after one step towards the one that fits all discs best. [px]"""
    pictures = _pictures(windows, radii_px, minimum.parameters, spread)
    colors = windows.classes.shape[1]
    level = np.einsum("nc,nck->nk", minimum.parameters[:, 2 : 2 + colors].astype(np.float32), windows.classes)
    slope = np.pad(level * windows.samples(pictures.by_sigma), ((0, 0), (0, minimum.parameters.shape[1])))
    normal, gradient = reduced_equations(minimum, slope[:, None], weights)
    known = normal[:, 0, 0] > 0
    step = float(gradient[known].sum() / max(normal[known].sum(), np.finfo(float).tiny))
    sigma_px = spread[0] + float(np.clip(step, -_LARGEST_SIGMA_STEP_PX, _LARGEST_SIGMA_STEP_PX))
    return float(np.clip(sigma_px, *_SIGMAS_PX))


def _neighbours(
    windows: DiscWindows,
    eyes: NDArray[np.int64],
    radii_px: Array,
    found: tuple[Array, Array | None],
    spread: tuple[float, int],
) -> Array32:
    """(N, C, K) pictures of all other discs in each disc's window, in units of its own light.

    So the light of touching discs, which each one's own picture holds too, is fitted in one step.

    Args:
        windows: around the discs.
        eyes: (N,) of the discs.
        radii_px: (N, 2) as in `spread_discs`.
        found: (N, 2) where they are [px], and (N, C) their light in each colour; all are alike when None.
        spread: of the light.
    """
    centers_px, amounts = found
    colors = windows.classes.shape[1]
    beside = np.zeros((len(eyes), *windows.classes.shape[1:]), np.float32)
    reach_px = windows.half + radii_px.max() + 4 * spread[0]
    gaps = np.abs(centers_px[None] - windows.middles_px[:, None]).max(axis=2)
    here, other = np.nonzero((gaps < reach_px) & (eyes[:, None] == eyes) & ~np.eye(len(eyes), dtype=bool))
    if len(here) == 0:
        return beside
    places, sigma = centers_px[other] - windows.middles_px[here], np.full(len(here), spread[0])
    pictures = windows.samples(spread_discs(places, radii_px[other], sigma, windows.half, spread[1]).light)
    shares = np.ones((len(here), colors))
    if amounts is not None:
        own = np.maximum(amounts, np.finfo(np.float32).tiny)
        shares = np.where(amounts[here] > 0, np.clip(own[other] / own[here], 0, _LARGEST_RATIO), 1.0)
    np.add.at(beside, here, shares.astype(np.float32)[..., None] * windows.classes[here] * pictures[:, None])
    return beside
