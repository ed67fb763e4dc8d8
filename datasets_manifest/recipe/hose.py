"""A hose with its drogue in the air stream: dimensions, masses, drag, and the flight condition; and those that ship."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from drogue_models.frozen_model import FrozenModel


class HoseParameters(FrozenModel):
    """A hose, the drogue at its end, and the air that both are dragged through.

    Attributes:
        name: of the preset that it comes from.
        length_m: from the pod's exit to the drogue's coupling. [m]
        diameter_m: outer. [m]
        mass_per_length_kg_m: of the hose, with the fuel in it. [kg/m]
        drogue_mass_kg: [kg]
        drogue_diameter_m: of the disc that its drag coefficient is meant for. [m]
        drogue_drag_coefficient: of the drogue.
        crossflow_drag_coefficient, skin_drag_coefficient: of the hose, for the air across and along it.
        airspeed_m_s: of tanker and receiver. [m/s]
        air_density_kg_m3: [kg/m3]
        turbulence_altitude_m: above ground, which sets scale and shape of the turbulence. [m]
    """

    name: str = Field(default="own", min_length=1, max_length=40)
    length_m: float = Field(gt=0.5, le=100)
    diameter_m: float = Field(gt=0, le=0.5)
    mass_per_length_kg_m: float = Field(gt=0, le=100)
    drogue_mass_kg: float = Field(gt=0, le=1000)
    drogue_diameter_m: float = Field(gt=0, le=5)
    drogue_drag_coefficient: float = Field(gt=0, le=3)
    crossflow_drag_coefficient: float = Field(default=1.1, ge=0, le=3)
    skin_drag_coefficient: float = Field(default=0.0035, ge=0, le=1)
    airspeed_m_s: float = Field(ge=0, le=300)
    air_density_kg_m3: float = Field(ge=0.05, le=1.5)
    turbulence_altitude_m: float = Field(ge=3, le=20_000)


# Values of a probe-and-drogue system of the fifty-foot class; from memory of the literature, not from a datasheet.
_FULL_SIZE = HoseParameters(
    name="full-size",
    length_m=15.0,
    diameter_m=0.067,
    mass_per_length_kg_m=4.1,
    drogue_mass_kg=29.5,
    drogue_diameter_m=0.61,
    drogue_drag_coefficient=0.8,
    airspeed_m_s=120.0,
    air_density_kg_m3=0.59,  # standard atmosphere at 6.9 km
    turbulence_altitude_m=6900.0,
)
# A pair of small rotorcraft as in the seed paper; the drogue's size is the paper's, hose and drag are our assumption.
_SMALL_UAV = HoseParameters(
    name="small-uav",
    length_m=4.0,
    diameter_m=0.02,
    mass_per_length_kg_m=0.25,
    drogue_mass_kg=3.0,
    drogue_diameter_m=0.66,
    drogue_drag_coefficient=0.8,
    airspeed_m_s=20.0,
    air_density_kg_m3=1.2,
    turbulence_altitude_m=100.0,
)

HOSES: dict[str, HoseParameters] = {hose.name: hose for hose in (_FULL_SIZE, _SMALL_UAV)}


def _resolve(value: Any) -> Any:
    """A preset's name, or a table that changes one, in full."""
    table = {"preset": value} if isinstance(value, str) else value
    if not isinstance(table, dict) or "preset" not in table:
        return value
    changes = {key: change for key, change in table.items() if key != "preset"}
    if not isinstance(table["preset"], str) or table["preset"] not in HOSES:
        raise ValueError(f"preset: no hose named {table['preset']!r}; there are {', '.join(HOSES)}")
    return {**HOSES[table["preset"]].model_dump(), **changes}


Hose = Annotated[HoseParameters, BeforeValidator(_resolve)]
"""In TOML the name of a preset, a table with `preset` and what differs from it, or all parameters."""
