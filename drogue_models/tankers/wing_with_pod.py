"""A tanker's wing with a refuelling pod, as far as a receiver behind the drogue sees it.

Tanker frame: x aft, y along the right wing, z up, origin where the hose leaves the pod. Shapes are ours: a swept
tapered wing with the pod near its left tip, in the proportions of a four-engined tanker.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import trimesh

from drogue_models.painted_mesh import PaintedMesh
from drogue_models.parts import TANKER_GREY
from drogue_models.solids import bar, loft, revolve, with_creases
from geometry.se3 import Array

TIP_Y_M, ROOT_Y_M = -9.0, 21.0
TIP_CHORD_M, ROOT_CHORD_M = 2.6, 7.6
SWEEP_SLOPE = math.tan(math.radians(28.0))
DIHEDRAL_SLOPE = math.tan(math.radians(5.0))
WING_HEIGHT_M = 1.05  # of the chord line above the pod's axis, at the pod
TRAILING_EDGE_X_M = -0.7  # of the wing, at the pod
THICKNESS_FRACTION = 0.12
# Triangles over many metres of a swept wing would have boxes that most rays near it meet.
_WING_SLICES = 31
POD_LENGTH_M, POD_RADIUS_M = 4.2, 0.40
TUNNEL_RADIUS_M, TUNNEL_DEPTH_M = 0.16, 0.8


@cache
def _tanker() -> trimesh.Trimesh:
    return trimesh.util.concatenate([_wing(), *_fairings(), _pylon(), _pod(), *_turbine()])


def tanker_mesh() -> trimesh.Trimesh:
    """Wing, pylon and pod in the tanker frame, each closed. [m]"""
    return _tanker().copy()


@cache
def wing_surfaces() -> tuple[PaintedMesh, ...]:
    """Wing, pylon and pod in light grey, in the tanker frame; nobody may change them."""
    return (PaintedMesh(mesh=with_creases(tanker_mesh()), reflectance=np.array(TANKER_GREY), smooth=True),)


def pod_exit_m(y_m: float) -> Array:
    """(3,) where the hose of a second pod leaves, under the wing beside the first one, in the tanker frame. [m]

    Raises:
        ValueError: there is no wing.
    """
    if not TIP_Y_M + 1.0 <= y_m <= ROOT_Y_M - 1.0:
        raise ValueError(f"y_m: must be in [{TIP_Y_M + 1:g}, {ROOT_Y_M - 1:g}], where there is a wing, got {y_m:g}")
    back_m = _nose_x_m(y_m) + _chord_m(y_m) - TRAILING_EDGE_X_M
    return np.array([back_m, y_m, _wing_z_m(y_m) - WING_HEIGHT_M])


def _aerofoil(points_a_side: int) -> Array:
    """(N, 2) outline of a symmetric section of chord 1: x from nose to tail, z up; over the top first.

    Source: NACA four-digit thickness law, with the coefficient that closes the trailing edge.
    """
    x = (1 - np.cos(np.linspace(0.0, np.pi, points_a_side))) / 2
    half = THICKNESS_FRACTION / 0.2 * (0.2969 * np.sqrt(x) - 0.1260 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    upper = np.stack([x, half], axis=-1)
    lower = np.stack([x, -half], axis=-1)[-2:0:-1]
    return np.vstack([upper, lower])


def _chord_m(y_m: float) -> float:
    return TIP_CHORD_M + (ROOT_CHORD_M - TIP_CHORD_M) * (y_m - TIP_Y_M) / (ROOT_Y_M - TIP_Y_M)


def _nose_x_m(y_m: float) -> float:
    return TRAILING_EDGE_X_M - _chord_m(0.0) - y_m * SWEEP_SLOPE


def _wing_z_m(y_m: float) -> float:
    return WING_HEIGHT_M - y_m * DIHEDRAL_SLOPE


def _wing() -> trimesh.Trimesh:
    section = _aerofoil(24)
    rings = []
    for y_m in np.linspace(TIP_Y_M, ROOT_Y_M, _WING_SLICES):
        ring = np.empty((len(section), 3))
        ring[:, 0] = _nose_x_m(y_m) + section[:, 0] * _chord_m(y_m)
        ring[:, 1] = y_m
        ring[:, 2] = _wing_z_m(y_m) + section[:, 1] * _chord_m(y_m)
        rings.append(ring)
    return loft(rings)


def _fairings() -> list[trimesh.Trimesh]:
    """Slender bodies over the flap tracks that break up the wing's lower side."""
    share = np.linspace(0.0, 1.0, 25)
    half_m = 0.16 * np.sqrt(np.maximum(0.0, 1 - (2 * share - 1) ** 2))
    fairings = []
    for y_m in (4.0, 8.5, 13.0):
        length_m = 0.5 * _chord_m(y_m)
        profile = np.stack([half_m, length_m * share], axis=-1)
        profile[[0, -1], 0] = 0.0
        body = _along_x(revolve(profile, 32))
        body.apply_translation([_nose_x_m(y_m) + 0.62 * _chord_m(y_m), y_m, _wing_z_m(y_m) - 0.05 * _chord_m(y_m)])
        fairings.append(body)
    return fairings


def _pylon() -> trimesh.Trimesh:
    """From inside the pod to inside the wing."""
    section = _aerofoil(12)
    rings = []
    for z_m, nose_x_m, chord_m in ((0.2, -3.4, 2.7), (WING_HEIGHT_M, -3.7, 3.0)):
        ring = np.empty((len(section), 3))
        ring[:, 0] = nose_x_m + section[:, 0] * chord_m
        ring[:, 1] = -section[:, 1] * chord_m
        ring[:, 2] = z_m
        rings.append(ring)
    return loft(rings)


def _pod() -> trimesh.Trimesh:
    """Streamlined body whose aft end holds the tunnel from which the hose comes."""
    share = np.linspace(0.0, 1.0, 25)
    # An ellipsoid-like nose and a long boat tail that ends blunt, a little wider than the tunnel.
    body_m = POD_RADIUS_M * np.minimum(1.0, np.sqrt(1 - (1 - np.minimum(share / 0.28, 1.0)) ** 2))
    tail = np.clip((share - 0.6) / 0.4, 0.0, 1.0)
    body_m = body_m - (POD_RADIUS_M - 1.45 * TUNNEL_RADIUS_M) * tail**2
    outside = np.stack([body_m, POD_LENGTH_M * (share - 1)], axis=-1)
    outside[0, 0] = 0.0
    tunnel = [(TUNNEL_RADIUS_M, 0.0), (TUNNEL_RADIUS_M, -TUNNEL_DEPTH_M), (0.0, -TUNNEL_DEPTH_M)]
    return _along_x(revolve(np.vstack([outside, tunnel]), 48))


def _turbine() -> list[trimesh.Trimesh]:
    """Blades of the ram-air turbine at the pod's nose."""
    hub_x_m = 0.06 - POD_LENGTH_M
    blades = []
    for angle in np.radians([45.0, 135.0, 225.0, 315.0]):
        radial = np.array([0.0, np.cos(angle), np.sin(angle)])
        pitched = np.cross([1.0, 0.0, 0.0], radial) * 0.8 + [0.6, 0.0, 0.0]
        start = np.array([hub_x_m, 0.0, 0.0])
        blades.append(bar(start, start + 0.42 * radial, pitched, (0.07, 0.012)))
    return blades


def _along_x(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Turn the z axis to x."""
    mesh.vertices = np.asarray(mesh.vertices)[:, [2, 0, 1]]
    return mesh
