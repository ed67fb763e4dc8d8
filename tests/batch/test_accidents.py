"""Engines that abort, hang and refuse: each loses its own frame, and all other files are as without it."""

from __future__ import annotations

import io
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage import layout
from datasets_manifest.storage.frame_store import list_frames, read_shard_index
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.storage import open_storage
from datasets_manifest.storage.writer import leftovers
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.render_dataset import unit_of_frame
from droguekit.batch.task_queue import TaskQueue
from droguekit.cli.main import INTERRUPTED
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.batch_datasets import ANALYTIC_RECIPE, QUICK_RECIPE, file_hashes, render_recipe

Troubled = Callable[..., Path]


def made_before(frame_index: int) -> list[int]:
    """The frames that one worker makes before this one, scene by scene."""
    unit_of = partial(unit_of_frame, parse_recipe(ANALYTIC_RECIPE))
    order = TaskQueue(range(8), unit_of).in_rows()
    return sorted(order[: order.index(frame_index)])


def test_an_engine_that_aborts_once_is_forgiven(troubled: Troubled, quick_dataset: Path, tmp_path: Path) -> None:
    troubled(abort_once=[5])
    stormy = render_recipe(tmp_path / "stormy", workers=2, text=QUICK_RECIPE)
    assert (stormy.drops, stormy.totals.retries, sorted(stormy.totals.made)) == ((), 1, list(range(8)))
    assert file_hashes(tmp_path / "stormy") == file_hashes(quick_dataset)


def test_frames_that_abort_always_are_reported_and_made_later(
    troubled: Troubled, quick_dataset: Path, tmp_path: Path
) -> None:
    troubled(abort=[3])
    told = io.StringIO()
    out = tmp_path / "stormy"
    stormy = render_recipe(out, text=QUICK_RECIPE, told=told)
    reason = "its worker process died (SIGABRT), attempt 3 of 3"
    assert [(drop.frame_index, drop.reason) for drop in stormy.drops] == [(3, reason)]
    assert read_manifest(out).drops == stormy.drops
    assert (stormy.pairs, stormy.totals.retries) == (7, 2)
    assert "frame 3: its worker process died (SIGABRT), attempt 1 of 3; it is tried again" in told.getvalue()
    assert re.search(r"^pairs: 8 of 8, .* a minute, 2 repeated, 1 left out", told.getvalue(), re.MULTILINE)
    lines = [json.loads(line) for line in (out / layout.EVENTS_FILE).read_text().splitlines()]
    events = [line["event"] for line in lines]
    assert (events.count("frame"), events.count("retry"), events.count("drop")) == (7, 2, 1)
    assert (lines[-1]["made"], lines[-1]["retries"], lines[-1]["drops"]) == (7, 2, 1)
    assert lines[-1]["size_bytes"] == sum(line["size_bytes"] for line in lines if line["event"] == "frame")
    # A Python process with numpy in it holds some tens of MiB, and a small frame's worker less than 2 GiB.
    assert 0.01 < lines[-1]["workers_peak_gib"] < 4.0
    # Accidents of an earlier run do not count in the next one.
    troubled()
    again = render_recipe(out, workers=0, text=QUICK_RECIPE)
    assert again.dataset_sha256 == read_manifest(quick_dataset).dataset_sha256
    assert file_hashes(out) == file_hashes(quick_dataset)


@pytest.mark.slow  # for as long as the time that the frame is given
def test_a_frame_that_hangs_is_stopped_and_tried_again(troubled: Troubled, quick_dataset: Path, tmp_path: Path) -> None:
    marks = troubled(hang_once=[1])
    told, out = io.StringIO(), tmp_path / "out"
    summary = render_recipe(out, [1], ExecutionOptions(1, timeout_s=60.0), QUICK_RECIPE, told)
    assert (marks / "hang-1").exists()
    assert "frame 1: it was still at work after 60 s and was stopped, attempt 1 of 3; it is tried" in told.getvalue()
    # The frame takes about 50 ms; where a crowded machine gives all its attempts too little time, it is made later.
    assert summary.totals.made == [1] or [drop.frame_index for drop in summary.drops] == [1]
    assert render_recipe(out, [1], text=QUICK_RECIPE).pairs == 1
    assert file_hashes(layout.frame_folder(out, 1)) == file_hashes(layout.frame_folder(quick_dataset, 1))


