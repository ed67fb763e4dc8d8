"""Each command on a real dataset, through its own entry point."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage import layout
from datasets_manifest.storage.manifest import build_manifest, read_manifest, write_manifest
from datasets_manifest.storage.writer import write_calibration
from datasets_manifest.types.estimates import read_estimates
from droguekit.cli.main import DONE, WRONG_INPUT, run
from nav.runner import method_names
from render.mitsuba_engine.variant import probe_variant
from tests.support.recipe_builder import RIG_160_PX, recipe_text, stations
from tests.support.small_datasets import SINGLE_PAIRS

# The scalar variant takes its time with every pixel.
SMALL_RECIPE = recipe_text(
    name="small",
    rig=RIG_160_PX,
    frames={"count": 2},
    distance=stations(10.0),
    render={"samples_per_px": 1, "surround_samples_per_px": 1, "max_depth": 2},
)


def no_engines() -> Generator[str, None, bool]:
    """Takes the place of a look at the engines, which takes seconds."""
    yield from ()
    return True


def test_validate_finds_nothing_in_what_render_made(smoke_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["validate", str(smoke_dataset)]) == DONE
    assert capsys.readouterr().out.endswith(f"{smoke_dataset}: 6 pairs, no faults\n")


def test_reproduce_says_what_it_proved(smoke_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["reproduce", str(smoke_dataset), "--frame", "4"]) == DONE
    assert capsys.readouterr().out == "frame 4: record and images are the same bit for bit\n"


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_preview_shows_every_pair_it_is_asked_for(smoke_dataset: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"sheet{suffix}"
    options = ["--count", "5", "--columns", "3", "--tile-width", "160"]
    assert run(["preview", str(smoke_dataset), "--out", str(out), *options]) == DONE
    sheet = cv2.imread(str(out))
    # Two rows of three tiles of 160 x (120 + 22 for the caption), with gaps of 4 around each.
    assert sheet.shape == (2 * (120 + 22) + 3 * 4, 3 * 160 + 4 * 4, 3)
    captions = [sheet[4 + row * 146 + 120 : 4 + row * 146 + 142] for row in (0, 1)]
    tiles = [caption[:, 4 + column * 164 : 164 + column * 164] for caption in captions for column in range(3)]
    assert [bool(np.ptp(tile) > 100) for tile in tiles] == [True] * 5 + [False]


def test_export_adds_markers_and_hubs_to_the_annotations_that_the_dataset_has(
    smoke_dataset: Path, tmp_path: Path
) -> None:
    assert run(["export", str(smoke_dataset), "--format", "coco", "--out", str(tmp_path / "coco")]) == DONE
    exported = json.loads((tmp_path / "coco" / "all.json").read_text())
    stored = json.loads((smoke_dataset / layout.ANNOTATIONS_FOLDER / "all.json").read_text())
    assert [entry for entry in exported["annotations"] if entry["category_id"] == 1] == stored["annotations"]
    assert {entry["category_id"] for entry in exported["annotations"]} == {1, 2, 3}


def test_navigate_writes_one_estimate_for_each_pair_and_method(smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "estimates.jsonl"
    assert run(["navigate", str(smoke_dataset), "--method", "joint", "--method", "paper", "--out", str(out)]) == DONE
    found = [(estimate.frame_index, estimate.method) for estimate in read_estimates(out)]
    assert found == [(index, method) for index in range(6) for method in ("joint", "paper")]


def test_plan_counts_without_rendering(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "smoke", "--no-probe"]) == DONE
    shown = capsys.readouterr().out
    assert "smoke: 6 pairs of 2 x 320 x 240" in shown
    assert "by split: train 3, val 0, test 3" in shown
    assert [int(count) for count in re.findall(r"^ +[\d.]+ m +(\d+) #+$", shown, re.MULTILINE)] == [2, 2, 2]


@pytest.mark.mitsuba
def test_doctor_names_the_engine_that_works_and_what_a_gpu_lacks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    assert run(["doctor"]) == DONE
    shown = capsys.readouterr().out
    assert re.search(r"^engine +mitsuba works as (llvm_ad_rgb|scalar_rgb): ", shown, re.MULTILINE)
    assert re.search(r"^gpu +is optional: device cuda: no NVIDIA driver, as /nonexistent/", shown, re.MULTILINE)


def test_doctor_names_viewer_and_browser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("droguekit.workflows.installation.engine_lines", no_engines)
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(__version__="0.99.1"))
    (tmp_path / "chromium").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run(["doctor"]) == DONE
    shown = capsys.readouterr().out
    assert re.search(r"^viewer +rerun 0\.99\.1, for droguekit view$", shown, re.MULTILINE)
    assert re.search(rf"^browser +{tmp_path}/chromium, for droguekit report --pdf$", shown, re.MULTILINE)


def test_doctor_tells_how_to_get_viewer_and_browser_and_finds_no_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("droguekit.workflows.installation.engine_lines", no_engines)
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run(["doctor"]) == DONE
    shown = capsys.readouterr().out
    assert re.search(r"^viewer +rerun is optional: .*; pip install 'droguekit\[viz\]'$", shown, re.MULTILINE)
    assert re.search(r"^browser +Chromium is optional: .*apt-get install chromium", shown, re.MULTILINE)


@pytest.mark.mitsuba
def test_demo_goes_from_a_recipe_to_a_report_and_keeps_what_is_there(
    smoke_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "demo"
    shutil.copytree(smoke_dataset, out / "dataset")
    assert run(["demo", "smoke", "--out", str(out)]) == DONE
    told = capsys.readouterr()
    assert "6 of 6 pairs exist already" in told.err
    assert sorted(path.name for path in out.iterdir()) == [
        "benchmark.json",
        "dataset",
        "estimates.jsonl",
        "report.html",
    ]
    result = json.loads((out / "benchmark.json").read_text())
    assert result["schema"] == 1
    assert result["dataset"]["sha256"] == read_manifest(smoke_dataset).dataset_sha256
    assert set(result["methods"]) == set(method_names())
    assert "<svg" in (out / "report.html").read_text()


@pytest.mark.slow
def test_demo_reports_a_few_pairs_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("droguekit.cli.demo._FIRST_PAIRS", 2)
    (tmp_path / "small.toml").write_text(recipe_text(SINGLE_PAIRS, frames={"count": 3}))
    out = tmp_path / "out"
    command = ["demo", str(tmp_path / "small.toml"), "--out", str(out), "--workers", "0"]
    assert run(command) == DONE
    told = capsys.readouterr().err
    assert f"{out}/report.html has a first report, of 2 pairs; going on to 3" in told
    assert told.index("rendering 2 stereo pairs") < told.index("first report") < told.index("rendering 3 stereo pairs")
    assert json.loads((out / "benchmark.json").read_text())["dataset"]["pairs"] == 3
    assert run(command) == DONE
    assert "first report" not in capsys.readouterr().err


@pytest.mark.slow
def test_demo_goes_on_where_its_first_pairs_show_no_drogue(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("droguekit.cli.demo._FIRST_PAIRS", 2)
    frames = {"count": 6, "empty_fraction": 0.6}
    (tmp_path / "small.toml").write_text(recipe_text(SINGLE_PAIRS, frames=frames, seed=2))
    out = tmp_path / "out"
    assert run(["demo", str(tmp_path / "small.toml"), "--out", str(out), "--workers", "0"]) == DONE
    assert "no drogue in the first 2 pairs, so there is no first report; going on to 6" in capsys.readouterr().err
    assert [entry.empty for entry in read_manifest(out / "dataset").frames][:2] == [True, True]
    assert json.loads((out / "benchmark.json").read_text())["dataset"]["pairs"] == 6


@pytest.mark.slow
@pytest.mark.mitsuba
def test_the_slow_variant_is_announced_and_no_other_one_continues_its_dataset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "small.toml").write_text(SMALL_RECIPE)
    command = [sys.executable, "-m", "droguekit.cli.main", "render", str(tmp_path / "small.toml")]
    # A library that is not there leaves the scalar variant.
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": "/nonexistent/libLLVM.so"}
    options = ["--out", str(tmp_path / "out"), "--workers", "1", "--frames", "0:1"]
    done = subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    assert "engine mitsuba runs as scalar_rgb" in done.stdout + done.stderr
    assert (tmp_path / "out" / "frames" / "000000" / "record.json").is_file()
    if probe_variant().variant == "scalar_rgb":
        return
    assert run([*command[3:], "--out", str(tmp_path / "out"), "--workers", "1"]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert re.search(r"its frames were made by mitsuba .* scalar_rgb, .* but this is mitsuba .* llvm_ad_rgb, ", told)


@pytest.mark.parametrize(
    "arguments",
    [
        ["detect", "EMPTY", "--detector", "color-blob", "--out", "OUT"],
        ["navigate", "EMPTY", "--method", "constant", "--out", "OUT"],
        ["diff", "EMPTY", "WHOLE"],
        ["diff", "WHOLE", "EMPTY"],
        ["preview", "EMPTY", "--out", "OUT.png"],
        ["browse", "EMPTY", "--out", "OUT"],
        ["export", "EMPTY", "--format", "coco", "--out", "OUT"],
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_dataset_without_pairs_is_one_line(
    arguments: list[str], dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty, recipe = tmp_path / "empty", parse_recipe(SMALL_RECIPE)
    empty.mkdir()
    write_manifest(empty, build_manifest(empty, recipe, "1", {}))
    write_calibration(empty, recipe.rig)
    places = {"EMPTY": empty, "WHOLE": dataset, "OUT": tmp_path / "out", "OUT.png": tmp_path / "out.png"}
    assert run([str(places.get(word, word)) for word in arguments]) == WRONG_INPUT
    line = capsys.readouterr().err.splitlines()[-1]  # behind progress
    assert re.search(rf"{empty}: .*no pairs", line)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset", "empty"]
