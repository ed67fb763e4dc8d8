"""An airframe as a whole: its surfaces, propellers and lamps, and the places that paint and hoses refer to."""

from __future__ import annotations

from dataclasses import dataclass

from drogue_models.tankers.airframe_grids import SurfaceGrid, WingStation, tapered
from drogue_models.tankers.equipment import Rotor, pod, pylon
from drogue_models.tankers.tanker import Station

Place = tuple[float, float, float]


@dataclass(frozen=True)
class SourceDimension:
    """A published dimension that the airframe must keep.

    Attributes:
        what: `length`, `span`, `height`, or the role of a surface with `_span` or `_width` after it.
        value_m: as published. [m]
        source: where.
    """

    what: str
    value_m: float
    source: str


@dataclass(frozen=True)
class Trail:
    """Soot or oil that flows aft over whatever lies behind its start.

    Attributes:
        start_m: (3,) in body axes.
        width_m: at its start; it widens aft.
        length_m: after which a third is left.
        strength: share of the paint that it hides at most.
        oil: brownish and streaky instead of black.
    """

    start_m: Place
    width_m: float
    length_m: float
    strength: float
    oil: bool = False


@dataclass(frozen=True)
class Roundel:
    """A round marking on the surface of one role.

    Attributes:
        role: of the surface.
        center_m: (3,) in body axes, of the right one on both sides.
        radius_m: of the outer ring.
        normal_axis: 1 on a body's sides and on fins, 2 on wings.
        below: whether a wing carries it below instead of above.
    """

    role: str
    center_m: Place
    radius_m: float
    normal_axis: int
    below: bool = False


@dataclass(frozen=True, eq=False)
class Airframe:
    """All of an aircraft in body axes: x aft from the nose, y along the right wing, z up. [m]

    Attributes:
        grids: painted surfaces; a mirrored one is given once.
        rotors: propellers.
        stations_m: where the hose leaves, by station.
        nav_lights_m: left, right and tail lamp.
        nav_light_radius_m: of each.
        dimensions: published ones.
        trails: soot and oil.
        roundels: markings.
        panel_m: mean size of skin panels.
        deck_m: x range of the fuselage's windscreen, and its lowest z; or None.
        belt_z_m: height of windows and cheat line on the fuselage.
        belly_line_m: x range of a line along the belly, or None.
        pod_lights: whether a collar with lamps surrounds the hose's exit.
    """

    grids: tuple[SurfaceGrid, ...]
    rotors: tuple[Rotor, ...]
    stations_m: dict[Station, Place]
    nav_lights_m: tuple[Place, Place, Place]
    dimensions: tuple[SourceDimension, ...]
    nav_light_radius_m: float = 0.06
    trails: tuple[Trail, ...] = ()
    roundels: tuple[Roundel, ...] = ()
    panel_m: float = 1.6
    deck_m: tuple[float, float, float] | None = None
    belt_z_m: float = 0.4
    belly_line_m: tuple[float, float] | None = None
    pod_lights: bool = True


def wing_pod(
    stations: list[WingStation], y_m: float, size_m: tuple[float, float], drop_m: float, aft: float = 0.9
) -> tuple[list[SurfaceGrid], Place]:
    """A pod with its pylon under a wing, mirrored on the other side.

    Args:
        stations: of the wing.
        y_m: of the pod.
        size_m: length and radius of the pod.
        drop_m: of the pod's axis below the wing's chord line.
        aft: where the hose leaves, as a share of the wing's chord.

    Returns:
        The surfaces, and where the hose leaves on the right.
    """
    wing = tapered(stations, y_m)
    exit_m = (wing.x_m + aft * wing.chord_m, y_m, wing.z_m - drop_m)
    length_m, radius_m = size_m
    surfaces = [part.moved(exit_m) for part in pod(length_m, radius_m, mirrored=True)]
    nose_m, chord_m = exit_m[0] - 0.80 * length_m, 0.62 * length_m
    high_z_m = wing.z_m + 0.005 * wing.chord_m
    surfaces.append(
        pylon(
            (nose_m, y_m, exit_m[2] + 0.4 * radius_m, chord_m),
            (
                nose_m + 0.25 * drop_m,
                y_m,
                high_z_m,
                min(chord_m, wing.x_m + 0.74 * wing.chord_m - nose_m - 0.25 * drop_m),
            ),
            mirrored=True,
        )
    )
    return surfaces, exit_m


def left_of(place: Place) -> Place:
    """The same place on the left side."""
    return (place[0], -place[1], place[2])


def oil_trails(places: tuple[Place, ...]) -> list[Trail]:
    """Fuel and oil behind each hose's exit, and along the pod before it."""
    return [Trail((x - 3.0, y, z - 0.2), 0.22, 3.0, 0.45, oil=True) for x, y, z in places]
