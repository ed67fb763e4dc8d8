"""The command line itself: help, errors, exit codes."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from droguekit.cli.main import COMMANDS, DONE, INTERRUPTED, WRONG_INPUT, explain, run

HEAVY = ("numpy", "scipy", "cv2", "pydantic", "mitsuba", "trimesh", "matplotlib", "distributed", "OpenEXR")


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "droguekit.cli.main", *arguments], capture_output=True, text=True, check=False
    )


def test_help_lists_every_command_and_imports_nothing_heavy() -> None:
    script = (
        "import sys\n"
        "from droguekit.cli.main import run\n"
        "code = run(['--help'])\n"
        f"print('heavy:', [name for name in {HEAVY!r} if name in sys.modules], 'code:', code)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "heavy: [] code: 0" in result.stdout
    for name in COMMANDS:
        assert re.search(rf"^  {name} ", result.stdout, re.MULTILINE), name


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself_with_examples(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, "--help"]) == DONE
    shown = capsys.readouterr().out
    assert f"Usage: droguekit {name}" in shown
    assert re.search(rf"^    droguekit {name}\b", shown, re.MULTILINE)


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    from importlib.metadata import version

    assert run(["--version"]) == DONE
    assert capsys.readouterr().out == f"droguekit {version('droguekit')}\n"


@pytest.mark.parametrize(
    "arguments",
    [[], ["rendr"], ["render"], ["render", "demo"], ["validate", "--frames", "1"], ["reproduce", "d", "--frame", "x"]],
)
def test_wrong_usage_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(arguments) == WRONG_INPUT
    assert "Traceback" not in capsys.readouterr().err


def test_an_error_is_one_line_that_names_the_cause() -> None:
    result = _run("plan", "nowhere.toml")
    assert result.returncode == WRONG_INPUT
    assert result.stdout == ""
    assert re.fullmatch(r"droguekit: error: .*nowhere\.toml.*\n", result.stderr)


@pytest.mark.parametrize("place", [0, -1])
def test_debug_anywhere_shows_the_traceback(place: int) -> None:
    arguments = ["plan", "nowhere.toml"]
    arguments.insert(len(arguments) if place == -1 else place, "--debug")
    result = _run(*arguments)
    assert "Traceback" in result.stderr
    assert "nowhere.toml" in result.stderr


def test_an_interrupted_run_says_how_to_go_on(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "droguekit.cli.main", "demo", "smoke", "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("1 of 3: rendering")
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()
    assert process.returncode == INTERRUPTED
    assert told.splitlines()[-1] == "droguekit: interrupted; run the same command to continue"
    assert "Traceback" not in told


def test_a_terminated_command_leaves_nothing_half_written(tmp_path: Path) -> None:
    (tmp_path / "stalling.py").write_text(
        "import signal\n"
        "from pathlib import Path\n"
        "from datasets_manifest.atomic import new_folder\n"
        "EXAMPLES = {'stall': ()}\n"
        "def stall(out: Path) -> None:\n"
        "    with new_folder(out) as folder:\n"
        "        (folder / 'first').write_text('half')\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
    )
    script = (
        "import sys\n"
        "from droguekit.cli.main import COMMANDS, Command, main\n"
        "sys.path.append(sys.argv.pop(1))\n"
        "COMMANDS['stall'] = Command('stalling', 'Write without an end.')\n"
        "main()\n"
    )
    work = tmp_path / "work"
    work.mkdir()
    arguments = [sys.executable, "-c", script, str(tmp_path), "stall", str(work / "out")]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr.strip()) == (INTERRUPTED, "droguekit: interrupted")
    assert list(work.iterdir()) == []


def test_only_names_that_are_not_utf_8_are_said_to_be_none() -> None:
    name = "out/caf\udce9"
    with pytest.raises(UnicodeEncodeError) as wrong:
        name.encode()
    assert explain(wrong.value) == f"{name}: has characters that are not UTF-8; rename the file or folder"
    with pytest.raises(UnicodeEncodeError) as narrow:
        "out/café".encode("ascii")
    assert "rename" not in explain(narrow.value)
