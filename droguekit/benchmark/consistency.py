"""Whether errors are as large as the covariances that come with them say, and as the bounds allow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from datasets_manifest.estimates import TANGENT, PoseEstimate
from droguekit.benchmark.bounds import component_covariance
from droguekit.benchmark.pose_errors import COMPONENTS, PoseError
from droguekit.benchmark.result_parts import ComponentRatios, Nees, NeesPart, NormalizedErrors
from droguekit.benchmark.statistics import mean_square_region, rms_upper_limit, root_mean_square
from geometry.se3 import Array

# Position, attitude and both together, as slices of the five components.
_PARTS = {"position": slice(0, 3), "attitude": slice(3, 5), "pose": slice(0, 5)}


def squared_errors(estimate: PoseEstimate, error: PoseError) -> Array | None:
    """Normalized estimation error squared of position, attitude and both.

    Args:
        estimate: with a covariance.
        error: of its pose.

    Returns:
        (3,) of 3, 2 and 5 degrees of freedom, or None where the covariance is not positive definite or stands in
        another tangent than ours.

    Source: e^T C^-1 e, Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.
    """
    if estimate.covariance is None or estimate.tangent != TANGENT:
        return None
    covariance = component_covariance(estimate.left_from_drogue, estimate.covariance)
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0))
    if not deviations.all():
        return None
    scaled, whole = covariance / np.outer(deviations, deviations), error.components / deviations
    try:
        return np.array(
            [whole[part] @ cho_solve(cho_factor(scaled[part, part]), whole[part]) for part in _PARTS.values()]
        )
    except LinAlgError:
        return None


def nees(squares: Sequence[Array | None]) -> Nees | None:
    """Mean over the poses that come with a covariance; None without any.

    Args:
        squares: `squared_errors` of each.
    """
    if not squares:
        return None
    usable = np.array([row for row in squares if row is not None])
    parts = {}
    for k, (name, part) in enumerate(_PARTS.items()):
        freedom = part.stop - part.start
        if len(usable):
            low, high = mean_square_region(freedom * len(usable))
            mean = float(usable[:, k].mean()) / freedom
            parts[name] = NeesPart(freedom=freedom, per_freedom=mean, low=low, high=high)
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
