"""Damaged and hostile files through every reader, `validate` and every export: a clear error, or none, each time.

What counts as clear is one line of a ValueError or an OSError. Nothing may be written outside the folder that was
named, and nothing that a dataset leads to may be changed. `make fuzz` tries twenty times as many.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from labelgen.validation.dataset_checks import validate_dataset
from tests.support.whole_dataset import write_whole_dataset


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset with EXR files; to be read only (copy it to damage it)."""
    folder = tmp_path_factory.mktemp("fuzz") / "whole"
    write_whole_dataset(folder)
    assert validate_dataset(folder).faults == []
    return folder
