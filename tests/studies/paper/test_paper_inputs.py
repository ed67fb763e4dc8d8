"""Hashes of files and code."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import pytest

from studies.paper.paper_inputs import code_facts, code_sha256, file_sha256


def test_the_hash_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert file_sha256(tmp_path / "a") == hashlib.sha256(b"abc").hexdigest()
    with pytest.raises(ValueError, match="missing: cannot be read"):
        file_sha256(tmp_path / "missing")


def test_the_hash_of_the_code_is_that_of_names_and_contents(tmp_path: Path) -> None:
    here, there = tmp_path / "here" / "room", tmp_path / "there" / "room"
    (here / "inner").mkdir(parents=True)
    (here / "a.py").write_text("x = 1\n")
    (here / "inner" / "b.py").write_text("y = 2\n")
    shutil.copytree(here, there)
    (there / "notes.txt").write_text("no code")
    first = code_sha256([here])
    assert code_sha256([there]) == first
    (there / "inner" / "b.py").rename(there / "b.py")
    assert code_sha256([there]) != first
    (here / "a.py").write_text("x = 2\n")
    assert code_sha256([here]) != first


def test_the_page_names_the_code() -> None:
    facts = dict(code_facts())
    assert len(facts["Its hash (SHA-256)"]) == 64
    # All packages are found: the hash is not that of nothing.
    assert facts["Its hash (SHA-256)"] != code_sha256([])
