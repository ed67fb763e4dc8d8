"""The shape of a trailed hose at rest in the air stream, as a chain of links that resist bending.

Axes are the tanker's: x aft, y right wing, z up, origin where the hose leaves. Weight and drag act on every link, and
the drogue pulls at the lower end. A link i of length h_i is at rest when the moments about its middle vanish:

    u_i x [h_i F_i + EI (u_(i+1) / g_i + u_(i-1) / g_(i-1))] = 0

with its direction u_i, the force F_i in its middle, the bending stiffness EI and the distances g between the middles of
neighbouring links. That is Euler's and Bernoulli's beam under tension, EI d2u/ds2 + F = (tension) u (S. Timoshenko,
Strength of Materials part II, "beams under axial load"), in the discrete form of Bergou et al. 2008,
doi:10.1145/1360612.1360662. Without bending stiffness it is the chain of `HoseModel.equilibrium`. Tension keeps the
bending near the ends, within a few times sqrt(EI / tension): 0.2 m for the full-size hose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root

from datasets_manifest.recipe.sequence_ranges import HoseParameters
from datasets_manifest.types.field_types import Range
from geometry.se3 import Array
from scenes.flight.hose_dynamics import GRAVITY_M_S2

HOSE_LINKS = 36
# Stiff fittings of two links each hold the hose along the axes of the exit and of the coupling.
FITTED_LINKS = 2
FITTING_M = 0.12
_FREE_LINKS = HOSE_LINKS - 2 * FITTED_LINKS
# A reinforced rubber hose of 67 mm with a bore of 51 mm and an effective modulus of 90 MPa; our estimate.
_STIFFNESS_N_M2, _STIFF_DIAMETER_M = 60.0, 0.067
# Largest moment left on a link, per length, as a share of the drogue's drag. Differences of float64 limit it.
_SETTLED = 1e-8
_DIFFERENCE_RAD = 1e-7


@dataclass(frozen=True, eq=False)
class HoseAtRest:
    """A hose at rest, in the tanker's axes.

    Attributes:
        nodes_m: (N + 1, 3) ends of the links, from the exit to the coupling. [m]
        pull_n: (3,) force of the drogue on the hose. [N]
        airspeed_m_s: [m/s]
    """

    nodes_m: Array
    pull_n: Array
    airspeed_m_s: float


@dataclass(frozen=True)
class HoseEnds:
    """Where a hose begins and ends.

    Attributes:
        exit_elevation_rad: of its direction where it leaves the tanker, above the tanker's x axis. [rad]
        coupling_elevation_rad: of its direction where it enters the coupling, from the tanker to the drogue; negative
            where it descends. Its azimuth is that of the force there. [rad]
        drop_rad, swing_rad: direction from the exit to the coupling: below the tanker's plane, and to the right. A side
            force of the drogue holds it there. [rad]
    """

    exit_elevation_rad: float
    coupling_elevation_rad: float
    drop_rad: float
    swing_rad: float


def bending_stiffness_n_m2(diameter_m: float) -> float:
    """Bending stiffness of a hose; proportional to the fourth power of its diameter. [N m2]"""
    return _STIFFNESS_N_M2 * (diameter_m / _STIFF_DIAMETER_M) ** 4


def link_lengths_m(length_m: float) -> Array:
    """(N,) lengths of the links: about half of `FITTING_M` at the ends of a long hose; all equal in a short one. [m]"""
    at = np.linspace(0.0, 1.0, HOSE_LINKS + 1)
    even = np.sin(2 * np.pi / HOSE_LINKS) / (2 * np.pi / HOSE_LINKS)
    gathered = np.clip((1.0 - FITTING_M / FITTED_LINKS * HOSE_LINKS / length_m) / even, 0.0, 0.98)
    lengths: Array = np.diff(length_m * (at - gathered * np.sin(2 * np.pi * at) / (2 * np.pi)))
    return lengths


def link_loads_n(hose: HoseParameters, directions: Array, lengths_m: Array, airspeed_m_s: ArrayLike) -> Array:
    """(..., N, 3) weight and drag of links in still air. [N]

    Args:
        hose: its coefficients.
        directions: (..., N, 3) unit vectors.
        lengths_m: (N,). [m]
        airspeed_m_s: (...). [m/s]
    """
    half_density = hose.air_density_kg_m3 / 2
    speed = np.asarray(airspeed_m_s, dtype=np.float64)[..., None, None]
    along = directions[..., :1] * speed
    normal = speed * np.array([1.0, 0.0, 0.0]) - along * directions
    across = np.linalg.norm(normal, axis=-1, keepdims=True)
    drag = half_density * hose.diameter_m * hose.crossflow_drag_coefficient * across * normal
    friction = half_density * np.pi * hose.diameter_m * hose.skin_drag_coefficient * np.abs(along) * along
    weight = np.array([0.0, 0.0, -hose.mass_per_length_kg_m * GRAVITY_M_S2])
    loads: Array = lengths_m[:, None] * (drag + friction * directions + weight)
    return loads


def drogue_pull_n(hose: HoseParameters, airspeed_m_s: ArrayLike) -> Array:
    """(..., 3) drag and weight of the drogue in (...) air streams. [N]"""
    area_m2 = np.pi / 4 * hose.drogue_diameter_m**2
    speed = np.asarray(airspeed_m_s, dtype=np.float64)
    pull = np.zeros((*speed.shape, 3))
    pull[..., 0] = hose.air_density_kg_m3 / 2 * area_m2 * hose.drogue_drag_coefficient * speed**2
    pull[..., 2] = -hose.drogue_mass_kg * GRAVITY_M_S2
    return pull


def middle_forces_n(loads_n: Array, pull_n: Array) -> Array:
    """(..., N, 3) forces in the middles of links with (..., N, 3) loads: pull at the end and all loads beyond. [N]"""
    beyond = np.cumsum(loads_n[..., ::-1, :], axis=-2)[..., ::-1, :]
    forces: Array = pull_n[..., None, :] + beyond - loads_n / 2
    return forces


def hose_at_rest(hose: HoseParameters, ends: HoseEnds, airspeed_m_s: Range) -> HoseAtRest:
    """The shape of a hose at rest between its ends.

    Args:
        hose: its coefficients; the next argument takes the place of its air stream.
        ends: where it begins and ends.
        airspeed_m_s: within it the air stream is as fast as the drogue's weight and drag need for the drop. Where no
            speed within it will do, the drogue has lift, too. [m/s]

    Raises:
        ValueError: no shape is found, because the drogue hardly pulls at the hose.
    """
    balance = _Balance(hose, ends, None)
    found = root(balance.residual, balance.start(), jac=balance.jacobian, tol=1e-12)
    needed = float(balance.unpacked(found.x)[3])
    if not (balance.is_solved_by(found.x) and airspeed_m_s.low <= needed <= airspeed_m_s.high):
        nearest = needed if np.isfinite(needed) else hose.airspeed_m_s
        balance = _Balance(hose, ends, float(np.clip(nearest, airspeed_m_s.low, airspeed_m_s.high)))
        found = root(balance.residual, balance.start(), jac=balance.jacobian, tol=1e-12)
    if not balance.is_solved_by(found.x):
        raise ValueError(
            f"hose: no shape at rest is found for {hose.length_m:g} m; raise airspeed_m_s or "
            "model.drogue_drag_coefficient, or lower drop_deg"
        )
    elevation, azimuth, pull, speed = balance.unpacked(found.x)
    steps = _directions(elevation, azimuth) * balance.lengths_m[:, None]
    nodes = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return HoseAtRest(nodes_m=nodes, pull_n=pull, airspeed_m_s=float(speed))


def _directions(elevation: ArrayLike, azimuth: ArrayLike) -> Array:
    """(..., 3) unit vectors."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


