"""Copies of users' meshes in a dataset: its labels can be checked and exported wherever it is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import partial

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.layout import MESHES_FOLDER, is_plain_name
from datasets_manifest.storage.storage import Location, Storage, open_storage
from drogue_models.drogue_families.mesh_files import body_mesh_data, offer_body_mesh
from drogue_models.parameters import BodyMesh


def write_mesh_copies(dataset: Location, recipe: Recipe) -> None:
    """Write the meshes of a recipe's drogues that a dataset lacks.

    Raises:
        ValueError: a mesh that is missing or was changed.
        OSError: it cannot be written.
    """
    storage = open_storage(dataset)
    for name, body in _copies(recipe):
        if not storage.exists(name) or _sha256(storage, name) != body.sha256:
            storage.write(name, body_mesh_data(body))


def offer_mesh_copies(storage: Storage, recipe: Recipe) -> None:
    """Let the drogues of a dataset's recipe and records take their meshes from its copies, when they are needed."""
    for name, body in _copies(recipe):
        if storage.exists(name):
            offer_body_mesh(body.sha256, partial(storage.read, name))


def mesh_copy_faults(dataset: Location, recipe: Recipe) -> list[str]:
    """Faults of a dataset's copies of meshes, a line each."""
    storage, faults = open_storage(dataset), []
    for name, body in _copies(recipe):
        try:
            if _sha256(storage, name) != body.sha256:
                faults.append(f"{storage.where(name)}: was changed: its hash differs from that in its name")
        except FileNotFoundError:
            faults.append(f"{storage.where(name)}: is missing; `render` with the same recipe writes it")
        except OSError as error:
            faults.append(f"{storage.where(name)}: cannot be read: {error.strerror}")
    return faults


def _copies(recipe: Recipe) -> Iterator[tuple[str, BodyMesh]]:
    """Name of the copy of every mesh, each once."""
    bodies = {drogue.body_mesh.sha256: drogue.body_mesh for drogue in recipe.drogues if drogue.body_mesh is not None}
    for sha256, body in bodies.items():
        name = f"{sha256}.{body.file_type}"
        # A manifest may come from anybody, and no mesh of such a type can be read.
        if is_plain_name(name):
            yield f"{MESHES_FOLDER}/{name}", body


def _sha256(storage: Storage, name: str) -> str:
    return hashlib.sha256(storage.read(name)).hexdigest()
