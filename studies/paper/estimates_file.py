"""A file of estimates, read once: the contenders' estimates in it, and its hash; and the dataset that they are of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, read_estimates
from droguekit.benchmark.poses.pose_errors import by_method
from studies.paper.contenders import CONTENDERS, Contender, present
from studies.paper.provenance import file_sha256, source_text


@dataclass(frozen=True, eq=False)
class EstimatesFile:
    """What a file of estimates says of the contenders.

    Attributes:
        path: where it lies.
        sha256: of its contents.
        methods: by name and frame.
    """

    path: Path
    sha256: str
    methods: Mapping[str, Mapping[int, Estimate]]


@dataclass(frozen=True, eq=False)
class NavigatedData:
    """A dataset with estimates.

    Attributes:
        dataset: that was navigated.
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
        """Those of which there are estimates."""
        return present(self.file.methods)


def read_estimates_file(path: Path, frame_indices: Sequence[int]) -> EstimatesFile:
    """Read the contenders' estimates.

    Raises:
        ValueError: the file cannot be read, names other frames than the dataset's, or holds none of the contenders.
    """
    names = [contender.method for contender in CONTENDERS]
    found = by_method(read_estimates(path), frame_indices, str(path))
    methods = {name: estimates for name, estimates in found.items() if name in names}
    if not methods:
        raise ValueError(
            f"{path}: holds none of the methods {', '.join(names)}; name them to droguekit navigate by --method"
        )
    return EstimatesFile(path, file_sha256(path), methods)
