"""The surface of a painted hose: rubber with bands, grime and a satin finish along a curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drogue_models.meshes import HOSE_SECTIONS, hose_mesh
from drogue_models.painted_mesh import HIGHEST_REFLECTANCE, LOWEST_REFLECTANCE, PaintedMesh, Sheen
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part, part_reflectance_rgb
from drogue_models.surface_looks import HoseLook

# Texels along and around a hose; 25 m of it have one each 2.4 cm.
_ROWS, _COLUMNS = 1024, 8
# Grime changes the paint by up to this much, over about this many texels. Our choice.
_GRIME, _GRIME_TEXELS = 0.35, 24


def hose_surface(drogue: DrogueParameters, nodes_m: ArrayLike, look: HoseLook | None) -> PaintedMesh:
    """The hose along nodes, in their axes.

    Args:
        drogue: gives the radius, and the paint where `look` is None.
        nodes_m: (K, 3) centre line from the coupling to the tanker, see `hose_mesh`. [m]
        look: its paint.
    """
    mesh = hose_mesh(nodes_m, drogue.hose_radius_m)
    if look is None:
        return PaintedMesh(mesh=mesh, reflectance=np.array(part_reflectance_rgb(drogue, Part.HOSE)), smooth=True)
    rings = np.asarray(mesh.vertices)[:-2].reshape(-1, HOSE_SECTIONS, 3).mean(axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rings, axis=0), axis=1))])
    # The map runs from one side of the hose to the other and back, so that it has no seam.
    around = 1.0 - np.abs(np.arange(HOSE_SECTIONS) / (HOSE_SECTIONS / 2) - 1.0)
    v = np.repeat(along_m / along_m[-1], HOSE_SECTIONS)
    uv = np.column_stack([np.tile(around, len(rings)), v])
    uv = np.vstack([uv, [[0.5, 0.0], [0.5, 1.0]]])
    paint = np.clip(_paint(look, float(along_m[-1])), LOWEST_REFLECTANCE, HIGHEST_REFLECTANCE)
    sheen = Sheen(look.sheen_fraction, look.roughness) if look.sheen_fraction > 0 else None
    return PaintedMesh(mesh=mesh, reflectance=paint.astype(np.float32), uv=np.clip(uv, 0, 1), smooth=True, sheen=sheen)


def _paint(look: HoseLook, length_m: float) -> NDArray[np.float64]:
    """(rows, columns, 3) reflectance; row 0 is at the coupling."""
    edge_m = np.linspace(0.0, length_m, _ROWS + 1)
    paint = np.tile(np.array(look.reflectance_rgb), (_ROWS, 1))
    for band in look.bands:
        inside_m = np.minimum(edge_m[1:], band.end_m) - np.maximum(edge_m[:-1], band.start_m)
        share = np.clip(inside_m * _ROWS / length_m, 0.0, 1.0)[:, None]
        paint = paint * (1 - share) + share * np.array(band.reflectance_rgb)
    rng = np.random.default_rng([look.seed, 1])
    coarse = rng.uniform(1.0 - _GRIME, 1.0, (_ROWS // _GRIME_TEXELS + 2, _COLUMNS))
    at = np.arange(_ROWS) / _GRIME_TEXELS
    low = at.astype(int)
    share = (at - low)[:, None]
    grime: NDArray[np.float64] = coarse[low] * (1 - share) + coarse[low + 1] * share
    return np.asarray(paint[:, None] * grime[..., None])
