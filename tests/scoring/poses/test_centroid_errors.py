from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.types.estimates import Feature
from droguekit.scoring.poses.centroid_errors import (
    centroid_errors,
    centroid_statistics,
    position_error_from_centroids,
    symmetric_orders,
)
from droguekit.scoring.poses.cramer_rao import feature_points, pose_bound
from droguekit.scoring.poses.drogue_truth import drogue_truth
from geometry.circles import disc_image_centers
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, StereoRig


def test_sigma_and_bias_are_those_of_the_noise(build: SimpleNamespace, rng: np.random.Generator) -> None:
    rows = []
    for index in range(60):
        record = build.record(index, build.pose(0.1, 0, 8, *rng.uniform(-10, 10, 2), 3))
        features = build.features(record, lambda: rng.normal([0.03, -0.02], 0.1))
        rows.append(centroid_errors(drogue_truth(record), features))
    statistics = centroid_statistics(rows)
    assert statistics.count == 60 * 16
    assert statistics.hub_count == 60 * 2
    # Root mean square of noise and bias; 1920 coordinates know it to 1.6 %, three of those.
    assert statistics.sigma_px == pytest.approx(np.sqrt(0.1**2 + (0.03**2 + 0.02**2) / 2), rel=0.05)
    # Standard error of the mean 0.1 / sqrt(960) = 0.0032; three of those.
    assert statistics.bias_u_px == pytest.approx(0.03, abs=0.01)
    assert statistics.bias_v_px == pytest.approx(-0.02, abs=0.01)
    assert statistics.bias_outward_px == pytest.approx(0, abs=0.01)
    assert statistics.mistaken == 0


@pytest.mark.parametrize("turn", range(8))
def test_numbering_modulo_the_symmetry_is_no_error(build: SimpleNamespace, turn: int) -> None:
    record = build.record(0, build.pose(0.1, 0, 8, 5, -6, 3))
    errors = centroid_errors(drogue_truth(record), build.features(record, lambda: (0.05, 0.0), turn=turn))
    # Rounding of pixel coordinates.
    np.testing.assert_allclose(errors.offset_px, [[0.05, 0.0]] * 18, atol=1e-10)


def test_each_renumbering_is_a_permutation(build: SimpleNamespace) -> None:
    for count in (5, 7, 8):
        record = build.record(0, build.pose(0, 0, 5), build.drogue(count))
        orders = symmetric_orders(drogue_truth(record).layout)
        assert len({tuple(order) for order in orders}) == count
        assert all(sorted(order) == list(range(count + 1)) for order in orders)


def test_outward_is_away_from_the_middle(build: SimpleNamespace) -> None:
    record = build.record(0, build.pose(0.1, 0, 8))
    truth = drogue_truth(record)
    features = []
    for feature in build.features(record, lambda: (0.0, 0.0)):
        if feature.index == "hub":
            continue
        eye = 0 if feature.eye == "left" else 1
        middle = truth.centers_px[eye, :8].mean(axis=0)
        arm = np.array(feature.center_px) - middle
        moved = np.array(feature.center_px) + 0.02 * arm / np.linalg.norm(arm)
        features.append(feature.model_copy(update={"center_px": tuple(moved)}))
    # Rounding of pixel coordinates.
    assert centroid_statistics([centroid_errors(truth, features)]).bias_outward_px == pytest.approx(0.02, abs=1e-10)


def test_a_measurement_of_something_else_is_counted_not_averaged(build: SimpleNamespace) -> None:
    record = build.record(0, build.pose(0.1, 0, 8))
    features = list(build.features(record, lambda: (0.1, 0.1)))
    # The image of a marker has a radius of 13 px there.
    features[3] = features[3].model_copy(update={"center_px": (features[3].center_px[0] + 15, 500.0)})
    statistics = centroid_statistics([centroid_errors(drogue_truth(record), features)])
    assert statistics.mistaken == 1
    assert statistics.count == 15
    assert statistics.sigma_px == pytest.approx(0.1, rel=1e-9)


def test_hidden_features_are_left_out(build: SimpleNamespace) -> None:
    record = build.record(0, build.pose(0.1, 0, 8))
    features = build.features(record, lambda: (0.1, 0.1))
    hidden = record.views.left.markers[2].model_copy(update={"visible_fraction": 0.5})
    left = record.views.left.model_copy(
        update={"markers": (*record.views.left.markers[:2], hidden, *record.views.left.markers[3:])}
    )
    record = record.model_copy(update={"views": record.views.model_copy(update={"left": left})})
    assert centroid_statistics([centroid_errors(drogue_truth(record), features)]).count == 15


def test_an_unknown_feature_is_named(build: SimpleNamespace) -> None:
    truth = drogue_truth(build.record(0, build.pose(0.1, 0, 8), build.drogue()))

    def feature(index: int | str) -> Feature:
        return Feature(eye="left", index=index, center_px=(1, 1), cov_px2=((1, 0), (0, 1)), used=True)

    with pytest.raises(ValueError, match=r"index must be 'hub' or in \[0, 8\), got 8"):
        centroid_errors(truth, [feature(8)])
    with pytest.raises(ValueError, match="the drogue has no hub"):
        centroid_errors(truth, [feature("hub")])


