"""`droguekit navigate --live` on video files and on streams over real sockets, against `import` and `navigate`."""

from __future__ import annotations

import fcntl
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import pytest

from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, read_estimates
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from geometry.se3 import RigidTransform, rotation_from_angles
from tests.support.live_streams import (
    FFV1,
    FFV1_DEEP,
    H264,
    PATIENCE_S,
    Wire,
    encode,
    rtsp_camera,
    serve,
    side_by_side,
    write_calibration,
)
from tests.support.painted_pairs import fly_past

Reference = Callable[[list[str]], dict[tuple[str, int], Estimate]]
Flying = tuple[subprocess.Popen[str], BinaryIO]

PAIRS = 6
WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 640, 480, 3200 / 3, 0.12
# A drawn disc has neither a hole nor a hose, and to a network is no drogue for sure.
BY_COLOR = ["--detector", "color-blob"]
METHODS = [*BY_COLOR, "--method", "joint", "--method", "paper"]
TRACKED = [*BY_COLOR, "--method", "joint-hub", "--tracker", "bernoulli", "--filter", "--smooth"]


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """What the camera sends: both views of a drogue that comes nearer, side by side."""
    turn = rotation_from_angles(*np.radians([4, -3, 5]))
    pairs = fly_past([RigidTransform(turn, np.array([0.02 * k, -0.01 * k, 5.0 - 0.02 * k])) for k in range(PAIRS)])
    return side_by_side([(pair.images.left, pair.images.right) for pair in pairs])


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_calibration(tmp_path_factory.mktemp("rig") / "stereo.yaml", WIDTH, HEIGHT, FOCAL_PX, BASELINE_M)


