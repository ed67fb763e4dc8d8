"""Estimate poses on a running camera until it ends or Ctrl-C; what was estimated stays, whatever ends the run."""

from __future__ import annotations

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import TYPE_CHECKING, Literal, cast

from datasets_manifest.calibration.baseline_units import BASELINE_UNITS_M
from datasets_manifest.storage.pair_faults import PairFaults
from droguekit.workflows.estimate_file import EstimateFile
from droguekit.workflows.importing import ImportOptions
from droguekit.workflows.navigation import (
    FixCount,
    LatencyTally,
    NavigationOptions,
    NavigationSummary,
    check_places,
    navigate_dataset,
    sequence_settings,
    tallied,
)

if TYPE_CHECKING:
    from datasets_manifest.storage.storage import Location
    from droguekit.batch.progress import ProgressReport
    from droguekit.capture.live_pairs import CameraSettings, CaptureSettings, LivePairs
    from droguekit.capture.stereo_source import StereoSource
    from nav.realtime import Clock

_STATUS_EVERY_S = 10.0
# Of so many pairs latencies are kept: an hour at 14 Hz, in 25 MB.
_NEWEST = 50_000
_ENDING = b"\ndroguekit: ending; Ctrl-C again ends at once\n"
_ENDED = b"\ndroguekit: ended at once; estimates are written, latencies are not\n"


@dataclass(frozen=True)
class LiveOptions:
    """Which camera, and what its images do not say.

    Attributes:
        source: a device's number or file, two of them, a video file, an address, or `ros:LEFT,RIGHT`; None for no
            camera.
        calibration, calibration_unit, image_size, drogue, encoding, black_level_dn, bits: see `ImportOptions`; None for
            its own.
        timeout_s: longest wait for a pair; 5 s when None. [s]
        stamp_tolerance_ms: largest difference of the time stamps of left and right; 1 ms when None. [ms]
        camera_format: libav's name of the pixel format or codec to ask a device for, or None.
    """

    source: str | None
    calibration: tuple[Path, ...] | None = None
    calibration_unit: str | None = None
    image_size: str | None = None
    drogue: str | None = None
    encoding: str | None = None
    black_level_dn: float | None = None
    bits: int | None = None
    timeout_s: float | None = None
    stamp_tolerance_ms: float | None = None
    camera_format: str | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: one is out of its range, or there is no camera that it could be of; names the command's option.
        """
        if self.source is None:
            given = [each.name for each in fields(self) if getattr(self, each.name) is not None]
            if given:
                option = given[0].removesuffix("_dn").removesuffix("_s").replace("_", "-")
                raise ValueError(f"--{option}: needs --live; a dataset has its own")
            return
        if not self.calibration:
            raise ValueError("--live: needs the cameras' --calibration; docs/how-to/calibrate.md tells how to make it")
        if self.timeout_s is not None and not 0 < self.timeout_s <= 3600:
            raise ValueError(f"--timeout: must be above 0 and up to 3600 s, got {self.timeout_s:g}")
        if self.stamp_tolerance_ms is not None and not 0 <= self.stamp_tolerance_ms <= 1000:
            raise ValueError(f"--stamp-tolerance-ms: must be from 0 to 1000 ms, got {self.stamp_tolerance_ms:g}")
        self.images()

    def images(self) -> ImportOptions:
        """What the images do not say, as an import takes it.

        Raises:
            ValueError: a value is out of its range; names the command's option.
        """
        names = ("calibration", "calibration_unit", "image_size", "drogue", "encoding", "black_level_dn", "bits")
        given = {name: getattr(self, name) for name in names}
        return ImportOptions(**{name: value for name, value in given.items() if value is not None})

    def capture(self, rate_hz: float | None) -> CaptureSettings:
        """How to read the camera, with the rate to ask a device for. [Hz]"""
        from droguekit.capture.live_pairs import CaptureSettings

        names = {"timeout_s": self.timeout_s, "tolerance_ms": self.stamp_tolerance_ms}
        given = {name: value for name, value in names.items() if value is not None}
        return CaptureSettings(**given, camera_format=self.camera_format, rate_hz=rate_hz)


def navigate_pairs(
    dataset: Location | None,
    live: LiveOptions,
    methods: Sequence[str],
    out: Path,
    report: ProgressReport,
    options: NavigationOptions,
) -> NavigationSummary:
    """Estimate poses in the pairs of a dataset or of a camera, whichever is named.

    Raises:
        ValueError: both are named or none, and as `navigate_dataset` and `navigate_live`.
        OSError: the estimates cannot be written.
    """
    if (dataset is None) == (live.source is None):
        raise ValueError("navigate: needs either a dataset's folder or --live SOURCE")
    if dataset is None:
        return navigate_live(live, methods, out, report, options)
    return navigate_dataset(dataset, methods, out, report, options)


def navigate_live(
    live: LiveOptions, methods: Sequence[str], out: Path, report: ProgressReport, options: NavigationOptions
) -> NavigationSummary:
    """Estimate poses in every pair of a camera, and write each estimate when it exists; all methods when none is named.

    The run ends when a video file does, at the first SIGINT or SIGTERM, or by a fault of the camera or of the disk.
    Pairs that have arrived by then are still processed.

    Raises:
        ValueError: no such camera, calibration, method, detector, tracker or way to measure centres, a camera that
            delivers no pair or not what is calibrated, or an output that is a folder or there already.
        OSError: the estimates cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.capture.live_pairs import LivePairs
    from droguekit.numerical_threads import one_thread
    from nav.realtime import MonotonicClock, process_arrivals
    from nav.runner import add_smoothed, open_navigator

    settings, clock = sequence_settings(methods, options), MonotonicClock()
    check_places(out, options.latency_out)
    if out.is_file():
        raise ValueError(f"--out: {out} is there already, and a flight cannot be repeated; name another file")
    source, camera, remarks = _camera(live, options.rate_hz, clock)
    pairs = LivePairs(source, camera)
    navigator = open_navigator(settings, options.detector)
    tally, fixes, fault, faults = LatencyTally(_NEWEST), Counter[str](), None, PairFaults()
    status = _Status(pairs, remarks, tally, fixes, report)
    with EstimateFile(out) as file, one_thread(), _ended_by_signals(pairs.stop):
        with closing(process_arrivals(pairs, navigator, clock)) as answers:
            try:
                for estimate in add_smoothed(tallied(answers, tally, faults, status.advance), settings):
                    file.write(estimate)
                    fixes[estimate.method] += estimate.status == "fix"
            except OSError as error:
                fault = error.strerror or str(error)
        if not tally.pairs and fault is None:
            file.remove()
            raise ValueError(pairs.fault or f"--live: {source.name}: delivered no pair")
        latency = tally.report(pairs.rate_hz, dict(pairs.source.left_out))
        if options.latency_out is not None:
            try:
                write_text_atomic(options.latency_out, latency.to_json())
            except OSError as error:
                fault = fault or error.strerror
    counts = [FixCount(name, fixes[name], tally.pairs) for name in settings.names]
    return NavigationSummary(counts, latency, fault or pairs.fault or faults.line(), faults)


