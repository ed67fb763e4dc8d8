"""Which interpreter runs Blender, and what is said where none does."""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from droguekit.cli.main import WRONG_INPUT, run
from droguekit.workflows.installation import BPY_OF_PYTHON
from render.blender_engine import interpreter
from render.blender_engine.interpreter import BlenderInterpreter, find_blender
from render.blender_engine.messages import (
    LIGHT,
    CameraPath,
    ImageWindow,
    PictureRequest,
    pickled,
)
from render.blender_engine.process import BlenderProcess

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A home without any Blender, and the folder of its programs."""
    programs = tmp_path / "bin"
    programs.mkdir()
    monkeypatch.setattr(interpreter, "_has_bpy", lambda: False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.delenv("DROGUEKIT_BLENDER", raising=False)
    return programs


def program(path: Path, *lines: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(["#!/bin/sh", *lines, ""]), encoding="utf-8")
    path.chmod(0o755)
    return path


def test_the_order_is_named_then_this_python_then_made_then_a_program(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = program(bare / "blender", "exit 1")
    assert find_blender() == BlenderInterpreter(found, "on the search path")
    made = program(tmp_path / "data" / "droguekit" / "blender" / "bin" / "python", "exit 1")
    assert find_blender() == BlenderInterpreter(made, "made by droguekit doctor --make-blender")
    monkeypatch.setattr(interpreter, "_has_bpy", lambda: True)
    assert find_blender() == BlenderInterpreter(Path(sys.executable), "this Python")
    named = program(tmp_path / "other", "exit 1")
    monkeypatch.setenv("DROGUEKIT_BLENDER", str(named))
    assert find_blender() == BlenderInterpreter(named, "named in DROGUEKIT_BLENDER")


def test_a_named_blender_that_is_not_there_is_no_reason_to_take_another(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(bare / "blender", "exit 1")
    monkeypatch.setenv("DROGUEKIT_BLENDER", "/nowhere/blender")
    with pytest.raises(ValueError, match=r"^engine blender: DROGUEKIT_BLENDER=/nowhere/blender is not a program$"):
        find_blender()


def test_where_there_is_none_one_line_says_how_to_make_one(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["render", "smoke", "--engine", "blender", "--out", str(tmp_path / "out")]) == WRONG_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "droguekit: error: engine blender: no Blender is here; make one with: droguekit doctor --make-blender "
        "(or name a Python that has bpy, or a Blender program, in DROGUEKIT_BLENDER)"
    )
    assert not (tmp_path / "out").exists()


def test_a_python_runs_isolated_and_a_program_in_the_background(tmp_path: Path) -> None:
    python = program(tmp_path / "python", "echo Python 3.13.5")
    assert BlenderInterpreter(python, "").command("code") == [str(python), "-I", "-c", "code"]
    # Warnings may come first.
    blender = program(tmp_path / "other", "echo warning", "echo Blender 5.2.2 LTS")
    assert BlenderInterpreter(blender, "").command("code")[-2:] == ["--python-expr", "code"]
    assert "--background" in BlenderInterpreter(blender, "").command("code")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["echo something else"], "is neither a Python with bpy nor a Blender program"),
        (["exit 3"], "is neither a Python with bpy nor a Blender program"),
    ],
)
def test_what_is_neither_python_nor_blender_is_refused(tmp_path: Path, lines: list[str], message: str) -> None:
    other = program(tmp_path / "other", *lines)
    with pytest.raises(ValueError, match=f"^engine blender: {re.escape(str(other))} {message}$"):
        BlenderProcess(BlenderInterpreter(other, "named in DROGUEKIT_BLENDER"))


def test_a_python_without_blender_says_so_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("render.blender_engine.process.MEMORY_FOLDER", tmp_path / "none")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    # Without -S the same Python has what this one has.
    other = program(tmp_path / "python", f'exec "{Path(sys.executable).resolve()}" -S "$@"')
    with pytest.raises(ValueError, match=r"cannot be loaded by .*/python \(a test\): .*No module named '(bpy|numpy)'"):
        BlenderProcess(BlenderInterpreter(other, "a test"))
    assert not list(tmp_path.glob("droguekit-*"))


def fake_bpy(folder: Path, version: tuple[int, int, int]) -> Path:
    """A Python whose `bpy` has nothing but a version."""
    folder.mkdir()
    (folder / "bpy.py").write_text(f"class app:\n    version = {version}\n", encoding="ascii")
    run_with = f"import sys; sys.path.insert(0, {str(folder)!r}); exec(sys.argv[1])"
    # `--version`, or `-I -c CODE`.
    return program(
        folder / "python",
        'if [ "$1" = --version ]; then echo Python 3.11.0; exit; fi',
        f'exec "{sys.executable}" -c "{run_with}" "$3"',
    )


def test_a_blender_that_is_too_old_is_told_the_least_version(tmp_path: Path) -> None:
    old = fake_bpy(tmp_path / "old", (4, 3, 2))
    with pytest.raises(ValueError, match=r"this is Blender 4\.3\.2, and 5\.0 or newer is needed"):
        BlenderProcess(BlenderInterpreter(old, "a test"))


def test_messages_are_read_by_a_python_that_has_numpy_alone() -> None:
    """And name nothing of numpy's own, which differs between its versions."""
    window = ImageWindow(left_px=1, top_px=2, width_px=3, height_px=4, focal_px=np.float64(5.5), center_px=(6.0, 7.0))
    path = CameraPath(positions_m=np.arange(6.0).reshape(2, 3), quaternions=np.eye(4)[:2])
    request = PictureRequest(LIGHT, window, path, samples=(0, 4), bounces=1, seed=8, file="light")
    data = pickled(request)
    assert b"numpy" not in data.replace(b"render.blender_engine.messages", b"")
    read = pickle.loads(data)
    assert read.window == window and np.array_equal(read.path.positions_m, path.positions_m)
    assert read.path.positions_m.flags.writeable
    code = (
        "import pickle, sys\n"
        f"sys.path.insert(0, {str(REPOSITORY)!r})\n"
        "request = pickle.load(sys.stdin.buffer)\n"
        "import render.blender_engine.worker\n"
        "print(request.path.positions_m.sum(), *{name.split('.')[0] for name in sys.modules})\n"
    )
    result = subprocess.run([sys.executable, "-P", "-c", code], input=data, capture_output=True, check=True)
    total, *modules = result.stdout.decode().split()
    assert float(total) == 15.0
    ours = {"datasets_manifest", "drogue_models", "geometry", "labelgen", "nav", "scenes", "droguekit"}
    assert {"numpy", "render"} <= set(modules)
    assert not set(modules) & {*ours, "scipy", "OpenEXR", "cv2", "pydantic", "trimesh", "matplotlib", "numba"}


