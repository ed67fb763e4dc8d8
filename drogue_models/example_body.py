"""The body of the example drogue: `python -m drogue_models.example_body FILE.ply` writes the mesh that ships."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh

from drogue_models.solids import revolve

_SECTIONS = 48


def example_body() -> trimesh.Trimesh:
    """A closed funnel of moulded plastic with a coupling at its end, for a rim of 0.30 m and a hub 0.22 m deep. [m]"""
    depth_m, mouth_m = 0.22, 0.04
    share = np.linspace(0.0, 1.0, 9)
    # A trumpet: steep near the rim, slender at the coupling.
    inside_m = 0.285 - (0.285 - 0.085) * share**0.6
    inside = np.stack([inside_m, 0.012 + (depth_m - 0.012) * share], axis=-1)
    outside = np.stack([inside_m + 0.006, inside[:, 1]], axis=-1)
    # The seat of the hub lies 3 mm behind the hub's face.
    seat = [(0.0, depth_m + 0.09), (mouth_m, depth_m + 0.09), (mouth_m, depth_m + 0.003), (0.085, depth_m + 0.003)]
    end = [(0.091, depth_m + 0.05), (0.06, depth_m + 0.08), (0.045, depth_m + 0.16), (0.0, depth_m + 0.16)]
    return revolve(np.vstack([seat, inside[::-1], outside, end]), _SECTIONS)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m drogue_models.example_body FILE.ply")
    example_body().export(Path(sys.argv[1]))
