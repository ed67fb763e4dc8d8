"""A small dataset with everything that datasets have."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.support.whole_dataset import write_whole_dataset


@pytest.fixture(scope="package")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "whole"
    write_whole_dataset(folder)
    return folder


@pytest.fixture
def dataset(whole: Path, tmp_path: Path) -> Path:
    shutil.copytree(whole, tmp_path / "dataset")
    return tmp_path / "dataset"
