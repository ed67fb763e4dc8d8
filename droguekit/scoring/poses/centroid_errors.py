"""The noise of the measured centroids, and how much of a pose's error follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Feature
from drogue_models.marker_layout import MarkerLayout
from droguekit.scoring.poses.cramer_rao import pose_covariance
from droguekit.scoring.poses.drogue_truth import DrogueTruth
from droguekit.scoring.results.pose_result import CentroidStatistics
from geometry.se3 import Array
from geometry.stereo import EYES


@dataclass(frozen=True, eq=False)
class CentroidErrors:
    """Measured minus true ellipse centres of one pair.

    Attributes:
        eye, feature: (K,) which feature in which eye, in the order of `DrogueTruth`.
        offset_px: (K, 2) [px]
        outward_px: (K,) part of the offset that points away from the image of the drogue's middle. [px]
        is_hub, used: (K,) whether the feature is the hub, and whether the pose rests on it.
        weight: (K,) smallest variance that the estimator gives a feature over its own; all 1 where it gives one that
            is no proper variance.
        mistaken: number of measurements that lie farther from their feature than its image is wide, and so belong to
            something else; they are not among the K.
    """

    eye: NDArray[np.intp]
    feature: NDArray[np.intp]
    offset_px: Array
    outward_px: Array
    is_hub: NDArray[np.bool_]
    used: NDArray[np.bool_]
    weight: Array
    mistaken: int


def centroid_errors(truth: DrogueTruth, features: Sequence[Feature]) -> CentroidErrors:
    """Errors of the measured features of one pair that are visible in the truth.

    Even markers look alike, so an estimator's numbering may be the true one turned by the symmetry: the turn that fits
    best in the median is taken for all features of the pair.

    Raises:
        ValueError: a feature that the drogue does not have.
    """
    places = feature_places(truth.layout, features)
    measured = np.array([feature.center_px for feature in features], dtype=np.float64).reshape(-1, 2)
    used = np.array([feature.used for feature in features], dtype=np.bool_)
    eye = np.array([EYES.index(feature.eye) for feature in features], dtype=np.intp)
    candidates = [order[places] for order in symmetric_orders(truth.layout)]
    if len(features):
        medians = [np.median(np.linalg.norm(measured - truth.centers_px[eye, c], axis=1)) for c in candidates]
        places = candidates[int(np.argmin(medians))]
    offset = measured - truth.centers_px[eye, places]
    width = _image_radii(truth)[eye, places]
    visible = truth.visible[eye, places]
    near = np.linalg.norm(offset, axis=1) <= width
    keep = visible & near
    markers_px = truth.centers_px[:, : truth.layout.count]
    middle = markers_px.mean(axis=1) if truth.layout.count else np.zeros((2, 2))
    arm = (truth.centers_px[eye, places] - middle[eye])[keep]
    outward = np.einsum("ki,ki->k", offset[keep], arm) / np.maximum(np.linalg.norm(arm, axis=1), np.finfo(float).tiny)
    return CentroidErrors(
        eye=eye[keep],
        feature=places[keep],
        offset_px=offset[keep],
        outward_px=outward,
        is_hub=places[keep] == truth.layout.count,
        used=used[keep],
        weight=_weights(features)[keep],
        mistaken=int((visible & ~near).sum()),
    )


def symmetric_orders(layout: MarkerLayout) -> list[NDArray[np.intp]]:
    """Renumberings of the features by the rotations that map the markers onto themselves; the hub stays. Each (M,)."""
    if layout.count == 0:
        return [np.array([0])]
    orders = []
    for step in range(layout.symmetry_order):
        angle = 2 * np.pi * step / layout.symmetry_order
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned = layout.centers_m[:, :2] @ turn.T
        gaps = np.linalg.norm(turned[:, None] - layout.centers_m[None, :, :2], axis=-1)
        orders.append(np.append(gaps.argmin(axis=1), layout.count))
    return orders


def centroid_statistics(errors: Sequence[CentroidErrors]) -> CentroidStatistics:
    """Noise and bias over many pairs."""
    offsets = np.concatenate([e.offset_px for e in errors] or [np.zeros((0, 2))])
    outward = np.concatenate([e.outward_px for e in errors] or [np.zeros(0)])
    hub = np.concatenate([e.is_hub for e in errors] or [np.zeros(0, dtype=np.bool_)])
    markers = offsets[~hub]
    some = len(markers) > 0
    return CentroidStatistics(
        count=len(markers),
        sigma_px=_coordinate_rms(markers),
        bias_u_px=float(markers[:, 0].mean()) if some else None,
        bias_v_px=float(markers[:, 1].mean()) if some else None,
        bias_outward_px=float(outward[~hub].mean()) if some else None,
        hub_count=int(hub.sum()),
        hub_sigma_px=_coordinate_rms(offsets[hub]),
        mistaken=sum(e.mistaken for e in errors),
    )


def position_error_from_centroids(truth: DrogueTruth, errors: CentroidErrors) -> Array | None:
    """Position error that weighted least squares would make with these very centroids, to first order about the truth.

    Args:
        truth: the drogue.
        errors: of the centroids; those count on which the pose rests.

    Returns:
        (3,) estimate minus truth [m], or None where the centroids leave the pose open.
    """
    eye, feature = errors.eye[errors.used], errors.feature[errors.used]
    jacobian = truth.jacobian[eye, feature]
    root = np.sqrt(errors.weight[errors.used])[:, None]
    whitened = jacobian * root[..., None]
    covariance = pose_covariance(whitened)
    if covariance is None:
        return None
    gradient = np.einsum("kij,ki->j", whitened[..., :6], errors.offset_px[errors.used] * root)
    error: Array = (covariance @ gradient)[:3]
    return error


def feature_places(layout: MarkerLayout, features: Sequence[Feature]) -> NDArray[np.intp]:
    """(K,) places of measured features among the drogue's: the markers, then the hub.

    Raises:
        ValueError: a feature that the drogue does not have.
    """
    for feature in features:
        if feature.index == "hub":
            if layout.hub_center_m is None:
                raise ValueError("features: the drogue has no hub, got index 'hub'")
        elif not 0 <= feature.index < layout.count:
            raise ValueError(f"features: index must be 'hub' or in [0, {layout.count}), got {feature.index}")
    return np.array([layout.count if f.index == "hub" else f.index for f in features], dtype=np.intp)


def _weights(features: Sequence[Feature]) -> Array:
    variances = np.array([f.cov_px2[0][0] / 2 + f.cov_px2[1][1] / 2 for f in features], dtype=np.float64)
    if not (np.isfinite(variances) & (variances > 0)).all():
        return np.ones(len(features))
    # Only ratios count, and the inverse of a very small variance would not be finite.
    weights: Array = variances.min(initial=np.inf) / variances
    return weights


def _image_radii(truth: DrogueTruth) -> Array:
    """(2, M) radius of each feature's image if it faces the camera, to first order. [px]"""
    radii_m = np.append(np.full(truth.layout.count, truth.layout.radius_m), truth.layout.hub_outer_radius_m)
    radii: Array = np.broadcast_to(truth.rig.delivered_focal_px * radii_m / truth.distance_m, (2, len(radii_m)))
    return radii


def _coordinate_rms(offsets_px: Array) -> float | None:
    return float(np.sqrt(np.mean(np.square(offsets_px)))) if len(offsets_px) else None
