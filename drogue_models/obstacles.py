"""Shapes of obstacles around a drogue: the receiver's probe, bars, and other round objects as distractors."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from pydantic import Field

from drogue_models.frozen_model import FrozenModel, Metres
from geometry.se3 import Array

OBSTACLE_SECTIONS = 64
# (radius, z) of a probe's nozzle over the radius of its tube: a bulb, then a waist (our choice of proportions).
PROBE_PROFILE = ((0.55, 0.0), (0.80, 0.12), (0.95, 0.35), (0.95, 1.6), (0.62, 2.2), (0.62, 5.2), (1.0, 6.0))


PlainForm = Literal["probe", "bar", "ball", "disc", "ring"]
ProbeForm = Literal["probe-straight", "probe-cranked", "probe-retractable", "probe-nose", "probe-boom"]
CockpitForm = Literal["nose", "canopy-frame", "glare-shield"]
DistractorBody = Literal["nacelle", "intake", "wheel", "antenna", "roundel", "lamp", "bird", "pod"]
PLAIN_FORMS: tuple[PlainForm, ...] = get_args(PlainForm)
PROBE_FORMS: tuple[ProbeForm, ...] = get_args(ProbeForm)
COCKPIT_FORMS: tuple[CockpitForm, ...] = get_args(CockpitForm)
DISTRACTOR_BODIES: tuple[DistractorBody, ...] = get_args(DistractorBody)


class ObstacleShape(FrozenModel):
    """An obstacle's dimensions, in its own axes.

    The plain forms are bodies of revolution about the z axis in one colour; the others are painted, see
    `drogue_models.surroundings`.

    Attributes:
        form: `probe` (tip at the origin, body along +z), `bar` (a rod along z around the origin), `ball`, `disc` (a
            thin round plate facing -z) or `ring` (a torus around z).
        radius_m: largest radius; of a ring that of its centre line. [m]
        length_m: of probe and bar, thickness of a disc; ignored otherwise. [m]
        tube_radius_m: of a ring's tube; ignored by the other plain forms. [m]
        seed: of a painted form's details and wear.
        mirrored: whether a painted form is that of the other side, such as a probe on the left.
    """

    form: PlainForm | ProbeForm | CockpitForm | DistractorBody
    radius_m: Metres
    length_m: float = Field(default=0.01, gt=0, le=50, allow_inf_nan=False)
    tube_radius_m: Metres = 0.05
    # Left out for the plain forms, so that the hashes of other datasets stay those of earlier versions.
    seed: int = Field(default=0, ge=0, exclude_if=lambda seed: seed == 0)
    mirrored: bool = Field(default=False, exclude_if=lambda mirrored: not mirrored)

    def profile_m(self) -> Array:
        """(P, 2) corners (radius, z) of a plain form's section, counter-clockwise with z up, radius to the right. [m]

        Raises:
            ValueError: the form is no body of revolution.
        """
        profile: Array
        match self.form:
            case "probe":
                nozzle = np.array(PROBE_PROFILE) * self.radius_m
                end_m = max(self.length_m, 1.5 * nozzle[-1, 1])
                profile = np.vstack([[0.0, 0.0], nozzle, [self.radius_m, end_m], [0.0, end_m]])
            case "bar" | "disc":
                low_m = -self.length_m / 2 if self.form == "bar" else 0.0
                high_m = low_m + self.length_m
                profile = np.array([[0.0, low_m], [self.radius_m, low_m], [self.radius_m, high_m], [0.0, high_m]])
            case "ball":
                angle = np.linspace(-np.pi / 2, np.pi / 2, OBSTACLE_SECTIONS // 2 + 1)
                profile = self.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
                # The cosine of a right angle is not exactly 0.
                profile[[0, -1], 0] = 0.0
            case "ring":
                angle = 2 * np.pi * np.arange(OBSTACLE_SECTIONS // 2) / (OBSTACLE_SECTIONS // 2)
                tube = self.tube_radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
                profile = np.array([self.radius_m, 0.0]) + tube
            case _:
                raise ValueError(f"form: {self.form} is no body of revolution")
        return profile
