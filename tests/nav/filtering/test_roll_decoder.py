"""Blinking lamps tell apart the rolls that an even ring leaves open."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.estimates import Feature, PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters, MarkerCode, even_ring
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_rotation
from geometry.stereo import EYES, StereoRig
from nav.filtering.roll_decoder import DecodedRoll, RollDecoder, likelihoods, with_decoded_roll
from nav.runner import add_smoothed, open_navigator
from nav.sequence_navigator import SequenceSettings

COUNT, PERIOD_S = 12, 0.04
CHASE = tuple("".join("01"[slot != lamp] for slot in range(COUNT)) for lamp in range(COUNT))
# Two lamps opposite each other are dark in every slot: one pair leaves two turns open, and so do all others.
OPPOSITE = tuple("".join("01"[slot != lamp % 6] for slot in range(6)) for lamp in range(COUNT))
RIG = StereoRig(PinholeCamera(fx_px=600.0, fy_px=600.0, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240), 0.2)


def lamps(patterns: tuple[str, ...]) -> DrogueParameters:
    return DrogueParameters(
        name="coded",
        rim_radius_m=0.305,
        face_inner_radius_m=0.25,
        marker_positions_m=even_ring(COUNT, 0.28),
        marker_radius_m=0.01,
        marker_luminance_cd_m2=20_000.0,
        marker_emission_rgb=(1.0, 1.0, 1.0),
        marker_code=MarkerCode(slot_s=PERIOD_S, patterns=patterns),
    )


def pose(roll_deg: float, distance_m: float = 3.0) -> RigidTransform:
    tilt, roll = exp_rotation(np.array([0.1, -0.15, 0.0])), exp_rotation(np.array([0.0, 0.0, np.radians(roll_deg)]))
    return RigidTransform(tilt @ roll, np.array([0.1, 0.05, distance_m]))


def pair(drogue: DrogueParameters, true_pose: RigidTransform, index: int, contrast: float = 800.0) -> StereoImages:
    """Spots of light of one width where lamps are, half as bright where a lamp is dark: by day its disc reflects."""
    rng = np.random.default_rng(index)
    lit = drogue.lit_fractions(index * PERIOD_S, 0.002)
    views = []
    for eye in EYES:
        y, x = np.indices((240, 320))
        view = rng.normal(400.0, 20.0, (240, 320))
        for (column, row), share in zip(RIG.image(true_pose.apply(drogue.marker_centers_m), eye), lit, strict=True):
            view += contrast * (0.5 + 0.5 * share) * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 2)
        views.append(np.clip(view, 0, 4095).astype(np.uint16))
    return StereoImages(views[0], views[1], index * PERIOD_S, 0.002, bits=12)


def blind_pair(drogue: DrogueParameters, true_pose: RigidTransform, index: int) -> BlindPair:
    return BlindPair(index, pair(drogue, true_pose, index), RIG, drogue)


def roll_error_deg(found: RigidTransform, truth: RigidTransform) -> float:
    turn = truth.rotation.T @ found.rotation
    return float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))


@pytest.mark.parametrize("roll_deg", [-160.0, -31.0, 0.0, 75.0, 130.0])
def test_one_pair_tells_the_roll_of_a_ring_with_one_dark_lamp(roll_deg: float) -> None:
    drogue = lamps(CHASE)
    given = pose((roll_deg + 15) % 30 - 15)
    decoded = RollDecoder(RIG, drogue).decode(pair(drogue, pose(roll_deg), 4), given)
    assert abs(roll_error_deg(decoded.left_from_drogue, pose(roll_deg))) < 1e-9
    assert decoded.probability > 0.95


def test_faint_pairs_count_together_while_the_drogue_rolls_and_its_given_roll_jumps() -> None:
    drogue, decoder, rng = lamps(CHASE), RollDecoder(RIG, lamps(CHASE)), np.random.default_rng(5)
    probabilities = []
    for index in range(30):
        true_pose = pose(100.0 + 3.0 * index)
        given = pose(100.0 + 3.0 * index + 30.0 * rng.integers(12))
        decoded = decoder.decode(pair(drogue, true_pose, index, contrast=40.0), given)
        probabilities.append(decoded.probability)
    assert probabilities[0] < 0.9 and probabilities[-1] > 0.99
    assert abs(roll_error_deg(decoded.left_from_drogue, true_pose)) < 1e-9


def test_a_code_that_half_a_turn_repeats_leaves_two_rolls() -> None:
    drogue, decoder = lamps(OPPOSITE), RollDecoder(RIG, lamps(OPPOSITE))
    for index in range(10):
        decoded = decoder.decode(pair(drogue, pose(75.0), index), pose(-15.0))
    assert decoded.probability == pytest.approx(0.5, abs=0.01)
    assert abs(roll_error_deg(decoded.left_from_drogue, pose(75.0))) % 180 < 1e-9


def test_another_flight_begins_anew() -> None:
    drogue, decoder = lamps(OPPOSITE), RollDecoder(RIG, lamps(OPPOSITE))
    all_lit = lamps(("1",))
    for index in range(5):
        decoder.decode(pair(drogue, pose(0.0), index), pose(0.0))
    jumped = decoder.decode(pair(all_lit, pose(0.0, 8.0), 5, contrast=0.0), pose(0.0, 8.0))
    assert jumped.probability < 0.5


def test_likelihoods_are_those_of_two_levels() -> None:
    """Of two statements the right one fits exactly, the other leaves what two levels of its groups leave."""
    lit = np.array([[0.0, 1.0, 1.0, 1.0], [1.0, 0.0, 1.0, 1.0]])
    light = np.array([[1.0, 3.0, 3.1, 2.9], [np.nan] * 4])
    # The wrong statement would need darkness to shine; at best it has one level, with the light's own scatter.
    rest = ((light[0] - light[0].mean()) ** 2).sum() / light[0].mean() ** 2
    best = (0.1**2 + 0.1**2) / light[0].mean() ** 2
    expected = np.exp(-(rest - best) / (2 * max(best / 2, 0.03**2)))
    chances = likelihoods(light, lit)
    assert chances.sum() == pytest.approx(1.0)
    assert chances[1] == pytest.approx(0.98 * expected / (1 + expected) + 0.01)


def test_markers_keep_their_places_when_the_pose_is_turned() -> None:
    drogue = lamps(CHASE)
    centers_m = marker_layout(drogue).centers_m
    given, true_pose = pose(-10.0), pose(-10.0 + 30.0 * 7)
    features = tuple(
        Feature(eye="left", index=index, center_px=(x, y), cov_px2=((1, 0), (0, 1)), used=True)
        for index, (x, y) in enumerate(RIG.image(given.apply(centers_m), "left").tolist())
    )
    estimate = PoseEstimate(frame_index=0, method="joint", left_from_drogue=given, features=features)
    turned = with_decoded_roll(estimate, drogue, DecodedRoll(true_pose, 0.9))
    assert isinstance(turned, PoseEstimate) and turned.roll_probability == 0.9
    assert np.allclose(turned.left_from_drogue.rotation, true_pose.rotation, atol=1e-12)
    places = RIG.image(turned.left_from_drogue.apply(centers_m), "left")
    for feature in turned.features:
        assert isinstance(feature.index, int)
        assert np.allclose(places[feature.index], feature.center_px, atol=1e-9)


def test_a_navigated_flight_has_the_true_roll_measured_filtered_and_smoothed() -> None:
    drogue = lamps(CHASE)
    poses = [pose(100.0 + 2.0 * index, 3.0 - 0.02 * index) for index in range(6)]
    settings = SequenceSettings(("joint",), filtered=True, smoothed=True)
    navigator = open_navigator(settings, "peak-ring")
    pairs = [navigator.process(blind_pair(drogue, true_pose, index)) for index, true_pose in enumerate(poses)]
    estimates = list(add_smoothed(pairs, settings))
    assert [estimate.method for estimate in estimates].count("joint+smoother") == 6
    for estimate in estimates:
        assert isinstance(estimate, PoseEstimate) and estimate.roll_probability is not None
        assert estimate.roll_probability > 0.95
        # A wrong turn is off by 30 degrees; spots of noisy light tell the roll to tenths.
        assert abs(roll_error_deg(estimate.left_from_drogue, poses[estimate.frame_index])) < 1
        places = RIG.image(poses[estimate.frame_index].apply(drogue.marker_centers_m), "left")
        for feature in estimate.features:
            if feature.eye == "left" and isinstance(feature.index, int):
                assert np.linalg.norm(places[feature.index] - feature.center_px) < 1


def test_markers_are_numbered_by_the_roll_of_each_estimate() -> None:
    """Pairs are numbered by the roll nearest to zero; filter and smoother follow it beyond half a symmetry angle."""
    drogue = lamps(CHASE).model_copy(update={"marker_code": None})
    poses = [pose(9.0 + 2.0 * index) for index in range(8)]
    settings = SequenceSettings(("joint",), filtered=True, smoothed=True)
    navigator = open_navigator(settings, "peak-ring")
    pairs = [navigator.process(blind_pair(drogue, true_pose, index)) for index, true_pose in enumerate(poses)]
    rolls_deg = dict[str, list[float]]()
    for estimate in add_smoothed(pairs, settings):
        assert isinstance(estimate, PoseEstimate)
        found = estimate.left_from_drogue
        rolls_deg.setdefault(estimate.method, []).append(roll_error_deg(found, pose(0.0)))
        for eye in EYES:
            places = RIG.image(found.apply(drogue.marker_centers_m), eye)
            marked = [(places[f.index], f.center_px) for f in estimate.features if f.eye == eye and f.index != "hub"]
            assert len(marked) > COUNT / 2
            # Another number is off by a marker's distance of 29 px; the filter trails by a fraction of a pixel.
            assert max(np.linalg.norm(np.subtract(*each)) for each in marked) < 2
    # The measured roll jumps back by 30 degrees; the others go on.
    assert min(np.diff(rolls_deg["joint"])) < -20
    assert all(min(np.diff(rolls_deg[f"joint+{kind}"])) > 0 for kind in ("filter", "smoother"))
