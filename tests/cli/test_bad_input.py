"""Bad input: one line that says what, where and what to do, exit code 2, and nothing half-written."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from datasets_manifest.storage import layout
from datasets_manifest.types.estimates import read_estimates
from droguekit.cli.main import FAULT, WRONG_INPUT, run
from tests.support.recipe_builder import between, recipe_text

RECIPE = recipe_text(name="mine", frames={"count": 2}, distance=between(3.0, 9.0), render={"samples_per_px": 1})


def _run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The command as a user sees it, in this process."""
    words = [str(argument) for argument in arguments]
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(words)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def _assert_refused(result: subprocess.CompletedProcess[str], message: str) -> None:
    errors = [line for line in result.stderr.splitlines() if line.startswith("droguekit: error: ")]
    assert result.returncode == WRONG_INPUT, result.stderr
    assert len(errors) == 1
    assert errors[0] == result.stderr.splitlines()[-1]
    assert re.search(message, errors[0])
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[frames]", "[frames]\ncolour = 1"), r"mine\.toml.*frames\.colour"),
        (("[render]", "[render]\nsample_per_px = 1"), r"mine\.toml.*render\.sample_per_px"),
        (("low_m = 3.0", "low_m = 1.0"), r"mine\.toml.*distance: 1 m is nearer than 1\.\d\d m"),
        (("[frames]", "seed = -1\n[frames]"), r"mine\.toml"),
        (("count = 2", "count = 0"), r"mine\.toml.*frames\.count"),
        (("[render]", '[render]\nengine = "povray"'), r"engine: no engine named 'povray'; there are"),
        (("[frames]", "[frames"), r"mine\.toml: not valid TOML"),
    ],
)
def test_a_wrong_recipe_names_file_and_key(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    recipe = tmp_path / "mine.toml"
    recipe.write_text(RECIPE.replace(*change))
    _assert_refused(_run("render", recipe, "--out", tmp_path / "out"), message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "-1"], r"seed: .*greater than or equal to 0, got -1"),
        (["--frames", "2:1"], r"--frames: .* got '2:1'"),
        (["--frames", "0:7"], r"--frames: must name frames of the recipe's 6"),
        (["--frames", "five"], r"--frames: must be A:B"),
        (["--workers", "-2"], r"workers: must not be negative, got -2"),
        (["--engine", "povray"], r"engine: no engine named 'povray'"),
        (["--timeout", "inf"], r"--timeout: must be above 0 s and at most 1e\+06 s, got inf"),
        (["--timeout", "nan"], r"--timeout: must be above 0 s and at most 1e\+06 s, got nan"),
        (["--timeout", "0"], r"--timeout: must be above 0 s"),
        (["--timeout", "9", "--workers", "0"], r"--timeout: --workers 0 renders in this process, which sets no limit"),
    ],
)
def test_wrong_options_of_render(arguments: list[str], message: str, tmp_path: Path) -> None:
    _assert_refused(_run("render", "smoke", "--out", tmp_path / "out", *arguments), message)
    assert not (tmp_path / "out").exists()


