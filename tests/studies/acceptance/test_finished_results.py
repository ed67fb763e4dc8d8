"""The hash of the inputs of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.acceptance.finished_results import code_fingerprint

ROOM = "a_room_of_this_test"


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / ROOM
    (folder / "weights").mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "weights" / "network.onnx").write_bytes(b"first")
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def test_other_code_and_other_networks_make_another(room: Path) -> None:
    before = code_fingerprint((ROOM,))
    (room / "weights" / "network.onnx").write_bytes(b"second")
    trained_anew = code_fingerprint((ROOM,))
    (room / "more.py").write_text("ANSWER = 42\n")
    assert len({before, trained_anew, code_fingerprint((ROOM,))}) == 3


def test_what_python_leaves_behind_does_not_count(room: Path) -> None:
    before = code_fingerprint((ROOM,))
    (room / "__pycache__").mkdir()
    (room / "__pycache__" / "more.cpython-311.pyc").write_bytes(b"compiled")
    assert code_fingerprint((ROOM,)) == before