def test_a_frame_that_is_refused_is_dropped_at_once_with_its_reason(troubled: Troubled, tmp_path: Path) -> None:
    troubled(refuse=[6])
    summary = render_recipe(tmp_path / "out", text=QUICK_RECIPE)
    assert [(drop.frame_index, drop.reason) for drop in summary.drops] == [(6, "frame 6 is beyond me")]
    assert (summary.pairs, summary.totals.retries) == (7, 0)


def test_an_error_of_all_frames_ends_the_run(troubled: Troubled, tmp_path: Path) -> None:
    troubled(refuse=[*range(8)])
    with pytest.raises(RuntimeError, match="beyond me"):
        render_recipe(tmp_path / "out", text=QUICK_RECIPE)
    assert not (tmp_path / "out").exists()


def test_a_full_disk_ends_the_run_and_the_rest_goes_on_later(
    troubled: Troubled, quick_dataset: Path, tmp_path: Path
) -> None:
    troubled(no_space=[4])
    with pytest.raises(OSError, match="frame 4: cannot be made: /scratch: No space left on device"):
        render_recipe(tmp_path / "out", text=QUICK_RECIPE)
    before = made_before(4)
    assert before and layout.frame_indices(tmp_path / "out") == before
    troubled()
    assert render_recipe(tmp_path / "out", workers=0, text=QUICK_RECIPE).kept == len(before)
    assert file_hashes(tmp_path / "out") == file_hashes(quick_dataset)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], object]]:
    """Mounts a small file system at `tmp_path/disk`; call it to mount it anew with other options."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("mounting a file system of its own takes rights that this process does not have")
    yield lambda options: subprocess.run(["mount", "-o", f"remount,{options}", disk], check=True)
    subprocess.run(["umount", "--lazy", disk], check=True)


def test_a_disk_that_is_full_and_one_that_is_read_only(
    small_disk: Callable[[str], object],
    analytic_dataset: Path,
    tmp_path: Path,
) -> None:
    out = tmp_path / "disk" / "out"
    with pytest.raises(OSError, match="No space left on device"):
        render_recipe(out, text=ANALYTIC_RECIPE)
    there = layout.frame_indices(out)
    assert 0 < len(there) < 8
    assert leftovers(out) == []
    small_disk("ro,size=50m")
    with pytest.raises(OSError, match="Read-only file system"):
        render_recipe(out, text=ANALYTIC_RECIPE)
    small_disk("rw,size=50m")
    assert render_recipe(out, workers=0, text=ANALYTIC_RECIPE).kept == len(there)
    assert file_hashes(out) == file_hashes(analytic_dataset)


@pytest.fixture
def waiting_run(
    troubled: Troubled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], subprocess.Popen[str]]:
    """Starts `render` with one worker in a process of its own, and returns when it works on frame 2."""
    troubled(wait=[2])
    for name in ("begun", "go-on"):
        os.mkfifo(tmp_path / name)
    monkeypatch.setenv("TROUBLE_BEGUN", str(tmp_path / "begun"))
    monkeypatch.setenv("TROUBLE_GO_ON", str(tmp_path / "go-on"))
    (tmp_path / "quick.toml").write_text(QUICK_RECIPE)

    def start() -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "droguekit.cli.main", "render", str(tmp_path / "quick.toml")]
        options = ["--out", str(tmp_path / "out"), "--workers", "1"]
        process = subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True)
        # Opened without waiting for the writer, so that a run that ends early fails instead of hanging.
        begun = os.open(tmp_path / "begun", os.O_RDONLY | os.O_NONBLOCK)
        is_told, _, _ = select.select([begun], [], [], 120.0)
        told = os.read(begun, 10) if is_told else b""
        os.close(begun)
        assert told == b"2\n"
        return process

    return start


def await_line(process: subprocess.Popen[str], beginning: str) -> None:
    """Read errors until a line begins so; on a slow machine lines of progress come before it.

    A run that never prints the line is killed after two minutes, and so fails instead of hanging.
    """
    assert process.stderr is not None
    deadline = threading.Timer(120.0, process.kill)
    deadline.start()
    try:
        assert any(line.startswith(beginning) for line in process.stderr)
    finally:
        deadline.cancel()


# What SIGINT does at first is seen with the second signal too.
@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_one_signal_finishes_the_frame_in_hand_and_says_how_to_go_on(
    waiting_run: Callable[[], subprocess.Popen[str]],
    number: signal.Signals,
    troubled: Troubled,
    tmp_path: Path,
) -> None:
    with waiting_run() as process:
        assert process.stderr is not None
        process.send_signal(number)
        await_line(process, "stopping after the running frames (1)")
        (tmp_path / "go-on").write_text("")
        told = process.stderr.read().splitlines()
    assert process.returncode == INTERRUPTED
    made = sorted([*made_before(2), 2])
    assert told[-2:] == [
        f"stopped after {len(made)} of 8 pairs, all of them complete",
        "droguekit: interrupted; run the same command to continue",
    ]
    out = tmp_path / "out"
    assert layout.frame_indices(out) == made
    assert leftovers(out) == []
    troubled()
    assert render_recipe(out, workers=0, text=QUICK_RECIPE).kept == len(made)


def test_a_second_signal_stops_at_once_and_loses_only_the_frame_in_hand(
    waiting_run: Callable[[], subprocess.Popen[str]], troubled: Troubled, tmp_path: Path
) -> None:
    with waiting_run() as process:
        assert process.stderr is not None
        process.send_signal(signal.SIGINT)
        await_line(process, "stopping after ")
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()
    assert process.returncode == INTERRUPTED
    assert "Traceback" not in told
    out = tmp_path / "out"
    assert layout.frame_indices(out) == made_before(2)
    troubled()
    assert render_recipe(out, workers=0, text=QUICK_RECIPE).kept == len(made_before(2))


@pytest.mark.slow
def test_a_jump_of_the_clock_changes_nothing(troubled: Troubled, quick_dataset: Path, tmp_path: Path) -> None:
    library = tmp_path / "jumping_clock.so"
    source = tmp_path / "jumping_clock.c"
    # The time of day jumps a day back or forth with every look at it; the monotonic clock stays.
    source.write_text(
        "#define _GNU_SOURCE\n#include <time.h>\n#include <sys/time.h>\n#include <unistd.h>\n#include <sys/syscall.h>\n"
        "static long n;\n"
        "int clock_gettime(clockid_t id, struct timespec *t) {\n"
        "  int r = syscall(SYS_clock_gettime, id, t);\n"
        "  if (id == CLOCK_REALTIME) t->tv_sec += (n++ % 2 ? 86400 : -86400);\n"
        "  return r;\n}\n"
        "time_t time(time_t *out) { struct timespec t; clock_gettime(CLOCK_REALTIME, &t);\n"
        "  if (out) *out = t.tv_sec; return t.tv_sec; }\n"
    )
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("needs a C compiler to set another clock under the process")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source], check=True)
    (tmp_path / "quick.toml").write_text(QUICK_RECIPE)
    command = [sys.executable, "-m", "droguekit.cli.main", "render", str(tmp_path / "quick.toml")]
    subprocess.run(
        [*command, "--out", str(tmp_path / "out"), "--workers", "1", "--timeout", "600"],
        env={**os.environ, "LD_PRELOAD": str(library)},
        check=True,
        capture_output=True,
    )
    assert file_hashes(tmp_path / "out") == file_hashes(quick_dataset)


def damage(dataset: Path, index: int, name: str = "left.png") -> None:
    """Truncate a file of a frame, in its folder or in the tar file of all frames."""
    path = layout.frame_folder(dataset, index) / name
    if path.exists():
        path.write_bytes(path.read_bytes()[:100])
        return
    file = read_shard_index(open_storage(dataset), 0).frames[index][name]
    with (dataset / layout.shard_file(0)).open("r+b") as archive:
        archive.seek(file.offset)
        archive.write(b"\0" * file.size)


@pytest.mark.parametrize("name", ["left.png", layout.RECORD_FILE])
@pytest.mark.parametrize("pairs_per_tar", [None, 100])
def test_damaged_frames_that_cannot_be_made_again_are_left_out(
    pairs_per_tar: int | None, name: str, troubled: Troubled, quick_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(quick_dataset, out)
    if pairs_per_tar is not None:
        render_recipe(out, workers=ExecutionOptions(0, pairs_per_tar=pairs_per_tar), text=QUICK_RECIPE)
    for index in (2, 5):
        damage(out, index, name)
    told = io.StringIO()
    troubled(refuse=[2])
    summary = render_recipe(out, workers=0, text=QUICK_RECIPE, told=told)
    assert [(drop.frame_index, drop.reason) for drop in summary.drops] == [(2, "frame 2 is beyond me")]
    assert (summary.pairs, summary.totals.made) == (7, [5])
    assert "1 damaged pairs could not be made again and are removed: 2" in told.getvalue()
    assert read_manifest(out).drops == summary.drops
    assert list_frames(out) == [0, 1, 3, 4, 5, 6, 7]
    assert validate_dataset(out).passed
    troubled()
    whole = render_recipe(out, workers=0, text=QUICK_RECIPE)
    assert (whole.drops, whole.totals.made) == ((), [2])
    assert whole.dataset_sha256 == read_manifest(quick_dataset).dataset_sha256


def test_a_tar_file_whose_last_frame_is_removed_goes_with_it(
    troubled: Troubled, quick_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    render_recipe(out, [0], ExecutionOptions(0, pairs_per_tar=100), QUICK_RECIPE)
    damage(out, 0)
    troubled(refuse=[0])
    assert render_recipe(out, [0, 1], 0, QUICK_RECIPE).pairs == 1
    assert list_frames(out) == [1]
    damage(out, 1)
    troubled(refuse=[1])
    assert [drop.frame_index for drop in render_recipe(out, [1], 0, QUICK_RECIPE).drops] == [0, 1]
    assert sorted(path.name for path in (out / layout.SHARDS_FOLDER).iterdir()) == ["layout.json"]


def test_a_whole_copy_in_a_tar_file_outlives_a_damaged_folder(
    troubled: Troubled, quick_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(quick_dataset, out)
    render_recipe(out, workers=ExecutionOptions(0, pairs_per_tar=100), text=QUICK_RECIPE)
    shutil.copytree(layout.frame_folder(quick_dataset, 4), layout.frame_folder(out, 4))
    damage(out, 4)
    troubled(refuse=[4])
    summary = render_recipe(out, workers=0, text=QUICK_RECIPE)
    assert (summary.drops, summary.dataset_sha256) == ((), read_manifest(quick_dataset).dataset_sha256)
    assert not layout.frame_folder(out, 4).exists()
    assert validate_dataset(out).passed


def test_a_frame_that_cannot_be_made_is_left_out_of_every_later_run(
    troubled: Troubled, quick_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(quick_dataset, out)
    for index in (1, 3, 6):
        shutil.rmtree(layout.frame_folder(out, index))
    troubled(refuse=[1, 3, 6])
    for chosen in ([1], [1, 3], range(8)):
        summary = render_recipe(out, chosen, 0, QUICK_RECIPE)
        assert [drop.frame_index for drop in summary.drops] == [index for index in (1, 3, 6) if index in chosen]


def test_a_single_frame_that_cannot_be_made_is_left_out(troubled: Troubled, tmp_path: Path) -> None:
    troubled(refuse=[1])
    summary = render_recipe(tmp_path / "out", [1], 0, QUICK_RECIPE)
    assert [drop.frame_index for drop in summary.drops] == [1]
