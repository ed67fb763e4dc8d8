"""Standard output and error that are closed, full, or read by somebody who stops reading."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

from droguekit.batch.progress import PlainProgress
from droguekit.cli.main import DONE, WRONG_INPUT
from droguekit.output_streams import printable


def shell(line: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A line of bash, in which `$DK` is the command."""
    text = f"set -o pipefail; DK='{sys.executable} -m droguekit.cli.main'; {line}"
    environment = {"PYTHONPATH": ":".join(path for path in sys.path if path), "PATH": "/usr/bin:/bin", "LC_ALL": "C"}
    return subprocess.run(["bash", "-c", text], capture_output=True, text=True, check=False, cwd=cwd, env=environment)


@pytest.mark.parametrize(
    ("line", "code", "error"),
    [
        ("$DK --version >&-", DONE, ""),
        ("$DK --help <&- >&- 2>&-", DONE, ""),
        ("$DK nonsense >&- 2>&-", WRONG_INPUT, ""),
        ("$DK nonsense 2>/dev/full", WRONG_INPUT, ""),
        ("$DK --help | true", DONE, ""),
        ("$DK --version >/dev/full", WRONG_INPUT, "droguekit: error: standard output: No space left on device\n"),
    ],
)
def test_the_exit_code_keeps_its_meaning(line: str, code: int, error: str) -> None:
    done = shell(line)
    assert (done.returncode, done.stderr) == (code, error)


def test_files_do_not_take_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """The first file that is opened would get the number of standard output, and what is printed with it."""
    done = shell("$DK model red-8 --out mesh.ply >&- 2>&-", tmp_path)
    assert done.returncode == DONE
    assert (tmp_path / "mesh.ply").read_bytes().startswith(b"ply\n")
    assert b"wrote" not in (tmp_path / "mesh.ply").read_bytes()


def test_control_characters_reach_no_terminal(tmp_path: Path) -> None:
    name = "\x1b]0;title\x07\x1b[2J\u202egnp"
    assert printable(name) == "\\x1b]0;title\\x07\\x1b[2J\\u202egnp"
    assert printable("\u00e9\t\u03c3\n") == "\u00e9\t\u03c3\n"
    told = io.StringIO()
    PlainProgress(told).say(f"{name} is damaged")
    assert told.getvalue() == f"{printable(name)} is damaged\n"
    done = shell(f"$DK render $'{name}' --out out; $DK validate $'\\xff\\x1b'", tmp_path)
    assert "\\x1b" in done.stderr and "\x1b" not in done.stderr + done.stdout
