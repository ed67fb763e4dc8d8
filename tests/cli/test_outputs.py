"""Places that commands write: streams and links are written to, and nothing that a command reads is written over."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run


def test_a_pipe_gets_what_a_file_would(dataset: Path, tmp_path: Path) -> None:
    pipe, got = tmp_path / "pipe", list[str]()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()), daemon=True)
    reader.start()
    assert run(["coverage", str(dataset), "--json", str(pipe)]) == FAULT  # cells are empty
    reader.join(60)
    assert run(["coverage", str(dataset), "--json", str(tmp_path / "file")]) == FAULT
    assert pipe.is_fifo() and json.loads(got[0]) == json.loads((tmp_path / "file").read_text())


def test_standard_output_gets_the_numbers_between_the_lines(dataset: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "droguekit.cli.main", "coverage", dataset, "--json", "/dev/stdout"]
    with (tmp_path / "told").open("wb") as told:
        subprocess.run(command, check=False, stdout=told, stderr=subprocess.DEVNULL)
    text = (tmp_path / "told").read_text()
    assert run(["coverage", str(dataset), "--json", str(tmp_path / "file")]) == FAULT
    lines, _, numbers = text.partition("{\n")
    assert lines.strip() and json.loads("{" + numbers) == json.loads((tmp_path / "file").read_text())


def test_a_full_device_is_told_and_stays_a_device(dataset: Path, tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.symlink_to("/dev/full")
    assert run(["coverage", str(dataset), "--json", str(full)]) == WRONG_INPUT
    assert Path("/dev/full").is_char_device() and full.is_symlink()


def test_a_link_and_the_rights_of_a_file_stay(dataset: Path, tmp_path: Path) -> None:
    file, link = tmp_path / "file.json", tmp_path / "link.json"
    file.write_text("old")
    file.chmod(0o600)
    link.symlink_to("file.json")
    assert run(["coverage", str(dataset), "--json", str(link)]) == FAULT
    assert link.is_symlink() and file.stat().st_mode & 0o777 == 0o600
    assert json.loads(file.read_text())


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["benchmark", "dataset", "--estimates", "e.jsonl", "--json", "e.jsonl"], "--json: is what --estimates reads"),
        (["coverage", "dataset", "--json", "a", "--html", "./a"], "--html: must be another file than --json"),
        (["coverage", "dataset", "--json", "dataset/manifest.json"], "--json: is a part of the dataset"),
        (["preview", "dataset", "--out", "dataset/frames/000000/left.png"], "--out: is a part of the dataset"),
        (["export", "dataset", "--format", "coco", "--out", "dataset"], "--out: is what DIR reads"),
        (["train", "dataset", "--out", "out", "--cache", "dataset"], "--cache: is what SOURCE reads"),
        (["coverage", "dataset", "--json", ""], "--json: must name a place"),
    ],
)
def test_what_a_command_reads_is_not_written_over(
    arguments: list[str],
    told: str,
    dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "e.jsonl").write_text("estimates\n")
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert run(arguments) == WRONG_INPUT
    assert capsys.readouterr().err.startswith(f"droguekit: error: {told}")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_folder_may_have_the_name_of_a_format(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("coco").mkdir()
    assert run(["export", "dataset", "--format", "coco", "--out", "coco"]) == DONE


def test_a_report_may_lie_beside_the_dataset(dataset: Path) -> None:
    for _ in range(2):
        assert run(["coverage", str(dataset), "--html", str(dataset / "coverage.html")]) == FAULT
