"""Tells by the blinking of lamps which of the rolls that the markers' symmetry leaves open is the true one.

The pose of a ring of equal lamps is known up to turns that map the ring onto itself. Each turn says which lamps are lit
in an exposure, and the light at their places tells how likely that is. From pair to pair the pose is followed by the
nearest roll, so that the pairs of a sequence count together.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.bilinear_sampling import sample_bilinear
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from nav.filtering.measurement_update import nearest_roll, rolled, steps_to_roll
from nav.matching.marker_channel import marker_channel, marker_color
from nav.matching.ring_matching import symmetry_permutations

# The mean over a spot of this spread stands for a lamp's light: half its radius, but a pixel's blur at least. [px]
_LEAST_SPREAD_PX, _MOST_SPREAD_PX = 0.7, 4.0
# Lamps of one state differ by this share of their light without any noise: by background, shade and clipping.
_LEAST_DEVIATION = 0.03
# Two unknown levels of light take as many lamps.
_LEAST_LAMPS = 3
# Statements that hardly tell lamps apart explain nothing.
_LEAST_POWER = 1e-6
# A pair says nothing with this probability: its pose is wrong, or something stands before the lamps.
_WORTHLESS_PAIR = 0.02
# Poses of one flight do not move by more between pairs; the roll cannot be followed beyond.
_MOST_SPEED_M_S, _MOST_AXIS_STEP_RAD, _LONGEST_GAP_S = 60.0, 0.35, 0.5
# The roll is followed to a wrong neighbour about once in so many pairs.
_PAIRS_PER_SLIP = 1000.0


@dataclass(frozen=True, eq=False)
class DecodedRoll:
    """The likeliest of the rolls that the markers' symmetry leaves open.

    Attributes:
        left_from_drogue: pose of a pair with this roll.
        probability: of the roll.
    """

    left_from_drogue: RigidTransform
    probability: float


class RollDecoder:
    """Decides between the rolls of a drogue whose lamps blink, from pair to pair."""

    def __init__(self, rig: StereoRig, drogue: DrogueParameters) -> None:
        """Prepare for the first pair; all rolls are equally likely."""
        self._rig, self._drogue = rig, drogue
        self._layout = marker_layout(drogue)
        self._permutations = symmetry_permutations(self._layout)
        self._last: tuple[float, RigidTransform] | None = None
        self._probabilities = self._unknown()

    def _unknown(self) -> Array:
        order = len(self._permutations)
        return np.full(order, 1.0 / order)

    def decode(self, images: StereoImages, pose: RigidTransform) -> DecodedRoll:
        """The pose with the likeliest roll by this pair and those before.

        Args:
            images: the next pair.
            pose: its `left_from_drogue`, modulo the markers' symmetry.
        """
        order = len(self._permutations)
        if self._last is None or not _is_one_flight(*self._last, images.time_s, pose):
            self._probabilities = self._unknown()
        else:
            pose = nearest_roll(pose, self._last[1].rotation, order)
            self._probabilities = self._probabilities + (1 / order - self._probabilities) / _PAIRS_PER_SLIP
        self._last = images.time_s, pose
        lit = np.array(self._drogue.lit_fractions(images.time_s, images.exposure_s))
        brightness = np.stack([self._brightness(images, pose, eye) for eye in EYES])
        self._probabilities = self._probabilities * likelihoods(brightness, lit[self._permutations])
        self._probabilities = self._probabilities / self._probabilities.sum()
        turn = int(np.argmax(self._probabilities))
        return DecodedRoll(rolled(pose, turn, order), float(self._probabilities[turn]))

    def _brightness(self, images: StereoImages, pose: RigidTransform, eye: Eye) -> Array:
        """(N,) light of the markers' colour at their places; NaN outside the image. [DN]"""
        places = self._rig.image(pose.apply(self._layout.centers_m), eye)
        width, height = images.size_px
        radius_px = self._rig.delivered_focal_px * self._layout.radius_m / max(float(pose.translation_m[2]), 1e-9)
        spread_px = float(np.clip(radius_px / 2, _LEAST_SPREAD_PX, _MOST_SPREAD_PX))
        inside = ((places >= 0) & (places <= (width - 1, height - 1))).all(axis=1)
        light = np.full(len(places), np.nan)
        if not inside.any():
            return light
        reach = int(np.ceil(4 * spread_px)) + 1
        left, top = np.maximum(np.floor(places[inside].min(axis=0)).astype(int) - reach, 0)
        right, bottom = np.ceil(places[inside].max(axis=0)).astype(int) + reach + 1
        window = (int(left), int(top), min(int(right), width), min(int(bottom), height))
        channel = marker_channel(images, eye, marker_color(self._drogue), window=window).astype(np.float32)
        smooth = cv2.GaussianBlur(channel, (0, 0), spread_px)
        column, row = (places[inside] - window[:2]).astype(np.float32).T
        light[inside] = sample_bilinear(smooth, column[None], row[None], cv2.BORDER_REPLICATE)[0]
        return light