def test_an_engine_that_is_not_installed(tmp_path: Path) -> None:
    blocked = tmp_path / "blocked"
    blocked.mkdir()
    # What `import mitsuba` and its metadata look like where the package is missing, in this process and its workers.
    (blocked / "sitecustomize.py").write_text(
        "import sys, importlib.metadata as metadata\n"
        "sys.modules['mitsuba'] = None\n"
        "found = metadata.Distribution.from_name\n"
        "def from_name(name):\n"
        "    if name == 'mitsuba':\n"
        "        raise metadata.PackageNotFoundError(name)\n"
        "    return found(name)\n"
        "metadata.Distribution.from_name = staticmethod(from_name)\n"
    )
    out = tmp_path / "out"
    result = subprocess.run(
        [sys.executable, "-m", "droguekit.cli.main", "render", "smoke", "--out", str(out), "--workers", "1"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(blocked)},
    )
    _assert_refused(result, r"mitsuba.*not installed.*pip install")
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["benchmark", "none", "--detector", "color-blob", "--html", "file/page.html"], "Not a directory"),
        (["export", "none", "--format", "coco", "--out", "file"], "Not a directory"),
        (["navigate", "none", "--out", f"{300 * 'x'}/estimates.jsonl"], "File name too long"),
    ],
)
def test_an_output_that_cannot_be_written_is_told_before_the_work(
    arguments: list[str],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    # The dataset, which is not there either, has not been looked for.
    assert run(arguments) == WRONG_INPUT
    assert capsys.readouterr().err.strip() == f"droguekit: error: {arguments[-1]}: cannot be written: {reason}"


def test_an_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    _assert_refused(_run("render", "smoke", "--out", tmp_path / "file" / "out"), r"file.*Not a directory")
    if os.geteuid() != 0:  # nothing is unwritable for root
        (tmp_path / "closed").mkdir(mode=0o555)
        _assert_refused(_run("render", "smoke", "--out", tmp_path / "closed" / "out"), r"closed.*Permission denied")


@pytest.mark.parametrize(
    ("engine", "most_bytes", "message"),
    [
        ("analytic", 500_000, r"out/frames/000000: cannot be written: File too large"),
        pytest.param("mitsuba", 20_000, r"cannot be .*File too large", marks=pytest.mark.mitsuba),
    ],
)
def test_a_full_disk_leaves_nothing_half_written(
    engine: str,
    most_bytes: int,
    message: str,
    tmp_path: Path,
    full_disk: Callable[[int], AbstractContextManager[None]],
) -> None:
    recipe, out = tmp_path / "mine.toml", tmp_path / "out"
    recipe.write_text(RECIPE.replace("3.0", "30.0").replace("9.0", "40.0"))
    # The larger limit first meets a noisy image of 1280 x 960 pixels, the smaller one a temporary file or the manifest.
    with full_disk(most_bytes):
        result = _run("render", recipe, "--out", out, "--workers", "1", "--engine", engine)
    _assert_refused(result, message)
    assert not out.exists()


@pytest.fixture
def damaged(smoke_dataset: Path, tmp_path: Path) -> Path:
    out = tmp_path / "damaged"
    shutil.copytree(smoke_dataset, out)
    return out


def test_a_truncated_image(damaged: Path, tmp_path: Path) -> None:
    image = layout.frame_folder(damaged, 1) / "right.png"
    image.write_bytes(image.read_bytes()[:2000])
    result = _run("validate", damaged)
    assert result.returncode == FAULT
    assert re.search(r"000001/right\.png", result.stdout)
    # One pair does not end the work on the others.
    estimates, detections = tmp_path / "estimates.jsonl", tmp_path / "detections.json"
    for command in (["navigate", "--method", "constant", "--out", estimates], ["detect", "--out", detections]):
        result = _run(command[0], damaged, *command[1:])
        assert result.returncode == FAULT
        assert re.search(r"first pair 1: .*000001/right\.png: the PNG is truncated", result.stderr)
        assert "Traceback" not in result.stderr
    pairs = len(list((damaged / "frames").iterdir()))
    assert len(list(read_estimates(estimates))) == pairs
    assert {entry["image_id"] for entry in json.loads(detections.read_text())}.isdisjoint({3, 4})


def test_a_truncated_record(damaged: Path, tmp_path: Path) -> None:
    record = layout.frame_folder(damaged, 2) / layout.RECORD_FILE
    record.write_bytes(record.read_bytes()[:500])
    result = _run("validate", damaged)
    assert result.returncode == FAULT
    assert re.search(r"000002/record\.json", result.stdout)
    _assert_refused(_run("preview", damaged, "--out", tmp_path / "sheet.png"), r"000002/record\.json: is truncated")
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]
    estimates, page = tmp_path / "estimates.jsonl", tmp_path / "report.html"
    assert _run("navigate", damaged, "--method", "constant", "--out", estimates).returncode == FAULT
    for command in (
        ["benchmark", damaged, "--estimates", estimates, "--html", page],
        ["export", damaged, "--format", "parquet", "--out", tmp_path / "table"],
    ):
        result = _run(*command)
        assert result.returncode == FAULT
        assert re.search(r"1 pair has no result by a fault, first pair 2: .*000002/record\.json", result.stderr)
        assert "Traceback" not in result.stderr
    assert page.stat().st_size > 0
    for written in (estimates, page):
        written.unlink()
    shutil.rmtree(tmp_path / "table")
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["validate"],
        ["navigate", "--out", "e.jsonl"],
        ["preview", "--out", "s.png"],
        ["reproduce", "--frame", "0"],
        ["export", "--format", "coco", "--out", "x"],
        ["benchmark", "--estimates", "e.jsonl"],
    ],
)
def test_a_dataset_that_is_not_there(arguments: list[str], tmp_path: Path) -> None:
    name, *rest = arguments
    _assert_refused(_run(name, tmp_path / "missing", *rest), r"missing: there is no such dataset folder")


@pytest.mark.parametrize("format_", ["parquet", "huggingface"])
def test_a_name_that_is_not_utf8_is_told(format_: str, smoke_dataset: Path, tmp_path: Path) -> None:
    """Libraries refuse such a name without saying which."""
    place = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9/out"))
    result = _run("export", smoke_dataset, "--format", format_, "--out", place)
    _assert_refused(result, r"caf\udce9: has characters that are not UTF-8; rename the file or folder$")


def test_wrong_names_of_methods_formats_and_frames(smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    _assert_refused(_run("navigate", smoke_dataset, "--method", "guess", "--out", out), r"'guess'.*paper")
    _assert_refused(_run("export", smoke_dataset, "--format", "voc", "--out", out), r"no format named 'voc'; there are")
    _assert_refused(_run("preview", smoke_dataset, "--out", tmp_path / "sheet.gif"), r"must end in \.png or \.jpg")
    _assert_refused(_run("preview", smoke_dataset, "--out", tmp_path / "s.png", "--columns", "0"), r"--columns")
    _assert_refused(_run("reproduce", smoke_dataset, "--frame", "99"), r"has no frame 99")
    assert list(tmp_path.iterdir()) == []


def test_estimates_that_are_none(smoke_dataset: Path, tmp_path: Path) -> None:
    estimates = tmp_path / "estimates.jsonl"
    estimates.write_text('{"status": "fix"}\n')
    result = _run("benchmark", smoke_dataset, "--estimates", estimates, "--json", tmp_path / "out.json")
    _assert_refused(result, r"estimates\.jsonl, line 1: not a pose estimate: fix\.\S+: Field required")
    assert [path.name for path in tmp_path.iterdir()] == ["estimates.jsonl"]


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("render", "smoke", "--out", ""), "--out"),
        (("merge", "", "a"), "OUT"),
        (("merge", "a", ""), "SHARD"),
        (("validate", " "), "DIR"),
        (("navigate", "", "--out", "poses.jsonl"), "DIR"),
        (("real-check", "a", "--known", ""), "--known"),
    ],
)
def test_an_empty_place_is_not_the_current_folder(
    words: tuple[str, ...], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _assert_refused(_run(*words), rf"{name}: must name a folder or a URL, got ' ?'")
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_file_system_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), "part")

    out = tmp_path / "drogue.stl"
    monkeypatch.setattr(Path, "open", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    _assert_refused(_run("model", "--out", out), f"--out: {out} cannot be written: Read-only file system")
