"""Inputs of the page: files of estimates with their datasets, and the hashes of data, files and code."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, read_estimates
from droguekit.scoring.poses.pose_errors import estimates_by_method
from studies.paper.published_results import CONTENDERS, Contender, present

_PACKAGES = ("datasets_manifest", "drogue_models", "droguekit", "geometry", "labelgen", "nav", "render", "scenes")


@dataclass(frozen=True, eq=False)
class EstimatesFile:
    """The contenders' estimates in a file.

    Attributes:
        path: of the file.
        sha256: of its contents.
        methods: by name and frame.
    """

    path: Path
    sha256: str
    methods: Mapping[str, Mapping[int, Estimate]]


@dataclass(frozen=True, eq=False)
class ExperimentData:
    """A dataset with estimates.

    Attributes:
        dataset: the images.
        file: the estimates on it.
    """

    dataset: Dataset
    file: EstimatesFile

    @property
    def manifest(self) -> Manifest:
        """Of the dataset."""
        return self.dataset.manifest

    @property
    def source(self) -> str:
        """What the dataset is called and which engines made it."""
        return source_text(self.manifest)

    @property
    def contenders(self) -> list[Contender]:
        """Contenders with estimates."""
        return present(self.file.methods)


def read_estimates_file(path: Path, frame_indices: Sequence[int]) -> EstimatesFile:
    """Read the contenders' estimates.

    Raises:
        ValueError: the file cannot be read, names other frames than the dataset's, or holds none of the contenders.
    """
    names = [contender.method for contender in CONTENDERS]
    found = estimates_by_method(read_estimates(path), frame_indices, str(path))
    methods = {name: estimates for name, estimates in found.items() if name in names}
    if not methods:
        raise ValueError(
            f"{path}: holds none of the methods {', '.join(names)}; name them to droguekit navigate by --method"
        )
    return EstimatesFile(path, file_sha256(path), methods)


def code_facts() -> list[tuple[str, str]]:
    """Version of the code that wrote the page, and a hash of all its modules."""
    return [
        ("Code that wrote this page", f"droguekit {version('droguekit')}"),
        ("Its hash (SHA-256)", code_sha256(_roots())),
    ]


def source_text(manifest: Manifest) -> str:
    """What a dataset is called and which engines made it, for titles and captions."""
    # An engine's name comes before its version.
    engines = sorted({engine.partition(",")[0] for engine in manifest.engines})
    return ", ".join([manifest.name, *engines])


def dataset_facts(manifest: Manifest) -> list[tuple[str, str]]:
    """A dataset's hash, and what it was made with."""
    engines = "; ".join(sorted(manifest.engines)) or "nothing"
    software = ", ".join(f"{name} {number}" for name, number in sorted(manifest.software.items()))
    return [
        (f"Dataset {source_text(manifest)}, {manifest.counts.pairs} pairs", manifest.dataset_sha256),
        (f"Made by, {source_text(manifest)}", f"{engines}; with {software}"),
    ]


def code_sha256(roots: Sequence[Path]) -> str:
    """Hash of the names and contents of all Python modules below some folders, wherever these lie."""
    digest = hashlib.sha256()
    for root in sorted(roots, key=lambda path: path.name):
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """Hash of a file.

    Raises:
        ValueError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error


def _roots() -> list[Path]:
    places = [find_spec(name) for name in _PACKAGES]
    return [Path(place) for spec in places if spec is not None for place in spec.submodule_search_locations or ()]
