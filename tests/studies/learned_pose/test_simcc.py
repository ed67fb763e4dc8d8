"""Coordinates as distributions over bins, and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import truncnorm

from studies.learned_pose.keypoint_network import KeypointNetwork, simcc_loss
from studies.learned_pose.simcc import BINS, BINS_PER_PX, SIGMA_BINS, WINDOW_BINS, bin_of, decode, encode


def log(distributions: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(distributions, 1e-30)).astype(np.float32)


def round_trip_limit_px() -> float:
    """Shift of the mean of a Gaussian cut at the window, whose middle is half a bin off the Gaussian's at most."""
    low, high = (-(WINDOW_BINS + 1) / SIGMA_BINS, WINDOW_BINS / SIGMA_BINS)
    return abs(float(truncnorm(low, high, scale=SIGMA_BINS).mean())) / BINS_PER_PX


def test_decoding_undoes_encoding() -> None:
    points = np.random.default_rng(0).uniform(20, 235, (8, 2))
    found = decode(log(encode(points)))
    limit_px = round_trip_limit_px()
    assert limit_px < 1e-3
    # Logarithms in single precision of up to 70 add 4e-6 of each weight.
    np.testing.assert_allclose(found.points_px, points, atol=limit_px + 1e-4)
    assert found.shares.min() > 0.999


def test_bins_cover_the_crop_evenly() -> None:
    # The first pixel's corners, -0.5 and 0.5, are the outer edges of its bins 0 and 1.
    np.testing.assert_allclose(bin_of(np.array([-0.5, 0.5])), [-0.5, 1.5])
    assert bin_of(np.array([255.5]))[0] == BINS - 0.5


def test_targets_are_distributions_even_outside_the_crop() -> None:
    targets = encode(np.array([[10.0, 100.0], [-80.0, 300.0]]))
    assert targets.shape == (2, 2, BINS)
    # Single precision of a sum of 512.
    np.testing.assert_allclose(targets.sum(axis=-1), 1, atol=1e-5)
    assert np.argmax(targets[0, 1]) == 0 and np.argmax(targets[1, 1]) == BINS - 1


def test_a_second_peak_does_not_pull_but_lowers_the_share() -> None:
    here, there = encode(np.array([[60.0, 60.0]])), encode(np.array([[150.0, 90.0]]))
    found = decode(log(0.7 * here + 0.3 * there))
    np.testing.assert_allclose(found.points_px, [[60.0, 60.0]], atol=round_trip_limit_px() + 1e-4)
    assert found.shares[0] == pytest.approx(0.7, abs=1e-3)


def test_the_loss_is_least_at_the_targets() -> None:
    targets = torch.from_numpy(encode(np.random.default_rng(1).uniform(30, 220, (8, 2))))[None]
    at_target = float(simcc_loss(torch.log(targets.clamp_min(1e-30)), targets))
    entropy = float(-(targets * torch.log(targets.clamp_min(1e-30))).sum(dim=-1).mean())
    assert at_target == pytest.approx(entropy, abs=1e-4)
    assert at_target == pytest.approx(np.log(SIGMA_BINS * np.sqrt(2 * np.pi * np.e)), abs=1e-3)
    moved = torch.roll(torch.log(targets.clamp_min(1e-30)), 1, dims=-1)
    # The divergence of two Gaussians one bin apart.
    assert float(simcc_loss(moved, targets)) - at_target == pytest.approx(1 / (2 * SIGMA_BINS**2), rel=0.02)


def test_the_network_answers_for_every_keypoint() -> None:
    torch.manual_seed(0)
    with torch.inference_mode():
        assert KeypointNetwork(5).eval()(torch.rand(2, 3, 256, 256)).shape == (2, 2, 5, BINS)
