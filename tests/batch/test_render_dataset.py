"""Whole runs: the same dataset whatever the order, the workers and the accidents."""

from __future__ import annotations

import fcntl
import io
import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from datasets_manifest.atomic import PART_SUFFIX
from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage import layout
from datasets_manifest.storage.manifest import read_manifest, with_build, write_manifest
from datasets_manifest.storage.writer import leftovers
from droguekit.batch import render_dataset as rendering
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.frame_task import FrameReport, FrameTask, reproduce_frame
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import EventLog, make_frames, render_dataset
from droguekit.batch.worker_pool import MAX_ATTEMPTS, TaskAttempt, WorkerDiedError, run_in_own_process
from render.engine import EngineUnavailableError
from tests.support.batch_datasets import ANALYTIC_RECIPE, QUICK_RECIPE, TINY_RECIPE, file_hashes, render_recipe


def test_reverse_order_and_two_workers_give_the_same_files(tiny_dataset: Path, tmp_path: Path) -> None:
    summary = render_recipe(tmp_path / "again", [3, 2, 1, 0], 2)
    assert summary.dataset_sha256 == read_manifest(tiny_dataset).dataset_sha256
    assert file_hashes(tmp_path / "again") == file_hashes(tiny_dataset)


class Deleting(PlainProgress):
    """A progress report during which somebody deletes a place, once so many frames are finished."""

    def __init__(self, place: Path, frames: int) -> None:
        super().__init__(io.StringIO())
        self._place, self._left = place, frames

    def advance(self) -> None:
        super().advance()
        self._left -= 1
        if self._left == 0:
            shutil.rmtree(self._place)


@pytest.mark.parametrize(("place", "lost"), [("frames/000001", [1]), ("frames", [0, 1, 2]), ("", [0, 1, 2])])
def test_frames_that_vanish_during_the_run_are_named(
    place: str, lost: list[int], analytic_dataset: Path, tmp_path: Path
) -> None:
    out, source = tmp_path / "out", RecipeSource(parse_recipe(ANALYTIC_RECIPE), ANALYTIC_RECIPE)
    for index in (0, 1):
        shutil.copytree(layout.frame_folder(analytic_dataset, index), layout.frame_folder(out, index))
    for name in (layout.MANIFEST_FILE, layout.RECIPE_FILE):
        shutil.copy(analytic_dataset / name, out / name)
    # Two of them were there before, and one is made.
    summary = render_dataset(source, out, range(4), 0, Deleting(out / place, 1))
    assert [drop.frame_index for drop in summary.drops] == lost
    assert all("somebody deleted it during the run" in drop.reason for drop in summary.drops)
    assert read_manifest(out).drops == summary.drops
    assert (out / layout.RECIPE_FILE).read_text() == ANALYTIC_RECIPE
    again = render_dataset(source, out, range(8), 0, PlainProgress(io.StringIO()))
    assert again.drops == () and again.dataset_sha256 == read_manifest(analytic_dataset).dataset_sha256


def accident(index: int, number: int, code: int = -signal.SIGILL) -> TaskAttempt[FrameReport]:
    return TaskAttempt(index, number, None, WorkerDiedError(code), final=number == MAX_ATTEMPTS)