def test_no_features_have_no_statistics(build: SimpleNamespace) -> None:
    truth = drogue_truth(build.record(0, build.pose(0.1, 0, 8)))
    errors = centroid_errors(truth, ())
    assert centroid_statistics([errors]).sigma_px is None
    assert centroid_statistics([]).count == 0
    assert position_error_from_centroids(truth, errors) is None


def test_centroids_predict_the_error_of_least_squares(build: SimpleNamespace, rng: np.random.Generator) -> None:
    record = build.record(0, build.pose(0.4, -0.2, 6, 4, -7, 3))
    truth = drogue_truth(record)
    predicted = np.array(
        [
            position_error_from_centroids(
                truth, centroid_errors(truth, build.features(record, lambda: rng.normal(0, 0.05, 2)))
            )
            for _ in range(1500)
        ]
    )
    bound = 0.05 * pose_bound(truth.rig, truth.left_from_drogue, truth.layout, truth.visible)[:3]
    # A standard deviation of 1500 samples is known to 1.8 %; three of those.
    np.testing.assert_allclose(predicted.std(axis=0), bound, rtol=0.06)


def test_a_shift_of_the_pose_is_recovered_from_its_centroids(build: SimpleNamespace) -> None:
    """Centroids of a slightly moved drogue are explained by that move."""
    record, shift = build.record(0, build.pose(0.4, -0.2, 6, 4, -7, 3)), np.array([1e-4, -2e-4, 1e-3])
    moved = build.record(0, build.pose(*(np.array([0.4, -0.2, 6]) + shift), 4, -7, 3))
    truth = drogue_truth(record)
    errors = centroid_errors(truth, build.features(moved, lambda: (0.0, 0.0)))
    # The neglected second order is shift^2 / Z ~ 2e-7.
    np.testing.assert_allclose(position_error_from_centroids(truth, errors), shift, atol=1e-6)


def test_a_shift_is_recovered_from_the_delivered_images_of_lenses(build: SimpleNamespace) -> None:
    ideal, shift = build.rig, np.array([1e-4, -2e-4, 1e-3])
    lens = Lens(PinholeCamera(1280, 960, 2560.0, 2560.0, 639.5, 479.5), BrownConrady(-0.2))
    rig = StereoRig(ideal.camera, ideal.baseline_m, lenses=(lens, lens))
    record, pose = build.record(0, build.pose(0.4, -0.2, 6, 4, -7, 3)), build.pose(0.4, -0.2, 6, 4, -7, 3)
    centers_m, radii_m = feature_points(drogue_truth(record).layout)

    def delivered_px(at: RigidTransform) -> np.ndarray:
        return np.stack([disc_image_centers(rig, at, centers_m, radii_m, eye) for eye in EYES])

    truth = replace(drogue_truth(record), rig=rig, centers_px=delivered_px(pose))
    moved = delivered_px(RigidTransform(pose.rotation, pose.translation_m + shift))
    features = [
        Feature(
            eye=eye,
            index="hub" if place == truth.layout.count else place,
            center_px=tuple(moved[side, place]),
            cov_px2=((1e-4, 0.0), (0.0, 1e-4)),
            used=True,
        )
        for side, eye in enumerate(EYES)
        for place in range(len(centers_m))
    ]
    predicted = position_error_from_centroids(truth, centroid_errors(truth, features))
    # A focal length that is 20 % off would make the depth 20 % wrong; the shift's second order is 2e-7.
    np.testing.assert_allclose(predicted, shift, atol=1e-6)


@pytest.mark.parametrize("variance_px2", [1e-310, 1e-305, 1e-300, 1e300])
def test_only_the_ratio_of_the_variances_counts(build: SimpleNamespace, variance_px2: float) -> None:
    record = build.record(0, build.pose(0.4, -0.2, 6, 4, -7, 3))
    truth, rng = drogue_truth(record), np.random.default_rng(1)
    features = build.features(record, lambda: rng.normal(0, 0.05, 2))

    def predicted(scale_px2: float) -> np.ndarray:
        covariances = [((k * scale_px2, 0.0), (0.0, k * scale_px2)) for k in range(1, len(features) + 1)]
        given = [f.model_copy(update={"cov_px2": each}) for f, each in zip(features, covariances, strict=True)]
        return position_error_from_centroids(truth, centroid_errors(truth, given))

    # Rounding; numbers below 2e-308 have fewer digits, at 1e-310 thirteen.
    np.testing.assert_allclose(predicted(variance_px2), predicted(1.0), rtol=1e-6)


@pytest.mark.parametrize("variance_px2", [0.0, np.inf])
def test_measurements_without_proper_variances_weigh_the_same(build: SimpleNamespace, variance_px2: float) -> None:
    record = build.record(0, build.pose(0.4, -0.2, 6, 4, -7, 3))
    wrong = ((variance_px2, 0.0), (0.0, variance_px2))
    first, *others = build.features(record, lambda: (0.1, 0.1))
    errors = centroid_errors(drogue_truth(record), [first.model_copy(update={"cov_px2": wrong}), *others])
    assert errors.weight.tolist() == [1.0] * 18
