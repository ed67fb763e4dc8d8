"""New folders, and folders that are there and get contents."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from datasets_manifest.atomic import new_folder, open_text_atomic, write_text_atomic


def fill(folder: Path) -> None:
    (folder / "frames").mkdir()
    (folder / "frames" / "first").write_text("1")
    (folder / "manifest.json").write_text("{}")


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


WHOLE = ["frames", "frames/first", "manifest.json"]


def test_an_empty_folder_stays_itself_and_keeps_its_rights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    out.mkdir(mode=0o750)
    before = out.stat()
    monkeypatch.chdir(out)
    with new_folder(Path()) as folder:
        fill(folder)
    assert (out.stat().st_ino, out.stat().st_mode) == (before.st_ino, before.st_mode)
    assert names(Path.cwd()) == names(out) == WHOLE
    with pytest.raises(ValueError, match="is not empty"), new_folder(out):
        pass


@pytest.mark.parametrize("is_there", [False, True])
def test_a_failure_leaves_what_was_there_before(is_there: bool, tmp_path: Path) -> None:
    out = tmp_path / "new" / "parent" / "out"
    if is_there:
        out.mkdir(parents=True)
    before = names(tmp_path)
    with pytest.raises(RuntimeError, match="stop"), new_folder(out) as folder:
        fill(folder)
        raise RuntimeError("stop")
    assert names(tmp_path) == before
    with new_folder(out) as folder:
        fill(folder)
    assert names(out) == WHOLE


@pytest.mark.parametrize("name", ["frames/others", "manifest.json"])
def test_another_writer_of_the_same_folder_loses_nothing(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with (
        pytest.raises(OSError, match=rf"out: cannot be written: another process wrote {name.split('/')[0]} into it"),
        new_folder(out) as folder,
    ):
        fill(folder)
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("others")
    assert [path.read_text() for path in out.rglob("*") if path.is_file()] == ["others"]


def test_an_error_within_an_error_is_told_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot be written") as caught, new_folder(tmp_path / "out") as folder:
        shutil.copy(tmp_path / "file", folder / "file")
        with open_text_atomic(folder / "outer") as stream:
            stream.write("first")
            write_text_atomic(folder / "file" / "inner", "second")
    assert str(caught.value.strerror) == f"{tmp_path / 'out'}: cannot be written: File exists"
    assert names(tmp_path) == ["file"]


def test_a_mounted_folder_is_filled(small_disk: Path) -> None:
    with new_folder(small_disk) as folder:
        fill(folder)
    assert names(small_disk) == WHOLE


def test_a_disk_that_takes_no_writing_is_called_that(small_disk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from droguekit.cli.main import WRONG_INPUT, run

    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    assert run(["new", "recipe", "--out", str(small_disk / "mine.toml")]) == WRONG_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith("mine.toml: cannot be written: Read-only file system")
