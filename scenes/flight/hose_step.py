"""One step of a hose in motion and the air around it, compiled: a flight takes twenty thousand steps.

Sums run over components first, then from the exit to the drogue, so that results do not depend on the machine.
"""

from __future__ import annotations

import numpy as np

from geometry.compiled_loops import compiled
from geometry.se3 import Array

GRAVITY_M_S2 = 9.80665  # standard gravity


@compiled
def advance(
    state: tuple[Array, Array, Array],
    air_m_s: Array,
    pod_m: Array,
    masses: tuple[Array, Array, Array],
    drag: tuple[float, float, float],
    sizes: tuple[float, float, float, float],
) -> None:
    """Advance all sequences by one step of semi-implicit Euler; see `HoseModel.step`.

    Args:
        state: (3, S, N + 1) nodes [m] and velocities [m/s], (S, N) tensions [N]; overwritten.
        air_m_s: (3, S, N + 1) velocity of the air at the nodes. [m/s]
        pod_m: (3, S) position of the pod's exit at the end of the step. [m]
        masses: (N,) masses [kg], their inverses, and the inverses' sums over both ends of each link. [1/kg]
        drag: coefficients of a link across and along the wind, and of the drogue. [kg/m]
        sizes: length of a link [m] and its square [m2], the time step [s] and twice its square [s2].
    """
    (nodes, velocities, tensions), (mass, inverse, _) = state, masses
    link_m, _, time_step_s, _ = sizes
    links = len(mass)
    u, ahead, velocity = np.empty((3, links)), np.empty((3, links)), np.empty((3, links))
    half_drag, pull, place = np.empty((3, links)), np.empty((3, links)), np.empty((3, links + 1))
    change = np.empty(links)
    for s in range(nodes.shape[1]):
        for i in range(3):
            for n in range(links):
                u[i, n] = (nodes[i, s, n + 1] - nodes[i, s, n]) / link_m
                pull[i, n] = tensions[s, n] * u[i, n]
        _drag_links(u, air_m_s[:, s], velocities[:, s], drag, half_drag)
        # Positions of the nodes with the tensions of the previous step.
        past = air_m_s[:, s, links] - velocities[:, s, links]
        speed = np.sqrt(past[0] * past[0] + past[1] * past[1] + past[2] * past[2])
        for i in range(3):
            place[i, 0] = pod_m[i, s]
            for n in range(links):
                force = half_drag[i, n]
                if n < links - 1:
                    force += half_drag[i, n + 1]
                else:
                    force += drag[2] * speed * past[i]
                if i == 2:
                    force -= GRAVITY_M_S2 * mass[n]
                force -= pull[i, n]
                if n < links - 1:
                    force += pull[i, n + 1]
                velocity[i, n] = velocities[i, s, n + 1] + time_step_s * inverse[n] * force
                place[i, n + 1] = nodes[i, s, n + 1] + time_step_s * velocity[i, n]
            for n in range(links):
                ahead[i, n] = place[i, n + 1] - place[i, n]
        _restore_lengths(u, ahead, masses, sizes, change)
        for n in range(links):
            tensions[s, n] += change[n]
        for i in range(3):
            velocities[i, s, 0] = (pod_m[i, s] - nodes[i, s, 0]) / time_step_s
            nodes[i, s, 0] = place[i, 0]
            for n in range(links):
                force = -(change[n] * u[i, n])
                if n < links - 1:
                    force += change[n + 1] * u[i, n + 1]
                correction = time_step_s * inverse[n] * force
                velocities[i, s, n + 1] = velocity[i, n] + correction
                nodes[i, s, n + 1] = place[i, n + 1] + time_step_s * correction


