"""Write a dataset into a recording of the rerun viewer, or open a viewer and send it there."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from datasets_manifest.atomic import part_path
from datasets_manifest.types.estimates import Estimate
from droguekit.batch.progress import ProgressReport
from droguekit.visualization.rerun_viewer.recording import APPLICATION, FRAMES, PairRecorder, ShownPairs, blueprint

# Only this machine can connect to the viewer.
_HOST = "127.0.0.1"
# Longest time for the viewer to open, and time in which it fails if it gets no window. [s]
_OPEN_TIMEOUT_S, _WINDOW_TIMEOUT_S = 30.0, 2.0


@dataclass(frozen=True)
class ViewSummary:
    """Indices of the shown pairs, and a line for each pair that could not be read."""

    shown: tuple[int, ...]
    faults: tuple[str, ...]


def view_pairs(
    source: ShownPairs,
    frames: Sequence[int],
    estimates: Mapping[str, Mapping[int, Estimate]],
    save: Path | None,
    report: ProgressReport,
) -> ViewSummary:
    """Show pairs with estimates.

    Args:
        source: the dataset.
        frames: indices of the pairs, in order.
        estimates: by method and frame.
        save: an .rrd file, which appears when it is complete and is not written without pairs; None opens a viewer.
        report: is told of the progress.

    Raises:
        OSError: the file cannot be written, or no viewer can be opened.
    """
    # A new id for each: the viewer would join recordings of the same id.
    recording = rr.RecordingStream(APPLICATION)
    if save is None:
        _open_viewer(recording)
        return _log_pairs(recording, source, frames, estimates, report)
    part = part_path(save)
    try:
        save.parent.mkdir(parents=True, exist_ok=True)
        # The library reports no failed writes; this one is ours.
        part.touch(exist_ok=False)
        rr.save(part, default_blueprint=blueprint(), recording=recording)
        summary = _log_pairs(recording, source, frames, estimates, report)
        rr.disconnect(recording=recording)
        _check_recording(part, len(summary.shown))
        if summary.shown:
            part.replace(save)
    except OSError as error:
        raise OSError(error.errno, f"{save}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return summary


def _open_viewer(recording: rr.RecordingStream) -> None:
    """Open a viewer and connect to it.

    Raises:
        OSError: it does not open; the library would silently drop all data.
    """
    port = _free_port()
    # The viewer that came with the library; it stays open when this process ends.
    command = [sys.executable, "-m", "rerun_cli", "--bind", _HOST, "--port", str(port)]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    until_s = time.monotonic() + _OPEN_TIMEOUT_S
    while viewer.poll() is None and not _answers(port) and time.monotonic() < until_s:
        time.sleep(0.2)
    # It listens before it has a window, and exits when it gets none.
    with suppress(subprocess.TimeoutExpired):
        viewer.wait(_WINDOW_TIMEOUT_S)
    if viewer.returncode is not None or not _answers(port):
        with suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGKILL)
        raise OSError(None, "the viewer does not open; write a recording with --save FILE.rrd")
    rr.connect_grpc(f"rerun+http://{_HOST}:{port}/proxy", default_blueprint=blueprint(), recording=recording)


def _free_port() -> int:
    """A free port instead of the default one, where another program or viewer may listen."""
    with socket.socket() as held:
        held.bind((_HOST, 0))
        return int(held.getsockname()[1])


def _answers(port: int) -> bool:
    try:
        with socket.create_connection((_HOST, port), timeout=1.0):
            return True
    except OSError:
        return False


def _log_pairs(
    recording: rr.RecordingStream,
    source: ShownPairs,
    frames: Sequence[int],
    estimates: Mapping[str, Mapping[int, Estimate]],
    report: ProgressReport,
) -> ViewSummary:
    recorder, shown, faults = None, [], []
    report.begin("pairs", len(frames))
    try:
        for index in frames:
            try:
                pair = source.read(index)
            except ValueError as error:
                faults.append(f"frame {index} is left out: {error}")
            else:
                recorder = recorder or PairRecorder(recording, pair.rig, list(estimates))
                recorder.add(pair, {name: found[index] for name, found in estimates.items() if index in found})
                shown.append(index)
            report.advance()
    finally:
        report.end()
    recording.flush()
    return ViewSummary(tuple(shown), tuple(faults))


def _check_recording(path: Path, pairs: int) -> None:
    """Read the file again.

    Raises:
        OSError: it does not hold all pairs.
    """
    try:
        found = _count_images(path) if pairs else 0
    except (ValueError, RuntimeError) as error:
        raise OSError(None, "what was written cannot be read again; is the disk full?") from error
    if found != pairs:
        raise OSError(None, f"only {found} of {pairs} pairs are in it; is the disk full?")


def _count_images(path: Path) -> int:
    """Left images in a file, by the reader that this version of rerun has.

    Raises:
        ValueError, RuntimeError: the file cannot be read.
    """
    if hasattr(rr, "dataframe"):  # up to rerun 0.23, the last for numpy 1
        view = rr.dataframe.load_recording(path).view(index=FRAMES, contents="rig/left/image")
        return int(view.select(columns=[FRAMES]).read_all().num_rows)
    from rerun.chunk import RrdReader

    return sum(chunk.num_rows for chunk in RrdReader(path).stream() if chunk.entity_path == "/rig/left/image")