def _camera(
    live: LiveOptions, rate_hz: float | None, clock: Clock
) -> tuple[StereoSource, CameraSettings, Sequence[str]]:
    """The camera that the options name, what its images do not say, and what its calibration was taken for.

    Raises:
        ValueError: there is no such camera, calibration or drogue.
    """
    from datasets_manifest.calibration.calibration_reader import read_calibration
    from datasets_manifest.calibration.rig_report import rig_report
    from drogue_models.presets import load_drogue
    from droguekit.capture.live_pairs import CameraSettings, open_source

    images = live.images()
    assert live.source is not None
    calibration = read_calibration(images.calibration, BASELINE_UNITS_M[images.calibration_unit], images.image_size_px)
    rig = calibration.rig
    encoding = cast(Literal["linear", "gamma"] | None, images.encoding)
    settings = CameraSettings(rig, load_drogue(images.drogue), encoding, images.black_level_dn or 0.0, images.bits)
    return open_source(live.source, live.capture(rate_hz), rig, clock), settings, rig_report(calibration)


class _Status:
    """Tells what the camera delivers once it does, and every few seconds how it goes."""

    def __init__(
        self,
        pairs: LivePairs,
        remarks: Sequence[str],
        tally: LatencyTally,
        fixes: Counter[str],
        report: ProgressReport,
    ) -> None:
        self._remarks = remarks
        self._pairs, self._tally, self._fixes, self._report = pairs, tally, fixes, report
        self._told_s: float | None = None

    def advance(self) -> None:
        """Count a pair."""
        now_s = monotonic()
        if self._told_s is None:
            for line in (*self._remarks, f"{self._pairs.description}; Ctrl-C ends"):
                self._report.say(line)
        elif now_s - self._told_s < _STATUS_EVERY_S:
            return
        else:
            fixes = ", ".join(f"{method} {count} fixes" for method, count in self._fixes.most_common(1))
            self._report.say(f"{self._tally.pairs} pairs, {self._tally.late} late, {fixes or 'no fix yet'}")
        self._told_s = now_s


@contextmanager
def _ended_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """The first SIGINT or SIGTERM calls `stop`, the next one ends the process at once."""
    heard = threading.Event()

    def hear(number: int, frame: FrameType | None) -> None:
        if heard.is_set():
            os.write(2, _ENDED)
            # Threads of cameras and of network run times may not be ready to end.
            os._exit(128 + number)
        heard.set()
        os.write(2, _ENDING)
        # Not in this thread, which may be holding the very lock that `stop` needs.
        threading.Thread(target=stop, name="end of the run").start()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, hear) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
