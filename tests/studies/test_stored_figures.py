"""Stored figures count for the code and machine that made them, and a damaged file is named."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from droguekit.batch.progress import PlainProgress
from studies.stored_figures import code_fingerprint, read_results, rendering_build, write_results

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


def test_results_are_read_again_by_what_made_them_alone(tmp_path: Path) -> None:
    file, told = tmp_path / "results.json", PlainProgress(io.StringIO())
    assert read_results(file, {"machine": "one"}, told) == {}
    results = {"first": {"cpu_s": 1.0}, "second": {"cpu_s": 2.0}}
    write_results(file, results, {"machine": "one"})
    assert read_results(file, {"machine": "one"}, told) == results
    assert read_results(file, {"machine": "two"}, told) == {}


@pytest.mark.parametrize("content", [b"{", b"\xff", b"[1]", b'{"first": 3}'])
def test_a_damaged_file_of_results_is_named(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"results\.json: .*remove it"):
        read_results(tmp_path / "results.json", {}, PlainProgress(io.StringIO()))


def test_a_build_of_rendering_tells_versions_and_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    before = rendering_build()
    assert before == rendering_build() != rendering_build(("droguekit",))
    monkeypatch.setattr("studies.stored_figures.cpu_features", lambda: ["another processor"])
    assert before != rendering_build()
