"""The models of a BOP dataset: a mesh of every drogue in millimetres, its extent and its symmetries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters

MM_PER_M = 1000.0


def dataset_drogues(recipe: Recipe) -> list[DrogueParameters]:
    """The drogues of a dataset in the order of their object ids, which begin at 1."""
    drogues: list[DrogueParameters] = []
    for drogue in [variant.drogue for variant in recipe.variants] or [recipe.drogue]:
        if drogue not in drogues:
            drogues.append(drogue)
    return drogues


def object_id(recipe: Recipe, record: PairRecord) -> int:
    """The id of a pair's drogue.

    Raises:
        ValueError: the pair has none, or one that is not the recipe's.
    """
    drogues = dataset_drogues(recipe)
    if record.frame.drogue not in drogues:
        raise ValueError(f"frame {record.frame_index}: drogue: is none of the recipe's")
    return drogues.index(record.frame.drogue) + 1


def write_models(recipe: Recipe, folder: Path) -> None:
    """Write `models` and `models_eval`, which are the same.

    Raises:
        ValueError: a user's body mesh that is missing or was changed.
    """
    info = {}
    for name in ("models", "models_eval"):
        (folder / name).mkdir()
    for number, drogue in enumerate(dataset_drogues(recipe), start=1):
        mesh = trimesh.util.concatenate(list(drogue_meshes(drogue).values()))
        mesh.apply_scale(MM_PER_M)
        ply = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply")
        for name in ("models", "models_eval"):
            (folder / name / f"obj_{number:06d}.ply").write_bytes(ply)
        info[str(number)] = model_info(drogue, np.asarray(mesh.vertices, dtype=np.float64))
    for name in ("models", "models_eval"):
        (folder / name / "models_info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")


def model_info(drogue: DrogueParameters, vertices_mm: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, Any]:
    """Diameter, extent and symmetries of a model; its (V, 3) vertices are given. [mm]

    The symmetries are those of the markers, 4x4 row by row: turns about the axis, the whole turn left out.
    """
    low, size = vertices_mm.min(axis=0), np.ptp(vertices_mm, axis=0)
    hull = vertices_mm[ConvexHull(vertices_mm).vertices]
    order = marker_layout(drogue).symmetry_order
    info: dict[str, Any] = {"diameter": float(pdist(hull).max())}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    if order > 1:
        info["symmetries_discrete"] = [_turn(2 * np.pi * index / order) for index in range(1, order)]
    return info


def _turn(angle: float) -> list[float]:
    cosine, sine = float(np.cos(angle)), float(np.sin(angle))
    return [cosine, -sine, 0.0, 0.0, sine, cosine, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