@pytest.mark.parametrize(("workers", "most"), [(2, 9), (16, 32)])
def test_a_death_that_the_first_frames_share_ends_the_run(
    workers: int, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = [accident(index, number) for number in (1, 2, 3) for index in range(100)]
    monkeypatch.setattr(rendering, "run_tasks", lambda *_: (attempt for attempt in attempts))
    told, task = io.StringIO(), FrameTask(parse_recipe(TINY_RECIPE), tmp_path)
    expected = rf"no frame can be made: {most} attempts failed, the last: its worker process died \(SIGILL\); .*\.drjit"
    with pytest.raises(OSError, match=expected):
        make_frames(task, range(100), ExecutionOptions(workers), PlainProgress(told), EventLog(io.StringIO()))
    assert len(told.getvalue().splitlines()) == most - 1


def test_deaths_of_frames_that_were_left_out_before_cost_those_frames_only(
    troubled: Callable[..., Path], quick_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, left_out = tmp_path / "out", (1, 3, 6)
    shutil.copytree(quick_dataset, out)
    for index in left_out:
        shutil.rmtree(layout.frame_folder(out, index))
    troubled(refuse=left_out)
    assert len(render_recipe(out, workers=0, text=QUICK_RECIPE).drops) == 3
    deaths = [accident(index, number) for number in (1, 2, 3) for index in left_out]
    monkeypatch.setattr(rendering, "run_tasks", lambda *_: (death for death in deaths))
    summary = render_recipe(out, workers=2, text=QUICK_RECIPE)
    assert [drop.frame_index for drop in summary.drops] == [*left_out]
    assert all(drop.reason == "its worker process died (SIGILL), attempt 3 of 3" for drop in summary.drops)


def test_deaths_of_other_frames_end_a_run_beside_those_left_out_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deaths = [accident(index, number) for number in (1, 2, 3) for index in range(10)]
    monkeypatch.setattr(rendering, "run_tasks", lambda *_: (death for death in deaths))
    told, task = PlainProgress(io.StringIO()), FrameTask(parse_recipe(TINY_RECIPE), tmp_path, engine_version="1")
    with pytest.raises(OSError, match="no frame can be made: 9 attempts failed"):
        make_frames(task, range(10), ExecutionOptions(2), told, EventLog(io.StringIO()), range(5))


def test_deaths_after_a_frame_is_made_cost_their_frames_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = TaskAttempt(100, 1, FrameReport("here", 1.0, {}, None, 1), None, final=True)
    attempts = [made, *(accident(index, number) for number in (1, 2, 3) for index in range(100))]
    monkeypatch.setattr(rendering, "run_tasks", lambda *_: (attempt for attempt in attempts))
    task, told = FrameTask(parse_recipe(ANALYTIC_RECIPE), tmp_path), io.StringIO()
    totals, drops = make_frames(task, range(101), ExecutionOptions(2), PlainProgress(told), EventLog(io.StringIO()))
    assert (totals.made, totals.retries, len(drops)) == ([100], 200, 100)
    # Only the engine with a cache of kernels is said to have one.
    assert drops[0].reason == "its worker process died (SIGILL), attempt 3 of 3"


def test_an_error_that_the_first_frames_share_names_a_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = [TaskAttempt[FrameReport](index, 1, None, ValueError("no sky"), final=True) for index in range(4, 8)]
    monkeypatch.setattr(rendering, "run_tasks", lambda *_: (attempt for attempt in attempts))
    task, told = FrameTask(parse_recipe(ANALYTIC_RECIPE), tmp_path), io.StringIO()
    with pytest.raises(ValueError, match=r"^frame 6: no sky; the first 3 pairs all fail$"):
        make_frames(task, range(4, 8), ExecutionOptions(2), PlainProgress(told), EventLog(io.StringIO()))


def test_a_whole_dataset_is_left_as_it_is(tiny_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(tiny_dataset, out)
    before = {path: path.stat().st_mtime_ns for path in (out / layout.FRAMES_FOLDER).rglob("*")}
    summary = render_recipe(out)
    assert (summary.totals.made, summary.kept, summary.pairs, summary.planned) == ([], 4, 4, 4)
    assert {path: path.stat().st_mtime_ns for path in (out / layout.FRAMES_FOLDER).rglob("*")} == before
    assert file_hashes(out) == file_hashes(tiny_dataset)


def test_missing_truncated_and_changed_frames_are_made_again(analytic_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(analytic_dataset, out)
    shutil.rmtree(layout.frame_folder(out, 0))
    image = layout.frame_folder(out, 1) / "left.png"
    image.write_bytes(image.read_bytes()[:1000])
    record = layout.frame_folder(out, 2) / layout.RECORD_FILE
    record.write_text(record.read_text().replace('"family":"clear"', '"family":"foggy"'))
    summary = render_recipe(out, workers=0, text=ANALYTIC_RECIPE)
    assert set(summary.totals.made) == {0, 1, 2}
    assert summary.kept == 5
    assert file_hashes(out) == file_hashes(analytic_dataset)


def test_frames_that_no_manifest_vouches_for_are_made_again(analytic_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(analytic_dataset, out)
    (out / layout.MANIFEST_FILE).unlink()
    told = io.StringIO()
    assert render_recipe(out, workers=0, text=ANALYTIC_RECIPE, told=told).kept == 0
    assert f"{out}: its manifest.json is missing, so that its 8 pairs are discarded" in told.getvalue()
    assert file_hashes(out) == file_hashes(analytic_dataset)


@pytest.mark.parametrize("other", ["text", "seed", "no recipe"])
def test_frames_of_another_recipe_stay_where_the_manifest_is_missing(
    other: str, analytic_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(analytic_dataset, out)
    (out / layout.MANIFEST_FILE).unlink()
    text, seed = ANALYTIC_RECIPE, None
    if other == "text":
        text = text.replace('name = "quick"', 'name = "slow"')
    elif other == "seed":
        seed = 6
    else:
        (out / layout.RECIPE_FILE).unlink()
    before = file_hashes(out)
    recipe = parse_recipe(text, seed=seed)
    message = r"holds pairs without manifest\.json, not of this recipe and seed; give another folder"
    with pytest.raises(ValueError, match=message):
        render_dataset(RecipeSource(recipe, text), out, range(1), 0, PlainProgress(io.StringIO()))
    assert file_hashes(out) == before


def copy_without_manifest(dataset: Path, tmp_path: Path, damaged: range) -> Path:
    """A copy of a dataset that has lost its manifest and the ends of some records."""
    out = tmp_path / "copy"
    shutil.copytree(dataset, out)
    (out / layout.MANIFEST_FILE).unlink()
    for index in damaged:
        record = layout.frame_folder(out, index) / layout.RECORD_FILE
        record.write_bytes(record.read_bytes()[:100])
    return out


@pytest.mark.parametrize("damaged", [range(1), range(8)])
def test_pairs_whose_records_are_damaged_are_made_again_where_the_manifest_is_missing(
    damaged: range, analytic_dataset: Path, tmp_path: Path
) -> None:
    out = copy_without_manifest(analytic_dataset, tmp_path, damaged)
    assert render_recipe(out, workers=0, text=ANALYTIC_RECIPE).kept == 0
    assert file_hashes(out) == file_hashes(analytic_dataset)


@pytest.mark.parametrize("damaged", [range(1), range(8)])
def test_damaged_records_of_another_recipe_stay_where_the_manifest_is_missing(
    damaged: range, analytic_dataset: Path, tmp_path: Path
) -> None:
    out = copy_without_manifest(analytic_dataset, tmp_path, damaged)
    before = file_hashes(out)
    why = r"not of this recipe and seed" + (r" \(.*record\.json cannot be read\);" if len(damaged) == 8 else ";")
    with pytest.raises(ValueError, match=why):
        render_recipe(out, workers=0, text=ANALYTIC_RECIPE.replace('name = "quick"', 'name = "slow"'))
    if len(damaged) == 1:
        other_seed = RecipeSource(parse_recipe(ANALYTIC_RECIPE, seed=6), ANALYTIC_RECIPE)
        with pytest.raises(ValueError, match=why):
            render_dataset(other_seed, out, range(1), 0, PlainProgress(io.StringIO()))
    assert file_hashes(out) == before


def test_a_part_is_a_dataset_that_the_rest_completes(analytic_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "parts"
    first = render_recipe(out, range(1, 3), workers=0, text=ANALYTIC_RECIPE)
    assert (first.pairs, first.planned) == (2, 8)
    assert [entry.frame_index for entry in read_manifest(out).frames] == [1, 2]
    second = render_recipe(out, workers=0, text=ANALYTIC_RECIPE)
    assert (second.kept, second.pairs) == (2, 8)
    assert file_hashes(out) == file_hashes(analytic_dataset)


def test_a_run_that_was_killed_goes_on_to_the_same_dataset(analytic_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    script = tmp_path / "run.py"
    # Tells of each finished frame on a line, which is when the test kills it.
    script.write_text(
        "from pathlib import Path\n"
        "from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe\n"
        "from droguekit.batch.render_dataset import render_dataset\n"
        "class Tell:\n"
        "    def begin(self, what, total): pass\n"
        "    def advance(self): print('frame', flush=True)\n"
        "    def note(self, text): pass\n"
        "    def say(self, text): pass\n"
        "    def end(self): pass\n"
        "if __name__ == '__main__':\n"
        f"    text = {ANALYTIC_RECIPE!r}\n"
        f"    render_dataset(RecipeSource(parse_recipe(text), text), Path({str(out)!r}), range(8), 1, Tell())\n"
    )
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "frame\n"
        run.kill()
    made_before = len(layout.frame_indices(out))
    assert 1 <= made_before < 8
    assert render_recipe(out, workers=0, text=ANALYTIC_RECIPE).kept == made_before
    assert leftovers(out) == []
    assert file_hashes(out) == file_hashes(analytic_dataset)


def test_events_tell_of_every_frame_and_are_only_added_to(analytic_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(analytic_dataset, out)
    before = (out / layout.EVENTS_FILE).read_text()
    shutil.rmtree(layout.frame_folder(out, 3))
    render_recipe(out, text=ANALYTIC_RECIPE)
    text = (out / layout.EVENTS_FILE).read_text()
    assert text.startswith(before)
    first = [json.loads(line) for line in before.splitlines()]
    assert [line["event"] for line in first] == ["start", *["frame"] * 8, "end"]
    assert {line["frame"] for line in first if line["event"] == "frame"} == {*range(8)}
    new = [json.loads(line) for line in text[len(before) :].splitlines()]
    assert [(line["event"], line.get("frame")) for line in new] == [("start", None), ("frame", 3), ("end", None)]
    assert all(seconds >= 0 for seconds in new[1]["stage_s"].values())


def test_another_build_of_the_existing_pairs_is_told_and_recorded(analytic_dataset: Path, tmp_path: Path) -> None:
    out, told = tmp_path / "copy", io.StringIO()
    shutil.copytree(analytic_dataset, out)
    own = read_manifest(out)
    write_manifest(out, with_build(own, {**own.software, "numpy": "0.9"}, own.cpu_features))
    # A run that makes nothing changes nothing.
    before = file_hashes(out)
    render_recipe(out, [1], 0, ANALYTIC_RECIPE, told)
    assert "another build" not in told.getvalue() and read_manifest(out).software["numpy"] == "0.9"
    assert file_hashes(out).keys() == before.keys()
    for index in (1, 2):
        shutil.rmtree(layout.frame_folder(out, index))
        told = io.StringIO()
        render_recipe(out, [index], 0, ANALYTIC_RECIPE, told)
        assert "another build made the existing pairs, so new ones may differ in pixels or last digits: numpy" in (
            told.getvalue()
        )
        found = read_manifest(out)
        assert found.software == {**own.software, "numpy": f"0.9 and {own.software['numpy']}"}
        assert found.cpu_features == own.cpu_features
    assert reproduce_frame(out, 1).verdict == "identical"


def test_the_same_build_goes_on_without_a_word(analytic_dataset: Path, tmp_path: Path) -> None:
    out, told = tmp_path / "copy", io.StringIO()
    shutil.copytree(analytic_dataset, out)
    shutil.rmtree(layout.frame_folder(out, 1))
    render_recipe(out, workers=0, text=ANALYTIC_RECIPE, told=told)
    assert "another build" not in told.getvalue()
    assert file_hashes(out) == file_hashes(analytic_dataset)


def test_another_recipe_is_refused_with_the_keys_that_differ(tiny_dataset: Path) -> None:
    before = file_hashes(tiny_dataset)
    other = TINY_RECIPE.replace("seed = 5", "seed = 4").replace("high_m = 12.0", "high_m = 13.0")
    with pytest.raises(ValueError, match=r"another recipe: they differ in seed, distance\.high_m; give another folder"):
        render_recipe(tiny_dataset, text=other)
    assert file_hashes(tiny_dataset) == before


def test_frames_of_another_engine_build_are_not_mixed_in(tiny_dataset: Path, tmp_path: Path) -> None:
    task = FrameTask(parse_recipe(TINY_RECIPE), tmp_path, engine_version="mitsuba 0.1")
    with pytest.raises(ValueError, match=r"made by mitsuba 0\.1, but this is mitsuba .*, whose pixels differ"):
        run_in_own_process(partial(task, 0))
    assert list(tmp_path.iterdir()) == []


def test_the_device_reaches_the_process_that_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    task = FrameTask(parse_recipe(TINY_RECIPE), tmp_path, device="cuda")
    with pytest.raises(EngineUnavailableError, match=r"^device cuda: no NVIDIA driver"):
        run_in_own_process(partial(task, 0))


@pytest.mark.parametrize("frames", [[0, 0], [4], [-1]])
def test_frames_that_the_recipe_does_not_have_are_refused(tmp_path: Path, frames: list[int]) -> None:
    with pytest.raises(ValueError, match="frames: must be different indices from 0 to 3"):
        render_recipe(tmp_path / "out", frames)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "name",
    [
        "thesis.tex",
        "recipe.toml",
        "README.md",
        "croissant.json",
        "annotations/all.json",
        "calibration/kalibr_camchain.yaml",
        "frames/000000/left.png",
        "shards/notes.txt",
    ],
)
def test_a_folder_with_other_things_is_refused_and_untouched(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    message = re.escape(f"holds other files ({name.partition('/')[0]}); give a new or empty folder")
    with pytest.raises(ValueError, match=message):
        render_recipe(out)
    assert {path: path.read_text() for path in out.rglob("*") if path.is_file()} == {out / name: "mine"}
    assert (out / name).read_text() == "mine"


def test_what_a_killed_start_leaves_is_no_other_thing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / layout.FRAMES_FOLDER).mkdir(parents=True)
    (out / layout.RECIPE_FILE).write_text(ANALYTIC_RECIPE)
    (out / layout.EVENTS_FILE).touch()
    (out / f".{layout.MANIFEST_FILE}-0{PART_SUFFIX}").write_text("{")
    assert render_recipe(out, range(1), workers=0, text=ANALYTIC_RECIPE).pairs == 1
    assert leftovers(out) == []


def test_a_file_is_no_place_for_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match="is a file; give a folder"):
        render_recipe(tmp_path / "file")


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with (out / layout.EVENTS_FILE).open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="another run is writing into it"):
            render_recipe(out)
    assert [path.name for path in out.iterdir()] == [layout.EVENTS_FILE]