class _Balance:
    """Moments on the links of a hose.

    Unknown are the links' angles, the drogue's side force, and the airspeed, or the drogue's lift where that is given.
    """

    def __init__(self, hose: HoseParameters, ends: HoseEnds, airspeed_m_s: float | None) -> None:
        self._hose, self._ends, self._airspeed_m_s = hose, ends, airspeed_m_s
        self.lengths_m = link_lengths_m(hose.length_m)
        between_m = (self.lengths_m[1:] + self.lengths_m[:-1]) / 2
        self._stiffness_n_m = (bending_stiffness_n_m2(hose.diameter_m) / between_m)[:, None]

    def start(self) -> Array:
        """A straight hose."""
        angles = [np.full(_FREE_LINKS, -self._ends.drop_rad), np.full(_FREE_LINKS + 1, self._ends.swing_rad)]
        return np.concatenate([*angles, np.zeros(2)])

    def unpacked(self, unknown: Array) -> tuple[Array, Array, Array, Array]:
        """(..., N) elevations and azimuths of the links [rad], (..., 3) pull of the drogue [N] and (...) airspeed."""
        one = np.ones((*unknown.shape[:-1], FITTED_LINKS))
        first, last = self._ends.exit_elevation_rad * one, self._ends.coupling_elevation_rad * one
        elevation = np.concatenate([first, unknown[..., :_FREE_LINKS], last], axis=-1)
        turned = unknown[..., _FREE_LINKS : 2 * _FREE_LINKS + 1]
        azimuth = np.concatenate([0.0 * one, turned, turned[..., -1:]], axis=-1)
        if self._airspeed_m_s is None:
            speed = self._hose.airspeed_m_s * np.exp(unknown[..., -1])
        else:
            speed = np.full(unknown.shape[:-1], self._airspeed_m_s)
        pull = drogue_pull_n(self._hose, speed)
        pull[..., 1] = unknown[..., -2] * pull[..., 0]
        if self._airspeed_m_s is not None:
            pull[..., 2] += unknown[..., -1] * pull[..., 0]
        return elevation, azimuth, pull, speed

    def is_solved_by(self, unknown: Array) -> bool:
        """Whether the moments vanish but for rounding."""
        return bool(np.abs(self.residual(unknown)).max() < _SETTLED)

    def residual(self, unknown: Array) -> Array:
        """(..., U) moments per length of each link, over the drogue's drag, and the miss of the chord's direction.

        The lower fitting turns freely to the side, into the direction of the force.
        """
        elevation, azimuth, pull, speed = self.unpacked(unknown)
        links = _directions(elevation, azimuth)
        force = middle_forces_n(link_loads_n(self._hose, links, self.lengths_m, speed), pull)
        turning = self.lengths_m[:, None] * force
        turning[..., :-1, :] += self._stiffness_n_m * links[..., 1:, :]
        turning[..., 1:, :] += self._stiffness_n_m * links[..., :-1, :]
        turning /= self.lengths_m[:, None] * pull[..., None, :1]
        side = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
        up = np.cross(links, side)
        sideways = (turning * side).sum(axis=-1)
        sideways[..., -FITTED_LINKS] = (force[..., -1, :] * side[..., -1, :]).sum(axis=-1) / pull[..., 0]
        chord = (links * self.lengths_m[:, None]).sum(axis=-2)
        aim = _directions(-self._ends.drop_rad, self._ends.swing_rad)
        miss = chord / np.linalg.norm(chord, axis=-1, keepdims=True) - aim
        upwards, free = (turning * up).sum(axis=-1), slice(FITTED_LINKS, FITTED_LINKS + _FREE_LINKS)
        turned = sideways[..., FITTED_LINKS : FITTED_LINKS + _FREE_LINKS + 1]
        return np.concatenate([upwards[..., free], turned, miss[..., 1:]], axis=-1)

    def jacobian(self, unknown: Array) -> Array:
        """(U, U) derivative of the residual by central differences."""
        step = _DIFFERENCE_RAD * np.eye(len(unknown))
        derivative: Array = (self.residual(unknown + step) - self.residual(unknown - step)).T / (2 * _DIFFERENCE_RAD)
        return derivative
