"""`droguekit navigate` on an imported flight: tracker, filter, smoother, real time, and what is refused."""

from __future__ import annotations

import io
import json
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from datasets_manifest.importers.imported_dataset import ImportedPair, ImportSettings, write_imported
from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.estimates import NoFix, PoseEstimate, read_estimates
from droguekit.batch.progress import PlainProgress
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from droguekit.workflows.navigation import NavigationOptions, navigate_dataset
from geometry.se3 import RigidTransform, rotation_from_angles
from nav.pair_navigator import PairNavigator
from tests.support.painted_pairs import fly_past

PAIRS = 6
# To the networks, which know what drogues look like, the drawn disc is none.
BLOBS = ["--detector", "color-blob"]


class Flight:
    """Drawn pairs as an importer reads them."""

    left_out = ()
    remarks = ()

    def __init__(self, pairs: list[BlindPair]) -> None:
        self._pairs, self.count = pairs, len(pairs)

    def __iter__(self) -> Iterator[Any]:
        for pair in self._pairs:
            name = f"{pair.frame_index}.png"
            yield ImportedPair((name, name), pair.images.time_s, pair.images.left, pair.images.right)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset without truth of a drogue that comes nearer."""
    turn = rotation_from_angles(*np.radians([4, -3, 5]))
    pairs = fly_past([RigidTransform(turn, np.array([0.02 * k, -0.01 * k, 5.0 - 0.02 * k])) for k in range(PAIRS)])
    out = tmp_path_factory.mktemp("flight") / "data"
    settings = ImportSettings("flight", pairs[0].rig, pairs[0].drogue, encoding="linear")
    write_imported(Flight(pairs), settings, out, lambda: None)
    return out


def by_method(path: Path) -> dict[str, Any]:
    found = {}
    for estimate in read_estimates(path):
        found.setdefault(estimate.method, []).append(estimate)
    return found


def test_all_of_it_together(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "estimates.jsonl"
    options = ["--method", "joint-hub", "--tracker", "bernoulli", "--redetect-every", "3", "--filter", "--smooth"]
    assert run(["navigate", str(flight), *BLOBS, *options, "--capture-radius", "0.2", "--out", str(out)]) == DONE
    found = by_method(out)
    assert list(found) == ["joint-hub", "joint-hub+filter", "joint-hub+smoother"]
    for estimates in found.values():
        assert [e.frame_index for e in estimates] == list(range(PAIRS))
        assert all(isinstance(e, PoseEstimate) for e in estimates)
        assert [{r.source for r in e.regions} for e in estimates][:2] == [{"detector"}, {"bernoulli"}]
    told = capsys.readouterr().out.splitlines()
    assert told == [*(f"{name:<18} {PAIRS} fixes in {PAIRS} pairs" for name in found), f"wrote {out}"]


def test_without_a_tracker_the_detector_looks_at_every_pair_and_there_are_no_others(
    flight: Path, tmp_path: Path
) -> None:
    out = tmp_path / "estimates.jsonl"
    assert run(["navigate", str(flight), *BLOBS, "--method", "joint", "--out", str(out)]) == DONE
    (estimates,) = by_method(out).values()
    assert {region.source for estimate in estimates for region in estimate.regions} == {"detector"}
    assert all(estimate.latency_s is None for estimate in estimates)


def test_in_real_time_every_pair_is_worked_on_or_told_to_be_late(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, latency = tmp_path / "estimates.jsonl", tmp_path / "latency.json"
    # Faster than any machine works, so that pairs are late.
    options = ["--method", "joint", "--tracker", "flow", "--filter", "--rate", "10000", "--latency", str(latency)]
    assert run(["navigate", str(flight), *BLOBS, *options, "--out", str(out)]) == DONE
    told = json.loads(latency.read_text())
    assert (told["schema"], told["rate_hz"], told["pairs"]) == (1, 10000.0, PAIRS)
    assert 0 < told["late"] < PAIRS
    for estimates in by_method(out).values():
        assert [e.frame_index for e in estimates] == list(range(PAIRS))
        late = [e for e in estimates if isinstance(e, NoFix) and e.reason.startswith("late:")]
        assert len(late) == told["late"]
        assert isinstance(estimates[-1], PoseEstimate)
        latencies_ms = [1e3 * e.latency_s for e in estimates if isinstance(e, PoseEstimate)]
        assert told["latency"]["max_ms"] == pytest.approx(max(latencies_ms))
    percentiles = [told["latency"][name] for name in ("p50_ms", "p95_ms", "p99_ms", "max_ms")]
    assert percentiles == sorted(percentiles)
    assert {"read", "wait", "handover", "centroids", "pose", "filter", "output"} <= set(told["stages"])
    printed = capsys.readouterr().out
    assert f"{PAIRS} pairs at 10000 Hz, {told['late']} late\n" in printed
    assert re.search(rf"^whole +{told['latency']['p50_ms']:.1f} ", printed, re.MULTILINE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--redetect-every", "5"], "--redetect-every: needs --tracker"),
        (["--tracker", "mil", "--redetect-every", "0"], "--redetect-every: must be at least 1, got 0"),
        (["--tracker", "guess"], "tracker: must be one of bernoulli"),
        (["--capture-radius", "0.1"], "--capture-radius: needs --filter or --smooth"),
        (["--filter", "--capture-radius", "nan"], "--capture-radius: must be above 0 m, got nan"),
        (["--rate", "0"], "--rate: must be from 0.001 to 10000 Hz, got 0"),
        (["--rate", "nan"], "--rate: must be from 0.001 to 10000 Hz, got nan"),
        (["--latency", "latency.json"], "--latency: needs --rate"),
        (["--centroids", "grey"], "--centroids: must be one of own, binary, edge"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    out = tmp_path / "estimates.jsonl"
    assert run(["navigate", str(flight), *options, "--out", str(out)]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert message in told
    assert len(told.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_take_results_are_refused_before_the_work(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "folder", tmp_path / "estimates.jsonl"
    folder.mkdir()
    other_name = folder / ".." / out.name
    for out_place, latency, message in (
        (folder, None, "--out: must be a file, got the folder"),
        (out, folder, "--latency: must be a file, got the folder"),
        (out, other_name, "--latency: must be another file than --out"),
        (out, "s3://bucket/latency.json", "--latency: must be a folder or file of this machine"),
    ):
        options = ["--out", str(out_place), *([] if latency is None else ["--rate", "9", "--latency", str(latency)])]
        assert run(["navigate", str(flight), "--method", "constant", *options]) == WRONG_INPUT
        told = capsys.readouterr().err
        assert message in told
        assert len(told.splitlines()) == 1
    assert list(tmp_path.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("rate", [[], ["--rate", "1000"]])
def test_a_damaged_pair_gets_no_fix_and_all_others_theirs(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], rate: list[str]
) -> None:
    data = tmp_path / "data"
    for file in flight.rglob("*"):
        if file.is_file():
            copy = data / file.relative_to(flight)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes()[: 5000 if file.match("*/000005/right.png") else None])
    out = tmp_path / "estimates.jsonl"
    assert run(["navigate", str(data), "--method", "constant", *rate, "--out", str(out)]) == FAULT
    (found,) = by_method(out).values()
    assert [estimate.frame_index for estimate in found] == list(range(PAIRS))
    assert re.search(r"000005/right\.png: the PNG is truncated", found[5].reason)
    told = capsys.readouterr()
    assert "in 1 of 6 pairs" in told.out
    (line,) = (line for line in told.err.splitlines() if not line.startswith("pairs:"))
    assert re.match(r"droguekit: error: 1 pair has no result by a fault, first pair 5: .*000005/right\.png", line)


@pytest.mark.parametrize(
    "options",
    [[], ["--filter", "--smooth"], ["--tracker", "bernoulli", "--filter"]],
    ids=["plain", "filters", "tracker"],
)
@pytest.mark.parametrize("stage", ["observe", "measure", "estimate_measured"])
def test_a_fault_of_ours_ends_one_pair_and_not_the_run(
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    stage: str,
) -> None:
    works, calls = getattr(PairNavigator, stage), []

    def fails_once(self: PairNavigator, *given: Any) -> Any:
        calls.append(stage)
        if len(calls) == 1:
            raise np.linalg.LinAlgError("singular\nmatrix")
        return works(self, *given)

    monkeypatch.setattr(PairNavigator, stage, fails_once)
    out = tmp_path / "estimates.jsonl"
    assert run(["navigate", str(flight), *BLOBS, "--method", "joint", *options, "--out", str(out)]) == FAULT
    for estimates in by_method(out).values():
        assert [estimate.frame_index for estimate in estimates] == list(range(PAIRS))
        assert estimates[0].reason == "internal fault, LinAlgError: singular matrix"
        assert all(isinstance(estimate, PoseEstimate) for estimate in estimates[1:])
    told = capsys.readouterr()
    assert "in 1 of 6 pairs" in told.out
    assert "first pair 0: internal fault, LinAlgError: singular matrix; --debug shows the trace" in told.err
    assert "Traceback" not in told.err


def test_debug_shows_the_trace_of_a_fault_within_a_pair(
    flight: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(PairNavigator, "estimate_measured")
    assert run(["navigate", str(flight), "--method", "joint", "--debug", "--out", str(tmp_path / "e.jsonl")]) == FAULT
    assert [record.getMessage() for record in caplog.records] == [f"pair {index}" for index in range(PAIRS)]
    assert all(record.exc_info[0] is AttributeError for record in caplog.records)


@pytest.mark.parametrize("replaces", [False, True])
def test_an_estimate_is_on_the_disk_before_the_next_pair_is_worked_on(
    flight: Path, tmp_path: Path, replaces: bool
) -> None:
    out = tmp_path / "estimates.jsonl"
    place = out.with_name("estimates.jsonl.part") if replaces else out
    if replaces:
        out.write_text("old")

    class ReadingProgress(PlainProgress):
        lines: ClassVar[list[int]] = []

        def advance(self) -> None:
            self.lines.append(len(list(read_estimates(place))))

    navigate_dataset(flight, ["constant", "joint"], out, ReadingProgress(io.StringIO()))
    assert ReadingProgress.lines == [2 * pair for pair in range(1, PAIRS + 1)]
    assert len(list(read_estimates(out))) == 2 * PAIRS
    assert list(tmp_path.iterdir()) == [out]


def library_threads() -> list[int]:
    """How many threads OpenCV takes, and the linear algebra of each library that is loaded."""
    return [cv2.getNumThreads(), *(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")]


class InterruptedProgress(PlainProgress):
    """Ctrl-C after the second pair; remembers how many threads libraries took until then."""

    def __init__(self, stream: io.StringIO) -> None:
        super().__init__(stream)
        self._pairs = 0
        self.threads = []

    def advance(self) -> None:
        self._pairs += 1
        self.threads += library_threads()
        if self._pairs == 2:
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("rate_hz", [None, 500.0])
def test_an_interrupt_leaves_the_old_file_no_thread_and_all_settings(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], rate_hz: float | None
) -> None:
    out = tmp_path / "estimates.jsonl"
    out.write_text("old")
    threads, handler = set(threading.enumerate()), signal.signal(signal.SIGINT, signal.default_int_handler)
    cores, order = cv2.getNumThreads(), NavigationOptions(rate_hz=rate_hz)
    try:
        cv2.setNumThreads(2)
        with (
            threadpool_limits(2, "blas"),
            pytest.raises(KeyboardInterrupt),
            capsys.disabled(),
            (tmp_path / "log").open("w") as log,
        ):
            before, progress = library_threads(), InterruptedProgress(log)
            try:
                navigate_dataset(flight, ["constant"], out, progress, order)
            finally:
                after = library_threads()
    finally:
        signal.signal(signal.SIGINT, handler)
        cv2.setNumThreads(cores)
    assert out.read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimates.jsonl", "estimates.jsonl.part", "log"]
    assert [estimate.frame_index for estimate in read_estimates(tmp_path / "estimates.jsonl.part")][:2] == [0, 1]
    left = {t for t in set(threading.enumerate()) - threads if not t.name.startswith("other-eye")}
    assert left == set()
    assert set(progress.threads) == {1}
    # Libraries that were loaded meanwhile come last.
    assert after[: len(before)] == before
