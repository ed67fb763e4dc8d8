"""What a tanker is: its type, where the hose leaves it, its paint, and the state of its flaps, lamps and propellers."""

from __future__ import annotations

from typing import Literal, NamedTuple, Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel

TankerType = Literal[
    "four-jet",
    "twin-jet-wide",
    "four-turboprop",
    "twin-jet-high-wing",
    "fighter",
    "tilt-rotor",
    "unmanned",
    "multirotor",
]
Station = Literal["left-pod", "right-pod", "centreline", "buddy-store", "belly"]
PaintScheme = Literal[
    "light-grey", "medium-grey", "white-cheat-line", "dark-grey", "desert", "olive", "navy", "trainer", "carbon"
]
PodLight = Literal["off", "red", "amber", "green"]

STATIONS: dict[TankerType, tuple[Station, ...]] = {
    "four-jet": ("left-pod", "right-pod", "centreline"),
    "twin-jet-wide": ("left-pod", "right-pod", "centreline"),
    "four-turboprop": ("left-pod", "right-pod"),
    "twin-jet-high-wing": ("left-pod", "right-pod"),
    "fighter": ("buddy-store",),
    "tilt-rotor": ("centreline",),
    "unmanned": ("buddy-store",),
    "multirotor": ("belly",),
}
"""Where the hose can leave each type."""


class Propellers(NamedTuple):
    """What turns on a type of tanker.

    Attributes:
        blades: of each propeller.
        rate_deg_s: in flight. [deg/s]
    """

    blades: int
    rate_deg_s: float


PROPELLERS: dict[TankerType, Propellers] = {
    "four-turboprop": Propellers(6, 6.0 * 1020),  # R391 at 1020 rpm, EASA TCDS P.003
    "tilt-rotor": Propellers(3, 6.0 * 333),  # V-22 cruise: 84 % of 397 rpm
    "multirotor": Propellers(2, 6.0 * 4000),  # our estimate of a hovering quadcopter of 5 kg with propellers of 17 in
}
"""Types with propellers or rotors."""


class Tanker(FrozenModel):
    """One tanker; every field is the same for all frames of a scene but those of the blades.

    Tanker frame: x aft, y along the right wing, z up, origin where the hose leaves, whatever the station.

    Attributes:
        type: planform, see `planforms`.
        station: where the hose leaves; `belly` is the multirotor's.
        paint: scheme of the whole aircraft.
        seed: of the pattern of panels, stains and wear.
        flaps_deg: deflection of the flaps; ignored by the multirotor. [deg]
        nav_lights: whether the red, green and white navigation lights shine.
        pod_light: the lamp beside the hose's exit that shines.
        blade_phase_deg: position of the propellers' first blade, from up. [deg]
        blade_sweep_deg: angle through which propellers turn during the exposure: 0 freezes the blades, 360 divided by
            their number makes an even disc. [deg]
    """

    type: TankerType
    station: Station
    paint: PaintScheme = "light-grey"
    seed: int = Field(default=0, ge=0, lt=2**31)
    flaps_deg: float = Field(default=0.0, ge=0, le=40)
    nav_lights: bool = True
    pod_light: PodLight = "off"
    blade_phase_deg: float = Field(default=0.0, ge=0, lt=360)
    blade_sweep_deg: float = Field(default=0.0, ge=0, le=180)

    @model_validator(mode="after")
    def _has_station(self) -> Self:
        if self.station not in STATIONS[self.type]:
            raise ValueError(f"station: {self.type} has {', '.join(STATIONS[self.type])}, got {self.station!r}")
        return self