@compiled
def air_at_nodes(
    nodes_m: Array, gust_m_s: Array, airspeed_m_s: float, source_m: Array, bow: tuple[float, float], air_m_s: Array
) -> None:
    """Velocity of the air at the nodes of a hose, into `air_m_s`.

    A round nose of radius a in air of speed V adds `V a^2 / 4 r / |r|^3` at r from its source; inside the body at most
    the airspeed, its value at the tip.

    Args:
        nodes_m: (3, S, N + 1) positions. [m]
        gust_m_s: (3, S) the same at all nodes. [m/s]
        airspeed_m_s: of tanker and receiver. [m/s]
        source_m: (3, S) positions of the sources, half a radius behind the tips of the noses. [m]
        bow: `V a^2 / 4` [m3/s], 0 without a nose, and the square of half the radius of the body far behind it. [m2]
        air_m_s: (3, S, N + 1) is overwritten. [m/s]

    Source: Rankine's half-body, a point source in a uniform stream; Milne-Thomson, Theoretical Hydrodynamics, ch. 15.
    """
    strength, least_m2 = bow
    away = np.empty(3)
    for s in range(nodes_m.shape[1]):
        for n in range(nodes_m.shape[2]):
            square = 0.0
            for i in range(3):
                away[i] = nodes_m[i, s, n] - source_m[i, s]
                square += away[i] * away[i]
            square = max(square, least_m2)
            for i in range(3):
                air = gust_m_s[i, s]
                if i == 0:
                    air += airspeed_m_s
                if strength > 0:
                    air += strength * away[i] / (square * np.sqrt(square))
                air_m_s[i, s, n] = air


@compiled
def _drag_links(
    u: Array, air_m_s: Array, velocities_m_s: Array, drag: tuple[float, float, float], half_drag: Array
) -> None:
    """Half the drag of each link in air that moves past its middle, into `half_drag`. [N]"""
    wind = np.empty(3)
    for n in range(u.shape[1]):
        along = normal2 = 0.0
        for i in range(3):
            past, next_past = air_m_s[i, n] - velocities_m_s[i, n], air_m_s[i, n + 1] - velocities_m_s[i, n + 1]
            wind[i] = 0.5 * (next_past + past)
            along += u[i, n] * wind[i]
        for i in range(3):
            normal = wind[i] - along * u[i, n]
            normal2 += normal * normal
        across = drag[0] * np.sqrt(normal2)
        for i in range(3):
            tangential = along * u[i, n]
            half_drag[i, n] = 0.5 * (across * (wind[i] - tangential) + drag[1] * np.abs(along) * tangential)


@compiled
def _restore_lengths(
    u: Array,
    ahead: Array,
    masses: tuple[Array, Array, Array],
    sizes: tuple[float, float, float, float],
    change: Array,
) -> None:
    """Change of the tensions that restores the links' lengths at the end of the step, into `change`. [N]

    One step of Newton's method on the squared lengths: its error is of second order in a change that is itself small,
    and the next step removes it. The tridiagonal system is solved by elimination with partial pivoting, as LAPACK's
    dgtsv does.

    Args:
        u: (3, N) directions in which the tensions pull.
        ahead: (3, N) vectors of the links at the end of the step without the change. [m]
        masses, sizes: as in `advance`.
        change: (N,) is overwritten.
    """
    (_, inverse, both), (_, link_m2, _, scale_s2) = masses, sizes
    links = len(inverse)
    lower, diagonal, upper = np.zeros(links), np.empty(links), np.zeros(links)
    for n in range(links):
        square = own = before = after = 0.0
        for i in range(3):
            square += ahead[i, n] * ahead[i, n]
            own += ahead[i, n] * u[i, n]
            if n > 0:
                before += ahead[i, n] * u[i, n - 1]
            if n < links - 1:
                after += ahead[i, n] * u[i, n + 1]
        diagonal[n] = both[n] * own
        change[n] = (square - link_m2) / scale_s2
        if n > 0:
            lower[n - 1] = -inverse[n - 1] * before
        if n < links - 1:
            upper[n] = -inverse[n] * after
    for n in range(links - 1):
        if np.abs(diagonal[n]) >= np.abs(lower[n]):
            share = lower[n] / diagonal[n]
            diagonal[n + 1] -= share * upper[n]
            change[n + 1] -= share * change[n]
            lower[n] = 0.0
        else:
            # The two rows change places; `lower` then holds what lies two beside the diagonal.
            share = diagonal[n] / lower[n]
            diagonal[n], kept = lower[n], diagonal[n + 1]
            diagonal[n + 1] = upper[n] - share * kept
            lower[n] = upper[n + 1]
            upper[n + 1] = -share * lower[n]
            upper[n] = kept
            kept = change[n]
            change[n] = change[n + 1]
            change[n + 1] = kept - share * change[n + 1]
    change[links - 1] /= diagonal[links - 1]
    if links > 1:
        change[links - 2] = (change[links - 2] - upper[links - 2] * change[links - 1]) / diagonal[links - 2]
    for n in range(links - 3, -1, -1):
        change[n] = (change[n] - upper[n] * change[n + 1] - lower[n] * change[n + 2]) / diagonal[n]