@pytest.fixture(scope="module")
def imported(images: list[np.ndarray], calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same images, imported as files."""
    folder = tmp_path_factory.mktemp("files")
    for index, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{index}.png"), image[:, :, ::-1])
    out = tmp_path_factory.mktemp("imported") / "data"
    assert run(["import", str(folder), *meaning(calibration), "--out", str(out)]) == DONE
    return out


def meaning(calibration: Path) -> list[str]:
    return ["--calibration", str(calibration), "--encoding", "linear", "--black-level", "2"]


def live(source: Path | str, calibration: Path, out: Path | str, *options: str) -> list[str]:
    return ["navigate", "--live", str(source), *meaning(calibration), "--out", str(out), *options]


def opened(pipe: Path) -> BinaryIO:
    """The reading end of a pipe, whether or not somebody writes to it yet."""
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(reader, True)
    return os.fdopen(reader, "rb")


@pytest.fixture(scope="module")
def reference(imported: Path, tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """Estimates of the imported pairs by some options, computed once."""
    known: dict[tuple[str, ...], dict[tuple[str, int], Estimate]] = {}

    def estimates(options: list[str]) -> dict[tuple[str, int], Estimate]:
        if tuple(options) not in known:
            out = tmp_path_factory.mktemp("reference") / "estimates.jsonl"
            assert run(["navigate", str(imported), *options, "--out", str(out)]) == DONE
            known[tuple(options)] = {(e.method, e.frame_index): e for e in read_estimates(out)}
        return known[tuple(options)]

    return estimates


def assert_same(
    estimates: Iterable[Estimate], reference: Mapping[tuple[str, int], Estimate], first_s: float = 0.0
) -> int:
    """All estimates of pairs that were not late are those of the imported pairs; how many pairs they are."""
    done = [e for e in estimates if not (isinstance(e, NoFix) and e.reason.startswith("late:"))]
    for got in done:
        want = reference[got.method, got.frame_index]
        assert (got.status, got.regions) == (want.status, want.regions)
        # The same pixels; sums in another order at most.
        np.testing.assert_allclose([f.center_px for f in got.features], [f.center_px for f in want.features], atol=1e-9)
        if isinstance(want, PoseEstimate):
            pose = want.left_from_drogue.as_matrix()
            np.testing.assert_allclose(got.left_from_drogue.as_matrix(), pose, atol=1e-9)
        assert got.time_s == pytest.approx(first_s + got.frame_index / 25, abs=1e-3)  # Matroska's clock ticks in ms
        assert (got.latency_s is None) == got.method.endswith("+smoother")
    return len({e.frame_index for e in done})


def test_a_video_played_at_its_rate_gives_the_poses_of_import(
    images: list[np.ndarray],
    calibration: Path,
    reference: Reference,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    video, out, latency = tmp_path / "flight.mkv", tmp_path / "estimates.jsonl", tmp_path / "latency.json"
    encode(str(video), images)
    assert run(live(video, calibration, out, *METHODS, "--latency", str(latency))) == DONE
    estimates = list(read_estimates(out))
    assert [e.frame_index for e in estimates if e.method == "joint"] == list(range(PAIRS))
    done = assert_same(estimates, reference(METHODS))
    told = json.loads(latency.read_text())
    assert (told["schema"], told["pairs"], told["late"], told["left_out"]) == (1, PAIRS, PAIRS - done, {})
    # The rate is that of the arrivals, and the first one may be late by a little.
    assert 0 < told["rate_hz"] <= 25 * 1.01
    assert {"read", "wait", "handover", "detect", "centroids", "pose", "output"} <= set(told["stages"])
    printed = capsys.readouterr()
    assert f"{video}: 640x480 px a view, RGB of 8 bits, linear encoding, black level 2; baseline 0.12 m" in printed.err
    assert re.search(rf"^{PAIRS} pairs at [\d.]+ Hz, {PAIRS - done} late$", printed.out, re.MULTILINE)


def test_a_stream_over_a_socket_answers_pair_by_pair_with_the_poses_of_import(
    images: list[np.ndarray],
    calibration: Path,
    reference: Reference,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # The camera waits until it reads the answers to the pair before, from a pipe: each line is out when it is made.
    pipe, lines = tmp_path / "estimates.jsonl", []
    os.mkfifo(pipe)

    def send(wire: Wire) -> None:
        def sent(index: int) -> None:
            if index > 0:
                lines.extend(answers.readline() for _ in range(2))

        encode(wire, images, FFV1, sent=sent)
        wire.close()
        lines.extend(answers)

    with opened(pipe) as answers, serve(send) as address:
        assert run(live(address, calibration, pipe, *TRACKED)) == FAULT
    printed = capsys.readouterr()
    (tmp_path / "copy.jsonl").write_bytes(b"".join(lines))
    estimates = list(read_estimates(tmp_path / "copy.jsonl"))
    assert len(estimates) == 3 * PAIRS
    assert assert_same(estimates, reference(TRACKED)) == PAIRS
    assert printed.err.splitlines()[-1] == f"droguekit: error: {address}: the stream ended"
    assert f"{PAIRS} fixes in {PAIRS} pairs" in printed.out


def test_a_lossless_transport_stream_gives_the_poses_of_import(
    images: list[np.ndarray], calibration: Path, reference: Reference, tmp_path: Path
) -> None:
    out = tmp_path / "estimates.jsonl"
    with serve(lambda wire: encode(wire, images, H264)) as address:
        assert run(live(address, calibration, out, *METHODS)) == FAULT
    estimates = list(read_estimates(out))
    assert sorted({e.frame_index for e in estimates}) == list(range(PAIRS))
    assert assert_same(estimates, reference(METHODS)) >= 1


def test_a_lossless_rtsp_camera_gives_the_poses_of_import(
    images: list[np.ndarray],
    calibration: Path,
    reference: Reference,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "estimates.jsonl"
    # Before libav knows the clock, it gives the first image no time stamp.
    with serve(rtsp_camera([images[0], *images])) as address:
        address = address.replace("tcp://", "rtsp://me:secret@") + "/stereo"
        assert run(live(address, calibration, out, *METHODS)) == FAULT
    printed = capsys.readouterr()
    assert "/stereo: the stream ended" in printed.err and "secret" not in printed.err
    assert "left out: 1 without a time stamp\n" in printed.out
    estimates = list(read_estimates(out))
    assert sorted({e.frame_index for e in estimates}) == list(range(PAIRS))
    assert assert_same(estimates, reference(METHODS), first_s=0.04) >= 1


def jpeg_stream(images: list[np.ndarray], then: Callable[[Wire], object] = lambda wire: None) -> Callable[[Wire], None]:
    """Answers an HTTP request by a JPEG a part, as simple network cameras do."""

    def send(wire: Wire) -> None:
        wire.receive()
        wire.write(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n")
        for image in images:
            _, data = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {data.size}\r\n\r\n"
            wire.write(head.encode() + data.tobytes() + b"\r\n")
        wire.write(b"--frame\r\n")
        then(wire)

    return send


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.splitlines()[-1]


def test_images_of_another_size_end_the_run_and_what_was_estimated_stays(
    images: list[np.ndarray], calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "estimates.jsonl"
    with serve(jpeg_stream([*images[:3], images[3][:, :-2], images[4]])) as address:
        address = address.replace("tcp:", "http:")
        assert run(live(address, calibration, out, "--method", "joint")) == FAULT
    fault = "left half 3: must be 640x480 px as calibrated, got 639x480"
    assert last_line(capsys) == f"droguekit: error: {address}: {fault}"
    estimates = list(read_estimates(out))
    assert [e.frame_index for e in estimates] == [0, 1, 2]
    assert isinstance(estimates[-1], PoseEstimate)
    # The stream has no time stamps: times of arrival stand for them.
    times_s = [e.time_s for e in estimates if isinstance(e, PoseEstimate)]
    assert times_s == sorted(times_s)


def test_a_camera_of_another_size_is_refused_and_leaves_no_file(
    images: list[np.ndarray], calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "estimates.jsonl"
    encode(str(tmp_path / "one.mkv"), [image[:, :WIDTH] for image in images])
    assert run(live(tmp_path / "one.mkv", calibration, out, "--method", "joint")) == WRONG_INPUT
    assert "one.mkv: left half 0: must be 640x480 px as calibrated, got 320x480" in last_line(capsys)
    assert not out.exists()


@pytest.mark.parametrize(
    ("deep", "options", "message"),
    [
        (False, ["--bits", "12"], "flight.mkv: has 8 bits; leave the number of bits out"),
        (True, [], "flight.mkv: sends 16-bit numbers; give the camera's own depth by --bits"),
        (
            True,
            ["--bits", "10"],
            "flight.mkv: left half 0: has values beyond 10 bits; say by --bits how many the camera has",
        ),
    ],
)
def test_the_depth_of_numbers_must_be_said_and_be_right(
    images: list[np.ndarray],
    calibration: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    deep: bool,
    options: list[str],
    message: str,
) -> None:
    sent = [image[:, :, 0].astype(np.uint16) << 4 for image in images] if deep else images
    encode(str(tmp_path / "flight.mkv"), sent, FFV1_DEEP if deep else FFV1)
    out = tmp_path / "estimates.jsonl"
    assert run(live(tmp_path / "flight.mkv", calibration, out, "--method", "constant", *options)) == WRONG_INPUT
    assert message in last_line(capsys)
    assert not out.exists()


def test_a_camera_that_stalls_ends_the_run_by_its_time_limit(
    images: list[np.ndarray], calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "estimates.jsonl"
    with serve(jpeg_stream(images[:2], then=lambda wire: wire.receive())) as address:
        address = address.replace("tcp:", "http:")
        assert run(live(address, calibration, out, "--method", "constant", "--timeout", "2")) == FAULT
    assert re.search(rf"error: {re.escape(address)}: no image came for 2 s$", last_line(capsys))
    assert [e.frame_index for e in read_estimates(out)] == [0, 1]


def test_a_full_disk_ends_the_run_and_leaves_whole_lines(
    images: list[np.ndarray], calibration: Path, tmp_path: Path
) -> None:
    video, out = tmp_path / "flight.mkv", tmp_path / "estimates.jsonl"
    encode(str(video), images, times=range(0, 25 * PAIRS, 25))
    most_bytes = 10_000  # about two estimates and a half; no file may grow beyond it, as on a full disk

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    command = [sys.executable, "-m", "droguekit.cli.main", *live(video, calibration, out, "--method", "joint")]
    command += BY_COLOR
    done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limit)
    count = len(list(read_estimates(out)))
    assert done.returncode == FAULT
    fault = f"{out}: cannot be written: File too large; the {count} estimates before are kept"
    assert done.stderr.splitlines()[-1] == f"droguekit: error: {fault}"
    assert 0 < count < PAIRS
    assert re.search(r"^joint +\d fixes in \d pairs$", done.stdout, re.MULTILINE)


def test_a_device_without_room_is_told(
    images: list[np.ndarray], calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    encode(str(tmp_path / "flight.mkv"), images)
    assert run(live(tmp_path / "flight.mkv", calibration, "/dev/full", "--method", "joint")) == FAULT
    assert "/dev/full: cannot be written: No space left on device; the 0 estimates" in last_line(capsys)


@pytest.fixture
def flying(images: list[np.ndarray], calibration: Path, tmp_path: Path) -> Iterator[Flying]:
    """A process that navigates on a camera which sends all images and then waits; its pipe, with the first estimate."""
    pipe = tmp_path / "estimates.jsonl"
    os.mkfifo(pipe)
    with serve(jpeg_stream(images, then=lambda wire: wire.receive())) as address, opened(pipe) as answers:
        options = live(address.replace("tcp:", "http:"), calibration, pipe, "--method", "joint", "--timeout", "600")
        command = [sys.executable, "-m", "droguekit.cli.main", *options]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            # One page is less than an estimate: the process waits for somebody to read.
            fcntl.fcntl(answers, fcntl.F_SETPIPE_SZ, 4096)
            assert select.select([answers], [], [], PATIENCE_S)[0]
            yield process, answers
        finally:
            process.kill()
            process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_the_run_cleanly(flying: Flying, number: signal.Signals, tmp_path: Path) -> None:
    process, answers = flying
    lines = [answers.readline()]
    while json.loads(lines[-1])["frame_index"] < PAIRS - 1:
        lines.append(answers.readline())
    process.send_signal(number)
    printed, told = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == DONE, told
    assert "droguekit: ending; Ctrl-C again ends at once" in told
    assert re.search(rf"^joint +\d fixes in {PAIRS} pairs$", printed, re.MULTILINE)
    assert answers.read() == b""
    (tmp_path / "copy.jsonl").write_bytes(b"".join(lines))
    assert [e.frame_index for e in read_estimates(tmp_path / "copy.jsonl")] == list(range(PAIRS))


def test_a_second_interrupt_ends_at_once(flying: Flying) -> None:
    process, _ = flying
    process.send_signal(signal.SIGINT)
    while "ending" not in process.stderr.readline():
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 130
    assert "ended at once" in process.stderr.read()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--live", "0"], "--live: needs the cameras' --calibration"),
        (["--calibration", "RIG", "data"], "--calibration: needs --live; a dataset has its own"),
        (["--timeout", "3", "data"], "--timeout: needs --live"),
        (["--live", "0", "--calibration", "RIG", "data"], "navigate: needs either a dataset's folder or --live SOURCE"),
        ([], "navigate: needs either a dataset's folder or --live SOURCE"),
        (["--live", "77", "--calibration", "RIG"], "--live: there is no /dev/video77; there are "),
        (["--live", "none.mkv", "--calibration", "RIG"], "--live: there is no file none.mkv"),
        (
            ["--live", "tcp://127.0.0.1:9", "--calibration", "RIG"],
            "tcp://127.0.0.1:9: cannot be opened: Connection ref",
        ),
        (
            ["--live", "rtsp://me:secret@127.0.0.1:9/x", "--calibration", "RIG"],
            "rtsp://127.0.0.1:9/x: cannot be opened",
        ),
        (["--live", "a.mkv,b.mkv", "--calibration", "RIG"], "--live: there is no file a.mkv"),
        (["--live", "ros:left,right", "--calibration", "RIG"], "--live: must be ros:/LEFT,/RIGHT"),
        (["--live", "RIG", "--calibration", "RIG", "--rate", "9"], "--rate: with --live only devices such as 0"),
        (["--live", "RIG", "--calibration", "RIG"], "stereo.yaml: cannot be opened: Invalid data"),
        (["--live", "0", "--calibration", "RIG", "--timeout", "0"], "--timeout: must be above 0"),
        (["--live", "0", "--calibration", "RIG", "--bits", "99"], "--bits: must be from 9 to 16"),
        (["--live", "0", "--calibration", "RIG", "--stamp-tolerance-ms", "-1"], "--stamp-tolerance-ms: must be from 0"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    options = [str(calibration) if option == "RIG" else option for option in options]
    assert run(["navigate", "--method", "constant", "--out", str(tmp_path / "out.jsonl"), *options]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert message in told and len(told.splitlines()) == 1 and "secret" not in told
    assert list(tmp_path.iterdir()) == []


def test_a_video_without_a_whole_picture_is_told(
    images: list[np.ndarray], calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, out = tmp_path / "flight.mkv", tmp_path / "estimates.jsonl"
    encode(str(video), images)
    video.write_bytes(video.read_bytes()[:2000])
    assert run(live(video, calibration, out, "--method", "constant")) == WRONG_INPUT
    assert "flight.mkv: delivered no pair" in last_line(capsys)
    assert not out.exists()


def test_a_file_of_estimates_is_not_overwritten(
    images: list[np.ndarray], calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, out = tmp_path / "flight.mkv", tmp_path / "estimates.jsonl"
    encode(str(video), images)
    out.write_text("the flight before")
    assert run(live(video, calibration, out, "--method", "constant")) == WRONG_INPUT
    assert "is there already, and a flight cannot be repeated" in last_line(capsys)
    assert out.read_text() == "the flight before"