def test_the_environment_s_packages_are_the_extra_s() -> None:
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    (extra,) = re.findall(r"^blender = \[(.*)\]$", text, re.MULTILINE)
    assert dict(re.findall(r"\"(bpy==[\d.]+); python_version == '([\d.]+)'\"", extra)) == {
        package: python for python, package in BPY_OF_PYTHON.items()
    }


def fitting_python(folder: Path, log: Path) -> None:
    """A Python 3.13 that makes empty environments."""
    program(
        folder / "python3.13",
        f'echo "$*" >> {log}',
        'if [ "$1" = -c ]; then echo 3.13; exit; fi',
        'mkdir -p "$4/bin" && printf "#!/bin/sh\\necho Python 3.13.5\\n" > "$4/bin/python" && chmod +x "$4/bin/python"',
    )


def test_doctor_makes_an_environment_and_tries_it(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", f"{bare}{os.pathsep}/usr/bin{os.pathsep}/bin")
    log = tmp_path / "log"
    fitting_python(bare, log)
    program(bare / "uv", f'echo "uv $*" >> {log}')
    run(["doctor", "--make-blender"])
    shown = capsys.readouterr().out
    made = tmp_path / "data" / "droguekit" / "blender"
    part = made.with_name("blender.part")
    steps = log.read_text(encoding="utf-8").splitlines()
    assert steps[-2:] == [f"-m venv --without-pip {part}", f"uv pip install --python {part}/bin/python bpy==5.2.3"]
    assert f"blender    making {made} with Python 3.13, {bare / 'python3.13'}" in shown
    assert "blender    installing bpy==5.2.3 (350 MB)" in shown
    # Its Python answers with nothing: it was tried.
    assert f"engine     blender does not work: engine blender: cannot be loaded by {made}/bin/python" in shown
    assert (made / "bin" / "python").exists() and not part.exists()


def test_an_installation_that_fails_leaves_the_old_environment(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", f"{bare}{os.pathsep}/usr/bin{os.pathsep}/bin")
    fitting_python(bare, tmp_path / "log")
    program(bare / "uv", "echo Collecting", "echo no space left >&2", "exit 1")
    old = program(tmp_path / "data" / "droguekit" / "blender" / "bin" / "python", "exit 1")
    assert run(["doctor", "--make-blender"]) == WRONG_INPUT
    assert capsys.readouterr().err == ("droguekit: error: doctor: bpy==5.2.3 cannot be installed: no space left\n")
    assert old.exists() and not (tmp_path / "data" / "droguekit" / "blender.part").exists()


def test_without_a_fitting_python_doctor_says_which_are(
    bare: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("droguekit.workflows.installation.sys.executable", str(bare / "none"))
    assert run(["doctor", "--make-blender"]) == WRONG_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("droguekit: error: doctor: Blender's package needs Python 3.13 or 3.11, and neither is here")


def test_doctor_without_blender_names_the_line_that_makes_it(bare: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from droguekit.workflows.installation import _blender_lines

    (line,) = _blender_lines()
    assert line.startswith(
        "engine     blender is optional: engine blender: no Blender is here; make one with: droguekit"
    )
