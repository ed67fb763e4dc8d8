"""`droguekit navigate`."""

from __future__ import annotations

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DetectorOption
from droguekit.cli.main import FAULT
from droguekit.cli.navigation import navigate_options as its
from droguekit.workflows.live_navigation import LiveOptions, navigate_pairs
from droguekit.workflows.navigation import NavigationOptions

EXAMPLES = (
    "droguekit navigate data/demo --out estimates.jsonl",
    "droguekit navigate data/demo --method paper --method joint --out estimates.jsonl",
    "droguekit navigate data/demo --centroids binary --out estimates.jsonl",
    "droguekit navigate data/demo --detector my-network.onnx --out estimates.jsonl",
    "droguekit navigate data/docking-10m --method joint-hub --tracker bernoulli --filter --out estimates.jsonl",
    "droguekit navigate data/docking-10m --method joint-hub --tracker bernoulli --rate 25 --out estimates.jsonl",
    "droguekit navigate --live 0 --calibration stereo.yaml --method joint-hub --filter --out flight.jsonl",
    "droguekit navigate --live rtsp://camera/stereo --calibration stereo.yaml --method joint-hub --out flight.jsonl",
    "droguekit navigate --live ros:/left/image_raw,/right/image_raw --calibration stereo.yaml --out flight.jsonl",
)


def navigate(
    out: its.EstimatesOption,
    dataset: its.DatasetOrNone = None,
    method: its.MethodOption = None,
    centroids: its.CentroidsOption = "own",
    detector: DetectorOption = None,
    tracker: its.TrackerOption = None,
    redetect_every: its.RedetectOption = None,
    filtered: its.FilterOption = False,
    smoothed: its.SmoothOption = False,
    capture_radius: its.CaptureRadiusOption = None,
    rate: its.RateOption = None,
    latency: its.LatencyOption = None,
    live: its.LiveOption = None,
    calibration: its.CalibrationOption = None,
    calibration_unit: its.CalibrationUnitOption = None,
    image_size: its.ImageSizeOption = None,
    drogue: its.DrogueOption = None,
    encoding: its.EncodingOption = None,
    black_level: its.BlackLevelOption = None,
    bits: its.BitsOption = None,
    timeout: its.TimeoutOption = None,
    stamp_tolerance_ms: its.StampToleranceOption = None,
    camera_format: its.CameraFormatOption = None,
) -> None:
    """Estimate the drogue's pose in every pair, from images, rig and drogue dimensions alone.

    Pairs come from a dataset, or with --live from a running camera until Ctrl-C. Each estimate is written as soon as it
    exists. Exits with 1 where a pair cannot be read or our own code fails in it, which then gets no fix with that
    reason, and where a camera's run ends by a fault.
    """
    files = None if not calibration else tuple(calibration)
    images = (files, calibration_unit, image_size, drogue, encoding, black_level, bits)
    camera = LiveOptions(live, *images, timeout, stamp_tolerance_ms, camera_format)
    options = NavigationOptions(
        centroids=centroids,
        detector=detector,
        tracker=tracker,
        redetect_every=redetect_every,
        filtered=filtered,
        smoothed=smoothed,
        capture_radius_m=capture_radius,
        is_live=live is not None,
        rate_hz=rate,
        latency_out=latency,
    )
    done = navigate_pairs(dataset, camera, method or (), out, progress_report(), options)
    for line in done.lines():
        typer.echo(line)
    typer.echo(f"wrote {out}")
    if done.fault is not None:
        typer.echo(f"droguekit: error: {done.fault}", err=True)
        raise typer.Exit(FAULT)