def likelihoods(brightness: Array, lit: Array) -> Array:
    """(K,) likelihoods of K statements which lamps are lit, up to a common factor.

    The light of each eye's lamps is one level, and another one or more where they are lit, both unknown. Their scatter
    is that of the best statement.

    Args:
        brightness: (E, N) light of the lamps in each eye, NaN where unknown.
        lit: (K, N) by each statement the share of the exposure in which a lamp is lit.
    """
    rests, unknowns, count = np.zeros(len(lit)), 0, 0
    for light in brightness:
        known = np.isfinite(light)
        if known.sum() < _LEAST_LAMPS:
            continue
        deviations = light[known] - light[known].mean()
        states = lit[:, known] - lit[:, known].mean(axis=1, keepdims=True)
        power = (states**2).sum(axis=1)
        differ = power > _LEAST_POWER
        slope = np.where(differ, np.maximum(states @ deviations, 0.0) / np.where(differ, power, 1.0), 0.0)
        level = max(float(np.abs(light[known]).mean()), 1e-9)
        rests += ((deviations - slope[:, None] * states) ** 2).sum(axis=1) / level**2
        unknowns, count = unknowns + 2, count + int(known.sum())
    variance = max(float(rests.min()) / max(count - unknowns, 1), _LEAST_DEVIATION**2)
    chances = np.exp(-(rests - rests.min()) / (2 * variance))
    chances = chances / chances.sum()
    shared: Array = chances * (1 - _WORTHLESS_PAIR) + _WORTHLESS_PAIR / len(lit)
    return shared


def with_decoded_roll(estimate: Estimate, drogue: DrogueParameters, roll: DecodedRoll | None) -> Estimate:
    """A measured estimate turned to the decoded roll, with its markers renumbered.

    Args:
        estimate: of the pair; stays as it is without a pose.
        drogue: with blinking lamps.
        roll: of the pair, or None where nothing is to be turned.
    """
    if roll is None or not isinstance(estimate, PoseEstimate):
        return estimate
    return with_own_numbers(turned_to(estimate, drogue, roll), estimate, drogue)


def with_own_numbers(estimate: PoseEstimate, measured: PoseEstimate, drogue: DrogueParameters) -> PoseEstimate:
    """An estimate whose markers are numbered by its own roll.

    Args:
        estimate: with the markers of the measured one, rolled against it by any number of symmetry angles.
        measured: of the same pair.
        drogue: whose markers they are.
    """
    layout = marker_layout(drogue)
    rotations = measured.left_from_drogue.rotation, estimate.left_from_drogue.rotation
    turn = steps_to_roll(*rotations, layout.symmetry_order) % layout.symmetry_order
    if turn == 0:
        return estimate
    new_index = symmetry_permutations(layout)[turn]
    features = tuple(
        feature if feature.index == "hub" else feature.model_copy(update={"index": int(new_index[feature.index])})
        for feature in estimate.features
    )
    return estimate.model_copy(update={"features": features})


def turned_to(estimate: PoseEstimate, drogue: DrogueParameters, roll: DecodedRoll) -> PoseEstimate:
    """An estimate, measured, filtered or smoothed, turned to the decoded roll; its markers keep their numbers."""
    wanted, order = roll.left_from_drogue.rotation, marker_layout(drogue).symmetry_order
    modes = tuple(
        mode.model_copy(update={"left_from_drogue": nearest_roll(mode.left_from_drogue, wanted, order)})
        for mode in estimate.modes
    )
    pose = nearest_roll(estimate.left_from_drogue, wanted, order)
    return estimate.model_copy(update={"left_from_drogue": pose, "modes": modes, "roll_probability": roll.probability})


def _is_one_flight(before_s: float, before: RigidTransform, now_s: float, now: RigidTransform) -> bool:
    """Whether the roll can be followed from one pose to the next."""
    step_s = now_s - before_s
    if not 0 < step_s <= _LONGEST_GAP_S:
        return False
    moved_m = float(np.linalg.norm(now.translation_m - before.translation_m))
    cosine = float(now.rotation[:, 2] @ before.rotation[:, 2])
    return moved_m <= _MOST_SPEED_M_S * step_s and cosine >= np.cos(_MOST_AXIS_STEP_RAD)
