"""Whether errors are as large as the covariances that come with them say, and as the bounds allow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from datasets_manifest.types.estimates import TANGENT, PoseEstimate
from droguekit.benchmark.poses.bounds import component_covariance
from droguekit.benchmark.poses.pose_errors import COMPONENTS, PoseError
from droguekit.benchmark.results.result_parts import ComponentRatios, Nees, NeesPart, NormalizedErrors
from droguekit.benchmark.statistics import mean_square_region, rms_upper_limit, root_mean_square
from geometry.se3 import Array

Parts = Mapping[str, slice]

# A square beyond this tells of a covariance that is no measure of anything, and means of such squares of no method.
_MOST_SQUARE = 1e100

# Position, attitude and both together, as slices of the five components.
_PARTS: Parts = {"position": slice(0, 3), "attitude": slice(3, 5), "pose": slice(0, 5)}


def squared_errors(estimate: PoseEstimate, error: PoseError) -> Array | None:
    """Normalized estimation error squared of position, attitude and both.

    Args:
        estimate: with a covariance.
        error: of its pose.

    Returns:
        (3,) of 3, 2 and 5 degrees of freedom, or None where the covariance is not positive definite, too small or too
        large for floats, or stands in another tangent than ours.

    Source: e^T C^-1 e, Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.
    """
    if estimate.covariance is None or estimate.tangent != TANGENT:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = component_covariance(estimate.left_from_drogue, estimate.covariance)
    return normalized_squares(error.components, covariance, _PARTS)


def normalized_squares(error: Array, covariance: Array, parts: Parts) -> Array | None:
    """(len(parts),) `e^T C^-1 e` of parts of an error.

    Returns:
        None where the covariance is not positive definite, or too small or too large for floats.
    """
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0))
    if not deviations.all():
        return None
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        scaled, whole = covariance / np.outer(deviations, deviations), error / deviations
        if not np.isfinite(scaled).all():
            return None
        try:
            squares = np.array(
                [whole[part] @ cho_solve(cho_factor(scaled[part, part]), whole[part]) for part in parts.values()]
            )
        except (LinAlgError, ValueError):
            # The latter where the error over its deviation is no float.
            return None
    return squares if (squares < _MOST_SQUARE).all() else None


def nees_parts(squares: Array, parts: Parts) -> dict[str, NeesPart]:
    """Means over (n, len(parts)) `normalized_squares`; empty without any."""
    if not len(squares):
        return {}
    found = {}
    for k, (name, part) in enumerate(parts.items()):
        freedom = part.stop - part.start
        low, high = mean_square_region(freedom * len(squares))
        found[name] = NeesPart(freedom=freedom, per_freedom=float(squares[:, k].mean()) / freedom, low=low, high=high)
    return found


def nees(squares: Sequence[Array | None]) -> Nees | None:
    """Mean over the poses that come with a covariance; None without any.

    Args:
        squares: `squared_errors` of each.
    """
    if not squares:
        return None
    usable = np.array([row for row in squares if row is not None])
    parts = nees_parts(usable, _PARTS)
    return Nees(
        n=len(usable),
        unusable=len(squares) - len(usable),
        position=parts.get("position"),
        attitude=parts.get("attitude"),
        pose=parts.get("pose"),
    )


def normalized_errors(pairs: Sequence[tuple[PoseError, Array]]) -> NormalizedErrors | None:
    """Root mean square of errors over the (5,) bound of their frame, with its upper limit; None without any."""
    if not pairs:
        return None
    ratios = np.array([error.components / bound for error, bound in pairs])
    nrms = dict(zip(COMPONENTS, (root_mean_square(column) for column in ratios.T), strict=True))
    upper = {name: rms_upper_limit(value, len(pairs)) for name, value in nrms.items()}
    return NormalizedErrors(n=len(pairs), nrms=ComponentRatios(**nrms), upper=ComponentRatios(**upper))
